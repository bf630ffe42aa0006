//! Circles in a network: ways on which a vehicle could come back to where it was.
//!
//! Within a zone nobody waits in a circle, because its passing order is one list. Around a circle of zones vehicles can:
//! each stands behind the next. But then they stand close together all the way round, so a network in which fewer
//! vehicles may come into a circle than fit on it is free of that (`docs/architecture.md`, "No lock-up").

use super::Scenario;
use super::network::{Network, ZoneId};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// A vehicle that stands more than this behind where it need not stop any more drives on, m.
const STANDING_RESERVE_M: f64 = 5.0;
/// The circles of a network, and which of them each path can lead into.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Circles {
    /// The greatest number of vehicles that may be on their way into, on, or behind each.
    pub capacity: Vec<u32>,
    /// Sets of circles, ascending; the first is empty.
    sets: Vec<Vec<u32>>,
    /// By zone and path, which set it is part of or leads into; empty without circles.
    reach: Vec<Vec<u32>>,
}

impl Circles {
    /// The circles of a scenario's network.
    pub fn of(scenario: &Scenario) -> Circles {
        let nodes = Nodes::of(&scenario.network);
        let components = nodes.components();
        if components.is_empty() {
            return Circles::default();
        }
        let kinds = scenario.fleet.iter().map(|kind| &kind.vehicle);
        let spacing_m =
            kinds.map(|v| v.length_m.max(v.standstill_gap_m)).fold(0.0, f64::max) + STANDING_RESERVE_M;
        let mut capacity: Vec<u32> = Vec::with_capacity(components.len());
        let mut ahead: Vec<Vec<u32>> = vec![Vec::new(); nodes.all.len()];
        let before = nodes.before();
        for (circle, members) in (0..).zip(components) {
            let around_m = nodes.shortest_circle_m(&members);
            capacity.push(((around_m / spacing_m) as u32).saturating_sub(1).max(1));
            nodes.mark(circle, members, &before, &mut ahead);
        }
        let mut known = BTreeMap::from([(Vec::new(), 0)]);
        let mut sets = vec![Vec::new()];
        let mut reach: Vec<Vec<u32>> =
            scenario.network.zones.iter().map(|z| vec![0; z.paths.len()]).collect();
        for (&(zone, path), set) in nodes.all.iter().zip(ahead) {
            reach[zone as usize][path as usize] = *known.entry(set).or_insert_with_key(|set| {
                sets.push(set.clone());
                sets.len() as u32 - 1
            });
        }
        Circles { capacity, sets, reach }
    }

    /// The circles a vehicle on a path may come into, ascending.
    pub fn ahead_of(&self, zone: ZoneId, path: u32) -> &[u32] {
        self.reach.get(zone as usize).map_or(&[], |paths| &self.sets[paths[path as usize] as usize])
    }
}

/// Paths, and which follow which.
struct Nodes {
    all: Vec<(ZoneId, u32)>,
    next: Vec<Vec<usize>>,
    /// Length of each, with the link behind it, m.
    length_m: Vec<f64>,
}

impl Nodes {
    fn of(network: &Network) -> Nodes {
        let mut first = Vec::with_capacity(network.zones.len());
        let mut all = Vec::new();
        for (zone, shape) in (0..).zip(&network.zones) {
            first.push(all.len());
            all.extend((0..shape.paths.len() as u32).map(|path| (zone, path)));
        }
        let mut next = Vec::with_capacity(all.len());
        let mut length_m = Vec::with_capacity(all.len());
        for &(zone, path) in &all {
            let shape = &network.zones[zone as usize];
            let to = shape.exit_of(path).to;
            length_m.push(shape.paths[path as usize].length_m + to.map_or(0.0, |to| to.link_m));
            next.push(to.map_or_else(Vec::new, |to| {
                let there = &network.zones[to.zone as usize];
                there.paths_from(to.segment).map(|path| first[to.zone as usize] + path as usize).collect()
            }));
        }
        Nodes { all, next, length_m }
    }

    /// Strongly connected sets of paths that hold a circle (Tarjan's algorithm, without recursion).
    fn components(&self) -> Vec<Vec<usize>> {
        let count = self.all.len();
        let (mut index, mut low) = (vec![usize::MAX; count], vec![0; count]);
        let (mut on_stack, mut stack, mut found) = (vec![false; count], Vec::new(), Vec::new());
        let mut counter = 0;
        for root in 0..count {
            if index[root] != usize::MAX {
                continue;
            }
            let mut work = vec![(root, 0)];
            while let Some(&mut (node, ref mut at)) = work.last_mut() {
                if *at == 0 {
                    (index[node], low[node]) = (counter, counter);
                    counter += 1;
                    stack.push(node);
                    on_stack[node] = true;
                }
                if let Some(&next) = self.next[node].get(*at) {
                    *at += 1;
                    if index[next] == usize::MAX {
                        work.push((next, 0));
                    } else if on_stack[next] {
                        low[node] = low[node].min(index[next]);
                    }
                    continue;
                }
                work.pop();
                if let Some(&(before, _)) = work.last() {
                    low[before] = low[before].min(low[node]);
                }
                if low[node] == index[node] {
                    let at = stack.iter().rposition(|&n| n == node).expect("the node is on the stack");
                    let members = stack.split_off(at);
                    members.iter().for_each(|&n| on_stack[n] = false);
                    if members.len() > 1 || self.next[node].contains(&node) {
                        found.push(members);
                    }
                }
            }
        }
        found
    }

    /// Length of the shortest circle within a set of paths, m (Dijkstra from each).
    fn shortest_circle_m(&self, members: &[usize]) -> f64 {
        let mut is_member = vec![false; self.all.len()];
        members.iter().for_each(|&node| is_member[node] = true);
        let mut best_m = f64::INFINITY;
        for &start in members {
            let mut distance = vec![f64::INFINITY; self.all.len()];
            let mut open = BinaryHeap::from([Reverse((0u64, start))]);
            let mut begun = false;
            while let Some(Reverse((bits, node))) = open.pop() {
                // Distances are >= 0, so their bits are in the order of their values.
                let so_far_m = f64::from_bits(bits);
                if (begun && node == start) || so_far_m >= best_m {
                    best_m = best_m.min(so_far_m);
                    break;
                }
                begun = true;
                for &next in self.next[node].iter().filter(|&&next| is_member[next]) {
                    let to_m = so_far_m + self.length_m[node];
                    if to_m < distance[next] {
                        distance[next] = to_m;
                        open.push(Reverse((to_m.to_bits(), next)));
                    }
                }
            }
        }
        best_m
    }

    /// The paths before each.
    fn before(&self) -> Vec<Vec<usize>> {
        let mut before: Vec<Vec<usize>> = vec![Vec::new(); self.all.len()];
        for (node, next) in self.next.iter().enumerate() {
            next.iter().for_each(|&next| before[next].push(node));
        }
        before
    }

    /// Marks the paths of a circle, and all that lead into it. Circles are marked in ascending order.
    fn mark(&self, circle: u32, members: Vec<usize>, before: &[Vec<usize>], ahead: &mut [Vec<u32>]) {
        let mut work = members;
        while let Some(node) = work.pop() {
            if ahead[node].last() != Some(&circle) {
                ahead[node].push(circle);
                work.extend(&before[node]);
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::load_embedded;

    #[test]
    fn circles_of_the_embedded_networks() {
        let circles = |name| Circles::of(&load_embedded(name, &[], None).unwrap());
        for name in ["two-merges", "tree", "intersection", "lane-drop"] {
            assert_eq!(circles(name), Circles::default(), "{name}");
        }
        let ring = circles("roundabout");
        // 180 m round, standing 6 + 5 m apart.
        assert_eq!(ring.capacity, [15]);
        for zone in 0..3 {
            // Stay, leave, enter.
            let ahead: Vec<&[u32]> = (0..3).map(|path| ring.ahead_of(zone, path)).collect();
            assert_eq!(ahead, [&[0][..], &[], &[0]]);
        }
        assert_eq!(circles("grid-3x3").capacity.len(), 1);
    }

    #[test]
    fn circles_side_by_side_do_not_concern_each_other() {
        use crate::bench::{Family, side_by_side};
        let scenario = side_by_side(Family::Grids, 1_500, 60.0).unwrap();
        let circles = Circles::of(&scenario);
        let count = scenario.network.zones.len() / 9;
        assert!(count > 33, "{count}");
        assert_eq!(circles.capacity, vec![circles.capacity[0]; count]);
        for (zone, shape) in (0..).zip(&scenario.network.zones) {
            for path in 0..shape.paths.len() as u32 {
                let ahead = circles.ahead_of(zone, path);
                assert!(ahead.is_empty() || ahead == [zone / 9], "{zone} {path} {ahead:?}");
            }
        }
    }
}
