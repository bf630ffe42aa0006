//! `[faults]`: what goes wrong on purpose.

use super::error::ScenarioError;
use super::scope;
use super::table::Table;
use crate::scenario::ranges::{MAX_DELAY, MAX_ERROR, MAX_TIME_S};
use crate::scenario::{CommandFaults, Faults, Noise, Scope, SensorFault, SensorKind, Span, Stall, Zone};

/// Reads `[faults]`; an empty table is none.
pub(super) fn read(table: Option<&Table<'_>>, zones: &[Zone]) -> Result<Option<Faults>, ScenarioError> {
    let Some(t) = table else { return Ok(None) };
    t.only_declared(crate::scenario::keys::FAULTS)?;
    let mut faults = Faults::default();
    if let Some(field) = t.get("noise") {
        faults.noise = Some(noise(&field.table("a table such as {position_sd_m = 0.5}")?)?);
    }
    if t.get("sensors").is_some() {
        let tables = t.tables("sensors", "a list of tables such as {kind = \"frozen\"}")?;
        faults.sensors = tables.iter().map(|table| sensor(table, zones)).collect::<Result<_, _>>()?;
    }
    if let Some(field) = t.get("commands") {
        faults.commands = Some(commands(&field.table("a table such as {loss = 0.05}")?)?);
    }
    if t.get("stalls").is_some() {
        let tables = t.tables("stalls", "a list of tables such as {from_s = 10, until_s = 12}")?;
        faults.stalls = tables.iter().map(|table| stall(table, zones)).collect::<Result<_, _>>()?;
    }
    Ok((faults != Faults::default()).then_some(faults))
}

fn noise(t: &Table<'_>) -> Result<Noise, ScenarioError> {
    t.only(&["position_sd_m", "speed_sd_mps", "from_s", "until_s"])?;
    if t.get("position_sd_m").is_none() && t.get("speed_sd_mps").is_none() {
        return Err(t.missing("position_sd_m", "a standard deviation in m, or speed_sd_mps instead"));
    }
    let sd = |key, unit| {
        let expected = format!("a standard deviation from 0 to {MAX_ERROR:e} {unit}");
        t.f64_or(key, 0.0, |sd| (0.0..=MAX_ERROR).contains(&sd), &expected)
    };
    Ok(Noise {
        position_sd_m: sd("position_sd_m", "m")?,
        speed_sd_mps: sd("speed_sd_mps", "m/s")?,
        span: span(t)?,
    })
}

fn sensor(t: &Table<'_>, zones: &[Zone]) -> Result<SensorFault, ScenarioError> {
    let all = ["kind", "zones", "paths", "fraction", "from_s", "until_s", "position_m", "speed_mps"];
    // Without a kind the other keys cannot be judged; a misspelt "kind" is still found here.
    t.only(&all)?;
    let kind = t.need("kind", "\"bias\" or \"frozen\"")?;
    let is_bias = kind.choice(&[("bias", true), ("frozen", false)])?;
    t.only_or_stale(if is_bias { &all } else { &all[..6] }, if kind.is_set() { &all } else { &[] })?;
    let kind = if is_bias {
        if t.get("position_m").is_none() && t.get("speed_mps").is_none() {
            return Err(t.missing("position_m", "what is added to the position in m, or speed_mps instead"));
        }
        let bias = |key, unit| {
            let expected = format!("a number from {:e} to {MAX_ERROR:e} {unit}", -MAX_ERROR);
            t.f64_or(key, 0.0, |bias| bias.abs() <= MAX_ERROR, &expected)
        };
        SensorKind::Bias { position_m: bias("position_m", "m")?, speed_mps: bias("speed_mps", "m/s")? }
    } else {
        SensorKind::Frozen
    };
    Ok(SensorFault { kind, scope: scope(t, zones)?, span: span(t)? })
}

fn commands(t: &Table<'_>) -> Result<CommandFaults, ScenarioError> {
    const DELAY: &str = "an integer from 1 to 1000";
    t.only(&["loss", "delay_steps", "delay_probability", "from_s", "until_s"])?;
    let probability =
        |key, default| t.f64_or(key, default, |p| (0.0..=1.0).contains(&p), "a probability from 0 to 1");
    let (delay_steps, by_default) = match t.get("delay_steps") {
        Some(field) => match field.integer(1, DELAY)? {
            steps if steps <= MAX_DELAY => (steps, 1.0),
            _ => return Err(field.bad(DELAY)),
        },
        None if t.get("delay_probability").is_some() => return Err(t.missing("delay_steps", DELAY)),
        None if t.get("loss").is_none() => {
            return Err(t.missing("loss", "a probability from 0 to 1, or delay_steps instead"));
        }
        None => (0, 0.0),
    };
    Ok(CommandFaults {
        loss: probability("loss", 0.0)?,
        delay_steps,
        delay_probability: probability("delay_probability", by_default)?,
        span: span(t)?,
    })
}

fn stall(t: &Table<'_>, zones: &[Zone]) -> Result<Stall, ScenarioError> {
    t.only(&["zones", "paths", "fraction", "from_s", "until_s"])?;
    Ok(Stall { scope: scope(t, zones)?, span: span(t)? })
}

/// Everywhere and everybody, unless something narrower is given.
fn scope(t: &Table<'_>, zones: &[Zone]) -> Result<Scope, ScenarioError> {
    let paths = scope::paths(t, zones, |_, _, _| Ok(()))?;
    let within = |f| f > 0.0 && f <= 1.0;
    Ok(Scope {
        paths: (!paths.is_empty()).then_some(paths),
        fraction: t.f64_or("fraction", 1.0, within, "a fraction with 0 < fraction <= 1")?,
    })
}

/// The whole run, unless something narrower is given.
fn span(t: &Table<'_>) -> Result<Span, ScenarioError> {
    let expected = format!("a time from 0 to below {MAX_TIME_S:e} s");
    let from_s = t.f64_or("from_s", 0.0, |f| (0.0..MAX_TIME_S).contains(&f), &expected)?;
    let expected = format!("a time > from_s = {from_s} and at most {MAX_TIME_S:e} s");
    let until_s = t.f64_or("until_s", MAX_TIME_S, |u| u > from_s && u <= MAX_TIME_S, &expected)?;
    Ok(Span { from_s, until_s })
}
