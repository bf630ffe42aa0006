//! Networks without shapes, in rows: as wide beside their height as a page or a screen is, or nearly.

use super::Network;
use super::shapes::Place;

/// Width by height that is aimed at.
const ASPECT: f64 = 1.6;
/// Room between rows, and between networks side by side, m.
const APART_M: Place = (80.0, ROWS_APART_M);
/// Room between two rows, m.
pub(super) const ROWS_APART_M: f64 = 70.0;
/// Zones one behind the other are broken into rows only where they come to this many: two or three merges are seen
/// well as they lie.
const FEWEST_ROWS: f64 = 3.0;

/// What is laid out of a zone: its lanes.
type Lanes = [Vec<Place>];

/// A network of zones that are linked, or a row of one.
struct Block {
    zones: Vec<usize>,
    low: Place,
    high: Place,
}

impl Block {
    fn of(zones: Vec<usize>, shapes: &[Vec<Vec<Place>>]) -> Block {
        let (mut low, mut high) = ((f64::INFINITY, f64::INFINITY), (f64::NEG_INFINITY, f64::NEG_INFINITY));
        for &(x, y) in zones.iter().flat_map(|&zone| shapes[zone].iter().flatten()) {
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x), high.1.max(y));
        }
        Block { zones, low, high }
    }

    fn width(&self) -> f64 {
        self.high.0 - self.low.0
    }

    fn height(&self) -> f64 {
        self.high.1 - self.low.1
    }
}

/// Moves what is linked as a whole: long ways are broken into rows, and networks beside each other fill rows from left
/// to right. What the scenario has shaped stays where it is.
pub(super) fn arrange(network: &Network, shapes: &mut [Vec<Vec<Place>>]) {
    let mut blocks = Vec::new();
    for zones in linked(network) {
        let is_shaped = |&zone: &usize| network.zones[zone].segments.iter().any(|s| !s.shape.is_empty());
        if zones.iter().any(is_shaped) {
            return;
        }
        wrap(&zones, shapes);
        blocks.push(Block::of(zones, shapes));
    }
    if blocks.len() < 2 {
        return;
    }
    let widest = blocks.iter().map(Block::width).fold(0.0, f64::max) + APART_M.0;
    let highest = blocks.iter().map(Block::height).fold(0.0, f64::max) + APART_M.1;
    let columns = (ASPECT * highest * blocks.len() as f64 / widest).sqrt().round().max(1.0) as usize;
    let mut top = 0.0;
    for row in blocks.chunks(columns) {
        for (column, block) in row.iter().enumerate() {
            let left = column as f64 * widest;
            shift(&block.zones, shapes, (left - block.low.0, top - block.high.1));
        }
        top -= row.iter().map(Block::height).fold(0.0, f64::max) + APART_M.1;
    }
}

/// Zones that are linked, directly or by others; each group ascending, groups by their first zone.
fn linked(network: &Network) -> Vec<Vec<usize>> {
    fn root(of: &mut [usize], mut zone: usize) -> usize {
        while of[zone] != zone {
            of[zone] = of[of[zone]];
            zone = of[zone];
        }
        zone
    }
    let mut of: Vec<usize> = (0..network.zones.len()).collect();
    for (zone, shape) in network.zones.iter().enumerate() {
        for to in shape.exits.iter().filter_map(|exit| exit.to) {
            let (a, b) = (root(&mut of, zone), root(&mut of, to.zone as usize));
            of[a.max(b)] = a.min(b);
        }
    }
    let mut groups: Vec<Vec<usize>> = vec![Vec::new(); of.len()];
    for zone in 0..of.len() {
        let first = root(&mut of, zone);
        groups[first].push(zone);
    }
    groups.retain(|group| !group.is_empty());
    groups
}

/// Breaks zones that lie one behind the other into rows, where there are many.
fn wrap(zones: &[usize], shapes: &mut [Vec<Vec<Place>>]) {
    let whole = Block::of(zones.to_vec(), shapes);
    let row_m = whole.height() + APART_M.1;
    let rows = (whole.width() / (ASPECT * row_m)).sqrt().round();
    if rows < FEWEST_ROWS {
        return;
    }
    let end_of = |lanes: &Lanes, most: bool| {
        let xs = lanes.iter().flatten().map(|p| p.0);
        if most { xs.fold(f64::NEG_INFINITY, f64::max) } else { xs.fold(f64::INFINITY, f64::min) }
    };
    let mut spans: Vec<(f64, f64, usize)> =
        zones.iter().map(|&zone| (end_of(&shapes[zone], false), end_of(&shapes[zone], true), zone)).collect();
    spans.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut row: Vec<usize> = Vec::new();
    let (mut begin, mut reach, mut number) = (whole.low.0, f64::NEG_INFINITY, 0.0);
    for (from, to, zone) in spans {
        // A row ends only where no zone lies on both sides.
        let is_full = to - begin > whole.width() / rows * 1.01;
        if is_full && from >= reach - 1e-6 && !row.is_empty() {
            shift(&row, shapes, (whole.low.0 - begin, -number * row_m));
            row.clear();
            (begin, number) = (from, number + 1.0);
        }
        reach = reach.max(to);
        row.push(zone);
    }
    shift(&row, shapes, (whole.low.0 - begin, -number * row_m));
}

fn shift(zones: &[usize], shapes: &mut [Vec<Vec<Place>>], (dx, dy): Place) {
    for &zone in zones {
        for place in shapes[zone].iter_mut().flatten() {
            *place = (place.0 + dx, place.1 + dy);
        }
    }
}
