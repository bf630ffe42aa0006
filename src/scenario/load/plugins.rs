//! `[[controllers]]`: which paths a controller written elsewhere drives.

use super::error::ScenarioError;
use super::scope;
use super::table::{Field, Table};
use crate::scenario::{OnExit, Plugin, Zone, ZoneId};

/// Controller processes have indices below 64, and the built-in pool wants at least one.
const MAX_PLUGINS: usize = 63;

/// Reads `[[controllers]]`.
pub(super) fn read(root: &Table<'_>, zones: &[Zone]) -> Result<Vec<Plugin>, ScenarioError> {
    const EXPECTED: &str = "a list of controllers, each with a name and zones or paths";
    if root.get("controllers").is_none() {
        return Ok(Vec::new());
    }
    let tables = root.tables("controllers", EXPECTED)?;
    for table in &tables {
        table.only_declared(crate::scenario::keys::CONTROLLERS)?;
    }
    let names = super::table::unique_names(&tables, "controller")?;
    let mut plugins: Vec<Plugin> = Vec::with_capacity(tables.len());
    for (table, name) in tables.iter().zip(names) {
        if plugins.len() == MAX_PLUGINS {
            return Err(table.need("name", "")?.bad(&format!("at most {MAX_PLUGINS} controllers")));
        }
        let is_free = |zone: ZoneId, path: u32, field: &Field<'_>| {
            let taken = plugins.iter().find(|p| p.paths.contains(&(zone, path)));
            let Some(other) = taken else { return Ok(()) };
            let z = &zones[zone as usize];
            let path = &z.paths[path as usize].name;
            let problem = format!("{} drives {}.{path} already", other.name, z.name);
            Err(field.bad_because(Some(problem), "paths no other controller drives"))
        };
        let paths = scope::paths(table, zones, is_free)?;
        if paths.is_empty() {
            return Err(table.missing("zones", "zones = [\"NAME\", ...], or paths instead"));
        }
        const COMMAND: &str = "a command line";
        let command = match table.get("command") {
            None => None,
            Some(field) => match field.str(COMMAND)?.trim() {
                "" => return Err(field.bad(COMMAND)),
                text => Some(text.to_owned()),
            },
        };
        const ON_EXIT: &str = "\"end\", \"restart\", \"builtin\" or \"shield-fallback\"";
        let on_exit = match table.get("on_exit") {
            None => OnExit::default(),
            Some(field) => OnExit::of(field.str(ON_EXIT)?).ok_or_else(|| field.bad(ON_EXIT))?,
        };
        plugins.push(Plugin { name: name.to_owned(), paths, command, on_exit });
    }
    Ok(plugins)
}
