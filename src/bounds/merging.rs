//! A rigorous bound that knows of merging, whatever the passing order.
//!
//! Vehicles are left alone but for disjoint pairs, of two that pass one merge: one passes it after the other, and then
//! finds it at least `phi v + delta` further. A pair costs at least the lesser of its two orders, where both came by
//! the same lanes that in which they came, and an order at least as much as its Lagrangian dual for any multiplier `mu >= 0` of
//! `t_second(merge) >= t_first(merge + phi v + delta)`: with the second's speed `v` at the merge given, that is one
//! vehicle whose time up to the merge is cheaper by `mu` and one whose time up to the further place is dearer by it,
//! each alone and convex ([`super::alone`]). The second's cost is convex in `v^2`, the first's grows with `v`: cells
//! of `v` are bounded from below by the ends of the one and the lower end of the other, and split until they are small.
//! What is left out (other vehicles, other places, limits) can only cost.

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
    /// Pairs that it is made of.
    pub pairs: usize,
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
    let mut gains: Vec<(f64, u32, u32)> = Vec::new();
    for zone in 0..scenario.network.zones.len() as u32 {
        let mut halves: Vec<(f64, Half<'_>)> = Vec::new();
        for entrant in traffic.entrants {
            let Some(at) = entrant.way.iter().position(|(z, _)| *z == zone) else { continue };
            let half = Half::new(traffic, &shares, entrant, at, &setting);
            let passes_s = entrant.arrival_s + half.alone.durations_s[..=at].iter().sum::<f64>();
            halves.push((passes_s, half));
        }
        halves.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (at, (passes_s, own)) in halves.iter().enumerate() {
            for (then_s, other) in &halves[at + 1..] {
                // Further apart than any distance asked for takes at the speeds of vehicles alone.
                if then_s - passes_s > 2.0 * setting.reaction_s + 0.2 * setting.gap_m {
                    break;
                }
                let is_behind = own.has_come_the_way_of(other);
                let least = match own.entrant.arrival_s < other.entrant.arrival_s {
                    true if is_behind => setting.order(own, other),
                    false if is_behind => setting.order(other, own),
                    _ => setting.order(own, other).min(setting.order(other, own)),
                };
                let gain = least - own.alone.cost - other.alone.cost;
                if gain > 0.0 {
                    gains.push((gain, own.entrant.vehicle, other.entrant.vehicle));
                }
            }
        }
    }
    // Any choice of disjoint pairs will do: the dearest first.
    gains.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut taken = std::collections::BTreeSet::new();
    let mut merging = Merging { total: traffic.alone().total, pairs: 0 };
    for (gain, a, b) in gains {
        if !taken.contains(&a) && !taken.contains(&b) {
            taken.extend([a, b]);
            merging.total += gain;
            merging.pairs += 1;
        }
    }
    Some(merging)
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

    /// Whether both have been on the same lanes all the way, so that nobody can have passed the other.
    fn has_come_the_way_of(&self, other: &Half<'_>) -> bool {
        self.entrant.way[..self.before.len()] == other.entrant.way[..other.before.len()]
    }
}

impl Setting {
    /// At least what a pair costs in the order given.
    fn order(&self, first: &Half<'_>, second: &Half<'_>) -> f64 {
        let least = first.alone.cost + second.alone.cost;
        // Time up to the merge must not become a gain.
        let most = second.before.iter().map(|(_, weight)| weight * self.beta).fold(f64::INFINITY, f64::min);
        // The dual is concave in its multiplier: golden section.
        let ratio = 0.5 * (5f64.sqrt() - 1.0);
        let (mut low, mut high) = (0.0, most);
        let dual = |mu: f64| self.dual(first, second, mu);
        let (mut a, mut b) = (high - ratio * (high - low), low + ratio * (high - low));
        let (mut at_a, mut at_b) = (dual(a), dual(b));
        let mut best = least.max(at_a).max(at_b);
        for _ in 0..TRIES {
            if at_a > at_b {
                (high, b, at_b) = (b, a, at_a);
                a = high - ratio * (high - low);
                at_a = dual(a);
            } else {
                (low, a, at_a) = (a, b, at_b);
                b = low + ratio * (high - low);
                at_b = dual(b);
            }
            best = best.max(at_a).max(at_b);
        }
        best
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
        let mut further_m = self.reaction_s * speed_mps + self.gap_m;
        let mut legs: Vec<Leg> = Vec::new();
        let dearer = |length_m: f64, weight: f64| Leg { length_m, weight, price: weight * self.beta + mu };
        legs.extend(half.before.iter().map(|&(length_m, weight)| dearer(length_m, weight)));
        for &(length_m, weight) in &half.after {
            let part_m = further_m.min(length_m);
            if part_m > 0.0 {
                legs.push(dearer(part_m, weight));
            }
            if length_m > part_m {
                legs.push(Leg::new(length_m - part_m, weight, self.beta));
            }
            further_m -= part_m;
        }
        // Behind the network a vehicle keeps the speed it left with.
        let end = match further_m > 0.0 {
            true => End::Coasting { length_m: further_m, faster_mps: self.slip_mps, price: mu },
            false => End::Free,
        };
        optimum(half.entrant.speed_mps, &legs, end).map_or(f64::NEG_INFINITY, |found| found.cost)
    }
}
