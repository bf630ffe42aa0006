//! Where a human stops for others, and whether it can be told to.

use super::duties::Row;
use super::geometry::{Conflicts, Point, PointKind, Use};
use crate::scenario::{HumanParams, VehicleParams};
use crate::vehicle::driver::can_be_told;

/// How far before a crossing humans stop, m.
const BEFORE_CROSSING_M: f64 = 1.0;

/// How far before a point it is that a human stops for others, m.
pub fn line_before_m(kind: PointKind, jam_gap_m: f64, longest_m: f64) -> f64 {
    match kind {
        // Whoever passes the merge first must have its tail beyond the line by then.
        PointKind::Merge => longest_m + jam_gap_m,
        PointKind::Crossing => BEFORE_CROSSING_M,
    }
}

/// Whether a human that learns now that another is to go first can let it, wherever they meet: it can stop at the line, after
/// its delay, whatever it does until then. `longest_m` is the length of the longest vehicle.
pub fn can_yield(
    (human, vehicle): (&HumanParams, &VehicleParams),
    conflicts: &Conflicts,
    first: &Row,
    second: &Row,
    longest_m: f64,
) -> bool {
    let braking_mps2 = human.hardest_mps2.min(-vehicle.u_min_mps2);
    conflicts.uses(second.path).iter().filter(|own| own.at_m > second.x_m).all(|own| {
        let theirs = conflicts.uses(first.path).iter().find(|u| u.point == own.point);
        if theirs.is_none_or(|theirs| theirs.on_lane_of(own)) {
            return true;
        }
        let kind = conflicts.points()[own.point as usize].kind;
        let line_m = own.at_m - line_before_m(kind, human.jam_gap_m, longest_m) - second.x_m;
        can_be_told(human, braking_mps2, line_m, second.v_mps)
    })
}

/// How far beyond a point on its path a vehicle is clear of it, m.
pub fn clear_m(point: &Point, passes: &Use, length_m: f64) -> f64 {
    match point.kind {
        PointKind::Merge => 0.0,
        PointKind::Crossing => passes.area_m + length_m,
    }
}

/// Whether a vehicle is on a conflict point that another has yet to pass.
pub fn stands_on(conflicts: &Conflicts, inside: &Row, other: &Row) -> bool {
    conflicts.uses(inside.path).iter().any(|own| {
        let theirs = conflicts.uses(other.path).iter().find(|u| u.point == own.point);
        let to_m = own.at_m + clear_m(&conflicts.points()[own.point as usize], own, inside.length_m);
        (own.at_m..to_m).contains(&inside.x_m)
            && theirs.is_some_and(|theirs| !theirs.on_lane_of(own) && other.x_m < theirs.at_m)
    })
}

/// Whether a vehicle has entered a box in which another has yet to pass a point that it is not clear of.
///
/// Who keeps to no order has entered it with the first point only: before that it still stops for those inside.
pub fn is_in_the_way(conflicts: &Conflicts, inside: &Row, other: &Row) -> bool {
    conflicts.uses(inside.path).iter().filter(|own| entered_from_m(inside, own) <= inside.x_m).any(|own| {
        let theirs = conflicts.uses(other.path).iter().find(|u| u.point == own.point);
        let point = &conflicts.points()[own.point as usize];
        inside.x_m < own.at_m + clear_m(point, own, inside.length_m)
            && theirs.is_some_and(|theirs| !theirs.on_lane_of(own) && other.x_m < theirs.at_m)
    })
}

fn entered_from_m(inside: &Row, passes: &Use) -> f64 {
    if inside.is_free { passes.first_m } else { passes.box_m }
}

/// Whether a vehicle has passed every point where it meets another that has not passed all of them.
pub fn has_gone_first(conflicts: &Conflicts, first: &Row, second: &Row) -> bool {
    let mut meets = false;
    let all = conflicts.uses(second.path).iter().all(|own| {
        let theirs = conflicts.uses(first.path).iter().find(|u| u.point == own.point);
        let Some(theirs) = theirs.filter(|theirs| !theirs.on_lane_of(own)) else { return true };
        meets |= second.x_m < own.at_m;
        second.x_m >= own.at_m || first.x_m >= theirs.at_m
    });
    meets && all
}
