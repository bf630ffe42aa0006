//! `cz bench solver`: the closed-form QP next to Clarabel, and the whole controller, on a real run.

use super::instructions::Instructions;
use super::machine::Machine;
use super::{BenchError, io};
use crate::control::ocbf::Program;
use crate::control::rows::Row;
use crate::control::{ControllerPool, clarabel, qp};
use crate::coordination::Coordinator;
use crate::scenario::Scenario;
use crate::vehicle::Inequality;
use crate::world::World;
use ipc_schemas::{Assignment, VehicleCommand, VehicleState};
use serde::Serialize;
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

/// The results.
#[derive(Clone, Debug, Serialize)]
pub struct SolverReport {
    /// Where it was measured.
    pub machine: Machine,
    /// Scenario name.
    pub scenario: String,
    /// QPs of the run.
    pub programs: usize,
    /// Of them, QPs whose rows contradict each other.
    pub infeasible: usize,
    /// Closed form, ns per QP (best of several passes).
    pub closed_form_ns: f64,
    /// Clarabel, set up afresh for each QP, ns per QP.
    pub clarabel_ns: f64,
    /// `clarabel_ns / closed_form_ns`.
    pub ratio: f64,
    /// Clarabel, set up once and given new numbers for each QP, ns per QP. Programs of fewer rows than the
    /// longest are filled up with rows that are always satisfied.
    pub clarabel_updated_ns: f64,
    /// `clarabel_updated_ns / closed_form_ns`.
    pub ratio_updated: f64,
    /// Rows of the solver that is updated.
    pub updated_rows: usize,
    /// Greatest difference of an answer of Clarabel, either way, to the closed form, m/s^2.
    pub greatest_difference_mps2: f64,
    /// The same of the fresh solver alone, m/s^2.
    pub greatest_difference_fresh_mps2: f64,
    /// The same of the updated solver alone, m/s^2.
    pub greatest_difference_updated_mps2: f64,
    /// The whole controller (partners, rows, reference, QP, verdict, command), ns per vehicle-step.
    pub controller_ns: f64,
    /// Vehicle-steps of the run.
    pub vehicle_steps: usize,
    /// Instructions, where they can be counted.
    pub instructions: Option<InstructionCounts>,
}

/// Instructions retired in user space, counted by the processor in a pass of their own.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct InstructionCounts {
    /// Closed form, per QP.
    pub closed_form: f64,
    /// Clarabel set up afresh, per QP.
    pub clarabel: f64,
    /// Clarabel given new numbers, per QP.
    pub clarabel_updated: f64,
    /// The whole controller, per vehicle-step.
    pub controller: f64,
}

/// One step of the run as a controller sees it.
struct Step {
    time_s: f64,
    states: Vec<VehicleState>,
    assignments: Vec<Assignment>,
}

/// QPs handed to Clarabel at most; it takes tens of microseconds for each.
const CLARABEL_SAMPLE: usize = 20_000;
/// Passes over the whole run; the fastest counts, as interruptions only ever add.
const PASSES: usize = 20;
/// Passes over Clarabel's sample.
const CLARABEL_PASSES: usize = 3;

/// Measures on the programs and frames of one run.
pub fn solver(scenario: &Arc<Scenario>) -> Result<SolverReport, BenchError> {
    let machine = Machine::here();
    let steps = record(scenario)?;
    let zones = 0..scenario.network.zones.len() as u32;
    let pool = || ControllerPool::new(scenario.clone(), zones.clone());
    let broken = |e: crate::control::pool::PoolError| BenchError::Disagreement(e.to_string());

    let mut programs: Vec<(Program, Vec<(Inequality, Row)>)> = Vec::new();
    let mut observer = pool();
    let mut vehicle_steps = 0;
    for step in &steps {
        observer.coordinate(&step.states, &step.assignments).map_err(broken)?;
        observer
            .inspect(step.time_s, &step.states, |program, rows| programs.push((*program, rows)))
            .map_err(broken)?;
        observer.command(step.time_s, &step.states, |_| vehicle_steps += 1).map_err(broken)?;
    }

    let closed_form = || {
        for (program, _) in &programs {
            black_box(qp::solve(black_box(&program.tracking), black_box(&program.interval)));
        }
    };
    let mut closed_form_ns = f64::INFINITY;
    for _ in 0..PASSES {
        let start = Instant::now();
        closed_form();
        closed_form_ns = closed_form_ns.min(start.elapsed().as_nanos() as f64 / programs.len() as f64);
    }

    let stride = programs.len().div_ceil(CLARABEL_SAMPLE).max(1);
    let sample: Vec<_> = programs.iter().step_by(stride).collect();
    let longest = sample.iter().map(|(_, rows)| rows.len()).max().unwrap_or(0);
    let mut reused = clarabel::Reused::new(longest);
    let mut fresh = || sample.iter().map(|(p, rows)| clarabel::solve(&p.tracking, rows)).collect::<Vec<_>>();
    let mut updated = || sample.iter().map(|(p, rows)| reused.solve(&p.tracking, rows)).collect::<Vec<_>>();
    let mut clarabel_ns = f64::INFINITY;
    let mut clarabel_updated_ns = f64::INFINITY;
    let mut differences = [0.0f64; 2];
    // In turn, so that a slow spell of the machine meets both.
    for _ in 0..CLARABEL_PASSES {
        let timed = |solve: &mut dyn FnMut() -> Vec<Option<f64>>, best: &mut f64| {
            let start = Instant::now();
            let answers = solve();
            *best = best.min(start.elapsed().as_nanos() as f64 / sample.len() as f64);
            greatest_difference(&sample, &answers)
        };
        let fresh = timed(&mut fresh, &mut clarabel_ns)?;
        let updated = timed(&mut updated, &mut clarabel_updated_ns)?;
        differences = [differences[0].max(fresh), differences[1].max(updated)];
    }

    let mut controller_ns = f64::INFINITY;
    for _ in 0..PASSES {
        let mut spent = 0;
        control(&steps, pool(), |commands| {
            // One clock reading per stretch between events: reading it costs as much as a vehicle.
            let start = Instant::now();
            commands()?;
            spent += start.elapsed().as_nanos();
            Ok(())
        })?;
        controller_ns = controller_ns.min(spent as f64 / vehicle_steps as f64);
    }

    let instructions = Instructions::counter().and_then(|mut counter| {
        let per = |count: u64, what: usize| count as f64 / what as f64;
        let mut in_control = 0;
        let closed_form = per(counter.count(closed_form)?, programs.len());
        let clarabel = per(counter.count(|| drop(black_box(fresh())))?, sample.len());
        let clarabel_updated = per(counter.count(|| drop(black_box(updated())))?, sample.len());
        control(&steps, pool(), |commands| {
            let mut outcome = Ok(());
            in_control += counter.count(|| outcome = commands()).unwrap_or(0);
            outcome
        })
        .ok()?;
        Some(InstructionCounts {
            closed_form,
            clarabel,
            clarabel_updated,
            controller: per(in_control, vehicle_steps),
        })
    });
    let infeasible = programs.iter().filter(|(p, _)| p.interval.is_empty()).count();
    Ok(SolverReport {
        machine,
        scenario: scenario.name.clone(),
        programs: programs.len(),
        infeasible,
        closed_form_ns,
        clarabel_ns,
        ratio: clarabel_ns / closed_form_ns,
        clarabel_updated_ns,
        ratio_updated: clarabel_updated_ns / closed_form_ns,
        updated_rows: longest + 1,
        greatest_difference_mps2: differences[0].max(differences[1]),
        greatest_difference_fresh_mps2: differences[0],
        greatest_difference_updated_mps2: differences[1],
        controller_ns,
        vehicle_steps,
        instructions,
    })
}

/// The greatest difference of these answers to the closed form's, m/s^2.
fn greatest_difference(
    sample: &[&(Program, Vec<(Inequality, Row)>)],
    answers: &[Option<f64>],
) -> Result<f64, BenchError> {
    let mut greatest = 0.0f64;
    for ((program, _), answer) in sample.iter().zip(answers) {
        match (qp::solve(&program.tracking, &program.interval), *answer) {
            (Some(ours), Some(theirs)) => greatest = greatest.max((ours - theirs).abs()),
            (None, None) => {}
            (ours, theirs) => {
                return Err(BenchError::Disagreement(format!(
                    "closed form {ours:?}, Clarabel {theirs:?} on {program:?}"
                )));
            }
        }
    }
    Ok(greatest)
}

/// Lets a pool answer all steps. `measure` is handed one stretch between events after the other: only the
/// commands are to be measured; what an event brings is coordination's cost.
fn control(
    steps: &[Step],
    mut pool: ControllerPool,
    mut measure: impl FnMut(&mut dyn FnMut() -> Result<(), BenchError>) -> Result<(), BenchError>,
) -> Result<(), BenchError> {
    let broken = |e: crate::control::pool::PoolError| BenchError::Disagreement(e.to_string());
    let mut sink: Vec<VehicleCommand> = Vec::with_capacity(1024);
    for chunk in steps.chunk_by(|_, next| next.assignments.is_empty()) {
        pool.coordinate(&chunk[0].states, &chunk[0].assignments).map_err(broken)?;
        measure(&mut || {
            for step in chunk {
                sink.clear();
                pool.command(step.time_s, &step.states, |c| sink.push(c)).map_err(broken)?;
                black_box(&sink);
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// Runs the scenario once and keeps what the controller saw.
fn record(scenario: &Arc<Scenario>) -> Result<Vec<Step>, BenchError> {
    let zones = 0..scenario.network.zones.len() as u32;
    let mut world = World::new(scenario.clone(), 1);
    let mut coordinator = Coordinator::new(scenario.clone(), zones.clone());
    let mut pool = ControllerPool::new(scenario.clone(), zones);
    let mut steps = Vec::new();
    let broken = |what: &str| BenchError::Disagreement(what.to_owned());
    while !world.is_finished() {
        let states: Vec<VehicleState> = world.records().collect();
        let masks = world.coordinator_masks();
        let mut assignments = Vec::new();
        if masks.acting != 0 {
            let seen: Vec<VehicleState> = world.coordinator_records(0).collect();
            coordinator.act(world.step(), &seen);
            assignments.extend_from_slice(coordinator.assignments());
        }
        let time_s = scenario.time_s(world.step());
        let mut commands = Vec::new();
        pool.coordinate(&states, &assignments).map_err(|e| broken(&e.to_string()))?;
        pool.command(time_s, &states, |c| commands.push(c)).map_err(|e| broken(&e.to_string()))?;
        world.command(0, &commands).map_err(|e| broken(&e.to_string()))?;
        world.advance().map_err(|error| broken(&error.to_string()))?;
        steps.push(Step { time_s, states, assignments });
    }
    if steps.is_empty() {
        return Err(io("record a run")(std::io::Error::other("the scenario has no steps")));
    }
    Ok(steps)
}
