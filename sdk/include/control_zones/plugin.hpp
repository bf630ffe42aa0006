// Write a controller for Control Zones in C++17: a RAII session, and a loop around a function.
//
//     #include <algorithm>
//     #include <control_zones/plugin.hpp>
//     #include <iostream>
//
//     int main() {
//         try {
//             control_zones::run([](const control_zones::Session &session, const cz_vehicle_t &vehicle) {
//                 const auto &spec = session.spec();
//                 return std::clamp(15.0 - vehicle.state->v_mps, spec.u_min_mps2, spec.u_max_mps2);
//             });
//         } catch (const std::exception &error) {
//             std::cerr << error.what() << '\n';
//             return 1;
//         }
//     }
#ifndef CONTROL_ZONES_PLUGIN_HPP
#define CONTROL_ZONES_PLUGIN_HPP

#include "plugin.h"

#include <memory>
#include <stdexcept>
#include <string>
#include <utility>

namespace control_zones {

/// Why a controller cannot go on.
struct Error : std::runtime_error {
    Error() : std::runtime_error(cz_last_error()) {}
};

/// Feedback in words.
inline std::string text(const cz_feedback_t &feedback) {
    std::string words(cz_feedback_text(&feedback, nullptr, 0), '\0');
    cz_feedback_text(&feedback, words.data(), words.size() + 1);
    return words;
}

/// A borrowed range of records.
template <class T> class Range {
public:
    Range(T *data, std::size_t size) : data_(data), size_(size) {}
    T *begin() const { return data_; }
    T *end() const { return data_ + size_; }
    std::size_t size() const { return size_; }
    T &operator[](std::size_t i) const { return data_[i]; }

private:
    T *data_;
    std::size_t size_;
};

/// One attachment to a run; leaves it when destroyed.
class Session {
public:
    /// Joins the run the environment names, unless names are given.
    explicit Session(const char *run = nullptr, const char *controller = nullptr, double timeout_s = 30.0)
        : plugin_(cz_attach(run, controller, timeout_s)) {
        if (!plugin_) throw Error();
    }

    /// Waits for the next step; false at the end of the run.
    bool wait() {
        for (;;) {
            switch (cz_wait(plugin_.get(), 1.0)) {
            case CZ_STEP: return true;
            case CZ_END: return false;
            case CZ_TIMEOUT: break;
            default: throw Error();
            }
        }
    }

    const cz_run_spec_t &spec() const { return *cz_run_spec(plugin_.get()); }
    const cz_frame_header_t &header() const { return *cz_header(plugin_.get()); }
    double time_s() const { return static_cast<double>(header().time_ns) * 1e-9; }
    Range<const cz_path_spec_t> paths() const { return range(cz_paths); }
    Range<const cz_vehicle_state_t> states() const { return range(cz_states); }
    Range<const cz_vehicle_t> vehicles() const { return range(cz_vehicles); }
    /// All that the vehicle at this place among vehicles() must respect.
    Range<const cz_partner_t> partners(std::size_t vehicle) const {
        std::size_t count = 0;
        const cz_partner_t *data = cz_partners(plugin_.get(), vehicle, &count);
        return {data, count};
    }
    /// The answers that the world refused since the last one it took, with field and rule.
    Range<const cz_feedback_t> refusals() const { return range(cz_refusals); }
    /// The step to be answered: its number, time and flags.
    cz_step_t step() const { return cz_step(plugin_.get()); }
    /// What the run has been so far.
    cz_summary_t summary() const { return cz_summary(plugin_.get()); }

    /// The command frame being written.
    Range<cz_vehicle_command_t> commands() {
        std::size_t count = 0;
        cz_vehicle_command_t *data = cz_commands(plugin_.get(), &count);
        if (!data) throw Error();
        return {data, count};
    }

    /// Sends it.
    void send() {
        if (cz_send(plugin_.get()) != 0) throw Error();
    }

private:
    template <class T> Range<const T> range(const T *(*get)(const cz_plugin_t *, std::size_t *)) const {
        std::size_t count = 0;
        const T *data = get(plugin_.get(), &count);
        return {data, count};
    }

    struct Detach {
        void operator()(cz_plugin_t *plugin) const { cz_detach(plugin); }
    };
    std::unique_ptr<cz_plugin_t, Detach> plugin_;
};

/// Joins the run the environment names and answers every step: `law(session, vehicle)` is the acceleration.
template <class Law> void run(Law &&law) {
    Session session;
    while (session.wait()) {
        auto vehicles = session.vehicles();
        auto commands = session.commands();
        for (std::size_t i = 0; i < vehicles.size(); ++i) {
            commands[i].u_mps2 = law(std::as_const(session), vehicles[i]);
        }
        session.send();
    }
}

/// Joins the run the environment names and answers every step: `controller.step(session, vehicle, place)` is the
/// acceleration of the vehicle at that place among `session.vehicles()`; `controller.on_end(summary)` is called when the
/// run is over.
template <class Controller> void drive(Controller &controller) {
    Session session;
    while (session.wait()) {
        auto vehicles = session.vehicles();
        auto commands = session.commands();
        for (std::size_t i = 0; i < vehicles.size(); ++i) {
            commands[i].u_mps2 = controller.step(std::as_const(session), vehicles[i], i);
        }
        session.send();
    }
    controller.on_end(session.summary());
}

} // namespace control_zones

#endif // CONTROL_ZONES_PLUGIN_HPP
