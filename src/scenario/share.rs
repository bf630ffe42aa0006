//! How zones are shared out over processes.

use super::{Network, ZoneId};
use std::ops::Range;

/// The greatest number of coordinator processes: each has a bit in the frame header.
pub const MAX_COORDINATORS: u32 = 64;
/// The greatest number of controller processes.
pub const MAX_CONTROLLERS: u32 = 64;

/// The zones of process `index` of `count`: contiguous ranges of nearly equal size.
pub fn zones_of(zones: u32, index: u32, count: u32) -> Range<ZoneId> {
    let bound = |i: u32| (u64::from(zones) * u64::from(i) / u64::from(count)) as u32;
    bound(index)..bound(index + 1)
}

/// For each of `count` coordinator processes, the bit mask of the others that own a zone next to one of
/// its own.
pub fn neighbour_coordinators(network: &Network, count: u32) -> Vec<u64> {
    let zones = network.zones.len() as u32;
    let mut owner = vec![0; zones as usize];
    for index in 0..count {
        for zone in zones_of(zones, index, count) {
            owner[zone as usize] = index;
        }
    }
    let mut masks = vec![0u64; count as usize];
    for zone in 0..zones {
        for neighbour in network.neighbours(zone) {
            let (a, b) = (owner[zone as usize], owner[neighbour as usize]);
            if a != b {
                masks[a as usize] |= 1 << b;
                masks[b as usize] |= 1 << a;
            }
        }
    }
    masks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_zone_has_exactly_one_owner() {
        for zones in 1..40 {
            for count in 1..=zones {
                let mut next = 0;
                for index in 0..count {
                    let range = zones_of(zones, index, count);
                    assert_eq!(range.start, next);
                    assert!(!range.is_empty());
                    next = range.end;
                }
                assert_eq!(next, zones);
            }
        }
    }
}
