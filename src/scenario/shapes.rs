//! Where lanes lie in the plane: as the scenario says, or laid out where it does not.

use super::arrange::{ROWS_APART_M, arrange};
use super::{Network, Source, Zone, ZoneId};

/// A place in the plane, m.
pub type Place = (f64, f64);

/// How far apart lanes are laid out that have no shape, m.
const APART_M: f64 = 40.0;
/// A lane without a shape begins to come in at this share of its length.
const COMES_IN: f64 = 0.45;
/// Pieces of the bend with which it does.
const PIECES: u32 = 16;

/// A polyline of every segment of every zone.
#[derive(Clone, Debug)]
pub struct Shapes(Vec<Vec<Vec<Place>>>);

impl Shapes {
    /// The shapes a network's scenario says, or else lanes from left to right, zones one behind the other and side by
    /// side where they do not lie on one way; in rows, where they would be much wider or higher than a page.
    pub fn of(network: &Network) -> Shapes {
        let mut shapes = Shapes(Vec::with_capacity(network.zones.len()));
        let mut free_m = 0.0;
        for zone in &network.zones {
            // Behind the zone upstream that is placed already; otherwise a row of its own.
            let upstream = zone.segments.iter().enumerate().find_map(|(at, segment)| match segment.source {
                Some(Source::Zone { zone, exit }) if (zone as usize) < shapes.0.len() => {
                    let link_m =
                        network.zones[zone as usize].exits[exit as usize].to.map_or(0.0, |to| to.link_m);
                    let end = shapes.exit(network, zone, exit);
                    Some((at, (end.0 + link_m, end.1)))
                }
                _ => None,
            });
            let entrances: Vec<usize> =
                (0..zone.segments.len()).filter(|&s| zone.segments[s].source.is_some()).collect();
            let (first, origin) = upstream.unwrap_or((entrances[0], (0.0, free_m)));
            if upstream.is_none() && zone.segments.iter().all(|s| s.shape.is_empty()) {
                free_m -= APART_M * (entrances.len() as f64 + 1.0);
            }
            let row_of = |segment: usize| entrances.iter().position(|&e| e == segment).unwrap_or(0) as f64;
            let aside_m = |segment: usize| (row_of(segment) - row_of(first)) * -APART_M;
            let placed = (0..zone.segments.len()).map(|at| place(zone, at, origin, aside_m(at)));
            shapes.0.push(placed.collect());
        }
        arrange(network, &mut shapes.0);
        shapes
    }

    /// A zone's segments, each with at least two places.
    pub fn segments(&self, zone: ZoneId) -> &[Vec<Place>] {
        &self.0[zone as usize]
    }

    /// Where an exit is: at the end of the first path that leads to it.
    pub fn exit(&self, network: &Network, zone: ZoneId, exit: u32) -> Place {
        let mut paths = network.zones[zone as usize].paths.iter().filter(|path| path.exit == exit);
        let last = paths.next().and_then(|path| path.segments.last()).expect("an exit ends some path");
        let shape = &self.segments(zone)[*last as usize];
        shape[shape.len() - 1]
    }

    /// From an exit to the entrance it leads to, at least two places; `None` where it leads out of the network.
    pub fn link(&self, network: &Network, zone: ZoneId, exit: u32) -> Option<Vec<Place>> {
        let to = network.zones[zone as usize].exits[exit as usize].to?;
        let (from, end) = (self.exit(network, zone, exit), self.segments(to.zone)[to.segment as usize][0]);
        let is_shaped =
            |zone: ZoneId| network.zones[zone as usize].segments.iter().any(|s| !s.shape.is_empty());
        if end.0 >= from.0 || is_shaped(zone) || is_shaped(to.zone) {
            return Some(vec![from, end]);
        }
        // Back to the beginning of the next row, between the two.
        let (aside_m, between_m) = (0.3 * APART_M, end.1 + 0.5 * ROWS_APART_M);
        let (right, left) = (from.0 + aside_m, end.0 - aside_m);
        Some(vec![from, (right, from.1), (right, between_m), (left, between_m), (left, end.1), end])
    }

    /// The place so far along a path, m.
    pub fn on_path(&self, network: &Network, zone: ZoneId, path: u32, at_m: f64) -> Place {
        let shape = &network.zones[zone as usize];
        let segments = &shape.paths[path as usize].segments;
        let mut left_m = at_m;
        for &segment in segments {
            let length_m = shape.segments[segment as usize].length_m;
            if left_m <= length_m || segments.last() == Some(&segment) {
                return along(&self.segments(zone)[segment as usize], left_m / length_m);
            }
            left_m -= length_m;
        }
        unreachable!("a path has segments")
    }
}

/// The polyline of one segment of a zone whose origin, and whose distance aside of it, are given.
fn place(zone: &Zone, at: usize, origin: Place, aside_m: f64) -> Vec<Place> {
    let segment = &zone.segments[at];
    if !segment.shape.is_empty() {
        return segment.shape.iter().map(|&[x, y]| (x, y)).collect();
    }
    let path =
        zone.paths.iter().find(|p| p.segments.contains(&(at as u32))).expect("a path uses each segment");
    let before = path.segments.iter().take_while(|&&s| s as usize != at);
    let before_m: f64 = before.map(|&s| zone.segments[s as usize].length_m).sum();
    let start = origin.0 + before_m + zone.longest_m() - path.length_m;
    let end = (start + segment.length_m, origin.1);
    if segment.source.is_none() || aside_m == 0.0 {
        return vec![(start, origin.1), end];
    }
    // Beside the others at first, then in to where it ends with them.
    let bend = (0..=PIECES).map(|piece| {
        let t = f64::from(piece) / f64::from(PIECES);
        let along_m = segment.length_m * (COMES_IN + (1.0 - COMES_IN) * t);
        (start + along_m, origin.1 + aside_m * (1.0 - t * t * (3.0 - 2.0 * t)))
    });
    std::iter::once((start, origin.1 + aside_m)).chain(bend).collect()
}

/// The place at a share of a polyline's length.
pub fn along(shape: &[Place], share: f64) -> Place {
    let lengths: Vec<f64> = shape.windows(2).map(|w| (w[1].0 - w[0].0).hypot(w[1].1 - w[0].1)).collect();
    let mut left = share.clamp(0.0, 1.0) * lengths.iter().sum::<f64>();
    for (pair, length) in shape.windows(2).zip(&lengths) {
        if left <= *length && *length > 0.0 {
            let t = left / length;
            return (pair[0].0 + t * (pair[1].0 - pair[0].0), pair[0].1 + t * (pair[1].1 - pair[0].1));
        }
        left -= length;
    }
    shape[shape.len() - 1]
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::{Override, load_embedded};

    #[test]
    fn zones_without_shapes_lie_one_behind_the_other_and_lanes_end_together() {
        let none: [Override; 0] = [];
        let scenario = load_embedded("two-merges", &none, None).unwrap();
        let (network, shapes) = (&scenario.network, Shapes::of(&scenario.network));
        let ends: Vec<Place> = shapes.segments(0).iter().map(|lane| lane[lane.len() - 1]).collect();
        assert_eq!(ends[0], ends[1]);
        let [from, to] = shapes.link(network, 0, 0).unwrap()[..] else { panic!("no straight link") };
        assert_eq!(from, ends[0]);
        assert_eq!(to, from, "no link lies between them");
        assert_eq!(shapes.on_path(network, 0, 0, 0.0), (0.0, 0.0));
        assert_eq!(shapes.link(network, 1, 0), None);
    }

    /// Width and height of what is laid out, and whether no two zones lie on each other.
    fn extent(network: &Network) -> (f64, f64) {
        let shapes = Shapes::of(network);
        let all: Vec<Place> = shapes.0.iter().flatten().flatten().copied().collect();
        let span = |of: fn(&Place) -> f64| {
            let values = || all.iter().map(of);
            values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min)
        };
        let middle = |zone: &Vec<Vec<Place>>| (zone[0][0], zone[0][zone[0].len() - 1]);
        let mut middles: Vec<_> = shapes.0.iter().map(middle).collect();
        middles.sort_by(|a, b| a.partial_cmp(b).unwrap());
        assert!(middles.windows(2).all(|pair| pair[0] != pair[1]), "two zones lie on each other");
        (span(|p| p.0), span(|p| p.1))
    }

    #[test]
    fn what_would_be_a_long_row_or_a_high_column_is_laid_out_in_rows() {
        let none: [Override; 0] = [];
        let (width, height) = extent(&load_embedded("corridor-8", &none, None).unwrap().network);
        assert!((0.7..4.0).contains(&(width / height)), "{width} m by {height} m");
        for vehicles in [100, 1_000, 10_000] {
            let many = crate::bench::side_by_side(crate::bench::Family::Corridors, vehicles, 90.0).unwrap();
            let (width, height) = extent(&many.network);
            assert!((0.7..3.2).contains(&(width / height)), "{vehicles}: {width} m by {height} m");
        }
    }
}
