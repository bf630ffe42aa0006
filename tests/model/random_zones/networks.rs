//! Networks drawn at random, as texts that the loader reads: segments, merges, diverges, crossings, exits, links,
//! routes, orders, kinds of vehicles, demand.

use control_zones::scenario::{PassingOrder, Scenario, load_given};
use proptest::prelude::*;
use std::fmt::Write as _;

/// Demand ends after this, s.
pub const DEMAND_S: f64 = 60.0;
/// By then everybody must have left, s.
pub const END_S: f64 = 2400.0;
const DT_S: f64 = 0.1;

/// The passing orders there are, with their words.
pub const ORDERS: [(PassingOrder, &str); 3] = [
    (PassingOrder::Fifo, "fifo"),
    (PassingOrder::PerPoint, "per_point"),
    (PassingOrder::Resequenced, "resequenced"),
];

/// What is drawn; indices are taken modulo what there is.
#[derive(Clone, Debug)]
pub struct RawNetwork {
    pub zones: Vec<RawZone>,
    pub vehicle: RawVehicle,
    pub seed: u64,
    /// Whether every conflict point is far enough behind each entrance for the fastest vehicle to stop before it.
    pub is_roomy: bool,
}

#[derive(Clone, Debug)]
pub struct RawVehicle {
    pub v_max_mps: f64,
    pub braking_mps2: f64,
    pub reaction_s: f64,
    pub gap_m: f64,
    pub has_trucks: bool,
}

#[derive(Clone, Debug)]
pub struct RawZone {
    /// Lengths of entrances, of the segments behind them, and of those behind these, m.
    pub entrances_m: Vec<f64>,
    pub inner_m: Vec<f64>,
    pub last_m: Vec<f64>,
    pub paths: Vec<RawPath>,
    pub crossings: Vec<RawCrossing>,
    pub exits: Vec<RawExit>,
    /// Which of the passing orders there are.
    pub order: usize,
    pub demands: Vec<RawDemand>,
}

#[derive(Clone, Copy, Debug)]
pub struct RawPath {
    pub entrance: usize,
    pub inner: usize,
    pub last: Option<usize>,
    pub exit: usize,
    pub share: f64,
}

#[derive(Clone, Copy, Debug)]
pub struct RawCrossing {
    pub segments: (usize, usize),
    /// Where, as fractions of the segments' lengths.
    pub at: (f64, f64),
    pub length_m: f64,
}

#[derive(Clone, Copy, Debug)]
pub struct RawExit {
    pub kind: usize,
    pub to: usize,
    pub link_m: f64,
}

#[derive(Clone, Copy, Debug)]
pub struct RawDemand {
    pub per_hour: f64,
    pub headway_s: f64,
    pub speed_mps: f64,
    pub has_routes: bool,
}

fn zone() -> impl Strategy<Value = RawZone> {
    let lengths = |count| prop::collection::vec(20.0..150.0_f64, count);
    let path = (0..3usize, 0..3usize, prop::option::of(0..2usize), 0..3usize, 0.2..1.0_f64)
        .prop_map(|(entrance, inner, last, exit, share)| RawPath { entrance, inner, last, exit, share });
    // Where they begin at the beginnings of segments, these may be ways that part.
    let at = prop_oneof![3 => (0.0..1.0_f64, 0.0..1.0_f64), 1 => Just((0.0, 0.0))];
    let crossing = ((0..8usize, 0..8usize), at, 1.0..8.0_f64)
        .prop_map(|(segments, at, length_m)| RawCrossing { segments, at, length_m });
    let exit = (0..6usize, 0..6usize, prop_oneof![2 => Just(0.0), 1 => 20.0..120.0_f64])
        .prop_map(|(kind, to, link_m)| RawExit { kind, to, link_m });
    let demand = (100.0..900.0_f64, 1.5..3.0_f64, 7.0..12.0_f64, any::<bool>()).prop_map(
        |(per_hour, headway_s, speed_mps, has_routes)| RawDemand {
            per_hour,
            headway_s,
            speed_mps,
            has_routes,
        },
    );
    (
        lengths(1..=3),
        lengths(1..=3),
        lengths(0..=2),
        prop::collection::vec(path, 1..=6),
        prop::collection::vec(crossing, 0..=5),
        prop::collection::vec(exit, 1..=3),
        0..ORDERS.len(),
        prop::collection::vec(demand, 3),
    )
        .prop_map(|(entrances_m, inner_m, last_m, paths, crossings, exits, order, demands)| RawZone {
            entrances_m,
            inner_m,
            last_m,
            paths,
            crossings,
            exits,
            order,
            demands,
        })
}

/// Networks of up to four zones.
pub fn network() -> impl Strategy<Value = RawNetwork> {
    let vehicle = (
        12.0..20.0_f64,
        3.0..5.0_f64,
        1.0..1.8_f64,
        prop_oneof![Just(0.0), Just(5.0), 1.0..10.0_f64],
        prop::bool::weighted(0.3),
    )
        .prop_map(|(v_max_mps, braking_mps2, reaction_s, gap_m, has_trucks)| RawVehicle {
            v_max_mps,
            braking_mps2,
            reaction_s,
            gap_m,
            has_trucks,
        });
    (prop::collection::vec(zone(), 1..=4), vehicle, any::<u64>(), prop::bool::weighted(0.7))
        .prop_map(|(zones, vehicle, seed, is_roomy)| RawNetwork { zones, vehicle, seed, is_roomy })
}

/// A path as it will be written.
struct Way {
    entrance: usize,
    segments: Vec<usize>,
    exit: usize,
    share: f64,
}

/// A zone as it will be written: what nothing uses is left out.
struct Built {
    /// Name and length, m, by index; entrances first.
    segments: Vec<(String, f64)>,
    is_used: Vec<bool>,
    ways: Vec<Way>,
    /// Exits that some path leads to, and where they go: zone and entrance.
    exits: Vec<(usize, Option<(usize, usize)>)>,
    /// Where each entrance comes from: zone, exit, link in m.
    sources: Vec<Option<(usize, usize, f64)>>,
}

impl RawNetwork {
    /// Braking of the weakest kind, m/s^2.
    fn weakest_mps2(&self) -> f64 {
        if self.vehicle.has_trucks { 2.5 } else { self.vehicle.braking_mps2 }
    }

    /// Distance in which the fastest vehicle stops, and a step, m.
    fn stopping_m(&self) -> f64 {
        let v = self.vehicle.v_max_mps;
        v * v / (2.0 * self.weakest_mps2()) + v * DT_S + 0.1
    }

    fn build(&self) -> Vec<Built> {
        let mut all: Vec<Built> = self.zones.iter().map(|zone| self.build_zone(zone)).collect();
        for here in 0..all.len() {
            for (place, exit) in all[here].exits.clone().into_iter().enumerate() {
                let raw = self.zones[here].exits[exit.0];
                // The first leads on or out, so that there is a way out of every zone.
                let later = all.len() - here - 1;
                let to = match (raw.kind, place) {
                    (0, _) => continue,
                    (5, 1..) => raw.to % (here + 1),
                    _ if later == 0 => continue,
                    _ => here + 1 + raw.to % later,
                };
                // The first entrance of the first zone stays a road.
                let free = |at: &usize| all[to].sources[*at].is_none() && (to, *at) != (0, 0);
                let Some(at) = (0..all[to].sources.len()).find(free) else { continue };
                all[to].sources[at] = Some((here, exit.0, raw.link_m));
                all[here].exits[place].1 = Some((to, at));
            }
        }
        all
    }

    fn build_zone(&self, raw: &RawZone) -> Built {
        let room_m = if self.is_roomy { self.stopping_m() } else { 0.0 };
        let (entrances, inner) = (raw.entrances_m.len(), raw.inner_m.len());
        let mut segments: Vec<(String, f64)> = Vec::new();
        let named = |letter: char, lengths: &[f64], more_m: f64| {
            (0..).zip(lengths).map(|(i, m)| (format!("{letter}{i}"), m + more_m)).collect::<Vec<_>>()
        };
        segments.extend(named('e', &raw.entrances_m, room_m));
        segments.extend(named('i', &raw.inner_m, 0.0));
        segments.extend(named('l', &raw.last_m, 0.0));
        let mut ways: Vec<Way> = Vec::new();
        for at in 0..raw.paths.len().max(entrances) {
            let path = raw.paths[at % raw.paths.len()];
            let entrance = if at < entrances { at } else { path.entrance % entrances };
            let mut own = vec![entrance, entrances + (path.inner + at) % inner];
            if let Some(last) = path.last.filter(|_| !raw.last_m.is_empty()) {
                own.push(entrances + inner + last % raw.last_m.len());
            }
            let exit = path.exit % raw.exits.len();
            if !ways.iter().any(|way| way.segments == own && way.exit == exit) {
                ways.push(Way { entrance, segments: own, exit, share: path.share });
            }
        }
        let is_used = (0..segments.len()).map(|s| ways.iter().any(|way| way.segments.contains(&s))).collect();
        let used_exits = (0..raw.exits.len()).filter(|exit| ways.iter().any(|way| way.exit == *exit));
        let exits = used_exits.map(|exit| (exit, None)).collect();
        Built { segments, is_used, ways, exits, sources: vec![None; entrances] }
    }

    /// The text of the scenario.
    pub fn text(&self) -> String {
        let built = self.build();
        let RawVehicle { v_max_mps, braking_mps2, reaction_s, gap_m, has_trucks } = self.vehicle;
        let mut text = format!(
            "name = \"random\"\nseed = {}\ndt_s = {DT_S}\nshield = \"on\"\nobjective = {{ beta = 1 }}\n\
             [end]\ntime_s = {END_S}\n[vehicle]\nu_min_mps2 = {:?}\nu_max_mps2 = 3\nv_max_mps = {v_max_mps:?}\n\
             length_m = 4.5\nreaction_time_s = {reaction_s:?}\nstandstill_gap_m = {gap_m:?}\n",
            self.seed, -braking_mps2
        );
        if has_trucks {
            let v_max_mps = 0.9 * v_max_mps;
            write!(
                text,
                "[[fleet]]\nname = \"car\"\nshare = 0.7\n[[fleet]]\nname = \"truck\"\nshare = 0.3\nlength_m = 12\n\
                 u_min_mps2 = -2.5\nu_max_mps2 = 1.5\nv_max_mps = {v_max_mps:?}\n"
            )
            .expect("text grows");
        }
        let mut roads = String::new();
        for (index, zone) in built.iter().enumerate() {
            self.write_zone(&mut text, &mut roads, &built, index, zone);
        }
        text + &roads
    }

    fn write_zone(&self, text: &mut String, roads: &mut String, all: &[Built], index: usize, zone: &Built) {
        let raw = &self.zones[index];
        let order = ORDERS[raw.order % ORDERS.len()].1;
        *text += &format!("[[zones]]\nname = \"z{index}\"\norder = \"{order}\"\nsegments = [\n");
        for (at, (name, length_m)) in zone.segments.iter().enumerate().filter(|(at, _)| zone.is_used[*at]) {
            let source = match zone.sources.get(at) {
                None => String::new(),
                Some(None) => {
                    *roads += &self.road(all, index, at);
                    format!(", road = \"r{index}-{at}\"")
                }
                Some(Some((from, exit, link_m))) => {
                    format!(", zone = \"z{from}\", exit = \"x{exit}\", link_m = {link_m:?}")
                }
            };
            *text += &format!("{{ name = \"{name}\", length_m = {length_m:?}{source} }},\n");
        }
        *text += "]\npaths = [\n";
        for (at, way) in zone.ways.iter().enumerate() {
            let names: Vec<String> =
                way.segments.iter().map(|&s| format!("\"{}\"", zone.segments[s].0)).collect();
            let (exit, share) = (way.exit, way.share);
            *text += &format!(
                "{{ name = \"p{at}\", segments = [{}], exit = \"x{exit}\", share = {share:?} }},\n",
                names.join(", ")
            );
        }
        *text += "]\n";
        let crossings = self.crossings(raw, zone);
        if !crossings.is_empty() {
            *text += &format!("crossings = [\n{crossings}]\n");
        }
    }

    fn crossings(&self, raw: &RawZone, zone: &Built) -> String {
        let mut text = String::new();
        // Entrances are as long as a vehicle takes to stop where that is asked for.
        let first = if self.is_roomy { raw.entrances_m.len() } else { 0 };
        let open: Vec<usize> = (first..zone.segments.len()).filter(|&s| zone.is_used[s]).collect();
        for (index, crossing) in raw.crossings.iter().enumerate() {
            if open.is_empty() {
                break;
            }
            let (a, b) = (open[crossing.segments.0 % open.len()], open[crossing.segments.1 % open.len()]);
            let is_shared = |way: &Way| way.segments.contains(&a) && way.segments.contains(&b);
            if a == b || zone.ways.iter().any(is_shared) {
                continue;
            }
            let at_m = |segment: usize, fraction: f64| fraction * zone.segments[segment].1;
            text += &format!(
                "{{ name = \"c{index}\", length_m = {:?}, at = {{ {} = {:?}, {} = {:?} }} }},\n",
                crossing.length_m,
                zone.segments[a].0,
                at_m(a, crossing.at.0),
                zone.segments[b].0,
                at_m(b, crossing.at.1),
            );
        }
        text
    }

    fn road(&self, all: &[Built], zone: usize, entrance: usize) -> String {
        let RawDemand { per_hour, headway_s, speed_mps, has_routes } = self.zones[zone].demands[entrance];
        let mut routes = String::new();
        if has_routes {
            // Two walks, taking the first and the last path at hand.
            let walk = |last: bool| {
                let (mut at, mut paths) = (Some((zone, entrance)), Vec::new());
                while let Some((zone, entrance)) = at.filter(|_| paths.len() < 3) {
                    let mut open = all[zone].ways.iter().enumerate().filter(|(_, w)| w.entrance == entrance);
                    let found = if last { open.next_back() } else { open.next() };
                    let (index, way) = found.expect("an entrance has a path");
                    paths.push(format!("\"z{zone}.p{index}\""));
                    at = all[zone].exits.iter().find(|(exit, _)| *exit == way.exit).and_then(|(_, to)| *to);
                }
                paths.join(", ")
            };
            routes = format!(
                "routes = [\n{{ name = \"a\", paths = [{}], share = 0.7 }},\n{{ name = \"b\", paths = [{}] }},\n]\n",
                walk(false),
                walk(true)
            );
        }
        let (least, greatest) = (speed_mps - 2.0, speed_mps);
        format!(
            "[[roads]]\nname = \"r{zone}-{entrance}\"\n{routes}[roads.demand]\n\
             rates = [{{ until_s = {DEMAND_S:?}, vehicles_per_hour = {per_hour:?} }}]\nmin_headway_s = {headway_s:?}\n\
             speed_mean_mps = {:?}\nspeed_sd_mps = 0.5\nspeed_min_mps = {least:?}\nspeed_max_mps = {greatest:?}\n",
            speed_mps - 1.0
        )
    }

    /// The scenario.
    pub fn scenario(&self) -> Result<Scenario, TestCaseError> {
        let text = self.text();
        load_given(&text, Vec::new(), &[], None).map_err(|error| {
            let error = error.to_string();
            // Entrances are given to exits at random: some lead nowhere but back.
            match error.contains("leaves the network again") {
                true => TestCaseError::reject("no way out"),
                false => TestCaseError::fail(format!("{error}\n{text}")),
            }
        })
    }
}
