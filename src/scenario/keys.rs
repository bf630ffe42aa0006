//! The keys of a scenario, each declared once: its name, what it takes, its default and its meaning.
//!
//! The loader reads by these declarations, [`check`](super::Scenario::check) holds scenarios that come as bytes to
//! them, and `docs/scenario.md` is made from them.

mod document;
mod kinds;

pub use document::document;
pub(in crate::scenario) use kinds::{Choice, Flag, Key, Number, other};

use super::embedded::trace_names;
use super::ranges;
use super::{
    EntryRule, FeConditions, LawKind, PassingOrder, PositionFeedback, ReferenceLaw, Replan, SafetyRows,
    ScheduleKind, ShieldMode, Solver, ViableParams, Yielding,
};
use kinds::{number, without_default};

/// Keys of one table.
pub(in crate::scenario) type Keys = &'static [&'static dyn Key];

// The top level and [end].
pub(in crate::scenario) static DT: Number =
    number("dt_s", ranges::STEP, 0.1, "step; a whole number of nanoseconds");
pub(in crate::scenario) static SHIELD: Choice<ShieldMode> = Choice {
    name: "shield",
    words: &[("off", ShieldMode::Off), ("observe", ShieldMode::Observe), ("on", ShieldMode::On)],
    meaning: "safety shield in front of the vehicles ([shield](shield.md)); `observe` only counts",
};
pub(in crate::scenario) static ROOT: Keys = &[
    &other("name", "text", "required", "letters, digits, `_`, `-`"),
    &other("seed", "integer from 0 to 2^64 - 1", "1", "of all random streams; `--seed` goes before it"),
    &DT,
    &other("end", "table", "see below", "when the run ends"),
    &other("vehicle", "table", "see below", "limits of vehicles, and distances they keep"),
    &other("objective", "table", "required", "weight of time against energy"),
    &other("control", "table", "see below", "the built-in controllers' law"),
    &other("coordination", "table", "see below", "what coordinators do beside assigning duties"),
    &other("gate", "table", "see below", "when arrivals may enter"),
    &SHIELD,
    &other("fleet", "list", "one kind", "kinds of vehicles"),
    &other("roads", "list", "required", "entry roads; their order breaks ties between simultaneous arrivals"),
    &other("zones", "list", "required", "control zones, in any order; from each there must be a way out"),
    &other("controllers", "list", "none", "controllers written elsewhere ([contract](plugin-contract.md))"),
    &other("faults", "table", "none", "what goes wrong on purpose ([faults](faults.md))"),
];

pub(in crate::scenario) static END: Keys = &[
    &other(
        "vehicles",
        "integer from 1 to 4294967295",
        "no limit",
        "arrivals after this many, over all roads, are not generated",
    ),
    &other(
        "time_s",
        "a time in s, at least `dt_s`, at most 1e9 s and 1e9 steps",
        "7200",
        "the run ends here at the latest, and earlier when everybody has left",
    ),
];

// [vehicle]
pub(in crate::scenario) static U_MIN: Number =
    number("u_min_mps2", ranges::BRAKING, -4.0, "strongest braking");
pub(in crate::scenario) static U_MAX: Number =
    number("u_max_mps2", ranges::ACCELERATION, 4.0, "strongest acceleration");
pub(in crate::scenario) static V_MIN: Number = number("v_min_mps", ranges::LEAST_SPEED, 0.0, "least speed");
pub(in crate::scenario) static V_MAX: Number =
    number("v_max_mps", ranges::GREATEST_SPEED, 30.0, "greatest speed, more than `v_min_mps`");
pub(in crate::scenario) static LENGTH: Number = number(
    "length_m",
    ranges::VEHICLE_LENGTH,
    4.5,
    "a body reaches from the position back by this; decides when an arrival would overlap another vehicle, and what \
     counts as an overlap",
);
pub(in crate::scenario) static REACTION_TIME: Number =
    number("reaction_time_s", ranges::REACTION_TIME, 1.8, "φ of the safety distance φ·v + δ");
pub(in crate::scenario) static STANDSTILL_GAP: Number =
    number("standstill_gap_m", ranges::STANDSTILL_GAP, 0.0, "δ");
pub(in crate::scenario) static VEHICLE: Keys =
    &[&U_MIN, &U_MAX, &V_MIN, &V_MAX, &LENGTH, &REACTION_TIME, &STANDSTILL_GAP];

// [[fleet]]
pub(in crate::scenario) static SHARE: Number =
    number("share", ranges::SHARE, 1.0, "weight with which it is chosen");
pub(in crate::scenario) static FLEET: Keys = &[
    &other("name", "text", "required", "unique among the kinds"),
    &SHARE,
    &U_MIN,
    &U_MAX,
    &V_MIN,
    &V_MAX,
    &LENGTH,
    &REACTION_TIME,
    &STANDSTILL_GAP,
    &DRIVER,
    &YIELDS,
    &DESIRED,
    &DESIRED_SD,
    &TIME_HEADWAY,
    &JAM_GAP,
    &IDM_ACCELERATION,
    &COMFORTABLE,
    &DELAY,
    &NOISE,
    &CRITICAL_GAP,
    &PATIENCE,
    &HARDEST,
    &SCARES,
];

// Human drivers.
pub(in crate::scenario) static DRIVER: Choice<bool> = Choice {
    name: "driver",
    words: &[("automated", false), ("human", true)],
    meaning: "who drives: controllers, or a human ([mixed traffic](mixed.md)); the limits of a human's vehicle are what \
              others reckon with. What follows is for humans alone",
};
pub(in crate::scenario) static YIELDS: Choice<Yielding> = Choice {
    name: "yields",
    words: Yielding::WORDS,
    meaning: "who goes first at conflict points: as the coordinator says, by the roads' `rank`, or who comes first; with the \
              latter two where no gap is accepted",
};
pub(in crate::scenario) static DESIRED: Number = without_default(
    "desired_mps",
    ranges::HUMAN_SPEED,
    "`v_max_mps`",
    "mean desired speed, at most `v_max_mps`",
);
pub(in crate::scenario) static DESIRED_SD: Number =
    number("desired_sd_mps", ranges::DEVIATION, 0.0, "its standard deviation over drivers, m/s");
pub(in crate::scenario) static TIME_HEADWAY: Number =
    number("headway_s", ranges::HUMAN_TIME, 1.2, "time headway T of the intelligent driver model");
pub(in crate::scenario) static JAM_GAP: Number =
    number("jam_gap_m", ranges::STANDSTILL_GAP, 2.0, "distance between bodies at a standstill, s0");
pub(in crate::scenario) static IDM_ACCELERATION: Number =
    number("acceleration_mps2", ranges::HUMAN_ACCELERATION, 1.5, "greatest acceleration, a");
pub(in crate::scenario) static COMFORTABLE: Number =
    number("comfortable_mps2", ranges::HUMAN_ACCELERATION, 2.0, "comfortable deceleration, b");
pub(in crate::scenario) static DELAY: Number =
    number("delay_s", ranges::HUMAN_DELAY, 0.6, "delay with which they notice what others do");
pub(in crate::scenario) static NOISE: Number = number(
    "noise_mps2",
    ranges::DEVIATION,
    0.1,
    "deviation of the acceleration, drawn anew every second, m/s^2",
);
pub(in crate::scenario) static CRITICAL_GAP: Number = number(
    "critical_gap_s",
    ranges::HUMAN_TIME,
    2.0,
    "least time from their clearing a conflict point to the arrival of one that has the right of way",
);
pub(in crate::scenario) static PATIENCE: Number = number(
    "patience_s",
    ranges::HUMAN_TIME,
    10.0,
    "having stood longer than this since they drove last they go before whoever stands",
);
pub(in crate::scenario) static HARDEST: Number = without_default(
    "hardest_mps2",
    ranges::HUMAN_ACCELERATION,
    "that of `u_min_mps2`",
    "how hard they brake at most, as a positive number",
);
pub(in crate::scenario) static SCARES: Number =
    number("scares_per_h", ranges::RATE, 0.0, "how often they brake as hard as that for 2 s for no reason");

// [objective]
pub(in crate::scenario) static BETA: Number =
    without_default("beta", ranges::BETA, "this or `alpha` is required", "weight of time against energy");
pub(in crate::scenario) static OBJECTIVE: Keys = &[
    &other(
        "alpha",
        "a weight with 0 < alpha < 1",
        "this or `beta` is required",
        "beta = alpha · max(u_max², u_min²) / (2 (1 − alpha)), in the range of `beta`",
    ),
    &BETA,
];

// [control]
pub(in crate::scenario) static REFERENCE: Choice<ReferenceLaw> = Choice {
    name: "reference",
    words: &[("corrected", ReferenceLaw::Corrected), ("as_printed", ReferenceLaw::AsPrinted)],
    meaning: "equation for the plan's duration",
};
pub(in crate::scenario) static REPLAN: Choice<Replan> = Choice {
    name: "replan",
    words: &[("from_entry", Replan::FromEntry), ("from_state", Replan::FromState)],
    meaning: "where a new plan starts when the terminal speed changes",
};
pub(in crate::scenario) static POSITION_FEEDBACK: Choice<PositionFeedback> = Choice {
    name: "position_feedback",
    words: &[("approximate", PositionFeedback::Approximate), ("exact", PositionFeedback::Exact)],
    meaning: "how the reference time is found",
};
pub(in crate::scenario) static SOLVER: Choice<Solver> = Choice {
    name: "solver",
    words: &[("closed_form", Solver::ClosedForm), ("clarabel", Solver::Clarabel)],
    meaning: "who solves the QP",
};
pub(in crate::scenario) static SAFETY_ROWS: Choice<SafetyRows> = Choice {
    name: "safety_rows",
    words: &[("continuous", SafetyRows::Continuous), ("sampled", SafetyRows::Sampled)],
    meaning: "form of the rear-end row",
};
pub(in crate::scenario) static K_REAR_END: Number =
    number("k_rear_end_per_s", ranges::GAIN, 1.0, "gain k1 of the rear-end row");
pub(in crate::scenario) static K_MERGE: Number =
    number("k_merge_per_s", ranges::GAIN, 1.0, "gain k2 of the merging and crossing rows");
pub(in crate::scenario) static K_SPEED: Number =
    number("k_speed_per_s", ranges::GAIN, 1.0, "gain of the speed rows");
pub(in crate::scenario) static CLF_RATE: Number =
    number("clf_rate_per_s", ranges::GAIN, 10.0, "rate ε of the tracking (CLF) row");
pub(in crate::scenario) static SLACK_WEIGHT: Number =
    without_default("slack_weight", ranges::SLACK_WEIGHT, "`beta`", "weight λ of its squared slack");
pub(in crate::scenario) static CLF: Flag =
    Flag { name: "clf", default: true, meaning: "whether the tracking row is there" };
pub(in crate::scenario) static FEASIBILITY_ROWS: Flag =
    Flag { name: "feasibility_rows", default: true, meaning: "whether the feasibility rows are there" };
pub(in crate::scenario) static FE_CONDITIONS: Choice<FeConditions> = Choice {
    name: "fe_conditions",
    words: &[("full", FeConditions::Full), ("barrier", FeConditions::Barrier), ("off", FeConditions::Off)],
    meaning: "what keeps a vehicle in feasibility-enforcement mode: all entry conditions, only b ≥ 0, or no such mode",
};
// control.viable
const DEFAULT: ViableParams = ViableParams::DEFAULT;
pub(in crate::scenario) static VIABILITY: Flag = Flag {
    name: "viability",
    default: DEFAULT.viability,
    meaning: "whether accelerations are bounded by what is viable",
};
pub(in crate::scenario) static COMFORT: Flag = Flag {
    name: "comfort",
    default: DEFAULT.comfort,
    meaning: "whether there is the comfort row toward leaders",
};
pub(in crate::scenario) static BODIES: Flag = Flag {
    name: "bodies",
    default: DEFAULT.bodies,
    meaning: "whether there is the second tier: nobody drives through anybody",
};
pub(in crate::scenario) static SLOTS: Flag =
    Flag { name: "slots", default: DEFAULT.slots, meaning: "whether slots behind partners are kept" };
pub(in crate::scenario) static K_COMFORT: Number =
    number("k_comfort_per_s", ranges::GAIN, DEFAULT.k_comfort_per_s, "gain of the comfort row");
pub(in crate::scenario) static PRICE_OF_EXPOSURE: Number = number(
    "price_of_exposure_mps4",
    ranges::PRICE_OF_EXPOSURE,
    DEFAULT.price_of_exposure_mps4,
    "what a metre of missing margin costs a second, by which it is made up",
);
pub(in crate::scenario) static CLEARANCE: Number = number(
    "clearance_m",
    ranges::STANDSTILL_GAP,
    DEFAULT.clearance_m,
    "distance between bodies that the second tier keeps",
);
pub(in crate::scenario) static BUFFER: Number =
    number("buffer_m", ranges::STANDSTILL_GAP, DEFAULT.buffer_m, "distance added to a slot");
pub(in crate::scenario) static BUFFER_TIME: Number = number(
    "buffer_s",
    ranges::REACTION_TIME,
    DEFAULT.buffer_s,
    "in proportion to the time to go where that is less than this",
);
pub(in crate::scenario) static PASSAGE_WEIGHT: Number = number(
    "passage_weight",
    ranges::SHARE,
    DEFAULT.passage_weight,
    "how many others' time counts when a slow passage holds up those behind",
);
pub(in crate::scenario) static VIABLE: Keys = &[
    &VIABILITY,
    &COMFORT,
    &BODIES,
    &SLOTS,
    &K_COMFORT,
    &PRICE_OF_EXPOSURE,
    &CLEARANCE,
    &BUFFER,
    &BUFFER_TIME,
    &PASSAGE_WEIGHT,
];

// [coordination]
pub(in crate::scenario) static SCHEDULE: Choice<ScheduleKind> = Choice {
    name: "schedule",
    words: ScheduleKind::WORDS,
    meaning: "whether coordinators schedule when vehicles leave ([control](control.md)): not, at least cost over the zone, or \
              over the zone and the next",
};
pub(in crate::scenario) static PRICE_OF_TIME: Number = number(
    "price_of_time",
    ranges::PRICE_OF_TIME,
    0.7,
    "what a second costs those who are not there yet, as a share of what it costs the vehicle itself",
);
pub(in crate::scenario) static TANDEM_WEIGHT: Number =
    number("tandem_weight", ranges::TANDEM_WEIGHT, 0.3, "weight of the next zone's cost beside this one's");
pub(in crate::scenario) static COORDINATION: Keys = &[
    &SCHEDULE,
    &PRICE_OF_TIME,
    &TANDEM_WEIGHT,
    &other("order", "as `order` of a zone", "`fifo`", "passing order of zones that name none"),
];

// [gate]
pub(in crate::scenario) static ENTRY: Choice<EntryRule> = Choice {
    name: "entry",
    words: EntryRule::WORDS,
    meaning: "when an arrival may enter behind the last vehicle on its road: once it overlaps nobody, is viable \
              toward it, or can stop behind it",
};
pub(in crate::scenario) static GATE: Keys = &[&ENTRY];

pub(in crate::scenario) static LAW: Choice<LawKind> =
    Choice { name: "law", words: LawKind::WORDS, meaning: "the law; a zone may have its own (`law`)" };
pub(in crate::scenario) static CONTROL: Keys = &[
    &LAW,
    &REFERENCE,
    &REPLAN,
    &POSITION_FEEDBACK,
    &SOLVER,
    &SAFETY_ROWS,
    &K_REAR_END,
    &K_MERGE,
    &K_SPEED,
    &CLF_RATE,
    &SLACK_WEIGHT,
    &CLF,
    &FEASIBILITY_ROWS,
    &FE_CONDITIONS,
    &other(
        "fe_fraction",
        "a fraction with 0 < f <= 1",
        "0.25",
        "part of the path in which that mode may act",
    ),
    &other("viable", "table", "see below", "parts and gains of the law `viable` ([control](control.md))"),
];

// [[roads]]
pub(in crate::scenario) static AUTOMATED: Number = without_default(
    "automated",
    ranges::PART,
    "as the kinds' shares say",
    "share of its vehicles that are of the kinds without human drivers",
);
pub(in crate::scenario) static ROADS: Keys = &[
    &other("name", "text", "required", "unique among the roads; arrival traces use it"),
    &other("demand", "table", "required", "who arrives when: a trace, or random arrivals"),
    &other("routes", "list", "paths are drawn", "ways its vehicles may take"),
    &other("entry", "as `entry` of `[gate]`", "that of `[gate]`", "when its vehicles may enter"),
    &AUTOMATED,
    &other(
        "rank",
        "integer from 0 to 1000",
        "0",
        "humans give way to those of higher rank ([mixed traffic](mixed.md))",
    ),
];
pub(in crate::scenario) static ROUTES: Keys = &[
    &other("name", "text", "required", "unique among the road's; a trace's column `route` uses it"),
    &other(
        "paths",
        "list of `\"ZONE.PATH\"`",
        "required",
        "in the order in which they are driven; then paths are drawn",
    ),
    &SHARE,
];
pub(in crate::scenario) static TRACE: Keys = &[
    &other(
        "trace",
        "text",
        "this or `rates` is required",
        concat!(
            "one of the traces that come with the program (",
            trace_names!(),
            "), or a CSV file with the header `time_s,road,speed_mps`, and `route` as a fourth column if some rows name one \
             of the road's, rows in order of time; a road takes its own rows. Relative to the scenario file. `{seed}` in it \
             is replaced by the seed"
        ),
    ),
    &other(
        "trace_seeds",
        "list of seeds",
        "none",
        "beside both `trace` and random arrivals: seeds that have a trace; others draw random ones. What `--set` gives \
         of the two goes before it",
    ),
];
pub(in crate::scenario) static RANDOM: Keys = &[
    &other(
        "rates",
        "list of `{ until_s, vehicles_per_hour }`",
        "this or `trace` is required",
        "periods in order, up to 1e9 s, with `vehicles_per_hour` 0 to 36000; demand ends with the last",
    ),
    &other(
        "min_headway_s",
        "a time from 0 to 1e6 s",
        "required",
        "least time between arrivals; an exponential one is added so that the mean fits the rate",
    ),
    &other("speed_mean_mps", "a speed in m/s", "required", "mean of the normal distribution of entry speeds"),
    &other("speed_sd_mps", "m/s", "required", "its standard deviation"),
    &other("speed_min_mps", "m/s, at least `v_min_mps`", "required", "speeds are redrawn until within this"),
    &other("speed_max_mps", "m/s, at most `v_max_mps`", "required", "and this"),
];

// [[zones]]
pub(in crate::scenario) static ORDER: Choice<PassingOrder> = Choice {
    name: "order",
    words: PassingOrder::WORDS,
    meaning: "who passes a conflict point first ([zones](zones.md))",
};
pub(in crate::scenario) static ZONES: Keys = &[
    &other("name", "text", "required", "unique among the zones"),
    &other("flow", "table", "no flow control", "flow policy of the zone's exits"),
    &other(
        "approaches",
        "list",
        "this or `segments`",
        "the short form of a merge: one path each, all to one exit",
    ),
    &other("segments", "list", "this or `approaches`", "stretches of lane"),
    &other("paths", "list", "required with `segments`", "chains of segments from an entrance to an exit"),
    &other(
        "exits",
        "list",
        "those that paths name",
        "ways out; one that no source names leads out of the network",
    ),
    &other("crossings", "list", "none", "conflict areas of segments that no path shares"),
    &ORDER,
    &other("law", "as `law` of `[control]`", "that of `[control]`", "law of the zone's built-in controllers"),
];
pub(in crate::scenario) static APPROACHES: Keys = &[
    &other("name", "text", "required", "unique in the zone"),
    &other("length_m", "a length from 1 to 1e6 m, at least v_max · dt", "required", "the paper's L"),
    &other("road", "text", "this or `zone` is required", "source: an entry road"),
    &other("zone", "text", "this or `road` is required", "source: a zone upstream"),
    &other("exit", "text", "its only exit", "which of its exits"),
    &other(
        "link_m",
        "0, or a length from 1 to 1e6 m and at least v_max · dt",
        "0",
        "plain road in between; with `zone` only",
    ),
    &other(
        "link_speed_mps",
        "a speed from 0.01 m/s to `v_max_mps`",
        "half of `v_max_mps`",
        "driven on that road where nobody is in the way",
    ),
];
pub(in crate::scenario) static KEEP_CLEAR: Flag = Flag {
    name: "keep_clear",
    default: false,
    meaning: "of no entrance: whoever is to let a human pass who does not follow the order waits before it, not on it",
};
pub(in crate::scenario) static SEGMENTS: Keys = &[
    &other("name", "text", "required", "unique in the zone"),
    &other("length_m", "a length from 0.01 to 1e6 m", "that of `shape`", ""),
    &other("shape", "list of points `[x, y]` in m", "not drawn to scale", "how it lies"),
    &KEEP_CLEAR,
    &other("road", "text", "no entrance", "of an entrance: as in `zones.approaches`"),
    &other("zone", "text", "no entrance", "of an entrance: as in `zones.approaches`"),
    &other("exit", "text", "its only exit", "as in `zones.approaches`"),
    &other("link_m", "as in `zones.approaches`", "0", ""),
    &other("link_speed_mps", "as in `zones.approaches`", "half of `v_max_mps`", ""),
];
pub(in crate::scenario) static PATHS: Keys = &[
    &other("name", "text", "required", "unique in the zone"),
    &other(
        "segments",
        "list of names",
        "required",
        "from an entrance on; together 1 to 1e6 m and at least v_max · dt long",
    ),
    &other("exit", "text", "the only one", "the exit it leads to"),
    &SHARE,
];
pub(in crate::scenario) static EXITS: Keys = &[
    &other("name", "text", "required", "unique in the zone"),
    &other("flow", "table", "that of the zone", "flow policy in place of the zone's"),
];
pub(in crate::scenario) static CROSSINGS: Keys = &[
    &other("name", "text", "required", "unique in the zone"),
    &other(
        "length_m",
        "a length from 0.1 to 1000 m",
        "required where `at` does not say it",
        "extent of the conflict area along a path",
    ),
    &other(
        "at",
        "table",
        "required",
        "segments, and where the area begins on each, or begins and ends, m: `{ a = 12.5, b = [8, 12] }`",
    ),
];

// [[controllers]]
pub(in crate::scenario) static CONTROLLERS: Keys = &[
    &other("name", "text", "required", "unique among the controllers"),
    &other("zones", "list of names", "none", "zones it drives, with all their paths"),
    &other("paths", "list of `\"ZONE.PATH\"`", "none", "single paths it drives"),
    &other("command", "text", "started by hand", "command line that starts it"),
    &other(
        "on_exit",
        "`\"end\"`, `\"restart\"`, `\"builtin\"` or `\"shield-fallback\"`",
        "`\"end\"`",
        "what becomes of its vehicles when its process ends in the middle of a run ([plug-ins](plugins.md))",
    ),
];

// [faults]
pub(in crate::scenario) static FAULTS: Keys = &[
    &other(
        "noise",
        "`{ position_sd_m, speed_sd_mps }`",
        "none",
        "noise on every published position and speed",
    ),
    &other(
        "sensors",
        "list: `kind = \"bias\"` with `position_m`, `speed_mps`, or `kind = \"frozen\"`; scope",
        "none",
        "sensors that are wrong by a constant, or repeat themselves",
    ),
    &other(
        "commands",
        "`{ loss, delay_steps, delay_probability }`",
        "none",
        "commands that never come, or late",
    ),
    &other("stalls", "list: scope", "none", "silent controllers"),
];

/// Names of keys, in order.
pub(in crate::scenario) fn names(keys: &[&dyn Key]) -> Vec<&'static str> {
    keys.iter().map(|key| key.name()).collect()
}
