//! Which paths a vehicle takes from zone to zone.

use crate::scenario::{Network, Scenario, ZoneId, draw};

/// The path of a vehicle in one zone and the next two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Way {
    pub path: u32,
    pub next_zone: u32,
    pub next_path: u32,
    pub then_path: u32,
    /// Index of the road's route, [`NONE`] when its paths are drawn.
    pub route: u32,
    pub road: u32,
    pub hop: u16,
}

/// No path, or no route.
pub(super) const NONE: u32 = u32::MAX;

/// Decides ways. Every draw is a hash of seed, vehicle and place on the way, so nothing is remembered, and what
/// one vehicle does changes nobody else's way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ways<'a> {
    network: &'a Network,
    seed: u64,
}

impl<'a> Ways<'a> {
    pub(super) fn of(scenario: &'a Scenario) -> Ways<'a> {
        Ways { network: &scenario.network, seed: scenario.seed }
    }

    /// The way of a vehicle that arrives by a road; `named` is the route its arrival names.
    pub(super) fn at_road(&self, road: u32, vehicle: u32, named: Option<u32>) -> Way {
        let entry = &self.network.roads[road as usize];
        let route = named.unwrap_or_else(|| match entry.routes.iter().any(|route| route.share > 0.0) {
            true => {
                let shares = entry.routes.iter().map(|route| route.share);
                draw::choice(self.seed, u64::from(vehicle), draw::ROUTE, shares) as u32
            }
            false => NONE,
        });
        let mut way =
            Way { path: NONE, next_zone: NONE, next_path: NONE, then_path: NONE, route, road, hop: 0 };
        way.path = self.path_at(&way, vehicle, 0, entry.zone, entry.segment);
        self.look_ahead(&mut way, vehicle, entry.zone);
        way
    }

    /// The way behind the exit of a zone; the vehicle comes into `zone` next.
    pub(super) fn onward(&self, way: Way, vehicle: u32, zone: ZoneId) -> Way {
        let mut way = Way {
            path: way.next_path,
            next_zone: NONE,
            next_path: NONE,
            then_path: NONE,
            hop: way.hop.saturating_add(1),
            ..way
        };
        self.look_ahead(&mut way, vehicle, zone);
        way
    }

    /// Fills in the paths behind the one in `zone`.
    fn look_ahead(&self, way: &mut Way, vehicle: u32, zone: ZoneId) {
        let Some((next, segment)) = self.behind(zone, way.path) else { return };
        way.next_zone = next;
        way.next_path = self.path_at(way, vehicle, 1, next, segment);
        let Some((then, segment)) = self.behind(next, way.next_path) else { return };
        way.then_path = self.path_at(way, vehicle, 2, then, segment);
    }

    /// Zone and entrance that a path leads to.
    fn behind(&self, zone: ZoneId, path: u32) -> Option<(ZoneId, u32)> {
        let to = self.network.zones[zone as usize].exit_of(path).to?;
        Some((to.zone, to.segment))
    }

    fn path_at(&self, way: &Way, vehicle: u32, ahead: usize, zone: ZoneId, segment: u32) -> u32 {
        let zone = &self.network.zones[zone as usize];
        let hop = usize::from(way.hop) + ahead;
        if way.route != NONE {
            let route = &self.network.roads[way.road as usize].routes[way.route as usize];
            if let Some(&path) = route.paths.get(hop) {
                return path;
            }
        }
        let mut open = zone.paths_from(segment);
        let first = open.next().expect("an entrance has a path");
        if open.next().is_none() {
            return first;
        }
        let paths = zone.paths_from(segment);
        let shares = paths.clone().map(|path| zone.paths[path as usize].share);
        let drawn = draw::choice(self.seed, u64::from(vehicle), hop as u64, shares);
        paths.clone().nth(drawn).expect("a draw is among what it was made from")
    }
}
