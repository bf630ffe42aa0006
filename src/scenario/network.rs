//! The network: control zones, the exits and links between them, and the entry roads.

use super::demand::Demand;
use super::flow::FlowPolicy;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Index of a zone in [`Network::zones`]. Zones are sorted upstream first as far as the network has such an
/// order; a connection to a zone that does not come later closes a cycle.
pub type ZoneId = u32;

/// All zones and entry roads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Network {
    /// Zones, upstream before downstream, otherwise as declared.
    pub zones: Vec<Zone>,
    /// Entry roads as declared; the order breaks ties between simultaneous arrivals.
    pub roads: Vec<Road>,
}

/// One control zone: lanes, the paths vehicles take over them, and where these conflict.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Zone {
    /// Unique name.
    pub name: String,
    /// Stretches of lane.
    pub segments: Vec<Segment>,
    /// Movements, each over some segments from an entrance to an exit; at least one.
    pub paths: Vec<Path>,
    /// Where paths lead; at least one.
    pub exits: Vec<Exit>,
    /// Places where segments cross that no path shares.
    pub crossings: Vec<Crossing>,
    /// Who passes a conflict point first.
    pub order: PassingOrder,
    /// The law of the zone's built-in controllers.
    pub law: LawKind,
}

/// A stretch of lane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Segment {
    /// Name, unique within the zone.
    pub name: String,
    /// Length, m.
    pub length_m: f64,
    /// Where its vehicles come from, if it is an entrance of the zone.
    pub source: Option<Source>,
    /// Polyline it is drawn as, m; empty when nobody said.
    pub shape: Vec<[f64; 2]>,
    /// Whether one that is to let a human pass who does not follow the order waits before it, not on it.
    pub keep_clear: bool,
}

/// One way through a zone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Path {
    /// Name, unique within the zone.
    pub name: String,
    /// Segments from entrance to exit: indices in [`Zone::segments`].
    pub segments: Vec<u32>,
    /// Index in [`Zone::exits`].
    pub exit: u32,
    /// Sum of the segments' lengths, m (paper: L).
    pub length_m: f64,
    /// Weight with which vehicles of its entrance take it when their route does not say.
    pub share: f64,
}

/// Where the vehicles of an entrance come from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Source {
    /// An entry road: index in [`Network::roads`].
    Road(u32),
    /// An exit of a zone: index in its [`Zone::exits`].
    Zone {
        /// The zone upstream.
        zone: ZoneId,
        /// Its exit.
        exit: u32,
    },
}

/// A way out of a zone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Exit {
    /// Name, unique within the zone.
    pub name: String,
    /// Where it leads; `None` out of the network.
    pub to: Option<Downstream>,
    /// How the zone's coordinator sets the terminal speed of those that leave by it.
    pub flow: FlowPolicy,
}

/// Where an exit leads.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Downstream {
    /// The zone.
    pub zone: ZoneId,
    /// Its entrance: index in [`Zone::segments`].
    pub segment: u32,
    /// Length of the plain link in between, m (0: none).
    pub link_m: f64,
    /// Speed driven on that link where nobody is in the way, m/s; without meaning when there is none.
    pub link_speed_mps: f64,
}

/// A conflict area between segments that no path shares.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Crossing {
    /// Name, unique within the zone.
    pub name: String,
    /// Where it is on each segment, in order of these.
    pub places: Vec<ConflictArea>,
}

impl Crossing {
    /// Its conflict area on a segment, if it has one there.
    pub fn area_on(&self, segment: u32) -> Option<&ConflictArea> {
        self.places.iter().find(|area| area.segment == segment)
    }
}

/// Where the conflict area of a crossing is on a segment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ConflictArea {
    /// Index in [`Zone::segments`].
    pub segment: u32,
    /// Where it begins, from the segment's start, m.
    pub from_m: f64,
    /// Its extent along the paths over the segment, m.
    pub length_m: f64,
}

/// How a coordinator decides who passes a conflict point first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PassingOrder {
    /// In order of entry into the zone.
    #[default]
    Fifo,
    /// In order of expected arrival, conflict point by conflict point.
    PerPoint,
    /// In order of entry, but a newcomer goes ahead of up to three others where that lowers the cost of the schedule.
    Resequenced,
}

impl PassingOrder {
    /// The words for them, the default first.
    pub(super) const WORDS: &'static [(&'static str, PassingOrder)] = &[
        ("fifo", PassingOrder::Fifo),
        ("per_point", PassingOrder::PerPoint),
        ("resequenced", PassingOrder::Resequenced),
    ];
}

/// A law of the built-in controllers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LawKind {
    /// Optimal control tracked under control barrier functions, as in the paper.
    #[default]
    Ocbf,
    /// Plans for slots, within what is viable.
    Viable,
}

/// When an arrival may enter behind the last vehicle on its road.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EntryRule {
    /// As soon as it overlaps nobody.
    #[default]
    Free,
    /// Once it is viable toward it: it keeps the distances it owes, whatever that one does.
    Viable,
    /// Once it can stop behind it, whatever that one does.
    RoomToStop,
}

impl EntryRule {
    /// The words for them, the default first.
    pub(super) const WORDS: &'static [(&'static str, EntryRule)] =
        &[("free", EntryRule::Free), ("viable", EntryRule::Viable), ("room_to_stop", EntryRule::RoomToStop)];
}

impl LawKind {
    /// The words for them, the default first.
    pub(super) const WORDS: &'static [(&'static str, LawKind)] =
        &[("ocbf", LawKind::Ocbf), ("viable", LawKind::Viable)];
}

/// An entry road.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Road {
    /// Unique name; arrival traces use it.
    pub name: String,
    /// Zone the road leads to.
    pub zone: ZoneId,
    /// Its entrance: index in [`Zone::segments`].
    pub segment: u32,
    /// Who arrives when.
    pub demand: Demand,
    /// Ways its vehicles may take, with weights; empty when paths are drawn zone by zone.
    pub routes: Vec<Route>,
    /// When they may enter.
    pub entry: EntryRule,
    /// Share of its vehicles that no human drives; that of the kinds when absent.
    #[serde(default)]
    pub automated: Option<f64>,
    /// Humans give way to those of roads of higher rank; vehicles from another zone have the right of way before all.
    #[serde(default)]
    pub rank: u32,
}

/// The paths a vehicle takes from zone to zone; behind the last one paths are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Route {
    /// Name, unique among the road's; arrival traces use it.
    pub name: String,
    /// Indices in [`Zone::paths`], one per zone on the way.
    pub paths: Vec<u32>,
    /// Weight with which vehicles of the road take it; 0 for routes only a trace names.
    pub share: f64,
}

impl Zone {
    /// The paths that begin at an entrance, by index.
    pub fn paths_from(&self, segment: u32) -> impl Iterator<Item = u32> + Clone + '_ {
        (0..).zip(&self.paths).filter(move |(_, path)| path.segments[0] == segment).map(|(index, _)| index)
    }

    /// The entrance a path begins at.
    pub fn entrance(&self, path: u32) -> &Segment {
        &self.segments[self.paths[path as usize].segments[0] as usize]
    }

    /// The exit a path leads to.
    pub fn exit_of(&self, path: u32) -> &Exit {
        &self.exits[self.paths[path as usize].exit as usize]
    }

    /// How far it is from the origin of a path to the zone behind it, m, where that begins at the path's end.
    pub fn onward_m(&self, path: u32) -> Option<f64> {
        let to = self.exit_of(path).to.filter(|to| to.link_m == 0.0);
        to.map(|_| self.paths[path as usize].length_m)
    }

    /// Whether lanes, paths, exits and crossings are the same; names of zones, flow policies, orders and laws may
    /// differ.
    pub fn same_shape(&self, other: &Zone) -> bool {
        let leads_alike = |(a, b): (&Exit, &Exit)| a.name == b.name && a.to == b.to;
        self.segments == other.segments
            && self.paths == other.paths
            && self.crossings == other.crossings
            && self.exits.len() == other.exits.len()
            && self.exits.iter().zip(&other.exits).all(leads_alike)
    }

    /// Length of the longest path, m.
    pub fn longest_m(&self) -> f64 {
        self.paths.iter().map(|path| path.length_m).fold(0.0, f64::max)
    }
}

impl Network {
    /// The zones downstream of a zone, in order of exit; one that two exits lead to twice.
    pub fn downstream(&self, zone: ZoneId) -> impl Iterator<Item = ZoneId> + '_ {
        self.zones[zone as usize].exits.iter().filter_map(|exit| Some(exit.to?.zone))
    }

    /// The zones upstream of a zone, in order of entrance.
    pub fn upstream(&self, zone: ZoneId) -> impl Iterator<Item = ZoneId> + '_ {
        self.zones[zone as usize].segments.iter().filter_map(|segment| match segment.source {
            Some(Source::Zone { zone, .. }) => Some(zone),
            _ => None,
        })
    }

    /// All neighbours of a zone, each once: upstream ones, then downstream ones.
    pub fn neighbours(&self, zone: ZoneId) -> impl Iterator<Item = ZoneId> {
        let mut all: Vec<ZoneId> = Vec::new();
        for neighbour in self.upstream(zone).chain(self.downstream(zone)) {
            if neighbour != zone && !all.contains(&neighbour) {
                all.push(neighbour);
            }
        }
        all.into_iter()
    }
}

/// An entrance, zone and segment, from which nobody comes out of the network, if there is one that a zone leads to:
/// all paths from it lead back.
pub(super) fn entrance_without_way_out(zones: &[Zone]) -> Option<(ZoneId, u32)> {
    let mut feeders: BTreeMap<(ZoneId, u32), Vec<(ZoneId, u32)>> = BTreeMap::new();
    let mut found: Vec<(ZoneId, u32)> = Vec::new();
    for (index, zone) in (0..).zip(zones) {
        for path in &zone.paths {
            let entrance = (index, path.segments[0]);
            match zone.exits[path.exit as usize].to {
                None => found.push(entrance),
                Some(to) => feeders.entry((to.zone, to.segment)).or_default().push(entrance),
            }
        }
    }
    let mut has_way: BTreeSet<(ZoneId, u32)> = BTreeSet::new();
    while let Some(entrance) = found.pop() {
        if has_way.insert(entrance) {
            found.extend(feeders.get(&entrance).into_iter().flatten());
        }
    }
    feeders.into_keys().find(|entrance| !has_way.contains(entrance))
}
