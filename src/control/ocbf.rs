//! The paper's law of one vehicle: feasibility-enforcement mode, then optimal tracking under barrier rows.

use super::law::{Decision, Law, Partner, Situation, Verdict, Words};
use super::qp::{self, Tracking};
use super::reference::{Optimum, Problem, Reference, Terminal};
use super::rows::{Interval, Row, Rows};
use super::{clarabel, reference};
use crate::conflict::DutyKind;
use crate::scenario::{FeConditions, Replan, SafetyRows, Scenario, Solver, VehicleParams};
use crate::vehicle::{Inequality, Merge, Pair, RearEnd};
use ipc_schemas::{MODE_FE, MODE_OCBF};
use std::hint::select_unpredictable;

/// Mode of a vehicle in its zone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Feasibility enforcement: braking until the entry conditions hold.
    Fe,
    /// Tracking the reference; never left again.
    Ocbf,
}

/// What a controller remembers of a vehicle between steps. Travels in the command frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Memory {
    /// Mode; a new vehicle starts in FE mode.
    pub mode: Mode,
    /// The plan, once there is one.
    pub plan: Option<Reference>,
}

impl Memory {
    /// The memory of a vehicle that has just entered.
    pub const ENTERED: Memory = Memory { mode: Mode::Fe, plan: None };

    /// Instant, s, and speed, m/s, at which the vehicle plans to reach the end of its path; zeros without a plan.
    #[inline(always)]
    fn exit(&self) -> (f64, f64) {
        self.plan.as_ref().map_or((0.0, 0.0), |plan| (plan.exit_time_s(), plan.exit_speed_mps()))
    }
}

/// One step's quadratic program, its rows already reduced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Program {
    /// Objective.
    pub tracking: Tracking,
    /// Feasible accelerations.
    pub interval: Interval,
}

/// The law with its parameters.
#[derive(Clone, Debug)]
pub struct Ocbf {
    control: crate::scenario::ControlParams,
    /// By kind of vehicle.
    kinds: Vec<VehicleParams>,
    beta: f64,
    dt_s: f64,
    slack_weight: f64,
}

/// Remaining lengths below this are not worth a new plan, m.
const LEAST_PLAN_M: f64 = 1e-3;

impl Memory {
    /// From words; anything that is no plan is none.
    #[inline(always)]
    pub fn recall(words: &Words) -> Memory {
        let plan = (words.words[DURATION] > 0.0).then(|| plan_of(words));
        Memory { mode: if words.mode == MODE_OCBF { Mode::Ocbf } else { Mode::Fe }, plan }
    }

    /// As words.
    pub fn words(&self) -> Words {
        let mode = match self.mode {
            Mode::Fe => MODE_FE,
            Mode::Ocbf => MODE_OCBF,
        };
        let Some(plan) = &self.plan else { return Words { mode, ..Words::ENTERED } };
        let Optimum { a, b, duration_s } = plan.optimum;
        let terminal = terminal_word(plan.terminal);
        Words { mode, words: [plan.start_s, plan.origin_m, plan.v0_mps, a, b, duration_s, terminal, 0.0] }
    }
}

/// Where a plan's duration stands among the words, s.
const DURATION: usize = 5;
/// Where its terminal condition stands.
const TERMINAL: usize = 6;

/// A terminal condition as a word: a speed, m/s, or less than any.
#[inline(always)]
fn terminal_word(terminal: Terminal) -> f64 {
    match terminal {
        Terminal::Free => -1.0,
        Terminal::Speed(w) => w,
    }
}

/// The plan in words that hold one.
#[inline(always)]
fn plan_of(words: &Words) -> Reference {
    let [start_s, origin_m, v0_mps, a, b, duration_s, terminal_mps, _] = words.words;
    Reference {
        start_s,
        origin_m,
        v0_mps,
        optimum: Optimum { a, b, duration_s },
        terminal: if terminal_mps < 0.0 { Terminal::Free } else { Terminal::Speed(terminal_mps) },
    }
}

/// Whether the words hold a plan that is tracked in this step: not in FE mode, and not when it is to be made first.
#[inline(always)]
fn is_tracked(words: &Words, s: &Situation) -> bool {
    words.mode == MODE_OCBF
        && words.words[DURATION] > 0.0
        && words.words[TERMINAL] == terminal_word(s.terminal)
}

impl Law for Ocbf {
    // In one piece with `program`: handed over in memory, a program is stored field by field and at once
    // loaded two fields at a time, for which the processor waits.
    #[inline(always)]
    fn decide<P>(&self, s: &Situation, partners: P, words: &mut Words) -> Decision
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let vehicle = self.vehicle(s);
        let brakes = |verdict, exit| Decision { u_mps2: vehicle.u_min_mps2, verdict, exit };
        if !is_tracked(words, s) {
            // Copies: what is handed over in memory would have to lie there for every other vehicle, too.
            let (s, partners) = (*s, partners.clone());
            if !self.remember(&s, partners, words) {
                return brakes(Verdict::Fe, Memory::recall(words).exit());
            }
        }
        let plan = plan_of(words);
        let exit = (plan.exit_time_s(), plan.exit_speed_mps());
        let Program { tracking, interval } = self.program(s, partners.clone(), &plan);
        let u = match self.control.solver {
            Solver::ClosedForm => qp::solve(&tracking, &interval),
            Solver::Clarabel => {
                // The limits once more, so that an answer within the solver's tolerance obeys them.
                let (s, partners) = (*s, partners.clone());
                clarabel::solve(&tracking, &self.row_list(&s, partners))
                    .map(|u| u.clamp(vehicle.u_min_mps2, vehicle.u_max_mps2))
            }
        };
        match u {
            None => brakes(Verdict::Infeasible, exit),
            Some(u) => {
                let wish = tracking.free_minimum_mps2();
                let (above, below) = (wish > interval.high, wish < interval.low);
                let row = select_unpredictable(above, interval.high_row, interval.low_row);
                let row = select_unpredictable(above || below, Some(row), None);
                Decision { u_mps2: u, verdict: Verdict::Tracked(row), exit }
            }
        }
    }
}

impl Ocbf {
    /// The law of a scenario.
    pub fn new(scenario: &Scenario) -> Ocbf {
        let control = scenario.control;
        Ocbf {
            control,
            kinds: scenario.fleet.iter().map(|kind| kind.vehicle).collect(),
            beta: scenario.beta,
            dt_s: scenario.dt_s(),
            slack_weight: if control.clf { control.slack_weight } else { 0.0 },
        }
    }

    #[inline(always)]
    fn vehicle(&self, s: &Situation) -> &VehicleParams {
        &self.kinds[usize::from(s.kind)]
    }

    /// Renews what a vehicle remembers, and says whether it has a plan now that is tracked.
    // Out of line: most vehicles in most steps track the plan they have.
    #[cold]
    #[inline(never)]
    fn remember<P: Iterator<Item = Partner>>(&self, s: &Situation, partners: P, words: &mut Words) -> bool {
        *words = self.renew(s, partners, Memory::recall(words)).words();
        is_tracked(words, s)
    }

    /// What a vehicle remembers that is still, or just now, in FE mode, or whose terminal condition changed.
    pub fn renew<P>(&self, s: &Situation, partners: P, memory: Memory) -> Memory
    where
        P: Iterator<Item = Partner>,
    {
        if memory.mode == Mode::Fe {
            let may_brake = s.x_m <= self.control.fe_fraction * s.length_m;
            if may_brake && !self.entry_conditions_hold(s, partners) {
                return memory;
            }
        }
        let plan = match memory.plan {
            Some(plan) if plan.terminal == s.terminal => plan,
            old => self.new_plan(s, old),
        };
        Memory { mode: Mode::Ocbf, plan: Some(plan) }
    }

    /// The program of `equ:ocbf_qp` for this step.
    #[inline(always)]
    pub fn program<P>(&self, s: &Situation, partners: P, plan: &Reference) -> Program
    where
        P: Iterator<Item = Partner>,
    {
        let (v_ref, u_ref) = plan.at(self.control.position_feedback, s.time_s, s.x_m);
        let tracking = Tracking {
            u_ref_mps2: u_ref,
            error_mps: s.v_mps - v_ref,
            clf_rate_per_s: self.control.clf_rate_per_s,
            slack_weight: self.slack_weight,
        };
        let vehicle = self.vehicle(s);
        let mut interval = Interval::limits(vehicle.u_min_mps2, vehicle.u_max_mps2);
        self.rows(s, partners, &mut interval);
        Program { tracking, interval }
    }

    /// The program this vehicle solves in this step and all its rows; `None` when it is in FE mode.
    pub fn posed<P>(
        &self,
        s: &Situation,
        partners: P,
        words: &Words,
    ) -> Option<(Program, Vec<(Inequality, Row)>)>
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let mut words = *words;
        let is_tracked = is_tracked(&words, s) || self.remember(s, partners.clone(), &mut words);
        let plan = is_tracked.then(|| plan_of(&words))?;
        Some((self.program(s, partners.clone(), &plan), self.row_list(s, partners)))
    }

    /// All rows, one by one, limits included, as a general solver wants them.
    pub fn row_list<P: Iterator<Item = Partner>>(
        &self,
        s: &Situation,
        partners: P,
    ) -> Vec<(Inequality, Row)> {
        let mut rows: Vec<(Inequality, Row)> = Vec::with_capacity(12);
        let vehicle = self.vehicle(s);
        rows.at_least(vehicle.u_min_mps2, Row::UMin);
        rows.at_most(Inequality { coefficient: 1.0, bound: vehicle.u_max_mps2 }, Row::UMax);
        self.rows(s, partners, &mut rows);
        rows
    }

    /// Plans from the entry or from the present state (`replan` in the scenario).
    fn new_plan(&self, s: &Situation, old: Option<Reference>) -> Reference {
        let law = self.control.reference;
        match self.control.replan {
            Replan::FromEntry => {
                let problem = Problem {
                    beta: self.beta,
                    v0_mps: s.entry_speed_mps,
                    length_m: s.length_m,
                    terminal: s.terminal,
                };
                let optimum = match old {
                    Some(old) => problem.perturb(law, &old.optimum, old.terminal),
                    None => problem.solve_forward(law),
                };
                Reference {
                    start_s: s.entry_time_s,
                    origin_m: 0.0,
                    v0_mps: s.entry_speed_mps,
                    optimum,
                    terminal: s.terminal,
                }
            }
            Replan::FromState => {
                // At the very end there is nothing left to plan: the old plan's end serves.
                let length_m = (s.length_m - s.x_m).max(LEAST_PLAN_M);
                let problem = Problem { beta: self.beta, v0_mps: s.v_mps, length_m, terminal: s.terminal };
                Reference {
                    start_s: s.time_s,
                    origin_m: s.x_m,
                    v0_mps: s.v_mps,
                    optimum: problem.solve_forward(law),
                    terminal: s.terminal,
                }
            }
        }
    }

    /// Adds all rows but the acceleration limits.
    #[inline(always)]
    fn rows<P, R>(&self, s: &Situation, partners: P, rows: &mut R)
    where
        P: Iterator<Item = Partner>,
        R: Rows,
    {
        let (k_v, vehicle) = (self.control.k_speed_per_s, self.vehicle(s));
        rows.at_least(k_v * (vehicle.v_min_mps - s.v_mps), Row::VMin);
        let v_max_bound = k_v * (vehicle.v_max_mps - s.v_mps);
        rows.at_most(Inequality { coefficient: 1.0, bound: v_max_bound }, Row::VMax);
        for partner in partners {
            let pair = pair(s, &partner);
            if partner.kind == DutyKind::RearEnd {
                let rear_end = self.rear_end(vehicle, &partner);
                let row = match self.control.safety_rows {
                    SafetyRows::Continuous => rear_end.row(&pair),
                    SafetyRows::Sampled => rear_end.sampled_row(&pair, self.dt_s),
                };
                rows.at_most(row, Row::RearEnd);
                if self.control.feasibility_rows {
                    rows.at_most(rear_end.feasibility_row(&pair), Row::RearEndFeasibility);
                }
                continue;
            }
            let merge = self.merge(vehicle, &partner);
            let crosses = partner.kind == DutyKind::Cross;
            rows.at_most(merge.row(&pair), if crosses { Row::Cross } else { Row::Merge });
            if self.control.feasibility_rows {
                let row = if crosses { Row::CrossFeasibility } else { Row::MergeFeasibility };
                rows.at_most(merge.feasibility_row(&pair), row);
            }
        }
    }

    /// Whether all conditions for leaving FE mode hold (section "Feasibility Enforcement Mode").
    fn entry_conditions_hold<P: Iterator<Item = Partner>>(&self, s: &Situation, mut partners: P) -> bool {
        let vehicle = self.vehicle(s);
        let is_full = match self.control.fe_conditions {
            FeConditions::Off => return true,
            FeConditions::Barrier => false,
            FeConditions::Full => true,
        };
        partners.all(|partner| {
            let pair = pair(s, &partner);
            match (partner.kind, is_full) {
                (DutyKind::RearEnd, false) => self.rear_end(vehicle, &partner).margin_m(&pair) >= 0.0,
                (DutyKind::RearEnd, true) => self.rear_end(vehicle, &partner).may_be_tracked(&pair),
                (_, false) => self.merge(vehicle, &partner).margin_m(&pair) >= 0.0,
                (_, true) => self.merge(vehicle, &partner).may_be_tracked(&pair),
            }
        })
    }

    #[inline(always)]
    fn rear_end(&self, vehicle: &VehicleParams, partner: &Partner) -> RearEnd {
        RearEnd {
            reaction_s: vehicle.reaction_time_s,
            gap_m: partner.gap_m,
            k_per_s: self.control.k_rear_end_per_s,
            u_min_mps2: vehicle.u_min_mps2,
        }
    }

    /// The row of a merge serves at crossings as well, with the distance to be kept there.
    #[inline(always)]
    fn merge(&self, vehicle: &VehicleParams, partner: &Partner) -> Merge {
        Merge {
            reaction_per_length: vehicle.reaction_time_s / partner.conflict_m,
            gap_m: partner.gap_m,
            k_per_s: self.control.k_merge_per_s,
            u_min_mps2: vehicle.u_min_mps2,
        }
    }
}

fn pair(s: &Situation, partner: &Partner) -> Pair {
    Pair {
        x_m: s.x_m,
        v_mps: s.v_mps,
        partner_x_m: partner.x_m,
        partner_v_mps: partner.v_mps,
        partner_u_mps2: partner.u_mps2,
    }
}

/// The mean optimal terminal speed over entry speeds: the computed baseline v_b, m/s.
pub fn mean_optimal_terminal_speed_mps(scenario: &Scenario, length_m: f64, entry_speeds_mps: &[f64]) -> f64 {
    let sum: f64 = entry_speeds_mps
        .iter()
        .map(|&v0| {
            reference::optimal_terminal_speed_mps(scenario.control.reference, scenario.beta, v0, length_m)
        })
        .sum();
    sum / entry_speeds_mps.len() as f64
}
