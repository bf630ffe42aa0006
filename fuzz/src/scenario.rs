//! Scenario text and `--set`s through the loader: a message, or a scenario every check agrees with.
//!
//! Input: the text, then `--set`s, each after a zero byte.

#![no_main]

use control_zones::scenario::{Override, decode, encode, load_given};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let text = String::from_utf8_lossy(bytes);
    let mut parts = text.split('\0');
    let toml = parts.next().unwrap_or_default();
    let sets: Result<Vec<Override>, _> = parts.map(str::parse).collect();
    let Ok(sets) = sets.map_err(|error| error.to_string()) else { return };
    let traces = vec![("t.csv".to_owned(), b"time_s,road,speed_mps\n1,r,15\n2,main1,15\n".to_vec())];
    match load_given(toml, traces, &sets, None) {
        Ok(scenario) => {
            scenario.check().expect("what the loader makes passes the check");
            let again = decode(&encode(&scenario)).expect("what was encoded can be decoded");
            assert_eq!(again, scenario);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
