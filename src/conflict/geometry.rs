//! Where the paths of a zone conflict.

use crate::scenario::{ConflictArea, Crossing, Network, Path, Zone, ZoneId};

/// Conflict points on a path nearer to each other than this are in one box, m: between two that are further apart
/// there is room for the longest vehicles.
const BOX_M: f64 = 25.0;

/// What happens at a conflict point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PointKind {
    /// Paths come together and go on as one.
    Merge,
    /// Paths cross and part again.
    Crossing,
}

/// A conflict point of a zone.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// What happens there.
    pub kind: PointKind,
    /// Name of the crossing, or of the segment or exit that paths merge into.
    pub name: String,
}

/// A path's passage of a conflict point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Use {
    /// Index in [`Conflicts::points`].
    pub point: u32,
    /// Distance from the zone's origin on this path, m (the literature's L_k).
    pub at_m: f64,
    /// Extent of the conflict area along the path, m; 0 at a merge.
    pub area_m: f64,
    /// Where the box begins that the point is in, m: the points that follow one another so closely that who stands between
    /// two of them may stand in others' way, and what is to be kept clear before them.
    pub box_m: f64,
    /// Where the first of these points is, m.
    pub first_m: f64,
    /// Lane on which the path passes it: paths that pass it on one lane follow each other there.
    lane: u32,
}

/// A stretch that two paths have in common.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Run {
    /// Where it begins on the path, m.
    pub from_m: f64,
    /// Where it ends on the path, m; infinite when it goes on behind a common exit.
    pub to_m: f64,
    /// Where it begins on the other path, m.
    pub other_from_m: f64,
}

/// The conflicts of one zone.
#[derive(Clone, Debug)]
pub struct Conflicts {
    points: Vec<Point>,
    paths: Vec<PathConflicts>,
    exits: Vec<Onward>,
    goes_on_together: bool,
}

#[derive(Clone, Debug)]
struct PathConflicts {
    length_m: f64,
    exit: u32,
    last_segment: u32,
    /// Where it first meets paths of other entrances, m; infinite when it does not.
    meets_from_m: f64,
    /// Whether it ends on a lane on which paths of other exits drive too.
    ends_among_others: bool,
    /// Ascending by place.
    uses: Vec<Use>,
    /// Stretches of segments shared with other paths, by path.
    shared: Vec<(u32, Run)>,
}

/// Where what is to be kept clear begins that a place on a path is in, or at the end of, m; the place itself where it is in
/// nothing of the kind.
fn kept_clear_from_m(zone: &Zone, path: &Path, at_m: f64) -> f64 {
    let (mut from_m, mut kept_m) = (0.0, None);
    for segment in path.segments.iter().map(|&s| &zone.segments[s as usize]) {
        if from_m >= at_m {
            break;
        }
        kept_m = kept_m.filter(|_| segment.keep_clear).or(segment.keep_clear.then_some(from_m));
        from_m += segment.length_m;
    }
    kept_m.unwrap_or(at_m)
}

/// Whether a crossing is where ways part: it begins where its segments do, behind one and the same. Who has passed that is
/// near the other way still, and counts as ahead of those on it for so long.
fn is_divergence(zone: &Zone, crossing: &Crossing) -> bool {
    let mut before = crossing.places.iter().flat_map(|&ConflictArea { segment, from_m, .. }| {
        zone.paths.iter().filter_map(move |path| {
            let at = path.segments.iter().position(|&s| s == segment)?;
            Some(at.checked_sub(1).filter(|_| from_m == 0.0).map(|at| path.segments[at]))
        })
    });
    let first = before.next().flatten();
    first.is_some() && before.all(|segment| segment == first)
}

/// What is behind an exit.
#[derive(Clone, Debug, Default)]
struct Onward {
    link_m: f64,
    /// By path of the zone there: its segments and their lengths, m. Empty for paths of other entrances.
    paths: Vec<Vec<(u32, f64)>>,
}

impl Conflicts {
    /// The conflicts of all zones of a network.
    pub fn of_all(network: &Network) -> Vec<Conflicts> {
        (0..network.zones.len() as ZoneId).map(|zone| Conflicts::of(network, zone)).collect()
    }

    /// The conflicts of a zone.
    pub fn of(network: &Network, zone: ZoneId) -> Conflicts {
        let zone = &network.zones[zone as usize];
        let paths = zone.paths.iter().map(|path| PathConflicts {
            length_m: path.length_m,
            exit: path.exit,
            last_segment: *path.segments.last().expect("a path has segments"),
            meets_from_m: f64::INFINITY,
            ends_among_others: false,
            uses: Vec::new(),
            shared: Vec::new(),
        });
        let mut conflicts = Conflicts {
            points: Vec::new(),
            paths: paths.collect(),
            exits: Vec::new(),
            goes_on_together: false,
        };
        conflicts.exits = zone
            .exits
            .iter()
            .map(|exit| {
                exit.to.map_or_else(Onward::default, |to| {
                    let there = &network.zones[to.zone as usize];
                    let segments = |path: &Path| {
                        let own = path.segments.iter().map(|&s| (s, there.segments[s as usize].length_m));
                        if path.segments[0] == to.segment { own.collect() } else { Vec::new() }
                    };
                    Onward { link_m: to.link_m, paths: there.paths.iter().map(segments).collect() }
                })
            })
            .collect();
        conflicts.find_merges(zone);
        conflicts.find_crossings(zone);
        conflicts.find_shared(zone);
        for (own, shape) in zone.paths.iter().enumerate() {
            let path = &conflicts.paths[own];
            let ends_with = |(with, run): &(u32, Run)| {
                run.to_m == path.length_m && zone.paths[*with as usize].exit != shape.exit
            };
            conflicts.paths[own].ends_among_others = path.shared.iter().any(ends_with);
        }
        let is_one_way = |exit: &Onward| exit.paths.iter().filter(|path| !path.is_empty()).count() <= 1;
        let mut shared = conflicts.paths.iter().flat_map(|path| &path.shared);
        conflicts.goes_on_together = conflicts.exits.len() == 1
            && conflicts.exits.iter().all(is_one_way)
            && shared.all(|(_, run)| run.to_m == f64::INFINITY);
        for (path, shape) in conflicts.paths.iter_mut().zip(&zone.paths) {
            path.uses.sort_by(|a, b| a.at_m.total_cmp(&b.at_m));
            path.meets_from_m = path.uses.first().map_or(f64::INFINITY, |first| first.at_m);
            path.uses.iter_mut().for_each(|u| u.box_m = kept_clear_from_m(zone, shape, u.at_m));
            for at in 1..path.uses.len() {
                let before = path.uses[at - 1];
                if path.uses[at].at_m - before.at_m < BOX_M {
                    path.uses[at].first_m = before.first_m;
                    path.uses[at].box_m = path.uses[at].box_m.min(before.box_m);
                }
            }
        }
        conflicts
    }

    /// The conflict points.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// The conflict points on a path, in order.
    pub fn uses(&self, path: u32) -> &[Use] {
        &self.paths[path as usize].uses
    }

    /// The first path that passes a conflict point, and its passage.
    pub fn first_use(&self, point: u32) -> Option<(u32, &Use)> {
        (0..)
            .zip(&self.paths)
            .find_map(|(path, own)| own.uses.iter().find(|u| u.point == point).map(|u| (path, u)))
    }

    /// Length of a path, m.
    pub fn length_m(&self, path: u32) -> f64 {
        self.paths[path as usize].length_m
    }

    /// The exit a path leads to.
    pub fn exit(&self, path: u32) -> u32 {
        self.paths[path as usize].exit
    }

    /// Whether vehicles that are on one lane stay on one lane, to the zone's exit and through the next zone.
    pub fn goes_on_together(&self) -> bool {
        self.goes_on_together
    }

    /// Where a path first meets others than those of its own lane, m; infinite when it does not.
    pub fn meets_from_m(&self, path: u32) -> f64 {
        self.paths[path as usize].meets_from_m
    }

    /// How far behind a path's end a vehicle of this length still stands in a conflict area of the zone or on a lane of
    /// paths to other exits, or may count there for one that keeps `reach_m` at most, m; 0 or less when neither is
    /// near the end.
    pub fn clears_behind_m(&self, path: u32, length_m: f64, reach_m: f64) -> f64 {
        let path = &self.paths[path as usize];
        let crossings =
            path.uses.iter().filter(|u| self.points[u.point as usize].kind == PointKind::Crossing);
        let clears = crossings.map(|u| u.at_m + u.area_m + length_m + reach_m);
        let behind_m = clears.fold(f64::NEG_INFINITY, f64::max) - path.length_m;
        if path.ends_among_others { behind_m.max(length_m) } else { behind_m }
    }

    fn find_merges(&mut self, zone: &Zone) {
        // Where a segment begins to which paths come over different ones.
        for (segment, shape) in (0..).zip(&zone.segments) {
            let before = |path: &Path| {
                let at = path.segments.iter().position(|&s| s == segment)?;
                Some(path.segments[at.checked_sub(1)?])
            };
            let first = zone.paths.iter().find_map(before);
            if zone.paths.iter().filter_map(before).all(|s| Some(s) == first) {
                continue;
            }
            let point = self.point(PointKind::Merge, &shape.name);
            for (path, own) in zone.paths.iter().zip(&mut self.paths) {
                let Some(at) = path.segments.iter().position(|&s| s == segment) else { continue };
                let at_m = path.segments[..at].iter().map(|&s| zone.segments[s as usize].length_m).sum();
                own.uses.push(Use::new(point, at_m, 0.0, path.segments[at - 1]));
            }
        }
        // Where paths end that leave by one exit and have not come together before.
        for (exit, shape) in (0..).zip(&zone.exits) {
            let mut leaving = self.paths.iter().filter(|path| path.exit == exit);
            let first = leaving.next().map(|path| path.last_segment);
            if leaving.all(|path| Some(path.last_segment) == first) {
                continue;
            }
            let point = self.point(PointKind::Merge, &shape.name);
            for own in self.paths.iter_mut().filter(|path| path.exit == exit) {
                own.uses.push(Use::new(point, own.length_m, 0.0, own.last_segment));
            }
        }
    }

    fn find_crossings(&mut self, zone: &Zone) {
        for crossing in zone.crossings.iter().filter(|crossing| !is_divergence(zone, crossing)) {
            let point = self.point(PointKind::Crossing, &crossing.name);
            for &ConflictArea { segment, from_m, length_m } in &crossing.places {
                for (path, own) in zone.paths.iter().zip(&mut self.paths) {
                    let Some(at) = path.segments.iter().position(|&s| s == segment) else { continue };
                    let before_m: f64 =
                        path.segments[..at].iter().map(|&s| zone.segments[s as usize].length_m).sum();
                    own.uses.push(Use::new(point, before_m + from_m, length_m, segment));
                }
            }
        }
    }

    fn find_shared(&mut self, zone: &Zone) {
        let mut by_segment: Vec<Vec<u32>> = vec![Vec::new(); zone.segments.len()];
        for (index, path) in (0..).zip(&zone.paths) {
            path.segments.iter().for_each(|&s| by_segment[s as usize].push(index));
        }
        let starts = |path: &Path| {
            path.segments
                .iter()
                .scan(0.0, |at, &s| {
                    let start = *at;
                    *at += zone.segments[s as usize].length_m;
                    Some(start)
                })
                .collect::<Vec<f64>>()
        };
        let all_starts: Vec<Vec<f64>> = zone.paths.iter().map(starts).collect();
        let divergences: Vec<&Crossing> =
            zone.crossings.iter().filter(|crossing| is_divergence(zone, crossing)).collect();
        let near_m = |own: u32, theirs: Option<&u32>| {
            let mut both = divergences.iter().filter_map(|d| {
                let (own, _) = d.area_on(own).zip(d.area_on(*theirs?))?;
                Some(own.length_m)
            });
            both.next().unwrap_or(0.0)
        };
        for (index, path) in zone.paths.iter().enumerate() {
            let mut others: Vec<u32> =
                path.segments.iter().flat_map(|&s| by_segment[s as usize].iter().copied()).collect();
            others.sort_unstable();
            others.dedup();
            for other in others.into_iter().filter(|&other| other as usize != index) {
                let theirs = &zone.paths[other as usize];
                let mut at = 0;
                while at < path.segments.len() {
                    let Some(place) = theirs.segments.iter().position(|s| *s == path.segments[at]) else {
                        at += 1;
                        continue;
                    };
                    let same = path.segments[at..].iter().zip(&theirs.segments[place..]);
                    let count = same.take_while(|(a, b)| a == b).count();
                    let from_m = all_starts[index][at];
                    let (end, their_end) = (at + count, place + count);
                    let goes_on = end == path.segments.len()
                        && their_end == theirs.segments.len()
                        && path.exit == theirs.exit;
                    let to_m = match all_starts[index].get(end) {
                        Some(&start) => start + near_m(path.segments[end], theirs.segments.get(their_end)),
                        None if goes_on => f64::INFINITY,
                        None => path.length_m,
                    };
                    let run = Run { from_m, to_m, other_from_m: all_starts[other as usize][place] };
                    self.paths[index].shared.push((other, run));
                    at = end;
                }
            }
        }
    }

    fn point(&mut self, kind: PointKind, name: &str) -> u32 {
        self.points.push(Point { kind, name: name.to_owned() });
        self.points.len() as u32 - 1
    }

    /// The stretches that a vehicle on `path`, going on to `next_path` of the zone behind the exit, shares with
    /// one on `other`, going on to `other_next`.
    pub fn runs(
        &self,
        (path, next_path): (u32, u32),
        (other, other_next): (u32, u32),
        mut with: impl FnMut(Run),
    ) {
        let (own, theirs) = (&self.paths[path as usize], &self.paths[other as usize]);
        let mut emit = |run: Run| {
            let to_m =
                if run.to_m == f64::INFINITY { self.parts_m(own, next_path, other_next) } else { run.to_m };
            with(Run { to_m, ..run });
        };
        if path == other {
            return emit(Run { from_m: 0.0, to_m: f64::INFINITY, other_from_m: 0.0 });
        }
        let from = own.shared.partition_point(|(with, _)| *with < other);
        for (_, run) in own.shared[from..].iter().take_while(|(with, _)| *with == other) {
            emit(*run);
        }
        if own.exit == theirs.exit && own.last_segment != theirs.last_segment {
            let (from_m, other_from_m) = (own.length_m, theirs.length_m);
            emit(Run { from_m, to_m: f64::INFINITY, other_from_m });
        }
    }

    /// Where two vehicles that leave by one exit part, m on the path; infinite when they do not.
    fn parts_m(&self, path: &PathConflicts, next: u32, other_next: u32) -> f64 {
        if next == other_next {
            return f64::INFINITY;
        }
        let onward = &self.exits[path.exit as usize];
        let (Some(a), Some(b)) = (onward.paths.get(next as usize), onward.paths.get(other_next as usize))
        else {
            return f64::INFINITY;
        };
        let common_m: f64 = a.iter().zip(b).take_while(|(a, b)| a.0 == b.0).map(|(a, _)| a.1).sum();
        path.length_m + onward.link_m + common_m
    }
}

impl Use {
    /// A passage in a box of its own.
    fn new(point: u32, at_m: f64, area_m: f64, lane: u32) -> Use {
        Use { point, at_m, area_m, box_m: at_m, first_m: at_m, lane }
    }

    /// The lane on which the path passes the point.
    pub(super) fn lane(&self) -> u32 {
        self.lane
    }

    /// Whether two paths pass the point on one lane, so that their vehicles follow each other there.
    pub fn on_lane_of(&self, other: &Use) -> bool {
        self.lane == other.lane
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_given;

    /// A lane from which ways part, and one that meets both.
    fn conflicts(segments: &str, crossings: &str) -> Conflicts {
        let text = format!(
            "name = \"parting\"\nseed = 1\ndt_s = 0.1\nobjective = {{ beta = 1 }}\n[end]\ntime_s = 9\n[vehicle]\nu_min_mps2 = -4\n\
             u_max_mps2 = 4\nv_max_mps = 20\nlength_m = 4.5\nreaction_time_s = 1\nstandstill_gap_m = 0\n\
             [[zones]]\nname = \"zone\"\nsegments = [\n{{ name = \"in\", length_m = 100, road = \"road\" }},\n\
             {{ name = \"other\", length_m = 50, road = \"side\" }},\n{{ name = \"on\", length_m = 20 }},\n{segments}\n]\npaths = [\n\
             {{ name = \"l\", segments = [\"in\", \"left\"], exit = \"l\" }},\n\
             {{ name = \"r\", segments = [\"in\", \"right\"], exit = \"r\" }},\n\
             {{ name = \"o\", segments = [\"other\", \"on\"], exit = \"o\" }},\n]\ncrossings = [{crossings}]\n{}",
            ["road", "side"].map(road).concat()
        );
        let scenario = load_given(&text, Vec::new(), &[], None).unwrap();
        Conflicts::of(&scenario.network, 0)
    }

    fn road(name: &str) -> String {
        format!(
            "[[roads]]\nname = \"{name}\"\ndemand = {{ rates = [{{ until_s = 1, vehicles_per_hour = 1 }}], min_headway_s = 1, \
             speed_mean_mps = 9, speed_sd_mps = 0, speed_min_mps = 9, speed_max_mps = 9 }}\n"
        )
    }

    #[test]
    fn ways_that_part_are_one_for_as_long_as_they_are_near_each_other() {
        let segments = "{ name = \"left\", length_m = 20 },\n{ name = \"right\", length_m = 20 }";
        let parts = "{ name = \"d\", at = { left = [0, 6], right = [0, 4] } }";
        let meets = "{ name = \"c\", length_m = 3, at = { left = 8, on = 5 } }";
        let parted = conflicts(segments, &format!("{parts}, {meets}"));
        let names: Vec<&str> = parted.points().iter().map(|point| point.name.as_str()).collect();
        assert_eq!(names, ["c"], "where they part nobody crosses");
        for (own, other, to_m) in [(0, 1, 106.0), (1, 0, 104.0)] {
            let mut runs = Vec::new();
            parted.runs((own, u32::MAX), (other, u32::MAX), |run| runs.push(run));
            assert_eq!(runs, [Run { from_m: 0.0, to_m, other_from_m: 0.0 }]);
        }
        // Areas that begin later, or of segments behind different ones, are crossings.
        for at in ["left = [1, 6], right = [0, 4]", "left = [0, 6], on = [0, 4]"] {
            let crossing = format!("{{ name = \"d\", at = {{ {at} }} }}");
            assert_eq!(conflicts(segments, &crossing).points().len(), 1, "{at}");
        }
    }

    #[test]
    fn a_box_begins_where_what_is_kept_clear_does() {
        let meets = "{ name = \"c\", at = { left = [8, 11], on = [5, 9] } }";
        for (keep_clear, box_m) in [(false, 108.0), (true, 100.0)] {
            let segments = format!(
                "{{ name = \"left\", length_m = 20, keep_clear = {keep_clear} }},\n{{ name = \"right\", length_m = 20 }}"
            );
            let conflicts = conflicts(&segments, meets);
            let found: Vec<(f64, f64, f64)> =
                conflicts.uses(0).iter().map(|u| (u.at_m, u.area_m, u.box_m)).collect();
            assert_eq!(found, [(108.0, 3.0, box_m)]);
            let other: Vec<(f64, f64, f64)> =
                conflicts.uses(2).iter().map(|u| (u.at_m, u.area_m, u.box_m)).collect();
            assert_eq!(other, [(55.0, 4.0, 55.0)]);
        }
    }
}
