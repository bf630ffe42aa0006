//! The comparisons of docs/control.md.

use super::Comparison;
use super::cli::Seeds;

/// A comparison by name: one for each of its scenarios.
struct Table {
    name: &'static str,
    scenarios: &'static [&'static str],
    seeds: Seeds,
    sets: &'static [&'static str],
    policies: &'static [&'static str],
    /// For whose order the centralised optimum is sought.
    joint: Option<&'static str>,
}

/// The traces that the design was made on.
const DEV: Seeds = Seeds { from: 1, to: 3 };
/// Random demands, and traces that nothing was tuned on.
const SEEDED: Seeds = Seeds { from: 4, to: 23 };

const ALL: [&str; 8] = [
    "paper-best",
    "paper-none",
    "paper-fixed-17",
    "paper-feedback",
    "viable",
    "viable-resequenced",
    "viable-gate",
    "viable-resequenced-gate",
];

const DENSE: &str = "roads.*.demand={ rates = [{ until_s = 7200.0, vehicles_per_hour = 600.0 }], min_headway_s = 1.2, \
                     speed_mean_mps = 16.0, speed_sd_mps = 1.2, speed_min_mps = 10.0, speed_max_mps = 22.0 }";

const TABLES: [Table; 10] = [
    Table {
        name: "dev",
        scenarios: &["paper"],
        seeds: DEV,
        sets: &[],
        policies: &ALL,
        joint: Some("viable"),
    },
    Table {
        name: "seeded",
        scenarios: &["paper"],
        seeds: SEEDED,
        sets: &[],
        policies: &ALL,
        joint: Some("viable"),
    },
    Table {
        name: "unseen",
        scenarios: &["paper"],
        seeds: SEEDED,
        sets: &["roads.*.demand.trace=sumo-400-{seed}"],
        policies: &ALL,
        joint: None,
    },
    Table {
        name: "unseen-dense",
        scenarios: &["paper"],
        seeds: SEEDED,
        sets: &["roads.*.demand.trace=sumo-600-{seed}"],
        policies: &ALL,
        joint: None,
    },
    Table {
        name: "unseen-varying",
        scenarios: &["varying-demand"],
        seeds: SEEDED,
        sets: &["roads.*.demand.trace=sumo-varying-{seed}"],
        policies: &ALL,
        joint: None,
    },
    Table {
        name: "varying",
        scenarios: &["varying-demand"],
        seeds: SEEDED,
        sets: &[],
        policies: &ALL,
        joint: None,
    },
    Table {
        name: "dense",
        scenarios: &["paper"],
        seeds: SEEDED,
        sets: &[DENSE],
        policies: &ALL,
        joint: None,
    },
    Table {
        name: "networks",
        scenarios: &["intersection", "roundabout", "grid-3x3", "corridor-8", "tree", "lane-drop"],
        seeds: Seeds { from: 1, to: 5 },
        sets: &[],
        policies: &["paper-none", "viable", "viable-resequenced"],
        joint: None,
    },
    Table {
        name: "prediction",
        scenarios: &["paper", "varying-demand"],
        seeds: SEEDED,
        sets: &[],
        policies: &[
            "paper-none",
            "paper-predicted",
            "paper-feedback",
            "paper-mean-speed",
            "paper-fixed-17",
            "viable",
        ],
        joint: None,
    },
    Table {
        name: "parts",
        scenarios: &["paper"],
        seeds: Seeds { from: 1, to: 23 },
        sets: &[],
        policies: &[
            "viable",
            "viable-resequenced",
            "viable-gate",
            "viable:coordination.schedule=pooled",
            "viable:coordination.schedule=none",
            "viable:coordination.price_of_time=0",
            "viable:control.viable.slots=false",
            "viable:control.viable.slots=false;coordination.schedule=none",
            "viable:control.viable.comfort=false",
            "viable:control.viable.bodies=false",
            "viable:control.viable.viability=false",
        ],
        joint: None,
    },
];

/// Names of all tables.
pub fn names() -> impl Iterator<Item = &'static str> {
    TABLES.iter().map(|table| table.name)
}

/// The comparisons of a table; none when there is no such table.
pub fn comparisons(name: &str, seeds: Option<Seeds>) -> Vec<Comparison> {
    let own = |list: &[&str]| -> Vec<String> { list.iter().map(|s| (*s).to_owned()).collect() };
    let of = |table: &Table| -> Vec<Comparison> {
        let scenarios = table.scenarios.iter().map(|scenario| Comparison {
            policies: own(table.policies),
            scenario: Some((*scenario).to_owned()),
            seeds: seeds.unwrap_or(table.seeds).all(),
            sets: own(table.sets),
            joint: table.joint.map(str::to_owned),
        });
        scenarios.collect()
    };
    TABLES.iter().filter(|table| table.name == name).flat_map(of).collect()
}
