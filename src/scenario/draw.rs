//! Draws that need no memory: hashes of seed, vehicle and purpose.

use xxhash_rust::xxh3::xxh3_64;

/// Purpose of the draw of a vehicle's kind.
pub(crate) const KIND: u64 = u64::MAX;
/// Purpose of the draw of who drives a vehicle.
pub(crate) const DRIVER: u64 = u64::MAX - 2;
/// Purpose of the draw of a vehicle's route.
pub(crate) const ROUTE: u64 = u64::MAX - 1;

/// One of some choices, by weight; the first when all weights are 0. Purposes from 0 on are places on the way, at
/// which a path is drawn.
pub(crate) fn choice(
    seed: u64,
    vehicle: u64,
    purpose: u64,
    weights: impl Iterator<Item = f64> + Clone,
) -> usize {
    let mut key = [0; 24];
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&vehicle.to_le_bytes());
    key[16..].copy_from_slice(&purpose.to_le_bytes());
    // 53 bits are a double's.
    let share = (xxh3_64(&key) >> 11) as f64 / (1_u64 << 53) as f64;
    let mut rest = share * weights.clone().sum::<f64>();
    let mut last = 0;
    for (index, weight) in weights.enumerate().filter(|(_, weight)| *weight > 0.0) {
        if rest < weight {
            return index;
        }
        rest -= weight;
        last = index;
    }
    last
}
