//! Comparisons of policies: the same arrivals, paired differences, groups, the cache, and bounds below everybody.

use control_zones::bounds::{Traffic, joint};
use control_zones::compare::cache::{Cache, bytes};
use control_zones::compare::cli::Seeds;
use control_zones::compare::report::{Block, FORMAT, Report};
use control_zones::compare::sample::Sample;
use control_zones::compare::{Comparison, Means, run, tables};
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{embedded_names, load};
use std::sync::Arc;

fn comparison(policies: &[&str], seeds: std::ops::RangeInclusive<u64>) -> Comparison {
    Comparison {
        policies: policies.iter().map(|p| (*p).to_owned()).collect(),
        scenario: Some("paper".to_owned()),
        seeds: seeds.collect(),
        sets: vec!["end.vehicles=24".to_owned()],
        joint: None,
    }
}

fn compare(comparison: &Comparison, jobs: usize, cache: Cache) -> Block {
    run(comparison, &Means { jobs, cache }, &mut |_, _, _| {}).unwrap()
}

fn value(block: &Block, policy: usize, measure: &str, replicate: usize) -> f64 {
    block.policies[policy].measures[measure].values[replicate].unwrap()
}

#[test]
fn a_report_is_the_same_for_any_number_of_jobs_and_from_the_cache() {
    let asked = comparison(&["paper-none", "paper-fixed-15", "paper-feedback"], 2..=4);
    let report = |block| Report { format: FORMAT, blocks: vec![block] };
    let once = report(compare(&asked, 1, Cache::none())).json();
    let dir = tempfile::tempdir().unwrap();
    let cache = || Cache::at(dir.path()).unwrap();
    assert!(once == report(compare(&asked, 2, cache())).json());
    let files = || {
        let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|f| f.unwrap().path()).collect();
        names.sort();
        names
    };
    let kept = files();
    let run =
        kept.iter().position(|f| f.file_name().is_some_and(|n| n.to_string_lossy().starts_with("run-")));
    let run = &kept[run.unwrap()];
    assert_eq!(kept.len(), 12, "a file per run, and one per replicate for its bounds: {kept:?}");
    // What is there is taken, what is broken is done again.
    let file = run.file_name().unwrap().to_str().unwrap();
    let mut sample: Sample = cache().find(file).unwrap();
    sample.overlap_pairs += 77;
    cache().put(file, &bytes(&sample)).unwrap();
    assert!(once != report(compare(&asked, 2, cache())).json(), "the cache is read");
    std::fs::write(run, "{").unwrap();
    assert!(once == report(compare(&asked, 2, cache())).json());
    assert_eq!(files(), kept);
    report(compare(&asked, 2, cache())).write(&dir.path().join("out")).unwrap();
    for (file, start) in
        [("pareto-1-paper.svg", "<svg"), ("compare.md", "    cz compare paper-none"), ("compare.json", "{")]
    {
        let text = std::fs::read_to_string(dir.path().join("out").join(file)).unwrap();
        assert!(text.starts_with(start), "{file}: {}", &text[..40]);
    }
    assert!(std::fs::read(dir.path().join("out/pareto-1-paper.png")).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn a_recorded_run_shows_what_the_run_shows() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("a.czlog");
    let mut cz = std::process::Command::new(env!("CARGO_BIN_EXE_cz"));
    cz.args([
        "run",
        "paper",
        "--in-process",
        "--seed",
        "2",
        "--set",
        "end.vehicles=24",
        "--set",
        "shield=on",
    ]);
    let output = cz.arg("--record").arg(&file).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let sets = ["end.vehicles=24", "shield=on"].map(str::to_owned);
    let scenario = control_zones::compare::load(Some("paper"), 2, &sets).unwrap();
    assert_eq!(Sample::recorded(&file).unwrap(), Sample::of(&scenario, "the same").unwrap());
    assert!(Sample::recorded(directory.path()).is_err());
}

#[test]
fn a_policy_may_have_controllers_of_ones_own_and_their_faults_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let policy = |controllers: &str| {
        let file = directory.path().join("mine.toml");
        std::fs::write(&file, format!("about = \"mine\"\ncontrollers = [{controllers}]\n")).unwrap();
        let mut cz = std::process::Command::new(env!("CARGO_BIN_EXE_cz"));
        let output =
            cz.args(["compare", file.to_str().unwrap(), "--scenario", "paper", "--seeds", "1"]).output();
        let output = output.unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (code, said) = policy("\"merge-1\"");
    assert!(code == Some(2) && said.contains("merge-1: expected TARGET=COMMAND"), "{code:?} {said}");
    let (code, said) = policy("\"merge-1=exit 7\"");
    assert!(code == Some(1) && said.contains("seed 1") && said.contains("merge-1"), "{code:?} {said}");
}

#[test]
fn totals_are_those_of_the_run_and_differences_are_paired() {
    let asked = comparison(&["paper-none", "paper-fixed-15"], 1..=3);
    let block = compare(&asked, 2, Cache::none());
    let mut differences = Vec::new();
    for (at, seed) in (1..=3).enumerate() {
        let totals: Vec<f64> = (0..2)
            .map(|policy| {
                let set = &block.policies[policy].members[0];
                let mut sets = asked.sets.clone();
                sets.extend(set.iter().cloned());
                if policy == 1 {
                    let exit_mps = block.exit_mps.unwrap();
                    sets.push(format!("zones.merge-2.flow={{policy=\"fixed\",terminal_mps={exit_mps:?}}}"));
                }
                let overrides: Vec<_> = sets.iter().map(|s| s.parse().unwrap()).collect();
                let mut run =
                    InProcess::new(&Arc::new(load(Some("paper"), &overrides, Some(seed)).unwrap()), 1, 1);
                run.run().unwrap();
                let summary = run.world().summary();
                assert_eq!(summary.held_arrivals, 0);
                let total: f64 = summary.zones.iter().map(|z| z.mean_objective).sum();
                assert!((value(&block, policy, "total", at) - total).abs() < 1e-9, "seed {seed}");
                total
            })
            .collect();
        differences.push(totals[1] - totals[0]);
    }
    let mean = differences.iter().sum::<f64>() / 3.0;
    let paired = block.policies[1].differences.iter().find(|d| d.measure == "total").unwrap();
    assert!((paired.absolute.unwrap().mean - mean).abs() < 1e-9);
    assert!(block.policies[0].differences.is_empty());
}

#[test]
fn a_group_is_its_cheapest_member_per_replicate() {
    let mut names = vec!["paper-best".to_owned(), "paper-none".into(), "paper-feedback".into()];
    names.push("paper-mean-speed".into());
    names.extend((0..=16).map(|i| format!("paper-fixed-{}", 12.0 + 0.5 * f64::from(i))));
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let block = compare(&comparison(&names, 1..=2), 2, Cache::none());
    // None, and 17 speeds and two feedbacks with v_m2 by the rule; then those again with v_m2 as printed.
    assert_eq!(block.policies[0].members.len(), 1 + 2 * 19);
    for replicate in 0..2 {
        let cheapest =
            (1..names.len()).map(|p| value(&block, p, "total", replicate)).fold(f64::INFINITY, f64::min);
        let taken = value(&block, 0, "total", replicate);
        let is_printed = block.policies[0].taken[replicate] > 19;
        assert!(if is_printed { taken <= cheapest } else { taken == cheapest }, "{taken} {cheapest}");
    }
}

#[test]
fn policies_are_named_changed_and_refused() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("mine.toml");
    std::fs::write(&file, "about = \"mine\"\nfrom = \"paper-none\"\nset = ['vehicle.standstill_gap_m=1']\n")
        .unwrap();
    let name = format!("{}:control.k_merge_per_s=2;control.clf=false", file.display());
    let block = compare(&comparison(&[&name], 1..=2), 1, Cache::none());
    assert_eq!(
        block.policies[0].members[0],
        [
            "control.law=ocbf",
            "coordination.schedule=none",
            "gate.entry=free",
            "zones.*.order=fifo",
            "zones.*.flow={ policy = \"none\" }",
            "vehicle.standstill_gap_m=1",
            "control.k_merge_per_s=2",
            "control.clf=false"
        ]
    );
    std::fs::write(&file, "about = \"mine\"\nsets = []\n").unwrap();
    let unknown = file.display().to_string();
    for (policy, words) in [
        ("papr-none", "policy papr-none: no such policy; expected paper-none, "),
        ("paper-fixed-fast", "policy paper-fixed-fast: fast: expected a speed in m/s"),
        ("paper-none:control.laww=x", "did you mean law?"),
        (&*unknown, "unknown field `sets`"),
    ] {
        let means = Means { jobs: 1, cache: Cache::none() };
        let error = run(&comparison(&[policy], 1..=1), &means, &mut |_, _, _| {}).unwrap_err().to_string();
        assert!(error.contains(words) && !error.contains('\n'), "{error}");
    }
    for (text, expected) in
        [("20", Some((1, 20))), ("4-23", Some((4, 23))), ("0", None), ("5-3", None), ("x", None)]
    {
        let seeds = text.parse::<Seeds>().ok().map(|s| (s.from, s.to));
        assert_eq!(seeds, expected, "{text}");
    }
    for table in tables::names() {
        assert!(!tables::comparisons(table, None).is_empty(), "{table}");
    }
}

#[test]
fn nobody_is_below_the_bounds() {
    for name in embedded_names() {
        let sets = ["end.vehicles=30".parse().unwrap(), "faults={}".parse().unwrap()];
        let scenario = Arc::new(load(Some(name), &sets, Some(5)).unwrap());
        let sample = Sample::of(&scenario, name).unwrap();
        assert_eq!(sample.vehicles.len(), 30, "{name}");
        let entrants = sample.entrants();
        let alone = Traffic { scenario: &scenario, entrants: &entrants }.alone();
        assert!(alone.total < sample.total(), "{name}: {} {}", alone.total, sample.total());
        assert!(alone.total > 0.4 * sample.total(), "{name}: {} {}", alone.total, sample.total());
    }
}

#[test]
fn the_centralised_optimum_lies_between() {
    for seed in [1, 5] {
        let sets = ["end.vehicles=40".parse().unwrap()];
        let scenario = Arc::new(load(Some("paper"), &sets, Some(seed)).unwrap());
        let sample = Sample::of(&scenario, "paper").unwrap();
        let entrants = sample.entrants();
        let traffic = Traffic { scenario: &scenario, entrants: &entrants };
        let found = joint::seek(&traffic, &sample.courses(), f64::INFINITY).unwrap();
        // Of no more exposure: dearer, as there is more to make up for.
        let exposure_ms = |found: &joint::Found| found.exposure_ms.iter().sum::<f64>();
        let most_ms = 0.9 * exposure_ms(&found);
        let safer = joint::seek(&traffic, &sample.courses(), most_ms).unwrap();
        assert!(exposure_ms(&safer) <= most_ms, "{found:?} {safer:?}");
        assert!(most_ms == 0.0 || safer.total > found.total, "{found:?} {safer:?}");
        let alone = traffic.alone().total;
        assert!(alone < found.total && found.total < sample.total(), "{alone} {found:?} {}", sample.total());
        assert!(found.missed_s < 0.02, "{found:?}");
        assert!(found.hardest_mps2.0 < 4.1 && found.hardest_mps2.1 > -4.1, "{found:?}");
    }
    // Of vehicles that never meet it is what each would do alone, but for the stretches.
    let sets = [
        "end.vehicles=6".parse().unwrap(),
        "roads.*.demand={ rates = [{ until_s = 7200.0, vehicles_per_hour = 20.0 }], min_headway_s = 1.2, \
         speed_mean_mps = 16.0, speed_sd_mps = 1.2, speed_min_mps = 10.0, speed_max_mps = 22.0 }"
            .parse()
            .unwrap(),
    ];
    let scenario = Arc::new(load(Some("paper"), &sets, Some(4)).unwrap());
    let sample = Sample::of(&scenario, "paper").unwrap();
    let entrants = sample.entrants();
    let traffic = Traffic { scenario: &scenario, entrants: &entrants };
    let found = joint::seek(&traffic, &sample.courses(), f64::INFINITY).unwrap();
    let alone = traffic.alone().total;
    assert!(
        found.converged && found.total >= alone - 1e-6 && found.total < 1.003 * alone,
        "{alone} {found:?}"
    );
    // A link behind a zone: not a chain of merges.
    let scenario = load(Some("tree"), &[], Some(1)).unwrap();
    let traffic = Traffic { scenario: &scenario, entrants: &[] };
    assert_eq!(joint::seek(&traffic, &[], 1.0), None);
}
