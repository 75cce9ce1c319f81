//! Inverse depths with a border, so that a window around any pixel lies inside.

use super::NormalWindow;
use super::fit::RUN;
use rayon::prelude::*;

/// Inverse depths with a border as wide as the window on all sides; infinite where there is none.
#[derive(Debug, Clone, Default)]
pub(crate) struct InverseDepths {
    pub(super) values: Vec<f32>,
    /// Length of a row with its borders.
    pub(super) stride: usize,
    pub(super) margin: usize,
}

impl InverseDepths {
    pub(super) fn of(depth: &[f32], width: usize, window: NormalWindow) -> Self {
        let mut inverse = InverseDepths::default();
        inverse.make_room(width, depth.len() / width.max(1), window);
        inverse.bands_mut(1).zip(depth.par_chunks(width.max(1))).for_each(|(mut row, depth)| row.fill(0, depth));
        inverse
    }

    /// Resizes the buffers for an image; what is inside the borders is to be filled.
    pub(crate) fn make_room(&mut self, width: usize, height: usize, window: NormalWindow) {
        let margin = window.radius();
        let stride = width.next_multiple_of(RUN) + 2 * margin;
        let length = stride * (height + 2 * margin);
        if (self.stride, self.margin, self.values.len()) != (stride, margin, length) {
            *self = InverseDepths { values: vec![f32::INFINITY; length], stride, margin };
        }
    }

    /// The image in bands of rows.
    pub(crate) fn bands_mut(&mut self, rows: usize) -> impl IndexedParallelIterator<Item = InverseBand<'_>> {
        let (stride, margin) = (self.stride, self.margin);
        let inside = stride * margin..self.values.len() - stride * margin;
        self.values[inside].par_chunks_mut(stride * rows).map(move |values| InverseBand { values, stride, margin })
    }
}

/// Some rows of an image.
pub(crate) struct InverseBand<'a> {
    values: &'a mut [f32],
    stride: usize,
    margin: usize,
}

impl InverseBand<'_> {
    /// Takes the depths of the band's row `y`.
    pub(crate) fn fill(&mut self, y: usize, depth: &[f32]) {
        for (inverse, z) in self.values[y * self.stride + self.margin..].iter_mut().zip(depth) {
            *inverse = 1.0 / z;
        }
    }
}
