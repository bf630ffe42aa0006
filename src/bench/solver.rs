//! `cz bench solver`: the closed-form QP next to Clarabel, and the whole controller, on a real run.

use super::machine::Machine;
use super::{BenchError, io};
use crate::control::law::Program;
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
    /// Greatest difference of the two answers, m/s^2.
    pub greatest_difference_mps2: f64,
    /// The whole controller (partners, rows, reference, QP, verdict, command), ns per vehicle-step.
    pub controller_ns: f64,
    /// Vehicle-steps of the run.
    pub vehicle_steps: usize,
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

    let mut closed_form_ns = f64::INFINITY;
    for _ in 0..PASSES {
        let start = Instant::now();
        for (program, _) in &programs {
            black_box(qp::solve(black_box(&program.tracking), black_box(&program.interval)));
        }
        closed_form_ns = closed_form_ns.min(start.elapsed().as_nanos() as f64 / programs.len() as f64);
    }

    let stride = programs.len().div_ceil(CLARABEL_SAMPLE).max(1);
    let sample: Vec<_> = programs.iter().step_by(stride).collect();
    let start = Instant::now();
    let answers: Vec<Option<f64>> =
        sample.iter().map(|(program, rows)| clarabel::solve(&program.tracking, rows)).collect();
    let clarabel_ns = start.elapsed().as_nanos() as f64 / sample.len() as f64;
    let mut greatest_difference_mps2 = 0.0f64;
    for ((program, _), answer) in sample.iter().zip(answers) {
        match (qp::solve(&program.tracking, &program.interval), answer) {
            (Some(ours), Some(theirs)) => {
                greatest_difference_mps2 = greatest_difference_mps2.max((ours - theirs).abs());
            }
            (None, None) => {}
            (ours, theirs) => {
                return Err(BenchError::Disagreement(format!(
                    "closed form {ours:?}, Clarabel {theirs:?} on {program:?}"
                )));
            }
        }
    }

    // Whole controller: only `command` is timed; what an event brings is coordination's cost.
    let mut controller_ns = f64::INFINITY;
    let mut sink: Vec<VehicleCommand> = Vec::with_capacity(1024);
    for _ in 0..PASSES {
        let mut pool = pool();
        let mut spent = 0;
        for chunk in steps.chunk_by(|_, next| next.assignments.is_empty()) {
            pool.coordinate(&chunk[0].states, &chunk[0].assignments).map_err(broken)?;
            // One clock reading per stretch between events: reading it costs as much as a vehicle.
            let start = Instant::now();
            for step in chunk {
                sink.clear();
                pool.command(step.time_s, &step.states, |c| sink.push(c)).map_err(broken)?;
                black_box(&sink);
            }
            spent += start.elapsed().as_nanos();
        }
        controller_ns = controller_ns.min(spent as f64 / vehicle_steps as f64);
    }
    let infeasible = programs.iter().filter(|(p, _)| p.interval.is_empty()).count();
    Ok(SolverReport {
        machine,
        scenario: scenario.name.clone(),
        programs: programs.len(),
        infeasible,
        closed_form_ns,
        clarabel_ns,
        ratio: clarabel_ns / closed_form_ns,
        greatest_difference_mps2,
        controller_ns,
        vehicle_steps,
    })
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
        world.advance().map_err(|n| broken(&format!("{n} vehicles without a command")))?;
        steps.push(Step { time_s, states, assignments });
    }
    if steps.is_empty() {
        return Err(io("record a run")(std::io::Error::other("the scenario has no steps")));
    }
    Ok(steps)
}
