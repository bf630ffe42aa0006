//! Runs whose coordinators schedule: everybody arrives, nobody is passed too often, and a coordinator that takes over decides
//! what its predecessor would have.

use control_zones::coordination::Coordinator;
use control_zones::lockstep::Ledger;
use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::{Override, Scenario, load};
use control_zones::step::{Commands, Step};
use ipc_schemas::{ASSIGNMENT_PASSED, ASSIGNMENT_PASSED_ONCE, Role};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

fn scenario(name: &str, sets: &[&str]) -> Arc<Scenario> {
    let sets: Vec<Override> = sets.iter().map(|set| set.parse().unwrap()).collect();
    Arc::new(load(Some(name), &sets, Some(1)).unwrap())
}

/// Steps through a run and shows each step's frames.
fn each_step(scenario: &Arc<Scenario>, mut show: impl FnMut(&Step)) -> InProcess {
    let mut run = InProcess::observed(scenario, 1, 1);
    let mut more = true;
    while more {
        more = run.step().unwrap();
        run.frames(|frames| {
            let commands =
                frames.commands.iter().map(|c| Commands { generation: 0, records: c.records.to_vec() });
            show(&Step {
                header: frames.header,
                state: frames.state.to_vec(),
                summaries: frames.summaries.concat(),
                coordination: frames.coordination.concat(),
                commands: commands.collect(),
                feedback: frames.feedback.to_vec(),
                misses: frames.misses,
                policy: frames.policy,
                state_hash: frames.state_hash,
            });
        })
        .unwrap();
    }
    run
}

const TANDEM: [&str; 3] =
    ["end.vehicles=40", "coordination.schedule=tandem", "coordination.order=resequenced"];

/// Whatever step a coordinator takes over in: orders, passings and schedules are in frames.
#[test]
fn a_successor_decides_what_its_predecessor_would_have() {
    for name in ["two-merges", "roundabout"] {
        let scenario = scenario(name, &TANDEM);
        let zones = 0..scenario.network.zones.len() as u32;
        let mut ledger = Ledger::new(&scenario, 1);
        let mut compared = 0;
        each_step(&scenario, |step| {
            if step.header.coordinators_acting != 0 {
                let handover = ledger.handover(Role::Coordinator, 0);
                let mut successor = Coordinator::new(scenario.clone(), zones.clone());
                successor.restore(&handover.heard, &handover.due, &handover.in_force);
                successor.act(step.header.step, &step.state);
                assert_eq!(successor.assignments(), step.coordination, "{name}, step {}", step.header.step);
                compared += 1;
            }
            ledger.relive(step);
        });
        assert!(compared > 100, "{compared}");
    }
}

/// Nobody has more than two in its zone passed it that it meets, and what frames say of it is right.
#[test]
fn nobody_is_passed_more_than_twice_in_a_zone() {
    for (name, sets) in [
        ("two-merges", vec!["coordination.schedule=pooled", "coordination.order=resequenced"]),
        ("two-merges", vec!["coordination.order=resequenced"]),
        ("intersection", vec!["coordination.schedule=pooled", "coordination.order=resequenced"]),
    ] {
        let scenario = scenario(name, &sets);
        let conflicts = control_zones::conflict::Conflicts::of_all(&scenario.network);
        let mut passed: BTreeMap<(u32, u32), BTreeSet<u32>> = BTreeMap::new();
        each_step(&scenario, |step| {
            for zone in step.coordination.chunk_by(|a, b| a.zone == b.zone) {
                let states: Vec<_> =
                    step.state.iter().filter(|s| s.zone == zone[0].zone && !s.has_left()).collect();
                let rank = |vehicle: u32| zone.iter().find(|a| a.vehicle == vehicle).unwrap().rank;
                let meet = |a: u32, b: u32| {
                    let of = |path| conflicts[zone[0].zone as usize].uses(path);
                    of(a).iter().any(|own| of(b).iter().any(|other| own.point == other.point))
                };
                for (at, own) in states.iter().enumerate() {
                    let by = passed.entry((own.zone, own.vehicle)).or_default();
                    let later = states[at + 1..].iter();
                    let overtakers =
                        later.filter(|s| rank(s.vehicle) < rank(own.vehicle) && meet(own.path, s.path));
                    by.extend(overtakers.map(|s| s.vehicle));
                    let said =
                        zone.iter().find(|a| a.vehicle == own.vehicle).unwrap().flags & ASSIGNMENT_PASSED;
                    assert_eq!(usize::from(said / ASSIGNMENT_PASSED_ONCE), by.len(), "{own:?}");
                    assert!(by.len() <= 2, "{own:?} by {by:?}");
                }
            }
        });
        let most = passed.values().map(BTreeSet::len).max();
        println!("{name} {sets:?}: {} were passed", passed.values().filter(|by| !by.is_empty()).count());
        assert!(most > Some(0), "nobody was passed");
    }
}

/// How zones are shared out changes nothing of what is scheduled.
#[test]
fn schedules_do_not_depend_on_how_zones_are_shared_out() {
    for name in ["two-merges", "tree", "grid-3x3"] {
        let hash = |coordinators, controllers, sets: &[&str]| {
            let mut run = InProcess::new(&scenario(name, sets), coordinators, controllers);
            run.run().unwrap();
            assert_eq!(run.world().departed(), run.world().arrived(), "{name}: somebody is left");
            run.world().state_hash()
        };
        let sets = [&TANDEM[..], &["end.time_s=20000"]].concat();
        let zones = scenario(name, &[]).network.zones.len() as u32;
        assert_eq!(hash(1, 1, &sets), hash(zones.min(3), 2, &sets), "{name}");
    }
}
