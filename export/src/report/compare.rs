//! Results of several runs: means over seeds, and differences between settings.

use super::data::Run;
use control_zones::reproduce::statistics::Interval;
use control_zones::world::{WorldSummary, ZoneSummaryRow};

/// Runs that differ in nothing but their seed.
pub struct Group<'a> {
    /// What they are of.
    pub label: String,
    /// In order of seed.
    pub runs: Vec<&'a Run>,
}

/// A figure that runs are compared by.
pub struct Metric {
    /// Its name.
    pub name: &'static str,
    /// Its unit.
    pub unit: &'static str,
    pub decimals: usize,
    /// Of a zone.
    pub of: fn(&ZoneSummaryRow) -> Option<f64>,
}

/// Figures of a zone.
pub const METRICS: [Metric; 11] = [
    Metric { name: "vehicles", unit: "", decimals: 0, of: |z| Some(f64::from(z.vehicles)) },
    Metric { name: "wait", unit: "s", decimals: 3, of: |z| Some(z.mean_wait_s) },
    Metric { name: "time", unit: "s", decimals: 3, of: |z| Some(z.mean_time_s) },
    Metric { name: "energy", unit: "m²/s³", decimals: 3, of: |z| Some(z.mean_energy) },
    Metric { name: "objective", unit: "m²/s³", decimals: 3, of: |z| Some(z.mean_objective) },
    Metric { name: "exposure", unit: "m\u{a0}s", decimals: 3, of: |z| Some(z.mean_exposure_m_s) },
    Metric { name: "FE vehicles", unit: "", decimals: 0, of: |z| Some(f64::from(z.fe_vehicles)) },
    Metric { name: "infeasible", unit: "", decimals: 0, of: |z| Some(f64::from(z.infeasible_vehicles)) },
    Metric { name: "rear-end margin", unit: "m", decimals: 2, of: |z| z.min_rear_end_margin_m },
    Metric { name: "merge margin", unit: "m", decimals: 2, of: |z| z.min_merge_margin_m },
    Metric { name: "crossing margin", unit: "m", decimals: 2, of: |z| z.min_cross_margin_m },
];

/// The runs by what they are of, in the order in which they were named.
pub fn groups(runs: &[Run]) -> Vec<Group<'_>> {
    let mut groups: Vec<Group<'_>> = Vec::new();
    for run in runs {
        let metadata = run.reader.metadata();
        let seed = |set: &&String| !set.trim_start().starts_with("seed=");
        let changes: Vec<&str> = metadata.overrides.iter().filter(seed).map(String::as_str).collect();
        let label = [&[metadata.scenario_name.as_str()][..], &changes].concat().join(" ");
        match groups.iter_mut().find(|group| group.label == label) {
            Some(group) => group.runs.push(run),
            None => groups.push(Group { label, runs: vec![run] }),
        }
    }
    for group in &mut groups {
        group.runs.sort_by_key(|run| run.reader.metadata().seed);
    }
    groups
}

impl Group<'_> {
    /// A figure of a zone in each run that has it.
    fn values(&self, zone: &str, metric: &Metric) -> Vec<(u64, f64)> {
        self.collect(|summary| {
            let zone = summary.zones.iter().find(|row| row.zone == zone)?;
            (metric.of)(zone)
        })
    }

    fn collect(&self, of: impl Fn(&WorldSummary) -> Option<f64>) -> Vec<(u64, f64)> {
        let value = |run: &&Run| Some((run.reader.metadata().seed, of(run.ended.summary.as_ref()?)?));
        self.runs.iter().filter_map(value).collect()
    }

    /// The sum of the zones' objectives in each run, waits counted as time, as in the summary of a run.
    fn totals(&self) -> Vec<(u64, f64)> {
        let beta = self.runs[0].scenario.beta;
        let total = |zone: &ZoneSummaryRow| zone.mean_objective + beta * zone.mean_wait_s;
        self.collect(|summary| Some(summary.zones.iter().map(total).sum()))
    }

    /// A figure of a zone over all runs, in words.
    pub fn cell(&self, zone: &str, metric: &Metric) -> String {
        words(&self.values(zone, metric), metric.decimals)
    }

    /// The sum of the zones' objectives, in words.
    pub fn total(&self) -> String {
        words(&self.totals(), 3)
    }

    /// Names of zones.
    pub fn zones(&self) -> impl Iterator<Item = &str> {
        self.runs[0].scenario.network.zones.iter().map(|zone| zone.name.as_str())
    }

    /// How a figure of a zone changes toward another group.
    pub fn change(&self, other: &Group<'_>, zone: &str, metric: &Metric) -> String {
        difference(&self.values(zone, metric), &other.values(zone, metric), metric.decimals)
    }

    /// How the sum of the objectives does.
    pub fn total_change(&self, other: &Group<'_>) -> String {
        difference(&self.totals(), &other.totals(), 3)
    }
}

/// A value, or a mean with its 95 % interval.
fn words(values: &[(u64, f64)], decimals: usize) -> String {
    let numbers: Vec<f64> = values.iter().map(|(_, value)| *value).collect();
    match (numbers.as_slice(), Interval::of(&numbers)) {
        ([], _) => "–".to_owned(),
        ([one], _) => format!("{one:.decimals$}"),
        (_, Some(interval)) => {
            let decimals = decimals.max(1);
            format!("{:.decimals$} ± {:.decimals$}", interval.mean, interval.half_width())
        }
        _ => "–".to_owned(),
    }
}

/// The second less the first: paired by seed, with a 95 % interval where at least two seeds are in both.
fn difference(first: &[(u64, f64)], second: &[(u64, f64)], decimals: usize) -> String {
    let paired: Vec<f64> = first
        .iter()
        .filter_map(|(seed, value)| Some(second.iter().find(|(other, _)| other == seed)?.1 - value))
        .collect();
    match (Interval::of(&paired), paired.as_slice()) {
        (Some(interval), _) => {
            let sign = if interval.meets(0.0, 0.0) { "" } else { " *" };
            let decimals = decimals.max(1);
            format!("{:+.decimals$} ± {:.decimals$}{sign}", interval.mean, interval.half_width())
        }
        (None, [one]) => format!("{one:+.decimals$}"),
        _ => "–".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::{difference, words};

    #[test]
    fn several_seeds_give_intervals_and_differences_are_paired() {
        assert_eq!(words(&[], 2), "–");
        assert_eq!(words(&[(1, 3.0)], 2), "3.00");
        // Student's quantile with one degree of freedom is 12.706.
        assert_eq!(words(&[(1, 1.0), (2, 3.0)], 2), "2.00 ± 12.71");
        // Whatever seeds have in common cancels.
        let (first, second) = ([(1, 10.0), (2, 20.0), (3, 30.0)], [(2, 19.0), (3, 29.0), (1, 9.0)]);
        assert_eq!(difference(&first, &second, 2), "-1.00 ± 0.00 *");
        assert_eq!(difference(&[(1, 10.0)], &[(1, 8.0)], 1), "-2.0");
        assert_eq!(difference(&[(1, 10.0)], &[(2, 8.0)], 1), "–");
    }
}
