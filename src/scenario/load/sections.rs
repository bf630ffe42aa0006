//! Vehicle limits, objective, control law and flow policies.

use super::error::ScenarioError;
use super::table::Table;
use crate::scenario::{
    Baseline, ControlParams, EntryRule, FlowPolicy, LawKind, Observed, VehicleKind, VehicleParams,
    ViableParams, keys, ranges,
};

/// No more kinds of vehicles than this.
pub(in crate::scenario) const MAX_KINDS: usize = 64;

/// `[vehicle]`, or the defaults.
pub(super) fn vehicle(table: Option<&Table<'_>>) -> Result<VehicleParams, ScenarioError> {
    let mut params = VehicleParams {
        u_min_mps2: keys::U_MIN.default(),
        u_max_mps2: keys::U_MAX.default(),
        v_min_mps: keys::V_MIN.default(),
        v_max_mps: keys::V_MAX.default(),
        length_m: keys::LENGTH.default(),
        reaction_time_s: keys::REACTION_TIME.default(),
        standstill_gap_m: keys::STANDSTILL_GAP.default(),
    };
    let Some(t) = table else { return Ok(params) };
    t.only_declared(keys::VEHICLE)?;
    read_vehicle(t, &mut params)?;
    Ok(params)
}

/// Reads what a table says of vehicles; what it does not say stays as it is.
fn read_vehicle(t: &Table<'_>, p: &mut VehicleParams) -> Result<(), ScenarioError> {
    p.u_min_mps2 = t.number_or(&keys::U_MIN, p.u_min_mps2)?;
    p.u_max_mps2 = t.number_or(&keys::U_MAX, p.u_max_mps2)?;
    p.v_min_mps = t.number_or(&keys::V_MIN, p.v_min_mps)?;
    let (v_min, range) = (p.v_min_mps, keys::V_MAX.range);
    let is_greatest = |v| v > v_min && range.contains(v);
    p.v_max_mps =
        t.f64_or(keys::V_MAX.name, p.v_max_mps, is_greatest, &format!("{range}, > v_min_mps = {v_min}"))?;
    p.length_m = t.number_or(&keys::LENGTH, p.length_m)?;
    p.reaction_time_s = t.number_or(&keys::REACTION_TIME, p.reaction_time_s)?;
    p.standstill_gap_m = t.number_or(&keys::STANDSTILL_GAP, p.standstill_gap_m)?;
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
        t.only_declared(keys::FLEET)?;
        if kinds.len() == MAX_KINDS {
            return Err(t.need("name", "")?.bad(&format!("at most {MAX_KINDS} kinds")));
        }
        let mut own = *vehicle;
        read_vehicle(t, &mut own)?;
        if own.v_max_mps > vehicle.v_max_mps {
            let expected = format!("at most that of [vehicle], {} m/s", vehicle.v_max_mps);
            return Err(t.need("v_max_mps", &expected)?.bad(&expected));
        }
        let share = t.number_or(&keys::SHARE, keys::SHARE.default())?;
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
        Some(field) => field.choice(keys::ENTRY.words),
    }
}

/// `[objective]`: beta, in m^2/s^4, given or from alpha.
pub(super) fn beta(table: &Table<'_>, vehicle: &VehicleParams) -> Result<f64, ScenarioError> {
    const ALPHA: &str = "a weight with 0 < alpha < 1";
    table.only_declared(keys::OBJECTIVE)?;
    match table.either("alpha", "beta") {
        (Some(_), Some(beta)) => {
            Err(beta.bad_because(Some("alpha is given as well".into()), "either alpha or beta"))
        }
        (None, None) => Err(table.missing("beta", &format!("{}, or alpha instead", ranges::BETA))),
        (None, Some(_)) => table.number(&keys::BETA),
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
    const FE_FRACTION: f64 = 0.25;
    let mut params = ControlParams {
        reference: keys::REFERENCE.default(),
        replan: keys::REPLAN.default(),
        position_feedback: keys::POSITION_FEEDBACK.default(),
        solver: keys::SOLVER.default(),
        safety_rows: keys::SAFETY_ROWS.default(),
        k_rear_end_per_s: keys::K_REAR_END.default(),
        k_merge_per_s: keys::K_MERGE.default(),
        k_speed_per_s: keys::K_SPEED.default(),
        clf_rate_per_s: keys::CLF_RATE.default(),
        slack_weight: beta,
        clf: keys::CLF.default,
        feasibility_rows: keys::FEASIBILITY_ROWS.default,
        fe_conditions: keys::FE_CONDITIONS.default(),
        fe_fraction: FE_FRACTION,
        viable: ViableParams::DEFAULT,
    };
    let Some(t) = table else { return Ok(params) };
    t.only_declared(keys::CONTROL)?;
    let p = &mut params;
    p.reference = t.chosen(&keys::REFERENCE)?;
    p.replan = t.chosen(&keys::REPLAN)?;
    p.position_feedback = t.chosen(&keys::POSITION_FEEDBACK)?;
    p.solver = t.chosen(&keys::SOLVER)?;
    p.safety_rows = t.chosen(&keys::SAFETY_ROWS)?;
    p.k_rear_end_per_s = t.number_or(&keys::K_REAR_END, p.k_rear_end_per_s)?;
    p.k_merge_per_s = t.number_or(&keys::K_MERGE, p.k_merge_per_s)?;
    p.k_speed_per_s = t.number_or(&keys::K_SPEED, p.k_speed_per_s)?;
    p.clf_rate_per_s = t.number_or(&keys::CLF_RATE, p.clf_rate_per_s)?;
    p.slack_weight = t.number_or(&keys::SLACK_WEIGHT, p.slack_weight)?;
    p.clf = t.flag(&keys::CLF)?;
    p.feasibility_rows = t.flag(&keys::FEASIBILITY_ROWS)?;
    p.fe_conditions = t.chosen(&keys::FE_CONDITIONS)?;
    p.fe_fraction = t.f64_or(
        "fe_fraction",
        FE_FRACTION,
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
    t.only_declared(keys::VIABLE)?;
    let default = ViableParams::DEFAULT;
    Ok(ViableParams {
        viability: t.flag(&keys::VIABILITY)?,
        comfort: t.flag(&keys::COMFORT)?,
        bodies: t.flag(&keys::BODIES)?,
        slots: t.flag(&keys::SLOTS)?,
        k_comfort_per_s: t.number_or(&keys::K_COMFORT, default.k_comfort_per_s)?,
        k_recovery_per_s: t.number_or(&keys::K_RECOVERY, default.k_recovery_per_s)?,
        clearance_m: t.number_or(&keys::CLEARANCE, default.clearance_m)?,
        buffer_m: t.number_or(&keys::BUFFER, default.buffer_m)?,
        buffer_s: t.number_or(&keys::BUFFER_TIME, default.buffer_s)?,
        passage_weight: t.number_or(&keys::PASSAGE_WEIGHT, default.passage_weight)?,
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
    }
    let Some(field) = zone.get("flow") else { return Ok(FlowPolicy::None) };
    const POLICY: &str = "a table such as {policy = \"fixed\", terminal_mps = 15}";
    let mut t = field.table(POLICY)?;
    let all = keys::names(keys::FLOW);
    // Without a policy the other keys cannot be judged; a misspelt "policy" is still found here.
    t.only(&all)?;
    let policy = t.need("policy", "\"none\", \"fixed\", \"feedback\" or \"mean_speed\"")?;
    let kind = policy.choice(&[
        ("none", Kind::None),
        ("fixed", Kind::Fixed),
        ("feedback", Kind::Feedback),
        ("mean_speed", Kind::MeanSpeed),
    ])?;
    let known: &[&str] = match kind {
        Kind::None => &["policy"],
        Kind::Fixed => &["policy", "terminal_mps"],
        Kind::Feedback => {
            &["policy", "baseline_mps", "baseline_entry_speeds_mps", "gain_mps", "segment_m", "min_mps"]
        }
        Kind::MeanSpeed => &["policy", "offset_mps", "gain_mps", "segment_m", "min_mps"],
    };
    t.only_or_stale(known, if policy.is_set() { &all[..] } else { &[] })?;
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
