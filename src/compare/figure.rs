//! Time against energy: what a policy buys with what.

use super::measure::{ENERGY, TIME};
use super::report::Block;
use crate::reproduce::ReproduceError;
use crate::reproduce::figures::{AXIS_FONT, COLOURS, Drawn, LABEL_FONT, both_formats, legend};
use crate::reproduce::statistics::Interval;
use plotters::coord::Shift;
use plotters::prelude::*;
use std::path::Path;

/// Lower end, mean, upper end.
type Ends = (f64, f64, f64);

/// A policy's place.
struct Place<'a> {
    name: &'a str,
    time_s: Ends,
    energy: Ends,
}

impl Place<'_> {
    /// Whether somebody is better in one and not worse in the other.
    fn is_dominated(&self, all: &[Place<'_>]) -> bool {
        let (t, e) = (self.time_s.1, self.energy.1);
        all.iter().any(|o| o.time_s.1 <= t && o.energy.1 <= e && (o.time_s.1 < t || o.energy.1 < e))
    }
}

/// Draws mean time against mean energy per vehicle with 95 % bars, and joins those that nobody dominates.
pub fn pareto(directory: &Path, name: &str, block: &Block) -> Result<(), ReproduceError> {
    let place = |p: &'_ super::report::PolicyResult| -> Option<(Ends, Ends)> {
        let ends = |id: &str| {
            let pooled = &p.measures[id];
            let mean = pooled.pooled?;
            Some(pooled.interval.map_or((mean, mean, mean), |i: Interval| (i.low, i.mean, i.high)))
        };
        Some((ends(TIME.id)?, ends(ENERGY.id)?))
    };
    let places: Vec<Place<'_>> = block
        .policies
        .iter()
        .filter_map(|p| place(p).map(|(time_s, energy)| Place { name: &p.name, time_s, energy }))
        .collect();
    if places.is_empty() {
        return Ok(());
    }
    both_formats!(directory, name, |area| draw(area, &block.scenario, &places))
}

fn draw<DB: DrawingBackend>(area: DrawingArea<DB, Shift>, scenario: &str, places: &[Place<'_>]) -> Drawn<DB> {
    area.fill(&WHITE)?;
    let range = |of: fn(&Place<'_>) -> Ends, room: f64| {
        let low = places.iter().map(|p| of(p).0).fold(f64::INFINITY, f64::min);
        let high = places.iter().map(|p| of(p).2).fold(f64::NEG_INFINITY, f64::max);
        let margin = 0.06 * (high - low).max(1e-3);
        low - margin..high + margin + room * (high - low).max(1e-3)
    };
    let (times, energies) = (range(|p| p.time_s, 0.35), range(|p| p.energy, 0.1));
    // Ten ticks or so that differ.
    let decimals = |range: &std::ops::Range<f64>| if range.end - range.start < 1.0 { 2 } else { 1 };
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("Time and energy per vehicle ({scenario})"), ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(48)
        .y_label_area_size(64)
        .build_cartesian_2d(times.clone(), energies.clone())?;
    chart
        .configure_mesh()
        .x_desc("time per vehicle, with waits outside (s)")
        .y_desc("energy per vehicle (m²/s³)")
        .x_label_formatter(&|v| format!("{v:.*}", decimals(&times)))
        .y_label_formatter(&|v| format!("{v:.*}", decimals(&energies)))
        .axis_desc_style(AXIS_FONT)
        .label_style(LABEL_FONT)
        .light_line_style(WHITE)
        .draw()?;
    let mut front: Vec<(f64, f64)> =
        places.iter().filter(|p| !p.is_dominated(places)).map(|p| (p.time_s.1, p.energy.1)).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    chart.draw_series(DashedLineSeries::new(front, 6, 4, BLACK.stroke_width(1)))?;
    for (at, place) in places.iter().enumerate() {
        let colour = COLOURS[at % COLOURS.len()];
        let (t, e) = (place.time_s, place.energy);
        let bars = [[(t.0, e.1), (t.2, e.1)], [(t.1, e.0), (t.1, e.2)]];
        chart.draw_series(bars.map(|bar| PathElement::new(bar.to_vec(), colour.stroke_width(1))))?;
        chart
            .draw_series([Circle::new((t.1, e.1), 5, colour.filled())])?
            .label(place.name)
            .legend(move |(x, y)| Circle::new((x + 12, y), 5, colour.filled()));
    }
    legend(&mut chart, SeriesLabelPosition::UpperRight)?;
    area.present()
}
