//! From a zone's duties to headways, and to the instants at which its vehicles leave.

use super::cost::Cost;
use super::pooling::{Headway, Pooling, Program, best_s};
use crate::conflict::{Duties, Duty, DutyKind};

/// Speeds that divide are taken to be at least this, m/s.
const LEAST_SPEED_MPS: f64 = 2.0;
/// Kept beside the margin, m, in full when the passage is at least so far away, s.
const BUFFER_M: f64 = 0.3;
const BUFFER_AFTER_S: f64 = 3.0;
/// How often headways are worked out anew from the speeds that the schedule has led to.
const ROUNDS: u32 = 3;

/// A vehicle on its way through a zone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Passage {
    /// Position on its path, m; negative before the zone.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Length of its path, m.
    pub length_m: f64,
    /// Its own length, m.
    pub body_m: f64,
    /// Reaction time phi, s.
    pub reaction_s: f64,
    /// Greatest speed, m/s.
    pub v_max_mps: f64,
    /// Strongest acceleration, m/s^2.
    pub u_max_mps2: f64,
    /// When it leaves, s from now, and how fast, m/s, if that is not to be scheduled.
    pub known: Option<(f64, f64)>,
}

impl Passage {
    /// Way left to the end of its path, m.
    pub fn left_m(&self) -> f64 {
        (self.length_m - self.x_m).max(0.01)
    }

    /// The earliest instant at which it can leave, s from now.
    fn soonest_s(&self) -> f64 {
        let (left_m, v, u) = (self.left_m(), self.v_mps, self.u_max_mps2);
        let until_fastest_m = (self.v_max_mps * self.v_max_mps - v * v) / (2.0 * u);
        if until_fastest_m >= left_m {
            return 2.0 * left_m / (v + (v * v + 2.0 * u * left_m).sqrt());
        }
        (self.v_max_mps - v).max(0.0) / u + (left_m - until_fastest_m.max(0.0)) / self.v_max_mps
    }
}

/// Schedules the vehicles of a zone; kept from use to use for its allocations.
#[derive(Clone, Debug, Default)]
pub struct Chain {
    pooling: Pooling,
    headways: Vec<Headway>,
    alone_s: Vec<f64>,
    earliest_s: Vec<f64>,
    /// The instants of the round before.
    before_s: Vec<f64>,
    speeds_mps: Vec<f64>,
    times_s: Vec<f64>,
}

impl Chain {
    /// The instants at which the vehicles leave, s from now, at least cost under the headways that their duties take.
    ///
    /// `passages` are in passing order, and `duties` those of the same rows; the first `known` of them are not
    /// scheduled, the others have one cost each.
    pub fn schedule(
        &mut self,
        passages: &[Passage],
        duties: &Duties,
        known: usize,
        costs: &[Cost],
    ) -> &[f64] {
        let speed = |cost: &Cost, passage: &Passage, time_s: f64| {
            cost.exit_mps(time_s).min(passage.v_max_mps).max(LEAST_SPEED_MPS)
        };
        let own = &passages[known..];
        self.alone_s.clear();
        self.alone_s.extend(costs.iter().map(best_s));
        self.times_s.clear();
        self.times_s.extend(self.alone_s.iter().zip(own).map(|(alone_s, own)| alone_s.max(own.soonest_s())));
        for round in 0..ROUNDS {
            self.before_s.clone_from(&self.times_s);
            self.speeds_mps.clear();
            let times = self.times_s.iter();
            self.speeds_mps.extend(costs.iter().zip(own).zip(times).map(|((c, p), &t)| speed(c, p, t)));
            self.separate(passages, duties, known);
            let Chain { pooling, headways, alone_s, earliest_s, before_s, times_s, .. } = self;
            let program = Program { costs, alone_s, earliest_s, headways };
            if round == 0 {
                pooling.minimise(&program, times_s);
            } else {
                pooling.minimise_again(&program, times_s);
            }
            // From the same instants the same would come out again.
            if times_s == before_s {
                break;
            }
        }
        &self.times_s
    }

    /// The instants found last, s from now.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// What the schedule found last costs in all.
    pub fn cost(&self, costs: &[Cost]) -> f64 {
        costs.iter().zip(&self.times_s).map(|(cost, &time_s)| cost.value(time_s)).sum()
    }

    /// Works out headways and earliest instants for the present speeds.
    ///
    /// All instants are those of leaving; places before the end of a path are passed at the speed of leaving. At each
    /// place that two vehicles pass, the later one comes when the earlier one is `phi v + gap` beyond it.
    fn separate(&mut self, passages: &[Passage], duties: &Duties, known: usize) {
        self.headways.clear();
        self.earliest_s.clear();
        for (at, own) in passages.iter().enumerate().skip(known) {
            let vehicle = at - known;
            let speed_mps = self.speeds_mps[vehicle];
            let buffer_m = BUFFER_M * (self.times_s[vehicle] / BUFFER_AFTER_S).min(1.0);
            let mut earliest_s = own.soonest_s();
            for duty in duties.of(at) {
                let ahead = duty.partner as usize;
                let partner = &passages[ahead];
                if duty.in_force(own.x_m, partner.x_m).is_none() {
                    continue;
                }
                for (own_m, partner_m) in places(duty, own, partner) {
                    if own_m < own.x_m {
                        continue;
                    }
                    let distance_m = own.reaction_s * speed_mps + duty.gap_m + buffer_m;
                    let rest_s = (own.length_m - own_m) / speed_mps;
                    if partner.x_m >= partner_m {
                        let lack_m = distance_m - (partner.x_m - partner_m);
                        earliest_s = earliest_s.max(lack_m / partner.v_mps.max(LEAST_SPEED_MPS) + rest_s);
                        continue;
                    }
                    // From the partner's leaving on.
                    let after_s = |partner_mps: f64| {
                        (distance_m - (partner.length_m - partner_m)) / partner_mps + rest_s
                    };
                    if let Some((time_s, speed_mps)) = partner.known {
                        earliest_s = earliest_s.max(time_s + after_s(speed_mps.max(LEAST_SPEED_MPS)));
                    } else if let Some(before) = ahead.checked_sub(known) {
                        let headway_s = after_s(self.speeds_mps[before]);
                        let (before, after) = (before as u32, vehicle as u32);
                        let mut same = self.headways.iter_mut().rev().take_while(|h| h.after == after);
                        match same.find(|h| h.before == before) {
                            Some(headway) => headway.headway_s = headway.headway_s.max(headway_s),
                            None => self.headways.push(Headway { before, after, headway_s }),
                        }
                    }
                }
            }
            self.earliest_s.push(earliest_s);
        }
    }
}

/// Where a duty takes time between two vehicles: the conflict point, and the end of the way they share. On the paths of
/// each, m.
fn places(duty: &Duty, own: &Passage, partner: &Passage) -> impl Iterator<Item = (f64, f64)> {
    let point = (duty.kind != DutyKind::RearEnd).then_some((duty.own_m, duty.partner_m));
    let end = (duty.kind != DutyKind::Cross).then(|| {
        let parted_m = duty.until_m - partner.body_m + duty.shift_m();
        let own_m = parted_m.min(own.length_m);
        (own_m, own_m - duty.shift_m())
    });
    point.into_iter().chain(end)
}
