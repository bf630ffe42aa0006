//! When a vehicle is to be where: durations of plans whose acceleration is linear in time and ends at zero.
//!
//! Over a distance `l` in a time `T`, from speed `v`, the least effort begins with `u = 3 (l - v T) / T^2` and
//! ends with the speed `1.5 l / T - v / 2`. From step to step the same plan results, so nothing has to be remembered.

/// Shortest time a plan is made for, s.
const LEAST_S: f64 = 1e-6;

/// A partner's passage of a place: it is `lead_m + speed_mps * t` past it at a time `t` from now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Passage {
    /// How far past it is now, were it to move with that speed all the time, m.
    pub lead_m: f64,
    /// Speed behind the place, m/s.
    pub speed_mps: f64,
}

/// What a vehicle is to keep from a partner at a place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spacing {
    /// Reaction time phi, s.
    pub reaction_s: f64,
    /// Standstill gap delta, m.
    pub gap_m: f64,
    /// Distance added so that what remains of the plan's error need not be braked for, m;
    pub buffer_m: f64,
    /// in proportion to the time to go below this one, s.
    pub buffer_s: f64,
}

impl Passage {
    /// Whether a vehicle that passes with a speed after a time does so in the spacing.
    #[inline]
    pub fn is_kept_by(&self, v_mps: f64, time_s: f64, spacing: &Spacing) -> bool {
        self.lead_m + self.speed_mps * time_s >= spacing.kept_m(v_mps, time_s)
    }
}

impl Spacing {
    /// What it is for a vehicle that passes with a speed after a time, m.
    #[inline]
    pub fn kept_m(&self, v_mps: f64, time_s: f64) -> f64 {
        let share = if time_s < self.buffer_s { time_s / self.buffer_s } else { 1.0 };
        self.reaction_s * v_mps + self.gap_m + self.buffer_m * share
    }
}

/// First acceleration of the plan that covers `distance_m` in `time_s`, m/s^2.
#[inline]
pub fn acceleration_mps2(distance_m: f64, v_mps: f64, time_s: f64) -> f64 {
    3.0 * (distance_m - v_mps * time_s) / (time_s * time_s)
}

/// Last speed of that plan, m/s; negative when it would have to reverse.
#[inline]
pub fn final_speed_mps(distance_m: f64, v_mps: f64, time_s: f64) -> f64 {
    1.5 * distance_m / time_s - 0.5 * v_mps
}

/// First acceleration of the plan that ends with `final_mps` instead of without acceleration, m/s^2.
#[inline]
pub fn acceleration_to_mps2(distance_m: f64, v_mps: f64, time_s: f64, final_mps: f64) -> f64 {
    (6.0 * distance_m - (4.0 * v_mps + 2.0 * final_mps) * time_s) / (time_s * time_s)
}

/// First acceleration of the plan that ends standing after `distance_m > 0`, in the time that is best from rest, m/s^2.
pub fn acceleration_to_rest_mps2(beta: f64, distance_m: f64, v_mps: f64) -> f64 {
    // From rest to rest effort is 6 l^2 / T^3.
    let time_s = (distance_m * (18.0 / beta).sqrt()).sqrt();
    acceleration_to_mps2(distance_m, v_mps, time_s, 0.0)
}

/// The speed `w > 0` with `w^2 (w - alone) = worth`, m/s: `w` minimises the effort of ending with it instead of with
/// `alone_mps`, `2 (w - alone)^2 / T`, and what it costs those behind, `4 worth / (T w)`.
pub fn passing_speed_mps(alone_mps: f64, worth: f64) -> f64 {
    // Newton comes to the root of this convex function from above; nobody drives faster than where it begins.
    let mut w = alone_mps.max(0.0) + MUCH_FASTER_MPS;
    for _ in 0..24 {
        let excess = w * w * (w - alone_mps) - worth;
        let step = excess / (w * (3.0 * w - 2.0 * alone_mps));
        w -= step;
        if step.abs() <= 1e-6 * w {
            break;
        }
    }
    w
}

const MUCH_FASTER_MPS: f64 = 30.0;

/// Duration of the plan over `distance_m > 0` that minimises `beta T` and effort, s: the root of
/// `1.5 y^2 (l y - v)(3 l y - v) = beta` in `y = 1 / T >= v / l`, by Newton from `guess_s`, any positive number.
///
/// The left side is convex and rises there, so that Newton comes to the root from above after at most one step. With
/// `y = v / l + z` it is at least `4.5 l^2 z^4`, which bounds that step.
#[inline]
pub fn free_duration_s(beta: f64, v_mps: f64, distance_m: f64, guess_s: f64) -> f64 {
    let (l, v) = (distance_m, v_mps);
    let mut y = (1.0 / guess_s).max(v / l);
    for _ in 0..ROUNDS {
        let (p, q) = (l * y - v, 3.0 * l * y - v);
        let excess = 1.5 * y * y * p * q - beta;
        let slope = 1.5 * y * (2.0 * p * q + l * y * (q + 3.0 * p));
        let mut next = y - excess / slope;
        // From a guess that is much too late the step goes far beyond the root; at rest the slope vanishes with y.
        if next > y {
            next = next.min(v / l + (beta / (4.5 * l * l)).sqrt().sqrt());
        }
        // Each step squares what is missing.
        let is_found = (next - y).abs() <= 1e-7 * next;
        y = next;
        if is_found {
            break;
        }
    }
    1.0 / y
}

/// Whether a duration is below that of the optimum for `beta`, without working the latter out.
#[inline]
pub fn is_sooner_than_free(beta: f64, v_mps: f64, distance_m: f64, time_s: f64) -> bool {
    let (l, v) = (distance_m, v_mps);
    let y = 1.0 / time_s;
    time_s <= 0.0 || (l * y > v && 1.5 * y * y * (l * y - v) * (3.0 * l * y - v) > beta)
}

/// From any guess the root is found in fewer.
const ROUNDS: u32 = 96;

/// Least duration with which the vehicle, `distance_m` before a place, passes it in the spacing to a partner, s;
/// infinite when the partner would have to move first.
///
/// `lead + w T = phi max(0, 1.5 l / T - v / 2) + delta + buffer min(1, T / horizon)`.
#[inline]
pub fn duration_s(distance_m: f64, v_mps: f64, passage: &Passage, spacing: &Spacing) -> f64 {
    let Spacing { reaction_s, gap_m, buffer_m, buffer_s } = *spacing;
    let constant = 1.5 * reaction_s * distance_m;
    let lead_m = passage.lead_m + 0.5 * reaction_s * v_mps - gap_m;
    let far_s = positive_root(passage.speed_mps, lead_m - buffer_m, constant);
    let time_s = if far_s >= buffer_s {
        far_s
    } else {
        positive_root(passage.speed_mps - buffer_m / buffer_s, lead_m, constant).min(buffer_s)
    };
    if time_s * v_mps <= 3.0 * distance_m {
        return time_s.max(LEAST_S);
    }
    // It would arrive standing: nothing but the gap is left to keep.
    let after_s =
        |missing_m: f64, v_mps: f64| if missing_m <= 0.0 { 0.0 } else { missing_m / v_mps.max(0.0) };
    let missing_m = gap_m - passage.lead_m;
    let far_s = after_s(missing_m + buffer_m, passage.speed_mps);
    let there_s = if far_s >= buffer_s {
        far_s
    } else {
        after_s(missing_m, passage.speed_mps - buffer_m / buffer_s).min(buffer_s)
    };
    there_s.max(3.0 * distance_m / v_mps)
}

/// The positive root of `a t^2 + b t = c` for `c >= 0`; infinite when there is none.
#[inline]
fn positive_root(a: f64, b: f64, c: f64) -> f64 {
    let discriminant = b * b + 4.0 * a * c;
    if discriminant < 0.0 {
        return f64::INFINITY;
    }
    let root = discriminant.sqrt();
    // In the form that does not cancel.
    if b > 0.0 {
        2.0 * c / (b + root)
    } else if a > 0.0 {
        (root - b) / (2.0 * a)
    } else {
        f64::INFINITY
    }
}

/// How a partner `ahead_m` before a place (negative: past it) passes it, when it is to be at `exit_m` beyond it
/// (negative: before it) after `exit_s` with `exit_mps`; without a plan, `None`, it drives on as it does.
#[inline]
pub fn passage(ahead_m: f64, v_mps: f64, exit: Option<Exit>) -> Passage {
    let drives_on = Passage { lead_m: -ahead_m, speed_mps: v_mps };
    let Some(exit) = exit.filter(|exit| ahead_m > 0.0 && exit.after_s > LEAST_S) else { return drives_on };
    let Exit { beyond_m, after_s, speed_mps } = exit;
    if beyond_m <= 0.0 {
        return Passage { lead_m: beyond_m - speed_mps * after_s, speed_mps };
    }
    // On its way it follows the cubic between what it does and what it plans.
    let (t, total_m) = (after_s, ahead_m + beyond_m);
    let excess = total_m - v_mps * t;
    let dv = speed_mps - v_mps;
    let a = 6.0 * dv / (t * t) - 12.0 * excess / (t * t * t);
    let b = 6.0 * excess / (t * t) - 2.0 * dv / t;
    let position = |t: f64| ((a / 6.0 * t + 0.5 * b) * t + v_mps) * t;
    let (mut low, mut high) = (0.0, t);
    for _ in 0..PASSAGE_HALVINGS {
        let middle = 0.5 * (low + high);
        if position(middle) < ahead_m {
            low = middle;
        } else {
            high = middle;
        }
    }
    let speed_mps = ((0.5 * a * high + b) * high + v_mps).max(0.0);
    Passage { lead_m: -speed_mps * high, speed_mps }
}

/// Instants of passages are found to some microseconds.
const PASSAGE_HALVINGS: u32 = 24;

/// A partner's broadcast exit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exit {
    /// How far beyond the place it is, m.
    pub beyond_m: f64,
    /// Time until then, s.
    pub after_s: f64,
    /// Speed then, m/s.
    pub speed_mps: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::reference::{Problem, Terminal};
    use crate::scenario::ReferenceLaw;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, ..ProptestConfig::default() })]

        #[test]
        fn the_free_duration_is_the_optimum_from_any_guess(
            beta in 0.05..20.0f64, v in prop_oneof![Just(0.0), 0.0..40.0f64], l in 0.01..800.0f64,
            guess in prop_oneof![1e-3..1e-1f64, 0.1..100.0f64, 1e2..1e4f64],
        ) {
            let problem = Problem { beta, v0_mps: v, length_m: l, terminal: Terminal::Free };
            let best = problem.solve_forward(ReferenceLaw::Corrected);
            let found = free_duration_s(beta, v, l, guess);
            prop_assert!((found - best.duration_s).abs() <= 1e-9 * best.duration_s, "{} {}", found, best.duration_s);
            prop_assert!((acceleration_mps2(l, v, found) - best.b).abs() <= 1e-6);
            prop_assert!(is_sooner_than_free(beta, v, l, (1.0 - 1e-9) * found));
            prop_assert!(!is_sooner_than_free(beta, v, l, (1.0 + 1e-9) * found));
            prop_assert!(is_sooner_than_free(beta, v, l, 0.0));
        }

        #[test]
        fn a_slot_is_the_first_instant_at_which_the_spacing_is_kept(
            l in 0.1..300.0f64, v in 0.0..30.0f64, lead in -300.0..60.0f64, w in 0.0..30.0f64,
            reaction_s in 0.0..2.5f64, gap_m in 0.0..12.0f64,
        ) {
            let spacing = Spacing { reaction_s, gap_m, buffer_m: 0.3, buffer_s: 3.0 };
            let passage = Passage { lead_m: lead, speed_mps: w };
            let spare = |t: f64| {
                let kept = reaction_s * final_speed_mps(l, v, t).max(0.0) + gap_m + 0.3 * (t / 3.0).min(1.0);
                lead + w * t - kept
            };
            let t = duration_s(l, v, &passage, &spacing);
            if t.is_infinite() {
                prop_assert!(spare(1e9) < 1e-3 * 1e9, "{}", spare(1e9));
                prop_assert!(w < 0.101 || spare(1e9) < 0.0);
            } else if t > 2.0 * LEAST_S && t * w < 1e6 {
                let scale = 1.0 + lead.abs() + w * t + reaction_s * l / t;
                let stands = v > 0.0 && (t - 3.0 * l / v).abs() < 1e-9 * t;
                prop_assert!(spare(t) >= -1e-9 * scale, "{} at {}", spare(t), t);
                prop_assert!(stands || spare(0.999 * t) <= 1e-9 * scale || w < 0.11, "{} before {}", spare(0.999 * t), t);
            }
        }

        #[test]
        fn a_partner_that_keeps_its_plan_passes_as_foretold(
            v in 0.5..25.0f64, total in 5.0..300.0f64, share in 0.01..0.99f64, stretch in 0.75..1.6f64,
        ) {
            // A plan that ends without acceleration, and does not reverse.
            let t = stretch * total / v;
            let end = final_speed_mps(total, v, t);
            prop_assume!(end > 0.1);
            let u = acceleration_mps2(total, v, t);
            let there = share * total;
            let exit = Exit { beyond_m: total - there, after_s: t, speed_mps: end };
            let Passage { lead_m, speed_mps } = passage(there, v, Some(exit));
            let at = -lead_m / speed_mps;
            let position = ((-u / t / 6.0 * at + 0.5 * u) * at + v) * at;
            prop_assert!((position - there).abs() < 1e-3, "{} {}", position, there);
            prop_assert!((v + u * at - 0.5 * u / t * at * at - speed_mps).abs() < 1e-3);
        }
    }

    #[test]
    fn passing_faster_is_worth_it_up_to_where_effort_and_time_balance() {
        for (alone, worth) in [(-5.0, 3.0), (0.0, 8.0), (2.0, 30.0), (12.0, 0.5), (1.0, 900.0), (0.5, 1e-4)] {
            let w = passing_speed_mps(alone, worth);
            assert!((w * w * (w - alone) - worth).abs() <= 1e-4 * (1.0 + worth), "{alone} {worth}: {w}");
            // Against the costs themselves, over a plan of 10 s.
            let cost = |w: f64| 2.0 * (w - alone) * (w - alone) / 10.0 + 4.0 * worth / (10.0 * w);
            assert!(cost(w) <= cost(0.98 * w) && cost(w) <= cost(1.02 * w), "{alone} {worth}: {w}");
            // The effort is what the plans' accelerations say.
            let (l, v, t) = (60.0, 8.0, 10.0);
            let effort = |w: f64| {
                let first = acceleration_to_mps2(l, v, t, w);
                let last = 2.0 * (w - v) / t - first;
                t * (first * first + first * last + last * last) / 6.0
            };
            let end = final_speed_mps(l, v, t);
            assert!((effort(end + 1.5) - effort(end) - 2.0 * 1.5 * 1.5 / t).abs() < 1e-9);
            assert!((acceleration_to_mps2(l, v, t, end) - acceleration_mps2(l, v, t)).abs() < 1e-12);
        }
    }

    #[test]
    fn who_is_past_the_place_or_has_no_plan_drives_on() {
        let exit = Exit { beyond_m: 10.0, after_s: 1.0, speed_mps: 20.0 };
        assert_eq!(passage(-5.0, 8.0, Some(exit)), Passage { lead_m: 5.0, speed_mps: 8.0 });
        assert_eq!(passage(5.0, 8.0, None), Passage { lead_m: -5.0, speed_mps: 8.0 });
        // An exit before the place: from there on as fast as it left.
        let before = Exit { beyond_m: -10.0, after_s: 2.0, speed_mps: 5.0 };
        assert_eq!(passage(30.0, 8.0, Some(before)), Passage { lead_m: -20.0, speed_mps: 5.0 });
    }
}
