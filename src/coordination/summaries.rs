//! What a zone tells its neighbours at its events.

use super::flow::segment_m;
use crate::scenario::{Scenario, ScheduleKind, ZoneId};
use ipc_schemas::{
    NO_PATH, NO_VEHICLE, STATE_ENTERED, STATE_HUMAN, STATE_LEFT, STATE_LEFT_NOW, STATE_PASSED,
    SUMMARY_COMING, VehicleState, ZoneSummary,
};

/// Whom a zone tells about itself.
#[derive(Clone, Debug)]
pub struct Audience {
    neighbours: Vec<Neighbour>,
    /// How far it is from the origin of each path to the zone behind it, m, where that begins at its end: when and how
    /// fast a vehicle comes over a link is not the coordinators' to decide.
    onward_m: Vec<Option<f64>>,
    /// Lengths of the paths, m.
    lengths_m: Vec<f64>,
    /// Whether neighbours are told of each vehicle.
    in_detail: bool,
}

/// Humans are expected to drive no more slowly, m/s.
const LEAST_EXPECTED_MPS: f64 = 1.0;

#[derive(Clone, Copy, Debug)]
struct Neighbour {
    zone: ZoneId,
    /// Length of the segment of this zone it observes, m.
    segment_m: f64,
    /// Whether vehicles come from there.
    is_upstream: bool,
}

impl Audience {
    /// The audience of a zone.
    pub fn of(scenario: &Scenario, zone: ZoneId) -> Audience {
        let network = &scenario.network;
        let neighbours = network.neighbours(zone).map(|n| {
            // Only policies of exits that lead here look into this zone; of several the one that looks furthest.
            let exits = network.zones[n as usize].exits.iter();
            let looking = exits.filter(|exit| exit.to.is_some_and(|to| to.zone == zone));
            let is_upstream = network.upstream(zone).any(|upstream| upstream == n);
            let segment_m = looking.map(|exit| segment_m(&exit.flow)).fold(0.0, f64::max);
            Neighbour { zone: n, segment_m, is_upstream }
        });
        let own = &network.zones[zone as usize];
        let onward_m = (0..own.paths.len() as u32).map(|path| own.onward_m(path));
        Audience {
            neighbours: neighbours.collect(),
            onward_m: onward_m.collect(),
            lengths_m: own.paths.iter().map(|path| path.length_m).collect(),
            in_detail: scenario.coordination.schedule == ScheduleKind::Tandem,
        }
    }

    /// What each is told of the zone's S(t): a group of records per neighbour.
    pub fn summaries<'a>(
        &'a self,
        zone: ZoneId,
        slice: &'a [VehicleState],
    ) -> impl Iterator<Item = ZoneSummary> + 'a {
        self.neighbours.iter().flat_map(move |neighbour| {
            let all = summarise(zone, neighbour, slice);
            let in_detail = move |state: &'a VehicleState| self.vehicle(neighbour, state, all);
            let members = slice.iter().filter(|state| self.in_detail && !state.has_left());
            let mut vehicles = members.flat_map(in_detail).peekable();
            let none = vehicles.peek().is_none().then_some(all);
            vehicles.chain(none)
        })
    }

    /// A member, as a neighbour is told of it: one that goes there, and one ahead of those from there.
    fn vehicle(
        &self,
        neighbour: &Neighbour,
        state: &VehicleState,
        all: ZoneSummary,
    ) -> impl Iterator<Item = ZoneSummary> + use<> {
        // A human tells nobody what it plans: it is expected to drive as fast as it came.
        let (planned_exit_time_s, planned_exit_speed_mps) = if state.flags & STATE_HUMAN != 0 {
            let length_m = self.lengths_m[state.path as usize];
            let v_mps = state.entry_speed_mps.max(LEAST_EXPECTED_MPS);
            (state.entry_time_s + length_m / v_mps, v_mps)
        } else {
            (state.planned_exit_time_s, state.planned_exit_speed_mps)
        };
        let told = ZoneSummary {
            x_m: state.x_m,
            v_mps: state.v_mps,
            planned_exit_time_s,
            planned_exit_speed_mps,
            vehicle: state.vehicle,
            path: state.path,
            next_path: state.next_path,
            kind: state.kind,
            ..all
        };
        let onward_m = self.onward_m[state.path as usize].filter(|_| state.next_zone == neighbour.zone);
        let coming = onward_m.map(|onward_m| ZoneSummary {
            x_m: state.x_m - onward_m,
            path: state.next_path,
            next_path: state.then_path,
            flags: SUMMARY_COMING,
            ..told
        });
        coming.into_iter().chain(neighbour.is_upstream.then_some(told))
    }
}

/// Whether a vehicle entered or left the zone of this S(t) in the step just ended, or a human who does not follow the
/// order passed a conflict point.
pub fn is_event(slice: &[VehicleState]) -> bool {
    slice.iter().any(|s| s.flags & (STATE_ENTERED | STATE_LEFT_NOW | STATE_PASSED) != 0)
}

fn summarise(zone: ZoneId, neighbour: &Neighbour, slice: &[VehicleState]) -> ZoneSummary {
    let segment_m = neighbour.segment_m;
    let members = slice.iter().filter(|s| s.flags & STATE_LEFT == 0);
    let (mut vehicles, mut segment_vehicles, mut speed_sum) = (0, 0, 0.0);
    for state in members {
        vehicles += 1;
        if state.x_m <= segment_m {
            segment_vehicles += 1;
            speed_sum += state.v_mps;
        }
    }
    ZoneSummary {
        segment_m,
        segment_mean_speed_mps: if segment_vehicles > 0 {
            speed_sum / f64::from(segment_vehicles)
        } else {
            0.0
        },
        from_zone: zone,
        to_zone: neighbour.zone,
        vehicles,
        segment_vehicles,
        vehicle: NO_VEHICLE,
        path: NO_PATH,
        next_path: NO_PATH,
        ..ZoneSummary::default()
    }
}
