//! Least total cost of instants that keep headways: `min sum of J_i(T_i)` subject to `T_i >= T_j + h_ij`.
//!
//! Vehicles whose headways bind are pooled into blocks that move as one. Where the headways form a chain, this is
//! isotonic regression by pool adjacent violators, after substituting `s_i = T_i - sum of h`; it is exact for convex
//! J_i. Where they do not (several conflict points), blocks are trees of binding headways, which are split again where
//! a multiplier is negative: the active-set method for separation constraints of Dwyer, Marriott and Stuckey ("Fast node
//! overlap removal", 2005), here for any convex J_i.

use super::cost::{Convex, Slope};

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
/// Within a block, whose instants are sums, s.
const WITHIN_TOLERANCE_S: f64 = 1e-9;
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
    /// The headways of the program solved last.
    last: Vec<Headway>,
    /// The instants found last, s.
    old_s: Vec<f64>,
    parts: Vec<Part>,
    wholes: Vec<Whole>,
    /// Active headways that were not looked at.
    open: Vec<bool>,
    side: Vec<bool>,
    stack: Vec<u32>,
}

/// A vehicle, and those that hang on it by headways that were looked at already.
#[derive(Clone, Copy, Debug)]
struct Part {
    /// What their slopes sum up to.
    slope: f64,
    /// Whether the block's bearer is among them.
    is_bearing: bool,
    /// Its active headways that were not looked at.
    ties: u32,
}

/// A block.
#[derive(Clone, Copy, Debug)]
struct Whole {
    /// What its vehicles' slopes sum up to.
    slope: f64,
    /// The earliest instant it may have, s, and the vehicle this is due to: its bearer.
    earliest: (f64, u32),
}

/// What is to be minimised.
#[derive(Clone, Copy, Debug)]
pub struct Program<'a, C> {
    /// Cost of each vehicle, in passing order.
    pub costs: &'a [C],
    /// The [best instant](best_s) of each alone, s.
    pub alone_s: &'a [f64],
    /// Nobody is earlier than this, s.
    pub earliest_s: &'a [f64],
    /// Sorted by `after`.
    pub headways: &'a [Headway],
}

impl Pooling {
    /// Writes the best instants to `times_s`.
    pub fn minimise<C: Convex>(&mut self, program: &Program<'_, C>, times_s: &mut Vec<f64>) {
        let Program { costs, alone_s, earliest_s, headways } = *program;
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
            self.merge(program, ready, i as u32, Side::Before);
        }
        if !is_chain(headways) {
            self.split_where_it_pays(program);
        }
        self.finish(program, times_s);
    }

    /// The same, begun from the blocks of the program solved last where this one has headways between the same
    /// vehicles: for those that differ little.
    pub fn minimise_again<C: Convex>(&mut self, program: &Program<'_, C>, times_s: &mut Vec<f64>) {
        let headways = program.headways;
        let between = |h: &Headway| (h.before, h.after);
        let is_alike = headways.iter().map(between).eq(self.last.iter().map(between));
        if program.costs.len() != self.block.len() || !is_alike {
            return self.minimise(program, times_s);
        }
        self.place_blocks_again(program);
        let all = headways.len();
        let apart = |own: &Pooling, h: &Headway| own.block[h.before as usize] != own.block[h.after as usize];
        while let Some(h) = headways.iter().find(|h| apart(self, h) && self.lack_s(h) > TOLERANCE_S) {
            // Each merge makes one block of two.
            let block = self.block[h.after as usize];
            self.merge(program, all, block, Side::Before);
        }
        self.split_where_it_pays(program);
        // Blocks that were not merged in passing order may lack headways within.
        if headways.iter().any(|h| self.lack_s(h) > WITHIN_TOLERANCE_S) {
            return self.minimise(program, times_s);
        }
        self.finish(program, times_s);
    }

    /// Moves the blocks there are, whose headways have changed, to their best instants.
    fn place_blocks_again<C: Convex>(&mut self, program: &Program<'_, C>) {
        self.old_s.clear();
        self.old_s
            .extend((0..self.block.len()).map(|i| self.at_s[self.block[i] as usize] + self.offset_s[i]));
        self.side.clear();
        self.side.resize(self.block.len(), false);
        for first in 0..self.block.len() {
            if !self.side[first] {
                self.measure(program, first as u32);
            }
        }
        for block in 0..self.block.len() as u32 {
            if self.block[block as usize] == block {
                let own = self.members(block).map(|i| program.alone_s[i] - self.offset_s[i]);
                let (from, to) =
                    own.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), s| (a.min(s), b.max(s)));
                self.place(program, block, self.at_s[block as usize], from, to);
            }
        }
    }

    /// Names a block by its first vehicle and works out the offsets in it.
    fn measure<C>(&mut self, program: &Program<'_, C>, first: u32) {
        self.side[first as usize] = true;
        self.offset_s[first as usize] = 0.0;
        self.at_s[first as usize] = self.old_s[first as usize];
        self.stack.push(first);
        while let Some(at) = self.stack.pop() {
            self.block[at as usize] = first;
            for (h, _) in program.headways.iter().zip(&self.is_active).filter(|(_, active)| **active) {
                let (other, away_s) = match (h.before == at, h.after == at) {
                    (true, _) => (h.after, h.headway_s),
                    (_, true) => (h.before, -h.headway_s),
                    _ => continue,
                };
                if !std::mem::replace(&mut self.side[other as usize], true) {
                    self.offset_s[other as usize] = self.offset_s[at as usize] + away_s;
                    self.stack.push(other);
                }
            }
        }
    }

    /// Writes down the instants found.
    fn finish<C>(&mut self, program: &Program<'_, C>, times_s: &mut Vec<f64>) {
        times_s.clear();
        times_s.extend((0..self.block.len()).map(|i| self.time_s(i)));
        // Rounding, and what the bound on splits may have left.
        for h in program.headways {
            let least = times_s[h.before as usize] + h.headway_s;
            let time = &mut times_s[h.after as usize];
            *time = time.max(least);
        }
        self.last.clear();
        self.last.extend_from_slice(program.headways);
    }

    /// By how much a headway is violated, s.
    fn lack_s(&self, h: &Headway) -> f64 {
        self.time_s(h.before as usize) + h.headway_s - self.time_s(h.after as usize)
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
                let lack_s = self.lack_s(h);
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
        self.place(program, first, 0.5 * (a + b), a.min(b), a.max(b));
        first
    }

    /// Moves a block to its best instant, which is within the bracket and sought from `start`.
    fn place<C: Convex>(&mut self, program: &Program<'_, C>, block: u32, start: f64, from: f64, to: f64) {
        let best = root(|at| self.slope(program, block, at), start, from, to);
        let earliest = self.members(block).map(|i| program.earliest_s[i] - self.offset_s[i]);
        self.at_s[block as usize] = earliest.fold(best, f64::max);
    }

    /// What the slopes of a block sum up to when it is at that instant.
    fn slope<C: Convex>(&self, program: &Program<'_, C>, block: u32, at_s: f64) -> Slope {
        self.members(block).map(|i| program.costs[i].slope(at_s + self.offset_s[i])).sum()
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
                for _ in 0..20 {
                    if self.slope(program, part, to).value >= 0.0 {
                        break;
                    }
                    to += 2.0 * (to - kept);
                }
                self.place(program, part, kept, -least, to);
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
    ///
    /// A block is a tree of active headways. The multiplier of each is what the slopes on one side of it sum up to, and
    /// the sides are found by taking off vehicles at the ends of the tree, one after the other.
    fn least_wanted<C: Convex>(&mut self, program: &Program<'_, C>) -> Option<(usize, u32)> {
        self.weigh(program);
        self.open.clone_from(&self.is_active);
        self.stack.clear();
        self.stack.extend((0..self.parts.len() as u32).filter(|&i| self.parts[i as usize].ties == 1));
        let mut least: Option<(usize, f64)> = None;
        while let Some(end) = self.stack.pop() {
            let ties = |(at, h): &(usize, &Headway)| self.open[*at] && (h.before == end || h.after == end);
            let Some((at, h)) = program.headways.iter().enumerate().find(ties) else { continue };
            self.open[at] = false;
            let part = self.parts[end as usize];
            let whole = self.wholes[self.block[end as usize] as usize];
            let rest = whole.slope - part.slope;
            let is_before = h.before == end;
            let (first, second) = if is_before { (part.slope, rest) } else { (rest, part.slope) };
            // What is wrong with the sum of the slopes, whoever may not be earlier bears.
            let is_held = self.at_s[self.block[end as usize] as usize] <= whole.earliest.0;
            let multiplier = if is_held && part.is_bearing == is_before { second } else { -first };
            if multiplier < -TOLERANCE_SLOPE && least.is_none_or(|(_, most)| multiplier < most) {
                least = Some((at, multiplier));
            }
            let other = if is_before { h.after } else { h.before };
            let hangs_on = &mut self.parts[other as usize];
            hangs_on.slope += part.slope;
            hangs_on.is_bearing |= part.is_bearing;
            hangs_on.ties -= 1;
            if hangs_on.ties == 1 {
                self.stack.push(other);
            }
        }
        least.map(|(at, _)| (at, self.block[program.headways[at].before as usize]))
    }

    /// Works out the slopes of vehicles and blocks where they are.
    fn weigh<C: Convex>(&mut self, program: &Program<'_, C>) {
        self.parts.clear();
        self.wholes.clear();
        let none = Whole { slope: 0.0, earliest: (f64::NEG_INFINITY, 0) };
        self.wholes.resize(self.block.len(), none);
        for (i, cost) in program.costs.iter().enumerate() {
            let slope = cost.slope(self.time_s(i)).value;
            self.parts.push(Part { slope, is_bearing: false, ties: 0 });
            let whole = &mut self.wholes[self.block[i] as usize];
            whole.slope += slope;
            let earliest_s = program.earliest_s[i] - self.offset_s[i];
            if earliest_s > whole.earliest.0 {
                whole.earliest = (earliest_s, i as u32);
            }
        }
        for (i, block) in self.block.iter().enumerate() {
            self.parts[i].is_bearing = self.wholes[*block as usize].earliest.1 == i as u32;
        }
        for (h, _) in program.headways.iter().zip(&self.is_active).filter(|(_, active)| **active) {
            self.parts[h.before as usize].ties += 1;
            self.parts[h.after as usize].ties += 1;
        }
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

/// Steps of the search for a root.
const STEPS: u32 = 120;
/// Width at which a bracket counts as closed, relative to where it is.
const CLOSED: f64 = 1e-14;
/// A step of Newton's method that is shorter than this share of where it leads is the last: what it leaves is of the
/// order of its square.
const FOUND: f64 = 1e-8;
/// If it is also shorter than this share of the one before.
const SHRINKING: f64 = 0.1;

/// Where a cost is least.
pub fn best_s(cost: &impl Convex) -> f64 {
    let (from, to) = cost.bracket_s();
    root(|t| cost.slope(t), 0.5 * (from + to), from, to)
}

/// Where a rising function passes 0 within a bracket; an end of it when it does not.
///
/// Newton's method from `start`, which halves the bracket where it would leave it or comes no nearer: the same steps on every
/// machine.
pub fn root(f: impl Fn(f64) -> Slope, start: f64, from: f64, to: f64) -> f64 {
    let (mut low, mut high) = (from, to);
    let (mut is_low_known, mut is_high_known) = (false, false);
    let mut at = if start > low && start < high { start } else { 0.5 * (low + high) };
    let (mut last, mut last_newton) = (high - low, 0.0);
    for _ in 0..STEPS {
        let Slope { value, rise } = f(at);
        if value < 0.0 {
            if at >= to {
                return to;
            }
            (low, is_low_known) = (at, true);
        } else if value > 0.0 {
            if at <= from {
                return from;
            }
            (high, is_high_known) = (at, true);
        } else {
            return at;
        }
        if high - low <= CLOSED * high.abs().max(low.abs()) {
            break;
        }
        let newton = at - value / rise;
        let (is_above, is_below) = (newton > low, newton < high);
        let next = if rise > 0.0 && is_above && is_below && (newton - at).abs() <= 0.75 * last {
            // Beside a slope that is steep enough steps are short however far away the root is, and become longer.
            let step = (newton - at).abs();
            if step <= FOUND * newton.abs() && step <= SHRINKING * last_newton {
                return newton;
            }
            last_newton = step;
            newton
        } else if value < 0.0 && !is_high_known && !is_below {
            high
        } else if value > 0.0 && !is_low_known && !is_above {
            low
        } else {
            0.5 * (low + high)
        };
        if next == at {
            break;
        }
        last = (next - at).abs();
        at = next;
    }
    at
}
