//! A coarse grid over an image: counts, and shapes made of cells.

use image::GrayImage;
use nalgebra::Point2;

/// A number for each cell of the image, by rows.
#[derive(Debug, Clone)]
pub(super) struct Cells {
    columns: usize,
    rows: usize,
    cell_px: u32,
    width: u32,
    height: u32,
    pub(super) counts: Vec<u32>,
}

impl Cells {
    /// All zero.
    pub(super) fn new(width: u32, height: u32, cell_px: u32) -> Self {
        let (columns, rows) = (width.div_ceil(cell_px) as usize, height.div_ceil(cell_px) as usize);
        Cells { columns, rows, cell_px, width, height, counts: vec![0; columns * rows] }
    }

    /// Adds one to each cell in which there is a point; those outside of the image do not count.
    pub(super) fn count_once(&mut self, points: &[Point2<f64>]) {
        let mut cells: Vec<usize> = points
            .iter()
            .filter_map(|point| {
                // Pixel centres are whole numbers: the image begins half a pixel before the first.
                let (x, y) = (point.x + 0.5, point.y + 0.5);
                let inside = x >= 0.0 && y >= 0.0 && x < f64::from(self.width) && y < f64::from(self.height);
                inside.then(|| (y as u32 / self.cell_px) as usize * self.columns + (x as u32 / self.cell_px) as usize)
            })
            .collect();
        cells.sort_unstable();
        cells.dedup();
        for cell in cells {
            self.counts[cell] += 1;
        }
    }

    /// For each cell, the combination over the cells at most `reach` to every side.
    fn around(&self, reach: usize, start: u32, combine: impl Fn(u32, u32) -> u32) -> Cells {
        let mut combined = self.clone();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let mut value = start;
                for near_row in row.saturating_sub(reach)..(row + reach + 1).min(self.rows) {
                    for near in column.saturating_sub(reach)..(column + reach + 1).min(self.columns) {
                        value = combine(value, self.counts[near_row * self.columns + near]);
                    }
                }
                combined.counts[row * self.columns + column] = value;
            }
        }
        combined
    }

    /// Sums over cells and their neighbours.
    pub(super) fn summed(&self, reach: usize) -> Cells {
        self.around(reach, 0, u32::saturating_add)
    }

    /// The shape (cells that are not zero) widened.
    pub(super) fn widened(&self, reach: usize) -> Cells {
        self.around(reach, 0, u32::max)
    }

    /// The shape narrowed; the outside of the image counts as part of it.
    pub(super) fn narrowed(&self, reach: usize) -> Cells {
        self.around(reach, u32::MAX, u32::min)
    }

    /// Fraction of the cells that are not zero.
    pub(super) fn fraction(&self) -> f64 {
        self.counts.iter().filter(|&&count| count > 0).count() as f64 / self.counts.len().max(1) as f64
    }

    /// Sets to zero the pixels of cells that are not.
    pub(super) fn paint(&self, mask: &mut GrayImage) {
        for (x, y, pixel) in mask.enumerate_pixels_mut() {
            let cell = (y / self.cell_px) as usize * self.columns + (x / self.cell_px) as usize;
            if self.counts[cell] > 0 {
                pixel.0 = [0];
            }
        }
    }
}
