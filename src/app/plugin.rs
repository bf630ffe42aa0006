//! `cz plugin check` and `cz plugin golden`.

use super::args::{PluginCommand, PluginReplayArgs};
use super::{AppError, print, record};
use crate::process::plugin_check::{Report, Rule, check, scenario};
use crate::process::{
    CommandDifference, PluginReplay, PluginReplayError, PluginReplayOptions, replay_plugin,
};
use std::sync::Arc;
use std::time::Duration;

pub(super) fn plugin(command: &PluginCommand) -> Result<(), AppError> {
    match command {
        PluginCommand::Check { deadline_ms, json, command } => run(*deadline_ms, *json, command),
        PluginCommand::New(args) => super::new::new(args),
        PluginCommand::Replay(args) => replay(args),
        PluginCommand::Golden => print(&super::golden::text()),
    }
}

/// `cz plugin replay`.
fn replay(args: &PluginReplayArgs) -> Result<(), AppError> {
    let bad = |name: &str, value: f64, expected: &str| {
        AppError::Usage(format!("{name} {value}: expected {expected}"))
    };
    if !(args.patience > 0.0 && args.patience <= 86_400.0) {
        return Err(bad("--patience", args.patience, "a number of seconds > 0 and <= 86400"));
    }
    if !(args.tolerance >= 0.0 && args.tolerance.is_finite()) {
        return Err(bad("--tolerance", args.tolerance, "an acceleration >= 0, m/s^2"));
    }
    let reader = record::open(&args.file)?;
    let known: Vec<_> = reader.scenario().plugins.iter().map(|plugin| plugin.name.clone()).collect();
    let target = match (&args.controller, &known[..]) {
        (Some(target), _) => target.clone(),
        (None, [only]) => only.clone(),
        (None, _) => {
            let zones = reader.scenario().network.zones.iter().map(|zone| zone.name.as_str());
            let all: Vec<_> = known.iter().map(String::as_str).chain(zones).collect();
            let problem = format!("--controller: expected one of {}, or several zones", all.join(", "));
            return Err(AppError::Usage(problem));
        }
    };
    let options = PluginReplayOptions {
        target,
        from: args.from,
        tolerance_mps2: args.tolerance,
        patience: (!args.debug).then(|| Duration::from_secs_f64(args.patience)),
        has_terminal: args.debug,
    };
    let came_to = replay_plugin(&reader, &options, &args.command).map_err(|error| match error {
        PluginReplayError::Target { .. } => AppError::Usage(format!("--controller {error}")),
        PluginReplayError::Missing(_) => AppError::Usage(format!("--from: {error}")),
        other => AppError::Failed(other.to_string()),
    })?;
    if args.json {
        print(&(serde_json::to_string_pretty(&came_to).expect("it has string keys only") + "\n"))?;
    } else {
        print(&replayed(&came_to, reader.metadata().dt_ns as f64 * 1e-9))?;
    }
    match came_to.differing {
        0 => Ok(()),
        n => Err(AppError::Failed(format!("{n} of {} commands differ", came_to.commands))),
    }
}

fn replayed(came_to: &PluginReplay, dt_s: f64) -> String {
    let PluginReplay { controller, steps, commands, .. } = came_to;
    let mut text = format!("{controller}: {steps} steps answered, {commands} commands compared");
    if came_to.put_in > 0 {
        text.push_str(&format!(", {} not, because the world had put them in", came_to.put_in));
    }
    text.push('\n');
    let told = |d: &CommandDifference| {
        format!(
            "step {} ({:.1} s), vehicle {} in {} at {:.3} m and {:.3} m/s: {:.6} m/s², recorded {:.6}\n",
            d.step,
            d.step as f64 * dt_s,
            d.vehicle,
            d.zone,
            d.x_m,
            d.v_mps,
            d.u_mps2,
            d.recorded_mps2
        )
    };
    came_to.differences.iter().for_each(|difference| text.push_str(&told(difference)));
    let listed = came_to.differences.len() as u64;
    if came_to.differing > listed {
        text.push_str(&format!("and {} more\n", came_to.differing - listed));
    }
    match &came_to.greatest {
        Some(greatest) => text.push_str(&format!("greatest: {}", told(greatest))),
        None => text.push_str("all commands are those recorded\n"),
    }
    if let Some(t) = &came_to.answer_time_us {
        text.push_str(&format!(
            "answer time p50 {:.1} µs, p99 {:.1}, p99.9 {:.1}, max {:.1}\n",
            t.p50, t.p99, t.p999, t.max
        ));
    }
    if let Some(step) = came_to.stopped_before {
        text.push_str(&format!("it ended before step {step}, which is not in the recording\n"));
    }
    text
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
