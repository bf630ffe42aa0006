//! SUMO's trip information: one line per vehicle.

use crate::fcd::Places;
use crate::out::OutError;
use crate::trips::{Trip, Trips};
use crate::xml::{Document, number};
use control_zones::scenario::Scenario;
use std::path::Path;

/// Writes the file. Vehicles still inside at the end have the arrival -1, as SUMO writes unfinished trips. Beside SUMO's
/// own attributes there are `energy`, m^2/s^3, and `feTime`, s, over completed visits.
pub fn write(path: &Path, scenario: &Scenario, trips: &Trips<'_>) -> Result<(), OutError> {
    let mut document = Document::begin(path, "tripinfos", "tripinfo_file.xsd")?;
    let places = Places::of(scenario);
    for trip in trips.all() {
        line(&mut document, &places, trip)?;
    }
    document.finish()
}

fn line(document: &mut Document, places: &Places<'_>, trip: &Trip) -> Result<(), OutError> {
    let kinds = &places.scenario.fleet;
    let vehicle = kinds.get(usize::from(trip.kind)).map_or(places.scenario.vehicle, |kind| kind.vehicle);
    let time_loss_s = (trip.duration_s() - trip.distance_m / vehicle.v_max_mps).max(0.0);
    let arrived = |value: f64| if trip.arrival_s.is_some() { number(value) } else { "-1".to_owned() };
    let arrival_lane = trip.arrival_s.map_or_else(String::new, |_| places.lane_name(trip.last.lane));
    document.empty(
        "tripinfo",
        &[
            ("id", &trip.vehicle.to_string()),
            ("depart", &number(trip.depart_s)),
            ("departLane", &places.lane_name(trip.first.lane)),
            ("departPos", "0"),
            ("departSpeed", &number(trip.depart_mps)),
            ("departDelay", &number(trip.depart_delay_s)),
            ("arrival", &arrived(trip.arrival_s.unwrap_or_default())),
            ("arrivalLane", &arrival_lane),
            ("arrivalPos", &arrived(trip.last.at_m)),
            ("arrivalSpeed", &arrived(trip.last_mps)),
            ("duration", &number(trip.duration_s())),
            ("routeLength", &number(trip.distance_m)),
            ("waitingTime", &number(trip.waiting_s)),
            ("waitingCount", &trip.waits.to_string()),
            ("stopTime", "0"),
            ("timeLoss", &number(time_loss_s)),
            ("rerouteNo", "0"),
            ("devices", ""),
            ("vType", &places.kind_name(trip.kind)),
            ("speedFactor", "1"),
            ("vaporized", ""),
            ("energy", &trip.energy.to_string()),
            ("feTime", &number(trip.fe_s)),
        ],
    )
}
