//! A scenario as bytes, and the hash by which participants of a run know that they have the same one.

use super::Scenario;
pub use crate::encoding::DecodeError;
use crate::encoding::{self, encode_onto};
use xxhash_rust::xxh3::xxh3_64;

/// The scenario as bytes; equal scenarios give equal bytes.
pub fn encode(scenario: &Scenario) -> Vec<u8> {
    let mut bytes = Vec::new();
    encode_onto(&mut bytes, scenario);
    bytes
}

/// The scenario of such bytes.
///
/// The values are not validated again: bytes from another process are to be compared with that process's
/// [`scenario_hash`] first.
pub fn decode(bytes: &[u8]) -> Result<Scenario, DecodeError> {
    encoding::decode(bytes)
}

/// The scenario as bytes that name their fields, for files.
pub fn keep(scenario: &Scenario) -> Vec<u8> {
    let mut bytes = Vec::new();
    encoding::keep_onto(&mut bytes, scenario);
    bytes
}

/// The scenario of such bytes, not validated again either.
pub fn kept(bytes: &[u8]) -> Result<Scenario, DecodeError> {
    encoding::kept(bytes)
}

/// Hash of the scenario; never 0, which can therefore stand for "none".
pub fn scenario_hash(scenario: &Scenario) -> u64 {
    xxh3_64(&encode(scenario)).max(1)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::scenario::{embedded_names, load_embedded};

    #[test]
    fn round_trip_of_all_scenarios() {
        let mut hashes = std::collections::BTreeSet::new();
        for name in embedded_names() {
            for seed in [1, 2] {
                let scenario = load_embedded(name, &[], Some(seed)).unwrap();
                assert_eq!(decode(&encode(&scenario)).unwrap(), scenario);
                assert_eq!(encoding::kept::<Scenario>(&keep(&scenario)).unwrap(), scenario);
                assert!(hashes.insert(scenario_hash(&scenario)), "{name} {seed}");
            }
        }
        assert!(!hashes.contains(&0));
    }

    #[test]
    fn other_bytes_are_refused() {
        let bytes = encode(&load_embedded("tree", &[], None).unwrap());
        for cut in 0..bytes.len() {
            assert!(matches!(decode(&bytes[..cut]), Err(DecodeError::Malformed(_))), "{cut}");
        }
        let longer = [&bytes[..], &[0]].concat();
        assert!(matches!(decode(&longer), Err(DecodeError::Trailing(1))));
        // A length field of 2^64 - 1 allocates nothing.
        assert!(matches!(decode(&[0xfd; 64]), Err(DecodeError::Malformed(_))));
        assert!(matches!(decode(&vec![0; encoding::MAX_BYTES + 1]), Err(DecodeError::TooLong { .. })));
        // Whatever single byte is wrong: an error or another scenario, no panic.
        for i in 0..bytes.len() {
            let mut wrong = bytes.clone();
            wrong[i] ^= 0xff;
            let _ = decode(&wrong);
        }
    }
}
