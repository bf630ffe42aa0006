//! Arrival traces through the loader: a message with a line, or arrivals in order.

#![no_main]

use control_zones::scenario::{Demand, load_given};
use libfuzzer_sys::fuzz_target;

const SCENARIO: &str = r#"
name = "t"
objective = { beta = 1 }
[[roads]]
name = "a"
demand = { trace = "t.csv" }
[[roads]]
name = "b"
demand = { trace = "t.csv" }
[[zones]]
name = "z"
approaches = [{ name = "a", length_m = 100, road = "a" }, { name = "b", length_m = 100, road = "b" }]
"#;

fuzz_target!(|bytes: &[u8]| {
    match load_given(SCENARIO, vec![("t.csv".to_owned(), bytes.to_vec())], &[], None) {
        Ok(scenario) => {
            scenario.check().expect("what the loader makes passes the check");
            for road in &scenario.network.roads {
                let Demand::Trace(arrivals) = &road.demand else { panic!("a trace was asked for") };
                assert!(arrivals.is_sorted_by_key(|a| a.time_s));
            }
        }
        Err(error) => {
            let message = error.to_string();
            assert!(message.contains("t.csv:") && !message.contains('\n'), "{message}");
        }
    }
});
