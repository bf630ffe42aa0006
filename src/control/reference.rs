//! The reference trajectory: the unconstrained optimum of Problem 1 (paper: `equ:uc_u` ff.).
//!
//! `u*(t) = a t + b`, `v*(t) = a t^2/2 + b t + v0`, `x*(t) = a t^3/6 + b t^2/2 + v0 t`, with time and
//! distance counted from where the plan starts (`equ:ucp_shift_vm_1` ff.).
//!
//! The paper prints the transversality condition as `beta - b/2 + a c = 0` (`equ:ucp_vm_5`), which
//! lost a square: along the optimum the Hamiltonian vanishes, `beta - b^2/2 + a c = 0`. The corrected
//! condition leads to a quartic in the duration T, the printed one to the cubic of `equ:tm`. Both are
//! here; see `docs/mathematics.md`.
//!
//! Only `+ - * /` and `sqrt` are used, so results are the same on every IEEE machine.

use crate::scenario::{PositionFeedback, ReferenceLaw};

/// What is asked of the speed at the end of the plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Terminal {
    /// Nothing: the speed is chosen by the optimum, `u*(T) = 0`.
    Free,
    /// It equals the terminal speed v_m, m/s (paper: `equ:vm`).
    Speed(f64),
}

/// The optimum over a given length: duration and coefficients.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Optimum {
    /// Duration T, s.
    pub duration_s: f64,
    /// Coefficient a, m/s^3.
    pub a: f64,
    /// Coefficient b, m/s^2.
    pub b: f64,
}

/// A planning problem: from speed `v0_mps`, cover `length_m` at least cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Problem {
    /// Weight of time beta, > 0.
    pub beta: f64,
    /// Speed at the start, m/s, >= 0.
    pub v0_mps: f64,
    /// Distance to cover, m, > 0.
    pub length_m: f64,
    /// Terminal condition.
    pub terminal: Terminal,
}

impl Problem {
    /// The optimum under the given transversality condition.
    pub fn solve(&self, law: ReferenceLaw) -> Optimum {
        let duration_s = match law {
            ReferenceLaw::Corrected => {
                let cost = |t: f64| self.coefficients(t).cost(self.beta);
                match self.quartic().rising_roots() {
                    RisingRoots { early: Some(early), late: Some(late) } if cost(late) < cost(early) => late,
                    roots => roots.early.or(roots.late).expect(RISES),
                }
            }
            ReferenceLaw::AsPrinted => self.printed_duration(),
        };
        self.coefficients(duration_s)
    }

    /// The optimum a vehicle can drive.
    ///
    /// Where the cost has two minima, the later one overshoots the end and comes back. It can be the
    /// cheaper of the two, but a vehicle does not reverse (`VehicleConstraints`), so the earlier is taken.
    pub fn solve_forward(&self, law: ReferenceLaw) -> Optimum {
        match law {
            ReferenceLaw::Corrected => {
                let roots = self.quartic().rising_roots();
                self.coefficients(roots.early.or(roots.late).expect(RISES))
            }
            ReferenceLaw::AsPrinted => self.solve(law),
        }
    }

    /// The optimum a vehicle can drive, near a duration at which it is likely to be: where the cost has one minimum, Newton
    /// finds it from there.
    pub fn solve_near(&self, guess_s: f64) -> Optimum {
        let quartic = self.quartic();
        let is_monotone = quartic.is_monotone();
        let mut duration = guess_s;
        for _ in 0..8 {
            if !(is_monotone && duration > 0.0 && duration.is_finite()) {
                break;
            }
            let residual = quartic.value(duration);
            if residual.abs() <= 1e-12 * quartic.s {
                return self.coefficients(duration);
            }
            duration -= residual / quartic.slope(duration);
        }
        self.solve_forward(ReferenceLaw::Corrected)
    }

    /// Re-plans for another terminal speed by perturbing the duration of `old` (paper:
    /// `equ:delta_t`).
    ///
    /// Corrected: first-order step `-(g_w / g_T) dw`, polished by Newton when the residual asks for it,
    /// solved afresh (see [`solve_forward`](Self::solve_forward)) when the cost has two local minima. As
    /// printed: the printed first-order step alone.
    pub fn perturb(&self, law: ReferenceLaw, old: &Optimum, old_terminal: Terminal) -> Optimum {
        let (Terminal::Speed(w_old), Terminal::Speed(w)) = (old_terminal, self.terminal) else {
            return self.solve_forward(law);
        };
        let (t, v0, l) = (old.duration_s, self.v0_mps, self.length_m);
        match law {
            ReferenceLaw::Corrected => {
                let quartic = self.quartic();
                if !quartic.is_monotone() {
                    return self.solve_forward(law);
                }
                let before = Problem { terminal: old_terminal, ..*self }.quartic();
                let g_w = -2.0 * (v0 + 2.0 * w_old) * t * t + 12.0 * l * t;
                let step = -(g_w / before.slope(t)) * (w - w_old);
                let mut duration = t + step;
                for _ in 0..8 {
                    if !(duration > 0.0 && duration.is_finite()) {
                        return self.solve_forward(law);
                    }
                    let residual = quartic.value(duration);
                    if residual.abs() <= 1e-12 * quartic.s {
                        return self.coefficients(duration);
                    }
                    duration -= residual / quartic.slope(duration);
                }
                self.solve_forward(law)
            }
            ReferenceLaw::AsPrinted => {
                let numerator = t * t + 6.0 * v0 * t;
                let denominator = 3.0 * self.beta * t * t + (4.0 * v0 + 2.0 * w) * t - 3.0 * l
                    + 6.0 * v0 * w
                    + 6.0 * v0 * v0;
                let duration = t - numerator / denominator * (w - w_old);
                if duration > 0.0 && duration.is_finite() {
                    self.coefficients(duration)
                } else {
                    self.solve_forward(law)
                }
            }
        }
    }

    /// Coefficients of the least-energy trajectory of a given duration (paper: `equ:ucp_vm_tm`).
    pub fn coefficients(&self, duration_s: f64) -> Optimum {
        let t = duration_s;
        let excess = self.length_m - self.v0_mps * t;
        match self.terminal {
            Terminal::Speed(w) => {
                let dv = w - self.v0_mps;
                Optimum {
                    duration_s,
                    a: 6.0 * dv / (t * t) - 12.0 * excess / (t * t * t),
                    b: -2.0 * dv / t + 6.0 * excess / (t * t),
                }
            }
            Terminal::Free => {
                let b = 3.0 * excess / (t * t);
                Optimum { duration_s, a: -b / t, b }
            }
        }
    }

    /// The condition dJ/dT = 0 as a quartic in T.
    fn quartic(&self) -> Quartic {
        let (v0, l) = (self.v0_mps, self.length_m);
        match self.terminal {
            Terminal::Speed(w) => Quartic {
                p: self.beta,
                q: 2.0 * (v0 * v0 + v0 * w + w * w),
                r: 12.0 * l * (v0 + w),
                s: 18.0 * l * l,
            },
            Terminal::Free => Quartic { p: self.beta, q: 1.5 * v0 * v0, r: 6.0 * v0 * l, s: 4.5 * l * l },
        }
    }

    /// The positive root of the printed cubic (`equ:tm`), or of its analogue with `u*(T) = 0`.
    fn printed_duration(&self) -> f64 {
        let (beta, v0, l) = (self.beta, self.v0_mps, self.length_m);
        let [c3, c2, c1, c0] = match self.terminal {
            Terminal::Speed(w) => {
                [beta, 2.0 * v0 + w, 6.0 * v0 * w + 6.0 * v0 * v0 - 3.0 * l, -12.0 * l * v0]
            }
            Terminal::Free => [2.0 * beta, 3.0 * v0, 6.0 * v0 * v0 - 3.0 * l, -6.0 * l * v0],
        };
        // One sign change, so one positive root; the value is negative before it, positive after.
        let root = |value: &dyn Fn(f64) -> f64, slope: &dyn Fn(f64) -> f64| {
            let mut high = 1.0;
            while value(high) < 0.0 {
                high *= 2.0;
            }
            rising_root(value, slope, 0.0, high)
        };
        if c0 == 0.0 {
            // From rest the constant term vanishes and T = 0 is a root of no use: divide it out.
            root(&|t| (c3 * t + c2) * t + c1, &|t| 2.0 * c3 * t + c2)
        } else {
            root(&|t| ((c3 * t + c2) * t + c1) * t + c0, &|t| (3.0 * c3 * t + 2.0 * c2) * t + c1)
        }
    }
}

impl Optimum {
    /// Energy, the integral of u^2/2, m^2/s^3.
    pub fn energy(&self) -> f64 {
        let (a, b, t) = (self.a, self.b, self.duration_s);
        0.5 * t * (a * a * t * t / 3.0 + a * b * t + b * b)
    }

    /// Cost `beta T` + energy (paper: `eqn:energyobj`).
    pub fn cost(&self, beta: f64) -> f64 {
        beta * self.duration_s + self.energy()
    }
}

/// `p T^4 - q T^2 + r T - s` with p, s > 0 and q, r >= 0: dJ/dT up to a positive factor.
#[derive(Clone, Copy, Debug)]
struct Quartic {
    p: f64,
    q: f64,
    r: f64,
    s: f64,
}

impl Quartic {
    fn value(&self, t: f64) -> f64 {
        ((self.p * t * t - self.q) * t + self.r) * t - self.s
    }

    fn slope(&self, t: f64) -> f64 {
        (4.0 * self.p * t * t - 2.0 * self.q) * t + self.r
    }

    /// The positive inflection point, where the slope is least.
    fn inflection(&self) -> f64 {
        (self.q / (6.0 * self.p)).sqrt()
    }

    fn is_monotone(&self) -> bool {
        self.slope(self.inflection()) >= 0.0
    }

    /// An upper bound of all positive roots.
    fn beyond(&self) -> f64 {
        let mut t = 1.0;
        while self.value(t) <= 0.0 || self.slope(t) <= 0.0 || t < self.inflection() {
            t *= 2.0;
        }
        t
    }

    /// The minima of the cost: the positive roots at which the value rises.
    fn rising_roots(&self) -> RisingRoots {
        let value = |t: f64| self.value(t);
        let slope = |t: f64| self.slope(t);
        let high = self.beyond();
        if self.is_monotone() {
            return RisingRoots { early: Some(rising_root(&value, &slope, 0.0, high)), late: None };
        }
        // The value rises, falls and rises again; the slope has one root on each side of the inflection.
        let middle = self.inflection();
        let curvature = |t: f64| 12.0 * self.p * t * t - 2.0 * self.q;
        let top = falling_root(&slope, 0.0, middle);
        let bottom = rising_root(&slope, &curvature, middle, high);
        RisingRoots {
            early: (value(top) >= 0.0).then(|| rising_root(&value, &slope, 0.0, top)),
            late: (value(bottom) < 0.0).then(|| rising_root(&value, &slope, bottom, high)),
        }
    }
}

/// Minima of the cost over the duration, s. At least one exists.
#[derive(Clone, Copy, Debug)]
struct RisingRoots {
    early: Option<f64>,
    late: Option<f64>,
}

/// Why [`RisingRoots`] is never empty.
const RISES: &str = "a quartic negative at 0 and positive at infinity has a rising root";

/// The root in `[low, high]` of a function that is negative before and positive after it: Newton,
/// kept inside a shrinking bracket.
fn rising_root(value: &dyn Fn(f64) -> f64, slope: &dyn Fn(f64) -> f64, low: f64, high: f64) -> f64 {
    let (mut low, mut high) = (low, high);
    let mut t = high;
    for _ in 0..200 {
        let f = value(t);
        if f == 0.0 {
            return t;
        }
        if f > 0.0 {
            high = t;
        } else {
            low = t;
        }
        let newton = t - f / slope(t);
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - t).abs() <= 1e-16 * t.abs() || next == low && f < 0.0 {
            return next;
        }
        t = next;
    }
    t
}

/// The root in `[low, high]` of a function that is positive before and negative after it: bisection,
/// only needed to bracket and only when the cost has two minima.
fn falling_root(value: &dyn Fn(f64) -> f64, low: f64, high: f64) -> f64 {
    let (mut low, mut high) = (low, high);
    for _ in 0..100 {
        let mid = 0.5 * (low + high);
        if value(mid) > 0.0 {
            low = mid;
        } else {
            high = mid;
        }
    }
    0.5 * (low + high)
}

/// A reference trajectory placed in time and space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference {
    /// Instant at which it starts, s.
    pub start_s: f64,
    /// Position at which it starts, m.
    pub origin_m: f64,
    /// Speed at which it starts, m/s.
    pub v0_mps: f64,
    /// Duration and coefficients.
    pub optimum: Optimum,
    /// Terminal condition it was made for.
    pub terminal: Terminal,
}

impl Reference {
    /// Position after `t_s` on the plan, counted from its origin, m.
    #[inline]
    pub fn distance_m(&self, t_s: f64) -> f64 {
        ((self.optimum.a / 6.0 * t_s + 0.5 * self.optimum.b) * t_s + self.v0_mps) * t_s
    }

    /// Speed after `t_s` on the plan, m/s.
    #[inline]
    pub fn speed_mps(&self, t_s: f64) -> f64 {
        (0.5 * self.optimum.a * t_s + self.optimum.b) * t_s + self.v0_mps
    }

    /// Acceleration after `t_s` on the plan, m/s^2.
    #[inline]
    pub fn acceleration_mps2(&self, t_s: f64) -> f64 {
        self.optimum.a * t_s + self.optimum.b
    }

    /// Instant at which the plan ends, s.
    #[inline]
    pub fn exit_time_s(&self) -> f64 {
        self.start_s + self.optimum.duration_s
    }

    /// Speed at which the plan ends, m/s.
    #[inline]
    pub fn exit_speed_mps(&self) -> f64 {
        match self.terminal {
            Terminal::Speed(w) => w,
            Terminal::Free => self.speed_mps(self.optimum.duration_s),
        }
    }

    /// Reference speed and acceleration for a vehicle that is at `x_m` at instant `t_s`, found through
    /// the reference time t_ref at which the plan is at the same position (section "Control and speed
    /// reference trajectories"); t_ref is kept within the plan.
    // Into whoever asks, however many do: called, it takes a vehicle a quarter longer to decide.
    #[inline(always)]
    pub fn at(&self, feedback: PositionFeedback, t_s: f64, x_m: f64) -> (f64, f64) {
        let duration = self.optimum.duration_s;
        let distance = x_m - self.origin_m;
        let elapsed = (t_s - self.start_s).clamp(0.0, duration);
        let t_ref = match feedback {
            PositionFeedback::Approximate => {
                let speed = self.speed_mps(elapsed);
                // Where the plan all but stands still, position says nothing about time.
                if speed > 1e-6 {
                    (elapsed - (self.distance_m(elapsed) - distance) / speed).clamp(0.0, duration)
                } else {
                    elapsed
                }
            }
            PositionFeedback::Exact => self.time_at(distance, elapsed),
        };
        (self.speed_mps(t_ref), self.acceleration_mps2(t_ref))
    }

    /// The root of `distance(t) = distance_m` within the plan, by bracketed Newton from `guess_s`.
    fn time_at(&self, distance_m: f64, guess_s: f64) -> f64 {
        let (mut low, mut high) = (0.0, self.optimum.duration_s);
        let mut t = guess_s;
        for _ in 0..60 {
            let excess = self.distance_m(t) - distance_m;
            if excess > 0.0 {
                high = t;
            } else {
                low = t;
            }
            let newton = t - excess / self.speed_mps(t);
            let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
            if (next - t).abs() <= 1e-13 * self.optimum.duration_s {
                return next;
            }
            t = next;
        }
        t
    }
}

/// The terminal speed that minimises the cost from an entry speed: `argmin J*(v_m)` of section
/// "Problem 2", which is the final speed of the plan with free terminal speed, m/s.
pub fn optimal_terminal_speed_mps(law: ReferenceLaw, beta: f64, v0_mps: f64, length_m: f64) -> f64 {
    let optimum = Problem { beta, v0_mps, length_m, terminal: Terminal::Free }.solve(law);
    v0_mps + optimum.b * optimum.duration_s + 0.5 * optimum.a * optimum.duration_s * optimum.duration_s
}
