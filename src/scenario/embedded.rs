//! Scenarios and arrival traces that are part of the program, so that it runs from any directory.

/// Name and text, the default first.
pub(super) const SCENARIOS: [(&str, &str); 5] = [
    ("two-merges", include_str!("../../scenarios/two-merges.toml")),
    ("varying-demand", include_str!("../../scenarios/varying-demand.toml")),
    ("corridor-8", include_str!("../../scenarios/corridor-8.toml")),
    ("tree", include_str!("../../scenarios/tree.toml")),
    ("faulty-sensors", include_str!("../../scenarios/faulty-sensors.toml")),
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

/// Paths of all embedded traces.
pub(super) fn trace_names() -> impl Iterator<Item = &'static str> {
    TRACES.iter().map(|(path, _)| *path)
}
