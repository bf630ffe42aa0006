//! `cz bench view`: how runs are looked at, and the table.

use super::AppError;
use super::args::{
    ConductArgs, Restart, ScenarioArgs, ShareArgs, SideBySide, SteeringArgs, TimingArgs, ViewBenchArgs,
};
use super::measured::{WAIT, align, run_as, scene, table as new_table};
use super::run::own_name;
use crate::bench::{self, BenchError, Family, NINE, THREE, Timed, ViewedOptions, ViewedReport};
use crate::process::WaitMode;

const MANY: &str = "10 000 vehicles";

fn scene_or_many(name: &str, quick: bool) -> (ScenarioArgs, ShareArgs) {
    if name == MANY {
        let side_by_side = Some(SideBySide { family: Family::Corridors, vehicles: 10_000 });
        let scenario = ScenarioArgs { side_by_side, ..ScenarioArgs::none() };
        return (scenario, ShareArgs { ctrl_procs: 1, coord_procs: 1 });
    }
    scene(name, quick)
}

pub(super) fn measure(args: &ViewBenchArgs) -> Result<ViewedReport, AppError> {
    let quick = args.measure.quick;
    let steering = SteeringArgs { steered: true, begin_paused: true };
    let timing = TimingArgs::default();
    let conduct = ConductArgs {
        wait: WAIT,
        wait_mode: WaitMode::default(),
        restart: Restart::OnFailure,
        timing,
        record_lag: None,
        steering,
    };
    let run = |name: &str, stays: bool| {
        let (scenario, share) = scene_or_many(name, quick);
        // A thread: whatever process a supervisor finds among its children at the end of a run, it ends.
        let looker = std::thread::spawn(move || bench::look(&own_name(), stays));
        let outcome = run_as(&scenario, share, conduct, None).map_err(BenchError::Run)?;
        let seen = looker.join().expect("whoever looks returns its errors")?;
        Ok((Timed::from(&outcome), seen))
    };
    let scenes = if quick { vec![THREE] } else { vec![THREE, NINE, MANY] };
    let options = ViewedOptions {
        scenes: scenes.into_iter().map(str::to_owned).collect(),
        repetitions: if quick { 1 } else { args.repetitions },
        run: &run,
    };
    Ok(bench::viewed(&options, |p| eprintln!("{}: {:.3}", p.scene, p.p50_ratio))?)
}

pub(super) fn table(r: &ViewedReport) -> String {
    let mut table = new_table(&[
        "p50 of a step [µs]",
        "nobody looks",
        "somebody",
        "ratio",
        "ratio of p99",
        "of wall time",
        "steps shown",
        "left out",
    ]);
    let median = |values: &[f64]| bench::median(&mut values.to_vec());
    for p in &r.points {
        table.add_row([
            p.scene.clone(),
            format!("{:.2}", median(&p.unseen_p50_us)),
            format!("{:.2}", median(&p.seen_p50_us)),
            format!("{:.3}", p.p50_ratio),
            format!("{:.3}", p.p99_ratio),
            format!("{:.3}", p.wall_ratio),
            p.seen.shown_steps.to_string(),
            p.seen.left_out_steps.to_string(),
        ]);
    }
    align(&mut table);
    format!("{}\n{table}\nsomebody / nobody, p50: at most {:.3}\n", r.machine, r.worst_p50_ratio)
}
