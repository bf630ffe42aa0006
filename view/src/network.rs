//! The network as the page draws it.

use control_zones::conflict::{Conflicts, PointKind};
use control_zones::scenario::shapes::{Place, Shapes};
use control_zones::scenario::{Scenario, Source, ZoneId};
use serde::Serialize;

/// All there is to draw.
#[derive(Debug, Serialize)]
pub struct NetworkView {
    zones: Vec<ZoneView>,
    /// Links with a length, by zone and exit: as records number them.
    links: Vec<LinkView>,
    /// From an exit to the entrance that follows at once, where it is drawn elsewhere.
    joins: Vec<Vec<Place>>,
    kinds: Vec<KindView>,
}

#[derive(Debug, Serialize)]
struct ZoneView {
    name: String,
    order: String,
    law: String,
    segments: Vec<SegmentView>,
    paths: Vec<PathView>,
    exits: Vec<ExitView>,
    points: Vec<PointView>,
}

#[derive(Debug, Serialize)]
struct SegmentView {
    name: String,
    length_m: f64,
    shape: Vec<Place>,
    is_entrance: bool,
    road: Option<String>,
}

#[derive(Debug, Serialize)]
struct PathView {
    name: String,
    segments: Vec<u32>,
    length_m: f64,
    exit: u32,
    /// Point and place along the path, m.
    uses: Vec<(u32, f64)>,
}

#[derive(Debug, Serialize)]
struct ExitView {
    name: String,
    to: Option<ZoneId>,
    place: Place,
}

#[derive(Debug, Serialize)]
struct PointView {
    name: String,
    kind: &'static str,
    area_m: f64,
    place: Option<Place>,
}

#[derive(Debug, Serialize)]
struct LinkView {
    zone: ZoneId,
    length_m: f64,
    shape: Vec<Place>,
}

#[derive(Debug, Serialize)]
struct KindView {
    name: String,
    length_m: f64,
    v_max_mps: f64,
}

/// A setting as scenarios write it.
fn setting(value: impl Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
}

impl NetworkView {
    /// The network of a scenario.
    pub fn of(scenario: &Scenario) -> NetworkView {
        let network = &scenario.network;
        let shapes = Shapes::of(network);
        let zones = (0..).zip(&network.zones).map(|(id, zone)| {
            let conflicts = Conflicts::of(network, id);
            let segments =
                zone.segments.iter().zip(shapes.segments(id)).map(|(segment, shape)| SegmentView {
                    name: segment.name.clone(),
                    length_m: segment.length_m,
                    shape: shape.clone(),
                    is_entrance: segment.source.is_some(),
                    road: match segment.source {
                        Some(Source::Road(road)) => Some(network.roads[road as usize].name.clone()),
                        _ => None,
                    },
                });
            let paths = (0..).zip(&zone.paths).map(|(path, own)| PathView {
                name: own.name.clone(),
                segments: own.segments.clone(),
                length_m: own.length_m,
                exit: own.exit,
                uses: conflicts.uses(path).iter().map(|u| (u.point, u.at_m)).collect(),
            });
            let exits = (0..).zip(&zone.exits).map(|(at, exit)| ExitView {
                name: exit.name.clone(),
                to: exit.to.map(|to| to.zone),
                place: shapes.exit(network, id, at),
            });
            let points = (0..).zip(conflicts.points()).map(|(at, point)| PointView {
                name: point.name.clone(),
                kind: if point.kind == PointKind::Merge { "merge" } else { "crossing" },
                area_m: conflicts.first_use(at).map_or(0.0, |(_, passes)| passes.area_m),
                place: conflicts
                    .first_use(at)
                    .map(|(path, passes)| shapes.on_path(network, id, path, passes.at_m)),
            });
            ZoneView {
                name: zone.name.clone(),
                order: setting(zone.order),
                law: setting(zone.law),
                segments: segments.collect(),
                paths: paths.collect(),
                exits: exits.collect(),
                points: points.collect(),
            }
        });
        let exits =
            (0..).zip(&network.zones).flat_map(|(id, zone)| (0..).zip(&zone.exits).map(move |e| (id, e)));
        let links = exits.clone().filter_map(|(zone, (at, exit))| {
            let length_m = exit.to.map(|to| to.link_m).filter(|length_m| *length_m > 0.0)?;
            Some(LinkView { zone, length_m, shape: shapes.link(network, zone, at)? })
        });
        let joins = exits.clone().filter_map(|(zone, (at, exit))| {
            let join =
                shapes.link(network, zone, at).filter(|_| exit.to.is_some_and(|to| to.link_m == 0.0))?;
            (join[0] != join[join.len() - 1]).then_some(join)
        });
        let joins = joins.collect();
        let kinds = scenario.fleet.iter().map(|kind| KindView {
            name: kind.name.clone(),
            length_m: kind.vehicle.length_m,
            v_max_mps: kind.vehicle.v_max_mps,
        });
        NetworkView { zones: zones.collect(), links: links.collect(), joins, kinds: kinds.collect() }
    }
}
