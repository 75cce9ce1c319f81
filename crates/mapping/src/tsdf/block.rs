//! A block of 8 x 8 x 8 voxels.

/// Voxels along an edge of a block.
pub(crate) const BLOCK_EDGE: usize = 8;
/// Voxels in a block.
pub(crate) const BLOCK_VOXELS: usize = BLOCK_EDGE * BLOCK_EDGE * BLOCK_EDGE;

/// Distances, weights and colours; voxel `(x, y, z)` stands at `(z * 8 + y) * 8 + x`. Its centre lies half a voxel from
/// its corner.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    /// Signed distance to the surface, metres; positive = free.
    pub(crate) distance: [f32; BLOCK_VOXELS],
    /// Sum of weights; 0 = never seen.
    pub(crate) weight: [f32; BLOCK_VOXELS],
    /// Red, green, blue in 1/256 steps, and how many pixels went in, up to [`MOST_COLORS`].
    pub(crate) color: [[u16; 4]; BLOCK_VOXELS],
}

/// A colour becomes a running mean over this many pixels.
pub(crate) const MOST_COLORS: u16 = 64;

impl Block {
    pub(crate) fn new() -> Box<Self> {
        Box::new(Block { distance: [0.0; BLOCK_VOXELS], weight: [0.0; BLOCK_VOXELS], color: [[0; 4]; BLOCK_VOXELS] })
    }
}
