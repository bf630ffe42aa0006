//! A scenario as large as wanted: many two-zone merging corridors side by side.

use crate::scenario::{Approach, Demand, Exit, Poisson, RatePeriod, Road, Source, SpeedDistribution, Zone};
use crate::scenario::{Override, Scenario, ScenarioError, load_embedded};

/// Mean number of vehicles at once in one corridor under the demand below, measured.
const VEHICLES_PER_CORRIDOR: f64 = 12.4;

/// A network of corridors that holds about `vehicles` at once, with steady demand until `until_s`.
///
/// Each is the embedded two-zone corridor with longer approaches, so that zones are well filled.
pub fn corridors(vehicles: usize, until_s: f64) -> Result<Scenario, ScenarioError> {
    let none: [Override; 0] = [];
    let mut scenario = load_embedded("varying-demand", &none, Some(1))?;
    let count = (vehicles as f64 / VEHICLES_PER_CORRIDOR).ceil().max(1.0) as u32;
    let zones = std::mem::take(&mut scenario.network.zones);
    let roads = std::mem::take(&mut scenario.network.roads);
    let zones_per = zones.len() as u32;
    let roads_per = roads.len() as u32;
    for i in 0..count {
        for zone in &zones {
            scenario.network.zones.push(Zone {
                name: format!("{}-{i}", zone.name),
                approaches: zone
                    .approaches
                    .iter()
                    .map(|a| Approach {
                        name: a.name.clone(),
                        length_m: 400.0,
                        source: match a.source {
                            Source::Road(r) => Source::Road(r + i * roads_per),
                            Source::Zone(z) => Source::Zone(z + i * zones_per),
                        },
                    })
                    .collect(),
                exit: match zone.exit {
                    Exit::Out => Exit::Out,
                    Exit::Zone { zone, path, link_m } => {
                        Exit::Zone { zone: zone + i * zones_per, path, link_m }
                    }
                },
                flow: zone.flow.clone(),
            });
        }
        for road in &roads {
            scenario.network.roads.push(Road {
                name: format!("{}-{i}", road.name),
                zone: road.zone + i * zones_per,
                path: road.path,
                demand: Demand::Poisson(Poisson {
                    rates: vec![RatePeriod { until_s, vehicles_per_hour: 400.0 }],
                    min_headway_s: 2.0,
                    speed: SpeedDistribution { mean_mps: 16.0, sd_mps: 1.0, min_mps: 13.0, max_mps: 19.0 },
                }),
            });
        }
    }
    scenario.name = format!("corridors-{count}");
    scenario.max_vehicles = None;
    scenario.max_time_s = until_s;
    Ok(scenario)
}
