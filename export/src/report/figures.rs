//! The figures of a page, drawn by `plotters` as SVG or PNG.

use super::data::{Driving, Run, Sample, Way};
use super::latency::Latency;
use super::lines::{simplified, split};
use control_zones::conflict::{Conflicts, PointKind};
use control_zones::scenario::Source;
use control_zones::scenario::shapes::{Place, Shapes};
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::register_font;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::ops::Range;
use std::path::Path;
use std::sync::Once;

/// Colours that colour-blind people can tell apart.
pub const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(90, 90, 90),
];
const INK: RGBColor = RGBColor(34, 34, 34);
const GREY: RGBColor = RGBColor(120, 120, 120);
const PALE: RGBColor = RGBColor(232, 232, 232);
/// Feasibility enforcement, and rows that could not be satisfied.
const FE: RGBColor = COLOURS[1];
const INFEASIBLE: RGBColor = RGBColor(0, 0, 0);
const MERGE: RGBColor = COLOURS[4];
const CROSSING: RGBColor = COLOURS[3];
/// Speeds from 0 to the greatest: viridis without its palest end.
const SPEEDS: [RGBColor; 8] = [
    RGBColor(68, 1, 84),
    RGBColor(70, 50, 126),
    RGBColor(54, 92, 141),
    RGBColor(39, 127, 142),
    RGBColor(31, 161, 135),
    RGBColor(74, 193, 109),
    RGBColor(140, 205, 60),
    RGBColor(205, 205, 30),
];

type Drawn<DB> = Result<(), DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>>;
type Plane<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// A figure: what it is called, what it says, and what it draws.
pub struct Figure<'a> {
    /// File name without ending.
    pub name: String,
    /// Heading.
    pub title: String,
    /// What is to be seen.
    pub caption: String,
    /// Width and height, pixels.
    pub size: (u32, u32),
    pub what: What<'a>,
}

/// What a figure draws.
pub enum What<'a> {
    Map(&'a Run),
    TimeSpace { run: &'a Run, zone: u32, path: u32 },
    Profile { run: &'a Run, zone: u32, of: Quantity },
    Margins { run: &'a Run, zone: u32 },
    Counts { runs: &'a [Run], of: Count },
    Latency(&'a Latency),
}

/// What a profile is of.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    Speed,
    Acceleration,
}

/// What is counted over time.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Count {
    Inside,
    Departed,
}

fn font() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        for style in [FontStyle::Normal, FontStyle::Bold] {
            // Fails only on bytes that are no font.
            let _ = register_font("sans-serif", style, dejavu::sans::regular());
        }
    });
}

impl Figure<'_> {
    /// The figure as SVG.
    pub fn svg(&self) -> Result<String, String> {
        font();
        let mut text = String::new();
        let area = SVGBackend::with_string(&mut text, self.size).into_drawing_area();
        self.draw(&area).map_err(|error| error.to_string())?;
        drop(area);
        Ok(text)
    }

    /// Writes the figure as PNG.
    pub fn png(&self, path: &Path) -> Result<(), String> {
        font();
        let area = BitMapBackend::new(path, self.size).into_drawing_area();
        self.draw(&area).map_err(|error| error.to_string())
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Drawn<DB> {
        area.fill(&WHITE)?;
        match &self.what {
            What::Map(run) => map(area, run)?,
            What::TimeSpace { run, zone, path } => time_space(area, run, *zone, *path)?,
            What::Profile { run, zone, of } => profile(area, run, *zone, *of)?,
            What::Margins { run, zone } => margins(area, run, *zone)?,
            What::Counts { runs, of } => counts(area, runs, *of)?,
            What::Latency(latency) => histogram(area, latency)?,
        }
        area.present()
    }
}

fn style(size: u32, color: RGBColor, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    ("sans-serif", size).into_font().color(&color).pos(Pos::new(horizontal, vertical))
}

fn axes<'a, DB: DrawingBackend + 'a>(
    area: &DrawingArea<DB, Shift>,
    right: u32,
    x: Range<f64>,
    y: Range<f64>,
    (x_name, y_name): (&str, &str),
) -> Result<Plane<'a, DB>, DrawingAreaErrorKind<DB::ErrorType>> {
    let decimals = |range: &Range<f64>| if range.end - range.start < 8.0 { 1 } else { 0 };
    let (x_decimals, y_decimals) = (decimals(&x), decimals(&y));
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .margin_right(right)
        .x_label_area_size(40)
        .y_label_area_size(58)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_desc(x_name)
        .y_desc(y_name)
        .x_label_formatter(&|v| format!("{v:.x_decimals$}"))
        .y_label_formatter(&|v| format!("{v:.y_decimals$}"))
        .x_labels(12)
        .y_labels(8)
        .bold_line_style(PALE)
        .light_line_style(WHITE)
        .axis_style(GREY)
        .axis_desc_style(style(15, INK, HPos::Center, VPos::Center))
        .label_style(("sans-serif", 13).into_font().color(&INK))
        .draw()?;
    Ok(chart)
}

/// Names of series in the upper left corner of a picture, one beside the other.
fn legend<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    left: i32,
    entries: &[(String, RGBColor)],
) -> Drawn<DB> {
    let mut x = left;
    for (name, color) in entries {
        area.draw(&Rectangle::new([(x, 8), (x + 16, 12)], color.filled()))?;
        area.draw(&Text::new(name.clone(), (x + 21, 10), style(13, INK, HPos::Left, VPos::Center)))?;
        x += 40 + (name.chars().count() as f64 * 7.4) as i32;
    }
    Ok(())
}

fn time_space<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    run: &Run,
    zone: u32,
    path: u32,
) -> Drawn<DB> {
    let conflicts = Conflicts::of(&run.scenario.network, zone);
    let length_m = conflicts.length_m(path);
    let (body, bar) = area.split_horizontally(area.dim_in_pixel().0 as i32 - 84);
    let (_, plot) = body.split_vertically(22);
    let mut chart = axes(&plot, 8, 0.0..run.end_s, 0.0..length_m, ("time, s", "distance on the path, m"))?;
    for u in conflicts.uses(path) {
        let point = &conflicts.points()[u.point as usize];
        let color = if point.kind == PointKind::Merge { MERGE } else { CROSSING };
        if u.area_m > 0.0 {
            let area = [(0.0, u.at_m), (run.end_s, (u.at_m + u.area_m).min(length_m))];
            chart.draw_series([Rectangle::new(area, color.mix(0.18).filled())])?;
        }
        chart.draw_series(DashedLineSeries::new(
            [(0.0, u.at_m), (run.end_s, u.at_m)],
            6,
            4,
            color.stroke_width(2),
        ))?;
        // When vehicles of other paths pass it.
        for (way, samples) in run.ways.iter().filter(|(way, _)| way.0 == zone && way.1 != path) {
            let Some(theirs) = conflicts.uses(way.1).iter().find(|other| other.point == u.point) else {
                continue;
            };
            let passed = samples.windows(2).find(|w| w[0].x_m < theirs.at_m && w[1].x_m >= theirs.at_m);
            // One that leaves there is last seen before it.
            let instant = match (passed, samples.last()) {
                (Some(w), _) => {
                    let share = (theirs.at_m - w[0].x_m) / (w[1].x_m - w[0].x_m);
                    Some(w[0].time_s + share * (w[1].time_s - w[0].time_s))
                }
                (None, Some(last)) if last.v_mps > 0.0 && theirs.at_m - last.x_m < 0.5 * last.v_mps => {
                    Some(last.time_s + (theirs.at_m - last.x_m) / last.v_mps)
                }
                _ => None,
            };
            chart.draw_series(instant.map(|t| Circle::new((t, u.at_m), 3, GREY.filled())))?;
        }
    }
    let v_max_mps = run.fastest_mps;
    let scale = (area.dim_in_pixel().0 as f64 / run.end_s.max(1e-9), area.dim_in_pixel().1 as f64 / length_m);
    let bucket = |sample: &Sample| {
        let share = (sample.v_mps / v_max_mps).clamp(0.0, 1.0);
        (share * (SPEEDS.len() as f64 - 1.0)).round() as usize
    };
    for (_, samples) in run.ways.iter().filter(|(way, _)| (way.0, way.1) == (zone, path)) {
        for piece in split(samples, bucket) {
            let color = SPEEDS[bucket(&piece[0])];
            let points = simplified(piece.iter().map(|s| (s.time_s, s.x_m)), scale);
            chart.draw_series([PathElement::new(points, color.stroke_width(2))])?;
        }
        for piece in split(samples, |sample| sample.kind) {
            let (color, width) = match piece[0].kind {
                Driving::Tracking => continue,
                Driving::FeasibilityEnforcement => (FE, 4),
                Driving::Infeasible => (INFEASIBLE, 5),
            };
            let points = simplified(piece.iter().map(|s| (s.time_s, s.x_m)), scale);
            chart.draw_series([PathElement::new(points, color.stroke_width(width))])?;
        }
    }
    // Names of points that are close together share a line.
    let names = conflicts.uses(path).iter().map(|u| {
        let y = plot_place(&chart, (run.end_s, u.at_m)).1;
        ((0, y), conflicts.points()[u.point as usize].name.clone())
    });
    for ((_, y), name) in clustered(names, 13, " ") {
        bar.draw(&Text::new(name, (2, y), style(11, INK, HPos::Left, VPos::Center)))?;
    }
    speed_bar(&bar, v_max_mps)?;
    let own = run.ways.iter().filter(|(way, _)| (way.0, way.1) == (zone, path));
    let is = |kind: Driving| own.clone().any(|(_, samples)| samples.iter().any(|sample| sample.kind == kind));
    let has = |kind: PointKind| {
        conflicts.uses(path).iter().any(|u| conflicts.points()[u.point as usize].kind == kind)
    };
    let (merges, crossings) = (has(PointKind::Merge), has(PointKind::Crossing));
    let entries = [
        (is(Driving::FeasibilityEnforcement), "feasibility enforcement", FE),
        (is(Driving::Infeasible), "infeasible", INFEASIBLE),
        (merges, "merge", MERGE),
        (crossings, "crossing", CROSSING),
        (merges || crossings, "others pass", GREY),
    ];
    legend(area, 70, &present(&entries))
}

/// The entries of a legend that the picture has something of.
fn present(entries: &[(bool, &str, RGBColor)]) -> Vec<(String, RGBColor)> {
    entries.iter().filter(|(is, ..)| *is).map(|(_, name, color)| ((*name).to_owned(), *color)).collect()
}

/// Labels that would lie over each other, put together at the place of the first.
fn clustered(
    labels: impl IntoIterator<Item = ((i32, i32), String)>,
    near_px: i32,
    between: &str,
) -> Vec<((i32, i32), String)> {
    /// Width of half a character, pixels.
    const HALF_PX: i32 = 4;
    let mut all: Vec<((i32, i32), String)> = Vec::new();
    for ((x, y), label) in labels {
        let near = |(at, known): &&mut ((i32, i32), String)| {
            let wide_px = HALF_PX * (known.len() + label.len()) as i32;
            (at.0 - x).abs() < near_px.max(wide_px) && (at.1 - y).abs() < near_px
        };
        match all.iter_mut().find(near) {
            Some((_, known)) if known.split(between).any(|known| known == label) => {}
            Some((_, known)) => *known = format!("{known}{between}{label}"),
            None => all.push(((x, y), label)),
        }
    }
    all
}

fn plot_place<DB: DrawingBackend>(chart: &Plane<'_, DB>, at: (f64, f64)) -> (i32, i32) {
    chart.backend_coord(&at)
}

fn speed_bar<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, v_max_mps: f64) -> Drawn<DB> {
    let (width, height) = area.dim_in_pixel();
    let (top, bottom) = (40, height as i32 - 60);
    let step = f64::from(bottom - top) / SPEEDS.len() as f64;
    let (left, right) = (width as i32 - 36, width as i32 - 24);
    for (i, color) in SPEEDS.iter().rev().enumerate() {
        let (from, to) = (top + (i as f64 * step) as i32, top + ((i + 1) as f64 * step) as i32);
        area.draw(&Rectangle::new([(left, from), (right, to)], color.filled()))?;
    }
    let text =
        |y: i32, v: f64| Text::new(v.to_string(), (right + 3, y), style(12, INK, HPos::Left, VPos::Center));
    area.draw(&text(bottom, 0.0))?;
    area.draw(&text((top + bottom) / 2, 0.5 * v_max_mps))?;
    area.draw(&text(top, v_max_mps))?;
    area.draw(&Text::new("m/s", (right, top - 16), style(12, INK, HPos::Right, VPos::Center)))
}

/// Bins of a profile along a path.
const BINS: usize = 80;

fn profile<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    run: &Run,
    zone: u32,
    of: Quantity,
) -> Drawn<DB> {
    let length_m = run.scenario.network.zones[zone as usize].longest_m();
    let value = |sample: &Sample| if of == Quantity::Speed { sample.v_mps } else { sample.u_mps2 };
    let vehicle = &run.scenario.vehicle;
    let (low, high, name) = match of {
        Quantity::Speed => (0.0, run.fastest_mps, "speed, m/s"),
        Quantity::Acceleration => (vehicle.u_min_mps2, vehicle.u_max_mps2, "acceleration, m/s²"),
    };
    let room = 0.04 * (high - low);
    let (_, plot) = area.split_vertically(22);
    let mut chart =
        axes(&plot, 12, 0.0..length_m, low - room..high + room, ("distance on the path, m", name))?;
    let scale = (area.dim_in_pixel().0 as f64 / length_m, area.dim_in_pixel().1 as f64 / (high - low));
    let ways = || run.ways.iter().filter(|(way, _)| way.0 == zone).map(|(_, samples)| samples);
    let mut bins: Vec<Vec<f64>> = vec![Vec::new(); BINS];
    for samples in ways() {
        for sample in samples {
            let bin = (sample.x_m / length_m * BINS as f64) as usize;
            bins[bin.min(BINS - 1)].push(value(sample));
        }
        let points = simplified(samples.iter().map(|s| (s.x_m, value(s).clamp(low, high))), scale);
        chart.draw_series([PathElement::new(points, GREY.mix(0.18).stroke_width(1))])?;
    }
    let quantile = |share: f64| {
        let points = bins.iter().enumerate().filter(|(_, bin)| !bin.is_empty()).map(|(at, bin)| {
            let mut sorted = bin.clone();
            sorted.sort_by(f64::total_cmp);
            let index = (share * (sorted.len() - 1) as f64).round() as usize;
            ((at as f64 + 0.5) / BINS as f64 * length_m, sorted[index])
        });
        points.collect::<Vec<(f64, f64)>>()
    };
    let (tenth, median, ninetieth) = (quantile(0.1), quantile(0.5), quantile(0.9));
    let band: Vec<(f64, f64)> = tenth.iter().chain(ninetieth.iter().rev()).copied().collect();
    chart.draw_series([Polygon::new(band, COLOURS[0].mix(0.22))])?;
    chart.draw_series([PathElement::new(median, COLOURS[0].stroke_width(3))])?;
    let entries = [
        ("median".to_owned(), COLOURS[0]),
        ("8 of 10".to_owned(), RGBColor(190, 215, 235)),
        ("each vehicle".to_owned(), RGBColor(200, 200, 200)),
    ];
    legend(area, 70, &entries)
}

/// Margins above this concern nobody, m.
const CLOSE_M: f64 = 25.0;
/// By more than this the margin of one pair does not change in a step, m.
const LEAP_M: f64 = 3.0;

fn margins<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, run: &Run, zone: u32) -> Drawn<DB> {
    let margins = &run.margins[zone as usize];
    let series = [
        ("toward leaders", &margins.rear_end, COLOURS[0]),
        ("at merges", &margins.merge, COLOURS[4]),
        ("at crossings", &margins.cross, COLOURS[3]),
    ];
    let all = || series.iter().flat_map(|(_, points, _)| points.iter()).map(|(_, margin)| *margin);
    let low = all().fold(0.0, f64::min);
    let high = all().fold(1.0, f64::max).min(CLOSE_M);
    let (_, plot) = area.split_vertically(22);
    let range = low - 0.08 * (high - low)..high;
    let mut chart = axes(&plot, 12, 0.0..run.end_s, range.clone(), ("time, s", "least margin, m"))?;
    if low < 0.0 {
        let below = [(0.0, range.start), (run.end_s, 0.0)];
        chart.draw_series([Rectangle::new(below, FE.mix(0.08).filled())])?;
    }
    chart.draw_series([PathElement::new([(0.0, 0.0), (run.end_s, 0.0)], INK.stroke_width(1))])?;
    let scale = (
        area.dim_in_pixel().0 as f64 / run.end_s.max(1e-9),
        area.dim_in_pixel().1 as f64 / (high - low).max(1e-9),
    );
    let step_s = run.scenario.dt_s();
    let [(_, leaders, color), others @ ..] = &series;
    // Where nobody owed anything there is no margin, and where another pair has the least one the line does not lead.
    let goes_on = |a: &(f64, f64), b: &(f64, f64)| {
        b.0 - a.0 < 1.5 * step_s && (a.1 > high) == (b.1 > high) && (b.1 - a.1).abs() < LEAP_M
    };
    for piece in leaders.chunk_by(goes_on).filter(|piece| piece[0].1 <= high) {
        let points = simplified(piece.iter().copied(), scale);
        chart.draw_series([PathElement::new(points, color.stroke_width(2))])?;
    }
    for (_, points, color) in others {
        let close = points.iter().filter(|(_, margin)| *margin <= high);
        chart.draw_series(close.map(|at| Circle::new(*at, 3, color.filled())))?;
    }
    let origin = (plot.get_pixel_range().0.start, plot.get_pixel_range().1.start);
    let mut labels = Vec::new();
    for (number, worst) in (1..).zip(&run.worst).filter(|(_, worst)| worst.owed.zone == zone) {
        let at = (worst.time_s, worst.margin_m.clamp(range.start, range.end));
        chart.draw_series([Circle::new(at, 4, INK.filled())])?;
        let (x, y) = plot_place(&chart, at);
        labels.push(((x - origin.0 + 6, y - origin.1), format!("{number}")));
    }
    for (place, text) in clustered(labels, 16, ", ") {
        plot.draw(&Text::new(text, place, style(13, INK, HPos::Left, VPos::Center)))?;
    }
    let entries: Vec<(String, RGBColor)> = series
        .iter()
        .filter(|(_, points, _)| !points.is_empty())
        .map(|(name, _, color)| ((*name).to_owned(), *color))
        .collect();
    legend(area, 70, &entries)
}

fn counts<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, runs: &[Run], of: Count) -> Drawn<DB> {
    let points = |run: &'_ Run| if of == Count::Inside { run.inside.clone() } else { run.departed.clone() };
    let end_s = runs.iter().map(|run| run.end_s).fold(0.0, f64::max);
    let high = runs.iter().flat_map(points).map(|(_, n)| n).fold(1.0, f64::max);
    let name = if of == Count::Inside { "vehicles in the network" } else { "vehicles that have left it" };
    let (_, plot) = area.split_vertically(22);
    let mut chart = axes(&plot, 12, 0.0..end_s, 0.0..1.05 * high, ("time, s", name))?;
    let scale = (area.dim_in_pixel().0 as f64 / end_s.max(1e-9), area.dim_in_pixel().1 as f64 / high);
    let mut entries = Vec::new();
    for (run, color) in runs.iter().zip(COLOURS.iter().cycle()) {
        let line = simplified(points(run).into_iter(), scale);
        chart.draw_series([PathElement::new(line, color.stroke_width(2))])?;
        entries.push((run.name(), *color));
    }
    legend(area, 70, &entries[..entries.len().min(5)])
}

fn histogram<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, latency: &Latency) -> Drawn<DB> {
    let (first, last) = (latency.bins[0].0, latency.bins[latency.bins.len() - 1].0);
    let most = latency.bins.iter().map(|(_, steps)| *steps).max().unwrap_or(1) as f64;
    // Four bins to an octave.
    let below = |up_to_us: f64| up_to_us / 2.0_f64.powf(0.25);
    // From 1, so that a single step is seen.
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .margin_right(12)
        .x_label_area_size(40)
        .y_label_area_size(58)
        .build_cartesian_2d((below(first)..last).log_scale(), (0.7..most * 1.5).log_scale())?;
    chart
        .configure_mesh()
        .x_desc("time of a step, µs")
        .y_desc("steps")
        .x_label_formatter(&|v| v.to_string())
        .y_label_formatter(&|v| format!("{v:.0}"))
        .bold_line_style(PALE)
        .light_line_style(WHITE)
        .axis_style(GREY)
        .axis_desc_style(style(15, INK, HPos::Center, VPos::Center))
        .label_style(("sans-serif", 13).into_font().color(&INK))
        .draw()?;
    let bars = latency.bins.iter().filter(|(_, steps)| *steps > 0).map(|(up_to_us, steps)| {
        Rectangle::new([(below(*up_to_us), 0.7), (*up_to_us, *steps as f64)], COLOURS[0].filled())
    });
    chart.draw_series(bars)?;
    for (name, at_us, color) in [("p50", latency.p50_us, INK), ("p99", latency.p99_us, FE)] {
        chart.draw_series([PathElement::new([(at_us, 0.7), (at_us, most * 1.5)], color.stroke_width(1))])?;
        chart.draw_series([Text::new(
            name,
            (at_us * 1.02, most * 1.4),
            style(13, color, HPos::Left, VPos::Top),
        )])?;
    }
    Ok(())
}

/// A part of the plane in a part of a picture, pixels.
struct View {
    low: Place,
    scale: f64,
    corner: (f64, f64),
    height: f64,
    /// What is outside is not drawn.
    frame: [f64; 4],
}

impl View {
    /// As much of the plane as fits, in the middle of the frame.
    fn new((low, high): (Place, Place), frame: [f64; 4]) -> View {
        let [left, top, right, bottom] = frame;
        let (width_m, height_m) = ((high.0 - low.0).max(1.0), (high.1 - low.1).max(1.0));
        let scale = ((right - left) / width_m).min((bottom - top) / height_m);
        let height = height_m * scale;
        let corner = (left + 0.5 * (right - left - width_m * scale), top + 0.5 * (bottom - top - height));
        View { low, scale, corner, height, frame }
    }

    fn at(&self, (x, y): Place) -> (f64, f64) {
        let across = self.corner.0 + (x - self.low.0) * self.scale;
        (across, self.corner.1 + self.height - (y - self.low.1) * self.scale)
    }

    fn px(&self, place: Place) -> Option<(i32, i32)> {
        let [left, top, right, bottom] = self.frame;
        let (x, y) = self.at(place);
        let (x, y) = (x.round(), y.round());
        let is_inside = (left..=right).contains(&x) && (top..=bottom).contains(&y);
        is_inside.then_some((x as i32, y as i32))
    }

    /// The part of a line that is inside the frame (Liang and Barsky).
    fn line(&self, from: Place, to: Place) -> Option<[(i32, i32); 2]> {
        let [left, top, right, bottom] = self.frame;
        let ((x, y), end) = (self.at(from), self.at(to));
        let (dx, dy) = (end.0 - x, end.1 - y);
        let (mut enters, mut leaves) = (0.0_f64, 1.0_f64);
        for (change, room) in [(-dx, x - left), (dx, right - x), (-dy, y - top), (dy, bottom - y)] {
            if change == 0.0 && room < 0.0 {
                return None;
            }
            if change < 0.0 {
                enters = enters.max(room / change);
            } else if change > 0.0 {
                leaves = leaves.min(room / change);
            }
        }
        let place = |t: f64| ((x + t * dx).round() as i32, (y + t * dy).round() as i32);
        (enters <= leaves).then(|| [place(enters), place(leaves)])
    }
}

/// Bounds of a network in the plane.
pub fn bounds(shapes: &Shapes, zones: usize) -> (Place, Place) {
    let places = || (0..zones as u32).flat_map(|zone| shapes.segments(zone)).flatten();
    let fold =
        |of: fn(&Place) -> f64, with: fn(f64, f64) -> f64, from: f64| places().map(of).fold(from, with);
    let (low_x, low_y) = (fold(|p| p.0, f64::min, f64::INFINITY), fold(|p| p.1, f64::min, f64::INFINITY));
    let high_x = fold(|p| p.0, f64::max, f64::NEG_INFINITY);
    ((low_x, low_y), (high_x, fold(|p| p.1, f64::max, f64::NEG_INFINITY)))
}

/// Room around the map, pixels.
const ROOM_PX: f64 = 56.0;

fn map<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, run: &Run) -> Drawn<DB> {
    let network = &run.scenario.network;
    let (width, height) = area.dim_in_pixel();
    let (width, height) = (f64::from(width), f64::from(height));
    let map = Map::of(run);
    let (low, high) = bounds(&map.shapes, network.zones.len());
    let whole = View::new((low, high), [ROOM_PX, ROOM_PX, width - ROOM_PX, height - ROOM_PX]);
    // Where conflicts are close together they are shown again, enlarged.
    let (near, far) = map.points.iter().fold((high, low), |(near, far), (p, ..)| {
        ((near.0.min(p.0), near.1.min(p.1)), (far.0.max(p.0), far.1.max(p.1)))
    });
    let extent_m = (far.0 - near.0).max(far.1 - near.1);
    let is_crowded = extent_m > 0.0 && extent_m < 0.2 * (high.0 - low.0).min(high.1 - low.1);
    map.draw(area, &whole, !is_crowded)?;
    if is_crowded {
        let (room, side) = (0.45 * extent_m, 0.4 * width.min(height));
        let frame = [8.0, height - side - 8.0, 8.0 + side, height - 8.0];
        let corners = [(frame[0] as i32, frame[1] as i32), (frame[2] as i32, frame[3] as i32)];
        area.draw(&Rectangle::new(corners, WHITE.filled()))?;
        area.draw(&Rectangle::new(corners, GREY.stroke_width(1)))?;
        let part = ((near.0 - room, near.1 - room), (far.0 + room, far.1 + room));
        map.draw(area, &View::new(part, frame), true)?;
    }
    let has = |kind: PointKind| map.points.iter().any(|(_, of, _)| *of == kind);
    let entries = [
        (has(PointKind::Merge), "merge", MERGE),
        (has(PointKind::Crossing), "crossing", CROSSING),
        (!map.braked.is_empty(), "feasibility enforcement", FE),
        (!map.stuck.is_empty(), "infeasible", INFEASIBLE),
        (true, "entrance", COLOURS[2]),
        (true, "exit", COLOURS[0]),
    ];
    legend(area, 12, &present(&entries))
}

/// What is on a map, in the plane.
struct Map<'a> {
    run: &'a Run,
    shapes: Shapes,
    points: Vec<(Place, PointKind, String)>,
    /// Where vehicles braked for feasibility, and where they could not satisfy their rows.
    braked: Vec<Place>,
    stuck: Vec<Place>,
}

impl<'a> Map<'a> {
    fn of(run: &'a Run) -> Map<'a> {
        let network = &run.scenario.network;
        let shapes = Shapes::of(network);
        let mut points = Vec::new();
        for zone in 0..network.zones.len() as u32 {
            let conflicts = Conflicts::of(network, zone);
            for (at, point) in (0..).zip(conflicts.points()) {
                let Some((path, passes)) = conflicts.first_use(at) else { continue };
                points.push((
                    shapes.on_path(network, zone, path, passes.at_m),
                    point.kind,
                    point.name.clone(),
                ));
            }
        }
        let (mut braked, mut stuck) = (Vec::new(), Vec::new());
        for ((zone, path, ..), samples) in &run.ways {
            for sample in samples.iter().filter(|sample| sample.kind != Driving::Tracking) {
                let place = shapes.on_path(network, *zone, *path, sample.x_m.max(0.0));
                if sample.kind == Driving::Infeasible { &mut stuck } else { &mut braked }.push(place);
            }
        }
        Map { run, shapes, points, braked, stuck }
    }

    fn draw<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        view: &View,
        is_detailed: bool,
    ) -> Drawn<DB> {
        let network = &self.run.scenario.network;
        for (id, zone) in (0..).zip(&network.zones) {
            for exit in 0..zone.exits.len() as u32 {
                if let Some(link) = self.shapes.link(network, id, exit) {
                    lane(area, view, &link, PALE, 5)?;
                }
            }
            for shape in self.shapes.segments(id) {
                lane(area, view, shape, RGBColor(196, 196, 196), 6)?;
            }
        }
        for (places, color, size) in [(&self.braked, FE, 2), (&self.stuck, INFEASIBLE, 4)] {
            let mut drawn: Vec<(i32, i32)> = places.iter().filter_map(|place| view.px(*place)).collect();
            drawn.sort_unstable();
            drawn.dedup();
            for place in drawn {
                area.draw(&Circle::new(place, size, color.filled()))?;
            }
        }
        let points =
            self.points.iter().filter_map(|(place, kind, name)| Some((view.px(*place)?, kind, name)));
        for (place, kind, name) in points {
            let color = if *kind == PointKind::Merge { MERGE } else { CROSSING };
            area.draw(&Circle::new(place, 5, color.filled()))?;
            area.draw(&Circle::new(place, 5, INK.stroke_width(1)))?;
            if is_detailed && self.points.len() > 4 && self.points.len() < 40 {
                let text = style(12, INK, HPos::Left, VPos::Top);
                area.draw(&Text::new(name.clone(), (place.0 + 6, place.1 + 3), text))?;
            }
        }
        self.names(area, view, is_detailed)?;
        self.worst(area, view)
    }

    /// Names of entrances, exits and zones; of those in the middle only where there is room.
    fn names<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        view: &View,
        is_detailed: bool,
    ) -> Drawn<DB> {
        let network = &self.run.scenario.network;
        let (mut entrances, mut exits) = (Vec::new(), Vec::new());
        for (id, zone) in (0..).zip(&network.zones) {
            for (segment, shape) in zone.segments.iter().zip(self.shapes.segments(id)) {
                if let (Some(Source::Road(road)), Some(place)) = (segment.source, view.px(shape[0])) {
                    entrances.push((place, network.roads[road as usize].name.clone()));
                }
            }
            for (at, exit) in (0..).zip(&zone.exits).filter(|(_, exit)| exit.to.is_none() && is_detailed) {
                if let Some(place) = view.px(self.shapes.exit(network, id, at)) {
                    exits.push((place, exit.name.clone()));
                }
            }
            let all: Vec<Place> = self.shapes.segments(id).iter().flatten().copied().collect();
            let middle = |of: fn(&Place) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
            let middle = view.px((middle(|p| p.0), middle(|p| p.1)));
            if let (Some((x, y)), true) = (middle, is_detailed && network.zones.len() > 1) {
                let text = style(14, INK, HPos::Center, VPos::Bottom);
                area.draw(&Text::new(zone.name.clone(), (x, y - 9), text))?;
            }
        }
        for (labels, color) in [(entrances, COLOURS[2]), (exits, COLOURS[0])] {
            for ((x, y), name) in clustered(labels, 26, ", ") {
                // Off the edge of the picture there is room to one side only.
                let width = f64::from(area.dim_in_pixel().0);
                let side = match f64::from(x) {
                    x if x < 0.12 * width => HPos::Left,
                    x if x > 0.88 * width => HPos::Right,
                    _ => HPos::Center,
                };
                area.draw(&Text::new(name, (x, y - 9), style(13, color, side, VPos::Bottom)))?;
            }
        }
        Ok(())
    }

    /// The worst moments, by their numbers.
    fn worst<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>, view: &View) -> Drawn<DB> {
        let run = self.run;
        let mut labels = Vec::new();
        for (number, worst) in (1..).zip(&run.worst) {
            let owed = &worst.owed;
            let is_own = |(way, samples): &(&Way, &Vec<Sample>)| {
                let times = samples.first().zip(samples.last()).map(|(a, b)| a.time_s..=b.time_s);
                (way.0, way.2) == (owed.zone, owed.vehicle)
                    && times.is_some_and(|t| t.contains(&worst.time_s))
            };
            let place = run.ways.iter().find(is_own).map(|((zone, path, ..), _)| {
                self.shapes.on_path(&run.scenario.network, *zone, *path, owed.pair.x_m.max(0.0))
            });
            if let Some(px) = place.and_then(|place| view.px(place)) {
                area.draw(&Circle::new(px, 7, INK.stroke_width(2)))?;
                labels.push((px, number.to_string()));
            }
        }
        for ((x, y), text) in clustered(labels, 22, ", ") {
            area.draw(&Text::new(text, (x, y + 10), style(13, INK, HPos::Center, VPos::Top)))?;
        }
        Ok(())
    }
}

fn lane<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    view: &View,
    shape: &[Place],
    color: RGBColor,
    width: u32,
) -> Drawn<DB> {
    for pair in shape.windows(2) {
        if let Some([from, to]) = view.line(pair[0], pair[1]) {
            area.draw(&PathElement::new([from, to], color.stroke_width(width)))?;
        }
    }
    Ok(())
}
