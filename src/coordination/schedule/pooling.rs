//! Least total cost of instants that keep headways: `min sum of J_i(T_i)` subject to `T_i >= T_j + h_ij`.
//!
//! Vehicles whose headways bind are pooled into blocks that move as one. Where the headways form a chain, this is
//! isotonic regression by pool adjacent violators, after substituting `s_i = T_i - sum of h`; it is exact for convex
//! J_i. Where they do not (several conflict points), blocks are trees of binding headways, which are split again where
//! a multiplier is negative: the active-set method for separation constraints of Dwyer, Marriott and Stuckey ("Fast node
//! overlap removal", 2005), here for any convex J_i.

use super::cost::Convex;

/// `T_after >= T_before + headway`; vehicles by index in the passing order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Headway {
    /// Who passes first.
    pub before: u32,
    /// Who passes later: a greater index.
    pub after: u32,
    /// Time between the two, s; may be negative where their ways to the end differ in length.
    pub headway_s: f64,
}

/// Violations below this do not count, s.
const TOLERANCE_S: f64 = 1e-11;
/// Multipliers above this count as zero.
const TOLERANCE_SLOPE: f64 = 1e-9;

/// Solves such programs; kept from use to use for its allocations.
#[derive(Clone, Debug, Default)]
pub struct Pooling {
    /// Block of each vehicle.
    block: Vec<u32>,
    /// Its instant relative to that of its block, s.
    offset_s: Vec<f64>,
    /// Instant of each block, s.
    at_s: Vec<f64>,
    /// Whether a headway holds its block together.
    is_active: Vec<bool>,
    slopes: Vec<f64>,
    side: Vec<bool>,
    stack: Vec<u32>,
}

/// A program.
struct Program<'a, C> {
    costs: &'a [C],
    earliest_s: &'a [f64],
    headways: &'a [Headway],
}

impl Pooling {
    /// Writes the best instants to `times_s`. `alone_s` are the [best instants](best_s) of each alone. Nobody is earlier
    /// than its `earliest_s`. `headways` are sorted by `after`.
    pub fn minimise<C: Convex>(
        &mut self,
        costs: &[C],
        alone_s: &[f64],
        earliest_s: &[f64],
        headways: &[Headway],
        times_s: &mut Vec<f64>,
    ) {
        let program = Program { costs, earliest_s, headways };
        let count = costs.len();
        self.block.clear();
        self.block.extend(0..count as u32);
        self.offset_s.clear();
        self.offset_s.resize(count, 0.0);
        self.at_s.clear();
        self.is_active.clear();
        self.is_active.resize(headways.len(), false);
        let mut ready = 0;
        for (i, alone_s) in alone_s.iter().enumerate() {
            self.at_s.push(alone_s.max(earliest_s[i]));
            ready += headways[ready..].iter().take_while(|h| h.after as usize == i).count();
            self.merge(&program, ready, i as u32, Side::Before);
        }
        if !is_chain(headways) {
            self.split_where_it_pays(&program);
        }
        times_s.clear();
        times_s.extend((0..count).map(|i| self.time_s(i)));
        // Rounding, and what the bound on splits may have left.
        for h in headways {
            let least = times_s[h.before as usize] + h.headway_s;
            let time = &mut times_s[h.after as usize];
            *time = time.max(least);
        }
    }

    fn time_s(&self, vehicle: usize) -> f64 {
        self.at_s[self.block[vehicle] as usize] + self.offset_s[vehicle]
    }

    fn members(&self, block: u32) -> impl Iterator<Item = usize> + '_ {
        self.block.iter().enumerate().filter(move |(_, b)| **b == block).map(|(vehicle, _)| vehicle)
    }

    /// Pools a block with those whose headways it violates: toward vehicles before its own, or after them. Only the
    /// first headways count.
    fn merge<C: Convex>(&mut self, program: &Program<'_, C>, count: usize, block: u32, side: Side) {
        let mut block = block;
        loop {
            let mut worst: Option<(usize, f64)> = None;
            for (at, h) in program.headways[..count].iter().enumerate() {
                let (before, after) = (h.before as usize, h.after as usize);
                let (own, other) = match side {
                    Side::Before => (self.block[after], self.block[before]),
                    Side::After => (self.block[before], self.block[after]),
                };
                if own != block || other == block {
                    continue;
                }
                let lack_s = self.time_s(before) + h.headway_s - self.time_s(after);
                if lack_s > TOLERANCE_S && worst.is_none_or(|(_, most)| lack_s > most) {
                    worst = Some((at, lack_s));
                }
            }
            let Some((at, _)) = worst else { return };
            block = self.join(program, at);
        }
    }

    /// Makes one block of the two that a headway ties together; the block of who passes first remains.
    fn join<C: Convex>(&mut self, program: &Program<'_, C>, at: usize) -> u32 {
        let Headway { before, after, headway_s } = program.headways[at];
        let (first, second) = (self.block[before as usize], self.block[after as usize]);
        let shift_s = self.offset_s[before as usize] + headway_s - self.offset_s[after as usize];
        for (block, offset_s) in self.block.iter_mut().zip(&mut self.offset_s) {
            if *block == second {
                *block = first;
                *offset_s += shift_s;
            }
        }
        self.is_active[at] = true;
        // The best instant of the whole lies between those of its parts.
        let (a, b) = (self.at_s[first as usize], self.at_s[second as usize] - shift_s);
        self.place(program, first, a.min(b), a.max(b));
        first
    }

    /// Moves a block to its best instant, which is within the bracket.
    fn place<C: Convex>(&mut self, program: &Program<'_, C>, block: u32, from: f64, to: f64) {
        let slope =
            |at: f64| self.members(block).map(|i| program.costs[i].slope(at + self.offset_s[i])).sum::<f64>();
        let best = root(slope, from, to);
        self.at_s[block as usize] = best.max(self.earliest(program, block).0);
    }

    /// The earliest instant of a block, and the vehicle it is due to.
    fn earliest<C>(&self, program: &Program<'_, C>, block: u32) -> (f64, usize) {
        let own = self.members(block).map(|i| (program.earliest_s[i] - self.offset_s[i], i));
        own.fold((f64::NEG_INFINITY, usize::MAX), |most, each| if each.0 > most.0 { each } else { most })
    }

    /// Splits blocks at headways that hold vehicles together which would rather be apart, until there are none.
    fn split_where_it_pays<C: Convex>(&mut self, program: &Program<'_, C>) {
        // Each split lowers the cost, so this ends by itself; the bound is for rounding.
        for _ in 0..4 * program.costs.len() {
            let Some((at, block)) = self.least_wanted(program) else { return };
            self.is_active[at] = false;
            let (before, after) = (program.headways[at].before, program.headways[at].after);
            self.mark(program, before);
            // An index no block has: that of a vehicle that is not the name of one.
            let names = |name: &u32| !self.block.contains(name);
            let new = (0..self.block.len() as u32).find(names).expect("a block of two left a name unused");
            debug_assert!(!self.side[after as usize]);
            let kept = self.at_s[block as usize];
            for (own, is_before) in self.block.iter_mut().zip(&self.side) {
                if *own == block && !*is_before {
                    *own = new;
                }
            }
            self.at_s[new as usize] = kept;
            for part in [block, new] {
                let least = self.members(part).map(|i| self.offset_s[i]).fold(f64::INFINITY, f64::min);
                let mut to = kept + 1.0;
                let slope = |at: f64| {
                    self.members(part).map(|i| program.costs[i].slope(at + self.offset_s[i])).sum::<f64>()
                };
                for _ in 0..20 {
                    if slope(to) >= 0.0 {
                        break;
                    }
                    to += 2.0 * (to - kept);
                }
                self.place(program, part, -least, to);
            }
            let all = program.headways.len();
            self.merge(program, all, block, Side::Before);
            let block = self.block[after as usize];
            self.merge(program, all, block, Side::After);
            // The second may have been pushed on, and with it whom it has joined.
            let block = self.block[after as usize];
            self.merge(program, all, block, Side::Before);
        }
    }

    /// The active headway with the most negative multiplier, and its block.
    fn least_wanted<C: Convex>(&mut self, program: &Program<'_, C>) -> Option<(usize, u32)> {
        self.slopes.clear();
        for i in 0..program.costs.len() {
            self.slopes.push(program.costs[i].slope(self.time_s(i)));
        }
        let mut least: Option<(usize, f64)> = None;
        for at in 0..program.headways.len() {
            if !self.is_active[at] {
                continue;
            }
            let before = program.headways[at].before;
            let block = self.block[before as usize];
            self.is_active[at] = false;
            self.mark(program, before);
            self.is_active[at] = true;
            // What is wrong with the sum of the slopes, whoever may not be earlier bears.
            let (earliest, bearer) = self.earliest(program, block);
            let is_held = self.at_s[block as usize] <= earliest;
            let (mut first, mut second) = (0.0, 0.0);
            for i in self.members(block) {
                *(if self.side[i] { &mut first } else { &mut second }) += self.slopes[i];
            }
            let multiplier = if is_held && self.side[bearer] { second } else { -first };
            if multiplier < -TOLERANCE_SLOPE && least.is_none_or(|(_, most)| multiplier < most) {
                least = Some((at, multiplier));
            }
        }
        least.map(|(at, _)| (at, self.block[program.headways[at].before as usize]))
    }

    /// Marks whom active headways connect with a vehicle.
    fn mark<C>(&mut self, program: &Program<'_, C>, vehicle: u32) {
        self.side.clear();
        self.side.resize(self.block.len(), false);
        self.side[vehicle as usize] = true;
        self.stack.clear();
        self.stack.push(vehicle);
        while let Some(at) = self.stack.pop() {
            for (h, _) in program.headways.iter().zip(&self.is_active).filter(|(_, active)| **active) {
                let other = match (h.before == at, h.after == at) {
                    (true, _) => h.after,
                    (_, true) => h.before,
                    _ => continue,
                };
                if !std::mem::replace(&mut self.side[other as usize], true) {
                    self.stack.push(other);
                }
            }
        }
    }
}

#[derive(Clone, Copy)]
enum Side {
    Before,
    After,
}

/// Whether headways form chains: nobody has two of them toward vehicles before it, nor two after it.
pub fn is_chain(headways: &[Headway]) -> bool {
    headways
        .iter()
        .enumerate()
        .all(|(at, h)| headways[..at].iter().all(|other| other.before != h.before && other.after != h.after))
}

/// Steps of the search for a root; each third one halves the bracket.
const STEPS: u32 = 120;
/// Width at which a bracket counts as closed, relative to where it is.
const CLOSED: f64 = 1e-14;
/// The search ends when it has come to the same place twice, to this share of it, and the root is no further away.
const FOUND: f64 = 1e-12;

/// Where a cost is least.
pub fn best_s(cost: &impl Convex) -> f64 {
    let (from, to) = cost.bracket_s();
    root(|t| cost.slope(t), from, to)
}

/// Where a rising function passes 0 within a bracket; an end of it when it does not.
///
/// Regula falsi with the Illinois rule, and halving now and then: the same steps on every machine.
pub fn root(f: impl Fn(f64) -> f64, from: f64, to: f64) -> f64 {
    let (mut low, mut high) = (from, to);
    let (mut f_low, mut f_high) = (f(low), f(high));
    if f_low >= 0.0 {
        return low;
    }
    if f_high <= 0.0 {
        return high;
    }
    let (mut last, mut before) = (0, f64::NAN);
    for step in 1..=STEPS {
        let width = high - low;
        if width <= CLOSED * high.abs().max(low.abs()) {
            break;
        }
        let middle = 0.5 * (low + high);
        let falsi = low - f_low * (width / (f_high - f_low));
        let is_halving = step % 3 == 0 || !(falsi > low && falsi < high);
        let at = if is_halving { middle } else { falsi };
        if at <= low || at >= high {
            break;
        }
        let is_found = !is_halving && (at - before).abs() <= FOUND * at.abs();
        if !is_halving {
            before = at;
        }
        let value = f(at);
        if value == 0.0 {
            return at;
        }
        if value < 0.0 {
            (low, f_low) = (at, value);
            if last < 0 {
                f_high *= 0.5;
            }
            last = -1;
        } else {
            (high, f_high) = (at, value);
            if last > 0 {
                f_low *= 0.5;
            }
            last = 1;
        }
        if is_found {
            // Beside a slope that is steep enough the same place comes twice however far away the root is.
            let beyond = at + FOUND.copysign(-value) * at.abs();
            if beyond <= low || beyond >= high {
                return at;
            }
            let value_beyond = f(beyond);
            if (value_beyond < 0.0) != (value < 0.0) {
                return at;
            }
            if value_beyond < 0.0 {
                (low, f_low) = (beyond, value_beyond);
            } else {
                (high, f_high) = (beyond, value_beyond);
            }
        }
    }
    0.5 * (low + high)
}
