//! How zones and roads hang together: sources resolved, zones sorted.

use super::error::ScenarioError;
use super::table::{Field, Table, find};
use super::zone::{Shape, zone};
use crate::scenario::network::entrance_without_way_out;
use crate::scenario::{Downstream, LawKind, PassingOrder, Segment, Source, Zone, ranges};

/// The network's shape; flow policies are still [`FlowPolicy::None`].
pub(super) struct Topology {
    /// Zones in topological order, otherwise as declared.
    pub(super) zones: Vec<Zone>,
    /// For each of them, its index as declared.
    pub(super) declared: Vec<usize>,
    /// Zone and entrance each road leads to.
    pub(super) road_ends: Vec<(u32, u32)>,
}

/// Reads all zones; `step_m` is the farthest a vehicle may go in one step.
pub(super) fn read(
    zones: &[Table<'_>],
    zone_names: &[&str],
    roads: &[Table<'_>],
    road_names: &[&str],
    (step_m, v_max_mps): (f64, f64),
    (law, order): (LawKind, PassingOrder),
) -> Result<Topology, ScenarioError> {
    // What zones have inside comes first, so that sources may name exits of any zone.
    let mut shapes = Vec::with_capacity(zones.len());
    for (table, name) in zones.iter().zip(zone_names) {
        shapes.push(zone(table, name, step_m, (law, order))?);
    }
    let exit_names: Vec<Vec<String>> =
        shapes.iter().map(|s| s.zone.exits.iter().map(|e| e.name.clone()).collect()).collect();
    let mut claims = Claims {
        exits: exit_names.iter().map(|names| vec![None; names.len()]).collect(),
        exit_names,
        roads: vec![None; roads.len()],
        step_m,
        v_max_mps,
    };
    for (index, shape) in shapes.iter_mut().enumerate() {
        let Shape { zone, entrances } = shape;
        for (segment, table) in entrances {
            let end = (index as u32, *segment as u32);
            zone.segments[*segment].source = Some(claims.source(table, end, zone_names, road_names)?);
        }
    }
    let mut sorted_zones: Vec<Zone> = shapes.into_iter().map(|shape| shape.zone).collect();
    // Before the roads: whoever closes a cycle has mostly taken an entrance from a road.
    claims.require_way_out(zone_names)?;
    let declared = sort(&sorted_zones);
    let mut road_ends = Vec::with_capacity(roads.len());
    for (table, claim) in roads.iter().zip(&claims.roads) {
        match claim {
            Some((zone, segment, _)) => road_ends.push((*zone, *segment)),
            None => {
                let expected = "a zone with this road as a source";
                let field = table.need("name", expected)?;
                return Err(field.bad_because(Some("no zone uses this road".into()), expected));
            }
        }
    }

    // From indices as declared to sorted ones.
    let mut sorted = vec![0; declared.len()];
    for (new, &old) in declared.iter().enumerate() {
        sorted[old] = new as u32;
    }
    for (zone, exits) in sorted_zones.iter_mut().zip(&claims.exits) {
        for segment in &mut zone.segments {
            if let Some(Source::Zone { zone, .. }) = &mut segment.source {
                *zone = sorted[*zone as usize];
            }
        }
        for (exit, claim) in zone.exits.iter_mut().zip(exits) {
            exit.to =
                claim.as_ref().map(|claim| Downstream { zone: sorted[claim.to.zone as usize], ..claim.to });
        }
    }
    let mut slots: Vec<Option<Zone>> = sorted_zones.into_iter().map(Some).collect();
    let zones: Vec<Zone> =
        declared.iter().map(|&old| slots[old].take().expect("each zone is sorted once")).collect();
    if let Some(trap) = entrance_without_way_out(&zones) {
        let leads_there = |claim: &&Claim<'_>| (sorted[claim.to.zone as usize], claim.to.segment) == trap;
        let claim = claims.exits.iter().flatten().flatten().find(leads_there);
        let problem = Some("nobody who comes in here leaves the network again".to_owned());
        let field = &claim.expect("an exit leads to the entrance").field;
        return Err(field.bad_because(problem, "an entrance with a path that leads out in the end"));
    }
    let road_ends = road_ends.into_iter().map(|(zone, segment)| (sorted[zone as usize], segment)).collect();
    Ok(Topology { zones, declared, road_ends })
}

/// Who uses which exit and which road, by indices as declared.
struct Claims<'a> {
    /// By zone and exit.
    exits: Vec<Vec<Option<Claim<'a>>>>,
    exit_names: Vec<Vec<String>>,
    /// Zone, entrance, and the key path that claimed it.
    roads: Vec<Option<(u32, u32, String)>>,
    step_m: f64,
    v_max_mps: f64,
}

/// An entrance that claimed an exit.
#[derive(Clone)]
struct Claim<'a> {
    to: Downstream,
    /// The `zone` key that says so, for messages.
    field: Field<'a>,
}

impl<'a> Claims<'a> {
    fn source(
        &mut self,
        t: &Table<'a>,
        (zone, segment): (u32, u32),
        zone_names: &[&str],
        road_names: &[&str],
    ) -> Result<Source, ScenarioError> {
        let step_m = self.step_m;
        match t.either("road", "zone") {
            (None, None) => Err(t.missing("road", "a source: road = \"NAME\", or zone = \"NAME\" upstream")),
            (Some(_), Some(zone)) => {
                Err(zone.bad_because(Some("road is given as well".into()), "one source, either road or zone"))
            }
            (Some(field), None) => {
                let road = find(&field, "road", road_names)?;
                if let Some((_, _, other)) = &self.roads[road] {
                    let problem = Some(format!("{other} uses this road already"));
                    return Err(field.bad_because(problem, "a road that nothing else uses"));
                }
                self.roads[road] = Some((zone, segment, t.key("road")));
                // A road by --set in place of the file's zone leaves that zone's keys without meaning.
                for key in ["link_m", "link_speed_mps", "exit"] {
                    if let Some(other) = t.get(key).filter(|other| other.is_set() || !field.is_set()) {
                        let problem = Some("the source is a road".to_owned());
                        return Err(other.bad_because(problem, &format!("{key} only with zone")));
                    }
                }
                Ok(Source::Road(road as u32))
            }
            (None, Some(field)) => {
                let upstream = find(&field, "zone", zone_names)?;
                let names = &self.exit_names[upstream];
                let exit = match (t.get("exit"), names.len()) {
                    (None, 1) => 0,
                    (None, _) => {
                        let expected = format!(
                            "the exit of {} it comes from: {}",
                            zone_names[upstream],
                            names.join(", ")
                        );
                        return Err(t.missing("exit", &expected));
                    }
                    (Some(field), _) => {
                        let names: Vec<&str> = names.iter().map(String::as_str).collect();
                        find(&field, "exit", &names)?
                    }
                };
                if let Some(other) = &self.exits[upstream][exit] {
                    let problem = Some(format!("{} claims the exit of this zone already", other.field.path));
                    return Err(field.bad_because(problem, "a zone whose exit leads nowhere else"));
                }
                let link = ranges::LINK_LENGTH;
                let why = "v_max_mps * dt_s, so that a vehicle passes at most one boundary per step";
                let expected = format!("{link}, >= {step_m} m = {why}");
                let is_link = |l| link.contains(l) && (l == 0.0 || l >= step_m);
                let link_m = t.f64_or("link_m", 0.0, is_link, &expected)?;
                let v_max_mps = self.v_max_mps;
                let expected = format!("{}, <= v_max_mps = {v_max_mps}", ranges::LINK_SPEED);
                let is_speed = |v| ranges::LINK_SPEED.contains(v) && v <= v_max_mps;
                let link_speed_mps = t.f64_or("link_speed_mps", v_max_mps / 2.0, is_speed, &expected)?;
                let to = Downstream { zone, segment, link_m, link_speed_mps };
                self.exits[upstream][exit] = Some(Claim { to, field });
                Ok(Source::Zone { zone: upstream as u32, exit: exit as u32 })
            }
        }
    }

    /// Refuses networks with zones from which nobody ever comes out.
    fn require_way_out(&self, names: &[&str]) -> Result<(), ScenarioError> {
        let count = self.exits.len();
        let mut feeders: Vec<Vec<usize>> = vec![Vec::new(); count];
        for (zone, exits) in self.exits.iter().enumerate() {
            exits.iter().flatten().for_each(|claim| feeders[claim.to.zone as usize].push(zone));
        }
        let mut has_way: Vec<bool> =
            self.exits.iter().map(|exits| exits.iter().any(Option::is_none)).collect();
        let mut found: Vec<usize> = (0..count).filter(|&zone| has_way[zone]).collect();
        while let Some(zone) = found.pop() {
            for &feeder in &feeders[zone] {
                if !std::mem::replace(&mut has_way[feeder], true) {
                    found.push(feeder);
                }
            }
        }
        let Some(start) = has_way.iter().position(|has| !has) else { return Ok(()) };
        // All exits of such a zone lead to others like it: following them comes round.
        let next =
            |zone: usize| self.exits[zone][0].as_ref().expect("its exits all lead to zones").to.zone as usize;
        let mut members = vec![start];
        let mut is_member = vec![false; count];
        is_member[start] = true;
        let mut zone = next(start);
        while !std::mem::replace(&mut is_member[zone], true) {
            members.push(zone);
            zone = next(zone);
        }
        members.drain(..members.iter().position(|&member| member == zone).unwrap_or(0));
        let start = members[0];
        // The connection to name is the one a --set made, if one did.
        let field = |zone: usize| &self.exits[zone][0].as_ref().expect("its exits all lead to zones").field;
        let blamed = members.iter().copied().find(|&zone| field(zone).is_set()).unwrap_or(start);
        let field = field(blamed);
        Err(ScenarioError::Cycle {
            place: field.place(),
            key: field.path.as_str().into(),
            found: field.found().into(),
            cycle: members.iter().chain([&start]).map(|z| names[*z]).collect::<Vec<_>>().join(" -> ").into(),
        })
    }
}

/// Zones upstream first; among those that are free to come next, the one declared first. Where a cycle leaves
/// none free, the one declared first of all that are left.
fn sort(zones: &[Zone]) -> Vec<usize> {
    let sources = |zone: &Zone| {
        let from = |s: &Segment| match s.source {
            Some(Source::Zone { zone, .. }) => Some(zone as usize),
            _ => None,
        };
        zone.segments.iter().filter_map(from).collect::<Vec<usize>>()
    };
    let mut waiting: Vec<usize> = zones.iter().map(|zone| sources(zone).len()).collect();
    let mut feeds: Vec<Vec<usize>> = vec![Vec::new(); zones.len()];
    for (index, zone) in zones.iter().enumerate() {
        sources(zone).into_iter().for_each(|from| feeds[from].push(index));
    }
    let mut left: std::collections::BTreeSet<usize> = (0..zones.len()).collect();
    let mut ready: std::collections::BTreeSet<usize> =
        (0..waiting.len()).filter(|&z| waiting[z] == 0).collect();
    let mut order = Vec::with_capacity(waiting.len());
    while let Some(zone) = ready.pop_first().or_else(|| left.first().copied()) {
        left.remove(&zone);
        order.push(zone);
        for &next in &feeds[zone] {
            waiting[next] -= 1;
            if waiting[next] == 0 && left.contains(&next) {
                ready.insert(next);
            }
        }
    }
    order
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::{TraceBase, load_text};
    use crate::scenario::{Downstream, Scenario, Source, load_embedded};

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
        assert_eq!(n.zones[3].segments[0].source, Some(Source::Zone { zone: 2, exit: 0 }));
        assert_eq!(n.zones[2].segments[0].source, Some(Source::Zone { zone: 1, exit: 0 }));
        assert_eq!(
            n.zones[1].exits[0].to,
            Some(Downstream { zone: 2, segment: 0, link_m: 0.0, link_speed_mps: 15.0 })
        );
        assert_eq!(n.zones[0].exits[0].to, None);
        for (index, road) in n.roads.iter().enumerate() {
            let entrance = &n.zones[road.zone as usize].segments[road.segment as usize];
            assert_eq!(entrance.source, Some(Source::Road(index as u32)));
        }
    }

    #[test]
    fn an_entrance_from_which_nobody_comes_out_is_refused() {
        let text = "name = \"n\"\nobjective = { beta = 1 }\n[[zones]]\nname = \"z\"\nsegments = [\n\
             { name = \"in\", length_m = 100, road = \"r\" },\n\
             { name = \"again\", length_m = 100, zone = \"z\", exit = \"back\" },\n]\npaths = [\n\
             { name = \"a\", segments = [\"in\"], exit = \"out\" },\n\
             { name = \"b\", segments = [\"in\"], exit = \"back\" },\n\
             { name = \"c\", segments = [\"again\"], exit = \"EXIT\" },\n]\n[[roads]]\nname = \"r\"\n\
             [roads.demand]\nrates = [{ until_s = 1, vehicles_per_hour = 1 }]\nmin_headway_s = 1\n\
             speed_mean_mps = 9\nspeed_sd_mps = 1\nspeed_min_mps = 8\nspeed_max_mps = 10\n";
        let load = |exit| load_text("n.toml", &text.replace("EXIT", exit), TraceBase::Embedded, &[], None);
        let refused = load("back").unwrap_err().to_string();
        assert_eq!(
            refused,
            "n.toml:7: zones.z.segments.again.zone = \"z\": nobody who comes in here leaves the network again; expected \
             an entrance with a path that leads out in the end"
        );
        let mut sound = load("out").unwrap();
        assert_eq!(sound.check(), Ok(()));
        sound.network.zones[0].paths[2].exit = sound.network.zones[0].paths[1].exit;
        assert!(sound.check().is_err());
    }

    #[test]
    fn the_embedded_networks() {
        let shape = |name| {
            let n = load_embedded(name, &[], None).unwrap().network;
            let out = n.zones.iter().filter(|z| z.exits[0].to.is_none()).count();
            (n.zones.len(), n.roads.len(), out)
        };
        assert_eq!(shape("two-merges"), (2, 3, 1));
        assert_eq!(shape("varying-demand"), (2, 3, 1));
        assert_eq!(shape("corridor-8"), (8, 9, 1));
        assert_eq!(shape("tree"), (5, 6, 1));
    }
}
