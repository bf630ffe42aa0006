// @NAME@: goes for the terminal speed, and keeps its distance to all it must respect.
#include <control_zones/plugin.hpp>

#include <algorithm>
#include <cmath>
#include <exception>
#include <iostream>

namespace {

/// One acceleration per vehicle, m/s^2.
struct Controller {
    double step(const control_zones::Session &session, const cz_vehicle_t &vehicle, std::size_t place) {
        const auto &spec = session.spec();
        const double x = vehicle.state->x_m, v = vehicle.state->v_mps;
        double u = 0.6 * ((std::isnan(vehicle.terminal_mps) ? 18.0 : vehicle.terminal_mps) - v);
        for (const cz_partner_t &partner : session.partners(place)) {
            const double gap = partner.x_m - x - partner.gap_m - spec.reaction_time_s * v;
            u = std::min(u, 0.4 * gap + 1.2 * (partner.state->v_mps - v));
        }
        return std::clamp(u, spec.u_min_mps2, spec.u_max_mps2);
    }

    /// Called when the run is over.
    void on_end(const cz_summary_t &summary) {
        std::cout << summary.answered << " steps answered, " << summary.skipped
                  << " passed without this controller\n";
    }
};

} // namespace

int main() {
    try {
        Controller controller;
        control_zones::drive(controller);
    } catch (const std::exception &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
