//! The reproduction: determinism, verdicts, errata, statistics, and the map from equations to code.

use control_zones::reproduce::claims::{Expectation, Verdict, judge};
use control_zones::reproduce::equations::{EQUATIONS, backward, forward};
use control_zones::reproduce::errata::TOPICS;
use control_zones::reproduce::grid::{Entry, Grid};
use control_zones::reproduce::optimality::{BOUND_PERCENT, checks};
use control_zones::reproduce::paper::{COMPARISON, VARYING, alpha_of, beta_of};
use control_zones::reproduce::statistics::{Interval, Quadratic, slope, student_975};
use control_zones::reproduce::{LABELS, Only, Options, Report, ReproduceError, run};
use std::collections::BTreeSet;

fn reproduce(only: &[&str], jobs: usize) -> Report {
    let only = only.iter().map(|w| w.parse().expect("a known part")).collect();
    run(&Options { seeds: 2, only, jobs }, &mut |_, _| {}).expect("the reproduction runs")
}

#[test]
fn json_is_the_same_for_any_number_of_jobs_and_from_run_to_run() {
    let parts = ["fig:diff_v", "tab:fem_time", "tab:feedback1", "fig:rate", "tab:feedback", "errata"];
    let one = reproduce(&parts, 1).json();
    for jobs in [2, 3] {
        assert!(one == reproduce(&parts, jobs).json(), "{jobs} jobs");
    }
    let value: serde_json::Value = serde_json::from_str(&one).expect("valid JSON");
    assert_eq!(value["format"], "cz.reproduce.v1");
    assert_eq!(value["claims"].as_array().map(Vec::len), Some(15));
    for word in ["wall", "date", "jobs"] {
        assert!(!one.contains(&format!("\"{word}")), "{word} in the JSON");
    }
}

#[test]
fn written_files_are_complete_and_figures_carry_text() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let report = reproduce(&["fig:diff_v", "fig:rate"], 2);
    report.write(dir.path()).expect("the report can be written");
    let read = |name: &str| std::fs::read(dir.path().join(name)).expect(name);
    assert_eq!(read("report.json"), report.json().as_bytes());
    let text = String::from_utf8(read("report.md")).expect("UTF-8");
    let figures = report.figures();
    assert_eq!(figures.len(), 7);
    for (name, _) in figures {
        assert!(text.contains(&format!("(figures/{name}.svg)")), "{name}");
        let svg = String::from_utf8(read(&format!("figures/{name}.svg"))).expect("UTF-8");
        assert!(svg.contains("(m/s)") || svg.contains("(s)"), "axis with a unit in {name}");
        assert!(svg.contains("no flow control"), "legend in {name}");
        assert!(read(&format!("figures/{name}.png")).starts_with(b"\x89PNG"));
    }
}

#[test]
fn every_policy_meets_the_same_arrivals() {
    // The number of vehicles of each zone is the demand's: all policies of a replicate must agree.
    use control_zones::reproduce::experiment::{Demand, FIXED, Policy, Setting, Traffic};
    use control_zones::reproduce::runs::Runs;
    let mut runs = Runs::new(2);
    for demand in Demand::ALL {
        for traffic in [Traffic::Constant, Traffic::Varying] {
            let setting = Setting::new(demand, vec![]).with_second(18.5);
            let replicate = setting.replicate(1);
            let all = [Policy::None, FIXED, Policy::Feedback].map(|p| replicate.run(traffic, p));
            runs.perform(all.clone(), &mut |_, _| {}).expect("the runs succeed");
            let vehicles = all.map(|r| {
                assert!(runs.outcome(&r).complete);
                runs.outcome(&r).zones.iter().map(|z| z.vehicles).collect::<Vec<_>>()
            });
            assert!(vehicles.iter().all(|v| *v == vehicles[0]), "{demand:?} {traffic:?} {vehicles:?}");
        }
    }
}

#[test]
fn the_second_zone_ends_at_its_mean_exit_speed_without_flow_control() {
    use control_zones::reproduce::experiment::{Demand, FIXED, Policy, Setting, Traffic};
    use control_zones::reproduce::runs::Runs;
    let mut runs = Runs::new(2);
    let settings = vec![
        Setting::new(Demand::Seeded, vec![]),
        Setting::new(Demand::Seeded, vec!["objective={ beta = 0.3 }".to_owned()]),
        Setting::new(Demand::Seeded, vec![]).with_second(18.5),
    ];
    let settled = Setting::settle(settings, &[Traffic::Constant], 3, &mut runs, &mut |_, _| {});
    let settled = settled.expect("the runs succeed");
    for setting in &settled[..2] {
        let of = |seed| {
            let run = setting.replicate(seed).run(Traffic::Constant, Policy::None);
            runs.outcome(&run).exit_speeds_mps[1]
        };
        let mean = (1..=3).map(of).sum::<f64>() / 3.0;
        let second = setting.second_mps[0].expect("measured");
        assert!((second - mean).abs() <= 0.05 + 1e-9, "{second} {mean}");
        let run = setting.replicate(2).run(Traffic::Constant, FIXED);
        let flow = format!("zones.merge-2.flow={{ policy = \"fixed\", terminal_mps = {second:?} }}");
        assert!(run.sets.contains(&flow), "{:?}", run.sets);
        // Nobody asked for the other kind of traffic.
        assert_eq!(setting.second_mps[1], None);
    }
    // The rule follows the setting, and a given speed goes before it.
    assert!(settled[0].second_mps[0] > settled[1].second_mps[0], "{settled:?}");
    assert_eq!(settled[2].second_mps, [Some(18.5); 2]);
}

#[test]
fn parts_are_named_and_unknown_ones_refused() {
    for word in Only::words() {
        word.parse::<Only>().expect(word);
    }
    let error = "tab:nothing".parse::<Only>().expect_err("an unknown part");
    assert!(error.to_string().contains("tab:fem_time"), "{error}");
    let options = Options { seeds: 1, only: vec![], jobs: 1 };
    assert!(matches!(run(&options, &mut |_, _| {}), Err(ReproduceError::TooFewSeeds(1))));
}

#[test]
fn student_quantiles_and_intervals_agree_with_tables() {
    for (degrees, quantile) in
        [(1, 12.706_205), (2, 4.302_653), (4, 2.776_445), (19, 2.093_024), (120, 1.979_930)]
    {
        assert!((student_975(degrees) - quantile).abs() < 2e-6, "{degrees}: {}", student_975(degrees));
    }
    // Mean 3, standard deviation sqrt(2.5), half width 2.776445 * sqrt(2.5 / 5).
    let i = Interval::of(&[1.0, 2.0, 3.0, 4.0, 5.0]).expect("five values");
    assert!((i.mean - 3.0).abs() < 1e-12 && (i.half_width() - 1.963_243).abs() < 1e-5, "{i:?}");
    assert_eq!(Interval::of(&[1.0]), None);
    assert_eq!(Interval::of(&[1.0, f64::NAN]), None);
}

#[test]
fn quadratic_fit_recovers_a_parabola() {
    let x: Vec<f64> = (0..17).map(|i| 12.0 + 0.5 * f64::from(i)).collect();
    let y: Vec<f64> = x.iter().map(|x| 28.0 + 0.3 * (x - 15.2) * (x - 15.2)).collect();
    let fit = Quadratic::fit(&x, &y).expect("a fit");
    assert!((fit.minimum().expect("a minimum") - 15.2).abs() < 1e-9);
    assert!((fit.r_squared - 1.0).abs() < 1e-12 && (fit.value(15.2) - 28.0).abs() < 1e-9);
    let hill: Vec<f64> = y.iter().map(|y| -y).collect();
    assert_eq!(Quadratic::fit(&x, &hill).expect("a fit").minimum(), None);
    assert!((slope(&[0.0, 1.0, 2.0], &[1.0, 3.0, 5.0]) - 2.0).abs() < 1e-12);
}

#[test]
fn verdicts_follow_from_intervals() {
    let at = |low: f64, high: f64| Some(Interval { mean: 0.5 * (low + high), low, high, n: 5 });
    let judged = |e, i: Option<Interval>| judge(e, i.as_ref());
    use Verdict::{DoesNotHold, Holds, HoldsInDirection, Undecided};
    let value = Expectation::Value { printed: 15.0, tolerance: 3.0 };
    assert_eq!(judged(value, at(13.0, 14.0)), Holds);
    assert_eq!(judged(value, at(9.0, 12.5)), Holds);
    assert_eq!(judged(value, at(2.0, 4.0)), HoldsInDirection);
    assert_eq!(judged(value, at(30.0, 40.0)), HoldsInDirection);
    assert_eq!(judged(value, at(-1.0, 20.0)), DoesNotHold);
    assert_eq!(judged(Expectation::Positive, at(0.1, 1.0)), Holds);
    assert_eq!(judged(Expectation::Positive, at(-0.1, 1.0)), HoldsInDirection);
    assert_eq!(judged(Expectation::Positive, at(-2.0, 1.0)), DoesNotHold);
    let zero = Expectation::Zero { tolerance: 2.0 };
    assert_eq!(judged(zero, at(-1.0, 1.9)), Holds);
    assert_eq!(judged(zero, at(-1.0, 3.0)), HoldsInDirection);
    assert_eq!(judged(zero, at(2.0, 4.0)), DoesNotHold);
    let near = Expectation::Location { printed: 15.0, tolerance: 1.0, low: 12.0, high: 20.0 };
    assert_eq!(judged(near, at(15.5, 16.5)), Holds);
    assert_eq!(judged(near, at(17.0, 18.0)), HoldsInDirection);
    assert_eq!(judged(near, at(19.0, 20.0)), DoesNotHold);
    assert_eq!(judged(Expectation::AtLeast(0.95), at(0.96, 1.0)), Holds);
    assert_eq!(judged(Expectation::AtLeast(0.95), at(0.9, 1.01)), HoldsInDirection);
    assert_eq!(judged(value, None), Undecided);
}

/// Numbers of a column of the first table whose columns include it.
fn column(grids: &[Grid], name: &str) -> Vec<f64> {
    let grid = grids.iter().find(|g| g.columns.iter().any(|c| c == name)).expect(name);
    let at = grid.columns.iter().position(|c| c == name).expect(name);
    let value = |row: &Vec<Entry>| match &row[at] {
        Entry::Number((value, _)) => *value,
        other => panic!("{name}: {other:?}"),
    };
    grid.rows.iter().map(value).collect()
}

#[test]
fn errata_show_what_they_say() {
    let report = reproduce(&["errata"], 2);
    assert_eq!(report.errata.len(), TOPICS.len());
    let evidence = |id: &str| &report.errata.iter().find(|e| e.id == id).expect(id).evidence;

    let lost = evidence("lost-square");
    let (brute, right) = (column(lost, "T brute force, s"), column(lost, "T corrected, s"));
    assert!(brute.iter().zip(&right).all(|(a, b)| (a - b).abs() < 1e-5));
    assert!(column(lost, "residual corrected").iter().all(|r| r.abs() < 1e-9));
    assert!(column(lost, "residual as printed").iter().any(|r| r.abs() > 0.05));
    let worst = |v: Vec<f64>| v.into_iter().fold(0.0, |a: f64, b| a.max(b.abs()));
    assert!((worst(column(lost, "error, %")) - 1.8).abs() < 0.4);
    // Only the corrected condition gives the same answer in feet.
    let feet = column(lost, "T corrected in feet, s");
    assert!(feet.iter().zip(&right).all(|(a, b)| (a - b).abs() < 1e-9));
    let (metres, feet) = (column(lost, "T as printed, s"), column(lost, "T as printed in feet, s"));
    assert!(feet.iter().zip(&metres).any(|(a, b)| (a - b).abs() > 0.05));

    let display = evidence("derivative-display");
    let (numerical, used) = (column(display, "numerical"), column(display, "equ:delta_t (6v0²)"));
    assert!(numerical.iter().zip(&used).all(|(a, b)| (a / b - 1.0).abs() < 1e-6));

    let phi2 = evidence("phi2");
    let (slack, rate) = (column(phi2, "row slack"), column(phi2, "ḃ2 + k2 b2 numerically"));
    assert!(slack.iter().zip(&rate).all(|(a, b)| (a - b).abs() < 1e-6));
}

#[test]
fn the_printed_tables_imply_what_the_errata_say() {
    for table in [&COMPARISON, &VARYING] {
        let expected = if table.alpha == 0.25 { 8.0 / 3.0 } else { 2.0 / 3.0 };
        for column in &table.columns {
            for cell in &column.zones {
                let (low, _, high) = cell.implied_beta();
                assert!(low <= expected && expected <= high, "{} {}", table.label, column.policy);
            }
        }
    }
    let (_, stated, _) = COMPARISON.columns[0].zones[0].implied_beta();
    assert!((stated - beta_of(0.0625)).abs() > 0.1);
    assert!((beta_of(0.0625) - 8.0 / 15.0).abs() < 1e-12 && (alpha_of(2.0 / 3.0) - 1.0 / 13.0).abs() < 1e-12);
    let off =
        |t: &control_zones::reproduce::paper::Performance| t.columns.map(|c| (c.excess() * 100.0).round());
    assert_eq!(off(&COMPARISON), [0.0, -1.0, -2.0]);
    assert_eq!(off(&VARYING), [0.0, 0.0, -10.0]);
}

#[test]
fn the_analytic_reference_is_optimal() {
    let checks = checks().expect("the transcription is solved");
    let (mut free, mut bound) = (0, 0);
    for c in &checks {
        if c.leader_binds() {
            // The constraint can only cost.
            assert!(c.transcription.1 > c.corrected.1 * (1.0 - 1e-4), "{c:?}");
            bound += 1;
        } else {
            assert!(c.excess_percent(c.corrected.1).abs() <= BOUND_PERCENT, "{c:?}");
            free += 1;
        }
    }
    assert!(free >= 26 && bound >= 3, "{free} {bound}");
}

/// Every `\label` of the paper.
const PAPER: [&str; 37] = [
    "fig:module_CZ",
    "modelF",
    "VehicleDynamics",
    "Safety",
    "SafeMerging",
    "VehicleConstraints",
    "equ:vm",
    "eqn:energyobja",
    "eqn:energyobj",
    "equ:upper",
    "fig:diagram",
    "equ:uc_u",
    "equ:uc_v",
    "equ:uc_x",
    "equ:ucp_vm_1",
    "equ:ucp_vm_2",
    "equ:ucp_vm_4",
    "equ:ucp_vm_5",
    "equ:cbf",
    "equ:clf",
    "equ:ocbf",
    "equ:ocbf_qp",
    "equ:candidate",
    "equ:candidate2",
    "sec:flow_control",
    "equ:feedback_control",
    "equ:ucp_shift_vm_1",
    "equ:ucp_shift_vm_4",
    "equ:tm",
    "equ:perturb_tm",
    "equ:delta_t",
    "equ:ucp_vm_tm",
    "fig:diff_v",
    "tab:fem_time",
    "tab:feedback1",
    "fig:rate",
    "tab:feedback",
];

#[test]
fn the_equation_map_is_complete_and_its_code_exists() {
    let mapped: Vec<&str> = EQUATIONS.iter().map(|m| m.label).collect();
    assert_eq!(mapped, PAPER);
    assert!(LABELS.iter().all(|l| PAPER.contains(l)));
    assert!(TOPICS.iter().flat_map(|t| t.labels).all(|l| PAPER.contains(l)));
    let source = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut codes = BTreeSet::new();
    for (file, item) in EQUATIONS.iter().flat_map(|m| m.code) {
        let text = std::fs::read_to_string(source.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"));
        let defined = ["fn ", "struct ", "enum ", "const ", "trait "].iter().any(|keyword| {
            let start = format!("{keyword}{item}");
            let ends =
                |at: usize| text[at + start.len()..].starts_with(|c: char| !c.is_alphanumeric() && c != '_');
            text.match_indices(&start).any(|(at, _)| ends(at))
        });
        assert!(defined, "{file} does not define {item}");
        codes.insert((file, item));
    }
    assert_eq!(forward().rows.len(), PAPER.len());
    assert_eq!(backward().rows.len(), codes.len());
}
