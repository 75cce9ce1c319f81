//! Damage to binary files.

use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;

/// A seed with one to five damages: flipped, lost, repeated bytes, and lengths that lie.
pub fn damaged_bytes(seed: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..random.random_range(1..6u32) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        match random.random_range(0..7u32) {
            0 => bytes[at] ^= 1 << random.random_range(0..8u32),
            1 => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => {
                let end = (at + random.random_range(1..64usize)).min(bytes.len());
                bytes.drain(at..end);
            }
            4 => {
                let end = (at + random.random_range(1..64usize)).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                bytes.splice(at..at, copy);
            }
            // Lengths: the numbers that a careless reader allocates.
            5 => {
                let value: u32 = [u32::MAX, i32::MAX as u32, 1 << 30, 0, 1, 1 << 24][random.random_range(0..6usize)];
                let end = (at + 4).min(bytes.len());
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            _ => {
                let end = (at + 8).min(bytes.len());
                let value = random.next_u64() >> random.random_range(0..64u32);
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
        }
    }
    bytes
}
