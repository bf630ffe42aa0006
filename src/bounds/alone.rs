//! The optimum of a vehicle that is alone on its way: a lower bound whatever the others do.
//!
//! Minimise `sum_k (pi_k tau_k + w_k integral of u^2/2)` over the legs of the way, with a price of time `pi_k` and a
//! weight `w_k` on leg k, from a given speed, without limits on `u` and `v`. In `z = v^2` as a function of position the time
//! `integral of z^(-1/2) ds` and the energy `integral of z'^2 / (8 z^(1/2)) ds` are convex (a square over a
//! concave function), so the problem is convex and its stationary point, unique, is the optimum. Along a leg
//! `w_k u = -lambda` is linear in time, and as duration is free the Hamiltonian is zero:
//! `pi_k - w_k u^2/2 + p_k v = 0`; at a leg's end `w u` is continuous, at the way's end it is zero where the speed is
//! free. Backward from an exit speed each leg is therefore a cubic, and the entry speed grows with the exit speed (or,
//! where that is given, falls with the acceleration at the end): its root is sought between bounds.

/// A stretch of the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Leg {
    /// Length, m, > 0.
    pub length_m: f64,
    /// Weight of energy, > 0.
    pub weight: f64,
    /// Price of time, >= 0: the weight times beta, unless others have a say in it.
    pub price: f64,
}

impl Leg {
    /// A leg whose time costs its vehicle alone.
    pub fn new(length_m: f64, weight: f64, beta: f64) -> Leg {
        Leg { length_m, weight, price: weight * beta }
    }
}

/// What is asked of the end of the way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum End {
    /// Nothing.
    Free,
    /// That speed, m/s, > 0.
    Speed(f64),
    /// Behind it a distance at the speed it ends with, and as much more as given: `(metres, m/s)`, at a price.
    Coasting {
        /// Distance, m.
        length_m: f64,
        /// Added to the speed, m/s.
        faster_mps: f64,
        /// Price of time.
        price: f64,
    },
}

/// The optimum over a way.
#[derive(Clone, Debug, PartialEq)]
pub struct Optimum {
    /// Cost, m^2/s^3.
    pub cost: f64,
    /// Time spent on each leg, s.
    pub durations_s: Vec<f64>,
    /// Speed at the end of each leg, m/s.
    pub exits_mps: Vec<f64>,
}

/// Steps of a search, at most: each third one halves the interval.
const STEPS: usize = 200;
/// By how much the entry speed may be missed, as a share of it.
const MISS: f64 = 1e-13;
/// Acceleration at an end whose speed is given, at most, m/s^2: beyond any that vehicles have.
const HARDEST_MPS2: f64 = 64.0;

/// The optimum of a vehicle that enters a way, of at least one leg, at `entry_mps > 0`. `None` when there is none
/// that ends at a given speed with accelerations of vehicles.
pub fn optimum(entry_mps: f64, legs: &[Leg], end: End) -> Option<Optimum> {
    let weight = legs[legs.len() - 1].weight;
    // What is sought, and the extremal it gives: the greater, the faster it must have come.
    let extremal = |sought: f64| match end {
        End::Free => backward(sought, 0.0, legs),
        End::Speed(exit_mps) => backward(exit_mps, -sought * weight, legs),
        End::Coasting { length_m, faster_mps, price } => {
            let through_mps = sought + faster_mps;
            let found = backward(sought, price * length_m / (through_mps * through_mps), legs);
            found.map(|(entry_mps, optimum)| {
                let cost = optimum.cost + price * length_m / through_mps;
                (entry_mps, Optimum { cost, ..optimum })
            })
        }
    };
    // A vehicle that would have come to rest on the way has not come fast enough.
    let excess_mps =
        |sought: f64| extremal(sought).map_or(f64::NEG_INFINITY, |(found_mps, _)| found_mps - entry_mps);
    let (mut low, mut high) = match end {
        End::Speed(_) => (-HARDEST_MPS2, HARDEST_MPS2),
        _ => (0.0, entry_mps.max(1.0)),
    };
    let (mut at_low, mut at_high) = (f64::NEG_INFINITY, excess_mps(high));
    while at_high < 0.0 {
        if end != End::Free && high > 1e4 || matches!(end, End::Speed(_)) {
            return None;
        }
        (low, at_low, high) = (high, at_high, 2.0 * high);
        at_high = excess_mps(high);
    }
    // Between the two by regula falsi, where an end that has stayed counts less (Illinois).
    let mut best = high;
    let mut was_low = None;
    for step in 0..STEPS {
        let middle = 0.5 * (low + high);
        let secant = (low * at_high - high * at_low) / (at_high - at_low);
        let is_within = secant > low && secant < high;
        best = if step % 3 < 2 && at_low.is_finite() && is_within { secant } else { middle };
        let excess = excess_mps(best);
        if excess.abs() <= MISS * entry_mps || best <= low || best >= high {
            break;
        }
        let is_low = excess < 0.0;
        let again = if was_low == Some(is_low) { 0.5 } else { 1.0 };
        if is_low {
            (low, at_low, at_high) = (best, excess, again * at_high);
        } else {
            (high, at_high, at_low) = (best, excess, again * at_low);
        }
        was_low = Some(is_low);
    }
    // Where rounding ends the search, from the side on which there is a way.
    extremal(best).or_else(|| extremal(high)).map(|(_, optimum)| optimum)
}

/// The extremal that ends at a speed with `w u = momentum`: entry speed, and what it costs. `None` when it would
/// have come to rest on the way.
fn backward(exit_mps: f64, momentum: f64, legs: &[Leg]) -> Option<(f64, Optimum)> {
    let (mut durations_s, mut exits_mps) = (vec![0.0; legs.len()], vec![0.0; legs.len()]);
    let (mut v, mut momentum, mut cost) = (exit_mps, momentum, 0.0);
    for (at, leg) in legs.iter().enumerate().rev() {
        // With r the time before the leg's end: u = u1 + c r, v = v1 - u1 r - c r^2/2.
        let u = momentum / leg.weight;
        let c = (leg.price / leg.weight - 0.5 * u * u) / v;
        let r = passes_s(leg.length_m, v, u, c)?;
        let energy = 0.5 * ((u + c * r) * u + c * c * r * r / 3.0) * r;
        cost += leg.price * r + leg.weight * energy;
        (durations_s[at], exits_mps[at]) = (r, v);
        (v, momentum) = (v - (u + 0.5 * c * r) * r, leg.weight * (u + c * r));
    }
    Some((v, Optimum { cost, durations_s, exits_mps }))
}

/// When `v - u r - c r^2/2` is zero first, if ever.
fn rest_s(v: f64, u: f64, c: f64) -> f64 {
    let root = u * u + 2.0 * c * v;
    // The stable form of the smaller positive root.
    if root < 0.0 || u + root.sqrt() <= 0.0 { f64::INFINITY } else { 2.0 * v / (u + root.sqrt()) }
}

/// When `v r - u r^2/2 - c r^3/6`, which grows until the vehicle rests, reaches `length_m`: Newton's method, kept
/// between bounds that close in.
fn passes_s(length_m: f64, v: f64, u: f64, c: f64) -> Option<f64> {
    let distance_m = |r: f64| (v - (0.5 * u + c / 6.0 * r) * r) * r;
    let rest_s = rest_s(v, u, c);
    let (mut low, mut high) = (0.0, if rest_s.is_finite() { rest_s } else { 1.0 });
    while rest_s.is_infinite() && distance_m(high) < length_m {
        (low, high) = (high, 2.0 * high);
    }
    if distance_m(high) < length_m {
        return None;
    }
    let mut r = 0.5 * (low + high);
    for _ in 0..100 {
        let missing_m = length_m - distance_m(r);
        *(if missing_m > 0.0 { &mut low } else { &mut high }) = r;
        let newton = r + missing_m / (v - (u + 0.5 * c * r) * r);
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - r).abs() <= 1e-13 * r || next <= low || next >= high {
            break;
        }
        r = next;
    }
    Some(r)
}
