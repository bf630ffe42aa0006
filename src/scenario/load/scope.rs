//! `zones` and `approaches`: which approaches a table is about.

use super::error::{ScenarioError, nearest};
use super::table::{Field, Table};
use crate::scenario::{Zone, ZoneId};

/// Zone and path of all approaches that the keys `zones` and `approaches` of a table name, ascending; empty
/// when there is neither key. `claim` may refuse one.
pub(super) fn approaches(
    table: &Table<'_>,
    zones: &[Zone],
    mut claim: impl FnMut(ZoneId, u32, &Field<'_>) -> Result<(), ScenarioError>,
) -> Result<Vec<(ZoneId, u32)>, ScenarioError> {
    let mut approaches: Vec<(ZoneId, u32)> = Vec::new();
    const ZONES: &str = "a list of zone names";
    if let Some(field) = table.get("zones") {
        for item in field.items(ZONES)? {
            let zone = zone_of(&item, item.str(ZONES)?, zones)?;
            for path in 0..zones[zone as usize].approaches.len() as u32 {
                claim(zone, path, &item)?;
                approaches.push((zone, path));
            }
        }
    }
    const APPROACHES: &str = "a list of approaches, each as \"ZONE.APPROACH\"";
    if let Some(field) = table.get("approaches") {
        for item in field.items(APPROACHES)? {
            let Some((zone, approach)) = item.str(APPROACHES)?.split_once('.') else {
                return Err(item.bad(APPROACHES));
            };
            let zone = zone_of(&item, zone, zones)?;
            let known = &zones[zone as usize].approaches;
            let Some(path) = known.iter().position(|a| a.name == approach) else {
                return Err(unknown(&item, approach, known.iter().map(|a| a.name.as_str())));
            };
            claim(zone, path as u32, &item)?;
            approaches.push((zone, path as u32));
        }
    }
    approaches.sort_unstable();
    if approaches.windows(2).any(|w| w[0] == w[1]) {
        let field = table.get("approaches").map_or_else(|| table.need("zones", ""), Ok)?;
        return Err(field.bad_because(Some("an approach is named twice".into()), "each once"));
    }
    Ok(approaches)
}

fn zone_of(field: &Field<'_>, name: &str, zones: &[Zone]) -> Result<ZoneId, ScenarioError> {
    match zones.iter().position(|z| z.name == name) {
        Some(index) => Ok(index as ZoneId),
        None => Err(unknown(field, name, zones.iter().map(|z| z.name.as_str()))),
    }
}

fn unknown<'a>(field: &Field<'_>, name: &str, known: impl Iterator<Item = &'a str> + Clone) -> ScenarioError {
    let hint = nearest(name, known.clone()).map(|n| format!("; did you mean {n}?")).unwrap_or_default();
    field.bad(&format!("one of {}{hint}", known.collect::<Vec<_>>().join(", ")))
}
