/*
 * Constant time headway: follow whoever is ahead, or merges ahead, at phi seconds plus a gap; go for the
 * terminal speed otherwise.
 *
 *     cz sdk install --prefix sdk-prefix
 *     cc headway.c $(PKG_CONFIG_PATH=sdk-prefix/lib/pkgconfig pkg-config --cflags --libs control-zones) -lm
 */
#include <control_zones/plugin.h>
#include <math.h>
#include <stdio.h>

static double clamp(double u, double low, double high) { return fmax(low, fmin(u, high)); }

/* Acceleration toward a headway of phi seconds behind a vehicle at x going v. */
static double follow(const cz_run_spec_t *spec, const cz_vehicle_state_t *self, double x, double v) {
    double gap = x - self->x_m - spec->standstill_gap_m - 2.0;
    double wanted = spec->reaction_time_s * self->v_mps;
    return 0.4 * (gap - wanted) + 1.2 * (v - self->v_mps);
}

static double drive(const cz_run_spec_t *spec, const cz_vehicle_t *vehicle) {
    const cz_vehicle_state_t *self = vehicle->state;
    double speed = isnan(vehicle->terminal_mps) ? 18.0 : vehicle->terminal_mps;
    double u = 0.6 * (speed - self->v_mps);
    if (vehicle->ahead) u = fmin(u, follow(spec, self, vehicle->ahead_x_m, vehicle->ahead->v_mps));
    if (vehicle->merge) u = fmin(u, follow(spec, self, vehicle->merge_x_m, vehicle->merge->v_mps));
    return clamp(u, spec->u_min_mps2, spec->u_max_mps2);
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
        for (size_t i = 0; i < count; i++) {
            commands[i].u_mps2 = drive(cz_run_spec(plugin), &vehicles[i]);
        }
        if (cz_send(plugin) != 0) wake = CZ_ERROR;
    }
    if (wake == CZ_ERROR) fprintf(stderr, "%s\n", cz_last_error());
    cz_detach(plugin);
    return wake == CZ_END ? 0 : 1;
}
