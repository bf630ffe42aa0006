// The intelligent driver model (Treiber, Hennecke, Helbing 2000), toward the vehicle ahead and toward the
// one that merges ahead.
#include <control_zones/plugin.hpp>

#include <algorithm>
#include <cmath>
#include <exception>
#include <iostream>

namespace {

constexpr double kComfort = 2.0; // acceleration and deceleration, m/s^2
constexpr double kJam = 2.0;     // standstill gap, m

double idm(const cz_run_spec_t &spec, double v, double v0, double gap, double approach) {
    const double wanted =
        kJam + std::max(0.0, spec.reaction_time_s * v + v * approach / (2.0 * kComfort));
    const double interaction = std::pow(wanted / std::max(gap, 0.1), 2);
    return kComfort * (1.0 - std::pow(v / v0, 4) - interaction);
}

} // namespace

int main() {
    try {
        control_zones::run([](const control_zones::Session &session, const cz_vehicle_t &vehicle) {
            const auto &spec = session.spec();
            const double x = vehicle.state->x_m, v = vehicle.state->v_mps;
            const double v0 = std::isnan(vehicle.terminal_mps) ? 20.0 : vehicle.terminal_mps + 2.0;
            double u = idm(spec, v, v0, 1e9, 0.0);
            if (vehicle.ahead) {
                u = std::min(u, idm(spec, v, v0, vehicle.ahead_x_m - x, v - vehicle.ahead->v_mps));
            }
            if (vehicle.merge) {
                u = std::min(u, idm(spec, v, v0, vehicle.merge_x_m - x, v - vehicle.merge->v_mps));
            }
            return std::clamp(u, spec.u_min_mps2, spec.u_max_mps2);
        });
    } catch (const std::exception &error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
}
