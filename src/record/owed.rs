//! Who owes what to whom at a recorded step, with margins: from the assignments in force and the states, as a
//! controller sees them.

use crate::conflict::{Duty, DutyKind};
use crate::scenario::{Scenario, VehicleParams};
use crate::step::Step;
use crate::vehicle::{Inequality, Merge, Pair, RearEnd};
use ipc_schemas::{
    Assignment, CONSTRAINT_CROSS, CONSTRAINT_MERGE, CONSTRAINT_REAR_END, NO_ZONE, VehicleState,
};
use std::collections::BTreeMap;

/// The assignments in force, zone by zone: what each zone's coordinator said last.
#[derive(Clone, Debug, Default)]
pub struct InForce {
    by_zone: BTreeMap<u32, Vec<Assignment>>,
}

/// What one vehicle owes to another at a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Owed {
    /// Zone index.
    pub zone: u32,
    /// The vehicle.
    pub vehicle: u32,
    /// To whom.
    pub partner: u32,
    /// What is in force where the two are now: toward a partner that has merged before it, what is owed to a leader.
    pub kind: DutyKind,
    /// Index of the conflict point within the zone, or `NO_POINT`.
    pub point: u32,
    /// Distance of the point from the zone's origin on the vehicle's path, m.
    pub own_m: f64,
    /// The two, the partner in the vehicle's coordinate.
    pub pair: Pair,
    /// The condition as the built-in law has it.
    pub condition: Condition,
    /// Whether its margin counts now: toward a leader at any instant, toward others once the vehicle comes to the
    /// conflict point within a step. Before that it is a distance that need not be there yet.
    pub counts: bool,
}

/// A safety condition between two vehicles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Condition {
    /// Toward a leader.
    RearEnd(RearEnd),
    /// Toward somebody who passes a merge or a crossing first.
    Merge(Merge),
}

impl Owed {
    /// The margin, m: of the barrier `b1` toward a leader (paper: `Safety`), of `b2` toward others (`SafeMerging`),
    /// which is what will be left at the conflict point only once the vehicle is there.
    pub fn margin_m(&self) -> f64 {
        match &self.condition {
            Condition::RearEnd(condition) => condition.margin_m(&self.pair),
            Condition::Merge(condition) => condition.margin_m(&self.pair),
        }
    }

    /// The barrier row that keeps it.
    pub fn row(&self) -> Inequality {
        match &self.condition {
            Condition::RearEnd(condition) => condition.row(&self.pair),
            Condition::Merge(condition) => condition.row(&self.pair),
        }
    }

    /// Whether the conditions for leaving feasibility-enforcement mode hold toward the partner.
    pub fn may_be_tracked(&self) -> bool {
        match &self.condition {
            Condition::RearEnd(condition) => condition.may_be_tracked(&self.pair),
            Condition::Merge(condition) => condition.may_be_tracked(&self.pair),
        }
    }
}

impl InForce {
    /// Takes what the coordinators said in a step; steps come in order.
    pub fn take(&mut self, step: &Step) {
        for group in step.coordination.chunk_by(|a, b| a.zone == b.zone) {
            self.by_zone.insert(group[0].zone, group.to_vec());
        }
    }

    /// The assignments of a zone.
    pub fn of(&self, zone: u32) -> &[Assignment] {
        self.by_zone.get(&zone).map_or(&[], Vec::as_slice)
    }

    /// Hands out everything that is owed at a step whose coordination has been taken: zone by zone, vehicles in the
    /// order of the state frame.
    pub fn owed(&self, scenario: &Scenario, step: &Step, mut with: impl FnMut(Owed)) {
        for states in step.state.chunk_by(|a, b| a.zone == b.zone).filter(|states| states[0].zone != NO_ZONE)
        {
            let zone = states[0].zone;
            let find = |vehicle: u32| states.iter().find(|s| s.vehicle == vehicle);
            for assignment in self.of(zone) {
                let Some(own) = find(assignment.vehicle).filter(|s| !s.has_left()) else { continue };
                let Some(partner) = find(assignment.partner) else { continue };
                let Some(kind) = scenario.fleet.get(usize::from(own.kind)) else { continue };
                if let Some(owed) = owed(scenario, &kind.vehicle, assignment, own, partner) {
                    with(owed);
                }
            }
        }
    }
}

fn owed(
    scenario: &Scenario,
    params: &VehicleParams,
    assignment: &Assignment,
    own: &VehicleState,
    partner: &VehicleState,
) -> Option<Owed> {
    let kind = match assignment.kind {
        CONSTRAINT_REAR_END => DutyKind::RearEnd,
        CONSTRAINT_MERGE => DutyKind::Merge,
        CONSTRAINT_CROSS => DutyKind::Cross,
        _ => return None,
    };
    let duty = Duty {
        kind,
        partner: assignment.partner,
        point: assignment.point,
        own_m: assignment.own_conflict_m,
        partner_m: assignment.partner_conflict_m,
        gap_m: assignment.gap_m,
        until_m: assignment.until_m,
    };
    let kind = duty.in_force(own.x_m, partner.x_m)?;
    let pair = Pair {
        x_m: own.x_m,
        v_mps: own.v_mps,
        partner_x_m: partner.x_m + duty.shift_m(),
        partner_v_mps: partner.v_mps,
        partner_u_mps2: partner.u_mps2,
    };
    let control = &scenario.control;
    let condition = match kind {
        DutyKind::RearEnd => Condition::RearEnd(RearEnd {
            reaction_s: params.reaction_time_s,
            gap_m: duty.gap_m,
            k_per_s: control.k_rear_end_per_s,
            u_min_mps2: params.u_min_mps2,
        }),
        DutyKind::Merge | DutyKind::Cross => Condition::Merge(Merge {
            reaction_per_length: params.reaction_time_s / duty.own_m,
            gap_m: duty.gap_m,
            k_per_s: control.k_merge_per_s,
            u_min_mps2: params.u_min_mps2,
        }),
    };
    let dt_s = scenario.dt_s();
    let reached_m = own.x_m + dt_s * (own.v_mps + 0.5 * dt_s * params.u_max_mps2);
    Some(Owed {
        counts: kind == DutyKind::RearEnd || reached_m >= duty.own_m,
        zone: assignment.zone,
        vehicle: own.vehicle,
        partner: partner.vehicle,
        kind,
        point: duty.point,
        own_m: duty.own_m,
        pair,
        condition,
    })
}
