//! What a controller sees.

use ipc_schemas::{
    self as frames, APPROACH_OWN, ASSIGNMENT_FREE_TERMINAL, ApproachSpec, Assignment, FrameHeader, RunSpec,
    STATE_LEFT, VehicleState,
};

/// The run a controller has joined.
#[derive(Clone, Debug)]
pub struct Run {
    /// Step, limits, distances and gains.
    pub spec: RunSpec,
    /// All approaches of all zones.
    pub approaches: Vec<Approach>,
    /// Own index among the controller processes.
    pub index: u32,
}

/// An approach and its name, `ZONE.APPROACH`.
#[derive(Clone, Debug)]
pub struct Approach {
    /// Its numbers.
    pub spec: ApproachSpec,
    /// Its name.
    pub name: String,
}

impl Run {
    /// The approach of a path of a zone.
    pub fn approach(&self, zone: u32, path: u32) -> Option<&Approach> {
        self.approaches.iter().find(|a| a.spec.zone == zone && a.spec.path == path)
    }

    /// Whether this controller drives an approach.
    pub fn drives(&self, zone: u32, path: u32) -> bool {
        self.approach(zone, path).is_some_and(|a| a.spec.flags & APPROACH_OWN != 0)
    }
}

/// One step: the state frame, and the coordination in force.
#[derive(Clone, Copy, Debug)]
pub struct Step<'a> {
    /// Header of the state frame.
    pub header: &'a FrameHeader,
    /// Simulated time, s.
    pub time_s: f64,
    /// The whole state frame, all zones.
    pub states: &'a [VehicleState],
    pub(crate) run: &'a Run,
    pub(crate) members: &'a [u32],
    pub(crate) assignments: &'a [Vec<Assignment>],
}

impl<'a> Step<'a> {
    /// The run's numbers.
    pub fn run(&self) -> &'a Run {
        self.run
    }

    /// The vehicles to be commanded, in the order of the commands.
    pub fn vehicles(&self) -> impl Iterator<Item = Vehicle<'a>> + use<'a> {
        let (run, states, assignments) = (self.run, self.states, self.assignments);
        self.members.iter().map(move |&at| {
            let state = &states[at as usize];
            let approach = run.approach(state.zone, state.path);
            let all = &assignments[state.zone as usize];
            let from = all.iter().position(|a| a.vehicle == state.vehicle).unwrap_or(all.len());
            let own = all[from..].iter().take_while(|a| a.vehicle == state.vehicle).count();
            Vehicle {
                state,
                length_m: approach.map_or(f64::NAN, |a| a.spec.length_m),
                assignments: &all[from..from + own],
                states,
            }
        })
    }
}

/// One vehicle to be commanded.
#[derive(Clone, Copy, Debug)]
pub struct Vehicle<'a> {
    /// Where it is.
    pub state: &'a VehicleState,
    /// Length of its approach, m.
    pub length_m: f64,
    /// Its constraints, as the coordinator sent them.
    pub assignments: &'a [Assignment],
    states: &'a [VehicleState],
}

/// A vehicle that another must respect.
#[derive(Clone, Copy, Debug)]
pub struct Partner<'a> {
    /// Its record in the same zone.
    pub state: &'a VehicleState,
    /// Its position in the vehicle's own coordinate, m.
    pub x_m: f64,
    /// Distance of the shared conflict point on the vehicle's path, m.
    pub conflict_m: f64,
    /// Whether it merges from another path; it drives ahead on the same one otherwise.
    pub merges: bool,
}

impl<'a> Vehicle<'a> {
    /// Terminal speed to leave the zone with, m/s; `None` when it is free.
    pub fn terminal_mps(&self) -> Option<f64> {
        let a = self.assignments.first()?;
        (a.flags & ASSIGNMENT_FREE_TERMINAL == 0).then_some(a.terminal_speed_mps)
    }

    /// The vehicles it must respect.
    pub fn partners(&self) -> impl Iterator<Item = Partner<'a>> + use<'a> {
        let (states, zone) = (self.states, self.state.zone);
        self.assignments.iter().filter_map(move |a| {
            let state = states.iter().find(|s| s.zone == zone && s.vehicle == a.partner)?;
            Some(Partner {
                state,
                x_m: state.x_m + a.own_conflict_m - a.partner_conflict_m,
                conflict_m: a.own_conflict_m,
                merges: a.kind == frames::CONSTRAINT_MERGE,
            })
        })
    }
}

/// Whether a record is to be commanded by somebody.
pub(crate) fn is_member(state: &VehicleState) -> bool {
    state.zone != frames::NO_ZONE && state.flags & STATE_LEFT == 0
}
