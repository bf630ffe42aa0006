//! What is told of a run.

use super::sample::{Sample, VehicleSample};
use crate::bounds::Bounds;
use crate::bounds::joint::Found;
use crate::reproduce::statistics::Interval;
use serde::Serialize;

/// A policy's run on one replicate.
#[derive(Clone, Debug)]
pub struct Row {
    /// The replicate.
    pub seed: u64,
    /// Which member of the policy it was.
    pub member: usize,
    /// What it showed.
    pub sample: Sample,
    /// What its vehicles take at least.
    pub bounds: Bounds,
    /// The centralised optimum, where it was sought and exists.
    pub joint: Option<Found>,
}

/// What becomes of a value's replicates.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Pool {
    /// Mean with its interval.
    Mean,
    /// Sum.
    Sum,
    /// Least.
    Least,
    /// Greatest.
    Greatest,
}

/// Something that is told of a run.
#[derive(Clone, Copy, Debug)]
pub struct Measure {
    /// Short name, the key in the JSON.
    pub id: &'static str,
    /// What it is.
    pub name: &'static str,
    /// Its unit, where it has one.
    pub unit: Option<&'static str>,
    /// How many decimals are shown.
    pub decimals: usize,
    /// What becomes of replicates.
    pub pool: Pool,
    /// What it is worked out from.
    pub of: Of,
}

/// What a measure is worked out from, and how; there may be no value.
#[derive(Clone, Copy, Debug)]
pub enum Of {
    /// From a run alone.
    Sample(fn(&Sample) -> Option<f64>),
    /// From a run and what its vehicles take at least.
    Row(fn(&Row) -> Option<f64>),
}

impl Measure {
    /// The value, where there is one.
    pub fn value(&self, row: &Row) -> Option<f64> {
        match self.of {
            Of::Sample(of) => of(&row.sample),
            Of::Row(of) => of(row),
        }
    }

    /// What it is over all replicates, with its unit.
    pub fn label(&self) -> String {
        let runs = if self.pool == Pool::Sum { ", all runs" } else { "" };
        let unit = self.unit.map_or(String::new(), |unit| format!(", {unit}"));
        format!("{}{runs}{unit}", self.name)
    }
}

fn mean(sample: &Sample, of: impl Fn(&VehicleSample) -> f64) -> Option<f64> {
    let vehicles = &sample.vehicles;
    let sum: f64 = vehicles.iter().map(of).sum();
    (!vehicles.is_empty()).then(|| sum / vehicles.len() as f64)
}

/// Time a vehicle took more than it would have alone, s.
fn delays_s(row: &Row) -> impl Iterator<Item = f64> + '_ {
    row.sample.vehicles.iter().zip(&row.bounds.durations_s).map(|(v, alone_s)| v.time_s() - alone_s)
}

fn least(margins: impl Iterator<Item = Option<f64>>) -> Option<f64> {
    margins.flatten().min_by(f64::total_cmp)
}

const fn measure(
    id: &'static str,
    name: &'static str,
    unit: Option<&'static str>,
    decimals: usize,
    pool: Pool,
    of: fn(&Sample) -> Option<f64>,
) -> Measure {
    Measure { id, name, unit, decimals, pool, of: Of::Sample(of) }
}

const fn beside(
    id: &'static str,
    name: &'static str,
    unit: Option<&'static str>,
    decimals: usize,
    pool: Pool,
    of: fn(&Row) -> Option<f64>,
) -> Measure {
    Measure { id, name, unit, decimals, pool, of: Of::Row(of) }
}

/// Cost in total, as the paper adds it.
pub const TOTAL: Measure =
    measure("total", "total cost, sum of the zones' means", None, 3, Pool::Mean, |r| Some(r.total()));

/// Cost per vehicle over its whole way, with what it waited outside.
pub const PER_VEHICLE: Measure = measure("per_vehicle", "cost per vehicle", None, 3, Pool::Mean, |r| {
    let beta = r.beta;
    mean(r, |v| beta * v.time_s() + v.energy())
});

/// Time per vehicle.
pub const TIME: Measure =
    measure("time_s", "time per vehicle, with waits", Some("s"), 2, Pool::Mean, |r| mean(r, |v| v.time_s()));

/// Energy per vehicle.
pub const ENERGY: Measure =
    measure("energy", "energy per vehicle", Some("m²/s³"), 3, Pool::Mean, |r| mean(r, |v| v.energy()));

/// All measures but the costs per zone, in the order of the table.
pub const MEASURES: [Measure; 30] = [
    TOTAL,
    beside("alone_total", "bound: vehicles alone (rigorous)", None, 3, Pool::Mean, |r| Some(r.bounds.total)),
    beside("merging_total", "bound: groups that merge (rigorous)", None, 3, Pool::Mean, |r| {
        r.bounds.merging_total
    }),
    beside("joint_total", "centralised optimum (local)", None, 3, Pool::Mean, |r| {
        Some(r.joint.as_ref()?.total)
    }),
    beside("joint_exposure", "its exposure per vehicle, sum of zones", Some("m·s"), 3, Pool::Mean, |r| {
        Some(r.joint.as_ref()?.exposure_ms.iter().sum())
    }),
    beside("joint_missed_s", "its duties missed at most", Some("s"), 3, Pool::Greatest, |r| {
        Some(r.joint.as_ref()?.missed_s)
    }),
    beside("of_alone", "total / vehicles alone (rigorous)", None, 3, Pool::Mean, |r| {
        Some(r.sample.total() / r.bounds.total)
    }),
    beside("of_merging", "total / groups that merge (rigorous)", None, 3, Pool::Mean, |r| {
        Some(r.sample.total() / r.bounds.merging_total?)
    }),
    beside("of_joint", "total / centralised optimum (local)", None, 3, Pool::Mean, |r| {
        Some(r.sample.total() / r.joint.as_ref()?.total)
    }),
    PER_VEHICLE,
    beside(
        "per_vehicle_of_alone",
        "cost per vehicle / vehicles alone (rigorous)",
        None,
        3,
        Pool::Mean,
        |r| Some(PER_VEHICLE.value(r)? / r.bounds.per_vehicle),
    ),
    TIME,
    ENERGY,
    measure("waits", "vehicles that waited outside", None, 1, Pool::Mean, |r| {
        Some(r.vehicles.iter().filter(|v| v.wait_s > 1e-9).count() as f64)
    }),
    measure("wait_s", "wait outside per vehicle", Some("s"), 3, Pool::Mean, |r| mean(r, |v| v.wait_s)),
    measure("fuel_ml", "fuel per vehicle", Some("ml"), 2, Pool::Mean, |r| mean(r, |v| v.fuel_ml)),
    measure("jerk", "jerk, root mean square", Some("m/s³"), 2, Pool::Mean, |r| {
        let time_s: f64 = r.vehicles.iter().map(|v| v.time_s() - v.wait_s).sum();
        let jerk: f64 = r.vehicles.iter().map(|v| v.jerk).sum();
        (time_s > 0.0).then(|| (jerk / time_s).sqrt())
    }),
    measure("exposure", "exposure per vehicle, sum of zones", Some("m·s"), 3, Pool::Mean, |r| {
        Some(r.zones.iter().map(|z| z.exposure_ms).sum())
    }),
    beside("delay_sd_s", "delay against alone, standard deviation", Some("s"), 2, Pool::Mean, |r| {
        let delays: Vec<f64> = delays_s(r).collect();
        let mean = delays.iter().sum::<f64>() / delays.len() as f64;
        let square = delays.iter().map(|d| (d - mean) * (d - mean)).sum::<f64>() / delays.len() as f64;
        (!delays.is_empty()).then(|| square.sqrt())
    }),
    beside(
        "delay_greatest_s",
        "delay against alone, greatest of all runs",
        Some("s"),
        2,
        Pool::Greatest,
        |r| delays_s(r).max_by(f64::total_cmp),
    ),
    measure("throughput", "throughput", Some("vehicles/h"), 1, Pool::Mean, |r| {
        let vehicles = &r.vehicles;
        let from_s = vehicles.iter().map(|v| v.entrant.arrival_s).min_by(f64::total_cmp)?;
        let exits = vehicles.iter().filter_map(|v| v.visits.last()).map(|visit| visit.exit_s);
        let to_s = exits.max_by(f64::total_cmp)?;
        Some(3600.0 * vehicles.len() as f64 / (to_s - from_s))
    }),
    measure("overlap_pairs", "pairs that overlapped", None, 0, Pool::Sum, |r| Some(r.overlap_pairs as f64)),
    measure("overlap_s", "overlapping", Some("s"), 2, Pool::Sum, |r| Some(r.overlap_s)),
    measure("infeasible", "vehicles with an infeasible program", None, 0, Pool::Sum, |r| {
        Some(r.zones.iter().map(|z| f64::from(z.infeasible)).sum())
    }),
    measure("enforced", "vehicles in feasibility enforcement", None, 1, Pool::Mean, |r| {
        Some(r.zones.iter().map(|z| f64::from(z.enforced)).sum())
    }),
    measure("out_of_order", "samples and passings out of order", None, 0, Pool::Sum, |r| {
        Some(f64::from(r.out_of_order))
    }),
    measure("least_safe_rear_end_m", "least rear-end margin, entered safe", Some("m"), 3, Pool::Least, |r| {
        least(r.zones.iter().map(|z| z.least_safe_m[0]))
    }),
    measure(
        "least_safe_merge_m",
        "least merging or crossing margin, entered safe",
        Some("m"),
        3,
        Pool::Least,
        |r| least(r.zones.iter().map(|z| z.least_safe_m[1])),
    ),
    measure("least_rear_end_m", "least rear-end margin, all", Some("m"), 3, Pool::Least, |r| {
        least(r.zones.iter().map(|z| z.least_m[0]))
    }),
    measure("least_merge_m", "least merging or crossing margin, all", Some("m"), 3, Pool::Least, |r| {
        least(r.zones.iter().map(|z| z.least_m[1]))
    }),
];

/// A measure over all replicates.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Pooled {
    /// Replicate by replicate; absent where there is no value.
    pub values: Vec<Option<f64>>,
    /// Mean, sum, least or greatest; absent when a mean or sum lacks a value.
    pub pooled: Option<f64>,
    /// The mean's interval.
    pub interval: Option<Interval>,
}

/// Pools values.
pub fn pool(values: Vec<Option<f64>>, pool: Pool) -> Pooled {
    let values: Vec<Option<f64>> = values.into_iter().map(|v| v.filter(|v| v.is_finite())).collect();
    let all: Option<Vec<f64>> = values.iter().copied().collect();
    let there = || values.iter().copied().flatten();
    let pooled = match pool {
        Pool::Mean => all.as_ref().map(|v| v.iter().sum::<f64>() / v.len() as f64),
        Pool::Sum => all.as_ref().map(|v| v.iter().sum()),
        Pool::Least => there().min_by(f64::total_cmp),
        Pool::Greatest => there().max_by(f64::total_cmp),
    };
    let interval = all.filter(|_| pool == Pool::Mean).and_then(|v| Interval::of(&v));
    Pooled { values, pooled, interval }
}
