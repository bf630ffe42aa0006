//! `[[controllers]]`: which approaches a controller written elsewhere drives.

use super::error::{ScenarioError, nearest};
use super::table::{Field, Table};
use crate::scenario::{Plugin, Zone, ZoneId};

/// Controller processes have indices below 64, and the built-in pool wants at least one.
const MAX_PLUGINS: usize = 63;

/// Reads `[[controllers]]`.
pub(super) fn read(root: &Table<'_>, zones: &[Zone]) -> Result<Vec<Plugin>, ScenarioError> {
    const EXPECTED: &str = "a list of controllers, each with a name and zones or approaches";
    if root.get("controllers").is_none() {
        return Ok(Vec::new());
    }
    let tables = root.tables("controllers", EXPECTED)?;
    for table in &tables {
        table.only(&["name", "zones", "approaches", "command"])?;
    }
    let names = super::topology::unique_names(&tables, "controller")?;
    let mut plugins: Vec<Plugin> = Vec::with_capacity(tables.len());
    for (table, name) in tables.iter().zip(names) {
        if plugins.len() == MAX_PLUGINS {
            return Err(table.need("name", "")?.bad(&format!("at most {MAX_PLUGINS} controllers")));
        }
        let mut approaches: Vec<(ZoneId, u32)> = Vec::new();
        let mut claim = |zone: ZoneId, path: u32, field: &Field<'_>| {
            let taken = plugins.iter().find(|p| p.approaches.contains(&(zone, path)));
            if let Some(other) = taken {
                let z = &zones[zone as usize];
                let approach = &z.approaches[path as usize].name;
                let problem = format!("{} drives {}.{approach} already", other.name, z.name);
                return Err(field.bad_because(Some(problem), "approaches no other controller drives"));
            }
            approaches.push((zone, path));
            Ok(())
        };
        const ZONES: &str = "a list of zone names";
        if let Some(field) = table.get("zones") {
            for item in field.items(ZONES)? {
                let zone = zone_of(&item, item.str(ZONES)?, zones)?;
                for path in 0..zones[zone as usize].approaches.len() as u32 {
                    claim(zone, path, &item)?;
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
                match known.iter().position(|a| a.name == approach) {
                    Some(path) => claim(zone, path as u32, &item)?,
                    None => return Err(unknown(&item, approach, known.iter().map(|a| a.name.as_str()))),
                }
            }
        }
        if approaches.is_empty() {
            return Err(table.missing("zones", "zones = [\"NAME\", ...], or approaches instead"));
        }
        approaches.sort_unstable();
        if approaches.windows(2).any(|w| w[0] == w[1]) {
            let field = table.get("approaches").map_or_else(|| table.need("zones", ""), Ok)?;
            return Err(field.bad_because(Some("an approach is named twice".into()), "each once"));
        }
        const COMMAND: &str = "a command line";
        let command = match table.get("command") {
            None => None,
            Some(field) => match field.str(COMMAND)?.trim() {
                "" => return Err(field.bad(COMMAND)),
                text => Some(text.to_owned()),
            },
        };
        plugins.push(Plugin { name: name.to_owned(), approaches, command });
    }
    Ok(plugins)
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
