//! Zones in which nothing moves any more: a run that makes no progress says so.

use super::role::World;
use serde::{Deserialize, Serialize};

/// Slower than this is standing, m/s.
const STANDING_MPS: f64 = 0.01;
/// A zone that stands this long at a run's end has stalled, s.
const STALLED_AFTER_S: f64 = 60.0;

/// A zone in which every vehicle stood from an instant until the run's end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stall {
    /// Zone name.
    pub zone: String,
    /// First step from which on all of its vehicles stood.
    pub since_step: u64,
    /// Its instant, s.
    pub since_s: f64,
    /// Vehicles standing in it.
    pub vehicles: u32,
}

/// Since which step each zone's vehicles have been standing; `MOVING` where they are not, or there are none.
#[derive(Debug)]
pub(super) struct Standstills(Vec<u64>);

const MOVING: u64 = u64::MAX;

impl Standstills {
    pub(super) fn new(zones: usize) -> Standstills {
        Standstills(vec![MOVING; zones])
    }

    /// The fastest of a zone's vehicles after a step; negative when it has none.
    pub(super) fn observe(&mut self, zone: usize, step: u64, fastest_mps: f64) {
        let since = &mut self.0[zone];
        let stands = (0.0..STANDING_MPS).contains(&fastest_mps);
        *since = if stands { (*since).min(step) } else { MOVING };
    }
}

impl World {
    /// Zones that have stood for a minute or longer by now.
    pub(super) fn stalls(&self) -> Vec<Stall> {
        let scenario = &self.scenario;
        let stalled = |&(zone, &since): &(usize, &u64)| {
            let is_old = since != MOVING && scenario.time_s(self.step() - since) >= STALLED_AFTER_S;
            is_old && !self.members(zone).is_empty()
        };
        let stall = |(zone, &since): (usize, &u64)| Stall {
            zone: scenario.network.zones[zone].name.clone(),
            since_step: since,
            since_s: scenario.time_s(since),
            vehicles: self.members(zone).len() as u32,
        };
        self.standstills.0.iter().enumerate().filter(stalled).map(stall).collect()
    }
}
