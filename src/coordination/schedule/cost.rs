//! What it costs a vehicle to pass the end of its path at a given instant.
//!
//! Time and control energy, `beta T + integral of u^2 / 2`, least over all motions that cover the way left in T. Over one
//! zone the best acceleration falls linearly to 0; over two zones with the boundary passed at T1 and the end at T2 it
//! is linear on each of the two. Derivation in `docs/scheduling.md`.

/// Slopes and values at instants at which nobody can be anywhere: finite, so that sums stay numbers.
const STEEP: f64 = 1e30;

/// Where the cost of a passage stops being convex: `v T = (3 - sqrt 3) l`.
const CONVEX_UNTIL: f64 = 1.267_949_192_431_122_7;

/// The way through one zone: `J(T) = beta T + 1.5 (l - v T)^2 / T^3`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Single {
    /// Weight of time, m^2/s^4.
    pub beta: f64,
    /// Way left to the end of the path, m.
    pub left_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
}

impl Single {
    /// Instant from which the slope is held, s: there J ends being convex.
    fn held_from_s(&self) -> f64 {
        if self.v_mps > 0.0 { CONVEX_UNTIL * self.left_m / self.v_mps } else { f64::INFINITY }
    }

    fn slope_at(&self, t: f64) -> Slope {
        let Single { beta, left_m: l, v_mps: v } = *self;
        let per_t4 = 1.0 / (t * t * t * t);
        let way = v * t;
        Slope {
            value: beta - 1.5 * (l - way) * (3.0 * l - way) * per_t4,
            rise: 3.0 * (6.0 * l * (l - way) + way * way) * per_t4 / t,
        }
    }

    /// Speed at the end, m/s.
    pub fn exit_mps(&self, t_s: f64) -> f64 {
        1.5 * self.left_m / t_s - 0.5 * self.v_mps
    }
}

/// The way through this zone and the next, `F(T1, T2) = c1 T1 + c2 T2 + E1 + weight E2`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tandem {
    /// Weight c1 of the instant at which the first zone is left, m^2/s^4.
    pub first_beta: f64,
    /// Weight c2 of the instant at which the second is left, m^2/s^4.
    pub second_beta: f64,
    /// Weight omega of the energy spent in the second zone; with 1 it counts in full.
    pub weight: f64,
    /// Way left in the first zone, m.
    pub first_m: f64,
    /// Way through the second, m.
    pub second_m: f64,
    /// Speed, m/s.
    pub v_mps: f64,
}

/// The best motion over two zones for given instants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TandemMotion {
    /// Acceleration now, m/s^2.
    pub u0_mps2: f64,
    /// Acceleration at the end of the first zone, m/s^2; behind it, it goes on from `u1 / weight` to 0.
    pub u1_mps2: f64,
    /// Speed at the boundary, m/s.
    pub v1_mps: f64,
    /// Speed at the end of the second zone, m/s.
    pub v2_mps: f64,
}

impl Tandem {
    /// The best motion that passes the boundary at `t1_s` and the end of the second zone at `t2_s`.
    pub fn motion(&self, t1_s: f64, t2_s: f64) -> TandemMotion {
        let Tandem { weight, first_m, second_m, v_mps: v, .. } = *self;
        let tau = t2_s - t1_s;
        let a = 1.5 * first_m / t1_s - 0.5 * v;
        let u1 = 3.0 * (second_m - a * tau) / (tau * tau / weight + 0.75 * tau * t1_s);
        let u0 = 3.0 * (first_m - v * t1_s) / (t1_s * t1_s) - 0.5 * u1;
        let v1 = a + 0.25 * u1 * t1_s;
        TandemMotion { u0_mps2: u0, u1_mps2: u1, v1_mps: v1, v2_mps: v1 + u1 * tau / (2.0 * weight) }
    }

    /// `F(T1, T2)`.
    pub fn value(&self, t1_s: f64, t2_s: f64) -> f64 {
        let tau = t2_s - t1_s;
        if t1_s <= 0.0 || tau <= 0.0 {
            return STEEP;
        }
        let TandemMotion { u0_mps2: u0, u1_mps2: u1, .. } = self.motion(t1_s, t2_s);
        let first = t1_s * (u0 * u0 + u0 * u1 + u1 * u1) / 6.0;
        let second = tau * u1 * u1 / (6.0 * self.weight * self.weight);
        self.first_beta * t1_s + self.second_beta * t2_s + first + self.weight * second
    }

    /// `dF / dT1`, and how it rises with T1.
    pub fn slope_first(&self, t1_s: f64, t2_s: f64) -> Slope {
        let Tandem { weight, first_m, second_m, v_mps: v, .. } = *self;
        let (per_t1, tau) = (1.0 / t1_s, t2_s - t1_s);
        let per_tau = 1.0 / tau;
        let per_weight = 1.0 / weight;
        // What comes behind `d_` is the derivative by T1.
        let a = 1.5 * first_m * per_t1 - 0.5 * v;
        let d_a = -1.5 * first_m * per_t1 * per_t1;
        let per_denominator = 1.0 / (tau * tau * per_weight + 0.75 * tau * t1_s);
        let d_denominator = -2.0 * tau * per_weight + 0.75 * (tau - t1_s);
        let u1 = 3.0 * (second_m - a * tau) * per_denominator;
        let d_u1 = (3.0 * (a - d_a * tau) - u1 * d_denominator) * per_denominator;
        let short = 3.0 * (first_m - v * t1_s) * per_t1 * per_t1;
        let u0 = short - 0.5 * u1;
        let d_u0 = -3.0 * v * per_t1 * per_t1 - 2.0 * short * per_t1 - 0.5 * d_u1;
        let v1 = a + 0.25 * u1 * t1_s;
        let d_v1 = d_a + 0.25 * (d_u1 * t1_s + u1);
        let bend = (u1 - u0) * per_t1 + u1 * per_tau;
        let d_bend = (d_u1 - d_u0 - (u1 - u0) * per_t1) * per_t1 + (d_u1 + u1 * per_tau) * per_tau;
        let lost = 1.0 - per_weight;
        Slope {
            value: self.first_beta - 0.5 * u1 * u1 * lost + bend * v1,
            rise: -u1 * d_u1 * lost + d_bend * v1 + bend * d_v1,
        }
    }

    /// `dF / dT2`, and how it rises with T2.
    pub fn slope_second(&self, t1_s: f64, t2_s: f64) -> Slope {
        let Tandem { weight, first_m, second_m, v_mps: v, .. } = *self;
        let tau = t2_s - t1_s;
        let per_tau = 1.0 / tau;
        let per_weight = 1.0 / weight;
        let a = 1.5 * first_m / t1_s - 0.5 * v;
        let per_denominator = 1.0 / (tau * tau * per_weight + 0.75 * tau * t1_s);
        let u1 = 3.0 * (second_m - a * tau) * per_denominator;
        let d_u1 = (-3.0 * a - u1 * (2.0 * tau * per_weight + 0.75 * t1_s)) * per_denominator;
        let v2 = a + 0.25 * u1 * t1_s + 0.5 * u1 * tau * per_weight;
        let d_v2 = 0.25 * d_u1 * t1_s + 0.5 * (d_u1 * tau + u1) * per_weight;
        Slope {
            value: self.second_beta - u1 * v2 * per_tau,
            rise: (u1 * v2 * per_tau - d_u1 * v2 - u1 * d_v2) * per_tau,
        }
    }
}

/// A vehicle's cost as a function of one instant, counted from now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Cost {
    /// Of leaving this zone, the last that counts.
    Single(Single),
    /// Of leaving this zone, the next one being left at a given instant, s.
    First(Tandem, f64),
    /// Of leaving the next zone, this one being left at a given instant, s.
    Second(Tandem, f64),
}

/// The slope of a cost at one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slope {
    /// The slope itself.
    pub value: f64,
    /// Its own slope there; 0 where it is not known.
    pub rise: f64,
}

impl Slope {
    /// A slope that stays the same around.
    const fn held(value: f64) -> Slope {
        Slope { value, rise: 0.0 }
    }

    /// The same within what sums can bear.
    fn bounded(self) -> Slope {
        if self.value.abs() < STEEP { self } else { Slope::held(self.value.clamp(-STEEP, STEEP)) }
    }
}

impl std::ops::Add for Slope {
    type Output = Slope;

    fn add(self, other: Slope) -> Slope {
        Slope { value: self.value + other.value, rise: self.rise + other.rise }
    }
}

impl std::iter::Sum for Slope {
    fn sum<I: Iterator<Item = Slope>>(all: I) -> Slope {
        all.fold(Slope::held(0.0), std::ops::Add::add)
    }
}

/// A function to be minimised of which only the slope is needed; the slope rises.
pub trait Convex {
    /// The slope.
    fn slope(&self, t_s: f64) -> Slope;

    /// Two instants between which the slope passes 0.
    fn bracket_s(&self) -> (f64, f64);
}

impl Cost {
    /// The cost, and beyond where it is convex its tangent.
    pub fn value(&self, t_s: f64) -> f64 {
        match self {
            Cost::Single(_) if t_s <= 0.0 => STEEP,
            Cost::Single(single) => {
                let t = t_s.min(single.held_from_s());
                let short = single.left_m - single.v_mps * t;
                let convex = single.beta * t + 1.5 * short * short / (t * t * t);
                convex + (t_s - t) * single.slope_at(t).value
            }
            Cost::First(tandem, t2) => tandem.value(t_s, *t2),
            Cost::Second(tandem, t1) => tandem.value(*t1, t_s),
        }
    }

    /// Speed with which the vehicle leaves at that instant, m/s.
    pub fn exit_mps(&self, t_s: f64) -> f64 {
        match self {
            Cost::Single(single) => single.exit_mps(t_s),
            Cost::First(tandem, t2) => tandem.motion(t_s, *t2).v1_mps,
            Cost::Second(tandem, t1) => tandem.motion(*t1, t_s).v2_mps,
        }
    }
}

impl Convex for Cost {
    fn slope(&self, t_s: f64) -> Slope {
        match self {
            Cost::Single(_) if t_s <= 0.0 => Slope::held(-STEEP),
            Cost::Single(single) => {
                let held_s = single.held_from_s();
                if t_s < held_s { single.slope_at(t_s) } else { Slope::held(single.slope_at(held_s).value) }
            }
            Cost::First(..) if t_s <= 0.0 => Slope::held(-STEEP),
            Cost::First(_, t2) if t_s >= *t2 => Slope::held(STEEP),
            Cost::First(tandem, t2) => tandem.slope_first(t_s, *t2).bounded(),
            Cost::Second(_, t1) if t_s <= *t1 => Slope::held(-STEEP),
            Cost::Second(tandem, t1) => tandem.slope_second(*t1, t_s).bounded(),
        }
    }

    fn bracket_s(&self) -> (f64, f64) {
        match self {
            Cost::Single(Single { beta, left_m, v_mps }) => {
                // (l - v T)(3 l - v T) <= 3 l^2 while v T <= l; and at half of that it exceeds beta T^4 / 1.5.
                let standing_s = ((4.5 / beta).sqrt() * left_m).sqrt();
                let last_s = if v_mps * standing_s > *left_m { left_m / v_mps } else { standing_s };
                (0.5 * last_s, last_s)
            }
            Cost::First(_, t2) => (0.0, *t2),
            Cost::Second(tandem, t1) => {
                // At the speed it would come with and without energy, u1 = 0: the slope is positive.
                let coasting = (1.5 * tandem.first_m / t1 - 0.5 * tandem.v_mps).max(0.5);
                let last_s = tandem.second_m / coasting;
                (*t1, t1 + last_s)
            }
        }
    }
}
