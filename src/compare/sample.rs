//! What one run of a policy showed.

use crate::bounds::Entrant;
use crate::bounds::joint::Course;
use crate::lockstep::in_process::InProcess;
use crate::record::{Reader, WorldReplay};
use crate::reproduce::ReproduceError;
use crate::reproduce::runs::drive;
use crate::scenario::arrivals::ArrivalStream;
use crate::scenario::{Scenario, Source};
use crate::world::World;
use ipc_schemas::{FLAG_END_OF_RUN, NO_ZONE, STATE_LEFT};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

/// What one run of a policy showed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Over all frames of the run.
    pub state_hash: u64,
    /// Weight of time, m^2/s^4.
    pub beta: f64,
    /// Whether every vehicle got through.
    pub complete: bool,
    /// Per zone.
    pub zones: Vec<ZoneSample>,
    /// Vehicles that got through, in order of number.
    pub vehicles: Vec<VehicleSample>,
    /// Pairs of vehicles whose bodies overlapped.
    pub overlap_pairs: u64,
    /// How long they did, s.
    pub overlap_s: f64,
    /// Instants at which a vehicle was past its leader, or passed a point before one that was to pass first.
    pub out_of_order: u32,
}

/// One zone's part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ZoneSample {
    /// Name.
    pub name: String,
    /// The integral of the missing rear-end margin over time, per vehicle, m s.
    pub exposure_ms: f64,
    /// Vehicles that met an infeasible program.
    pub infeasible: u32,
    /// Vehicles in feasibility-enforcement mode.
    pub enforced: u32,
    /// Least margins of vehicles that entered safe, m: rear end, merge or crossing.
    pub least_safe_m: [Option<f64>; 2],
    /// Least margins of all vehicles, m: rear end, merge or crossing.
    pub least_m: [Option<f64>; 2],
}

/// One vehicle's way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleSample {
    /// When it was to arrive, and where it went.
    pub entrant: Entrant,
    /// How long it waited outside, s.
    pub wait_s: f64,
    /// Its passages, as many as zones on its way.
    pub visits: Vec<VisitSample>,
    /// Fuel, ml, up to the last sample before it left.
    pub fuel_ml: f64,
    /// The integral of the squared jerk over the samples, m^2/s^5.
    pub jerk: f64,
}

/// One passage through a zone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct VisitSample {
    /// Instants, s.
    pub entry_s: f64,
    /// Instants, s.
    pub exit_s: f64,
    /// Speed at the end, m/s.
    pub exit_mps: f64,
    /// The integral of u^2/2, m^2/s^3.
    pub energy: f64,
}

impl VehicleSample {
    /// Time in zones and waiting, s.
    pub fn time_s(&self) -> f64 {
        self.wait_s + self.visits.iter().map(|v| v.exit_s - v.entry_s).sum::<f64>()
    }

    /// Energy over the whole way, m^2/s^3.
    pub fn energy(&self) -> f64 {
        self.visits.iter().map(|v| v.energy).sum()
    }
}

impl Sample {
    /// Mean cost per zone, m^2/s^3; what a vehicle waited outside counts in its first zone.
    pub fn zone_costs(&self) -> Vec<f64> {
        let mut sums = vec![(0.0, 0u32); self.zones.len()];
        for vehicle in &self.vehicles {
            let mut wait_s = vehicle.wait_s;
            for (visit, (zone, _)) in vehicle.visits.iter().zip(&vehicle.entrant.way) {
                let (sum, count) = &mut sums[*zone as usize];
                *sum += self.beta * (wait_s + visit.exit_s - visit.entry_s) + visit.energy;
                (*count, wait_s) = (*count + 1, 0.0);
            }
        }
        sums.into_iter().map(|(sum, count)| sum / f64::from(count.max(1))).collect()
    }

    /// The sum of the zones' mean costs, as the paper adds them; NaN when somebody did not get through, as means
    /// over the others would flatter a jam.
    pub fn total(&self) -> f64 {
        if self.complete { self.zone_costs().iter().sum() } else { f64::NAN }
    }

    /// Mean speed at which vehicles left, m/s.
    pub fn exit_mps(&self) -> f64 {
        let exits = self.vehicles.iter().filter_map(|v| v.visits.last()).map(|visit| visit.exit_mps);
        exits.sum::<f64>() / self.vehicles.len().max(1) as f64
    }

    /// When each vehicle passed what, in order of number.
    pub fn courses(&self) -> Vec<Vec<Course>> {
        let course = |v: &VisitSample| Course { entry_s: v.entry_s, exit_s: v.exit_s, exit_mps: v.exit_mps };
        self.vehicles.iter().map(|v| v.visits.iter().map(course).collect()).collect()
    }

    /// All entrants, in order of number.
    pub fn entrants(&self) -> Vec<Entrant> {
        self.vehicles.iter().map(|v| v.entrant.clone()).collect()
    }

    /// Runs a scenario, in one thread.
    pub fn of(scenario: &Arc<Scenario>, what: &str) -> Result<Sample, ReproduceError> {
        let failed = |error: crate::lockstep::LockstepError| ReproduceError::Run {
            command: what.to_owned(),
            error: error.to_string(),
        };
        let mut run = InProcess::new(scenario, 1, 1);
        run.record_visits();
        let mut observer = Observer::default();
        let complete = drive(&mut run, scenario, |world| observer.see(world)).map_err(failed)?;
        Ok(observer.sample(run.world(), complete))
    }

    /// What a recorded run showed: the world, brought on by the recorded commands, is looked at as it would be in the run.
    ///
    /// # Errors
    /// Why it cannot be told: the file is none, it is damaged, or the world comes out elsewhere.
    pub fn recorded(path: &Path) -> Result<Sample, String> {
        let reader = Reader::open(path).map_err(|error| error.to_string())?;
        let mut replay = WorldReplay::new(&reader);
        replay.record_visits();
        let mut observer = Observer::default();
        for step in reader.steps() {
            let step = step.map_err(|damage| damage.to_string())?;
            replay.take(&step).map_err(|error| error.to_string())?;
            if step.header.flags & FLAG_END_OF_RUN == 0 {
                observer.see(replay.world());
            }
        }
        let summary = replay.world().summary();
        let complete = summary.arrived == summary.departed && summary.waiting == 0;
        Ok(observer.sample(replay.world(), complete))
    }
}

/// Looks at the states of every step for what the world does not account.
#[derive(Default)]
pub(super) struct Observer {
    seen: BTreeMap<u32, Seen>,
}

#[derive(Default)]
struct Seen {
    /// Zones and paths, as it came into each.
    way: Vec<(u32, u32)>,
    u_mps2: f64,
    fuel_ml: f64,
    jerk: f64,
}

impl Observer {
    pub(super) fn see(&mut self, world: &World) {
        let dt_s = world.scenario().dt_s();
        for record in world.records().filter(|r| r.flags & STATE_LEFT == 0) {
            let seen = self.seen.entry(record.vehicle).or_default();
            if record.zone != NO_ZONE && seen.way.last().is_none_or(|(zone, _)| *zone != record.zone) {
                seen.way.push((record.zone, record.path));
            }
            let rise_mps2 = record.u_mps2 - seen.u_mps2;
            seen.jerk += rise_mps2 * rise_mps2 / dt_s;
            seen.u_mps2 = record.u_mps2;
            seen.fuel_ml += fuel_ml(record.v_mps - record.u_mps2 * dt_s, record.u_mps2, dt_s);
        }
    }

    pub(super) fn sample(mut self, world: &World, complete: bool) -> Sample {
        let scenario = world.scenario();
        let summary = world.summary();
        let mut visits: HashMap<u32, Vec<VisitSample>> = HashMap::new();
        // Zones are left one after the other, so each vehicle's visits come in order.
        for visit in world.visits() {
            visits.entry(visit.vehicle).or_default().push(VisitSample {
                entry_s: visit.entry_time_s,
                exit_s: visit.exit_time_s,
                exit_mps: visit.exit_speed_mps,
                energy: visit.energy,
            });
        }
        let mut streams: Vec<ArrivalStream> = (0..)
            .zip(&scenario.network.roads)
            .map(|(index, road)| ArrivalStream::new(road, index, scenario.seed))
            .collect();
        let mut vehicles = Vec::new();
        // Vehicles are numbered as they come in, and on each road they come in as they arrive.
        for (vehicle, seen) in std::mem::take(&mut self.seen) {
            let (zone, path) = seen.way[0];
            let entrance = scenario.network.zones[zone as usize].entrance(path);
            let Some(Source::Road(road)) = entrance.source else { continue };
            let arrival = streams[road as usize].next().expect("whoever came in has arrived");
            let Some(visits) = visits.remove(&vehicle).filter(|v| v.len() == seen.way.len()) else {
                continue;
            };
            let (arrival_s, speed_mps) = (arrival.time_s, arrival.speed_mps);
            vehicles.push(VehicleSample {
                wait_s: (visits[0].entry_s - arrival_s).max(0.0),
                entrant: Entrant { vehicle, arrival_s, speed_mps, way: seen.way },
                visits,
                fuel_ml: seen.fuel_ml,
                jerk: seen.jerk,
            });
        }
        let zones = summary.zones.iter().map(|z| ZoneSample {
            name: z.zone.clone(),
            exposure_ms: z.mean_exposure_m_s,
            infeasible: z.infeasible_vehicles,
            enforced: z.fe_vehicles,
            least_safe_m: [
                z.min_rear_end_margin_clean_m,
                lesser(z.min_merge_margin_clean_m, z.min_cross_margin_clean_m),
            ],
            least_m: [z.min_rear_end_margin_m, lesser(z.min_merge_margin_m, z.min_cross_margin_m)],
        });
        Sample {
            state_hash: world.state_hash(),
            beta: scenario.beta,
            complete,
            zones: zones.collect(),
            vehicles,
            overlap_pairs: summary.overlaps.pairs,
            overlap_s: summary.overlaps.time_s,
            out_of_order: summary.zones.iter().map(|z| z.overtakes + z.order_violations).sum(),
        }
    }
}

/// Fuel over a step under a held acceleration, ml: sum of `b_n v^n` and `u` times the sum of `c_n v^n`, nothing
/// while braking (Kamal et al., as the intersection literature has it).
fn fuel_ml(v0_mps: f64, u_mps2: f64, dt_s: f64) -> f64 {
    if u_mps2 < 0.0 {
        return 0.0;
    }
    let rate = |v: f64| {
        let cruise = 0.1569 + v * (0.0245 + v * (-7.415e-4 + v * 5.975e-5));
        cruise + u_mps2 * (0.07224 + v * (0.09681 + v * 1.075e-3))
    };
    // Simpson's rule is exact: v is linear in time, the rate a cubic in v.
    let at = |t: f64| rate(v0_mps + u_mps2 * t);
    dt_s / 6.0 * (at(0.0) + 4.0 * at(0.5 * dt_s) + at(dt_s))
}

/// The lesser of two margins, of which either may be one that nobody had.
fn lesser(a_m: Option<f64>, b_m: Option<f64>) -> Option<f64> {
    a_m.into_iter().chain(b_m).min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fuel_is_the_integral_of_the_rate() {
        let n = 100_000;
        let h = 2.0 / f64::from(n);
        let sum: f64 = (0..n).map(|i| fuel_ml(10.0 + 1.5 * h * f64::from(i), 1.5, h)).sum();
        assert!((sum - fuel_ml(10.0, 1.5, 2.0)).abs() < 1e-8);
        // At 10 m/s without acceleration: 0.1569 + 0.245 - 0.07415 + 0.05975 ml/s.
        assert!((fuel_ml(10.0, 0.0, 1.0) - 0.3875).abs() < 1e-9);
        assert_eq!(fuel_ml(10.0, -0.1, 1.0), 0.0);
    }
}
