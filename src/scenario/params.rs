//! Parameters of vehicles, controllers and flow policies.

use super::human::HumanParams;
use super::keys;
use serde::{Deserialize, Serialize};

/// Limits every vehicle obeys, and the distances it keeps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleParams {
    /// Strongest braking, m/s^2, negative.
    pub u_min_mps2: f64,
    /// Strongest acceleration, m/s^2, positive.
    pub u_max_mps2: f64,
    /// Least speed, m/s, >= 0.
    pub v_min_mps: f64,
    /// Greatest speed, m/s.
    pub v_max_mps: f64,
    /// Vehicle length, m: the body reaches back by it from the position.
    pub length_m: f64,
    /// Reaction time, s (paper: phi in `Safety`).
    pub reaction_time_s: f64,
    /// Standstill gap, centre to centre, m (paper: delta).
    pub standstill_gap_m: f64,
}

/// A kind of vehicle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleKind {
    /// Unique name.
    pub name: String,
    /// Weight with which vehicles are of this kind.
    pub share: f64,
    /// Limits, length and distances. Of a human's vehicle the limits are what others may assume of it.
    pub vehicle: VehicleParams,
    /// Who drives it: a human, or else whoever is commissioned.
    #[serde(default)]
    pub human: Option<HumanParams>,
}

/// Which necessary condition the reference trajectory satisfies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReferenceLaw {
    /// beta - b^2/2 + a c = 0, the correct transversality condition (quartic in T).
    Corrected,
    /// beta - b/2 + a c = 0 as the paper prints it (cubic in T), for reproduction.
    AsPrinted,
}

/// Where a new plan starts when the terminal speed changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Replan {
    /// The plan from the entry is perturbed (paper: `equ:delta_t`).
    FromEntry,
    /// A new plan from the vehicle's position and speed.
    FromState,
}

/// How the reference time is found from the position.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PositionFeedback {
    /// One Newton step: `t - (x*(t) - x) / v*(t)`.
    Approximate,
    /// The root of `x*(t_ref) = x`.
    Exact,
}

/// Who solves the QP of `equ:ocbf_qp`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// The exact closed form.
    ClosedForm,
    /// The Clarabel interior-point solver, as reference.
    Clarabel,
}

/// Which conditions keep a vehicle in feasibility-enforcement mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FeConditions {
    /// Barriers non-negative, rows satisfiable at u_min, and what the feasibility rows keep invariant.
    Full,
    /// Only the barriers.
    Barrier,
    /// There is no FE mode.
    Off,
}

/// The form of the safety rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SafetyRows {
    /// The continuous-time barrier rows of the paper.
    Continuous,
    /// The rear-end row for a command held over the step, with the partner's last acceleration.
    Sampled,
}

/// The controllers' law.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ControlParams {
    /// Transversality condition of the reference.
    pub reference: ReferenceLaw,
    /// Where re-planning starts.
    pub replan: Replan,
    /// Reference time from position.
    pub position_feedback: PositionFeedback,
    /// QP solver.
    pub solver: Solver,
    /// Form of the safety rows.
    pub safety_rows: SafetyRows,
    /// Rear-end barrier gain k1, 1/s.
    pub k_rear_end_per_s: f64,
    /// Merging barrier gain k2, 1/s.
    pub k_merge_per_s: f64,
    /// Speed barrier gain k_v, 1/s.
    pub k_speed_per_s: f64,
    /// CLF rate epsilon, 1/s.
    pub clf_rate_per_s: f64,
    /// Weight lambda of the squared slack.
    pub slack_weight: f64,
    /// Whether the CLF row is present.
    pub clf: bool,
    /// Whether the feasibility rows (`equ:candidate`, `equ:candidate2`) are present.
    pub feasibility_rows: bool,
    /// Entry conditions of FE mode.
    pub fe_conditions: FeConditions,
    /// Fraction of the path within which FE mode may act (paper: L/4).
    pub fe_fraction: f64,
    /// What concerns the law `viable` alone.
    pub viable: ViableParams,
}

/// The law `viable` (docs/control.md); each of its parts can be switched off alone, to see what it contributes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViableParams {
    /// Whether accelerations are bounded by what is viable: the first tier.
    pub viability: bool,
    /// Whether there is the comfort row toward leaders.
    pub comfort: bool,
    /// Whether there is the second tier: nobody drives through anybody.
    pub bodies: bool,
    /// Whether slots behind partners are kept.
    pub slots: bool,
    /// Gain of the comfort row, 1/s.
    pub k_comfort_per_s: f64,
    /// What a metre of missing margin costs a second, m/s^4: where it is negative, the comfort row recovers accordingly.
    pub price_of_exposure_mps4: f64,
    /// Distance between bodies that the second tier keeps, m.
    pub clearance_m: f64,
    /// Distance added to a slot, m,
    pub buffer_m: f64,
    /// in proportion to the time to go where that is less than this, s.
    pub buffer_s: f64,
    /// How many others' time counts when a slow passage holds up those behind.
    pub passage_weight: f64,
}

impl ViableParams {
    /// What holds when a scenario says nothing.
    pub const DEFAULT: ViableParams = ViableParams {
        viability: true,
        comfort: true,
        bodies: true,
        slots: true,
        k_comfort_per_s: 2.0,
        price_of_exposure_mps4: 0.877,
        clearance_m: 1.0,
        buffer_m: 0.3,
        buffer_s: 3.0,
        passage_weight: 10.0,
    };
}

/// Whether coordinators schedule the instants at which vehicles leave their zone.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScheduleKind {
    /// They do not.
    #[default]
    None,
    /// At least cost over the vehicles of the zone.
    Pooled,
    /// At least cost over the vehicles of the zone and of its neighbours, over this zone and the next.
    Tandem,
}

impl ScheduleKind {
    /// The words a scenario uses, the default first.
    pub(super) const WORDS: &'static [(&'static str, ScheduleKind)] =
        &[("none", ScheduleKind::None), ("pooled", ScheduleKind::Pooled), ("tandem", ScheduleKind::Tandem)];
}

/// What coordinators do beside assigning duties.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CoordinationParams {
    /// Whether they schedule.
    pub schedule: ScheduleKind,
    /// What a second costs those who are not there yet, as a share of what it costs the vehicle itself: the last
    /// vehicle weighs time with 1 + this, the others with 1 + 0.3 of this.
    pub price_of_time: f64,
    /// Weight omega of the next zone's cost beside this one's, in (0, 1].
    pub tandem_weight: f64,
}

impl CoordinationParams {
    /// No schedules.
    pub const DEFAULT: CoordinationParams = CoordinationParams {
        schedule: ScheduleKind::None,
        price_of_time: keys::PRICE_OF_TIME.default(),
        tandem_weight: keys::TANDEM_WEIGHT.default(),
    };
}
