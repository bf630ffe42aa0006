//! The mathematics of schedules: costs against numerical differentiation and minimisation, pooling against brute force,
//! Clarabel and the optimality conditions.

mod runs;

use clarabel::algebra::CscMatrix;
use clarabel::solver::{DefaultSettingsBuilder, DefaultSolver, IPSolver, NonnegativeConeT, SolverStatus};
use control_zones::coordination::schedule::cost::{Convex, Cost, Single, Slope, Tandem};
use control_zones::coordination::schedule::pooling::{Headway, Pooling, Program, best_s, is_chain};
use proptest::prelude::*;

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

fn singles() -> impl Strategy<Value = Single> {
    let beta = prop_oneof![Just(2.0 / 3.0), 0.1..10.0f64];
    let v_mps = prop_oneof![1 => Just(0.0), 8 => 0.1..30.0f64];
    (beta, 0.5..400.0f64, v_mps).prop_map(|(beta, left_m, v_mps)| Single { beta, left_m, v_mps })
}

fn tandems() -> impl Strategy<Value = Tandem> {
    let betas = (0.1..4.0f64, 0.1..4.0f64);
    (betas, 0.3..1.0f64, 5.0..300.0f64, 50.0..300.0f64, 5.0..25.0f64).prop_map(
        |((first_beta, second_beta), weight, first_m, second_m, v_mps)| Tandem {
            first_beta,
            second_beta,
            weight,
            first_m,
            second_m,
            v_mps,
        },
    )
}

/// Instants at which a vehicle could leave both zones, at plausible speeds.
fn instants(t: &Tandem, slow: (f64, f64)) -> (f64, f64) {
    let t1 = t.first_m / t.v_mps * slow.0;
    (t1, t1 + t.second_m / t.v_mps * slow.1)
}

/// Least `sum of w u^2 dt / 2` over accelerations held for one of `2 n` intervals each, that covers the ways in the times:
/// two linear conditions, so two multipliers.
fn least_energy(t: &Tandem, t1: f64, t2: f64, n: usize) -> f64 {
    let steps = (0..2 * n).map(|k| {
        let (start, dt) = if k < n {
            (t1 * k as f64 / n as f64, t1 / n as f64)
        } else {
            (t1 + (t2 - t1) * (k - n) as f64 / n as f64, (t2 - t1) / n as f64)
        };
        let weight = if k < n { 1.0 } else { t.weight };
        // What one unit of acceleration adds to the way until then.
        let reach = |end: f64| if start < end { dt * (end - start - 0.5 * dt) } else { 0.0 };
        (weight * dt, [reach(t1), reach(t2)])
    });
    let mut gram = [[0.0; 2]; 2];
    for (weight, reach) in steps {
        for (i, row) in gram.iter_mut().enumerate() {
            for (j, entry) in row.iter_mut().enumerate() {
                *entry += reach[i] * reach[j] / weight;
            }
        }
    }
    let wanted = [t.first_m - t.v_mps * t1, t.first_m + t.second_m - t.v_mps * t2];
    let det = gram[0][0] * gram[1][1] - gram[0][1] * gram[1][0];
    let multipliers = [
        (wanted[0] * gram[1][1] - wanted[1] * gram[0][1]) / det,
        (wanted[1] * gram[0][0] - wanted[0] * gram[1][0]) / det,
    ];
    0.5 * (multipliers[0] * wanted[0] + multipliers[1] * wanted[1])
}

proptest! {
    #![proptest_config(cases(2_000))]

    /// The slope of a passage's cost is its derivative and rises, and its bracket has the optimum.
    #[test]
    fn slopes_of_single_costs_are_derivatives_and_rise(single in singles(), at in 0.3..3.0f64) {
        let cost = Cost::Single(single);
        let (low, high) = cost.bracket_s();
        prop_assert!(cost.slope(low).value <= 0.0 && cost.slope(high).value >= -1e-9 * single.beta);
        let t = at * high;
        let h = 1e-5 * t;
        let numerical = (cost.value(t + h) - cost.value(t - h)) / (2.0 * h);
        let slope = cost.slope(t).value;
        let scale = slope.abs().max(single.beta).max(cost.value(t) / t);
        prop_assert!((numerical - slope).abs() < 1e-5 * scale, "{numerical} {slope}");
        prop_assert!(cost.slope(1.01 * t).value >= slope - 1e-12 * scale);
        if !(0.9..=1.1).contains(&at) {
            rises(|t| cost.slope(t), t)?;
        }
    }

    /// The closed form of F over two zones is the least control energy, found numerically, plus time; its slopes are its
    /// derivatives.
    #[test]
    fn tandem_costs_are_least_energies_and_slopes_their_derivatives(
        tandem in tandems(),
        slow in (0.6..1.6f64, 0.6..1.6f64),
    ) {
        let (t1, t2) = instants(&tandem, slow);
        let time = tandem.first_beta * t1 + tandem.second_beta * t2;
        let energy = tandem.value(t1, t2) - time;
        let numerical = least_energy(&tandem, t1, t2, 400);
        prop_assert!((energy - numerical).abs() < 1e-3 * numerical.max(0.01), "{energy} {numerical}");
        let (h1, h2) = (1e-5 * t1, 1e-5 * (t2 - t1));
        let first = (tandem.value(t1 + h1, t2) - tandem.value(t1 - h1, t2)) / (2.0 * h1);
        let second = (tandem.value(t1, t2 + h2) - tandem.value(t1, t2 - h2)) / (2.0 * h2);
        let scale = tandem.value(t1, t2) / t1.min(t2 - t1);
        prop_assert!((first - tandem.slope_first(t1, t2).value).abs() < 1e-4 * scale);
        prop_assert!((second - tandem.slope_second(t1, t2).value).abs() < 1e-4 * scale);
        rises(|t| tandem.slope_first(t, t2), t1)?;
        rises(|t| tandem.slope_second(t1, t), t2)?;
    }

    /// The motion over two zones covers both ways, and with weight 1 and free instants it is that over one way.
    #[test]
    fn tandem_motion_covers_both_ways(tandem in tandems(), slow in (0.6..1.6f64, 0.6..1.6f64)) {
        let (t1, t2) = instants(&tandem, slow);
        let m = tandem.motion(t1, t2);
        let way = |v: f64, from: f64, to: f64, t: f64| v * t + from * t * t / 3.0 + to * t * t / 6.0;
        prop_assert!((way(tandem.v_mps, m.u0_mps2, m.u1_mps2, t1) - tandem.first_m).abs() < 1e-9 * tandem.first_m);
        let second = way(m.v1_mps, m.u1_mps2 / tandem.weight, 0.0, t2 - t1);
        prop_assert!((second - tandem.second_m).abs() < 1e-9 * tandem.second_m);
        let whole = Single { beta: tandem.second_beta, left_m: tandem.first_m + tandem.second_m, v_mps: tandem.v_mps };
        let least = optimum(&Cost::Single(whole));
        let free = Tandem { weight: 1.0, first_beta: 0.0, ..tandem };
        prop_assert!(free.value(t1, t2) >= Cost::Single(whole).value(least) - 1e-9);
    }
}

/// What a slope says of its own slope is so.
fn rises(slope: impl Fn(f64) -> Slope, t: f64) -> Result<(), TestCaseError> {
    let step = 1e-5 * t;
    let (before, at, after) = (slope(t - step), slope(t), slope(t + step));
    let numerical = (after.value - before.value) / (2.0 * step);
    let scale = numerical.abs().max(at.value.abs() / t);
    prop_assert!((numerical - at.rise).abs() < 1e-3 * scale, "{numerical} {at:?}");
    Ok(())
}

fn alone_s<C: Convex>(costs: &[C]) -> Vec<f64> {
    costs.iter().map(best_s).collect()
}

fn optimum<C: Convex + Clone>(cost: &C) -> f64 {
    let mut times = Vec::new();
    let (costs, alone_s) = (std::slice::from_ref(cost), &[best_s(cost)]);
    Pooling::default().minimise(&Program { costs, alone_s, earliest_s: &[0.0], headways: &[] }, &mut times);
    times[0]
}

/// `w (t - d)^2 / 2`.
#[derive(Clone, Debug)]
struct Quadratic {
    weight: f64,
    best: f64,
}

impl Convex for Quadratic {
    fn slope(&self, t: f64) -> Slope {
        Slope { value: self.weight * (t - self.best), rise: self.weight }
    }

    fn bracket_s(&self) -> (f64, f64) {
        (self.best - 1.0, self.best + 1.0)
    }
}

/// Some headways between vehicles in order, sorted by who passes later.
fn headways(count: usize, dense: f64) -> impl Strategy<Value = Vec<Headway>> {
    let pairs: Vec<(u32, u32)> = (0..count as u32).flat_map(|b| (0..b).map(move |a| (a, b))).collect();
    prop::collection::vec((0.0..1.0f64, -1.0..4.0f64), pairs.len()).prop_map(move |drawn| {
        let chosen = pairs.iter().zip(drawn).filter(|(_, (chance, _))| *chance < dense);
        chosen.map(|(&(before, after), (_, headway_s))| Headway { before, after, headway_s }).collect()
    })
}

fn chain(headways: &[f64]) -> Vec<Headway> {
    (0..).zip(headways).map(|(i, &headway_s)| Headway { before: i, after: i + 1, headway_s }).collect()
}

/// The least of `sum of w (t - d)^2 / 2` under the headways and bounds, by Clarabel; none where it gives up, which it does
/// about once in five thousand.
fn by_clarabel(costs: &[Quadratic], earliest: &[f64], headways: &[Headway]) -> Option<Vec<f64>> {
    let n = costs.len();
    let mut rows: Vec<(Vec<(usize, f64)>, f64)> = headways
        .iter()
        .map(|h| (vec![(h.before as usize, 1.0), (h.after as usize, -1.0)], -h.headway_s))
        .collect();
    rows.extend(earliest.iter().enumerate().map(|(i, &e)| (vec![(i, -1.0)], -e)));
    let (mut is, mut js, mut vs) = (Vec::new(), Vec::new(), Vec::new());
    for (i, (row, _)) in rows.iter().enumerate() {
        for &(j, v) in row {
            is.push(i);
            js.push(j);
            vs.push(v);
        }
    }
    let a = CscMatrix::new_from_triplets(rows.len(), n, is, js, vs);
    let p = CscMatrix::new_from_triplets(
        n,
        n,
        (0..n).collect(),
        (0..n).collect(),
        costs.iter().map(|c| c.weight).collect(),
    );
    let q: Vec<f64> = costs.iter().map(|c| -c.weight * c.best).collect();
    let b: Vec<f64> = rows.iter().map(|(_, b)| *b).collect();
    let settings = DefaultSettingsBuilder::default().verbose(false).build().unwrap();
    let mut solver = DefaultSolver::new(&p, &q, &a, &b, &[NonnegativeConeT(rows.len())], settings).unwrap();
    solver.solve();
    let is_solved = matches!(solver.solution.status, SolverStatus::Solved | SolverStatus::AlmostSolved);
    is_solved.then(|| solver.solution.x.clone())
}

/// Whether times keep headways and bounds, to rounding.
fn keeps(times: &[f64], earliest: &[f64], headways: &[Headway]) -> bool {
    headways.iter().all(|h| times[h.after as usize] >= times[h.before as usize] + h.headway_s - 1e-9)
        && times.iter().zip(earliest).all(|(t, e)| *t >= e - 1e-9)
}

proptest! {
    #![proptest_config(cases(1_500))]

    /// Quadratic costs, any headways: what Clarabel finds.
    #[test]
    fn pooling_finds_what_clarabel_finds(
        (drawn, headways) in (2..9usize).prop_flat_map(|n| (
            prop::collection::vec((0.2..5.0f64, 0.0..12.0f64, 0.0..8.0f64), n),
            prop_oneof![headways(n, 0.3), headways(n, 0.8)],
        )),
    ) {
        let costs: Vec<Quadratic> = drawn.iter().map(|&(weight, best, _)| Quadratic { weight, best }).collect();
        let earliest: Vec<f64> = drawn.iter().map(|d| d.2).collect();
        let mut times = Vec::new();
        let program =
            Program { costs: &costs, alone_s: &alone_s(&costs), earliest_s: &earliest, headways: &headways };
        Pooling::default().minimise(&program, &mut times);
        prop_assert!(keeps(&times, &earliest, &headways), "{times:?}");
        let value = |times: &[f64]| -> f64 {
            times.iter().zip(&costs).map(|(t, c)| 0.5 * c.weight * (t - c.best) * (t - c.best)).sum()
        };
        let theirs = by_clarabel(&costs, &earliest, &headways);
        prop_assume!(theirs.is_some());
        let theirs = theirs.unwrap_or_default();
        let apart = (value(&times) - value(&theirs)).abs();
        prop_assert!(apart <= 1e-5 * (1.0 + value(&theirs)), "{times:?} {theirs:?}");
    }

    /// Begun from the blocks of another program of the same vehicles, it comes to the same.
    #[test]
    fn pooling_again_finds_the_same(
        (drawn, headways) in (2..9usize).prop_flat_map(|n| (
            prop::collection::vec((singles(), 0.0..12.0f64), n),
            prop_oneof![headways(n, 0.3), prop::collection::vec(0.2..4.0f64, n - 1).prop_map(|gaps| chain(&gaps))],
        )),
        others in prop::collection::vec(-1.0..1.0f64, 36),
    ) {
        let costs: Vec<Cost> = drawn.iter().map(|(single, _)| Cost::Single(*single)).collect();
        let earliest: Vec<f64> = drawn.iter().map(|(_, earliest)| *earliest).collect();
        let alone = alone_s(&costs);
        let mut pooling = Pooling::default();
        let (mut times, mut again) = (Vec::new(), Vec::new());
        let changed: Vec<Headway> =
            headways.iter().zip(&others).map(|(h, &by)| Headway { headway_s: h.headway_s + by, ..*h }).collect();
        let program = Program { costs: &costs, alone_s: &alone, earliest_s: &earliest, headways: &headways };
        pooling.minimise(&Program { headways: &changed, ..program }, &mut again);
        pooling.minimise_again(&program, &mut again);
        pooling.minimise(&program, &mut times);
        prop_assert!(keeps(&again, &earliest, &headways), "{again:?}");
        let value = |times: &[f64]| times.iter().zip(&costs).map(|(t, c)| c.value(*t)).sum::<f64>();
        let (cold, warm) = (value(&times), value(&again));
        prop_assert!((cold - warm).abs() <= 1e-9 * cold.abs(), "{headways:?}: {times:?} {again:?}");
    }

    /// A chain of vehicles on their ways (T4): optimality conditions, which for convex costs suffice. The multiplier of
    /// each headway is what the slopes behind it sum up to.
    #[test]
    fn pooling_of_a_chain_is_exact(
        vehicles in prop::collection::vec((singles(), 0.2..4.0f64), 1..15),
        held_s in 0.0..20.0f64,
    ) {
        let costs: Vec<Cost> = vehicles.iter().map(|(single, _)| Cost::Single(*single)).collect();
        let gaps: Vec<f64> = vehicles.iter().map(|(_, gap)| *gap).collect();
        let headways = chain(&gaps[1..]);
        prop_assert!(is_chain(&headways));
        let mut earliest = vec![0.0; costs.len()];
        earliest[0] = held_s;
        let mut times = Vec::new();
        let program =
            Program { costs: &costs, alone_s: &alone_s(&costs), earliest_s: &earliest, headways: &headways };
        Pooling::default().minimise(&program, &mut times);
        prop_assert!(keeps(&times, &earliest, &headways));
        let mut behind = 0.0;
        for i in (0..costs.len()).rev() {
            let slope = costs[i].slope(times[i]).value;
            behind += slope;
            let scale = 1e-6 * (1.0 + slope.abs());
            let slack = if i > 0 { times[i] - times[i - 1] - gaps[i] } else { times[0] - held_s };
            prop_assert!(behind >= -scale, "vehicle {i}: {behind}");
            prop_assert!(slack < 1e-7 || behind.abs() < scale, "vehicle {i}: {behind}, slack {slack}");
            if slack >= 1e-7 {
                behind = 0.0;
            }
        }
    }
}

proptest! {
    #![proptest_config(cases(60))]

    /// Three vehicles, any headways: nothing on a fine grid is cheaper.
    #[test]
    fn nothing_on_a_grid_is_cheaper_than_pooling(
        vehicles in prop::collection::vec(singles(), 3),
        gaps in headways(3, 0.8),
    ) {
        let costs: Vec<Cost> = vehicles.iter().map(|single| Cost::Single(*single)).collect();
        let mut times = Vec::new();
        let program =
            Program { costs: &costs, alone_s: &alone_s(&costs), earliest_s: &[0.0; 3], headways: &gaps };
        Pooling::default().minimise(&program, &mut times);
        prop_assert!(keeps(&times, &[0.0; 3], &gaps));
        let value = |times: &[f64]| times.iter().zip(&costs).map(|(t, c)| c.value(*t)).sum::<f64>();
        let own = value(&times);
        let last = times.iter().fold(0.0f64, |a, b| a.max(*b)) + 8.0;
        let grid: Vec<f64> = (1..=110).map(|k| last * f64::from(k) / 110.0).collect();
        for &a in &grid {
            for &b in &grid {
                for &c in &grid {
                    let tried = [a, b, c];
                    if keeps(&tried, &[0.0; 3], &gaps) {
                        prop_assert!(own <= value(&tried) + 1e-9 * own.abs(), "{times:?} {tried:?}");
                    }
                }
            }
        }
    }
}
