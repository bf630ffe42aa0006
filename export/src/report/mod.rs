//! `cz report`: a page on one or several recordings, in one file.

mod compare;
mod data;
mod figures;
mod latency;
mod lines;
mod page;

use crate::export::judge;
use clap::Parser;
use control_zones::app::{AppError, open_recording, print};
use control_zones::scenario::shapes::Shapes;
use data::Run;
use figures::{Count, Figure, Quantity, What};
use latency::Latency;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Time-space diagrams that are drawn at most.
const DIAGRAMS: usize = 12;
/// Width of the page, and of a second in time-space diagrams, pixels.
const PAGE_PX: f64 = 1100.0;
const PX_PER_S: f64 = 1.6;
/// Zones whose profiles and margins are drawn at most.
const ZONES: usize = 9;

/// Make one page of recordings: what was run, results, map, figures, worst moments, events.
///
/// Recordings that differ in nothing but the seed are one group, with intervals; groups are compared with the first.
#[derive(Debug, Parser)]
#[command(name = "cz report", version)]
pub struct ReportArgs {
    /// The recordings; figures are of the first.
    #[arg(required = true)]
    pub files: Vec<PathBuf>,
    /// The page to write.
    #[arg(long, value_name = "FILE", default_value = "report.html")]
    pub out: PathBuf,
    /// Also write each figure into this directory as PNG.
    #[arg(long, value_name = "DIR")]
    pub png: Option<PathBuf>,
    /// Also write each figure into this directory as SVG.
    #[arg(long, value_name = "DIR")]
    pub svg: Option<PathBuf>,
    /// Show how long steps took, from what `cz run --json` has written; may be repeated.
    #[arg(long, value_name = "FILE")]
    pub summary: Vec<PathBuf>,
}

/// Runs `cz report`.
pub fn main(args: &ReportArgs) -> Result<(), AppError> {
    let latency: Result<Vec<Latency>, String> = args.summary.iter().map(|path| Latency::read(path)).collect();
    let latency = latency.map_err(AppError::Usage)?;
    let mut runs = Vec::new();
    for path in &args.files {
        runs.push(Run::read(path, open_recording(path)?));
    }
    for latency in &latency {
        let is_of = |run: &Run| {
            run.reader
                .footer()
                .is_some_and(|footer| format!("{:016x}", footer.state_hash) == latency.state_hash)
        };
        if !runs.iter().any(is_of) {
            let problem = "its state hash is none of the recordings'";
            return Err(AppError::Usage(format!("--summary {}: {problem}", latency.name)));
        }
    }
    let figures = figures_of(&runs, &latency);
    let mut drawn = Vec::new();
    for figure in figures {
        let svg = figure.svg().map_err(|error| drawing(&figure.name, &error))?;
        drawn.push((figure, svg));
    }
    let page = page::page(&runs, &drawn, &latency);
    let mut out = crate::out::Out::create(&args.out).map_err(failed)?;
    let fault = out.fault();
    out.write_all(page.as_bytes()).map_err(|error| failed(fault(error)))?;
    out.finish().map_err(failed)?;
    files(args.svg.as_deref(), &drawn, |figure, svg, directory| {
        std::fs::write(directory.join(format!("{}.svg", figure.name)), svg).map_err(|error| error.to_string())
    })?;
    files(args.png.as_deref(), &drawn, |figure, _, directory| {
        figure.png(&directory.join(format!("{}.png", figure.name)))
    })?;
    let (path, kilobytes) = (args.out.display(), page.len() as f64 * 1e-3);
    print(&format!("{path}: {} figures, {kilobytes:.0} kB\n", drawn.len()))?;
    runs.iter().try_for_each(|run| judge(&run.path, &run.ended))
}

fn failed(error: crate::OutError) -> AppError {
    AppError::Failed(error.to_string())
}

fn drawing(name: &str, error: &str) -> AppError {
    AppError::Failed(format!("figure {name} cannot be drawn: {error}"))
}

/// Writes every figure into a directory.
fn files(
    directory: Option<&Path>,
    drawn: &[(Figure<'_>, String)],
    write: impl Fn(&Figure<'_>, &str, &Path) -> Result<(), String>,
) -> Result<(), AppError> {
    let Some(directory) = directory else { return Ok(()) };
    std::fs::create_dir_all(directory)
        .map_err(|error| AppError::Failed(format!("cannot make {}: {error}", directory.display())))?;
    drawn.iter().try_for_each(|(figure, svg)| {
        write(figure, svg, directory).map_err(|error| drawing(&figure.name, &error))
    })
}

/// A name that is a file's and an anchor's whatever a scenario calls its zones.
fn slug(text: &str) -> String {
    text.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' { c } else { '_' }).collect()
}

fn figures_of<'a>(runs: &'a [Run], latency: &'a [Latency]) -> Vec<Figure<'a>> {
    let run = &runs[0];
    let network = &run.scenario.network;
    let mut figures = vec![map(run)];
    if run.ways.is_empty() {
        return figures;
    }
    // Paths by how many take them, then in their own order.
    let mut used: BTreeMap<(u32, u32), usize> = BTreeMap::new();
    run.ways.keys().for_each(|(zone, path, ..)| *used.entry((*zone, *path)).or_default() += 1);
    let mut most: Vec<((u32, u32), usize)> = used.iter().map(|(way, count)| (*way, *count)).collect();
    most.sort_by_key(|(way, count)| (std::cmp::Reverse(*count), *way));
    most.truncate(DIAGRAMS);
    most.sort();
    // As wide as the page up to eleven minutes; what is longer is scrolled.
    let width = (run.end_s * PX_PER_S).clamp(PAGE_PX, 4000.0) as u32;
    let goes_on = if f64::from(width) > PAGE_PX { " It goes on to the right." } else { "" };
    let left_out = used.len().saturating_sub(DIAGRAMS);
    for ((zone, path), count) in most {
        let (zone_name, path_name) =
            (&network.zones[zone as usize].name, &network.zones[zone as usize].paths[path as usize].name);
        let rest = match left_out {
            0 => String::new(),
            n => format!(" Of {n} paths that fewer took there is no diagram."),
        };
        figures.push(Figure {
            name: slug(&format!("time-space-{zone_name}-{path_name}")),
            title: format!("Time and space: {zone_name}.{path_name}, {count} passages"),
            caption: format!(
                "Each line is a vehicle, coloured by its speed; thick where it braked in feasibility enforcement or could \
                 not satisfy its rows. Dashed: conflict points, with grey dots where vehicles of other paths pass \
                 them.{goes_on}{rest}"
            ),
            size: (width, 460),
            what: What::TimeSpace { run, zone, path },
        });
    }
    for (zone, shape) in (0..).zip(&network.zones).take(ZONES) {
        for (of, name, word) in
            [(Quantity::Speed, "speed", "Speed"), (Quantity::Acceleration, "acceleration", "Acceleration")]
        {
            figures.push(Figure {
                name: slug(&format!("{name}-{}", shape.name)),
                title: format!("{word} along the way: {}", shape.name),
                caption: "Median and the middle eight tenths of all vehicles' steps, by the place on their paths; behind \
                          them every vehicle."
                    .to_owned(),
                size: (1100, 320),
                what: What::Profile { run, zone, of },
            });
        }
        figures.push(Figure {
            name: slug(&format!("margins-{}", shape.name)),
            title: format!("Margins over time: {}", shape.name),
            caption: "The least margin toward leaders at each step (line), and toward those who pass first as a vehicle \
                      comes to a merge or crossing (dots); below zero somebody is closer than its reaction time allows. \
                      Numbers are the worst moments in the table below."
                .to_owned(),
            size: (1100, 340),
            what: What::Margins { run, zone },
        });
    }
    for (of, name, title) in [
        (Count::Inside, "inside", "Vehicles in the network"),
        (Count::Departed, "departed", "Vehicles that have left the network"),
    ] {
        figures.push(Figure {
            name: name.to_owned(),
            title: title.to_owned(),
            caption: if runs.len() > 1 { "Of all recordings.".to_owned() } else { String::new() },
            size: (1100, 300),
            what: What::Counts { runs, of },
        });
    }
    for latency in latency.iter().filter(|latency| !latency.bins.is_empty()) {
        figures.push(Figure {
            name: slug(&format!("latency-{}", latency.name)),
            title: format!("How long steps took: {}", latency.name),
            caption: "From the state's publication to the end of integration, both axes logarithmic."
                .to_owned(),
            size: (1100, 320),
            what: What::Latency(latency),
        });
    }
    figures
}

fn map(run: &Run) -> Figure<'_> {
    let network = &run.scenario.network;
    let (low, high) = figures::bounds(&Shapes::of(network), network.zones.len());
    let ratio = (high.1 - low.1) / (high.0 - low.0).max(1.0);
    Figure {
        name: "map".to_owned(),
        title: "Map".to_owned(),
        caption: "Lanes, conflict points, where vehicles braked in feasibility enforcement (orange) or could not satisfy \
                  their rows (black), and the worst moments (numbered circles)."
            .to_owned(),
        size: (1100, (1100.0 * ratio).clamp(240.0, 1100.0) as u32),
        what: What::Map(run),
    }
}
