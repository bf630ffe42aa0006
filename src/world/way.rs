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

    /// A way that begins on a path of a zone, with the paths behind it.
    pub(super) fn begun(&self, mut way: Way, vehicle: u32, zone: ZoneId) -> Way {
        self.look_ahead(&mut way, vehicle, zone);
        way
    }

    /// Zones and paths of a way out of the network.
    pub(super) fn whole(&self, mut way: Way, vehicle: u32, mut zone: ZoneId) -> Vec<(ZoneId, u32)> {
        let mut all = vec![(zone, way.path)];
        while way.next_zone != NONE {
            zone = way.next_zone;
            way = self.onward(way, vehicle, zone);
            all.push((zone, way.path));
        }
        all
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::super::World;
    use super::*;
    use crate::scenario::load_given;
    use std::sync::Arc;

    /// Two zones behind each other, each with two ways out of its one entrance.
    fn network(road: &str) -> String {
        let zone = |name: &str, source: &str| {
            format!(
                "[[zones]]\nname = \"{name}\"\nsegments = [\n{{ name = \"in\", length_m = 100, {source} }},\n\
                 {{ name = \"left\", length_m = 20 }},\n{{ name = \"right\", length_m = 20 }},\n]\npaths = [\n\
                 {{ name = \"l\", segments = [\"in\", \"left\"], exit = \"on\", share = 0.3 }},\n\
                 {{ name = \"r\", segments = [\"in\", \"right\"], exit = \"on\", share = 0.9 }},\n]\n"
            )
        };
        let vehicle = "u_min_mps2 = -4\nu_max_mps2 = 4\nv_max_mps = 20\nlength_m = 4.5\nreaction_time_s = 1";
        format!(
            "name = \"ways\"\nseed = 1\ndt_s = 0.1\nobjective = {{ beta = 1 }}\n[end]\ntime_s = 200\n[vehicle]\n{vehicle}\n\
             standstill_gap_m = 0\n{}{}[[roads]]\nname = \"road\"\n{road}",
            zone("a", "road = \"road\""),
            zone("b", "zone = \"a\", exit = \"on\""),
        )
    }

    #[test]
    fn ways_are_drawn_by_the_shares_and_taken_as_they_were_told() {
        let demand = "demand = { rates = [{ until_s = 1, vehicles_per_hour = 1 }], min_headway_s = 1, speed_mean_mps = 9, \
                      speed_sd_mps = 0, speed_min_mps = 9, speed_max_mps = 9 }\n";
        let scenario = load_given(&network(demand), Vec::new(), &[], None).unwrap();
        let ways = Ways::of(&scenario);
        let mut counts = [[0u32; 2]; 2];
        for vehicle in 0..20_000 {
            let way = ways.at_road(0, vehicle, None);
            assert_eq!((way.next_zone, way.then_path), (1, NONE));
            let onward = ways.onward(way, vehicle, 1);
            assert_eq!((onward.path, onward.next_zone), (way.next_path, NONE), "as it was told");
            counts[way.path as usize][onward.path as usize] += 1;
        }
        // 1 of 4 goes left in each, whatever it did before: four standard deviations are 0.012.
        for (path, share) in [(0, 0.25), (1, 0.75)] {
            let of_all = |count: u32| f64::from(count) / 20_000.0;
            assert!((of_all(counts[path].iter().sum()) - share).abs() < 0.015, "{counts:?}");
            assert!((of_all(counts.iter().map(|to| to[path]).sum()) - share).abs() < 0.015, "{counts:?}");
            assert!((of_all(counts[path][0]) - share * 0.25).abs() < 0.015, "{counts:?}");
        }
    }

    #[test]
    fn a_trace_names_routes_and_states_say_where_vehicles_turn() {
        let road = "routes = [{ name = \"lr\", paths = [\"a.l\", \"b.r\"] }, { name = \"rl\", paths = [\"a.r\", \"b.l\"] }]\n\
                    demand = { trace = \"t.csv\" }\n";
        let trace = "time_s,road,speed_mps,route\n1,road,10,lr\n9,road,10,rl\n17,road,10,lr\n";
        let traces = vec![("t.csv".to_owned(), trace.as_bytes().to_vec())];
        let scenario = Arc::new(load_given(&network(road), traces, &[], None).unwrap());
        let mut run = crate::lockstep::in_process::InProcess::new(&scenario, 1, 1);
        let mut seen: Vec<(u32, u32, u32, u32)> = Vec::new();
        let mut note = |world: &World| {
            let states = world.records().filter(|s| s.is_commanded());
            seen.extend(states.map(|s| (s.vehicle, s.zone, s.path, s.next_path)));
        };
        note(run.world());
        while run.step().unwrap() {
            note(run.world());
        }
        seen.sort_unstable();
        seen.dedup();
        let (l, r) = (0, 1);
        let expected = [(0, l, r), (1, r, l), (2, l, r)];
        let expected =
            expected.iter().flat_map(|&(vehicle, a, b)| [(vehicle, 0, a, b), (vehicle, 1, b, NONE)]);
        assert_eq!(seen, expected.collect::<Vec<_>>());
    }
}
