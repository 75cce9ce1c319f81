//! A block of 8 x 8 x 8 voxels, and the store of all blocks.

/// Voxels along an edge of a block.
pub(crate) const BLOCK_EDGE: usize = 8;
/// Rows of voxels in a block.
pub(crate) const BLOCK_ROWS: usize = BLOCK_EDGE * BLOCK_EDGE;

/// One value for each voxel of a row.
pub(crate) type Row<T = f32> = [T; BLOCK_EDGE];

/// Eight voxels along x, quantity by quantity: what one image changes lies in two neighbouring lines of the cache.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct VoxelRow {
    /// Signed distance to the surface, metres; positive = free.
    pub(crate) distance: Row,
    /// Sum of weights; 0 = never seen.
    pub(crate) weight: Row,
    /// Red, green, blue in 1/256 steps, and how many pixels went in, up to [`MAX_COLORS`].
    pub(crate) color: [Row<u16>; 4],
}

const EMPTY: VoxelRow =
    VoxelRow { distance: [0.0; BLOCK_EDGE], weight: [0.0; BLOCK_EDGE], color: [[0; BLOCK_EDGE]; 4] };

/// Voxel `(x, y, z)` is in row `z * 8 + y`. Its centre lies half a voxel from its corner.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) rows: [VoxelRow; BLOCK_ROWS],
}

/// A colour becomes a running mean over this many pixels.
pub(crate) const MAX_COLORS: u16 = 64;

impl Block {
    /// Red, green, blue and count of a voxel, `(z * 8 + y) * 8 + x`.
    pub(crate) fn color(&self, voxel: usize) -> [u16; 4] {
        let row = &self.rows[voxel / BLOCK_EDGE];
        row.color.map(|plane| plane[voxel % BLOCK_EDGE])
    }
}

/// Blocks that are allocated together, a megabyte.
const SLAB: usize = 128;

/// Blocks by their places 0, 1, 2 ...; they never move.
#[derive(Debug, Default)]
pub(crate) struct BlockStore {
    slabs: Vec<Vec<Block>>,
}

impl BlockStore {
    /// Number of blocks.
    pub(crate) fn len(&self) -> usize {
        self.slabs.last().map_or(0, |last| (self.slabs.len() - 1) * SLAB + last.len())
    }

    /// Appends empty blocks.
    pub(crate) fn grow(&mut self, mut count: usize) {
        while count > 0 {
            if self.slabs.last().is_none_or(|last| last.len() == SLAB) {
                self.slabs.push(Vec::with_capacity(SLAB));
            }
            let last = self.slabs.last_mut().expect("one was pushed");
            let more = count.min(SLAB - last.len());
            last.extend(std::iter::repeat_n(Block { rows: [EMPTY; BLOCK_ROWS] }, more));
            count -= more;
        }
    }

    /// The block at a place.
    pub(crate) fn get(&self, place: u32) -> &Block {
        &self.slabs[place as usize / SLAB][place as usize % SLAB]
    }

    /// The blocks at places in ascending order, no two alike.
    pub(crate) fn get_many_mut(&mut self, places: &[u32]) -> Vec<&mut Block> {
        let mut found = Vec::with_capacity(places.len());
        let mut places = places.iter().map(|&place| place as usize).peekable();
        for (number, slab) in self.slabs.iter_mut().enumerate() {
            let (mut rest, mut passed) = (slab.as_mut_slice(), number * SLAB);
            while let Some(place) = places.next_if(|place| place / SLAB == number) {
                let (block, after) = rest[place - passed..].split_first_mut().expect("the place is one of this slab");
                found.push(block);
                (rest, passed) = (after, place + 1);
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_found_where_they_were_put() {
        let mut store = BlockStore::default();
        assert_eq!(store.len(), 0);
        store.grow(3);
        store.grow(2 * SLAB);
        assert_eq!(store.len(), 2 * SLAB + 3);
        let places = [0, 2, SLAB as u32 - 1, SLAB as u32, 2 * SLAB as u32 + 2];
        for (block, place) in store.get_many_mut(&places).into_iter().zip(places) {
            block.rows[9].weight[3] = place as f32 + 1.0;
        }
        for place in 0..store.len() as u32 {
            let expected = if places.contains(&place) { place as f32 + 1.0 } else { 0.0 };
            assert_eq!(store.get(place).rows[9].weight[3], expected);
        }
    }
}
