//! One result however the zones are shared out.

use control_zones::lockstep::in_process::InProcess;
use control_zones::scenario::Scenario;
use std::sync::Arc;

/// Runs the scenario with one coordinator and one controller, and with each of these numbers of them.
pub fn assert_one_hash(scenario: &Arc<Scenario>, ways: &[(u32, u32)], what: &str) {
    let zones = scenario.network.zones.len() as u32;
    let hash = |coordinators: u32, controllers: u32| {
        let mut run = InProcess::new(scenario, coordinators.min(zones), controllers.min(zones));
        run.run().expect("the roles agree");
        run.world().summary().state_hash
    };
    let expected = hash(1, 1);
    for &(coordinators, controllers) in ways {
        assert_eq!(hash(coordinators, controllers), expected, "{what}: {coordinators}, {controllers}");
    }
}
