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
}

/// The traces that the design was made on.
const DEV: Seeds = Seeds { from: 1, to: 3 };
/// Random demands: no trace has these seeds.
const SEEDED: Seeds = Seeds { from: 4, to: 23 };

const PAPER: [&str; 4] = ["paper-best", "paper-none", "paper-fixed-17", "paper-feedback"];

const TABLES: [Table; 2] = [
    Table { name: "dev", scenarios: &["paper"], seeds: DEV, sets: &[], policies: &PAPER },
    Table { name: "seeded", scenarios: &["paper"], seeds: SEEDED, sets: &[], policies: &PAPER },
];

/// Names of all tables.
pub fn names() -> impl Iterator<Item = &'static str> {
    TABLES.iter().map(|table| table.name)
}

/// The comparisons of a table; none when there is no such table.
pub fn comparisons(name: &str, seeds: Option<Seeds>, joint: bool) -> Vec<Comparison> {
    let own = |list: &[&str]| -> Vec<String> { list.iter().map(|s| (*s).to_owned()).collect() };
    let of = |table: &Table| -> Vec<Comparison> {
        let scenarios = table.scenarios.iter().map(|scenario| Comparison {
            policies: own(table.policies),
            scenario: Some((*scenario).to_owned()),
            seeds: seeds.unwrap_or(table.seeds).all(),
            sets: own(table.sets),
            joint,
        });
        scenarios.collect()
    };
    TABLES.iter().filter(|table| table.name == name).flat_map(of).collect()
}
