//! Whoever commands what the law would command has the run that `cz run` has.

#![allow(clippy::unwrap_used)] // a test

use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::load_embedded;
use control_zones_env::{End, EnvError, Envs, FEATURES};
use std::sync::Arc;

fn column(name: &str) -> usize {
    FEATURES.iter().position(|feature| *feature == name).unwrap()
}

/// One run of a scenario: it, and what its zones cost.
struct Driven {
    envs: Envs,
    cost: Vec<f64>,
    end: End,
}

/// Drives a run to its end with what `act` makes of a vehicle's features.
fn driven(
    scenario: &str,
    sets: &[&str],
    zones: &[&str],
    capacity: usize,
    act: impl Fn(&[f64]) -> f64,
) -> Result<Driven, EnvError> {
    let mut envs = Envs::new(Some(scenario.to_owned()), sets, zones, capacity, 1)?;
    envs.reset(0, Some(1))?;
    let (actions, zones) = envs.sizes();
    let (mut actions, mut rewards) = (vec![0.0; actions], vec![0.0; zones]);
    let (mut cost, mut end) = (vec![0.0; zones], [End::No]);
    while end == [End::No] {
        let rows = envs.run(0)?.features().chunks(FEATURES.len());
        actions.iter_mut().zip(rows).for_each(|(action, row)| *action = act(row));
        envs.step(&actions, &mut rewards, &mut end)?;
        cost.iter_mut().zip(&rewards).for_each(|(cost, reward)| *cost -= reward);
    }
    Ok(Driven { envs, cost, end: end[0] })
}

/// The hash and the cost of each zone of the same run under the law.
fn expected(scenario: &str, sets: &[&str]) -> (u64, Vec<f64>) {
    let sets: Vec<_> = sets.iter().map(|set| set.parse().unwrap()).collect();
    let scenario = Arc::new(load_embedded(scenario, &sets, Some(1)).unwrap());
    let mut run = InProcess::new(&scenario, 1, 1);
    run.run().unwrap();
    let zones = run.world().summary().zones;
    (run.world().state_hash(), zones.iter().map(|z| f64::from(z.vehicles) * z.mean_objective).collect())
}

#[test]
fn the_laws_actions_make_the_laws_run_to_the_bit() {
    let law = |row: &[f64]| row[column("law_mps2")];
    for (scenario, sets) in [
        ("two-merges", &[][..]),
        ("paper", &[]),
        ("two-merges", &["shield=on"]),
        ("intersection", &[]),
        ("roundabout", &["control.law=viable"]),
        ("faulty-sensors", &[]),
    ] {
        let (hash, cost) = expected(scenario, sets);
        let run = driven(scenario, sets, &[], 64, law).unwrap();
        assert_eq!(run.envs.run(0).unwrap().world().state_hash(), hash, "{scenario} {sets:?}");
        // Where everybody has left, rewards are the paper's cost, up to rounding.
        if run.end == End::Served {
            for (found, expected) in run.cost.iter().zip(&cost) {
                assert!(
                    (found - expected).abs() < 1e-6 * expected,
                    "{scenario} {sets:?}: {found}, {expected}"
                );
            }
        }
        // Some vehicles are behind the last row; the law drives them, and nothing changes.
        let few = driven(scenario, sets, &[], 2, law).unwrap();
        assert_eq!(few.envs.run(0).unwrap().world().state_hash(), hash, "{scenario} {sets:?}, two rows");
    }
}

#[test]
fn other_actions_make_another_run_which_the_shield_keeps_safe() {
    let hold = |row: &[f64]| if row[0] > 0.0 { 15.0 - row[column("v_mps")] } else { 0.0 };
    let (hash, _) = expected("two-merges", &[]);
    let bare = driven("two-merges", &[], &["merge-2"], 64, hold).unwrap();
    assert_ne!(bare.envs.run(0).unwrap().world().state_hash(), hash);
    let shielded = driven("two-merges", &["shield=on"], &["merge-2"], 64, |_| 100.0).unwrap();
    let summary = shielded.envs.run(0).unwrap().world().summary();
    assert!(
        summary.shield.controllers.iter().any(|row| row.rear_end + row.merge > 0),
        "{:?}",
        summary.shield
    );
    assert!(summary.shield.controllers.iter().all(|row| row.lost == 0), "{:?}", summary.shield);
}

#[test]
fn runs_side_by_side_are_those_alone() {
    let law = column("law_mps2");
    let mut envs = Envs::new(None, &["end.vehicles=20"], &["merge-1"], 8, 3).unwrap();
    for index in 0..3 {
        envs.reset(index, Some(index as u64 + 1)).unwrap();
    }
    let (actions, zones) = envs.sizes();
    let (mut actions, mut rewards, mut ends) = (vec![0.0; 3 * actions], vec![0.0; 3 * zones], [End::No; 3]);
    while ends.contains(&End::No) {
        for (index, actions) in actions.chunks_mut(8).enumerate() {
            let rows = envs.run(index).unwrap().features().chunks(FEATURES.len());
            actions.iter_mut().zip(rows).for_each(|(action, row)| *action = row[law]);
        }
        envs.step(&actions, &mut rewards, &mut ends).unwrap();
    }
    for index in 0..3 {
        let set = "end.vehicles=20".parse().unwrap();
        let scenario = Arc::new(load_embedded("two-merges", &[set], Some(index as u64 + 1)).unwrap());
        let mut alone = InProcess::new(&scenario, 1, 1);
        alone.run().unwrap();
        let hash = envs.run(index).unwrap().world().state_hash();
        assert_eq!(hash, alone.world().state_hash(), "seed {}", index + 1);
    }
}

#[test]
fn mistakes_are_named() {
    let said = |result: Result<Driven, EnvError>| result.err().unwrap().to_string();
    let law = |row: &[f64]| row[column("law_mps2")];
    assert_eq!(
        said(driven("two-merges", &[], &["merge-3"], 4, law)),
        "zones: there is no zone merge-3 in two-merges, expected one of merge-1, merge-2"
    );
    let not_a_number = said(driven("two-merges", &[], &["merge-2"], 4, |_| f64::NAN));
    assert!(not_a_number.contains("zone merge-2: action 0 is NaN, expected a number"), "{not_a_number}");
    assert!(said(driven("two-merges", &["dt=3"], &[], 4, law)).contains("dt"));
    let mut envs = Envs::new(None, &[], &[], 4, 1).unwrap();
    assert!(envs.run(1).unwrap_err().to_string().contains("no environment 1"));
    let unready = envs.step(&[0.0; 8], &mut [0.0; 2], &mut [End::No]).unwrap_err();
    assert_eq!(unready.to_string(), "environment 0 is to be reset before it is used");
}
