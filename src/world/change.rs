//! Another scenario for a world that is under way.

use super::role::World;
use crate::scenario::{ArrivalStream, Scenario};
use std::cmp::Reverse;
use std::sync::Arc;

/// What cannot be changed in a run that is under way.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} cannot be changed in a run that is under way")]
pub struct ChangeError {
    /// Key, or part, of the scenario.
    pub what: String,
}

impl World {
    /// Goes on under another scenario, with the same steps, zones and roads. Where a road's demand is another,
    /// its arrivals from now on are those the new demand has after this instant.
    ///
    /// # Errors
    /// The first thing that differs and must not.
    pub fn change(&mut self, scenario: Arc<Scenario>) -> Result<(), ChangeError> {
        let fixed = |same: bool, what: &str| match same {
            true => Ok(()),
            false => Err(ChangeError { what: what.to_owned() }),
        };
        let (old, new) = (&self.scenario, &scenario);
        fixed(old.dt_ns == new.dt_ns, "dt_s")?;
        fixed(old.seed == new.seed, "seed")?;
        fixed(old.plugins == new.plugins, "controllers")?;
        fixed(old.faults == new.faults, "faults")?;
        fixed(old.network.zones.len() == new.network.zones.len(), "zones")?;
        for (a, b) in old.network.zones.iter().zip(&new.network.zones) {
            let same = a.name == b.name && a.same_shape(b);
            fixed(same, &format!("zones.{} but for its flow", a.name))?;
        }
        fixed(old.network.roads.len() == new.network.roads.len(), "roads")?;
        for (a, b) in old.network.roads.iter().zip(&new.network.roads) {
            let same = a.name == b.name && (a.zone, a.segment, &a.routes) == (b.zone, b.segment, &b.routes);
            fixed(same, &format!("roads.{} but for its demand", a.name))?;
        }
        fixed(old.fleet == new.fleet, "fleet")?;
        let controllers = self.drivers().count();
        let old = std::mem::replace(&mut self.scenario, scenario);
        self.change_demand(&old);
        self.rebuild_gateway(controllers);
        Ok(())
    }

    fn change_demand(&mut self, old: &Scenario) {
        let now_s = self.scenario.time_s(self.step());
        let (scenario, gates) = (&self.scenario, &mut self.gates);
        let generated = old.max_vehicles.unwrap_or(u32::MAX) - gates.left_to_generate;
        gates.left_to_generate = scenario.max_vehicles.unwrap_or(u32::MAX).saturating_sub(generated);
        let roads = old.network.roads.iter().zip(&scenario.network.roads);
        for (i, (before, road)) in roads.enumerate() {
            if before.demand != road.demand {
                gates.streams[i] = ArrivalStream::new(road, i as u32, scenario.seed);
                gates.pending[i] = gates.streams[i].find(|arrival| arrival.time_s > now_s);
            }
        }
        gates.next.clear();
        let pending = gates.pending.iter().enumerate();
        gates.next.extend(pending.filter_map(|(i, a)| Some(Reverse((a.as_ref()?.time_s.to_bits(), i)))));
    }
}
