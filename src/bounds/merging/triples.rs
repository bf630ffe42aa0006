//! Three vehicles that pass a merge one after another.
//!
//! As with [pairs](super), with a multiplier for each of the two distances. The one in the middle is the second of one pair
//! and the first of the other: its time up to the merge is cheaper by the one multiplier and dearer by the other, and dearer
//! by the latter up to where the last must find it. With the speeds at the merge of the second and the last given, the
//! three are alone. The second's cost is convex in the square of its own speed there and grows with the last one's,
//! so cells of both speeds are bounded from below like those of one.

use super::super::alone::{End, Leg, optimum};
use super::{Half, Setting, greatest};

/// Cells of speeds are split down to this width, m/s.
const CELL_MPS: f64 = 0.12;
/// Evaluations along one line in the search for the best multipliers.
const TRIES: usize = 5;
/// A search along a line reaches so far to either side, as a share of the greatest multiplier, after the first.
const REACH: f64 = 0.25;

/// Second and last at the merge: bounds of their speeds, m/s, and what all three cost at least.
#[derive(Clone, Copy)]
struct Cell {
    second: (f64, f64),
    last: (f64, f64),
    least: f64,
}

impl Setting {
    /// At least what three cost in the order given; no more than `enough` is sought.
    pub(super) fn order_of_three(&self, order: [&Half<'_>; 3], enough: f64) -> f64 {
        let alone: f64 = order.iter().map(|half| half.alone.cost).sum();
        let most = order[1].most(self).min(order[2].most(self));
        let dual =
            |first: f64, last: f64| self.dual_of_three(order, first.clamp(0.0, most), last.clamp(0.0, most));
        let (both, mut best) = greatest((0.0, most), TRIES, |mu| dual(mu, mu));
        let (mut first, mut last) = (both, both);
        // Concave in both: along one and the other.
        for reach in [REACH, REACH / 3.0] {
            if best >= enough {
                break;
            }
            let around = |mu: f64| ((mu - reach * most).max(0.0), (mu + reach * most).min(most));
            let (mu, found) = greatest(around(first), TRIES, |mu| dual(mu, last));
            if found > best {
                (first, best) = (mu, found);
            }
            let (mu, found) = greatest(around(last), TRIES, |mu| dual(first, mu));
            if found > best {
                (last, best) = (mu, found);
            }
        }
        best.max(alone)
    }

    /// The dual, or less.
    fn dual_of_three(&self, [first, second, last]: [&Half<'_>; 3], mu_first: f64, mu_last: f64) -> f64 {
        let arrival_s = |half: &Half<'_>| half.entrant.arrival_s;
        let offset = mu_first * (arrival_s(second) - arrival_s(first))
            + mu_last * (arrival_s(last) - arrival_s(second));
        let mus = (mu_first, mu_last);
        let free = self.second(last, mu_last, None);
        let preferred_mps = free.exits_mps[last.before.len() - 1];
        let of_last = |bounds: (f64, f64)| match nearest(preferred_mps, bounds) {
            None => free.cost,
            Some(speed_mps) => self.second(last, mu_last, Some(speed_mps)).cost,
        };
        let of_second = |bounds: (f64, f64), last_mps: f64| {
            let (cost, preferred_mps) = self.middle(second, mus, None, last_mps);
            match nearest(preferred_mps, bounds) {
                None => cost,
                Some(speed_mps) => self.middle(second, mus, Some(speed_mps), last_mps).0,
            }
        };
        let cell = |second: (f64, f64), last: (f64, f64)| {
            let ahead = self.first(first, mu_first, second.0);
            Cell { second, last, least: ahead + of_second(second, last.0) + of_last(last) - offset }
        };
        let (_, fastest_mps) = self.middle(second, mus, None, 0.0);
        let whole = |preferred_mps: f64| (0.0, self.v_max_mps.max(preferred_mps));
        let mut cells = vec![cell(whole(fastest_mps), whole(preferred_mps))];
        loop {
            let at = (0..cells.len())
                .min_by(|a, b| cells[*a].least.total_cmp(&cells[*b].least))
                .expect("there is a cell");
            let Cell { second, last, least } = cells[at];
            let widths = (second.1 - second.0, last.1 - last.0);
            if widths.0.max(widths.1) < CELL_MPS {
                return least;
            }
            let (lower, upper) = if widths.0 > widths.1 {
                let middle = 0.5 * (second.0 + second.1);
                (cell((second.0, middle), last), cell((middle, second.1), last))
            } else {
                let middle = 0.5 * (last.0 + last.1);
                (cell(second, (last.0, middle)), cell(second, (middle, last.1)))
            };
            cells[at] = lower;
            cells.push(upper);
        }
    }

    /// The one in the middle at a speed at the merge or at any, the last passing it at `last_mps`: cost, and that speed.
    fn middle(
        &self,
        half: &Half<'_>,
        (mu_first, mu_last): (f64, f64),
        speed_mps: Option<f64>,
        last_mps: f64,
    ) -> (f64, f64) {
        let before = half.before.iter().map(|&(length_m, weight)| Leg {
            length_m,
            weight,
            price: (weight * self.beta - mu_first + mu_last).max(0.0),
        });
        let mut legs: Vec<Leg> = before.collect();
        let (entry_mps, before) = (half.entrant.speed_mps, legs.len());
        let Some(speed_mps) = speed_mps else {
            let end = self.behind(half, mu_last, last_mps, &mut legs);
            let found = optimum(entry_mps, &legs, end);
            return found.map_or((f64::NEG_INFINITY, 0.0), |found| (found.cost, found.exits_mps[before - 1]));
        };
        let Some(reached) = optimum(entry_mps, &legs, End::Speed(speed_mps)) else {
            return (f64::INFINITY, speed_mps);
        };
        legs.clear();
        let end = self.behind(half, mu_last, last_mps, &mut legs);
        let rest = match end {
            // The network ends at the merge.
            End::Coasting { length_m, faster_mps, price } if legs.is_empty() => {
                price * length_m / (speed_mps + faster_mps)
            }
            _ if legs.is_empty() => 0.0,
            _ => optimum(speed_mps, &legs, end).map_or(f64::NEG_INFINITY, |found| found.cost),
        };
        (reached.cost + rest, speed_mps)
    }
}

/// The bound that is nearest to a speed, if it is not between them.
fn nearest(speed_mps: f64, (slow_mps, fast_mps): (f64, f64)) -> Option<f64> {
    let within = speed_mps.clamp(slow_mps, fast_mps);
    (within != speed_mps).then_some(within)
}
