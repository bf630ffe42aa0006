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
    ($($path:literal),* $(,)?) => { [$(($path, include_str!(concat!("../../scenarios/", $path)))),*] };
}

/// Path as scenarios give it, and text.
const TRACES: [(&str, &str); 6] = traces![
    "data/arrivals_400_seed1.csv",
    "data/arrivals_400_seed2.csv",
    "data/arrivals_400_seed3.csv",
    "data/arrivals_varying_seed1.csv",
    "data/arrivals_varying_seed2.csv",
    "data/arrivals_varying_seed3.csv",
];

/// Text of an embedded trace.
pub(super) fn trace(path: &str) -> Option<&'static str> {
    TRACES.iter().find(|(p, _)| *p == path).map(|(_, text)| *text)
}

/// Name and path of the embedded traces; by name every scenario may use them, wherever its file is.
const NAMES: [(&str, &str); 6] = [
    ("sumo-400-1", "data/arrivals_400_seed1.csv"),
    ("sumo-400-2", "data/arrivals_400_seed2.csv"),
    ("sumo-400-3", "data/arrivals_400_seed3.csv"),
    ("sumo-varying-1", "data/arrivals_varying_seed1.csv"),
    ("sumo-varying-2", "data/arrivals_varying_seed2.csv"),
    ("sumo-varying-3", "data/arrivals_varying_seed3.csv"),
];

/// Text of an embedded trace, by its name.
pub(super) fn named_trace(name: &str) -> Option<&'static str> {
    NAMES.iter().find(|(n, _)| *n == name).and_then(|(_, path)| trace(path))
}

/// Names of all embedded traces.
pub(super) fn trace_names() -> impl Iterator<Item = &'static str> {
    NAMES.iter().map(|(name, _)| *name)
}
