//! A rigorous bound that knows of merging, whatever the passing order.
//!
//! Vehicles are left alone but for disjoint pairs, and `triples`, of vehicles that pass one merge: one passes it after the
//! other, and then finds it at least `phi v + delta` further. A pair costs at least the lesser of its two orders, where both
//! came by the same lanes that in which they came, and an order at least as much as its Lagrangian dual for any multiplier
//! `mu >= 0` of `t_second(merge) >= t_first(merge + phi v + delta)`: with the second's speed `v` at the merge given, that
//! is one vehicle whose time up to the merge is cheaper by `mu` and one whose time up to the further place is dearer by
//! it, each alone and convex ([`super::alone`]). The second's cost is convex in `v^2`, the first's grows with `v`: cells
//! of `v` are bounded from below by the ends of the one and the lower end of the other, and split until they are small.
//! What is left out (other vehicles, other places, limits) can only cost.

mod triples;

use super::alone::{End, Leg, Optimum, optimum};
use super::traffic::{Entrant, Traffic, is_merge};

/// Cells of speed are split down to this width, m/s.
const CELL_MPS: f64 = 0.06;
/// Slowest speed at a merge that is looked at by itself, m/s; slower ones are bounded by it.
const SLOWEST_MPS: f64 = 1.0;
/// Evaluations of the dual in the search for its best multiplier.
const TRIES: usize = 9;

/// What the bound rests on.
#[derive(Clone, Debug, PartialEq)]
pub struct Merging {
    /// Of the sum of the zones' mean costs, m^2/s^3.
    pub total: f64,
    /// Pairs and triples that it is made of.
    pub groups: usize,
}

/// One vehicle with the merge it is looked at.
struct Half<'a> {
    entrant: &'a Entrant,
    /// Length and weight of the legs up to the merge, and behind it.
    before: Vec<(f64, f64)>,
    after: Vec<(f64, f64)>,
    alone: Optimum,
}

/// What does not depend on the pair.
struct Setting {
    beta: f64,
    reaction_s: f64,
    gap_m: f64,
    v_max_mps: f64,
    /// By how much a vehicle may be faster than when it left: the rest of a step.
    slip_mps: f64,
}

/// The bound; `None` where the network has anything but merges without links, or several kinds of vehicles.
pub fn bound(traffic: &Traffic<'_>) -> Option<Merging> {
    let scenario = traffic.scenario;
    if !scenario.network.zones.iter().all(is_merge) || scenario.fleet.len() != 1 {
        return None;
    }
    let vehicle = &scenario.vehicle;
    let setting = Setting {
        beta: scenario.beta,
        reaction_s: vehicle.reaction_time_s,
        gap_m: vehicle.standstill_gap_m,
        v_max_mps: vehicle.v_max_mps,
        slip_mps: vehicle.u_max_mps2 * scenario.dt_s(),
    };
    let shares = traffic.shares();
    let mut groups = Vec::new();
    for zone in 0..scenario.network.zones.len() as u32 {
        let mut halves: Vec<(f64, Half<'_>)> = Vec::new();
        for entrant in traffic.entrants {
            let Some(at) = entrant.way.iter().position(|(z, _)| *z == zone) else { continue };
            let half = Half::new(traffic, &shares, entrant, at, &setting);
            let passes_s = entrant.arrival_s + half.alone.durations_s[..=at].iter().sum::<f64>();
            halves.push((passes_s, half));
        }
        halves.sort_by(|a, b| a.0.total_cmp(&b.0));
        groups.extend(setting.groups(&halves));
    }
    // Any choice of disjoint groups will do: those of the most per vehicle first.
    let per_vehicle = |group: &Group| group.gain / group.vehicles.len() as f64;
    groups.sort_by(|a, b| per_vehicle(b).total_cmp(&per_vehicle(a)));
    let mut taken = std::collections::BTreeSet::new();
    let mut merging = Merging { total: traffic.alone().total, groups: 0 };
    for Group { gain, vehicles } in groups {
        if vehicles.iter().all(|vehicle| !taken.contains(vehicle)) {
            taken.extend(vehicles);
            merging.total += gain;
            merging.groups += 1;
        }
    }
    Some(merging)
}

/// Vehicles that cost more together than each alone.
struct Group {
    gain: f64,
    vehicles: Vec<u32>,
}

impl Half<'_> {
    fn new<'a>(
        traffic: &Traffic<'_>,
        shares: &[f64],
        entrant: &'a Entrant,
        at: usize,
        setting: &Setting,
    ) -> Half<'a> {
        let legs: Vec<(f64, f64)> = entrant
            .way
            .iter()
            .map(|&(zone, path)| {
                let shape = &traffic.scenario.network.zones[zone as usize];
                (shape.paths[path as usize].length_m, shares[zone as usize])
            })
            .collect();
        let priced: Vec<Leg> = legs.iter().map(|&(l, w)| Leg::new(l, w, setting.beta)).collect();
        let alone = optimum(entrant.speed_mps, &priced, End::Free).expect("a free end can be had");
        Half { entrant, before: legs[..=at].to_vec(), after: legs[at + 1..].to_vec(), alone }
    }

    fn vehicle(&self) -> u32 {
        self.entrant.vehicle
    }

    /// The greatest multiplier with which time up to the merge is no gain.
    fn most(&self, setting: &Setting) -> f64 {
        self.before.iter().map(|(_, weight)| weight * setting.beta).fold(f64::INFINITY, f64::min)
    }

    /// Whether both have been on the same lanes all the way, so that nobody can have passed the other.
    fn has_come_the_way_of(&self, other: &Half<'_>) -> bool {
        self.entrant.way[..self.before.len()] == other.entrant.way[..other.before.len()]
    }
}

impl Setting {
    /// The groups at a merge, of vehicles sorted by when they would pass it alone.
    fn groups(&self, halves: &[(f64, Half<'_>)]) -> Vec<Group> {
        let mut groups = Vec::new();
        for (at, (passes_s, own)) in halves.iter().enumerate() {
            // Further apart than any distance asked for takes at the speeds of vehicles alone.
            let reach_s = 2.0 * self.reaction_s + 0.2 * self.gap_m;
            let near = halves[at + 1..].iter().take_while(|(then_s, _)| then_s - passes_s <= reach_s);
            for (next, (_, other)) in near.enumerate() {
                let pair = gain(&[own, other], |order, _| self.order(order[0], order[1]));
                if pair <= 0.0 {
                    continue;
                }
                groups.push(Group { gain: pair, vehicles: vec![own.vehicle(), other.vehicle()] });
                if let (0, Some((third_s, third))) = (next, halves.get(at + 2))
                    && third_s - passes_s <= reach_s
                {
                    let of_three = [own, other, third];
                    let gain = gain(&of_three, |order, enough| self.order_of_three(order, enough));
                    groups.push(Group { gain, vehicles: of_three.map(Half::vehicle).to_vec() });
                }
            }
        }
        groups
    }

    /// At least what a pair costs in the order given.
    fn order(&self, first: &Half<'_>, second: &Half<'_>) -> f64 {
        let least = first.alone.cost + second.alone.cost;
        let (_, most) = greatest((0.0, second.most(self)), TRIES, |mu| self.dual(first, second, mu));
        least.max(most)
    }

    /// The dual, or less.
    fn dual(&self, first: &Half<'_>, second: &Half<'_>, mu: f64) -> f64 {
        let offset = mu * (second.entrant.arrival_s - first.entrant.arrival_s);
        let free = self.second(second, mu, None);
        let preferred_mps = free.exits_mps[second.before.len() - 1];
        let cost = |speed_mps: f64| self.second(second, mu, Some(speed_mps)).cost;
        // Cells with the second's cost at either end, and a bound of everything.
        struct Cell {
            ends: (f64, f64),
            costs: (f64, f64),
            least: f64,
        }
        let cell = |ends: (f64, f64), costs: (f64, f64)| {
            let holds = ends.0 <= preferred_mps && preferred_mps <= ends.1;
            let second = if holds { free.cost } else { costs.0.min(costs.1) };
            Cell { ends, costs, least: second + self.first(first, mu, ends.0) - offset }
        };
        let (slow, fast) = (SLOWEST_MPS.min(preferred_mps), self.v_max_mps.max(preferred_mps));
        // Slower than the slowest looked at: dearer for the second than that, as it prefers to be faster.
        let below = cost(slow) + self.first(first, mu, 0.0) - offset;
        let mut cells = vec![cell((slow, fast), (cost(slow), cost(fast)))];
        loop {
            let at = (0..cells.len())
                .min_by(|a, b| cells[*a].least.total_cmp(&cells[*b].least))
                .expect("there is a cell");
            let Cell { ends, costs, least } = cells[at];
            if ends.1 - ends.0 < CELL_MPS || least >= below {
                return least.min(below);
            }
            let middle_mps = 0.5 * (ends.0 + ends.1);
            let middle = cost(middle_mps);
            cells[at] = cell((ends.0, middle_mps), (costs.0, middle));
            cells.push(cell((middle_mps, ends.1), (middle, costs.1)));
        }
    }

    /// The one that passes second, its time up to the merge cheaper by `mu`, at a speed there or at any.
    fn second(&self, half: &Half<'_>, mu: f64, speed_mps: Option<f64>) -> Optimum {
        let before = half.before.iter().map(|&(length_m, weight)| Leg {
            length_m,
            weight,
            price: (weight * self.beta - mu).max(0.0),
        });
        let after: Vec<Leg> = half.after.iter().map(|&(l, w)| Leg::new(l, w, self.beta)).collect();
        let entry_mps = half.entrant.speed_mps;
        let Some(speed_mps) = speed_mps else {
            let all: Vec<Leg> = before.chain(after).collect();
            return optimum(entry_mps, &all, End::Free).expect("a free end can be had");
        };
        let before: Vec<Leg> = before.collect();
        let mut found = optimum(entry_mps, &before, End::Speed(speed_mps)).unwrap_or(Optimum {
            cost: f64::INFINITY,
            durations_s: Vec::new(),
            exits_mps: Vec::new(),
        });
        if !after.is_empty() {
            found.cost += optimum(speed_mps, &after, End::Free).expect("a free end can be had").cost;
        }
        found
    }

    /// Cost of the one that passes first, its time up to the place that it must have reached dearer by `mu`.
    fn first(&self, half: &Half<'_>, mu: f64, speed_mps: f64) -> f64 {
        let dearer =
            |&(length_m, weight): &(f64, f64)| Leg { length_m, weight, price: weight * self.beta + mu };
        let mut legs: Vec<Leg> = half.before.iter().map(dearer).collect();
        let end = self.behind(half, mu, speed_mps, &mut legs);
        optimum(half.entrant.speed_mps, &legs, end).map_or(f64::NEG_INFINITY, |found| found.cost)
    }

    /// Adds the legs behind the merge, with time dearer by `mu` up to where one who passes the merge after it, at that
    /// speed, must find it.
    fn behind(&self, half: &Half<'_>, mu: f64, speed_mps: f64, legs: &mut Vec<Leg>) -> End {
        let mut further_m = self.reaction_s * speed_mps + self.gap_m;
        for &(length_m, weight) in &half.after {
            let part_m = further_m.min(length_m);
            if part_m > 0.0 {
                legs.push(Leg { length_m: part_m, weight, price: weight * self.beta + mu });
            }
            if length_m > part_m {
                legs.push(Leg::new(length_m - part_m, weight, self.beta));
            }
            further_m -= part_m;
        }
        // Behind the network a vehicle keeps the speed it left with.
        match further_m > 0.0 {
            true => End::Coasting { length_m: further_m, faster_mps: self.slip_mps, price: mu },
            false => End::Free,
        }
    }
}

/// By how much these cost more together than each alone, at least: `order` bounds what they cost in one order, and need not
/// seek more than what is enough.
fn gain<'h, const N: usize>(
    halves: &[&'h Half<'h>; N],
    mut order: impl FnMut([&'h Half<'h>; N], f64) -> f64,
) -> f64 {
    let alone: f64 = halves.iter().map(|half| half.alone.cost).sum();
    let mut least = f64::INFINITY;
    let mut each = |places: [usize; N]| {
        let order_of = places.map(|place| halves[place]);
        // Who came behind another on the same lanes passes behind it.
        let overtakes = (0..N).any(|i| {
            (i + 1..N).any(|j| {
                let (before, after) = (order_of[i], order_of[j]);
                before.entrant.arrival_s > after.entrant.arrival_s && before.has_come_the_way_of(after)
            })
        });
        if !overtakes && least > alone {
            least = least.min(order(order_of, least));
        }
    };
    permutations(&mut std::array::from_fn(|place| place), 0, &mut each);
    least - alone
}

/// All orders, the given one first.
fn permutations<const N: usize>(places: &mut [usize; N], from: usize, each: &mut impl FnMut([usize; N])) {
    if from == N {
        return each(*places);
    }
    for at in from..N {
        places.swap(from, at);
        permutations(places, from + 1, each);
        places.swap(from, at);
    }
}

/// Where a concave function is greatest, nearly, and how great: golden section.
fn greatest((mut low, mut high): (f64, f64), tries: usize, mut value: impl FnMut(f64) -> f64) -> (f64, f64) {
    let ratio = 0.5 * (5f64.sqrt() - 1.0);
    let (mut a, mut b) = (high - ratio * (high - low), low + ratio * (high - low));
    let (mut at_a, mut at_b) = (value(a), value(b));
    let mut best = if at_a > at_b { (a, at_a) } else { (b, at_b) };
    for _ in 0..tries {
        let new = if at_a > at_b {
            (high, b, at_b) = (b, a, at_a);
            a = high - ratio * (high - low);
            at_a = value(a);
            (a, at_a)
        } else {
            (low, a, at_a) = (a, b, at_b);
            b = low + ratio * (high - low);
            at_b = value(b);
            (b, at_b)
        };
        if new.1 > best.1 {
            best = new;
        }
    }
    best
}
