//! A scenario as large as wanted: many two-zone merging corridors side by side.

use crate::scenario::{Demand, Poisson, RatePeriod, Road, Source, SpeedDistribution, Zone};
use crate::scenario::{Override, Scenario, ScenarioError, load_embedded};

/// Mean number of vehicles at once in one corridor under the demand below, once it has filled up; measured.
const VEHICLES_PER_CORRIDOR: f64 = 10.4;

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
            let mut zone = Zone { name: format!("{}-{i}", zone.name), ..zone.clone() };
            for segment in &mut zone.segments {
                segment.length_m = 400.0;
                match segment.source.as_mut() {
                    Some(Source::Road(road)) => *road += i * roads_per,
                    Some(Source::Zone { zone, .. }) => *zone += i * zones_per,
                    None => {}
                }
            }
            zone.paths.iter_mut().for_each(|path| path.length_m = 400.0);
            zone.exits.iter_mut().filter_map(|exit| exit.to.as_mut()).for_each(|to| to.zone += i * zones_per);
            scenario.network.zones.push(zone);
        }
        for road in &roads {
            scenario.network.roads.push(Road {
                name: format!("{}-{i}", road.name),
                zone: road.zone + i * zones_per,
                segment: road.segment,
                routes: Vec::new(),
                entry: road.entry,
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::lockstep::in_process::InProcess;
    use std::sync::Arc;

    #[test]
    fn corridors_hold_what_was_asked_for_from_the_end_of_the_warm_up_on() {
        let scenario = Arc::new(corridors(2_000, 90.0).unwrap());
        let mut run = InProcess::new(&scenario, 1, 1);
        let (mut sum, mut steps) = (0.0, 0.0);
        while run.step().unwrap() {
            let world = run.world();
            // What `cz bench scale` measures begins 500 steps into the run.
            if world.step() > 500 {
                let vehicles = f64::from(world.arrived() - world.departed());
                assert!((vehicles - 2_000.0).abs() < 0.06 * 2_000.0, "{vehicles} in step {}", world.step());
                (sum, steps) = (sum + vehicles, steps + 1.0);
            }
        }
        let mean: f64 = sum / steps;
        assert!(steps > 300.0 && (mean - 2_000.0).abs() < 0.03 * 2_000.0, "{mean} over {steps} steps");
    }
}
