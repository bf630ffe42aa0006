//! A scenario as large as wanted: many small networks side by side.

use crate::scenario::{Demand, Poisson, RatePeriod, Road, Source, SpeedDistribution, Zone};
use crate::scenario::{Override, Scenario, ScenarioError, load_embedded};

/// What stands side by side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// Corridors of two merges: the embedded one with longer approaches, so that zones are well filled.
    Corridors,
    /// Grids of nine intersections: the embedded one. A larger grid in one piece would hold no more vehicles than
    /// its shortest circle lets in.
    Grids,
}

impl Family {
    /// Name of the scenarios.
    pub fn name(self) -> &'static str {
        match self {
            Family::Corridors => "corridors",
            Family::Grids => "grids",
        }
    }

    /// Mean number of vehicles at once in one of them under the demand below, once it has filled up; measured.
    fn vehicles_each(self) -> f64 {
        match self {
            Family::Corridors => 10.4,
            Family::Grids => 26.3,
        }
    }

    /// Vehicles per hour and road, and the speeds they come with, m/s.
    fn demand(self) -> (f64, SpeedDistribution) {
        match self {
            Family::Corridors => {
                (400.0, SpeedDistribution { mean_mps: 16.0, sd_mps: 1.0, min_mps: 13.0, max_mps: 19.0 })
            }
            Family::Grids => {
                (180.0, SpeedDistribution { mean_mps: 10.0, sd_mps: 1.0, min_mps: 7.0, max_mps: 13.0 })
            }
        }
    }

    /// One of them.
    fn one(self) -> Result<Scenario, ScenarioError> {
        let none: [Override; 0] = [];
        match self {
            Family::Grids => load_embedded("grid-3x3", &none, Some(1)),
            Family::Corridors => {
                let mut scenario = load_embedded("varying-demand", &none, Some(1))?;
                for zone in &mut scenario.network.zones {
                    zone.segments.iter_mut().for_each(|segment| segment.length_m = 400.0);
                    zone.paths.iter_mut().for_each(|path| path.length_m = 400.0);
                }
                Ok(scenario)
            }
        }
    }
}

/// A network that holds about `vehicles` at once, with steady demand until `until_s`.
pub fn side_by_side(family: Family, vehicles: usize, until_s: f64) -> Result<Scenario, ScenarioError> {
    let mut scenario = family.one()?;
    let count = (vehicles as f64 / family.vehicles_each()).ceil().max(1.0) as u32;
    let zones = std::mem::take(&mut scenario.network.zones);
    let roads = std::mem::take(&mut scenario.network.roads);
    let zones_per = zones.len() as u32;
    let roads_per = roads.len() as u32;
    let (vehicles_per_hour, speed) = family.demand();
    for i in 0..count {
        for zone in &zones {
            let mut zone = Zone { name: format!("{}-{i}", zone.name), ..zone.clone() };
            for segment in &mut zone.segments {
                match segment.source.as_mut() {
                    Some(Source::Road(road)) => *road += i * roads_per,
                    Some(Source::Zone { zone, .. }) => *zone += i * zones_per,
                    None => {}
                }
            }
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
                automated: road.automated,
                rank: road.rank,
                demand: Demand::Poisson(Poisson {
                    rates: vec![RatePeriod { until_s, vehicles_per_hour }],
                    min_headway_s: 2.0,
                    speed,
                }),
            });
        }
    }
    scenario.name = format!("{}-{count}", family.name());
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

    /// What `cz bench scale` measures begins 500 steps into the run.
    fn holds(family: Family, until_s: f64, from: u64) {
        let scenario = Arc::new(side_by_side(family, 2_000, until_s).unwrap());
        let mut run = InProcess::new(&scenario, 1, 1);
        let (mut sum, mut steps) = (0.0, 0.0);
        while run.step().unwrap() {
            let world = run.world();
            if world.step() > from {
                let vehicles = f64::from(world.arrived() - world.departed());
                let is_near = (vehicles - 2_000.0).abs() < 0.06 * 2_000.0;
                assert!(is_near, "{family:?}: {vehicles} in step {}", world.step());
                (sum, steps) = (sum + vehicles, steps + 1.0);
            }
        }
        let mean: f64 = sum / steps;
        println!("{family:?}: {mean} vehicles");
        assert!(steps > 300.0 && (mean - 2_000.0).abs() < 0.03 * 2_000.0, "{mean} over {steps} steps");
    }

    #[test]
    fn corridors_hold_what_was_asked_for_from_the_end_of_the_warm_up_on() {
        holds(Family::Corridors, 90.0, 500);
    }

    #[test]
    fn grids_hold_what_was_asked_for_once_they_have_filled_up() {
        holds(Family::Grids, 150.0, 1_000);
    }
}
