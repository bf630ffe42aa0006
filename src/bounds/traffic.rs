//! Who comes when and goes where: what all policies are compared on.

use super::alone::{End, Leg, optimum};
use crate::scenario::{Downstream, Scenario, Zone};
use serde::{Deserialize, Serialize};

/// A vehicle as it comes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Entrant {
    /// Its number in the run.
    pub vehicle: u32,
    /// Instant at which it is to arrive, s.
    pub arrival_s: f64,
    /// Speed with which it is to, m/s.
    pub speed_mps: f64,
    /// Zones and paths it takes, in order.
    pub way: Vec<(u32, u32)>,
}

/// All vehicles of a run.
#[derive(Clone, Copy, Debug)]
pub struct Traffic<'a> {
    /// Network, vehicles and weights.
    pub scenario: &'a Scenario,
    /// In order of number.
    pub entrants: &'a [Entrant],
}

/// Lower bounds that are rigorous.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// Of the sum of the zones' mean costs, m^2/s^3.
    pub total: f64,
    /// The same with pairs and triples that merge, in whatever order; absent where the network has more than merges.
    pub merging_total: Option<f64>,
    /// Of the mean cost per vehicle, m^2/s^3.
    pub per_vehicle: f64,
    /// Time in zones of each entrant's own optimum, s.
    pub durations_s: Vec<f64>,
}

impl Traffic<'_> {
    /// The bounds that leave everybody alone.
    pub fn alone(&self) -> Bounds {
        let share = self.shares();
        let mean = |sum: f64| sum / self.entrants.len().max(1) as f64;
        let total = self.entrants.iter().map(|e| self.cost(e, &share).0).sum();
        let equal = vec![1.0; share.len()];
        let own: Vec<(f64, f64)> = self.entrants.iter().map(|e| self.cost(e, &equal)).collect();
        Bounds {
            total,
            merging_total: None,
            per_vehicle: mean(own.iter().map(|(cost, _)| cost).sum()),
            durations_s: own.into_iter().map(|(_, duration_s)| duration_s).collect(),
        }
    }

    /// All bounds that are rigorous.
    pub fn bounds(&self) -> Bounds {
        Bounds { merging_total: super::merging::bound(self).map(|merging| merging.total), ..self.alone() }
    }

    /// The weight of a vehicle's cost in each zone: one over how many pass it.
    pub fn shares(&self) -> Vec<f64> {
        let mut passing = vec![0.0; self.scenario.network.zones.len()];
        self.entrants.iter().flat_map(|e| &e.way).for_each(|(zone, _)| passing[*zone as usize] += 1.0);
        passing.into_iter().map(|n: f64| 1.0 / n.max(1.0)).collect()
    }

    /// Least weighted cost of one vehicle, and its time in zones, s.
    fn cost(&self, entrant: &Entrant, weights: &[f64]) -> (f64, f64) {
        let (mut cost, mut duration_s) = (0.0, 0.0);
        let mut entry_mps = entrant.speed_mps;
        let mut legs: Vec<Leg> = Vec::new();
        let mut finish = |legs: &mut Vec<Leg>, entry_mps: f64| {
            if !legs.is_empty() {
                let found = optimum(entry_mps, legs, End::Free).expect("a free end can be had");
                cost += found.cost;
                duration_s += found.durations_s.iter().sum::<f64>();
                legs.clear();
            }
        };
        for &(zone, path) in &entrant.way {
            let shape = &self.scenario.network.zones[zone as usize];
            let length_m = shape.paths[path as usize].length_m;
            legs.push(Leg::new(length_m, weights[zone as usize], self.scenario.beta));
            // Nobody controls a vehicle on a link: whatever was before does not matter behind it.
            if let Some(link) = shape.exit_of(path).to.filter(|to| to.link_m > 0.0) {
                finish(&mut legs, entry_mps);
                entry_mps = self.fastest_behind_mps(&link);
            }
        }
        finish(&mut legs, entry_mps);
        (cost, duration_s)
    }

    /// The greatest speed at the end of a link: that of a vehicle alone on it that came as fast as it may.
    fn fastest_behind_mps(&self, link: &Downstream) -> f64 {
        let kinds = || self.scenario.fleet.iter().map(|kind| kind.vehicle);
        let mut v = kinds().map(|kind| kind.v_max_mps).fold(0.0, f64::max);
        let brakes = kinds().map(|kind| -kind.u_min_mps2).fold(f64::INFINITY, f64::min);
        let (mut x, dt_s) = (0.0, self.scenario.dt_s());
        while x < link.link_m && v > link.link_speed_mps {
            x += v * dt_s;
            // Each driver goes over to the link's speed within the time constant of `world/link.rs`, or slower.
            let next = v - dt_s * (0.5 * (v - link.link_speed_mps)).min(brakes);
            if x < link.link_m {
                v = next;
            }
        }
        v.max(link.link_speed_mps)
    }
}

/// Whether a zone is a merge of single segments without a link behind it.
pub(super) fn is_merge(zone: &Zone) -> bool {
    zone.crossings.is_empty()
        && zone.exits.len() == 1
        && zone.exits[0].to.is_none_or(|to| to.link_m == 0.0)
        && zone.paths.iter().all(|path| path.segments.len() == 1)
}
