//! Passing orders: who of a zone's vehicles passes before whom.
//!
//! Whatever the policy, an order is one list of the zone's vehicles, first to last, and at every conflict point those
//! that meet there pass in the order of the list. So nobody can wait in a circle within a zone: the first of the
//! list waits for nobody in it.

use super::assign::row;
use crate::conflict::{Conflicts, Duties, Row};
use crate::scenario::{PassingOrder, Scenario};
use crate::shield::{Shield, yielding_slack_m};
use ipc_schemas::{STATE_ENTERED, VehicleState};

/// A vehicle that lets a newcomer pass first keeps at least this much slack, m: it is not to brake hard for it.
const YIELDING_SLACK_M: f64 = 0.5;

/// Decides orders; kept from use to use for its allocations.
#[derive(Debug)]
pub(super) struct Orders {
    /// By kind of vehicle.
    shields: Vec<Shield>,
    duties: Duties,
}

impl Orders {
    pub(super) fn new(scenario: &Scenario) -> Orders {
        let shields = scenario.fleet.iter().map(|kind| Shield::new(&kind.vehicle, scenario.dt_s()));
        Orders { shields: shields.collect(), duties: Duties::default() }
    }

    /// Brings a zone's order up to date: `order` has the vehicles in the order decided last, and afterwards those of the
    /// zone's members. `members` are in order of entry.
    pub(super) fn update(
        &mut self,
        policy: PassingOrder,
        scenario: &Scenario,
        conflicts: &Conflicts,
        members: &[VehicleState],
        order: &mut Vec<u32>,
    ) {
        match policy {
            PassingOrder::Fifo => {
                order.clear();
                order.extend(members.iter().map(|state| state.vehicle));
            }
            PassingOrder::PerPoint => {
                // One that has come back within a step, by a way from the zone to itself, is a newcomer too.
                let stays = |state: &VehicleState| state.flags & STATE_ENTERED == 0;
                order.retain(|vehicle| members.iter().any(|s| s.vehicle == *vehicle && stays(s)));
                for state in members {
                    if !order.contains(&state.vehicle) {
                        let place = self.place(scenario, conflicts, members, order, state);
                        order.insert(place, state.vehicle);
                    }
                }
            }
        }
    }

    /// Where a newcomer goes: before everybody at the end of the order whom it does not meet, or who would reach
    /// each point at which they meet later than it (both as fast as they entered), and can let it pass.
    fn place(
        &mut self,
        scenario: &Scenario,
        conflicts: &Conflicts,
        members: &[VehicleState],
        order: &[u32],
        newcomer: &VehicleState,
    ) -> usize {
        let first = row(scenario, newcomer, 0);
        let mut place = order.len();
        for (at, vehicle) in order.iter().enumerate().rev() {
            let Some(state) = members.iter().find(|state| state.vehicle == *vehicle) else { continue };
            let second = row(scenario, state, 1);
            match self.meets(conflicts, &first, &second) {
                Meeting::Nowhere => continue,
                Meeting::OnALane => break,
                Meeting::AtPoints => {}
            }
            let comes_first = conflicts.uses(first.path).iter().all(|own| {
                let theirs = conflicts.uses(second.path).iter().find(|u| u.point == own.point);
                theirs.is_none_or(|theirs| expected_s(newcomer, own.at_m) < expected_s(state, theirs.at_m))
            });
            let shield = &self.shields[usize::from(state.kind).min(self.shields.len() - 1)];
            let mut slack_m = || yielding_slack_m(shield, conflicts, &mut self.duties, &first, &second);
            if !comes_first || slack_m() < YIELDING_SLACK_M {
                break;
            }
            place = at;
        }
        place
    }

    fn meets(&mut self, conflicts: &Conflicts, first: &Row, second: &Row) -> Meeting {
        let mut on_a_lane = false;
        conflicts.runs((second.path, second.next_path), (first.path, first.next_path), |run| {
            on_a_lane |= run.from_m == 0.0 && run.other_from_m == 0.0;
        });
        let shares =
            |own: &crate::conflict::Use| conflicts.uses(second.path).iter().any(|u| u.point == own.point);
        match (on_a_lane, conflicts.uses(first.path).iter().any(shares)) {
            (true, _) => Meeting::OnALane,
            (false, true) => Meeting::AtPoints,
            (false, false) => Meeting::Nowhere,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Meeting {
    Nowhere,
    /// They entered on one lane, on which nobody overtakes.
    OnALane,
    AtPoints,
}

/// When a vehicle would reach a place on its path if it drove on as it entered, s.
fn expected_s(state: &VehicleState, at_m: f64) -> f64 {
    state.entry_time_s + at_m / state.entry_speed_mps.max(0.1)
}
