//! Kernels of the hot path, for developers: `cargo bench --bench kernels`.
//!
//! What a user decides by is measured by `cz bench`, with real processes.

use control_zones::control::qp::{self, Tracking};
use control_zones::control::reference::{Problem, Terminal};
use control_zones::control::rows::{Interval, Row, Rows};
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{ReferenceLaw, encode, load_embedded};
use control_zones::vehicle::{Held, Pair, RearEnd};
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;
use std::sync::Arc;

fn plan(c: &mut Criterion) {
    let problem = Problem { beta: 2.0 / 3.0, v0_mps: 15.0, length_m: 200.0, terminal: Terminal::Speed(15.0) };
    let nudged = Problem { terminal: Terminal::Speed(15.5), ..problem };
    c.bench_function("plan/solve", |b| b.iter(|| black_box(&problem).solve(ReferenceLaw::Corrected)));
    let old = problem.solve(ReferenceLaw::Corrected);
    c.bench_function("plan/perturb", |b| {
        b.iter(|| black_box(&nudged).perturb(ReferenceLaw::Corrected, &old, problem.terminal));
    });
    c.bench_function("plan/as_printed", |b| b.iter(|| black_box(&problem).solve(ReferenceLaw::AsPrinted)));
}

fn rows(c: &mut Criterion) {
    let rear_end = RearEnd { reaction_s: 1.8, gap_m: 0.0, k_per_s: 1.0, u_min_mps2: -4.0 };
    let pair = Pair { x_m: 50.0, v_mps: 15.0, partner_x_m: 80.0, partner_v_mps: 14.0, partner_u_mps2: 0.3 };
    c.bench_function("rows/rear_end", |b| {
        b.iter(|| {
            let pair = black_box(&pair);
            let mut interval = Interval::limits(-4.0, 4.0);
            interval.at_most(rear_end.row(pair), Row::RearEnd);
            interval.at_most(rear_end.feasibility_row(pair), Row::RearEndFeasibility);
            interval
        });
    });
    let tracking =
        Tracking { u_ref_mps2: 0.4, error_mps: -0.8, clf_rate_per_s: 10.0, slack_weight: 2.0 / 3.0 };
    let interval = Interval::limits(-4.0, 4.0);
    c.bench_function("qp/closed_form", |b| {
        b.iter(|| qp::solve(black_box(&tracking), black_box(&interval)));
    });
}

fn motion(c: &mut Criterion) {
    let own = Held::new(50.0, 15.0, -1.0);
    let leader = Held::new(80.0, 14.0, 0.5);
    c.bench_function("motion/least_margin", |b| {
        b.iter(|| black_box(&own).least_margin_m(black_box(&leader), 0.0, 1.8, 0.0, 0.1));
    });
    c.bench_function("motion/crossing", |b| b.iter(|| black_box(&own).passes_m(51.0, 0.1)));
}

fn run(c: &mut Criterion) {
    let scenario = Arc::new(load_embedded("paper", &[], Some(1)).expect("the scenario is embedded"));
    c.bench_function("run/paper, all roles in one process", |b| {
        b.iter(|| InProcess::new(&scenario, 1, 1).run().expect("the embedded scenario runs to its end"));
    });
    c.bench_function("encode/scenario", |b| b.iter(|| encode(black_box(&scenario))));
}

criterion_group!(kernels, plan, rows, motion, run);
criterion_main!(kernels);
