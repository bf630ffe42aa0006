/* Constant time headway: goes for the terminal speed, and keeps its distance to all it must respect. */
#include <control_zones/plugin.h>
#include <math.h>
#include <stdio.h>

/* One acceleration, m/s^2, for the vehicle at this place among those to be commanded. */
static double decide(const cz_plugin_t *plugin, const cz_vehicle_t *vehicle, size_t place) {
    const cz_run_spec_t *spec = cz_run_spec(plugin);
    double x = vehicle->state->x_m, v = vehicle->state->v_mps;
    double u = 0.6 * ((isnan(vehicle->terminal_mps) ? 18.0 : vehicle->terminal_mps) - v);
    size_t count;
    const cz_partner_t *partners = cz_partners(plugin, place, &count);
    for (size_t i = 0; i < count; i++) {
        double gap = partners[i].x_m - x - partners[i].gap_m - spec->reaction_time_s * v;
        u = fmin(u, 0.4 * gap + 1.2 * (partners[i].state->v_mps - v));
    }
    return fmax(spec->u_min_mps2, fmin(u, spec->u_max_mps2));
}

int main(void) {
    cz_plugin_t *plugin = cz_attach(NULL, NULL, 30.0);
    int wake = plugin ? CZ_TIMEOUT : CZ_ERROR;
    while (wake == CZ_TIMEOUT || wake == CZ_STEP) {
        wake = cz_wait(plugin, 1.0);
        if (wake != CZ_STEP) continue;
        size_t count;
        const cz_vehicle_t *vehicles = cz_vehicles(plugin, &count);
        cz_vehicle_command_t *commands = cz_commands(plugin, &count);
        for (size_t i = 0; i < count; i++) commands[i].u_mps2 = decide(plugin, &vehicles[i], i);
        if (cz_send(plugin) != 0) wake = CZ_ERROR;
    }
    if (wake == CZ_ERROR) {
        fprintf(stderr, "%s\n", cz_last_error());
    } else {
        cz_summary_t summary = cz_summary(plugin);
        printf("%llu steps answered, %llu passed without this controller\n",
               (unsigned long long)summary.answered, (unsigned long long)summary.skipped);
    }
    cz_detach(plugin);
    return wake == CZ_END ? 0 : 1;
}
