//! `zones` and `paths`: which paths a table is about.

use super::error::{ScenarioError, nearest};
use super::table::{Field, Table};
use crate::scenario::{Zone, ZoneId};

/// Zone and path of all paths that the keys `zones` and `paths` of a table name, ascending; empty
/// when there is neither key. `claim` may refuse one.
pub(super) fn paths(
    table: &Table<'_>,
    zones: &[Zone],
    mut claim: impl FnMut(ZoneId, u32, &Field<'_>) -> Result<(), ScenarioError>,
) -> Result<Vec<(ZoneId, u32)>, ScenarioError> {
    let mut paths: Vec<(ZoneId, u32)> = Vec::new();
    const ZONES: &str = "a list of zone names";
    if let Some(field) = table.get("zones") {
        for item in field.items(ZONES)? {
            let zone = zone_of(&item, item.str(ZONES)?, zones)?;
            for path in 0..zones[zone as usize].paths.len() as u32 {
                claim(zone, path, &item)?;
                paths.push((zone, path));
            }
        }
    }
    const PATHS: &str = "a list of paths, each as \"ZONE.PATH\"";
    if let Some(field) = table.get("paths") {
        for item in field.items(PATHS)? {
            let Some((zone, path)) = item.str(PATHS)?.split_once('.') else {
                return Err(item.bad(PATHS));
            };
            let zone = zone_of(&item, zone, zones)?;
            let known = &zones[zone as usize].paths;
            let Some(path) = known.iter().position(|a| a.name == path) else {
                return Err(unknown(&item, path, known.iter().map(|a| a.name.as_str())));
            };
            claim(zone, path as u32, &item)?;
            paths.push((zone, path as u32));
        }
    }
    paths.sort_unstable();
    if paths.windows(2).any(|w| w[0] == w[1]) {
        let field = table.get("paths").map_or_else(|| table.need("zones", ""), Ok)?;
        return Err(field.bad_because(Some("a path is named twice".into()), "each once"));
    }
    Ok(paths)
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
