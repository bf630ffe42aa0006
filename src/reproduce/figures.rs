//! The paper's figures, as SVG and PNG.
//!
//! Drawn by `plotters` with its own rasteriser; the bitmap text uses DejaVu Sans from the `dejavu` crate,
//! so neither building nor drawing needs a font of the system.

use super::ReproduceError;
use super::rate::{Curve, PERIODS};
use super::statistics::Interval;
use super::tables::SweepCurve;
use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::register_font;
use std::path::Path;
use std::sync::Once;

/// Size of every figure, pixels.
pub(crate) const SIZE: (u32, u32) = (900, 560);
pub(crate) const AXIS_FONT: (&str, u32) = ("sans-serif", 16);
pub(crate) const LABEL_FONT: (&str, u32) = ("sans-serif", 14);
const BLUE: RGBColor = RGBColor(31, 119, 180);
const ORANGE: RGBColor = RGBColor(255, 127, 14);
const GREEN: RGBColor = RGBColor(44, 160, 44);
const GREY: RGBColor = RGBColor(110, 110, 110);
/// Colours that can be told apart, for series that have no meaning of their own.
pub(crate) const COLOURS: [RGBColor; 8] = [
    BLUE,
    ORANGE,
    GREEN,
    RGBColor(214, 39, 40),
    RGBColor(148, 103, 189),
    RGBColor(140, 86, 75),
    RGBColor(23, 190, 207),
    GREY,
];

pub(crate) fn font() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        for style in [FontStyle::Normal, FontStyle::Bold] {
            // Fails only on bytes that are no font.
            let _ = register_font("sans-serif", style, dejavu::sans::regular());
        }
    });
}

pub(crate) fn broken(path: &Path, error: impl std::fmt::Display) -> ReproduceError {
    ReproduceError::Figure { path: path.to_owned(), error: error.to_string() }
}

/// Writes `name.svg` and `name.png`.
macro_rules! both_formats {
    ($dir:expr, $name:expr, $draw:expr) => {{
        use $crate::reproduce::figures::{SIZE, broken, font};
        font();
        let svg = $dir.join(format!("{}.svg", $name));
        $draw(SVGBackend::new(&svg, SIZE).into_drawing_area()).map_err(|e| broken(&svg, e))?;
        let png = $dir.join(format!("{}.png", $name));
        $draw(BitMapBackend::new(&png, SIZE).into_drawing_area()).map_err(|e| broken(&png, e))?;
        Ok(())
    }};
}
pub(crate) use both_formats;

/// Draws `fig:diff_v` for one variant.
pub fn sweep(dir: &Path, name: &str, curve: &SweepCurve) -> Result<(), ReproduceError> {
    both_formats!(dir, name, |area| draw_sweep(area, curve))
}

/// Draws `fig:rate`.
pub fn rate(dir: &Path, name: &str, title: &str, curves: &[Curve]) -> Result<(), ReproduceError> {
    both_formats!(dir, name, |area| draw_rate(area, title, curves))
}

pub(crate) type Drawn<DB> = Result<(), DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>>;

fn draw_sweep<DB: DrawingBackend>(area: DrawingArea<DB, Shift>, curve: &SweepCurve) -> Drawn<DB> {
    area.fill(&WHITE)?;
    let speeds = &curve.speeds_mps;
    let (from, to) = (speeds[0], speeds[speeds.len() - 1]);
    let all = || curve.objectives.iter().flatten().chain(&curve.baseline).flatten();
    let low = all().map(|i| i.low).fold(f64::INFINITY, f64::min);
    let high = all().map(|i| i.high).fold(f64::NEG_INFINITY, f64::max);
    // Room on top for the legend.
    let (low, high) = (low.floor() - 1.0, high.ceil() + 0.35 * (high - low));
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("Objectives under fixed v_m1 ({})", curve.variant), ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(48)
        .y_label_area_size(64)
        .build_cartesian_2d(from - 0.25..to + 0.25, low..high)?;
    axes(&mut chart, ("terminal speed of CZ1, v_m1 (m/s)", 9), "mean objective per vehicle (m²/s³)")?;
    for ((name, color), (values, baseline)) in [("CZ1", BLUE), ("CZ2", ORANGE), ("total", GREEN)]
        .into_iter()
        .zip(curve.objectives.iter().zip(&curve.baseline))
    {
        let points: Vec<(f64, Interval)> =
            speeds.iter().zip(values).filter_map(|(&v, i)| Some((v, (*i)?))).collect();
        let band: Vec<(f64, f64)> = points
            .iter()
            .map(|(v, i)| (*v, i.high))
            .chain(points.iter().rev().map(|(v, i)| (*v, i.low)))
            .collect();
        chart.draw_series([Polygon::new(band, color.mix(0.15))])?;
        let means = points.iter().map(|(v, i)| (*v, i.mean));
        chart
            .draw_series(LineSeries::new(means.clone(), color.stroke_width(2)))?
            .label(format!("{name}, fixed v_m1 (mean, 95 % band)"))
            .legend(move |(x, y)| solid(x, y, color.stroke_width(2)));
        chart.draw_series(means.map(|p| Circle::new(p, 3, color.filled())))?;
        if let Some(b) = baseline {
            let line = [(from, b.mean), (to, b.mean)];
            chart
                .draw_series(DashedLineSeries::new(line, 8, 6, color.stroke_width(2)))?
                .label(format!("{name}, no flow control"))
                .legend(move |(x, y)| dashes(x, y, color));
        }
    }
    if let Some(fit) = &curve.fit {
        let line = (0..=80).map(|i| from + (to - from) * f64::from(i) / 80.0).map(|v| (v, fit.value(v)));
        let minimum = fit.minimum().filter(|v| *v > from && *v < to);
        let label = match minimum {
            Some(v) => format!("quadratic fit, minimum at {v:.1} m/s, R² = {:.2}", fit.r_squared),
            None => format!("quadratic fit, no minimum inside, R² = {:.2}", fit.r_squared),
        };
        chart
            .draw_series(LineSeries::new(line, BLACK.stroke_width(1)))?
            .label(label)
            .legend(|(x, y)| solid(x, y, BLACK.stroke_width(1)));
        chart.draw_series(minimum.map(|v| TriangleMarker::new((v, fit.value(v)), 7, BLACK.filled())))?;
    }
    legend(&mut chart, SeriesLabelPosition::UpperRight)?;
    area.present()
}

fn draw_rate<DB: DrawingBackend>(area: DrawingArea<DB, Shift>, title: &str, curves: &[Curve]) -> Drawn<DB> {
    area.fill(&WHITE)?;
    let values = || curves.iter().flat_map(|c| &c.points).map(|p| p.1);
    let low = values().fold(f64::INFINITY, f64::min);
    let high = values().fold(f64::NEG_INFINITY, f64::max);
    let end = PERIODS[PERIODS.len() - 1].0;
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("Objective over time under varying traffic ({title})"), ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(48)
        .y_label_area_size(64)
        .right_y_label_area_size(64)
        .build_cartesian_2d(0.0..end, low - 0.1 * (high - low)..high + 0.45 * (high - low))?
        .set_secondary_coord(0.0..end, 0.0..700.0);
    axes(&mut chart, ("instant of entry (s)", 11), "objective over both zones (m²/s³), smoothed")?;
    chart
        .configure_secondary_axes()
        .y_desc("traffic rate (veh/h and road)")
        .y_label_formatter(&|v| format!("{v:.0}"))
        .axis_desc_style(AXIS_FONT)
        .label_style(LABEL_FONT)
        .draw()?;
    // Behind the curves, as in the paper.
    let mut steps = Vec::new();
    let mut from = 0.0;
    for (until, rate) in PERIODS {
        steps.extend([(from, rate), (until, rate)]);
        from = until;
    }
    chart
        .draw_secondary_series(DashedLineSeries::new(steps, 8, 6, BLACK.stroke_width(1)))?
        .label("traffic rate (right axis)")
        .legend(|(x, y)| dashes(x, y, BLACK));
    for curve in curves {
        let points = curve.points.iter().copied();
        match curve.policy {
            "none" => chart
                .draw_series(DashedLineSeries::new(points, 8, 5, ORANGE.stroke_width(2)))?
                .label("no flow control")
                .legend(|(x, y)| dashes(x, y, ORANGE)),
            policy => {
                let color = if policy == "feedback" { GREEN } else { BLUE };
                let label = if policy == "feedback" { "feedback on v_m1" } else { "fixed v_m1 = 15 m/s" };
                chart
                    .draw_series(LineSeries::new(points, color.stroke_width(2)))?
                    .label(label)
                    .legend(move |(x, y)| solid(x, y, color.stroke_width(2)))
            }
        };
    }
    legend(&mut chart, SeriesLabelPosition::UpperLeft)?;
    area.present()
}

pub(crate) type Plane = Cartesian2d<RangedCoordf64, RangedCoordf64>;

/// Draws the axes, with whole numbers at about `x_labels` places of the lower one.
fn axes<DB: DrawingBackend>(
    chart: &mut ChartContext<'_, DB, Plane>,
    (x, x_labels): (&str, usize),
    y: &str,
) -> Drawn<DB> {
    chart
        .configure_mesh()
        .x_desc(x)
        .y_desc(y)
        .x_labels(x_labels)
        .x_label_formatter(&|v| format!("{v:.0}"))
        .y_label_formatter(&|v| format!("{v:.0}"))
        .axis_desc_style(AXIS_FONT)
        .label_style(LABEL_FONT)
        .light_line_style(WHITE)
        .draw()
}

/// Draws what the series are called.
pub(crate) fn legend<'a, DB: DrawingBackend + 'a>(
    chart: &mut ChartContext<'a, DB, Plane>,
    position: SeriesLabelPosition,
) -> Drawn<DB> {
    chart
        .configure_series_labels()
        .position(position)
        .legend_area_size(30)
        .background_style(WHITE.mix(0.85))
        .border_style(GREY)
        .label_font(("sans-serif", 13))
        .draw()
}

/// A solid sample for the legend.
fn solid(x: i32, y: i32, style: ShapeStyle) -> PathElement<(i32, i32)> {
    PathElement::new([(x, y), (x + 24, y)], style)
}

/// A dashed sample for the legend.
fn dashes(x: i32, y: i32, color: RGBColor) -> DashedPathElement<std::array::IntoIter<(i32, i32), 2>, i32> {
    DashedPathElement::new([(x, y), (x + 24, y)], 6, 3, color.stroke_width(2))
}
