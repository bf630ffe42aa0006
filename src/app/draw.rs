//! `cz show --network`: a scenario's network as a picture.

use super::AppError;
use crate::conflict::{Conflicts, PointKind};
use crate::scenario::shapes::{Place, Shapes};
use crate::scenario::{Network, Scenario, Source, ZoneId};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::register_font;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::path::Path;

/// Longer side of the picture, pixels.
const SIZE_PX: f64 = 1400.0;
/// Room around it, pixels.
const MARGIN_PX: f64 = 60.0;
const LANE: RGBColor = RGBColor(120, 120, 120);
const ENTRANCE: RGBColor = RGBColor(44, 120, 60);
const EXIT: RGBColor = RGBColor(31, 80, 160);
const MERGE: RGBColor = RGBColor(230, 120, 0);
const CROSSING: RGBColor = RGBColor(170, 30, 90);

/// Writes the picture; the ending of the file decides on SVG or PNG.
pub(super) fn network(scenario: &Scenario, path: &Path) -> Result<(), AppError> {
    let picture = Picture::of(&scenario.network);
    let size = picture.size_px();
    // Fails only on bytes that are no font.
    let _ = register_font("sans-serif", FontStyle::Normal, dejavu::sans::regular());
    let drawn = match path.extension().and_then(|ending| ending.to_str()) {
        Some("svg") => {
            picture.draw(SVGBackend::new(path, size).into_drawing_area()).map_err(|e| e.to_string())
        }
        Some("png") => {
            picture.draw(BitMapBackend::new(path, size).into_drawing_area()).map_err(|e| e.to_string())
        }
        _ => {
            let file = path.display();
            return Err(AppError::Usage(format!("--out {file}: expected a file that ends in .svg or .png")));
        }
    };
    drawn.map_err(|error| AppError::Failed(format!("{}: cannot be drawn: {error}", path.display())))
}

/// What is drawn, in m.
#[derive(Default)]
struct Picture {
    lanes: Vec<(Vec<Place>, RGBColor)>,
    /// Between an exit and the entrance it leads to.
    links: Vec<Vec<Place>>,
    points: Vec<(Place, PointKind, String)>,
    labels: Vec<(Place, String, RGBColor)>,
}

impl Picture {
    fn of(network: &Network) -> Picture {
        let shapes = Shapes::of(network);
        let mut picture = Picture::default();
        for (id, zone) in (0..).zip(&network.zones) {
            let lanes = shapes.segments(id);
            for (segment, shape) in zone.segments.iter().zip(lanes) {
                let color = if segment.source.is_some() { ENTRANCE } else { LANE };
                picture.lanes.push((shape.clone(), color));
                if let Some(Source::Road(road)) = segment.source {
                    picture.labels.push((shape[0], network.roads[road as usize].name.clone(), ENTRANCE));
                }
            }
            for (at, exit) in (0..).zip(&zone.exits) {
                match shapes.link(network, id, at) {
                    Some(link) => picture.links.push(link),
                    None => picture.labels.push((shapes.exit(network, id, at), exit.name.clone(), EXIT)),
                }
            }
            picture.add_points(network, id, &shapes);
            let all: Vec<Place> = lanes.iter().flatten().copied().collect();
            let mean = |of: fn(&Place) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
            picture.labels.push(((mean(|p| p.0), mean(|p| p.1)), zone.name.clone(), BLACK));
        }
        picture
    }

    /// The conflict points of a zone.
    fn add_points(&mut self, network: &Network, zone: ZoneId, shapes: &Shapes) {
        let conflicts = Conflicts::of(network, zone);
        for (at, point) in (0..).zip(conflicts.points()) {
            let Some((path, passes)) = conflicts.first_use(at) else { continue };
            let place = shapes.on_path(network, zone, path, passes.at_m);
            self.points.push((place, point.kind, point.name.clone()));
        }
    }

    fn bounds(&self) -> (Place, Place) {
        let places = || self.lanes.iter().map(|(shape, _)| shape).chain(&self.links).flatten();
        let least = |of: fn(&Place) -> f64| places().map(of).fold(f64::INFINITY, f64::min);
        let most = |of: fn(&Place) -> f64| places().map(of).fold(f64::NEG_INFINITY, f64::max);
        ((least(|p| p.0), least(|p| p.1)), (most(|p| p.0), most(|p| p.1)))
    }

    fn size_px(&self) -> (u32, u32) {
        let (low, high) = self.bounds();
        let (width, height) = ((high.0 - low.0).max(1.0), (high.1 - low.1).max(1.0));
        let scale = SIZE_PX / width.max(height);
        let px = |m: f64| ((m * scale).max(200.0) + 2.0 * MARGIN_PX) as u32;
        (px(width), px(height))
    }

    fn draw<DB: DrawingBackend>(
        &self,
        area: DrawingArea<DB, Shift>,
    ) -> Result<(), DrawingAreaErrorKind<DB::ErrorType>> {
        area.fill(&WHITE)?;
        let (width, height) = area.dim_in_pixel();
        let (low, high) = self.bounds();
        let margin = MARGIN_PX as i32;
        let whole =
            View::new((low, high), (margin, margin), (width as i32 - 2 * margin, height as i32 - 2 * margin));
        // Where conflicts are close together they are shown again, enlarged, in an empty corner.
        let (near, far) = self.points.iter().fold((high, low), |(near, far), (p, ..)| {
            ((near.0.min(p.0), near.1.min(p.1)), (far.0.max(p.0), far.1.max(p.1)))
        });
        let extent = (far.0 - near.0).max(far.1 - near.1);
        let is_crowded = extent > 0.0 && extent < 0.2 * (high.0 - low.0).min(high.1 - low.1);
        self.draw_view(&area, &whole, if is_crowded { Names::Entrances } else { Names::Places })?;
        if is_crowded {
            let room = 0.35 * extent;
            let bounds = ((near.0 - room, near.1 - room), (far.0 + room, far.1 + room));
            let side = (0.42 * f64::from(width.min(height))) as i32;
            let place = (10, height as i32 - side - 10);
            area.draw(&Rectangle::new([place, (place.0 + side, place.1 + side)], WHITE.filled()))?;
            area.draw(&Rectangle::new([place, (place.0 + side, place.1 + side)], LANE.stroke_width(1)))?;
            self.draw_view(&area, &View::new(bounds, place, (side, side)), Names::Points)?;
        }
        self.legend(&area, !is_crowded)?;
        area.present()
    }

    /// What colours mean, of those that are there, in a line above everything else.
    fn legend<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        has_exits: bool,
    ) -> Result<(), DrawingAreaErrorKind<DB::ErrorType>> {
        let has_lane = |wanted: RGBColor| self.lanes.iter().any(|(_, color)| *color == wanted);
        let has_point = |wanted: PointKind| self.points.iter().any(|(_, kind, _)| *kind == wanted);
        let entries = [
            ("entrance", ENTRANCE, has_lane(ENTRANCE)),
            ("lane", LANE, has_lane(LANE)),
            ("merge", MERGE, has_point(PointKind::Merge)),
            ("crossing", CROSSING, has_point(PointKind::Crossing)),
            ("exit", EXIT, has_exits),
        ];
        let mut x = 12;
        for (name, color, _) in entries.iter().filter(|(.., is_there)| *is_there) {
            area.draw(&Rectangle::new([(x, 10), (x + 12, 18)], color.filled()))?;
            let style = ("sans-serif", 14).into_font().color(&BLACK).pos(Pos::new(HPos::Left, VPos::Center));
            area.draw(&Text::new(*name, (x + 18, 14), style))?;
            x += 18 + width_px(name) + 16;
        }
        Ok(())
    }

    fn draw_view<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        view: &View,
        names: Names,
    ) -> Result<(), DrawingAreaErrorKind<DB::ErrorType>> {
        // What names keep clear of.
        let mut drawn: Vec<(i32, i32)> = Vec::new();
        for piece in self.links.iter().flat_map(|link| link.windows(2)) {
            if let Some(line) = view.line(piece[0], piece[1]) {
                drawn.extend(dotted(&line));
                area.draw(&PathElement::new(line.to_vec(), LANE.mix(0.4).stroke_width(2)))?;
            }
        }
        for (shape, color) in &self.lanes {
            let lines: Vec<[(i32, i32); 2]> =
                shape.windows(2).filter_map(|w| view.line(w[0], w[1])).collect();
            for line in &lines {
                drawn.extend(dotted(line));
                area.draw(&PathElement::new(line.to_vec(), color.stroke_width(3)))?;
            }
            if let Some(line) = lines.get(lines.len() / 2) {
                area.draw(&Polygon::new(arrow(line), color.filled()))?;
            }
        }
        let mut labels: Vec<(Place, &String, RGBColor)> = Vec::new();
        for (place, kind, name) in self.points.iter().filter(|(place, ..)| view.holds(*place)) {
            let color = if *kind == PointKind::Merge { MERGE } else { CROSSING };
            area.draw(&Circle::new(view.px(*place), 5, color.filled()))?;
            let (x, y) = view.px(*place);
            // Three rows of three: a point is worth more than a lane.
            drawn.extend((0..9).map(|i| (x + 4 * (i % 3 - 1), y + 4 * (i / 3 - 1))));
            if names == Names::Points && self.points.len() <= 30 {
                labels.push((*place, name, color));
            }
        }
        let shown =
            |color: RGBColor| names == Names::Places || names == Names::Entrances && color == ENTRANCE;
        labels.extend(self.labels.iter().filter(|(.., c)| shown(*c)).map(|(p, name, c)| (*p, name, *c)));
        let (width, height) = area.dim_in_pixel();
        let mut taken: Vec<Label> = Vec::new();
        for (place, name, color) in labels {
            let label = Label::beside(view.px(place), name, (width as i32, height as i32), &taken, &drawn);
            let style =
                ("sans-serif", 14).into_font().color(&color).pos(Pos::new(HPos::Center, VPos::Center));
            area.draw(&Text::new(name.clone(), (label.x, label.y), style))?;
            taken.push(label);
        }
        Ok(())
    }
}

/// What is named in a view.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Names {
    /// Entrances, exits and zones.
    Places,
    /// Entrances; the rest is too close together.
    Entrances,
    /// Conflict points.
    Points,
}

/// Width of a text of the pictures' size, about, pixels.
fn width_px(text: &str) -> i32 {
    text.chars().count() as i32 * 8
}

/// Places along a line, a few pixels from each other.
fn dotted([(x0, y0), (x1, y1)]: &[(i32, i32); 2]) -> impl Iterator<Item = (i32, i32)> + use<> {
    let (x0, y0, dx, dy) = (*x0, *y0, x1 - x0, y1 - y0);
    let count = (dx.abs().max(dy.abs()) / 5).max(1);
    (0..=count).map(move |i| (x0 + dx * i / count, y0 + dy * i / count))
}

/// A text with its middle there, pixels.
struct Label {
    x: i32,
    y: i32,
    half_width: i32,
}

/// Half the height of a line of text with what is left free around it, pixels.
const HALF_LINE_PX: i32 = 9;

impl Label {
    /// A name beside a place: where the least is covered, above if that is as good.
    fn beside(
        (x, y): (i32, i32),
        name: &str,
        (width, height): (i32, i32),
        taken: &[Label],
        drawn: &[(i32, i32)],
    ) -> Label {
        let half_width = width_px(name) / 2 + 2;
        let near = [1, 2, 3].into_iter().flat_map(|far| {
            let (up, aside) = (14 * far, half_width + 8 * far);
            [
                (0, -up),
                (0, up),
                (aside, 0),
                (-aside, 0),
                (aside, -up),
                (-aside, -up),
                (aside, up),
                (-aside, up),
            ]
            .map(|(dx, dy)| (x + dx, y + dy, far))
        });
        let inside = |(x, y, far): (i32, i32, i32)| {
            let x = x.clamp(half_width + 2, (width - half_width - 2).max(half_width + 2));
            (x, y.clamp(30 + HALF_LINE_PX, height - HALF_LINE_PX), far)
        };
        let cost = |&(x, y, far): &(i32, i32, i32)| {
            let covers = |px: i32, py: i32, room: i32| {
                (px - x).abs() < half_width + room && (py - y).abs() < HALF_LINE_PX
            };
            let lanes = drawn.iter().filter(|(px, py)| covers(*px, *py, 2)).count() as i32;
            let overlaps = |other: &&Label| {
                (other.x - x).abs() < half_width + other.half_width
                    && (other.y - y).abs() < 2 * HALF_LINE_PX - 2
            };
            3 * lanes + 100 * taken.iter().filter(overlaps).count() as i32 + 2 * far
        };
        let best = near.map(inside).min_by_key(cost).unwrap_or((x, y, 0));
        Label { x: best.0, y: best.1, half_width }
    }
}

/// A part of the plane, and where it is drawn.
struct View {
    low: Place,
    high: Place,
    /// Upper left corner, and height, pixels.
    corner: (i32, i32),
    height: f64,
    scale: f64,
}

impl View {
    fn new((low, high): (Place, Place), corner: (i32, i32), (width, height): (i32, i32)) -> View {
        let scale_x = f64::from(width) / (high.0 - low.0).max(1.0);
        let scale_y = f64::from(height) / (high.1 - low.1).max(1.0);
        View { low, high, corner, height: f64::from(height), scale: scale_x.min(scale_y) }
    }

    fn px(&self, p: Place) -> (i32, i32) {
        let x = (p.0 - self.low.0) * self.scale;
        let y = self.height - (p.1 - self.low.1) * self.scale;
        (self.corner.0 + x as i32, self.corner.1 + y as i32)
    }

    fn holds(&self, p: Place) -> bool {
        (self.low.0..=self.high.0).contains(&p.0) && (self.low.1..=self.high.1).contains(&p.1)
    }

    /// The part of a line that is inside.
    fn line(&self, from: Place, to: Place) -> Option<[(i32, i32); 2]> {
        let (mut t0, mut t1) = (0.0_f64, 1.0_f64);
        for (start, delta, low, high) in [
            (from.0, to.0 - from.0, self.low.0, self.high.0),
            (from.1, to.1 - from.1, self.low.1, self.high.1),
        ] {
            if delta == 0.0 {
                if start < low || start > high {
                    return None;
                }
                continue;
            }
            let (a, b) = ((low - start) / delta, (high - start) / delta);
            t0 = t0.max(a.min(b));
            t1 = t1.min(a.max(b));
        }
        let at = |t: f64| self.px((from.0 + t * (to.0 - from.0), from.1 + t * (to.1 - from.1)));
        (t0 <= t1).then(|| [at(t0), at(t1)])
    }
}

/// A small arrow in the middle of a line, in the direction of travel.
fn arrow([(x0, y0), (x1, y1)]: &[(i32, i32); 2]) -> Vec<(i32, i32)> {
    let (dx, dy) = (f64::from(x1 - x0), f64::from(y1 - y0));
    let length = dx.hypot(dy).max(1e-9);
    let (ux, uy) = (dx / length, dy / length);
    let middle = (f64::from(x0 + x1) / 2.0, f64::from(y0 + y1) / 2.0);
    let place = |along: f64, aside: f64| {
        let x = middle.0 + along * ux - aside * uy;
        let y = middle.1 + along * uy + aside * ux;
        (x as i32, y as i32)
    };
    if length < 14.0 {
        vec![place(0.0, 0.0)]
    } else {
        vec![place(7.0, 0.0), place(-5.0, 5.0), place(-5.0, -5.0)]
    }
}
