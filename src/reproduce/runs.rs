//! Which runs are needed, and their execution on all cores.
//!
//! A run is named by its scenario, seed and `--set`s, exactly as `cz run` takes them, so that anyone can
//! repeat one by hand. Every run is done once however many tables use it. Results are kept by name and
//! read in a fixed order: neither the number of threads nor their timing can show in a report.

use super::ReproduceError;
use super::parallel;
use crate::lockstep::LockstepError;
use crate::lockstep::in_process::InProcess;
use crate::scenario::{self, Override, Scenario};
use crate::world::{CompletedVisit, World, ZoneSummaryRow};
use ipc_schemas::STATE_LEFT;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A run, by name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Run {
    /// Embedded scenario.
    pub scenario: &'static str,
    /// Seed.
    pub seed: u64,
    /// `--set`s in order.
    pub sets: Vec<String>,
}

impl Run {
    /// The command that repeats it.
    pub fn command(&self) -> String {
        let sets: String = self.sets.iter().map(|s| format!(" --set '{s}'")).collect();
        format!("cz run {} --in-process --seed {}{sets}", self.scenario, self.seed)
    }

    fn execute(&self) -> Result<Outcome, ReproduceError> {
        let overrides: Vec<Override> = self.sets.iter().map(|s| s.parse()).collect::<Result<_, _>>()?;
        let scenario = Arc::new(scenario::load_embedded(self.scenario, &overrides, Some(self.seed))?);
        let mut run = InProcess::new(&scenario, 1, 1);
        run.record_visits();
        let failed =
            |error: LockstepError| ReproduceError::Run { command: self.command(), error: error.to_string() };
        let complete = drive(&mut run, &scenario, |_| {}).map_err(failed)?;
        let world = run.world();
        let mut zones = world.summary().zones;
        if !complete {
            // Means over those that got through would flatter a jam.
            for zone in &mut zones {
                (zone.mean_time_s, zone.mean_energy) = (f64::NAN, f64::NAN);
                (zone.mean_objective, zone.fe_mean_s) = (f64::NAN, f64::NAN);
            }
        }
        let visits = world.visits();
        let exit_speeds_mps = (0..zones.len() as u32)
            .map(|zone| {
                let (mut sum, mut count) = (0.0, 0u32);
                for visit in visits.iter().filter(|v| v.zone == zone) {
                    sum += visit.exit_speed_mps;
                    count += 1;
                }
                sum / f64::from(count.max(1))
            })
            .collect();
        // Only the figure over time looks at single vehicles.
        let visits = if self.scenario == VARYING_SCENARIO { visits.to_vec() } else { Vec::new() };
        Ok(Outcome { beta: scenario.beta, complete, zones, exit_speeds_mps, visits })
    }
}

/// Runs to the end, or until a zone is jammed, and shows the world after each step; whether every vehicle got
/// through.
pub fn drive(
    run: &mut InProcess,
    scenario: &Scenario,
    mut see: impl FnMut(&World),
) -> Result<bool, LockstepError> {
    let window = ((JAM_S / scenario.dt_s()).ceil() as u64).max(1);
    let zones = scenario.network.zones.len();
    // Per zone: whether it had vehicles, and how many had left it, when the window began.
    let mut before = vec![(false, 0); zones];
    while run.step()? {
        let world = run.world();
        see(world);
        if !world.step().is_multiple_of(window) {
            continue;
        }
        let mut now: Vec<(bool, u32)> = world.summary().zones.iter().map(|z| (false, z.vehicles)).collect();
        for record in world.records().filter(|r| r.flags & STATE_LEFT == 0) {
            if let Some((occupied, _)) = now.get_mut(record.zone as usize) {
                *occupied = true;
            }
        }
        if before.iter().zip(&now).any(|(before, now)| before.0 && before.1 == now.1) {
            return Ok(false);
        }
        before = now;
    }
    let summary = run.world().summary();
    Ok(summary.arrived == summary.departed && summary.waiting == 0)
}

/// A zone that nobody leaves for this long, s of simulated time, while a vehicle waits in it is jammed: a
/// passage takes some 10 to 20 s.
const JAM_S: f64 = 120.0;

/// Scenario of the experiments under constant traffic.
pub const CONSTANT_SCENARIO: &str = "paper";

/// Scenario of the varying-traffic experiment; its runs keep single visits.
pub const VARYING_SCENARIO: &str = "varying-demand";

/// What a run showed.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// Weight of time, m^2/s^4.
    pub beta: f64,
    /// Whether every vehicle got through; the means are NaN when not.
    pub complete: bool,
    /// Results per zone.
    pub zones: Vec<ZoneSummaryRow>,
    /// Mean speed at each zone's conflict point, m/s.
    pub exit_speeds_mps: Vec<f64>,
    /// Single visits, where a figure needs them.
    pub visits: Vec<CompletedVisit>,
}

impl Outcome {
    /// Sum of the zones' mean objectives.
    pub fn total(&self) -> f64 {
        self.zones.iter().map(|z| z.mean_objective).sum()
    }
}

/// All runs done so far.
#[derive(Debug)]
pub struct Runs {
    jobs: usize,
    outcomes: BTreeMap<Run, Outcome>,
    total: usize,
}

/// Told how many simulations are done, of how many known so far.
pub type Progress<'a> = dyn FnMut(usize, usize) + 'a;

impl Runs {
    /// No runs yet; at most `jobs` at a time.
    pub fn new(jobs: usize) -> Runs {
        Runs { jobs: jobs.max(1), outcomes: BTreeMap::new(), total: 0 }
    }

    /// Does those of the runs that have not been done, in parallel.
    pub fn perform(
        &mut self,
        runs: impl IntoIterator<Item = Run>,
        progress: &mut Progress<'_>,
    ) -> Result<(), ReproduceError> {
        let missing: Vec<Run> = runs
            .into_iter()
            .filter(|run| !self.outcomes.contains_key(run))
            .collect::<BTreeSet<_>>()
            .into_iter()
            .collect();
        self.total += missing.len();
        let mut finished = BTreeMap::new();
        let (before, total) = (self.outcomes.len(), self.total);
        parallel::each(self.jobs, &missing, Run::execute, |run, outcome| {
            finished.insert(run.clone(), outcome);
            progress(before + finished.len(), total);
        })?;
        self.outcomes.append(&mut finished);
        Ok(())
    }

    /// The outcome of a run that has been performed.
    ///
    /// # Panics
    /// When it has not: every part lists the runs it reads.
    pub fn outcome(&self, run: &Run) -> &Outcome {
        self.outcomes.get(run).unwrap_or_else(|| panic!("not performed: {}", run.command()))
    }

    /// Runs done.
    pub fn len(&self) -> usize {
        self.outcomes.len()
    }

    /// Whether nothing was run.
    pub fn is_empty(&self) -> bool {
        self.outcomes.is_empty()
    }
}
