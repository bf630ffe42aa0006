//! `cz bench scale`: how the time of a step grows with the number of vehicles.

use super::machine::Machine;
use super::{BenchError, Sumo};
use crate::process::Outcome;
use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use std::ops::RangeInclusive;

/// What to measure, and how to run a network of a given size.
pub struct ScaleOptions<'a> {
    /// Vehicles at once, roughly, one measurement each.
    pub sizes: Vec<usize>,
    /// Runs a network of that many vehicles with that many controller processes (0: all in one process).
    pub run: &'a dyn Fn(usize, u32) -> Result<Outcome, String>,
    /// SUMO, and beside how many vehicles it is to be measured.
    pub sumo: Option<(Sumo, RangeInclusive<usize>)>,
}

/// One size and number of controller processes.
#[derive(Clone, Debug, Serialize)]
pub struct ScalePoint {
    /// Controller processes; 0 when everything ran in one process.
    pub controllers: u32,
    /// Vehicles in the network when the run ended.
    pub vehicles: u32,
    /// Zones of the network.
    pub zones: usize,
    /// Median time of a step, ns.
    pub step_ns: u64,
    /// `step_ns / vehicles`.
    pub ns_per_vehicle_step: f64,
    /// Peak resident memory of the world process, bytes.
    pub world_bytes: u64,
}

/// SUMO beside ours, one thread each.
///
/// SUMO's human drivers follow, change lanes and merge; ours are all driven by the paper's law. Both step the
/// same number of corridors of the same lengths and demand, 0.1 s at a time.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SumoPoint {
    /// Mean number of vehicles in SUMO's network.
    pub vehicles: f64,
    /// SUMO's mean time of a vehicle-step, ns.
    pub ns_per_vehicle_step: f64,
    /// Vehicles in ours.
    pub our_vehicles: u32,
    /// Our median step in one process, per vehicle, ns.
    pub our_ns_per_vehicle_step: f64,
    /// `ns_per_vehicle_step / our_ns_per_vehicle_step`.
    pub ratio: f64,
}

/// The results.
#[derive(Clone, Debug, Serialize)]
pub struct ScaleReport {
    /// Where it was measured.
    pub machine: Machine,
    /// All measurements.
    pub points: Vec<ScalePoint>,
    /// Per number of controller processes: exponent p of the fit step time = c * vehicles^p.
    pub growth_exponents: Vec<(u32, f64)>,
    /// SUMO beside ours, when asked for.
    pub sumo: Vec<SumoPoint>,
    /// Its version, when asked for.
    pub sumo_version: Option<String>,
}

/// Measures all sizes with everything in one process, one, and two controller processes.
pub fn scale(
    options: &ScaleOptions<'_>,
    mut done: impl FnMut(&ScalePoint),
) -> Result<ScaleReport, BenchError> {
    let machine = Machine::here();
    let mut points = Vec::new();
    let mut growth_exponents = Vec::new();
    let mut beside = Vec::new();
    for controllers in [0, 1, 2] {
        for &size in &options.sizes {
            let outcome = (options.run)(size, controllers).map_err(BenchError::Run)?;
            // In a large network every step is somebody's event.
            let most = if outcome.event_ns.count > outcome.steady_ns.count {
                outcome.event_ns
            } else {
                outcome.steady_ns
            };
            let vehicles = outcome.world.arrived - outcome.world.departed;
            let point = ScalePoint {
                controllers,
                vehicles,
                zones: outcome.world.zones.len(),
                step_ns: most.p50,
                ns_per_vehicle_step: most.p50 as f64 / f64::from(vehicles.max(1)),
                world_bytes: outcome.peak_rss_bytes,
            };
            done(&point);
            if let (0, Some((sumo, sizes))) = (controllers, &options.sumo)
                && sizes.contains(&size)
            {
                let theirs = sumo.measure(size)?;
                beside.push(SumoPoint {
                    vehicles: theirs.vehicles,
                    ns_per_vehicle_step: theirs.ns_per_vehicle_step,
                    our_vehicles: point.vehicles,
                    our_ns_per_vehicle_step: point.ns_per_vehicle_step,
                    ratio: theirs.ns_per_vehicle_step / point.ns_per_vehicle_step,
                });
            }
            points.push(point);
        }
        let of_these: Vec<&ScalePoint> = points.iter().filter(|p| p.controllers == controllers).collect();
        if let Some(exponent) = growth_exponent(&of_these) {
            growth_exponents.push((controllers, exponent));
        }
    }
    let sumo_version = options.sumo.as_ref().map(|(sumo, _)| sumo.version().to_owned());
    Ok(ScaleReport { machine, points, growth_exponents, sumo: beside, sumo_version })
}

/// Least-squares slope of log step time over log vehicles.
fn growth_exponent(points: &[&ScalePoint]) -> Option<f64> {
    if points.len() < 2 {
        return None;
    }
    let a = DMatrix::from_fn(points.len(), 2, |i, j| {
        if j == 0 { 1.0 } else { f64::from(points[i].vehicles.max(1)).ln() }
    });
    let b = DVector::from_fn(points.len(), |i, _| (points[i].step_ns.max(1) as f64).ln());
    a.svd(true, true).solve(&b, 1e-12).ok().map(|x| x[1])
}
