//! From a passing order to duties.

use super::geometry::{Conflicts, PointKind};
use crate::scenario::VehicleParams;
use std::hint::select_unpredictable;

/// What a vehicle owes to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DutyKind {
    /// The other drives ahead on the way they share: the margin `x_j - x_i - phi v - delta >= 0` is kept at every
    /// instant (paper: `Safety`).
    RearEnd,
    /// The other passes a merge first: the same margin from the instant at which the vehicle passes it (paper:
    /// `SafeMerging`).
    Merge,
    /// The other crosses first: at the instant at which the vehicle reaches the conflict area, the other is
    /// `phi v + delta` behind its beginning.
    Cross,
}

/// One duty of one vehicle toward one other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Duty {
    /// What is owed.
    pub kind: DutyKind,
    /// To whom: the caller's index of its row.
    pub partner: u32,
    /// Index of the conflict point; [`Duty::NO_POINT`] toward a leader.
    pub point: u32,
    /// Distance of the point from the zone's origin on the vehicle's path, m. Toward a leader any place that both
    /// pass; what counts is where it is for the one and for the other.
    pub own_m: f64,
    /// The same on the partner's path, m.
    pub partner_m: f64,
    /// Distance delta to be kept beside `phi v`, m.
    pub gap_m: f64,
    /// Position of the partner, on its own path, from which on nothing is owed any more, m; infinite while the two
    /// drive on together.
    pub until_m: f64,
}

impl Duty {
    /// The point of a duty that has none.
    pub const NO_POINT: u32 = u32::MAX;

    /// What is owed where the two are now, if anything still is. Behind a merge the one that passed it first
    /// is the leader; a crossing is over once the vehicle has reached it.
    #[inline(always)]
    pub fn in_force(&self, x_m: f64, partner_x_m: f64) -> Option<DutyKind> {
        // Of what kind the next duty is, is not to be foretold, and mostly all are in force: one branch, and that on the
        // whole.
        let has_reached = x_m >= self.own_m;
        let is_over = (partner_x_m >= self.until_m) | (has_reached & (self.kind == DutyKind::Cross));
        let kind =
            select_unpredictable(has_reached & (self.kind == DutyKind::Merge), DutyKind::RearEnd, self.kind);
        (!is_over).then_some(kind)
    }

    /// Added to the partner's position to express it in the vehicle's coordinate, m.
    #[inline]
    pub fn shift_m(&self) -> f64 {
        self.own_m - self.partner_m
    }
}

/// A vehicle as the order of passing sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// The caller's index.
    pub id: u32,
    /// Its path in the zone.
    pub path: u32,
    /// Its path in the zone behind the exit; `u32::MAX` when there is none.
    pub next_path: u32,
    /// Position on its path, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Strongest braking as a positive number, m/s^2.
    pub braking_mps2: f64,
    /// Length, m.
    pub length_m: f64,
    /// What it is longer than the vehicle for which standstill gaps are stated, m.
    pub extra_m: f64,
    /// Standstill gap it keeps, m.
    pub gap_m: f64,
    /// Greatest distance `phi v` it keeps, m.
    pub reach_m: f64,
    /// Whether it has left the zone, and so owes nothing in it.
    pub has_left: bool,
    /// Whether a human drives it who does not follow the order: nobody enters a box in which it is to pass first.
    pub is_free: bool,
}

impl Row {
    /// A vehicle of these parameters; `reference` are those for which standstill gaps are stated.
    pub fn new(own: &VehicleParams, reference: &VehicleParams, id: u32) -> Row {
        Row {
            id,
            path: 0,
            next_path: u32::MAX,
            x_m: 0.0,
            v_mps: 0.0,
            braking_mps2: -own.u_min_mps2,
            length_m: own.length_m,
            extra_m: (own.length_m - reference.length_m).max(0.0),
            gap_m: own.standstill_gap_m,
            reach_m: own.reaction_time_s * own.v_max_mps,
            has_left: false,
            is_free: false,
        }
    }

    /// Whether one that follows another on a lane is behind it until the other's tail has left the lane: on one way, or when
    /// it keeps at least the other's length. Otherwise it may turn off beside it while it still reaches back.
    fn stays_behind(&self, other: &Row) -> bool {
        (self.path, self.next_path) == (other.path, other.next_path)
            || self.gap_m + other.extra_m >= other.length_m
    }
}

/// Whether one that passes later is behind the other on their common stretch. Who has left the zone stands at the head
/// of the order: before those of its own exit, all of whom it has passed; but of others one may be inside that
/// is ahead of it.
fn may_hide(conflicts: &Conflicts, nearer: &Row, other: &Row) -> bool {
    !other.has_left || conflicts.exit(nearer.path) == conflicts.exit(other.path)
}

/// Whether one that passes a point behind another on its lane goes on behind it for so many metres. Otherwise it may have
/// come further from the point, by another way, than the one that passed it first.
fn goes_along(conflicts: &Conflicts, nearer: &Row, other: &Row, point: u32, for_m: f64) -> bool {
    let Some(passes) = conflicts.uses(nearer.path).iter().find(|u| u.point == point) else { return false };
    let mut goes = false;
    conflicts.runs((nearer.path, nearer.next_path), (other.path, other.next_path), |run| {
        goes |= run.from_m <= passes.at_m && passes.at_m + for_m <= run.to_m;
    });
    goes
}

/// The duties of one zone's vehicles; kept from use to use for its allocations.
#[derive(Clone, Debug, Default)]
pub struct Duties {
    all: Vec<Duty>,
    /// End of each row's duties in `all`.
    ends: Vec<u32>,
    /// The latest row of each way (path and next path), the latest last.
    latest: Vec<usize>,
    /// Stretches of the row's way on which somebody nearer has been found, and who, by place in the order.
    covered: Vec<(f64, f64, usize)>,
    /// The same for lanes that cross.
    lanes: Vec<(u32, usize)>,
}

impl Duties {
    /// Derives the duties of all vehicles from the order in which they pass, first to last; vehicles that have left
    /// the zone come first.
    ///
    /// Of a lane only the nearest row before counts, for whoever is further ahead has passed everything
    /// earlier. A leader that turns off hides the one ahead of it only until then, so the next one that
    /// goes on further is owed the same; likewise behind a merge.
    pub fn derive(&mut self, conflicts: &Conflicts, rows: &[Row]) {
        self.all.clear();
        self.ends.clear();
        self.latest.clear();
        for (place, row) in rows.iter().enumerate() {
            if !row.has_left {
                let first = self.all.len();
                self.following(conflicts, rows, row);
                self.crossings(conflicts, rows, row);
                // Nearest leaders first, then points in the order in which they are passed.
                self.all[first..].sort_unstable_by(|a, b| {
                    let key = |d: &Duty| (d.kind != DutyKind::RearEnd, d.own_m);
                    key(a).partial_cmp(&key(b)).expect("places are numbers")
                });
            }
            self.ends.push(self.all.len() as u32);
            // Behind who follows the order, those that do not are still to be seen.
            let is_behind = |other: &Row| row.is_free || !other.is_free;
            self.latest.retain(|&at| {
                (rows[at].path, rows[at].next_path) != (row.path, row.next_path) || !is_behind(&rows[at])
            });
            self.latest.push(place);
        }
    }

    /// The duties of the row at a place of the order, and the range they have among [`all`](Self::all).
    pub fn of(&self, place: usize) -> &[Duty] {
        &self.all[self.range(place)]
    }

    /// Where the duties of the row at a place of the order are among [`all`](Self::all).
    pub fn range(&self, place: usize) -> std::ops::Range<usize> {
        let from = place.checked_sub(1).map_or(0, |before| self.ends[before]);
        from as usize..self.ends[place] as usize
    }

    /// All duties, row by row.
    pub fn all(&self) -> &[Duty] {
        &self.all
    }

    /// Duties toward leaders and at merges.
    fn following(&mut self, conflicts: &Conflicts, rows: &[Row], row: &Row) {
        let Duties { all, latest, covered, .. } = self;
        covered.clear();
        for &at in latest.iter().rev() {
            let other = &rows[at];
            conflicts.runs((row.path, row.next_path), (other.path, other.next_path), |run| {
                let until_m = run.other_from_m + (run.to_m - run.from_m) + other.length_m;
                if row.x_m >= run.to_m || other.x_m >= until_m {
                    return;
                }
                // A newcomer may be a rounding before the origin.
                let behind = row.x_m >= run.from_m || run.from_m == 0.0;
                let from_m = if behind { f64::NEG_INFINITY } else { run.from_m };
                let hides = |&(from, to, nearer): &(f64, f64, usize)| {
                    from <= from_m && to >= run.to_m && {
                        let nearer = &rows[nearer];
                        let goes_on = run.to_m == f64::INFINITY;
                        may_hide(conflicts, nearer, other) && (goes_on || nearer.stays_behind(other))
                    }
                };
                if covered.iter().any(hides) {
                    return;
                }
                covered.push((from_m, run.to_m, at));
                let point = conflicts.uses(row.path).iter().find(|u| !behind && u.at_m == run.from_m);
                all.push(Duty {
                    kind: if behind { DutyKind::RearEnd } else { DutyKind::Merge },
                    partner: other.id,
                    point: point.map_or(Duty::NO_POINT, |u| u.point),
                    own_m: run.from_m,
                    partner_m: run.other_from_m,
                    gap_m: row.gap_m + other.extra_m,
                    until_m,
                });
            });
            // Where nobody turns off, whoever is further ahead is behind this one's back for good.
            if conflicts.goes_on_together() && covered.contains(&(f64::NEG_INFINITY, f64::INFINITY, at)) {
                break;
            }
        }
    }

    fn crossings(&mut self, conflicts: &Conflicts, rows: &[Row], row: &Row) {
        let Duties { all, latest, lanes, .. } = self;
        let points = conflicts.points();
        for own in conflicts.uses(row.path).iter().filter(|u| row.x_m < u.at_m) {
            let point = &points[own.point as usize];
            let is_crossing = point.kind == PointKind::Crossing;
            // Who is to wait for one that nobody can ask to wait does so before the box.
            let is_before_box = row.x_m < own.box_m;
            if !(is_crossing || is_before_box && own.box_m < own.at_m) {
                continue;
            }
            lanes.clear();
            for &at in latest.iter().rev() {
                let other = &rows[at];
                let theirs = conflicts.uses(other.path).iter().find(|u| u.point == own.point);
                let Some(theirs) = theirs.filter(|u| !u.on_lane_of(own)) else { continue };
                if !is_crossing && !other.is_free {
                    continue;
                }
                let gap_m = theirs.area_m + other.length_m;
                let hides = |&(lane, nearer): &(u32, usize)| {
                    let nearer = &rows[nearer];
                    lane == theirs.lane()
                        && (nearer.is_free || !other.is_free)
                        && may_hide(conflicts, nearer, other)
                        && goes_along(conflicts, nearer, other, own.point, gap_m + row.reach_m)
                };
                if lanes.iter().any(hides) {
                    continue;
                }
                lanes.push((theirs.lane(), at));
                let until_m = theirs.at_m + gap_m + row.reach_m;
                if other.x_m < until_m {
                    all.push(Duty {
                        kind: DutyKind::Cross,
                        partner: other.id,
                        point: own.point,
                        own_m: if other.is_free && is_before_box { own.box_m } else { own.at_m },
                        partner_m: theirs.at_m,
                        gap_m,
                        until_m,
                    });
                }
            }
        }
    }
}
