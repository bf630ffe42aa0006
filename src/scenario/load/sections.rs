//! Vehicle limits, objective, control law and flow policies.

use super::error::ScenarioError;
use super::table::Table;
use crate::scenario::{
    Baseline, ControlParams, CoordinationParams, EntryRule, FeConditions, FlowPolicy, LawKind, Observed,
    PassingOrder, PositionFeedback, ReferenceLaw, Replan, SafetyRows, ScheduleKind, Solver, VehicleKind,
    VehicleParams, ViableParams, ranges,
};

/// No more kinds of vehicles than this.
pub(in crate::scenario) const MAX_KINDS: usize = 64;

/// `[vehicle]`, or the defaults.
pub(super) fn vehicle(table: Option<&Table<'_>>) -> Result<VehicleParams, ScenarioError> {
    let mut params = VehicleParams {
        u_min_mps2: -4.0,
        u_max_mps2: 4.0,
        v_min_mps: 0.0,
        v_max_mps: 30.0,
        length_m: 4.5,
        reaction_time_s: 1.8,
        standstill_gap_m: 0.0,
    };
    let Some(t) = table else { return Ok(params) };
    t.only(&VEHICLE_KEYS)?;
    read_vehicle(t, &mut params)?;
    Ok(params)
}

const VEHICLE_KEYS: [&str; 7] =
    ["u_min_mps2", "u_max_mps2", "v_min_mps", "v_max_mps", "length_m", "reaction_time_s", "standstill_gap_m"];

/// Reads what a table says of vehicles; what it does not say stays as it is.
fn read_vehicle(t: &Table<'_>, p: &mut VehicleParams) -> Result<(), ScenarioError> {
    p.u_min_mps2 = t.within_or("u_min_mps2", p.u_min_mps2, &ranges::BRAKING)?;
    p.u_max_mps2 = t.within_or("u_max_mps2", p.u_max_mps2, &ranges::ACCELERATION)?;
    p.v_min_mps = t.within_or("v_min_mps", p.v_min_mps, &ranges::LEAST_SPEED)?;
    let v_min = p.v_min_mps;
    let is_greatest = |v| v > v_min && ranges::GREATEST_SPEED.contains(v);
    let expected = format!("{}, > v_min_mps = {v_min}", ranges::GREATEST_SPEED);
    p.v_max_mps = t.f64_or("v_max_mps", p.v_max_mps, is_greatest, &expected)?;
    p.length_m = t.within_or("length_m", p.length_m, &ranges::VEHICLE_LENGTH)?;
    p.reaction_time_s = t.within_or("reaction_time_s", p.reaction_time_s, &ranges::REACTION_TIME)?;
    p.standstill_gap_m = t.within_or("standstill_gap_m", p.standstill_gap_m, &ranges::STANDSTILL_GAP)?;
    Ok(())
}

/// `[[fleet]]`: kinds of vehicles, each with the keys of `[vehicle]` in which it differs; without it, one kind.
pub(super) fn fleet(root: &Table<'_>, vehicle: &VehicleParams) -> Result<Vec<VehicleKind>, ScenarioError> {
    if root.get("fleet").is_none() {
        return Ok(vec![VehicleKind { name: "cav".to_owned(), share: 1.0, vehicle: *vehicle }]);
    }
    let tables = root.tables("fleet", "a list of kinds of vehicles, each with a name")?;
    let names = super::topology::unique_names(&tables, "kind of vehicle")?;
    let mut kinds = Vec::with_capacity(tables.len());
    for (t, name) in tables.iter().zip(names) {
        t.only(&[&["name", "share"][..], &VEHICLE_KEYS].concat())?;
        if kinds.len() == MAX_KINDS {
            return Err(t.need("name", "")?.bad(&format!("at most {MAX_KINDS} kinds")));
        }
        let mut own = *vehicle;
        read_vehicle(t, &mut own)?;
        if own.v_max_mps > vehicle.v_max_mps {
            let expected = format!("at most that of [vehicle], {} m/s", vehicle.v_max_mps);
            return Err(t.need("v_max_mps", &expected)?.bad(&expected));
        }
        let share = t.within_or("share", 1.0, &ranges::SHARE)?;
        kinds.push(VehicleKind { name: name.to_owned(), share, vehicle: own });
    }
    Ok(kinds)
}

/// `law` of `[control]` or of a zone.
pub(super) fn law(table: Option<&Table<'_>>, default: LawKind) -> Result<LawKind, ScenarioError> {
    match table.and_then(|t| t.get("law")) {
        None => Ok(default),
        Some(field) => field.choice(&[("ocbf", LawKind::Ocbf), ("viable", LawKind::Viable)]),
    }
}

/// `entry` of `[gate]` or of a road.
pub(super) fn entry(table: Option<&Table<'_>>, default: EntryRule) -> Result<EntryRule, ScenarioError> {
    match table.and_then(|t| t.get("entry")) {
        None => Ok(default),
        Some(field) => field.choice(&[
            ("free", EntryRule::Free),
            ("viable", EntryRule::Viable),
            ("room_to_stop", EntryRule::RoomToStop),
        ]),
    }
}

/// `[objective]`: beta, in m^2/s^4, given or from alpha.
pub(super) fn beta(table: &Table<'_>, vehicle: &VehicleParams) -> Result<f64, ScenarioError> {
    const ALPHA: &str = "a weight with 0 < alpha < 1";
    table.only(&["alpha", "beta"])?;
    match table.either("alpha", "beta") {
        (Some(_), Some(beta)) => {
            Err(beta.bad_because(Some("alpha is given as well".into()), "either alpha or beta"))
        }
        (None, None) => Err(table.missing("beta", &format!("{}, or alpha instead", ranges::BETA))),
        (None, Some(beta)) => beta.within(&ranges::BETA),
        (Some(field), None) => {
            let alpha = field.f64(|a| a > 0.0 && a < 1.0, ALPHA)?;
            let u = vehicle.u_max_mps2.max(-vehicle.u_min_mps2);
            let beta = alpha * u * u / (2.0 * (1.0 - alpha));
            if ranges::BETA.contains(beta) {
                Ok(beta)
            } else {
                let expected = format!("{ALPHA} that gives {} as beta", ranges::BETA);
                Err(field.bad_because(Some(format!("it gives beta = {beta:?}")), &expected))
            }
        }
    }
}

/// `[control]`, or the defaults; `beta` is the default slack weight.
pub(super) fn control(table: Option<&Table<'_>>, beta: f64) -> Result<ControlParams, ScenarioError> {
    let mut params = ControlParams {
        reference: ReferenceLaw::Corrected,
        replan: Replan::FromEntry,
        position_feedback: PositionFeedback::Approximate,
        solver: Solver::ClosedForm,
        safety_rows: SafetyRows::Continuous,
        k_rear_end_per_s: 1.0,
        k_merge_per_s: 1.0,
        k_speed_per_s: 1.0,
        clf_rate_per_s: 10.0,
        slack_weight: beta,
        clf: true,
        feasibility_rows: true,
        fe_conditions: FeConditions::Full,
        fe_fraction: 0.25,
        viable: ViableParams::DEFAULT,
    };
    let Some(t) = table else { return Ok(params) };
    t.only(&[
        "law",
        "reference",
        "replan",
        "position_feedback",
        "solver",
        "safety_rows",
        "k_rear_end_per_s",
        "k_merge_per_s",
        "k_speed_per_s",
        "clf_rate_per_s",
        "slack_weight",
        "clf",
        "feasibility_rows",
        "fe_conditions",
        "fe_fraction",
        "viable",
    ])?;
    let gain = |key, default| t.within_or(key, default, &ranges::GAIN);
    let p = &mut params;
    p.reference = t.choice_or_first(
        "reference",
        &[("corrected", ReferenceLaw::Corrected), ("as_printed", ReferenceLaw::AsPrinted)],
    )?;
    p.replan =
        t.choice_or_first("replan", &[("from_entry", Replan::FromEntry), ("from_state", Replan::FromState)])?;
    p.position_feedback = t.choice_or_first(
        "position_feedback",
        &[("approximate", PositionFeedback::Approximate), ("exact", PositionFeedback::Exact)],
    )?;
    p.solver =
        t.choice_or_first("solver", &[("closed_form", Solver::ClosedForm), ("clarabel", Solver::Clarabel)])?;
    p.safety_rows = t.choice_or_first(
        "safety_rows",
        &[("continuous", SafetyRows::Continuous), ("sampled", SafetyRows::Sampled)],
    )?;
    p.k_rear_end_per_s = gain("k_rear_end_per_s", p.k_rear_end_per_s)?;
    p.k_merge_per_s = gain("k_merge_per_s", p.k_merge_per_s)?;
    p.k_speed_per_s = gain("k_speed_per_s", p.k_speed_per_s)?;
    p.clf_rate_per_s = gain("clf_rate_per_s", p.clf_rate_per_s)?;
    p.slack_weight = t.within_or("slack_weight", p.slack_weight, &ranges::SLACK_WEIGHT)?;
    p.clf = t.bool_or("clf", p.clf)?;
    p.feasibility_rows = t.bool_or("feasibility_rows", p.feasibility_rows)?;
    p.fe_conditions = t.choice_or_first(
        "fe_conditions",
        &[("full", FeConditions::Full), ("barrier", FeConditions::Barrier), ("off", FeConditions::Off)],
    )?;
    p.fe_fraction = t.f64_or(
        "fe_fraction",
        p.fe_fraction,
        |f| f > 0.0 && f <= 1.0,
        "a fraction with 0 < fe_fraction <= 1",
    )?;
    if let Some(field) = t.get("viable") {
        p.viable = viable(&field.table("a table such as {k_comfort_per_s = 1}")?)?;
    }
    Ok(params)
}

/// `control.viable`.
fn viable(t: &Table<'_>) -> Result<ViableParams, ScenarioError> {
    t.only(&[
        "viability",
        "comfort",
        "bodies",
        "slots",
        "k_comfort_per_s",
        "k_recovery_per_s",
        "clearance_m",
        "buffer_m",
        "buffer_s",
        "passage_weight",
    ])?;
    let default = ViableParams::DEFAULT;
    Ok(ViableParams {
        viability: t.bool_or("viability", default.viability)?,
        comfort: t.bool_or("comfort", default.comfort)?,
        bodies: t.bool_or("bodies", default.bodies)?,
        slots: t.bool_or("slots", default.slots)?,
        k_comfort_per_s: t.within_or("k_comfort_per_s", default.k_comfort_per_s, &ranges::GAIN)?,
        k_recovery_per_s: t.within_or("k_recovery_per_s", default.k_recovery_per_s, &ranges::GAIN)?,
        clearance_m: t.within_or("clearance_m", default.clearance_m, &ranges::STANDSTILL_GAP)?,
        buffer_m: t.within_or("buffer_m", default.buffer_m, &ranges::STANDSTILL_GAP)?,
        buffer_s: t.within_or("buffer_s", default.buffer_s, &ranges::REACTION_TIME)?,
        passage_weight: t.within_or("passage_weight", default.passage_weight, &ranges::SHARE)?,
    })
}

/// `[coordination]`, or the defaults, and the passing order of zones that name none.
pub(super) fn coordination(
    table: Option<&Table<'_>>,
) -> Result<(CoordinationParams, PassingOrder), ScenarioError> {
    let mut params = CoordinationParams::DEFAULT;
    let Some(t) = table else { return Ok((params, PassingOrder::default())) };
    t.only(&["schedule", "price_of_time", "tandem_weight", "order"])?;
    params.schedule = t.choice_or_first(
        "schedule",
        &[("none", ScheduleKind::None), ("pooled", ScheduleKind::Pooled), ("tandem", ScheduleKind::Tandem)],
    )?;
    params.price_of_time = t.within_or("price_of_time", params.price_of_time, &ranges::PRICE_OF_TIME)?;
    params.tandem_weight = t.within_or("tandem_weight", params.tandem_weight, &ranges::TANDEM_WEIGHT)?;
    Ok((params, order(t, PassingOrder::default())?))
}

/// `order` of a table.
pub(super) fn order(t: &Table<'_>, default: PassingOrder) -> Result<PassingOrder, ScenarioError> {
    t.get("order").map_or(Ok(default), |field| {
        field.choice(&[
            ("fifo", PassingOrder::Fifo),
            ("per_point", PassingOrder::PerPoint),
            ("resequenced", PassingOrder::Resequenced),
        ])
    })
}

/// What a zone's policy can observe: the lengths of the approaches of the zone downstream, if there is one.
pub(super) struct Downstream<'a> {
    pub(super) zone: &'a str,
    pub(super) longest_m: f64,
}

/// `zones.*.flow`, or no flow control.
pub(super) fn flow(
    zone: &Table<'_>,
    downstream: Option<&Downstream<'_>>,
    vehicle: &VehicleParams,
) -> Result<FlowPolicy, ScenarioError> {
    #[derive(Clone, Copy, PartialEq)]
    enum Kind {
        None,
        Fixed,
        Feedback,
        MeanSpeed,
        Predicted,
    }
    let Some(field) = zone.get("flow") else { return Ok(FlowPolicy::None) };
    const POLICY: &str = "a table such as {policy = \"fixed\", terminal_mps = 15}";
    let mut t = field.table(POLICY)?;
    let all = [
        "policy",
        "terminal_mps",
        "baseline_mps",
        "baseline_entry_speeds_mps",
        "gain_mps",
        "segment_m",
        "min_mps",
        "offset_mps",
    ];
    // Without a policy the other keys cannot be judged; a misspelt "policy" is still found here.
    t.only(&all)?;
    let policy = t.need("policy", "\"none\", \"fixed\", \"feedback\", \"mean_speed\" or \"predicted\"")?;
    let kind = policy.choice(&[
        ("none", Kind::None),
        ("fixed", Kind::Fixed),
        ("feedback", Kind::Feedback),
        ("mean_speed", Kind::MeanSpeed),
        ("predicted", Kind::Predicted),
    ])?;
    let known: &[&str] = match kind {
        Kind::None => &["policy"],
        Kind::Fixed => &["policy", "terminal_mps"],
        Kind::Feedback => {
            &["policy", "baseline_mps", "baseline_entry_speeds_mps", "gain_mps", "segment_m", "min_mps"]
        }
        Kind::Predicted => &["policy", "min_mps"],
        Kind::MeanSpeed => &["policy", "offset_mps", "gain_mps", "segment_m", "min_mps"],
    };
    t.only_or_stale(known, if policy.is_set() { &all } else { &[] })?;
    t.blame(&policy);

    let v_max = vehicle.v_max_mps;
    let (is_speed, speed) = flow_speed(v_max);
    if kind == Kind::None {
        return Ok(FlowPolicy::None);
    }
    if kind == Kind::Fixed {
        return Ok(FlowPolicy::Fixed { terminal_mps: t.f64("terminal_mps", is_speed, &speed)? });
    }
    let Some(downstream) = downstream else {
        let problem = "the zone's exit leads out of the network, there is nothing to observe".to_owned();
        return Err(policy.bad_because(Some(problem), "\"none\" or \"fixed\""));
    };
    if kind == Kind::Predicted {
        return Ok(FlowPolicy::Predicted { min_mps: t.f64_or("min_mps", 5.0, is_speed, &speed)? });
    }
    let longest = downstream.longest_m;
    let segment_ok = |l| l > 0.0 && l <= longest;
    let segment = format!(
        "a length with 0 < l <= {longest} m, the longest approach of the zone downstream, {}",
        downstream.zone
    );
    let gain_mps = t.within("gain_mps", &ranges::FLOW_GAIN)?;
    let min_mps = t.f64_or("min_mps", 5.0, is_speed, &speed)?;
    if kind == Kind::MeanSpeed {
        return Ok(FlowPolicy::MeanSpeed {
            offset_mps: t.within("offset_mps", &ranges::FLOW_OFFSET)?,
            gain_mps,
            segment_m: t.f64("segment_m", segment_ok, &segment)?,
            min_mps,
        });
    }
    let segment = match t.get("segment_m") {
        None => Observed::Whole,
        Some(field) => Observed::First(field.f64(segment_ok, &segment)?),
    };
    Ok(FlowPolicy::Feedback { baseline: baseline(&t, v_max)?, gain_mps, segment, min_mps })
}

/// Whether a speed is one that vehicles may be told to leave at, and what is expected.
fn flow_speed(v_max: f64) -> (impl Fn(f64) -> bool + Copy, String) {
    let expected = format!("{} and <= v_max_mps = {v_max}", ranges::FLOW_SPEED);
    (move |v| ranges::FLOW_SPEED.contains(v) && v <= v_max, expected)
}

/// `baseline_mps`: a speed, or "optimal" with the entry speeds to take the mean over.
fn baseline(t: &Table<'_>, v_max: f64) -> Result<Baseline, ScenarioError> {
    let (is_speed, speed) = flow_speed(v_max);
    let expected = format!("{speed}, or \"optimal\"");
    let field = t.need("baseline_mps", &expected)?;
    let samples = t.get("baseline_entry_speeds_mps");
    if field.str("").is_ok_and(|word| word == "optimal") {
        let list = format!("a list of speeds, each {speed}");
        let speeds: Vec<f64> = match samples {
            Some(samples) => {
                let items = samples.items(&list)?;
                items.iter().map(|item| item.f64(is_speed, &speed)).collect::<Result<_, _>>()?
            }
            None => (10..=20).map(f64::from).filter(|&v| v <= v_max).collect(),
        };
        if speeds.is_empty() {
            return Err(t.missing("baseline_entry_speeds_mps", &format!("{list} (the defaults exceed it)")));
        }
        return Ok(Baseline::Optimal(speeds));
    }
    let given = field.f64(is_speed, &expected)?;
    match samples {
        // Left over from the file's "optimal" when a --set gives the speed.
        Some(samples) if samples.is_set() || !field.is_set() => {
            Err(samples.bad_because(Some(format!("baseline_mps is {given}")), "it only with \"optimal\""))
        }
        _ => Ok(Baseline::Given(given)),
    }
}
