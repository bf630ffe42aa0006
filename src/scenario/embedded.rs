//! Scenarios and arrival traces that are part of the program, so that it runs from any directory.

/// Name and text, the default first.
pub(super) const SCENARIOS: [(&str, &str); 11] = [
    ("two-merges", include_str!("../../scenarios/two-merges.toml")),
    ("paper", include_str!("../../scenarios/paper.toml")),
    ("varying-demand", include_str!("../../scenarios/varying-demand.toml")),
    ("corridor-8", include_str!("../../scenarios/corridor-8.toml")),
    ("tree", include_str!("../../scenarios/tree.toml")),
    ("faulty-sensors", include_str!("../../scenarios/faulty-sensors.toml")),
    ("intersection", include_str!("../../scenarios/intersection.toml")),
    ("roundabout", include_str!("../../scenarios/roundabout.toml")),
    ("lane-drop", include_str!("../../scenarios/lane-drop.toml")),
    ("grid-3x3", include_str!("../../scenarios/grid-3x3.toml")),
    ("mixed-merges", include_str!("../../scenarios/mixed-merges.toml")),
];

macro_rules! traces {
    ($($name:literal),* $(,)?) => {
        [$(($name, include_str!(concat!("../../scenarios/data/", $name, ".csv")))),*]
    };
}

/// Name and text of arrival traces, which every scenario may use by name, wherever its file is. Those to 3 are what things
/// were tuned on.
#[rustfmt::skip]
const TRACES: [(&str, &str); 66] = traces![
    "sumo-400-1", "sumo-400-2", "sumo-400-3", "sumo-400-4", "sumo-400-5", "sumo-400-6", "sumo-400-7",
    "sumo-400-8", "sumo-400-9", "sumo-400-10", "sumo-400-11", "sumo-400-12", "sumo-400-13", "sumo-400-14",
    "sumo-400-15", "sumo-400-16", "sumo-400-17", "sumo-400-18", "sumo-400-19", "sumo-400-20", "sumo-400-21",
    "sumo-400-22", "sumo-400-23", "sumo-600-4", "sumo-600-5", "sumo-600-6", "sumo-600-7", "sumo-600-8",
    "sumo-600-9", "sumo-600-10", "sumo-600-11", "sumo-600-12", "sumo-600-13", "sumo-600-14", "sumo-600-15",
    "sumo-600-16", "sumo-600-17", "sumo-600-18", "sumo-600-19", "sumo-600-20", "sumo-600-21", "sumo-600-22",
    "sumo-600-23", "sumo-varying-1", "sumo-varying-2", "sumo-varying-3", "sumo-varying-4", "sumo-varying-5",
    "sumo-varying-6", "sumo-varying-7", "sumo-varying-8", "sumo-varying-9", "sumo-varying-10",
    "sumo-varying-11", "sumo-varying-12", "sumo-varying-13", "sumo-varying-14", "sumo-varying-15",
    "sumo-varying-16", "sumo-varying-17", "sumo-varying-18", "sumo-varying-19", "sumo-varying-20",
    "sumo-varying-21", "sumo-varying-22", "sumo-varying-23",
];

/// The names, as users read them.
macro_rules! trace_names {
    () => {
        "sumo-400-1 to -23, sumo-600-4 to -23, sumo-varying-1 to -23"
    };
}
pub(super) use trace_names;

/// Text of an embedded trace.
pub(super) fn trace(name: &str) -> Option<&'static str> {
    TRACES.iter().find(|(n, _)| *n == name).map(|(_, text)| *text)
}
