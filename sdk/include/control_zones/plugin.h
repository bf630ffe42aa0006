/*
 * Write a controller for Control Zones in C.
 *
 *     #include <control_zones/plugin.h>
 *     #include <stdio.h>
 *
 *     int main(void) {
 *         cz_plugin_t *plugin = cz_attach(NULL, NULL, 30.0);
 *         int wake = plugin ? CZ_TIMEOUT : CZ_ERROR;
 *         while (wake != CZ_END && wake != CZ_ERROR) {
 *             wake = cz_wait(plugin, 1.0);
 *             if (wake != CZ_STEP) continue;
 *             const cz_run_spec_t *spec = cz_run_spec(plugin);
 *             size_t count;
 *             const cz_vehicle_t *vehicles = cz_vehicles(plugin, &count);
 *             cz_vehicle_command_t *commands = cz_commands(plugin, &count);
 *             for (size_t i = 0; i < count; i++) {
 *                 double u = 15.0 - vehicles[i].state->v_mps;
 *                 if (u < spec->u_min_mps2) u = spec->u_min_mps2;
 *                 if (u > spec->u_max_mps2) u = spec->u_max_mps2;
 *                 commands[i].u_mps2 = u;
 *             }
 *             if (cz_send(plugin) != 0) wake = CZ_ERROR;
 *         }
 *         if (wake == CZ_ERROR) fprintf(stderr, "%s\n", cz_last_error());
 *         cz_detach(plugin);
 *         return wake == CZ_END ? 0 : 1;
 *     }
 *
 * A handle is used by one thread at a time. Pointers into frames are valid until cz_send: the frames lie in
 * shared memory and go back to the world with it. The contract is docs/plugin-contract.md.
 */
#ifndef CONTROL_ZONES_PLUGIN_H
#define CONTROL_ZONES_PLUGIN_H

#include "cz_schemas.h" /* installed beside this file */

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/** What cz_wait returns. */
#define CZ_TIMEOUT 0 /* nothing came in time; wait again */
#define CZ_STEP 1    /* a step is to be answered */
#define CZ_END 2     /* the run is over */
#define CZ_ERROR (-1) /* see cz_last_error */

/** An attachment to a run. */
typedef struct cz_plugin cz_plugin_t;

/** One vehicle to be commanded, with its partners looked up. */
typedef struct cz_vehicle {
    const cz_vehicle_state_t *state; /**< its record in the state frame */
    const cz_vehicle_state_t *ahead; /**< the nearest vehicle ahead on its way, or NULL */
    const cz_vehicle_state_t *merge; /**< the one that passes the nearest conflict point first, or NULL */
    double length_m;     /**< length of its path, m */
    double terminal_mps; /**< terminal speed to leave with, m/s; NaN when it is free */
    double ahead_x_m;    /**< position of ahead in the vehicle's own coordinate, m, or NaN */
    double merge_x_m;    /**< position of merge in the vehicle's own coordinate, m, or NaN */
    double merge_at_m;   /**< distance of their conflict point on the vehicle's path, m, or NaN */
    double scheduled_at_m;   /**< place on its path that it is scheduled for, m, or NaN */
    double scheduled_time_s; /**< instant before which it is not to be there, s, or NaN */
    double commanded_mps2;   /**< what this controller commanded it for the step just ended, m/s^2, or NaN; what was
                                  applied is state->u_mps2, and the rest is the shield's or the speed limit's */
    uint64_t place;          /**< its place among the records of its zone */
    const cz_vehicle_state_t *zone_states; /**< all records of its zone */
    uint64_t zone_count;     /**< their number */
    const cz_feedback_t *bounded; /**< what the shield found of its last command, or NULL where it let it pass: row says
                                       what bounded it, toward which vehicle, greatest is what it allowed, m/s^2 */
} cz_vehicle_t;

#if defined(__cplusplus)
static_assert(sizeof(cz_vehicle_t) == 80 + 5 * sizeof(void *), "cz_vehicle_t as in the library");
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
_Static_assert(sizeof(cz_vehicle_t) == 80 + 5 * sizeof(void *), "cz_vehicle_t as in the library");
#endif

/** A vehicle that another must respect where the two are now. */
typedef struct cz_partner {
    const cz_vehicle_state_t *state; /**< its record in the state frame */
    double x_m;    /**< its position in the vehicle's own coordinate, m */
    double at_m;   /**< distance of the conflict point on the vehicle's path, m; means nothing toward a leader */
    double gap_m;  /**< distance to be kept to it beside phi v, m */
    uint64_t kind; /**< CZ_CONSTRAINT_REAR_END, CZ_CONSTRAINT_MERGE or CZ_CONSTRAINT_CROSS */
    uint64_t place; /**< its place among the records of the zone; its broadcast intent stands in state */
} cz_partner_t;

/** A step to be answered. */
typedef struct cz_step {
    uint64_t step;    /**< its number */
    double time_s;    /**< simulated time, s */
    uint64_t skipped; /**< steps that have passed without this controller since its last answer */
    uint64_t missed;  /**< 1 when the world put something in for one that was late in the step before */
} cz_step_t;

/** What a run has been for a controller, as the controller saw it. */
typedef struct cz_summary {
    uint64_t step;     /**< step of the last state seen */
    double time_s;     /**< simulated time of it, s */
    uint64_t answered; /**< steps answered */
    uint64_t skipped;  /**< steps that passed without this controller between its answers */
    uint64_t missed;   /**< states before which the world had put something in for one that was late */
    uint64_t refused;  /**< answers that the world refused, as far as it said so: once in a step */
} cz_summary_t;

/** Joins a run. NULL names stand for the environment's CZ_RUN and CZ_CONTROLLER. NULL on failure. */
cz_plugin_t *cz_attach(const char *run, const char *controller, double timeout_s);
/** Leaves the run. NULL is allowed. */
void cz_detach(cz_plugin_t *plugin);
/** What went wrong last on this thread; valid until the next failure on it. */
const char *cz_last_error(void);
/** Waits for a step: CZ_STEP, CZ_TIMEOUT, CZ_END or CZ_ERROR. */
int cz_wait(cz_plugin_t *plugin, double timeout_s);
/** The run's numbers; valid until detached. */
const cz_run_spec_t *cz_run_spec(const cz_plugin_t *plugin);
/** All paths; valid until detached. */
const cz_path_spec_t *cz_paths(const cz_plugin_t *plugin, size_t *count);
/** Name of a path, ZONE.PATH; NULL beyond the last. Valid until detached. */
const char *cz_path_name(const cz_plugin_t *plugin, size_t index);
/** The step to be answered: its number, time and flags. */
cz_step_t cz_step(const cz_plugin_t *plugin);
/** What the run has been so far; after CZ_END, all of it. */
cz_summary_t cz_summary(const cz_plugin_t *plugin);
/** Header of the state frame; valid until cz_send. */
const cz_frame_header_t *cz_header(const cz_plugin_t *plugin);
/** The state frame, all zones; valid until cz_send. */
const cz_vehicle_state_t *cz_states(const cz_plugin_t *plugin, size_t *count);
/** The vehicles to be commanded, in the order of the commands; valid until cz_send. */
const cz_vehicle_t *cz_vehicles(const cz_plugin_t *plugin, size_t *count);
/** All vehicles that the one at this place among cz_vehicles must respect; valid until cz_send. */
const cz_partner_t *cz_partners(const cz_plugin_t *plugin, size_t vehicle, size_t *count);
/** The answers that the world refused since the last one it took, with field and rule; valid until cz_send. */
const cz_feedback_t *cz_refusals(const cz_plugin_t *plugin, size_t *count);
/** Writes feedback in words, ended by 0 and cut to size bytes; returns how many bytes all of it has. */
size_t cz_feedback_text(const cz_feedback_t *feedback, char *text, size_t size);
/** The coordination in force in a zone; valid until the next cz_wait. */
const cz_assignment_t *cz_assignments(const cz_plugin_t *plugin, uint32_t zone, size_t *count);
/** Lends the command frame, vehicles and zones filled in, accelerations 0; valid until cz_send. */
cz_vehicle_command_t *cz_commands(cz_plugin_t *plugin, size_t *count);
/** Sends the command frame: 0, or CZ_ERROR. One that comes too late for its step is dropped, which is no error:
 *  the next step is another chance. */
int cz_send(cz_plugin_t *plugin);

#ifdef __cplusplus
}
#endif

#endif /* CONTROL_ZONES_PLUGIN_H */
