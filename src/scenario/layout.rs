//! Where vehicles are: on which lane, and where in the plane. Nothing in a run depends on it.
//!
//! A shape need not be as long as its segment; places on it are shares of the length.

use super::network::Network;
use super::shapes::{Place, Shapes};
use ipc_schemas::{NO_ZONE, VehicleState};

/// A place and a direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Where it is.
    pub place: Place,
    /// Direction of travel, rad, counter-clockwise from the x axis.
    pub heading_rad: f64,
}

/// A stretch of a network that is one lane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Lane {
    /// A segment of a zone: both indices.
    Segment {
        /// Index in [`Network::zones`].
        zone: u32,
        /// Index in [`super::Zone::segments`].
        segment: u32,
    },
    /// A plain link, as [`VehicleState::link`] numbers them: those of all exits that have one, zone by zone.
    Link(u32),
}

/// A position on a lane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnLane {
    /// The lane.
    pub lane: Lane,
    /// Distance from its start, m.
    pub at_m: f64,
    /// Length of the lane, m.
    pub length_m: f64,
}

/// A network in the plane.
#[derive(Clone, Debug)]
pub struct Layout {
    shapes: Shapes,
    /// By link: from the end of the exit's lane to the entrance it leads to, with its length, m.
    links: Vec<(Vec<Place>, f64)>,
    /// By zone and path: segments with their lengths, m.
    paths: Vec<Vec<Vec<(u32, f64)>>>,
}

impl Layout {
    /// Lays a network out.
    pub fn of(network: &Network) -> Layout {
        let shapes = Shapes::of(network);
        let mut links = Vec::new();
        for (zone, shape) in (0..).zip(&network.zones) {
            for (at, exit) in (0..).zip(&shape.exits) {
                if let Some(to) = exit.to.filter(|to| to.link_m > 0.0) {
                    let line = shapes.link(network, zone, at).expect("the exit leads somewhere");
                    links.push((line, to.link_m));
                }
            }
        }
        let paths = network.zones.iter().map(|zone| {
            let segments = |path: &super::Path| {
                path.segments.iter().map(|&s| (s, zone.segments[s as usize].length_m)).collect()
            };
            zone.paths.iter().map(segments).collect()
        });
        Layout { paths: paths.collect(), shapes, links }
    }

    /// The shapes of all segments.
    pub fn shapes(&self) -> &Shapes {
        &self.shapes
    }

    /// The polyline of a lane.
    pub fn shape(&self, lane: Lane) -> &[Place] {
        match lane {
            Lane::Segment { zone, segment } => &self.shapes.segments(zone)[segment as usize],
            Lane::Link(link) => &self.links[link as usize].0,
        }
    }

    /// Every lane with its length, m: segments zone by zone, then links.
    pub fn lanes(&self) -> Vec<(Lane, f64)> {
        let mut lanes = Vec::new();
        for (zone, paths) in (0..).zip(&self.paths) {
            let mut segments: Vec<(u32, f64)> = paths.iter().flatten().copied().collect();
            segments.sort_unstable_by_key(|(segment, _)| *segment);
            segments.dedup_by_key(|(segment, _)| *segment);
            lanes.extend(segments.into_iter().map(|(segment, m)| (Lane::Segment { zone, segment }, m)));
        }
        lanes.extend((0..).zip(&self.links).map(|(link, (_, length_m))| (Lane::Link(link), *length_m)));
        lanes
    }

    /// The lane at a distance from a zone's origin on one of its paths; before and behind the path its first and last
    /// lane, at their ends. `None` for a path that does not exist.
    pub fn on_path(&self, zone: u32, path: u32, x_m: f64) -> Option<OnLane> {
        let segments = self.paths.get(zone as usize)?.get(path as usize)?;
        let mut left_m = x_m.max(0.0);
        for (index, &(segment, length_m)) in segments.iter().enumerate() {
            if left_m <= length_m || index + 1 == segments.len() {
                let lane = Lane::Segment { zone, segment };
                return Some(OnLane { lane, at_m: left_m.min(length_m), length_m });
            }
            left_m -= length_m;
        }
        None
    }

    /// Where the front of a vehicle is. `None` where a record names no place of this network.
    pub fn lane_of(&self, state: &VehicleState) -> Option<OnLane> {
        if state.zone != NO_ZONE {
            return self.on_path(state.zone, state.path, state.x_m);
        }
        let length_m = self.links.get(state.link as usize)?.1;
        Some(OnLane { lane: Lane::Link(state.link), at_m: state.x_m.clamp(0.0, length_m), length_m })
    }

    /// The place of a position on a lane.
    pub fn pose(&self, on: OnLane) -> Pose {
        pose_along(self.shape(on.lane), if on.length_m > 0.0 { on.at_m / on.length_m } else { 0.0 })
    }
}

/// The place at a share of a polyline's length, from 0 to 1, and the direction there.
fn pose_along(shape: &[Place], share: f64) -> Pose {
    let length = |pair: &[Place]| (pair[1].0 - pair[0].0).hypot(pair[1].1 - pair[0].1);
    let mut left = share.clamp(0.0, 1.0) * shape.windows(2).map(length).sum::<f64>();
    let mut last = Pose { place: shape[shape.len() - 1], heading_rad: 0.0 };
    for pair in shape.windows(2) {
        let length = length(pair);
        if length == 0.0 {
            continue;
        }
        let (dx, dy) = (pair[1].0 - pair[0].0, pair[1].1 - pair[0].1);
        last.heading_rad = dy.atan2(dx);
        if left <= length {
            let t = left / length;
            return Pose { place: (pair[0].0 + t * dx, pair[0].1 + t * dy), ..last };
        }
        left -= length;
    }
    last
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{Override, load_embedded};

    #[test]
    fn every_place_of_every_path_is_on_its_lane() {
        let none: [Override; 0] = [];
        for name in ["two-merges", "intersection", "roundabout", "corridor-8"] {
            let network = load_embedded(name, &none, None).expect("it is embedded").network;
            let layout = Layout::of(&network);
            let count: usize = network.zones.iter().map(|zone| zone.segments.len()).sum();
            let links =
                network.zones.iter().flat_map(|z| &z.exits).filter_map(|e| e.to).filter(|to| to.link_m > 0.0);
            assert_eq!(layout.lanes().len(), count + links.count(), "{name}");
            for (zone, shape) in (0..).zip(&network.zones) {
                for (index, path) in (0..).zip(&shape.paths) {
                    let mut before: Option<Place> = None;
                    for metre in 0..=path.length_m as u32 {
                        let on = layout.on_path(zone, index, f64::from(metre)).expect("the path exists");
                        assert!(on.at_m <= on.length_m);
                        let place = layout.pose(on).place;
                        if let Some(before) = before {
                            let moved_m = (place.0 - before.0).hypot(place.1 - before.1);
                            assert!(
                                moved_m < 4.0,
                                "{name}: {}.{} jumps {moved_m} m at {metre} m",
                                shape.name,
                                path.name
                            );
                        }
                        before = Some(place);
                    }
                }
            }
        }
    }

    #[test]
    fn headings_follow_the_shape() {
        let shape = [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)];
        let pose = pose_along(&shape, 0.25);
        assert_eq!((pose.place, pose.heading_rad), ((5.0, 0.0), 0.0));
        let pose = pose_along(&shape, 0.75);
        assert_eq!(pose.place, (10.0, 5.0));
        assert!((pose.heading_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!(pose_along(&shape, 2.0).place, (10.0, 10.0));
    }
}
