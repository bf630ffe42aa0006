//! What a zone is made of: lanes, paths, exits and crossings, as its table tells.

use super::error::{ScenarioError, nearest};
use super::sections;
use super::table::{Field, Table, find, unique_names};
use crate::scenario::{
    ConflictArea, Crossing, Exit, FlowPolicy, LawKind, PassingOrder, Path, Segment, Zone, keys, ranges,
};

/// Name of the one exit of a zone in the short form.
const ONLY_EXIT: &str = "exit";

/// A zone as far as its own table tells, and the tables of its entrances.
pub(super) struct Shape<'a> {
    pub(super) zone: Zone,
    /// Indices of segments, with their tables.
    pub(super) entrances: Vec<(usize, Table<'a>)>,
}

pub(super) fn zone<'a>(
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
