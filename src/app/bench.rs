//! `cz bench`: measurements.

use super::args::{
    BenchArgs, BenchKind, ConductArgs, PeerArgs, Restart, ScenarioArgs, ShareArgs, SideBySide, SteeringArgs,
    TimingArgs,
};
use super::measured::{WAIT, align, run_as, scenario_of, start_peer, table};
use super::{AppError, print};
use crate::bench::{
    self, BenchError, Family, LatencyOptions, LatencyReport, PeerKind, ScaleOptions, ScaleReport,
    SolverReport, Sumo,
};
use crate::process::{Outcome, Percentiles, StopFlag, WaitMode, run_in_process};
use std::path::Path;
use std::sync::Arc;

impl From<BenchError> for AppError {
    fn from(error: BenchError) -> AppError {
        match error {
            BenchError::NoSumo { .. } => AppError::Usage(error.to_string()),
            other => AppError::Failed(other.to_string()),
        }
    }
}

pub(super) fn bench(args: &BenchArgs) -> Result<(), AppError> {
    match &args.kind {
        BenchKind::Latency(args) => {
            let report = latency(args.quick)?;
            deliver(args.json.as_deref(), &report, &latency_table(&report))
        }
        BenchKind::Law(args) => {
            let report = super::bench_law::measure(args)?;
            deliver(args.json.as_deref(), &report, &super::bench_law::table(&report))
        }
        BenchKind::Solver(args) => {
            let scenario = Arc::new(scenario_of(args.quick).load()?);
            let report = bench::solver(&scenario)?;
            deliver(args.json.as_deref(), &report, &solver_table(&report))
        }
        BenchKind::Scale(args) => {
            let family = if args.grids { Family::Grids } else { Family::Corridors };
            let report = scale(family, args.measure.quick, args.with_sumo.then_some(args.sumo_up_to))?;
            deliver(args.measure.json.as_deref(), &report, &scale_table(&report))
        }
        BenchKind::Wait(args) => {
            let report = super::bench_wait::measure(args)?;
            deliver(args.measure.json.as_deref(), &report, &super::bench_wait::table(&report))
        }
        BenchKind::View(args) => {
            let report = super::bench_view::measure(args)?;
            deliver(args.measure.json.as_deref(), &report, &super::bench_view::table(&report))
        }
        BenchKind::Peer(args) => peer(args),
    }
}

fn deliver(json: Option<&Path>, report: &impl serde::Serialize, table: &str) -> Result<(), AppError> {
    let Some(path) = json else { return print(table) };
    let text = serde_json::to_string_pretty(report).expect("reports have string keys only") + "\n";
    if path == Path::new("-") {
        return print(&text);
    }
    std::fs::write(path, text)
        .map_err(|e| AppError::Failed(format!("cannot write {}: {e}", path.display())))?;
    print(table)
}

pub(super) fn run_processes(
    scenario: &ScenarioArgs,
    controllers: u32,
    record: Option<&Path>,
) -> Result<Outcome, String> {
    let share = ShareArgs { ctrl_procs: controllers, coord_procs: 1 };
    let restart = if record.is_some() { Restart::OnFailure } else { Restart::Never };
    let (wait_mode, timing) = (WaitMode::default(), TimingArgs::default());
    let conduct = ConductArgs {
        wait: WAIT,
        wait_mode,
        restart,
        timing,
        record_lag: None,
        steering: SteeringArgs::default(),
    };
    run_as(scenario, share, conduct, record)
}

fn latency(quick: bool) -> Result<LatencyReport, AppError> {
    let arguments = scenario_of(quick);
    let scenario = Arc::new(arguments.load()?);
    let start_peer = |kind: &[String]| start_peer(&arguments, kind);
    let options = LatencyOptions {
        scenario,
        round_trips: if quick { 20_000 } else { 200_000 },
        start_peer: &start_peer,
        run_processes: &|| run_processes(&arguments, 1, None),
        run_recorded: &|| {
            let path = std::env::temp_dir().join(format!("cz-bench-{}.czlog", std::process::id()));
            let outcome = run_processes(&arguments, 1, Some(&path));
            let _ = std::fs::remove_file(path);
            outcome
        },
    };
    Ok(bench::latency(&options)?)
}

fn peer(args: &PeerArgs) -> Result<(), AppError> {
    if args.kind == "busy" {
        bench::keep_busy();
        return Ok(());
    }
    let scenario = Arc::new(args.scenario.load()?);
    let bad = || AppError::Usage(format!("bench peer {} {:?}: not a peer", args.kind, args.values));
    let number = |i: usize| args.values.get(i).and_then(|v| v.parse::<u64>().ok()).ok_or_else(bad);
    let text = |i: usize| args.values.get(i).cloned().ok_or_else(bad);
    let kind = match args.kind.as_str() {
        "word" => PeerKind::Word { path: text(0)?, count: number(1)? },
        "iceoryx2" => PeerKind::Iceoryx2 { run: text(0)?.parse().map_err(|_| bad())?, count: number(1)? },
        "step" => PeerKind::Step { run: text(0)?.parse().map_err(|_| bad())? },
        "unix" => PeerKind::Unix { path: text(0)? },
        "tcp" => PeerKind::Tcp { port: u16::try_from(number(0)?).map_err(|_| bad())? },
        _ => return Err(bad()),
    };
    Ok(bench::run_peer(&kind, &scenario)?)
}

/// Vehicles from which on SUMO's clock is fine enough.
const SUMO_FROM: usize = 1_000;

fn scale(family: Family, quick: bool, sumo_up_to: Option<usize>) -> Result<ScaleReport, AppError> {
    // First, so that a missing package is said before minutes have passed.
    let sumo = match sumo_up_to {
        Some(most) => Some((Sumo::find()?, SUMO_FROM..=most)),
        None => None,
    };
    let sizes = if quick { vec![100, 1_000] } else { vec![100, 1_000, 10_000, 100_000] };
    let run = |size: usize, controllers: u32| {
        let side_by_side = Some(SideBySide { family, vehicles: size });
        let arguments = ScenarioArgs { scenario: None, seed: None, set: vec![], side_by_side };
        if controllers == 0 {
            let scenario = Arc::new(arguments.load().map_err(|e| e.to_string())?);
            return run_in_process(&scenario, 1, 1, &StopFlag::none(), |_| {}).map_err(|e| e.to_string());
        }
        run_processes(&arguments, controllers, None)
    };
    Ok(bench::scale(&ScaleOptions { sizes, run: &run, sumo }, |point| {
        eprintln!("{} vehicles, {} controllers: {} ns", point.vehicles, point.controllers, point.step_ns);
    })?)
}

fn latency_table(r: &LatencyReport) -> String {
    let mut table = table(&["ns", "p50", "p90", "p99", "p99.9", "max", "count", "p50 / floor", "p50 / ours"]);
    let floor = r.floor_round_trip.p50.max(1) as f64;
    let ours = r.steady_step.p50.max(1) as f64;
    let mut row = |name: &str, p: &Percentiles| {
        let p50 = p.p50 as f64;
        table.add_row([
            name.to_owned(),
            p.p50.to_string(),
            p.p90.to_string(),
            p.p99.to_string(),
            p.p999.to_string(),
            p.max.to_string(),
            p.count.to_string(),
            format!("{:.1}", p50 / floor),
            format!("{:.2}", p50 / ours),
        ]);
    };
    row("shared word, round trip (the floor)", &r.floor_round_trip);
    row("iceoryx2, round trip", &r.iceoryx2_round_trip);
    row("step in one process", &r.in_process_step);
    row("event step in one process", &r.in_process_event_step);
    row("step, three processes (ours)", &r.steady_step);
    row("event step, three processes", &r.event_step);
    row("step, three processes, recorded", &r.recorded_step);
    row("step, two processes", &r.two_process_step);
    row("event step, two processes", &r.two_process_event_step);
    row("step over a unix socket", &r.unix_socket_step);
    row("step over TCP", &r.tcp_step);
    align(&mut table);
    format!(
        "{}\n{}, {:.1} records per frame\n{table}\n\
         our step / (step in one process + iceoryx2 round trip) = {:.2}; p99 / p50 = {:.1}\n\
         unix socket / ours = {:.1}; TCP / ours = {:.1}; recorded / ours = {:.2}\n",
        r.machine,
        r.scenario,
        r.mean_records,
        r.ratio_to_parts,
        r.ratio_tail,
        r.ratio_unix,
        r.ratio_tcp,
        r.ratio_recorded
    )
}

fn solver_table(r: &SolverReport) -> String {
    let counts = r.instructions.as_ref();
    let mut table = table(&["", "ns", "instructions", "times the closed form", "difference [m/s²]"]);
    let mut row = |name: &str, ns: f64, count: Option<f64>, ratio: Option<f64>, difference: Option<f64>| {
        let or_none = |text: Option<String>| text.unwrap_or_default();
        table.add_row([
            name.to_owned(),
            format!("{ns:.1}"),
            count.map_or_else(|| "not available".to_owned(), |n| format!("{n:.0}")),
            or_none(ratio.map(|x| format!("{x:.0}"))),
            or_none(difference.map(|x| format!("{x:.1e}"))),
        ]);
    };
    row("closed form, per QP", r.closed_form_ns, counts.map(|c| c.closed_form), None, None);
    row(
        "Clarabel, fresh, per QP",
        r.clarabel_ns,
        counts.map(|c| c.clarabel),
        Some(r.ratio),
        Some(r.greatest_difference_fresh_mps2),
    );
    row(
        "Clarabel, updated, per QP",
        r.clarabel_updated_ns,
        counts.map(|c| c.clarabel_updated),
        Some(r.ratio_updated),
        Some(r.greatest_difference_updated_mps2),
    );
    row("whole controller, per vehicle-step", r.controller_ns, counts.map(|c| c.controller), None, None);
    align(&mut table);
    format!(
        "{}\n{}: {} QPs ({} infeasible), {} vehicle-steps; the updated solver has {} rows\n{table}\n",
        r.machine, r.scenario, r.programs, r.infeasible, r.vehicle_steps, r.updated_rows
    )
}

fn scale_table(r: &ScaleReport) -> String {
    let mut table =
        table(&["controllers", "vehicles", "zones", "step [µs]", "ns per vehicle-step", "world [MiB]"]);
    for p in &r.points {
        table.add_row([
            if p.controllers == 0 { "in process".to_owned() } else { p.controllers.to_string() },
            p.vehicles.to_string(),
            p.zones.to_string(),
            format!("{:.1}", p.step_ns as f64 / 1e3),
            format!("{:.1}", p.ns_per_vehicle_step),
            format!("{:.1}", p.world_bytes as f64 / f64::from(1 << 20)),
        ]);
    }
    align(&mut table);
    let mut text = format!("{}\n{table}\n", r.machine);
    for (controllers, exponent) in &r.growth_exponents {
        text.push_str(&format!("growth exponent, {controllers} controller processes: {exponent:.3}\n"));
    }
    if let Some(version) = &r.sumo_version {
        text.push_str(&sumo_table(r, version));
    }
    text
}

fn sumo_table(r: &ScaleReport, version: &str) -> String {
    let mut table = table(&["vehicles", "SUMO, ns per vehicle-step", "ours", "SUMO / ours"]);
    for p in &r.sumo {
        table.add_row([
            format!("{:.0} / {}", p.vehicles, p.our_vehicles),
            format!("{:.1}", p.ns_per_vehicle_step),
            format!("{:.1}", p.our_ns_per_vehicle_step),
            format!("{:.2}", p.ratio),
        ]);
    }
    align(&mut table);
    format!("SUMO {version} with human drivers, beside ours in one process; one thread each\n{table}\n")
}
