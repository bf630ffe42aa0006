//! `cz bench wait`: how the ways of waiting are run, and the table.

use super::AppError;
use super::args::{
    ConductArgs, Restart, ScenarioArgs, ShareArgs, SteeringArgs, TimingArgs, WaitArgs, WaitBenchArgs,
};
use super::measured::{WAIT, align, run_as, scene, start_peer, table as new_table};
use crate::bench::{self, BenchError, NINE, Side, THREE, Timed, WaitingOptions, WaitingReport};
use crate::process::{Placement, WaitMode, check_cores};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

/// Runs of the first command.
const FIRST_RUNS: usize = 20;

/// A run as a user starts it: nobody is pinned.
fn conduct(wait_mode: WaitMode) -> ConductArgs {
    let wait = WaitArgs { pin: Placement::None, ..WAIT };
    ConductArgs {
        wait,
        wait_mode,
        restart: Restart::OnFailure,
        timing: TimingArgs::default(),
        record_lag: None,
        steering: SteeringArgs::default(),
    }
}

pub(super) fn measure(args: &WaitBenchArgs) -> Result<WaitingReport, AppError> {
    let quick = args.measure.quick;
    let mut sides: Vec<Side> =
        [WaitMode::Adaptive, WaitMode::Hybrid, WaitMode::Block].map(Side::Mode).to_vec();
    // Three processes; the scene of nine is for still larger machines.
    let can_spin = check_cores(3).is_ok();
    sides.push(if can_spin { Side::Mode(WaitMode::Spin) } else { Side::TwoSpin });
    sides.extend(args.beside.is_some().then_some(Side::Beside));
    let run = |name: &str, side: &Side| {
        let (scenario, share) = scene(name, quick);
        match side {
            Side::Mode(mode) => run_as(&scenario, share, conduct(*mode), None)
                .map(|o| Timed::from(&o))
                .map_err(BenchError::Run),
            Side::TwoSpin => {
                let loaded = Arc::new(scenario.load().map_err(|e| BenchError::Run(e.to_string()))?);
                bench::two_processes(&loaded, &|kind| start_peer(&scenario, kind))
            }
            Side::Beside => beside(args.beside.as_deref().unwrap_or(Path::new("cz")), &scenario, share),
        }
    };
    let run_first = || {
        let share = ShareArgs { ctrl_procs: 1, coord_procs: 1 };
        let outcome = run_as(&ScenarioArgs::none(), share, conduct(WaitMode::default()), None);
        outcome.map(|outcome| Timed::from(&outcome)).map_err(BenchError::Run)
    };
    let options = WaitingOptions {
        scenes: vec![THREE, NINE],
        sides,
        loads: if quick { vec![0, 2] } else { args.busy.clone() },
        repetitions: if quick { 1 } else { args.repetitions },
        first_runs: if quick { 2 } else { FIRST_RUNS },
        run: &run,
        start_busy: &|| start_peer(&ScenarioArgs::none(), &["busy".to_owned()]),
        run_first: &run_first,
    };
    Ok(bench::waiting(&options, |p| {
        eprintln!("{}, {} busy, {}: {:.3} s", p.scene, p.busy, p.side, p.median.wall_s);
    })?)
}

/// Runs another build's program as its user would.
fn beside(program: &Path, scenario: &ScenarioArgs, share: ShareArgs) -> Result<Timed, BenchError> {
    let shares =
        [format!("--ctrl-procs={}", share.ctrl_procs), format!("--coord-procs={}", share.coord_procs)];
    let output = Command::new(program)
        .args(["run", "--json", "-"])
        .args(shares)
        .args(scenario.to_arguments())
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output()
        .map_err(|source| BenchError::Io { what: "start the other build", source })?;
    let unexpected = || BenchError::Run(format!("{} printed no summary", program.display()));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).map_err(|_| unexpected())?;
    let number = |value: &serde_json::Value| value.as_f64().ok_or_else(unexpected);
    let hash = summary["state_hash"].as_str().and_then(|hash| u64::from_str_radix(hash, 16).ok());
    Ok(Timed {
        wall_s: number(&summary["wall_s"])?,
        p50_us: number(&summary["step_latency_us"]["p50"])?,
        p99_us: number(&summary["step_latency_us"]["p99"])?,
        steady_p50_us: None,
        event_p50_us: None,
        state_hash: hash.ok_or_else(unexpected)?,
    })
}

pub(super) fn table(r: &WaitingReport) -> String {
    let mut table = new_table(&[
        "",
        "busy",
        "wall [s]",
        "/ best",
        "p50 [µs]",
        "p99",
        "steady p50",
        "/ best",
        "event p50",
        "/ best",
    ]);
    let optional = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:.2}"));
    for p in &r.points {
        table.add_row([
            format!("{}: {}", p.scene, p.side),
            p.busy.to_string(),
            format!("{:.3}", p.median.wall_s),
            format!("{:.2}", p.wall_ratio),
            format!("{:.1}", p.median.p50_us),
            format!("{:.1}", p.median.p99_us),
            optional(p.median.steady_p50_us),
            optional(p.steady_ratio),
            optional(p.median.event_p50_us),
            optional(p.event_ratio),
        ]);
    }
    align(&mut table);
    let least = r.first_ratios.iter().copied().fold(f64::INFINITY, f64::min);
    let most = r.first_ratios.iter().copied().fold(0.0, f64::max);
    format!(
        "{}\n{table}\n\
         adaptive / best: quiet, steady and event steps, at most {:.2}; busy, wall time, at most {:.2}\n\
         `cz run`, {} times: p99 / p50 = {:.1} in the median, {least:.1} to {most:.1}\n",
        r.machine,
        r.worst_quiet_ratio,
        r.worst_busy_ratio,
        r.first_ratios.len(),
        r.first_ratio,
    )
}
