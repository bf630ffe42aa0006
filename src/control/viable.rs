//! The law `viable`: each vehicle drives a plan of least effort for its slot, within what is viable.
//!
//! A state is viable when full braking keeps every duty, whatever the partners do: the shield's safe sets. The
//! law commands what the plan wishes, bounded by a comfort row toward leaders and by the greatest acceleration after
//! which the state is still viable, the partners braking fully from the state they published. For a vehicle that is
//! viable that is never less than `u_min`, so no step is without solution (docs/control.md).

use super::law::{Decision, Law, Partner, Situation, Verdict, Words};
use super::reference::{Problem, Terminal};
use super::rows::{Interval, Row, Rows};
use super::slot::{self, Exit, Passage, Spacing};
use crate::conflict::DutyKind;
use crate::scenario::{Scenario, VehicleParams, ViableParams};
use crate::shield::{self, Ends, Seen, Shield};
use crate::vehicle::{Held, Inequality, Pair, RearEnd};
use ipc_schemas::{MODE_FREE, MODE_SCHEDULED, MODE_SLOT};

/// What decides when a vehicle is to be where. Travels as the mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Aim {
    /// Its own optimum.
    Free,
    /// Its coordinator's schedule.
    Scheduled,
    /// A partner, which has to pass first.
    Slot,
}

impl Aim {
    #[inline(always)]
    fn mode(self) -> u16 {
        match self {
            Aim::Free => MODE_FREE,
            Aim::Scheduled => MODE_SCHEDULED,
            Aim::Slot => MODE_SLOT,
        }
    }
}

/// The word that is remembered: the instant at which the vehicle would leave if nobody were in the way, s. There the next
/// search for it begins; nothing else depends on it.
const FREE_EXIT: usize = 0;
/// A search that begins so near, s, needs no nearer beginning.
const STALE_S: f64 = 1e-2;

/// A kind of vehicle.
#[derive(Clone, Copy, Debug)]
struct Kind {
    vehicle: VehicleParams,
    /// First tier: the distances that are owed.
    viability: Shield,
    /// Second tier, for those that are outside the first: nobody drives through anybody.
    bodies: Shield,
}

/// The law with its parameters.
#[derive(Clone, Debug)]
pub struct Viable {
    params: ViableParams,
    kinds: Vec<Kind>,
    beta: f64,
    dt_s: f64,
}

/// A plan: what it begins with, and how it ends.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Plan {
    aim: Aim,
    u_mps2: f64,
    /// Time from now to the end of the path, s, and speed there, m/s.
    exit_s: f64,
    exit_mps: f64,
}

/// Distances below this are not worth a plan, m.
const LEAST_PLAN_M: f64 = 1e-3;

impl Law for Viable {
    #[inline(always)]
    fn decide<P>(&self, s: &Situation, partners: P, memory: &mut Words) -> Decision
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let plan = self.plan(s, partners.clone(), memory);
        if memory.mode != plan.aim.mode() {
            memory.mode = plan.aim.mode();
        }
        let exit = (s.time_s + plan.exit_s, plan.exit_mps);
        let interval = self.interval(s, plan.u_mps2, partners.clone());
        let u_min_mps2 = self.kind(s).vehicle.u_min_mps2;
        if interval.high < u_min_mps2 {
            // Nothing is left to choose.
            return Decision { u_mps2: u_min_mps2, verdict: Verdict::Infeasible, exit };
        }
        let (above, below) = (plan.u_mps2 > interval.high, plan.u_mps2 < interval.low);
        let row = if above { interval.high_row } else { interval.low_row };
        let verdict = Verdict::Tracked((above || below).then_some(row));
        // The greatest viable acceleration outranks the least speed.
        let u_mps2 = plan.u_mps2.max(interval.low).min(interval.high);
        Decision { u_mps2, verdict, exit }
    }
}

impl Viable {
    /// The law of a scenario.
    pub fn new(scenario: &Scenario) -> Viable {
        let dt_s = scenario.dt_s();
        let kinds = scenario.fleet.iter().map(|kind| Kind {
            vehicle: kind.vehicle,
            viability: Shield::new(&kind.vehicle, dt_s),
            bodies: Shield::of_bodies(&kind.vehicle, dt_s),
        });
        Viable { params: scenario.control.viable, kinds: kinds.collect(), beta: scenario.beta, dt_s }
    }

    #[inline(always)]
    fn kind(&self, s: &Situation) -> &Kind {
        &self.kinds[usize::from(s.kind)]
    }

    /// The parameters of a partner; a kind nobody has heard of cannot be told apart from the first.
    #[inline(always)]
    fn vehicle_of(&self, partner: &Partner) -> &VehicleParams {
        &self.kinds.get(usize::from(partner.vehicle_kind)).unwrap_or(&self.kinds[0]).vehicle
    }

    /// The plan of this step: for its own optimum or its schedule, later where a partner has to pass first.
    #[inline(always)]
    fn plan<P>(&self, s: &Situation, partners: P, memory: &mut Words) -> Plan
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let base = self.unhindered(s, memory);
        if !self.params.slots {
            return base;
        }
        let reaction_s = self.kind(s).vehicle.reaction_time_s;
        let mut best = base;
        for partner in partners {
            let at_m = match partner.kind {
                DutyKind::Merge | DutyKind::Cross => partner.conflict_m,
                // A leader is followed at the end of the path, if it is still one there.
                DutyKind::RearEnd if partner.until_m > s.length_m => s.length_m,
                DutyKind::RearEnd => continue,
            };
            let distance_m = at_m - s.x_m;
            if distance_m < LEAST_PLAN_M {
                continue;
            }
            let spacing = Spacing {
                reaction_s,
                gap_m: partner.gap_m,
                buffer_m: self.params.buffer_m,
                buffer_s: self.params.buffer_s,
            };
            let passage = passage(s, &partner, at_m);
            let ends_there = (s.length_m - at_m).abs() < LEAST_PLAN_M;
            if ends_there && passage.is_kept_by(base.exit_mps, base.exit_s, &spacing) {
                continue;
            }
            let time_s = slot::duration_s(distance_m, s.v_mps, &passage, &spacing);
            if time_s <= base.passes_s(s, distance_m) {
                continue;
            }
            let mut plan = self.behind(s, &partner, distance_m, time_s, &passage, &spacing);
            if time_s > MOVE_UP_AFTER_S {
                let up_mps2 = slot::acceleration_to_rest_mps2(self.beta, distance_m, s.v_mps);
                plan.u_mps2 = plan.u_mps2.max(up_mps2);
            }
            // Of several slots that which asks for the least now, and to leave no earlier than any lets it.
            let exit = if plan.exit_s > best.exit_s || best.aim != Aim::Slot { plan } else { best };
            let u_mps2 = if best.aim == Aim::Slot { plan.u_mps2.min(best.u_mps2) } else { plan.u_mps2 };
            best = Plan { u_mps2, ..exit };
        }
        best
    }

    /// The plan of a vehicle that has nobody in its way.
    #[inline(always)]
    fn unhindered(&self, s: &Situation, memory: &mut Words) -> Plan {
        let distance_m = (s.length_m - s.x_m).max(LEAST_PLAN_M);
        if let Some(schedule) = s.schedule
            && schedule.at_m - s.x_m >= LEAST_PLAN_M
        {
            return self.scheduled(s, schedule.at_m - s.x_m, schedule.time_s - s.time_s);
        }
        let Terminal::Speed(w) = s.terminal else {
            let guess_s = memory.words[FREE_EXIT] - s.time_s;
            let guess_s = if guess_s > 0.0 { guess_s } else { distance_m / s.v_mps.max(1.0) };
            let time_s = slot::free_duration_s(self.beta, s.v_mps, distance_m, guess_s);
            if (time_s - guess_s).abs() > STALE_S {
                memory.words[FREE_EXIT] = s.time_s + time_s;
            }
            return Plan {
                aim: Aim::Free,
                u_mps2: slot::acceleration_mps2(distance_m, s.v_mps, time_s),
                exit_s: time_s,
                exit_mps: slot::final_speed_mps(distance_m, s.v_mps, time_s).max(0.0),
            };
        };
        let problem =
            Problem { beta: self.beta, v0_mps: s.v_mps, length_m: distance_m, terminal: s.terminal };
        let guess_s = memory.words[FREE_EXIT] - s.time_s;
        let optimum = problem.solve_near(guess_s);
        if (optimum.duration_s - guess_s).abs() > STALE_S {
            memory.words[FREE_EXIT] = s.time_s + optimum.duration_s;
        }
        Plan { aim: Aim::Free, u_mps2: optimum.b, exit_s: optimum.duration_s, exit_mps: w }
    }

    /// The plan that is at a place when it is scheduled to be.
    fn scheduled(&self, s: &Situation, distance_m: f64, time_s: f64) -> Plan {
        // Whoever has been held up does not chase a schedule made before.
        let beta = HASTE * self.beta;
        let time_s = if slot::is_sooner_than_free(beta, s.v_mps, distance_m, time_s) {
            slot::free_duration_s(beta, s.v_mps, distance_m, distance_m / s.v_mps.max(1.0))
        } else {
            time_s
        };
        let Terminal::Speed(w) = s.terminal else {
            return Plan { aim: Aim::Scheduled, ..self.for_slot(s, distance_m, time_s) };
        };
        let u_mps2 = slot::acceleration_to_mps2(distance_m, s.v_mps, time_s, w);
        let (exit_s, exit_mps) = self.onward(s, distance_m, time_s, w);
        Plan { aim: Aim::Scheduled, u_mps2, exit_s, exit_mps }
    }

    /// The plan for a slot. Whoever passes a place slowly holds up those behind, for as long as it takes to cover the
    /// gap; where that costs them more than it costs effort, the vehicle passes faster than it would for itself.
    fn behind(
        &self,
        s: &Situation,
        partner: &Partner,
        distance_m: f64,
        time_s: f64,
        passage: &Passage,
        spacing: &Spacing,
    ) -> Plan {
        let alone_mps = slot::final_speed_mps(distance_m, s.v_mps, time_s);
        // Below some speed the bodies are what takes time.
        let body_m = match partner.kind {
            DutyKind::Cross => 0.0,
            _ => self.vehicle_of(partner).length_m + self.params.clearance_m,
        };
        let gap_m = spacing.gap_m.max(body_m - spacing.reaction_s * alone_mps.max(0.0));
        let worth = 0.25 * self.params.passage_weight * self.beta * gap_m * time_s;
        if time_s > LONGEST_S || worth <= LEAST_HURRY_MPS * alone_mps * alone_mps.max(0.0) {
            return self.for_slot(s, distance_m, time_s);
        }
        let fastest_mps = (s.v_mps * s.v_mps + self.kind(s).vehicle.u_max_mps2 * distance_m).sqrt();
        let there_mps = slot::passing_speed_mps(alone_mps, worth).min(fastest_mps).max(alone_mps);
        let kept_m = spacing.kept_m(there_mps, time_s).max(body_m);
        let time_s = ((kept_m - passage.lead_m) / passage.speed_mps).max(time_s).min(LONGEST_S);
        let u_mps2 = slot::acceleration_to_mps2(distance_m, s.v_mps, time_s, there_mps);
        let (exit_s, exit_mps) = self.onward(s, distance_m, time_s, there_mps);
        Plan { aim: Aim::Slot, u_mps2, exit_s, exit_mps }
    }

    /// The plan that is at a place after a time, without acceleration there.
    fn for_slot(&self, s: &Situation, distance_m: f64, time_s: f64) -> Plan {
        // Later than this it would have to reverse; it comes to stand there, and then waits.
        let moves_s = if time_s * s.v_mps > 3.0 * distance_m { 3.0 * distance_m / s.v_mps } else { time_s };
        let u_mps2 = slot::acceleration_mps2(distance_m, s.v_mps, moves_s);
        let there_mps = slot::final_speed_mps(distance_m, s.v_mps, moves_s).max(0.0);
        let (exit_s, exit_mps) = self.onward(s, distance_m, time_s.min(LONGEST_S), there_mps);
        Plan { aim: Aim::Slot, u_mps2, exit_s, exit_mps }
    }

    /// When, from now, and how fast a vehicle leaves that is at a place after a time with a speed.
    #[inline(always)]
    fn onward(&self, s: &Situation, distance_m: f64, time_s: f64, there_mps: f64) -> (f64, f64) {
        let rest_m = s.length_m - s.x_m - distance_m;
        if rest_m < LEAST_PLAN_M {
            return (time_s, there_mps);
        }
        let rest_s = slot::free_duration_s(self.beta, there_mps, rest_m, rest_m / there_mps.max(1.0));
        (time_s + rest_s, slot::final_speed_mps(rest_m, there_mps, rest_s).max(0.0))
    }

    /// What the plan of this step asks for, m/s^2.
    pub fn wish_mps2<P>(&self, s: &Situation, partners: P, memory: &mut Words) -> f64
    where
        P: Iterator<Item = Partner> + Clone,
    {
        self.plan(s, partners, memory).u_mps2
    }

    /// The accelerations that all rows allow, as far as they matter to a wish. Where none rules out that bodies touch,
    /// `high` is below `u_min`.
    #[inline(always)]
    pub fn interval<P>(&self, s: &Situation, wish_mps2: f64, partners: P) -> Interval
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let vehicle = &self.kind(s).vehicle;
        let mut interval = Interval::limits(vehicle.u_min_mps2, vehicle.u_max_mps2);
        self.rows(s, wish_mps2, partners, &mut interval);
        interval
    }

    /// The same rows one by one, limits included, as a general solver wants them.
    pub fn row_list<P>(&self, s: &Situation, wish_mps2: f64, partners: P) -> Vec<(Inequality, Row)>
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let vehicle = &self.kind(s).vehicle;
        let mut rows: Vec<(Inequality, Row)> = Vec::with_capacity(12);
        rows.at_least(vehicle.u_min_mps2, Row::UMin);
        rows.at_most(Inequality { coefficient: 1.0, bound: vehicle.u_max_mps2 }, Row::UMax);
        self.rows(s, wish_mps2, partners, &mut rows);
        rows
    }

    /// Adds all rows but the acceleration limits. Safe sets bound no wish that they admit.
    #[inline(always)]
    fn rows<P, R>(&self, s: &Situation, wish_mps2: f64, partners: P, rows: &mut R)
    where
        P: Iterator<Item = Partner> + Clone,
        R: Rows,
    {
        let Kind { vehicle, viability, bodies } = self.kind(s);
        let params = &self.params;
        let u_min_mps2 = vehicle.u_min_mps2;
        let at_most = |rows: &mut R, wish_mps2: f64, high_mps2: f64, row: Row| {
            rows.at_most(Inequality { coefficient: 1.0, bound: high_mps2 }, row);
            wish_mps2.min(high_mps2)
        };
        // No more braking is asked for comfort, or for v_max, than the vehicle can do.
        let mut wish = wish_mps2.max(u_min_mps2).min(vehicle.u_max_mps2);
        if s.v_mps + wish * self.dt_s > vehicle.v_max_mps {
            let fastest_mps2 = (vehicle.v_max_mps - s.v_mps) / self.dt_s;
            wish = at_most(rows, wish, fastest_mps2.max(u_min_mps2), Row::VMax);
        }
        if params.comfort {
            for partner in partners.clone().filter(|partner| partner.kind == DutyKind::RearEnd) {
                let row = self.comfort_row(s, &partner);
                if row.coefficient * wish > row.bound {
                    wish = at_most(rows, wish, (row.bound / row.coefficient).max(u_min_mps2), Row::Comfort);
                }
            }
        }
        // Whoever has to brake outranks the least speed.
        if s.v_mps + wish * self.dt_s < vehicle.v_min_mps {
            rows.at_least(((vehicle.v_min_mps - s.v_mps) / self.dt_s).min(wish), Row::VMin);
        }
        let mut ends = viability.ends(s.x_m, s.v_mps, wish);
        for partner in partners {
            let seen = self.seen(&partner, partner.gap_m);
            let plain = |tier: &Shield, ends: &Ends, gap_m: f64| {
                tier.plainly_admits(ends, partner.kind, partner.conflict_m, &Seen { gap_m, ..seen })
            };
            if params.viability && !plain(viability, &ends, seen.gap_m) {
                let owed = self.owed(&partner, &seen);
                if viability.is_viable(s.x_m, s.v_mps, &owed) {
                    let high_mps2 = viability.project(s.x_m, s.v_mps, wish, std::iter::once(owed)).u_mps2;
                    if high_mps2 < wish {
                        wish = at_most(rows, wish, high_mps2, row_of(partner.kind));
                        ends = viability.ends(s.x_m, s.v_mps, wish);
                    }
                }
            }
            if params.bodies {
                let (body_m, clearance_m) = match partner.kind {
                    DutyKind::Cross => (partner.gap_m, 0.0),
                    _ => (self.vehicle_of(&partner).length_m, params.clearance_m),
                };
                if plain(bodies, &ends, body_m + clearance_m) {
                    continue;
                }
                let owed = self.owed(&partner, &Seen { gap_m: body_m + clearance_m, ..seen });
                let high_mps2 = bodies.project(s.x_m, s.v_mps, wish, std::iter::once(owed)).u_mps2;
                if high_mps2 < wish {
                    wish = at_most(rows, wish, high_mps2, Row::Bodies);
                    ends = viability.ends(s.x_m, s.v_mps, wish);
                }
                let braking = Held::new(s.x_m, s.v_mps, u_min_mps2);
                let touching = shield::Partner { gap_m: body_m, ..owed };
                if high_mps2 <= u_min_mps2 && bodies.slack_after_m(&braking, &touching) < 0.0 {
                    // No braking rules out that the bodies touch.
                    wish = at_most(rows, wish, f64::NEG_INFINITY, Row::Bodies).max(u_min_mps2);
                }
            }
        }
    }

    /// The sampled row toward a leader: its margin keeps `1 - k dt` of its value over the step, or, negative, loses
    /// `k dt` of it.
    #[inline(always)]
    fn comfort_row(&self, s: &Situation, partner: &Partner) -> Inequality {
        let vehicle = &self.kind(s).vehicle;
        let pair = Pair {
            x_m: s.x_m,
            v_mps: s.v_mps,
            partner_x_m: partner.x_m,
            partner_v_mps: partner.v_mps,
            partner_u_mps2: partner.u_mps2,
        };
        let mut rear_end = RearEnd {
            reaction_s: vehicle.reaction_time_s,
            gap_m: partner.gap_m,
            k_per_s: self.params.k_comfort_per_s,
            u_min_mps2: vehicle.u_min_mps2,
        };
        let margin_m = rear_end.margin_m(&pair);
        if margin_m < 0.0 {
            // Effort and exposure cost least with u = -sqrt(2 price |m|), were the leader as fast: m' = -phi u.
            let braking = (2.0 * self.params.price_of_exposure_mps4).sqrt();
            rear_end.k_per_s = vehicle.reaction_time_s * braking / (-margin_m).sqrt();
        }
        rear_end.sampled_row(&pair, self.dt_s)
    }

    /// A partner as the safe sets see it: at the state it published,
    #[inline(always)]
    fn seen(&self, partner: &Partner, gap_m: f64) -> Seen {
        let braking_mps2 = -self.vehicle_of(partner).u_min_mps2;
        Seen { x_m: partner.x_m, v_mps: partner.v_mps, gap_m, braking_mps2 }
    }

    /// and braking fully.
    #[inline(always)]
    fn owed(&self, partner: &Partner, seen: &Seen) -> shield::Partner {
        shield::Partner {
            kind: partner.kind,
            at_m: partner.conflict_m,
            gap_m: seen.gap_m,
            braking_mps2: seen.braking_mps2,
            motion: Held::new(seen.x_m, seen.v_mps, -seen.braking_mps2),
        }
    }
}

/// Whoever is to wait longer than this moves up to where it waits, s: room ahead that nobody takes could close a circle of
/// vehicles that wait for each other.
const MOVE_UP_AFTER_S: f64 = 60.0;

/// Passing faster by less than this is not worth a thought, m/s.
const LEAST_HURRY_MPS: f64 = 0.01;

/// A schedule is kept at no higher price of time than this times beta.
const HASTE: f64 = 4.0;

/// Exits further away than this are not told, s.
const LONGEST_S: f64 = 1e4;

impl Plan {
    /// When, from now, it passes a place that far ahead, s; beyond its end as fast as it ends.
    #[inline(always)]
    fn passes_s(&self, s: &Situation, distance_m: f64) -> f64 {
        let beyond_m = s.length_m - s.x_m - distance_m;
        if beyond_m.abs() < LEAST_PLAN_M {
            return self.exit_s;
        }
        let exit = Exit { beyond_m, after_s: self.exit_s, speed_mps: self.exit_mps };
        let Passage { lead_m, speed_mps } = slot::passage(distance_m, s.v_mps, Some(exit));
        -lead_m / speed_mps
    }
}

/// How a partner passes a place in the vehicle's coordinate.
#[inline(always)]
fn passage(s: &Situation, partner: &Partner, at_m: f64) -> Passage {
    let exit = (partner.exit_time_s > s.time_s).then_some(Exit {
        beyond_m: partner.exit_at_m - at_m,
        after_s: partner.exit_time_s - s.time_s,
        speed_mps: partner.exit_speed_mps,
    });
    slot::passage(at_m - partner.x_m, partner.v_mps, exit)
}

fn row_of(kind: DutyKind) -> Row {
    match kind {
        DutyKind::RearEnd => Row::RearEnd,
        DutyKind::Merge => Row::Merge,
        DutyKind::Cross => Row::Cross,
    }
}
