//! Addresses of voxels: three 21-bit indices in one word, and a fixed hash of it.
//!
//! The hash is our own so that nothing depends on a random seed, and so that shards (taken from the middle bits) and
//! the hash table's buckets (taken from the outer bits) are independent of each other.

use crate::Error;
use std::hash::{BuildHasherDefault, Hasher};

/// Indices run from -2^20 to 2^20 - 1 on every axis.
pub(crate) const INDEX_LIMIT: i32 = 1 << 20;
const BITS: u32 = 21;
const MASK: u64 = (1 << BITS) - 1;

/// A voxel's or block's address. Orders by z, then y, then x.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct VoxelKey(u64);

impl VoxelKey {
    /// Packs indices; `None` when one is out of range.
    pub(crate) fn new(index: [i32; 3]) -> Option<Self> {
        let mut packed = 0;
        for axis in [2, 1, 0] {
            if !(-INDEX_LIMIT..INDEX_LIMIT).contains(&index[axis]) {
                return None;
            }
            packed = (packed << BITS) | (index[axis] + INDEX_LIMIT) as u64;
        }
        Some(VoxelKey(packed))
    }

    /// The voxel of edge `1 / inverse_edge` metres that holds a point; an error beyond the addressable range.
    pub(crate) fn of_point(point: [f64; 3], inverse_edge: f64) -> Result<Self, Error> {
        let mut index = [0; 3];
        for axis in 0..3 {
            let cell = (point[axis] * inverse_edge).floor();
            if !(cell >= -f64::from(INDEX_LIMIT) && cell < f64::from(INDEX_LIMIT)) {
                return Err(Error::OutOfRange {
                    distance_m: point[axis].abs(),
                    limit_m: f64::from(INDEX_LIMIT) / inverse_edge,
                    voxel_m: 1.0 / inverse_edge,
                });
            }
            index[axis] = cell as i32;
        }
        Ok(Self::new(index).expect("range was checked axis by axis"))
    }

    /// The three indices.
    pub(crate) fn index(self) -> [i32; 3] {
        let unpack = |axis: u32| ((self.0 >> (BITS * axis)) & MASK) as i32 - INDEX_LIMIT;
        [unpack(0), unpack(1), unpack(2)]
    }

    /// Which of `2^bits` shards owns the address.
    pub(crate) fn shard(self, bits: u32) -> usize {
        ((mix(self.0) >> 24) & ((1 << bits) - 1)) as usize
    }
}

impl std::hash::Hash for VoxelKey {
    fn hash<H: Hasher>(&self, state: &mut H) {
        state.write_u64(self.0);
    }
}

/// Finaliser with two multiplications: neighbouring addresses land far apart.
fn mix(mut word: u64) -> u64 {
    word ^= word >> 32;
    word = word.wrapping_mul(0xd6e8_feb8_6659_fd93);
    word ^= word >> 32;
    word = word.wrapping_mul(0xd6e8_feb8_6659_fd93);
    word ^ (word >> 32)
}

/// Hashes one [`VoxelKey`].
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct VoxelHasher(u64);

impl Hasher for VoxelHasher {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            self.0 = mix(self.0 ^ u64::from(byte));
        }
    }
    fn write_u64(&mut self, word: u64) {
        self.0 = mix(word);
    }
}

/// A hash map by voxel address.
pub(crate) type VoxelMap<V> = std::collections::HashMap<VoxelKey, V, BuildHasherDefault<VoxelHasher>>;

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn packing_is_reversible(x in -INDEX_LIMIT..INDEX_LIMIT, y in -INDEX_LIMIT..INDEX_LIMIT, z in -INDEX_LIMIT..INDEX_LIMIT) {
            prop_assert_eq!(VoxelKey::new([x, y, z]).unwrap().index(), [x, y, z]);
        }
    }

    #[test]
    fn indices_out_of_range_are_refused_not_wrapped() {
        assert!(VoxelKey::new([INDEX_LIMIT, 0, 0]).is_none());
        assert!(VoxelKey::new([0, -INDEX_LIMIT - 1, 0]).is_none());
        assert!(matches!(VoxelKey::of_point([0.0, 1e300, 0.0], 100.0), Err(Error::OutOfRange { .. })));
        assert!(matches!(VoxelKey::of_point([f64::NAN, 0.0, 0.0], 100.0), Err(Error::OutOfRange { .. })));
        assert_eq!(VoxelKey::of_point([-0.001, 0.0, 0.011], 100.0).unwrap().index(), [-1, 0, 1]);
    }
}
