//! The law of one vehicle: feasibility-enforcement mode, then optimal tracking under barrier rows.

use super::qp::{self, Tracking};
use super::reference::{Problem, Reference, Terminal};
use super::rows::{Interval, Row, Rows};
use super::{clarabel, reference};
use crate::scenario::{FeConditions, Replan, SafetyRows, Scenario, Solver};
use crate::vehicle::{Inequality, Merge, Pair, RearEnd, satisfiable_at};
use std::hint::select_unpredictable;

/// What the partner is to the vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PartnerKind {
    /// Drives ahead on the same path (paper: i_p).
    RearEnd,
    /// Passes the conflict point first, from another path (paper: i-1).
    Merge,
}

/// A vehicle this one must respect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Partner {
    /// Which constraint it imposes.
    pub kind: PartnerKind,
    /// Its position in the vehicle's own coordinate: as far from the conflict point as it is on its
    /// own path, m.
    pub x_m: f64,
    /// Its speed, m/s.
    pub v_mps: f64,
    /// Its acceleration over the step just ended, m/s^2.
    pub u_mps2: f64,
    /// Distance of the shared conflict point from the origin on the vehicle's path, m (paper: L).
    pub conflict_m: f64,
}

/// A vehicle at the start of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Situation {
    /// Simulated time, s.
    pub time_s: f64,
    /// Position since the zone's origin, m.
    pub x_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
    /// Instant of entry, s.
    pub entry_time_s: f64,
    /// Speed at entry, m/s.
    pub entry_speed_mps: f64,
    /// Length of the approach, m.
    pub length_m: f64,
    /// Terminal condition in force.
    pub terminal: Terminal,
}

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
}

/// Why the command is what it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The reference is tracked as wished.
    Nominal,
    /// FE mode brakes.
    Fe,
    /// A row decides.
    Bound(Row),
    /// No acceleration satisfies all rows; `u_min` is commanded.
    Infeasible,
}

/// The command and its reason.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// Acceleration for the step, m/s^2.
    pub u_mps2: f64,
    /// Why.
    pub verdict: Verdict,
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
pub struct Law {
    control: crate::scenario::ControlParams,
    vehicle: crate::scenario::VehicleParams,
    rear_end: RearEnd,
    beta: f64,
    dt_s: f64,
    slack_weight: f64,
}

/// Remaining lengths below this are not worth a new plan, m.
const LEAST_PLAN_M: f64 = 1e-3;

impl Law {
    /// The law of a scenario.
    pub fn new(scenario: &Scenario) -> Law {
        let (control, vehicle) = (scenario.control, scenario.vehicle);
        Law {
            control,
            vehicle,
            rear_end: RearEnd {
                reaction_s: vehicle.reaction_time_s,
                gap_m: vehicle.standstill_gap_m,
                k_per_s: control.k_rear_end_per_s,
                u_min_mps2: vehicle.u_min_mps2,
            },
            beta: scenario.beta,
            dt_s: scenario.dt_s(),
            slack_weight: if control.clf { control.slack_weight } else { 0.0 },
        }
    }

    /// Decides one vehicle's command and updates its memory.
    // In one piece with `program`: handed over in memory, a program is stored field by field and at once
    // loaded two fields at a time, for which the processor waits.
    #[inline(always)]
    pub fn decide<P>(&self, s: &Situation, partners: P, memory: &mut Memory) -> Decision
    where
        P: Iterator<Item = Partner> + Clone,
    {
        let Some(Program { tracking, interval }) = self.program(s, partners.clone(), memory) else {
            return Decision { u_mps2: self.vehicle.u_min_mps2, verdict: Verdict::Fe };
        };
        let u = match self.control.solver {
            Solver::ClosedForm => qp::solve(&tracking, &interval),
            Solver::Clarabel => {
                // The limits once more, so that an answer within the solver's tolerance obeys them.
                clarabel::solve(&tracking, &self.row_list(s, partners))
                    .map(|u| u.clamp(self.vehicle.u_min_mps2, self.vehicle.u_max_mps2))
            }
        };
        match u {
            None => Decision { u_mps2: self.vehicle.u_min_mps2, verdict: Verdict::Infeasible },
            Some(u) => {
                let wish = tracking.free_minimum_mps2();
                let (above, below) = (wish > interval.high, wish < interval.low);
                let row = select_unpredictable(above, interval.high_row, interval.low_row);
                let verdict = select_unpredictable(above || below, Verdict::Bound(row), Verdict::Nominal);
                Decision { u_mps2: u, verdict }
            }
        }
    }

    /// The program of `equ:ocbf_qp` for this step; `None` in FE mode, which does not solve one.
    #[inline(always)]
    pub fn program<P>(&self, s: &Situation, partners: P, memory: &mut Memory) -> Option<Program>
    where
        P: Iterator<Item = Partner> + Clone,
    {
        if memory.mode == Mode::Fe {
            let may_brake = s.x_m <= self.control.fe_fraction * s.length_m;
            if may_brake && !self.entry_conditions_hold(s, partners.clone()) {
                return None;
            }
            memory.mode = Mode::Ocbf;
        }
        let plan = self.plan(s, memory);
        let (v_ref, u_ref) = plan.at(self.control.position_feedback, s.time_s, s.x_m);
        let tracking = Tracking {
            u_ref_mps2: u_ref,
            error_mps: s.v_mps - v_ref,
            clf_rate_per_s: self.control.clf_rate_per_s,
            slack_weight: self.slack_weight,
        };
        let mut interval = Interval::limits(self.vehicle.u_min_mps2, self.vehicle.u_max_mps2);
        self.rows(s, partners, &mut interval);
        Some(Program { tracking, interval })
    }

    /// All rows, one by one, limits included, as a general solver wants them.
    pub fn row_list<P: Iterator<Item = Partner>>(
        &self,
        s: &Situation,
        partners: P,
    ) -> Vec<(Inequality, Row)> {
        let mut rows: Vec<(Inequality, Row)> = Vec::with_capacity(12);
        rows.at_least(self.vehicle.u_min_mps2, Row::UMin);
        rows.at_most(Inequality { coefficient: 1.0, bound: self.vehicle.u_max_mps2 }, Row::UMax);
        self.rows(s, partners, &mut rows);
        rows
    }

    /// The plan in force: made when there is none, re-made when the terminal condition changed.
    #[inline]
    fn plan<'m>(&self, s: &Situation, memory: &'m mut Memory) -> &'m Reference {
        match memory.plan {
            Some(plan) if plan.terminal == s.terminal => {}
            old => memory.plan = Some(self.new_plan(s, old)),
        }
        memory.plan.as_ref().expect("there was a plan, or one has just been made")
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
    #[inline]
    fn rows<P, R>(&self, s: &Situation, partners: P, rows: &mut R)
    where
        P: Iterator<Item = Partner>,
        R: Rows,
    {
        let k_v = self.control.k_speed_per_s;
        rows.at_least(k_v * (self.vehicle.v_min_mps - s.v_mps), Row::VMin);
        let v_max_bound = k_v * (self.vehicle.v_max_mps - s.v_mps);
        rows.at_most(Inequality { coefficient: 1.0, bound: v_max_bound }, Row::VMax);
        for partner in partners {
            let pair = pair(s, &partner);
            match partner.kind {
                PartnerKind::RearEnd => {
                    let row = match self.control.safety_rows {
                        SafetyRows::Continuous => self.rear_end.row(&pair),
                        SafetyRows::Sampled => self.rear_end.sampled_row(&pair, self.dt_s),
                    };
                    rows.at_most(row, Row::RearEnd);
                    if self.control.feasibility_rows {
                        rows.at_most(self.rear_end.feasibility_row(&pair), Row::RearEndFeasibility);
                    }
                }
                PartnerKind::Merge => {
                    let merge = self.merge(&partner);
                    rows.at_most(merge.row(&pair), Row::Merge);
                    if self.control.feasibility_rows {
                        rows.at_most(merge.feasibility_row(&pair), Row::MergeFeasibility);
                    }
                }
            }
        }
    }

    /// Whether all conditions for leaving FE mode hold (section "Feasibility Enforcement Mode").
    fn entry_conditions_hold<P: Iterator<Item = Partner>>(&self, s: &Situation, mut partners: P) -> bool {
        let u_min = self.vehicle.u_min_mps2;
        match self.control.fe_conditions {
            FeConditions::Off => true,
            FeConditions::Barrier => partners.all(|partner| {
                let pair = pair(s, &partner);
                match partner.kind {
                    PartnerKind::RearEnd => self.rear_end.margin_m(&pair) >= 0.0,
                    PartnerKind::Merge => self.merge(&partner).margin_m(&pair) >= 0.0,
                }
            }),
            FeConditions::Full => partners.all(|partner| {
                let pair = pair(s, &partner);
                match partner.kind {
                    PartnerKind::RearEnd => {
                        self.rear_end.margin_m(&pair) >= 0.0
                            && satisfiable_at(&self.rear_end.row(&pair), u_min)
                            && self.rear_end.reserve_mps(&pair) >= 0.0
                    }
                    PartnerKind::Merge => {
                        let merge = self.merge(&partner);
                        merge.margin_m(&pair) >= 0.0
                            && satisfiable_at(&merge.row(&pair), u_min)
                            && merge.reserve_mps(&pair) >= 0.0
                    }
                }
            }),
        }
    }

    fn merge(&self, partner: &Partner) -> Merge {
        Merge {
            reaction_per_length: self.vehicle.reaction_time_s / partner.conflict_m,
            gap_m: self.vehicle.standstill_gap_m,
            k_per_s: self.control.k_merge_per_s,
            u_min_mps2: self.vehicle.u_min_mps2,
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
