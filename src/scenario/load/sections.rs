//! Vehicle limits, objective and control law.

use super::error::ScenarioError;
use super::table::{Table, unique_names};
use crate::scenario::ranges::MAX_KINDS;
use crate::scenario::{
    ControlParams, CoordinationParams, EntryRule, HumanParams, LawKind, PassingOrder, VehicleKind,
    VehicleParams, ViableParams, keys, ranges,
};

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
        return Ok(vec![VehicleKind { name: "cav".to_owned(), share: 1.0, vehicle: *vehicle, human: None }]);
    }
    let tables = root.tables("fleet", "a list of kinds of vehicles, each with a name")?;
    let names = unique_names(&tables, "kind of vehicle")?;
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
        let human = human(t, &own)?;
        kinds.push(VehicleKind { name: name.to_owned(), share, vehicle: own, human });
    }
    Ok(kinds)
}

/// The human driver of a kind, if it has one.
fn human(t: &Table<'_>, vehicle: &VehicleParams) -> Result<Option<HumanParams>, ScenarioError> {
    if !t.chosen(&keys::DRIVER)? {
        const ONLY: &str = "driver = \"human\" beside it";
        let mut of_humans = keys::FLEET.iter().skip_while(|key| key.name() != keys::YIELDS.name);
        let stray = of_humans.find_map(|key| t.get(key.name()));
        return stray.map_or(Ok(None), |field| Err(field.bad(ONLY)));
    }
    let default = HumanParams::DEFAULT;
    let VehicleParams { v_max_mps, u_min_mps2, .. } = *vehicle;
    let at_most = |v| v <= v_max_mps && keys::DESIRED.range.contains(v);
    let expected = format!("{}, at most v_max_mps = {v_max_mps}", keys::DESIRED.range);
    Ok(Some(HumanParams {
        yields: t.chosen(&keys::YIELDS)?,
        desired_mps: t.f64_or(keys::DESIRED.name, v_max_mps, at_most, &expected)?,
        desired_sd_mps: t.number_or(&keys::DESIRED_SD, default.desired_sd_mps)?,
        headway_s: t.number_or(&keys::TIME_HEADWAY, default.headway_s)?,
        jam_gap_m: t.number_or(&keys::JAM_GAP, default.jam_gap_m)?,
        acceleration_mps2: t.number_or(&keys::IDM_ACCELERATION, default.acceleration_mps2)?,
        comfortable_mps2: t.number_or(&keys::COMFORTABLE, default.comfortable_mps2)?,
        delay_s: t.number_or(&keys::DELAY, default.delay_s)?,
        noise_mps2: t.number_or(&keys::NOISE, default.noise_mps2)?,
        critical_gap_s: t.number_or(&keys::CRITICAL_GAP, default.critical_gap_s)?,
        patience_s: t.number_or(&keys::PATIENCE, default.patience_s)?,
        hardest_mps2: t.number_or(&keys::HARDEST, (-u_min_mps2).max(0.1))?,
        scares_per_h: t.number_or(&keys::SCARES, default.scares_per_h)?,
    }))
}

/// `automated` and `rank` of a road.
pub(super) fn mixture(t: &Table<'_>, fleet: &[VehicleKind]) -> Result<(Option<f64>, u32), ScenarioError> {
    const RANK: &str = "an integer from 0 to 1000";
    let rank = match t.get("rank") {
        None => 0,
        Some(field) => match field.integer::<u32>(0, RANK)? {
            rank @ 0..=1000 => rank,
            _ => return Err(field.bad(RANK)),
        },
    };
    let Some(field) = t.get(keys::AUTOMATED.name) else { return Ok((None, rank)) };
    let share = field.within(&keys::AUTOMATED.range)?;
    let has = |human: bool| fleet.iter().any(|kind| kind.human.is_some() == human && kind.share > 0.0);
    if share < 1.0 && !has(true) || share > 0.0 && !has(false) {
        let lacks = if has(true) { "without" } else { "with" };
        return Err(field.bad(&format!("a kind {lacks} a human driver in the fleet, with a share above 0")));
    }
    Ok((Some(share), rank))
}

/// `law` of `[control]` or of a zone.
pub(super) fn law(table: Option<&Table<'_>>, default: LawKind) -> Result<LawKind, ScenarioError> {
    match table.and_then(|t| t.get("law")) {
        None => Ok(default),
        Some(field) => field.choice(keys::LAW.words),
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
        price_of_exposure_mps4: t.number_or(&keys::PRICE_OF_EXPOSURE, default.price_of_exposure_mps4)?,
        clearance_m: t.number_or(&keys::CLEARANCE, default.clearance_m)?,
        buffer_m: t.number_or(&keys::BUFFER, default.buffer_m)?,
        buffer_s: t.number_or(&keys::BUFFER_TIME, default.buffer_s)?,
        passage_weight: t.number_or(&keys::PASSAGE_WEIGHT, default.passage_weight)?,
    })
}

/// `[coordination]`, or the defaults, and the passing order of zones that name none.
pub(super) fn coordination(
    table: Option<&Table<'_>>,
) -> Result<(CoordinationParams, PassingOrder), ScenarioError> {
    let mut params = CoordinationParams::DEFAULT;
    let Some(t) = table else { return Ok((params, PassingOrder::default())) };
    t.only_declared(keys::COORDINATION)?;
    params.schedule = t.chosen(&keys::SCHEDULE)?;
    params.price_of_time = t.number_or(&keys::PRICE_OF_TIME, params.price_of_time)?;
    params.tandem_weight = t.number_or(&keys::TANDEM_WEIGHT, params.tandem_weight)?;
    Ok((params, order(t, PassingOrder::default())?))
}

/// `order` of a table.
pub(super) fn order(t: &Table<'_>, default: PassingOrder) -> Result<PassingOrder, ScenarioError> {
    t.get(keys::ORDER.name).map_or(Ok(default), |field| field.choice(keys::ORDER.words))
}
