//! How zones and roads hang together: sources resolved, cycles refused, zones sorted.

use super::error::{ScenarioError, nearest};
use super::table::{Field, Table};
use crate::scenario::{Approach, Exit, FlowPolicy, Source, Zone, ranges};

/// No more zones, roads, or approaches of a zone than this: frames carry their indices in 16 bits.
pub(in crate::scenario) const MAX_COUNT: usize = 65_535;

/// The network's shape; flow policies are still [`FlowPolicy::None`].
pub(super) struct Topology {
    /// Zones in topological order, otherwise as declared.
    pub(super) zones: Vec<Zone>,
    /// For each of them, its index as declared.
    pub(super) declared: Vec<usize>,
    /// Zone and approach each road leads to.
    pub(super) road_ends: Vec<(u32, u32)>,
}

/// Reads the names of an array of tables, which must be unique.
pub(super) fn unique_names<'a>(tables: &[Table<'a>], what: &str) -> Result<Vec<&'a str>, ScenarioError> {
    let mut seen = std::collections::BTreeSet::new();
    let mut names = Vec::with_capacity(tables.len());
    for table in tables {
        let name = table.name()?;
        if !seen.insert(name) {
            let expected = format!("a name no other {what} has");
            return Err(table.need("name", &expected)?.bad_because(Some("used twice".into()), &expected));
        }
        names.push(name);
    }
    if names.len() > MAX_COUNT {
        let table = &tables[MAX_COUNT];
        let expected = format!("at most {MAX_COUNT} {what} entries");
        return Err(table.need("name", &expected)?.bad_because(Some("too many".into()), &expected));
    }
    Ok(names)
}

/// Reads all approaches; `step_m` is the farthest a vehicle may go in one step, at `v_max_mps`.
pub(super) fn read(
    zones: &[Table<'_>],
    zone_names: &[&str],
    roads: &[Table<'_>],
    road_names: &[&str],
    (step_m, v_max_mps): (f64, f64),
) -> Result<Topology, ScenarioError> {
    let mut claims = Claims {
        exits: vec![None; zones.len()],
        roads: vec![None; roads.len()],
        exit_fields: vec![None; zones.len()],
        step_m,
        v_max_mps,
    };
    let mut approaches = Vec::with_capacity(zones.len());
    for (zone, table) in zones.iter().enumerate() {
        const APPROACHES: &str = "a list of approaches, at least one";
        let tables = table.tables("approaches", APPROACHES)?;
        let names = unique_names(&tables, "approach of the zone")?;
        let mut read = Vec::with_capacity(tables.len());
        for (path, (table, name)) in tables.iter().zip(names).enumerate() {
            read.push(claims.approach(table, name, (zone, path), zone_names, road_names)?);
        }
        approaches.push(read);
    }
    // Before the roads: whoever closes a cycle has mostly taken an approach from a road.
    let declared = sort(&approaches, &claims, zone_names)?;
    let mut road_ends = Vec::with_capacity(roads.len());
    for (table, claim) in roads.iter().zip(&claims.roads) {
        match claim {
            Some((zone, path, _)) => road_ends.push((*zone, *path)),
            None => {
                let expected = "an approach with this road as its source";
                let field = table.need("name", expected)?;
                return Err(field.bad_because(Some("no approach uses this road".into()), expected));
            }
        }
    }

    // From indices as declared to sorted ones.
    let mut sorted = vec![0; declared.len()];
    for (new, &old) in declared.iter().enumerate() {
        sorted[old] = new as u32;
    }
    let zones = declared.iter().map(|&old| Zone {
        name: zone_names[old].to_owned(),
        approaches: approaches[old]
            .iter()
            .map(|a| match a.source {
                Source::Zone(z) => Approach { source: Source::Zone(sorted[z as usize]), ..a.clone() },
                Source::Road(_) => a.clone(),
            })
            .collect(),
        exit: match claims.exits[old] {
            None => Exit::Out,
            Some((zone, path, link)) => {
                let (link_m, link_speed_mps) = link;
                Exit::Zone { zone: sorted[zone as usize], path, link_m, link_speed_mps }
            }
        },
        flow: FlowPolicy::None,
    });
    let zones = zones.collect();
    let road_ends = road_ends.into_iter().map(|(zone, path)| (sorted[zone as usize], path)).collect();
    Ok(Topology { zones, declared, road_ends })
}

/// Zone, approach, and the link's length and speed.
type ExitClaim = (u32, u32, (f64, f64));

/// Who uses which exit and which road, by indices as declared.
struct Claims<'a> {
    exits: Vec<Option<ExitClaim>>,
    /// The `zone` key that claimed each exit, for messages.
    exit_fields: Vec<Option<Field<'a>>>,
    /// Zone, approach, and the key path that claimed it.
    roads: Vec<Option<(u32, u32, String)>>,
    step_m: f64,
    v_max_mps: f64,
}

impl<'a> Claims<'a> {
    fn approach(
        &mut self,
        t: &Table<'a>,
        name: &str,
        (zone, path): (usize, usize),
        zone_names: &[&str],
        road_names: &[&str],
    ) -> Result<Approach, ScenarioError> {
        t.only(&["name", "length_m", "road", "zone", "link_m", "link_speed_mps"])?;
        let step_m = self.step_m;
        let why = "v_max_mps * dt_s, so that a vehicle passes at most one boundary per step";
        let (length, link) = (ranges::APPROACH_LENGTH, ranges::LINK_LENGTH);
        let expected = format!("{length}, >= {step_m} m = {why}");
        let length_m = t.f64("length_m", |l| length.contains(l) && l >= step_m, &expected)?;
        let end = (zone as u32, path as u32);
        let source = match t.either("road", "zone") {
            (None, None) => {
                return Err(t.missing("road", "a source: road = \"NAME\", or zone = \"NAME\" upstream"));
            }
            (Some(_), Some(zone)) => {
                return Err(
                    zone.bad_because(Some("road is given as well".into()), "one source, either road or zone")
                );
            }
            (Some(field), None) => {
                let road = find(&field, "road", road_names)?;
                if let Some((_, _, other)) = &self.roads[road] {
                    let problem = Some(format!("{other} uses this road already"));
                    return Err(field.bad_because(problem, "a road no other approach uses"));
                }
                self.roads[road] = Some((end.0, end.1, t.key("road")));
                // A road by --set in place of the file's zone leaves that zone's link without meaning.
                for key in ["link_m", "link_speed_mps"] {
                    if let Some(link) = t.get(key).filter(|link| link.is_set() || !field.is_set()) {
                        let problem = Some("the source is a road".to_owned());
                        return Err(link.bad_because(problem, &format!("{key} only with zone")));
                    }
                }
                Source::Road(road as u32)
            }
            (None, Some(field)) => {
                let upstream = find(&field, "zone", zone_names)?;
                if let Some(other) = &self.exit_fields[upstream] {
                    let problem = Some(format!("{} claims the exit of this zone already", other.path));
                    return Err(field.bad_because(problem, "a zone whose exit leads nowhere else"));
                }
                let expected = format!("{link}, >= {step_m} m = {why}");
                let is_link = |l| link.contains(l) && (l == 0.0 || l >= step_m);
                let link_m = t.f64_or("link_m", 0.0, is_link, &expected)?;
                let v_max_mps = self.v_max_mps;
                let expected = format!("{}, <= v_max_mps = {v_max_mps}", ranges::LINK_SPEED);
                let is_speed = |v| ranges::LINK_SPEED.contains(v) && v <= v_max_mps;
                let link_speed_mps = t.f64_or("link_speed_mps", v_max_mps / 2.0, is_speed, &expected)?;
                self.exits[upstream] = Some((end.0, end.1, (link_m, link_speed_mps)));
                self.exit_fields[upstream] = Some(field);
                Source::Zone(upstream as u32)
            }
        };
        Ok(Approach { name: name.to_owned(), length_m, source })
    }
}

/// Index of the name a field gives.
fn find(field: &Field<'_>, what: &str, names: &[&str]) -> Result<usize, ScenarioError> {
    let expected = || {
        let word = field.str("").unwrap_or("");
        let hint = nearest(word, names.iter().copied());
        let hint = hint.map(|h| format!("; did you mean {h}?")).unwrap_or_default();
        let mut list = names.iter().take(20).copied().collect::<Vec<_>>().join(", ");
        if names.len() > 20 {
            list += ", ...";
        }
        format!("the name of a {what}: {list}{hint}")
    };
    let name = field.str("").map_err(|_| field.bad(&expected()))?;
    let found = names.iter().position(|n| *n == name);
    found.ok_or_else(|| field.bad_because(Some(format!("unknown {what}")), &expected()))
}

/// Zones upstream first; among those that are free to come next, the one declared first.
fn sort(
    approaches: &[Vec<Approach>],
    claims: &Claims<'_>,
    names: &[&str],
) -> Result<Vec<usize>, ScenarioError> {
    let is_zone = |a: &&Approach| matches!(a.source, Source::Zone(_));
    let mut waiting: Vec<usize> = approaches.iter().map(|a| a.iter().filter(is_zone).count()).collect();
    let mut ready: std::collections::BTreeSet<usize> =
        (0..waiting.len()).filter(|&z| waiting[z] == 0).collect();
    let mut order = Vec::with_capacity(waiting.len());
    while let Some(zone) = ready.pop_first() {
        order.push(zone);
        if let Some((next, ..)) = claims.exits[zone] {
            waiting[next as usize] -= 1;
            if waiting[next as usize] == 0 {
                ready.insert(next as usize);
            }
        }
    }
    let Some(start) = waiting.iter().position(|&count| count > 0) else { return Ok(order) };
    // A zone has one exit, so what is left over are cycles and nothing else: following exits from any of
    // them comes back to it.
    let next = |zone: usize| claims.exits[zone].map_or(start, |(next, ..)| next as usize);
    let mut members = vec![start];
    let mut zone = next(start);
    while zone != start && members.len() <= names.len() {
        members.push(zone);
        zone = next(zone);
    }
    // The connection to name is the one a --set made, if one did.
    let is_set = |zone: &usize| claims.exit_fields[*zone].as_ref().is_some_and(Field::is_set);
    let blamed = members.iter().copied().find(is_set).unwrap_or(start);
    let field = claims.exit_fields[blamed].as_ref().expect("a zone of a cycle has an exit that was claimed");
    Err(ScenarioError::Cycle {
        place: field.place(),
        key: field.path.as_str().into(),
        found: field.found().into(),
        cycle: members.iter().chain([&start]).map(|z| names[*z]).collect::<Vec<_>>().join(" -> ").into(),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::{TraceBase, load_text};
    use crate::scenario::{Exit, Scenario, Source, load_embedded};

    /// Zones as (name, sources); a source that is no zone is a road.
    fn network(zones: &[(&str, &[&str])]) -> Scenario {
        let mut text = "name = \"n\"\nobjective = { beta = 1 }\n".to_owned();
        for (name, sources) in zones {
            text += &format!("[[zones]]\nname = \"{name}\"\n");
            for source in *sources {
                let kind = if zones.iter().any(|(z, _)| z == source) { "zone" } else { "road" };
                text += &format!(
                    "[[zones.approaches]]\nname = \"{source}\"\nlength_m = 100\n{kind} = \"{source}\"\n"
                );
            }
        }
        let roads = zones.iter().flat_map(|(_, s)| *s).filter(|s| !zones.iter().any(|(z, _)| z == *s));
        for road in roads {
            text += &format!(
                "[[roads]]\nname = \"{road}\"\n[roads.demand]\nrates = [{{ until_s = 1, vehicles_per_hour = 1 }}]\n\
                 min_headway_s = 1\nspeed_mean_mps = 9\nspeed_sd_mps = 1\nspeed_min_mps = 8\nspeed_max_mps = 10\n"
            );
        }
        load_text("n.toml", &text, TraceBase::Embedded, &[], None).unwrap()
    }

    #[test]
    fn zones_are_sorted_and_indices_follow() {
        let n =
            network(&[("last", &["mid", "b"]), ("x", &["r"]), ("mid", &["first", "y"]), ("first", &["r1"])])
                .network;
        let names: Vec<_> = n.zones.iter().map(|z| z.name.as_str()).collect();
        assert_eq!(names, ["x", "first", "mid", "last"]);
        assert_eq!(n.zones[3].approaches[0].source, Source::Zone(2));
        assert_eq!(n.zones[2].approaches[0].source, Source::Zone(1));
        assert_eq!(n.zones[1].exit, Exit::Zone { zone: 2, path: 0, link_m: 0.0, link_speed_mps: 15.0 });
        assert_eq!(n.zones[0].exit, Exit::Out);
        for (index, road) in n.roads.iter().enumerate() {
            let approach = &n.zones[road.zone as usize].approaches[road.path as usize];
            assert_eq!(approach.source, Source::Road(index as u32));
        }
    }

    #[test]
    fn the_embedded_networks() {
        let shape = |name| {
            let n = load_embedded(name, &[], None).unwrap().network;
            let out = n.zones.iter().filter(|z| z.exit == Exit::Out).count();
            (n.zones.len(), n.roads.len(), out)
        };
        assert_eq!(shape("two-merges"), (2, 3, 1));
        assert_eq!(shape("varying-demand"), (2, 3, 1));
        assert_eq!(shape("corridor-8"), (8, 9, 1));
        assert_eq!(shape("tree"), (5, 6, 1));
    }
}
