//! What a zone tells its neighbours at its events.

use super::flow::segment_m;
use crate::scenario::{Network, ZoneId};
use ipc_schemas::{STATE_ENTERED, STATE_LEFT, STATE_LEFT_NOW, VehicleState, ZoneSummary};

/// Whom a zone tells about itself.
#[derive(Clone, Debug)]
pub struct Audience(
    /// Each neighbour, and the length of the segment of this zone it observes, m.
    Vec<(ZoneId, f64)>,
);

impl Audience {
    /// The audience of a zone.
    pub fn of(network: &Network, zone: ZoneId) -> Audience {
        let neighbours = network.neighbours(zone).map(|n| {
            // Only policies of exits that lead here look into this zone; of several the one that looks furthest.
            let exits = network.zones[n as usize].exits.iter();
            let looking = exits.filter(|exit| exit.to.is_some_and(|to| to.zone == zone));
            (n, looking.map(|exit| segment_m(&exit.flow)).fold(0.0, f64::max))
        });
        Audience(neighbours.collect())
    }

    /// What each is told of the zone's S(t).
    pub fn summaries<'a>(
        &'a self,
        zone: ZoneId,
        slice: &'a [VehicleState],
    ) -> impl Iterator<Item = ZoneSummary> + 'a {
        self.0.iter().map(move |&(neighbour, segment_m)| summarise(zone, neighbour, segment_m, slice))
    }
}

/// Whether a vehicle entered or left the zone of this S(t) in the step just ended.
pub fn is_event(slice: &[VehicleState]) -> bool {
    slice.iter().any(|s| s.flags & (STATE_ENTERED | STATE_LEFT_NOW) != 0)
}

fn summarise(zone: ZoneId, to_zone: ZoneId, segment_m: f64, slice: &[VehicleState]) -> ZoneSummary {
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
        to_zone,
        vehicles,
        segment_vehicles,
    }
}
