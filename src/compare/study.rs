//! `cz study`: mixed traffic over the share of automated vehicles, and over how far humans leave what is assumed of them.

use super::cache::{Cache, bytes};
use super::cli::{LabArgs, Seeds, bar};
use super::encounters::{Counts, Encounters};
use super::measure::{Pool, Pooled, pool};
use super::sample::{Observer, Sample, VehicleSample};
use super::{CompareError, Means, load};
use crate::lockstep::LockstepError;
use crate::lockstep::in_process::InProcess;
use crate::reproduce::ReproduceError;
use crate::reproduce::figures::{COLOURS, Drawn, both_formats, legend};
use crate::reproduce::parallel;
use crate::reproduce::runs::drive;
use crate::scenario::{Scenario, scenario_hash};
use clap::{Args, ValueEnum};
use plotters::coord::Shift;
use plotters::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

/// What is studied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Topic {
    /// The same demand at every share of automated vehicles among human drivers
    Penetration,
    /// Humans who brake or accelerate harder than is assumed of them
    Bounds,
}

/// Arguments of `cz study`.
#[derive(Clone, Debug, Args)]
pub struct StudyArgs {
    /// What is studied
    pub topic: Topic,
    /// Seeds: how many, from 1, or a range; 4-13 by default, for which arrivals are random everywhere
    #[arg(long, value_name = "N|A-B")]
    pub seeds: Option<Seeds>,
    /// What it may cost, and where results go
    #[command(flatten)]
    pub lab: LabArgs,
}

/// A network with its demand, and how fast humans wish to drive there on average, m/s.
struct Place {
    network: &'static str,
    vehicles_per_hour: Option<f64>,
    desired_mps: f64,
}

const PLACES: [Place; 3] = [
    Place { network: "two-merges", vehicles_per_hour: Some(300.0), desired_mps: 18.0 },
    // As it is: 250 and 100 vehicles/h and lane.
    Place { network: "intersection", vehicles_per_hour: None, desired_mps: 13.0 },
    Place { network: "roundabout", vehicles_per_hour: None, desired_mps: 11.0 },
];

/// One curve: a place, what is said of its humans, and the values it is drawn over.
struct Series {
    place: &'static Place,
    name: String,
    values: &'static [f64],
    /// Settings for a value.
    sets: Box<dyn Fn(f64) -> Vec<String> + Sync>,
}

/// Shares of automated vehicles, %.
const SHARES: [f64; 11] = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0];
/// How many times as hard as is assumed.
const FACTORS: [f64; 4] = [1.0, 1.25, 1.5, 2.0];
/// What is assumed of humans in the study of bounds: braking and acceleration, m/s^2.
const ASSUMED_MPS2: [f64; 2] = [4.0, 2.0];

impl Topic {
    fn name(self) -> &'static str {
        match self {
            Topic::Penetration => "penetration",
            Topic::Bounds => "bounds",
        }
    }

    /// What the values are.
    fn axis(self) -> &'static str {
        match self {
            Topic::Penetration => "automated, %",
            Topic::Bounds => "times as hard",
        }
    }

    fn series(self) -> Vec<Series> {
        let of_place = |place: &'static Place| -> Vec<Series> {
            match self {
                Topic::Penetration => ["order", "priority"]
                    .map(|yields| Series {
                        place,
                        name: format!("humans with `{yields}`"),
                        values: &SHARES,
                        sets: Box::new(move |share| {
                            place.sets(share / 100.0, &format!("yields=\"{yields}\""))
                        }),
                    })
                    .into(),
                Topic::Bounds => ["braking", "acceleration"]
                    .map(|what| Series {
                        place,
                        name: format!("harder {what}"),
                        values: &FACTORS,
                        sets: Box::new(move |factor| {
                            let [braking, acceleration] = ASSUMED_MPS2;
                            let (key, assumed) = match what {
                                "braking" => ("hardest_mps2", braking),
                                _ => ("acceleration_mps2", acceleration),
                            };
                            let human = format!(
                                "u_min_mps2=-{braking},u_max_mps2={acceleration},scares_per_h=60,{key}={}",
                                factor * assumed
                            );
                            place.sets(0.5, &human)
                        }),
                    })
                    .into(),
            }
        };
        PLACES.iter().flat_map(of_place).collect()
    }
}

impl Place {
    /// Settings with this share of automated vehicles and these keys of the human kind.
    fn sets(&self, automated: f64, human: &str) -> Vec<String> {
        let desired_mps = self.desired_mps;
        let human = format!("driver=\"human\",desired_mps={desired_mps},desired_sd_mps=1,{human}");
        let mut sets = vec![
            "shield=on".to_owned(),
            "gate.entry=viable".to_owned(),
            "control.law=viable".to_owned(),
            "coordination.schedule=tandem".to_owned(),
            "coordination.order=resequenced".to_owned(),
            format!("fleet=[{{name=\"automated\"}},{{name=\"human\",{human}}}]"),
            format!("roads.*.automated={automated}"),
            // One road has the right of way.
            "roads.0.rank=1".to_owned(),
            "end.vehicles=100".to_owned(),
            "end.time_s=2000".to_owned(),
        ];
        if let Some(rate) = self.vehicles_per_hour {
            sets.push(format!("roads.*.demand.rates=[{{until_s=3600.0,vehicles_per_hour={rate}}}]"));
        }
        sets
    }
}

/// What one run showed.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Showed {
    sample: Sample,
    counts: Counts,
    /// Least margin at crossings, m.
    least_cross_m: Option<f64>,
    /// Vehicle-steps at whose end a safe set was left in which the vehicle was, whatever its partner did.
    lost: u64,
    /// Duties that began outside the safe set.
    began_unsafe: u64,
}

/// A measure of the study: key, heading, decimals, how runs are pooled, and its value in a run.
struct Measure {
    key: &'static str,
    heading: &'static str,
    decimals: usize,
    pool: Pool,
    of: fn(&Showed) -> Option<f64>,
}

const fn measure(
    key: &'static str,
    heading: &'static str,
    decimals: usize,
    pool: Pool,
    of: fn(&Showed) -> Option<f64>,
) -> Measure {
    Measure { key, heading, decimals, pool, of }
}

fn mean(showed: &Showed, of: fn(&VehicleSample) -> f64) -> Option<f64> {
    let all = &showed.sample.vehicles;
    (showed.sample.complete && !all.is_empty()).then(|| all.iter().map(of).sum::<f64>() / all.len() as f64)
}

fn per_hundred(showed: &Showed, count: u32) -> Option<f64> {
    let all = showed.sample.vehicles.len();
    (all > 0).then(|| 100.0 * f64::from(count) / all as f64)
}

fn least(showed: &Showed, which: usize) -> Option<f64> {
    showed.sample.zones.iter().filter_map(|z| z.least_safe_m[which]).min_by(f64::total_cmp)
}

const MEASURES: [Measure; 15] = [
    measure("through", "runs that ended", 0, Pool::Sum, |s| Some(f64::from(u8::from(s.sample.complete)))),
    measure("throughput", "vehicles/h", 0, Pool::Mean, |s| {
        let all = s.sample.complete.then_some(&s.sample.vehicles)?;
        let from_s = all.iter().map(|v| v.entrant.arrival_s).min_by(f64::total_cmp)?;
        let to_s = all.iter().filter_map(|v| Some(v.visits.last()?.exit_s)).max_by(f64::total_cmp)?;
        Some(3600.0 * all.len() as f64 / (to_s - from_s))
    }),
    measure("time_s", "time, s", 1, Pool::Mean, |s| mean(s, VehicleSample::time_s)),
    measure("energy", "energy, m²/s³", 1, Pool::Mean, |s| mean(s, VehicleSample::energy)),
    measure("fuel_ml", "fuel, ml", 1, Pool::Mean, |s| mean(s, |v| v.fuel_ml)),
    measure("stops", "stops", 1, Pool::Mean, |s| per_hundred(s, s.counts.stops)),
    measure("ttc", "TTC < 3 s", 1, Pool::Mean, |s| per_hundred(s, s.counts.ttc)),
    measure("drac", "DRAC > 3 m/s²", 1, Pool::Mean, |s| per_hundred(s, s.counts.drac)),
    measure("pet", "PET < 2 s", 1, Pool::Mean, |s| per_hundred(s, s.counts.pet)),
    measure("overlaps", "overlaps", 0, Pool::Sum, |s| Some(s.sample.overlap_pairs as f64)),
    measure("rear_end_m", "rear end, m", 2, Pool::Least, |s| least(s, 0)),
    measure("merge_m", "merge or crossing, m", 2, Pool::Least, |s| least(s, 1)),
    measure("cross_m", "crossing, m", 2, Pool::Least, |s| s.least_cross_m),
    measure("lost", "lost", 0, Pool::Sum, |s| Some(s.lost as f64)),
    measure("began_unsafe", "began unsafe", 0, Pool::Sum, |s| Some(s.began_unsafe as f64)),
];

/// What the columns are.
const LEGEND: &str = "\
Means over runs with 95 % intervals of: vehicles/h from the first arrival to the last exit; per vehicle time with waits outside, energy \
(∫½u²dt) and fuel; per 100 vehicles standstills, pairs one behind the other that came to a time to collision below 3 s or a deceleration to avoid one \
above 3 m/s², and passages of a conflict point less than 2 s after another was clear of it. Over all runs: pairs of bodies that overlapped, the least \
margins of automated vehicles that were safe when they came to owe them (at crossings of all), vehicle-steps that left a safe set the vehicle \
was in, and duties that began outside it.";

/// One curve of the study.
#[derive(Clone, Debug, Serialize)]
struct Curve {
    scenario: &'static str,
    name: String,
    values: Vec<f64>,
    /// By measure, value by value.
    measures: BTreeMap<&'static str, Vec<Pooled>>,
}

/// The study's results.
#[derive(Clone, Debug, Serialize)]
struct Study {
    format: &'static str,
    topic: &'static str,
    axis: &'static str,
    seeds: Vec<u64>,
    curves: Vec<Curve>,
}

fn showed(scenario: &Arc<Scenario>, cache: &Cache, what: &str) -> Result<Showed, CompareError> {
    let file = cache.file("study", scenario_hash(scenario));
    if let Some(known) = cache.find(&file) {
        return Ok(known);
    }
    let failed =
        |error: LockstepError| ReproduceError::Run { command: what.to_owned(), error: error.to_string() };
    let mut run = InProcess::new(scenario, 1, 1);
    run.record_visits();
    let (mut observer, mut encounters) = (Observer::default(), Encounters::of(run.world()));
    let complete = drive(&mut run, scenario, |world| {
        observer.see(world);
        encounters.see(world);
    })
    .map_err(failed)?;
    let summary = run.world().summary();
    let rows = &summary.shield.controllers;
    let showed = Showed {
        sample: observer.sample(run.world(), complete),
        counts: encounters.counts(),
        least_cross_m: summary.zones.iter().filter_map(|z| z.min_cross_margin_m).min_by(f64::total_cmp),
        lost: rows.iter().map(|row| u64::from(row.lost)).sum(),
        began_unsafe: rows.iter().map(|row| u64::from(row.began_unsafe)).sum(),
    };
    cache.put(&file, &bytes(&showed))?;
    Ok(showed)
}

/// Runs the command and returns what goes to standard output; a progress bar is on a terminal's standard error.
///
/// # Errors
/// When a run, a figure or a file fails.
pub fn main(args: &StudyArgs) -> Result<String, CompareError> {
    let Means { jobs, cache } = args.lab.means()?;
    let seeds = args.seeds.unwrap_or(Seeds { from: 4, to: 13 }).all();
    let all = args.topic.series();
    let mut wanted = Vec::new();
    for (at, series) in all.iter().enumerate() {
        for value in 0..series.values.len() {
            wanted.extend(seeds.iter().map(|&seed| (at, value, seed)));
        }
    }
    let bar = bar();
    bar.set_message("runs");
    bar.set_length(wanted.len() as u64);
    let mut found: BTreeMap<(usize, usize, u64), Showed> = BTreeMap::new();
    let work = |&(at, value, seed): &(usize, usize, u64)| {
        let Series { place, name, values, sets } = &all[at];
        let what = format!("{}, {name}, {} {}, seed {seed}", place.network, values[value], args.topic.axis());
        let scenario = load(Some(place.network), seed, &sets(values[value]))
            .map_err(|source| CompareError::Scenario { name: what.clone(), source: Box::new(source) })?;
        showed(&scenario, &cache, &what)
    };
    parallel::each(jobs, &wanted, work, |key, result| {
        found.insert(*key, result);
        bar.inc(1);
    })?;
    bar.finish_and_clear();
    let curve = |(at, series): (usize, &Series)| {
        let over_seeds = |of: fn(&Showed) -> Option<f64>, value: usize| -> Vec<Option<f64>> {
            seeds.iter().map(|&seed| of(&found[&(at, value, seed)])).collect()
        };
        let pooled = |measure: &Measure| {
            let of_value = |value| pool(over_seeds(measure.of, value), measure.pool);
            (measure.key, (0..series.values.len()).map(of_value).collect::<Vec<_>>())
        };
        Curve {
            scenario: series.place.network,
            name: series.name.clone(),
            values: series.values.to_vec(),
            measures: MEASURES.iter().map(pooled).collect(),
        }
    };
    let study = Study {
        format: "cz.study.v1",
        topic: args.topic.name(),
        axis: args.topic.axis(),
        curves: all.iter().enumerate().map(curve).collect(),
        seeds,
    };
    let json = serde_json::to_string_pretty(&study).expect("the study is numbers and words");
    let text = study.markdown();
    if let Some(directory) = &args.lab.out {
        study.write(directory, &json, &text)?;
    }
    Ok(if args.lab.json { json } else { text })
}

impl Study {
    fn markdown(&self) -> String {
        let mut text = format!("{LEGEND}\n\n");
        for curve in &self.curves {
            let _ = writeln!(text, "### {}, {}\n", curve.scenario, curve.name);
            let heads: Vec<&str> = MEASURES.iter().map(|m| m.heading).collect();
            let rule = "|---:".repeat(heads.len());
            let _ = writeln!(text, "| {} | {} |\n|---:{rule}|", self.axis, heads.join(" | "));
            for (at, value) in curve.values.iter().enumerate() {
                let cells = MEASURES.iter().map(|Measure { key, decimals, .. }| {
                    let pooled = &curve.measures[key][at];
                    match (pooled.pooled, &pooled.interval) {
                        (Some(mean), Some(i)) => format!("{mean:.decimals$} ± {:.decimals$}", i.half_width()),
                        (Some(value), None) => format!("{value:.decimals$}"),
                        _ => "–".to_owned(),
                    }
                });
                let _ = writeln!(text, "| {value} | {} |", cells.collect::<Vec<_>>().join(" | "));
            }
            text.push('\n');
        }
        text
    }

    fn write(&self, directory: &Path, json: &str, text: &str) -> Result<(), CompareError> {
        let failed = |path: &Path| {
            let path = path.to_owned();
            move |source| ReproduceError::Write { path, source }
        };
        std::fs::create_dir_all(directory).map_err(failed(directory))?;
        for (suffix, text) in [("json", json), ("md", text)] {
            let path = directory.join(format!("{}.{suffix}", self.topic));
            std::fs::write(&path, text).map_err(failed(&path))?;
        }
        for Place { network, .. } in PLACES {
            let curves: Vec<&Curve> = self.curves.iter().filter(|curve| curve.scenario == network).collect();
            figure(directory, &format!("{}-{network}", self.topic), self.axis, &curves)?;
        }
        Ok(())
    }
}

/// Lower end, mean and upper end of a mean, or of a sum three times the same.
fn ends(pooled: &Pooled) -> Option<(f64, f64, f64)> {
    let mean = pooled.pooled?;
    Some(pooled.interval.map_or((mean, mean, mean), |i| (i.low, i.mean, i.high)))
}

fn figure(directory: &Path, name: &str, axis: &str, curves: &[&Curve]) -> Result<(), ReproduceError> {
    both_formats!(directory, name, |area| draw(area, axis, curves))
}

/// Four panels: time, fuel, stops, and close encounters, with 95 % bars.
fn draw<DB: DrawingBackend>(area: DrawingArea<DB, Shift>, axis: &str, curves: &[&Curve]) -> Drawn<DB> {
    area.fill(&WHITE)?;
    let panels = [
        ("time_s", "time per vehicle (s)"),
        ("fuel_ml", "fuel per vehicle (ml)"),
        ("stops", "stops per 100 vehicles"),
        ("pet", "passages with PET < 2 s per 100 vehicles"),
    ];
    for (panel, (key, title)) in area.split_evenly((2, 2)).iter().zip(panels) {
        let all = || curves.iter().flat_map(|c| &c.measures[key]).filter_map(ends);
        let high = all().map(|e| e.2).fold(1e-3, f64::max);
        let values = || curves.iter().flat_map(|c| &c.values).copied();
        let (from, to) = (values().fold(f64::INFINITY, f64::min), values().fold(0.0, f64::max));
        let side = 0.03 * (to - from);
        let mut chart = ChartBuilder::on(panel)
            .caption(title, ("sans-serif", 15))
            .margin(8)
            .x_label_area_size(34)
            .y_label_area_size(44)
            .build_cartesian_2d(from - side..to + side, 0.0..1.35 * high)?;
        chart.configure_mesh().x_desc(axis).light_line_style(WHITE).label_style(("sans-serif", 12)).draw()?;
        for (at, curve) in curves.iter().enumerate() {
            let colour = COLOURS[at % COLOURS.len()];
            let points = || {
                let values = curve.values.iter().zip(&curve.measures[key]);
                values.filter_map(|(value, pooled)| Some((*value, ends(pooled)?)))
            };
            chart
                .draw_series(LineSeries::new(points().map(|(x, e)| (x, e.1)), colour.stroke_width(2)))?
                .label(format!("{}: {}", curve.scenario, curve.name.replace('`', "")))
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], colour.stroke_width(2)));
            let bars = points().map(|(x, e)| PathElement::new([(x, e.0), (x, e.2)], colour.stroke_width(1)));
            chart.draw_series(bars)?;
        }
        if key == "time_s" {
            legend(&mut chart, SeriesLabelPosition::UpperRight)?;
        }
    }
    area.present()
}
