//! How zones and roads hang together: lanes, paths and exits read, sources resolved, zones sorted.

use super::error::{ScenarioError, nearest};
use super::sections;
use super::table::{Field, Table, unique_names};
use crate::scenario::network::entrance_without_way_out;
use crate::scenario::{
    ConflictArea, Crossing, Downstream, Exit, FlowPolicy, LawKind, PassingOrder, Path, Segment, Source, Zone,
    keys, ranges,
};

/// Name of the one exit of a zone in the short form.
const ONLY_EXIT: &str = "exit";

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

/// A zone as far as its own table tells, and the tables of its entrances.
struct Shape<'a> {
    zone: Zone,
    entrances: Vec<(usize, Table<'a>)>,
}

fn zone<'a>(
    table: &Table<'a>,
    name: &str,
    step_m: f64,
    (law, order): (LawKind, PassingOrder),
) -> Result<Shape<'a>, ScenarioError> {
    let order = sections::order(table, order)?;
    let zone = Zone {
        name: name.to_owned(),
        segments: Vec::new(),
        paths: Vec::new(),
        exits: Vec::new(),
        crossings: Vec::new(),
        order,
        law: sections::law(Some(table), law)?,
    };
    match table.either("approaches", "segments") {
        (Some(_), Some(segments)) => {
            let problem = Some("approaches are given as well".to_owned());
            Err(segments.bad_because(problem, "either approaches, or segments and paths"))
        }
        (None, Some(_)) => full(table, zone, step_m),
        _ => short(table, zone, step_m),
    }
}

/// How long something must be that a vehicle may not pass within one step.
fn whole_length(step_m: f64) -> (impl Fn(f64) -> bool, String) {
    let length = ranges::PATH_LENGTH;
    let why = "v_max_mps * dt_s, so that a vehicle passes at most one boundary per step";
    (move |l| length.contains(l) && l >= step_m, format!("{length}, >= {step_m} m = {why}"))
}

/// The short form of a merge: approaches that end in one conflict point, and one exit.
fn short<'a>(table: &Table<'a>, mut zone: Zone, step_m: f64) -> Result<Shape<'a>, ScenarioError> {
    const APPROACHES: &str = "a list of approaches, at least one";
    for key in ["paths", "exits", "crossings"] {
        if let Some(field) = table.get(key) {
            return Err(field
                .bad_because(Some("the zone has no segments".into()), &format!("{key} only with segments")));
        }
    }
    let tables = table.tables("approaches", APPROACHES)?;
    let names = unique_names(&tables, "approach of the zone")?;
    let (is_length, expected) = whole_length(step_m);
    for (index, (t, name)) in tables.iter().zip(names).enumerate() {
        t.only_declared(keys::APPROACHES)?;
        let length_m = t.f64("length_m", &is_length, &expected)?;
        let name = name.to_owned();
        zone.segments.push(Segment {
            name: name.clone(),
            length_m,
            source: None,
            shape: Vec::new(),
            keep_clear: false,
        });
        zone.paths.push(Path { name, segments: vec![index as u32], exit: 0, length_m, share: 1.0 });
    }
    zone.exits.push(Exit { name: ONLY_EXIT.to_owned(), to: None, flow: FlowPolicy::None });
    Ok(Shape { zone, entrances: tables.into_iter().enumerate().collect() })
}

/// The full form: segments, paths over them, exits, and crossings.
fn full<'a>(table: &Table<'a>, mut zone: Zone, step_m: f64) -> Result<Shape<'a>, ScenarioError> {
    let segments = table.tables("segments", "a list of segments, at least one")?;
    let segment_names = unique_names(&segments, "segment of the zone")?;
    for (t, name) in segments.iter().zip(&segment_names) {
        zone.segments.push(segment(t, name)?);
    }
    if table.get("exits").is_some() {
        let exits = table.tables("exits", "a list of exits, at least one")?;
        for (t, name) in exits.iter().zip(unique_names(&exits, "exit of the zone")?) {
            t.only_declared(keys::EXITS)?;
            zone.exits.push(Exit { name: name.to_owned(), to: None, flow: FlowPolicy::None });
        }
    }
    let declares_exits = !zone.exits.is_empty();
    let paths = table.tables("paths", "a list of paths over the segments, at least one")?;
    let path_names = unique_names(&paths, "path of the zone")?;
    let mut is_used = vec![false; segments.len()];
    let (is_length, expected_length) = whole_length(step_m);
    for (t, name) in paths.iter().zip(&path_names) {
        t.only_declared(keys::PATHS)?;
        const SEGMENTS: &str = "a list of segment names from an entrance to an exit";
        let mut own: Vec<u32> = Vec::new();
        for item in t.need("segments", SEGMENTS)?.items(SEGMENTS)? {
            let index = find(&item, "segment", &segment_names)?;
            let is_entrance = is_entrance(&segments[index]);
            if own.contains(&(index as u32)) {
                return Err(item.bad_because(Some("used twice".into()), "each segment once in a path"));
            }
            if own.is_empty() && !is_entrance {
                let problem = Some("it has no source".to_owned());
                return Err(item.bad_because(problem, "a first segment with road or zone"));
            }
            if !own.is_empty() && is_entrance {
                let problem = Some("it is an entrance of the zone".to_owned());
                return Err(item.bad_because(problem, "entrances only as the first segment of a path"));
            }
            is_used[index] = true;
            own.push(index as u32);
        }
        let length_m = own.iter().map(|&s| zone.segments[s as usize].length_m).sum();
        if !is_length(length_m) {
            let problem = Some(format!("the path is {length_m} m long"));
            return Err(t.need("segments", SEGMENTS)?.bad_because(problem, &expected_length));
        }
        const EXIT: &str = "the name of an exit";
        let exit = match t.get("exit") {
            None if zone.exits.len() == 1 && declares_exits => 0,
            None if !declares_exits && path_names.len() == 1 => {
                zone.exits.push(Exit { name: ONLY_EXIT.to_owned(), to: None, flow: FlowPolicy::None });
                0
            }
            None => return Err(t.missing("exit", EXIT)),
            Some(field) => {
                let word = field.str(EXIT)?;
                match zone.exits.iter().position(|e| e.name == word) {
                    Some(at) => at,
                    None if declares_exits => {
                        let known: Vec<&str> = zone.exits.iter().map(|e| e.name.as_str()).collect();
                        find(&field, "exit", &known)?
                    }
                    None => {
                        let name = field.word()?.to_owned();
                        zone.exits.push(Exit { name, to: None, flow: FlowPolicy::None });
                        zone.exits.len() - 1
                    }
                }
            }
        };
        let share = t.number_or(&keys::SHARE, keys::SHARE.default())?;
        zone.paths.push(Path { name: (*name).to_owned(), segments: own, exit: exit as u32, length_m, share });
    }
    if let Some(unused) = is_used.iter().position(|used| !used) {
        let expected = "a segment that some path uses";
        let field = segments[unused].need("name", expected)?;
        return Err(field.bad_because(Some("no path uses this segment".into()), expected));
    }
    for (index, exit) in zone.exits.iter().enumerate() {
        if !zone.paths.iter().any(|path| path.exit as usize == index) {
            let expected = "an exit that some path leads to";
            let exits = table.tables("exits", expected)?;
            let field = exits[index].need("name", expected)?;
            return Err(field.bad_because(Some(format!("no path leads to {}", exit.name)), expected));
        }
    }
    if table.get("crossings").is_some() {
        let crossings = table.tables("crossings", "a list of crossings")?;
        let names = unique_names(&crossings, "crossing of the zone")?;
        for (t, name) in crossings.iter().zip(names) {
            let crossing = crossing(t, name, &zone, &segment_names)?;
            zone.crossings.push(crossing);
        }
    }
    let entrances = segments.into_iter().enumerate().filter(|(_, t)| is_entrance(t));
    Ok(Shape { zone, entrances: entrances.collect() })
}

fn is_entrance(segment: &Table<'_>) -> bool {
    segment.get("road").is_some() || segment.get("zone").is_some()
}

fn segment(t: &Table<'_>, name: &str) -> Result<Segment, ScenarioError> {
    t.only_declared(keys::SEGMENTS)?;
    let mut shape: Vec<[f64; 2]> = Vec::new();
    if let Some(field) = t.get("shape") {
        const SHAPE: &str = "a list of at least two points [x, y], in m, each within 1e7 m of the origin";
        for point in field.items(SHAPE)? {
            let coordinates = point.items(SHAPE)?;
            let [x, y] = &coordinates[..] else { return Err(point.bad(SHAPE)) };
            let number = |field: &Field<'_>| field.f64(|m| m.abs() <= 1e7, SHAPE);
            shape.push([number(x)?, number(y)?]);
        }
        if shape.len() < 2 {
            return Err(field.bad(SHAPE));
        }
    }
    let drawn_m: f64 = shape.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1])).sum();
    let length_m = match (t.get("length_m"), shape.is_empty()) {
        // Rounded, so that no last bit of a square root matters.
        (None, false) => (drawn_m * 1e6).round() / 1e6,
        _ => t.within("length_m", &ranges::SEGMENT_LENGTH)?,
    };
    if !ranges::SEGMENT_LENGTH.contains(length_m) {
        let field = t.need("shape", "")?;
        return Err(
            field.bad_because(Some(format!("it is {length_m} m long")), &ranges::SEGMENT_LENGTH.to_string())
        );
    }
    let keep_clear = t.flag(&keys::KEEP_CLEAR)?;
    if keep_clear && is_entrance(t) {
        return Err(t.need("keep_clear", "")?.bad("a segment that is no entrance: vehicles wait before it"));
    }
    Ok(Segment { name: name.to_owned(), length_m, source: None, shape, keep_clear })
}

fn crossing(
    t: &Table<'_>,
    name: &str,
    zone: &Zone,
    segment_names: &[&str],
) -> Result<Crossing, ScenarioError> {
    t.only_declared(keys::CROSSINGS)?;
    const AT: &str = "a table of places such as {north = 12.5, west = [8, 12]}, at least two";
    let field = t.need("at", AT)?;
    let mut places: Vec<ConflictArea> = Vec::new();
    if t.get("length_m").is_some() {
        t.within("length_m", &ranges::CROSSING_LENGTH)?;
    }
    for (key, place) in field.table(AT)?.entries() {
        let Some(segment) = segment_names.iter().position(|n| *n == key) else {
            let hint = nearest(key, segment_names.iter().copied());
            let hint = hint.map(|h| format!("; did you mean {h}?")).unwrap_or_default();
            return Err(
                place.bad_because(Some("unknown segment".into()), &format!("names of segments{hint}"))
            );
        };
        let longest_m = zone.segments[segment].length_m;
        let from = format!("a distance from 0 to {longest_m} m, the segment's length");
        let from_m = |field: &Field<'_>| field.f64(|m| (0.0..=longest_m).contains(&m), &from);
        let segment = segment as u32;
        places.push(match &place.items("").unwrap_or_default()[..] {
            [] => {
                let from_m = from_m(&place)?;
                ConflictArea { segment, from_m, length_m: t.within("length_m", &ranges::CROSSING_LENGTH)? }
            }
            [first, last] => {
                let from_m = from_m(first)?;
                let long = &ranges::CROSSING_LENGTH;
                let to_m = last.f64(
                    |m| long.contains(m - from_m),
                    &format!("the area's end: {long} behind its beginning"),
                )?;
                ConflictArea { segment, from_m, length_m: to_m - from_m }
            }
            _ => return Err(place.bad(&format!("{from}, or two between which the area is"))),
        });
    }
    places.sort_by_key(|area| area.segment);
    if places.len() < 2 {
        return Err(field.bad(AT));
    }
    for path in &zone.paths {
        if places.iter().filter(|area| path.segments.contains(&area.segment)).count() > 1 {
            let problem = Some(format!("path {} uses two of them", path.name));
            return Err(field.bad_because(problem, "segments that no path shares"));
        }
    }
    Ok(Crossing { name: name.to_owned(), places })
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

/// Index of the name a field gives.
fn find(field: &Field<'_>, what: &str, names: &[&str]) -> Result<usize, ScenarioError> {
    let expected = || {
        let article = if what.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" };
        let word = field.str("").unwrap_or("");
        let hint = nearest(word, names.iter().copied());
        let hint = hint.map(|h| format!("; did you mean {h}?")).unwrap_or_default();
        let mut list = names.iter().take(20).copied().collect::<Vec<_>>().join(", ");
        if names.len() > 20 {
            list += ", ...";
        }
        format!("the name of {article} {what}: {list}{hint}")
    };
    let name = field.str("").map_err(|_| field.bad(&expected()))?;
    let found = names.iter().position(|n| *n == name);
    found.ok_or_else(|| field.bad_because(Some(format!("unknown {what}")), &expected()))
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
