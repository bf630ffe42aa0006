//! `cz world check`.

use super::args::WorldCheckArgs;
use super::{AppError, print};
use crate::process::{CHANGES, Tolerances, WorldCheckOptions, WorldReport, WorldRule, check_world};
use std::sync::Arc;
use std::time::Duration;

pub(super) fn check(args: &WorldCheckArgs) -> Result<(), AppError> {
    let within = |name: &str, value: f64, most: f64, expected: &str| match value > 0.0 && value <= most {
        true => Ok(()),
        false => Err(AppError::Usage(format!("{name} {value}: expected {expected}"))),
    };
    within("--tolerance", args.tolerance, 1e3, "an acceleration > 0, m/s^2")?;
    within("--way-tolerance", args.way_tolerance, 1e3, "a length > 0, m")?;
    within("--patience", args.patience, 3600.0, "a time > 0 and <= 3600 s")?;
    let known: Vec<String> = WorldRule::ALL.iter().map(|rule| rule.name()).collect();
    if let Some(unknown) = args.allow.iter().find(|rule| !known.contains(rule)) {
        return Err(AppError::Usage(format!("--allow {unknown}: expected one of {}", known.join(", "))));
    }
    // What is asked for comes last, and goes before the check's own.
    let mut given = args.scenario.clone();
    given.set = CHANGES.iter().map(|set| (*set).to_owned()).chain(given.set).collect();
    let scenario = Arc::new(given.load()?);
    if !scenario.plugins.is_empty() {
        let problem = "the scenario has controllers that are processes of their own, expected none: the check commands all";
        return Err(AppError::Usage(problem.to_owned()));
    }
    if scenario.faults.is_some() {
        let problem =
            "the scenario has faults on purpose, expected none: what is not as commanded is the world's";
        return Err(AppError::Usage(problem.to_owned()));
    }
    let options = WorldCheckOptions {
        scenario: given.to_arguments(),
        tolerances: Tolerances { acceleration_mps2: args.tolerance, way_m: args.way_tolerance },
        patience: Duration::from_secs_f64(args.patience),
    };
    let report = check_world(&scenario, &args.command, &options)?;
    if args.json {
        print(&(serde_json::to_string_pretty(&report).expect("a report has string keys only") + "\n"))?;
    } else {
        print(&table(&report, &args.allow))?;
    }
    match report.breaches.iter().filter(|breach| !args.allow.contains(&breach.rule.name())).count() {
        0 => Ok(()),
        n => Err(AppError::Failed(format!("the world broke {n} of {} rules", WorldRule::ALL.len()))),
    }
}

fn table(report: &WorldReport, allowed: &[String]) -> String {
    let mut text = String::new();
    for rule in WorldRule::ALL {
        let (name, asked) = (rule.name(), rule.text());
        if let Some(breach) = report.breaches.iter().find(|b| b.rule == rule) {
            let again = if breach.count > 1 { format!(" ({} times)", breach.count) } else { String::new() };
            let verdict = if allowed.contains(&name) { "told" } else { "FAIL" };
            text.push_str(&format!(
                "{verdict}  {name}: {asked}\n      step {}{again}: {}\n",
                breach.step, breach.what
            ));
        } else {
            let verdict = if report.untried.contains(&rule) { "-   " } else { "ok  " };
            text.push_str(&format!("{verdict}  {name}: {asked}\n"));
        }
    }
    text.push_str(&format!(
        "{} steps, {} vehicles in the first run; accelerations held within {:.1e} m/s^2, ways within {:.1e} m\n",
        report.steps, report.vehicles, report.greatest_disobedience_mps2, report.greatest_deviation_m
    ));
    text
}
