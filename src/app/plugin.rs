//! `cz plugin check` and `cz plugin golden`.

use super::args::PluginCommand;
use super::{AppError, print};
use crate::process::plugin_check::{Report, Rule, check, scenario};
use std::sync::Arc;
use std::time::Duration;

pub(super) fn plugin(command: &PluginCommand) -> Result<(), AppError> {
    match command {
        PluginCommand::Check { deadline_ms, json, command } => run(*deadline_ms, *json, command),
        PluginCommand::Golden => print(&super::golden::text()),
    }
}

fn run(deadline_ms: f64, json: bool, command: &[String]) -> Result<(), AppError> {
    if !(deadline_ms > 0.0 && deadline_ms <= 1e6) {
        let expected = "a time > 0 and <= 1e6 ms";
        return Err(AppError::Usage(format!("--deadline-ms {deadline_ms}: expected {expected}")));
    }
    let scenario = Arc::new(scenario()?);
    let report = check(&scenario, command, Duration::from_secs_f64(deadline_ms * 1e-3))?;
    if json {
        print(&(serde_json::to_string_pretty(&report).expect("a report has string keys only") + "\n"))?;
    } else {
        print(&table(&report))?;
    }
    match report.breaches.len() {
        0 => Ok(()),
        n => Err(AppError::Failed(format!("the controller broke {n} of {} rules", Rule::ALL.len()))),
    }
}

fn table(report: &Report) -> String {
    let mut text = String::new();
    for rule in Rule::ALL {
        if let Some(breach) = report.breaches.iter().find(|b| b.rule == rule) {
            let again = if breach.count > 1 { format!(" ({} times)", breach.count) } else { String::new() };
            text.push_str(&format!(
                "FAIL  {}\n      step {}{again}: {}\n",
                rule.text(),
                breach.step,
                breach.what
            ));
        } else {
            let verdict = if report.untried.contains(&rule) { "-   " } else { "ok  " };
            text.push_str(&format!("{verdict}  {}\n", rule.text()));
        }
    }
    let [p50, p99, p999, max] = report.latency_us;
    text.push_str(&format!(
        "{} steps answered; answer time p50 {p50:.1} us, p99 {p99:.1}, p99.9 {p999:.1}, max {max:.1}\n",
        report.answered
    ));
    text
}
