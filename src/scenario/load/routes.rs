//! `roads.*.routes`: which ways the vehicles of a road may take.

use super::error::{ScenarioError, nearest};
use super::table::{Table, unique_names};

use crate::scenario::{Route, Zone, keys};

/// Reads the routes of a road that leads to `(zone, entrance)`; none when it does not name any.
pub(super) fn read(table: &Table<'_>, zones: &[Zone], end: (u32, u32)) -> Result<Vec<Route>, ScenarioError> {
    const ROUTES: &str = "a list of routes such as {name = \"left\", paths = [\"ZONE.PATH\"], share = 0.2}";
    if table.get("routes").is_none() {
        return Ok(Vec::new());
    }
    let tables = table.tables("routes", ROUTES)?;
    let names = unique_names(&tables, "route of the road")?;
    tables.iter().zip(names).map(|(t, name)| route(t, name, zones, end)).collect()
}

fn route(
    t: &Table<'_>,
    name: &str,
    zones: &[Zone],
    (zone, segment): (u32, u32),
) -> Result<Route, ScenarioError> {
    t.only_declared(keys::ROUTES)?;
    const PATHS: &str = "a list of paths in the order in which they are driven, each as \"ZONE.PATH\"";
    let mut next = Some((zone, segment));
    let mut paths = Vec::new();
    for item in t.need("paths", PATHS)?.items(PATHS)? {
        let word = item.str(PATHS)?;
        let Some((zone, segment)) = next else {
            let problem = Some("the path before leads out of the network".to_owned());
            return Err(item.bad_because(problem, "a route that ends there"));
        };
        let here = &zones[zone as usize];
        let open = here
            .paths_from(segment)
            .map(|path| (path, format!("{}.{}", here.name, here.paths[path as usize].name)));
        let open: Vec<(u32, String)> = open.collect();
        let Some((path, _)) = open.iter().find(|(_, name)| name == word) else {
            let known: Vec<&str> = open.iter().map(|(_, name)| name.as_str()).collect();
            let begins = if paths.is_empty() { "the road leads" } else { "the one before leads" };
            let hint = nearest(word, known.iter().copied());
            let hint = hint.map(|hint| format!("; did you mean {hint}?")).unwrap_or_default();
            return Err(item.bad(&format!("a path that begins where {begins}: {}{hint}", known.join(", "))));
        };
        paths.push(*path);
        next = here.exit_of(*path).to.map(|to| (to.zone, to.segment));
    }
    let share = t.number_or(&keys::SHARE, keys::SHARE.default())?;
    Ok(Route { name: name.to_owned(), paths, share })
}
