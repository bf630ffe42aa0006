//! `cz bench law`: what a step takes under the law `viable` with schedules, beside the paper's law.

use super::AppError;
use super::args::{MeasureArgs, ScenarioArgs};
use super::bench::run_processes;
use super::measured::{align, scenario_of, table as new_table};
use crate::bench::{self, BenchError, Machine};
use crate::process::{Outcome, StopFlag, run_in_process};
use serde::Serialize;
use std::sync::Arc;

/// The paper's setting is driven by `ocbf`; this makes it the law whose steps are compared.
const VIABLE: [&str; 4] = [
    "control.law=viable",
    "coordination.schedule=tandem",
    "coordination.order=resequenced",
    "zones.*.flow={policy=\"none\"}",
];

/// Runs of each law, by turns.
const REPETITIONS: usize = 7;

/// Medians of the steps' medians, ns.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Steps {
    /// Steps without coordination.
    steady_ns: f64,
    /// Steps in which the coordinator acts.
    event_ns: f64,
}

impl Steps {
    fn median(outcomes: &[Outcome]) -> Steps {
        let median = |of: fn(&Outcome) -> u64| {
            let mut values: Vec<f64> = outcomes.iter().map(|o| of(o) as f64).collect();
            bench::median(&mut values)
        };
        Steps { steady_ns: median(|o| o.steady_ns.p50), event_ns: median(|o| o.event_ns.p50) }
    }

    fn over(self, other: Steps) -> Steps {
        Steps {
            steady_ns: self.steady_ns / other.steady_ns.max(1.0),
            event_ns: self.event_ns / other.event_ns.max(1.0),
        }
    }
}

/// Both laws in one way of running.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Pair {
    ocbf: Steps,
    viable: Steps,
    /// `viable` by `ocbf`.
    ratio: Steps,
}

/// The results; the JSON keys are a contract.
#[derive(Debug, Serialize)]
pub(super) struct LawReport {
    machine: Machine,
    scenario: String,
    in_process: Pair,
    three_processes: Pair,
}

pub(super) fn measure(args: &MeasureArgs) -> Result<LawReport, AppError> {
    let ocbf = scenario_of(args.quick);
    let mut viable = ocbf.clone();
    viable.set.extend(VIABLE.map(str::to_owned));
    let repetitions = if args.quick { 1 } else { REPETITIONS };
    let in_one = |scenario: &ScenarioArgs| {
        let loaded = Arc::new(scenario.load().map_err(|error| error.to_string())?);
        run_in_process(&loaded, 1, 1, &StopFlag::none(), |_| {}).map_err(|error| error.to_string())
    };
    let pair = |run: &dyn Fn(&ScenarioArgs) -> Result<Outcome, String>| -> Result<Pair, AppError> {
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        for _ in 0..repetitions {
            for (scenario, outcomes) in [(&ocbf, &mut theirs), (&viable, &mut ours)] {
                outcomes.push(run(scenario).map_err(BenchError::Run)?);
            }
        }
        let (ocbf, viable) = (Steps::median(&theirs), Steps::median(&ours));
        Ok(Pair { ocbf, viable, ratio: viable.over(ocbf) })
    };
    Ok(LawReport {
        machine: Machine::here(),
        scenario: ocbf.load()?.name,
        in_process: pair(&in_one)?,
        three_processes: pair(&|scenario| run_processes(scenario, 1, None))?,
    })
}

pub(super) fn table(report: &LawReport) -> String {
    let mut table = new_table(&["p50, ns", "ocbf", "viable, scheduled", "ratio"]);
    let mut row = |name: &str, pair: &Pair, of: fn(&Steps) -> f64| {
        table.add_row([
            name.to_owned(),
            format!("{:.0}", of(&pair.ocbf)),
            format!("{:.0}", of(&pair.viable)),
            format!("{:.2}", of(&pair.ratio)),
        ]);
    };
    row("steady step, one process", &report.in_process, |s| s.steady_ns);
    row("event step, one process", &report.in_process, |s| s.event_ns);
    row("steady step, three processes", &report.three_processes, |s| s.steady_ns);
    row("event step, three processes", &report.three_processes, |s| s.event_ns);
    align(&mut table);
    format!("{}\n{}\n{table}\n", report.machine, report.scenario)
}
