//! An image at halved sizes, smoothed so that interpolating it does little harm.

use image::GrayImage;
use multiversion::multiversion;

/// Fixed point: a grey value times this.
const UNITS: f32 = 256.0;
/// Smallest side of a level, px.
const SMALLEST_SIDE: usize = 32;
/// Levels at most; patches of larger keypoints are cut from the last.
const MAX_LEVELS: usize = 6;

/// Variance of the smoothing of a level along an axis, px² of the level: of the filter (1 2 1)/4 for level 0; for the
/// others, that and (1 4 6 4 1)/16 amount to 0.6 px instead of 0.7.
pub(super) const SMOOTHING_PX2: f64 = 0.5;
/// The cubic B-spline smooths by this variance along an axis, px²; that of Catmull and Rom does not smooth.
pub(super) const SPLINE_PX2: f64 = 1.0 / 3.0;

/// Interpolation by a cubic: by powers of the offset from the second of four samples, the coefficients of their
/// weights.
///
/// A blend of Catmull and Rom's spline, which interpolates, and the B-spline, which smooths.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cubic([[f32; 4]; 4]);

impl Cubic {
    /// The cubic that smooths by this variance, px², as far as that is in its power.
    pub(super) fn smoothing(variance_px2: f64) -> Self {
        const CATMULL_ROM: [[f64; 4]; 4] =
            [[0.0, -0.5, 1.0, -0.5], [1.0, 0.0, -2.5, 1.5], [0.0, 0.5, 2.0, -1.5], [0.0, 0.0, -0.5, 0.5]];
        const B_SPLINE: [[f64; 4]; 4] =
            [[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]];
        let fraction = (variance_px2 / SPLINE_PX2).clamp(0.0, 1.0);
        let blend = |sample: usize, power: usize| {
            ((1.0 - fraction) * CATMULL_ROM[sample][power] + fraction * B_SPLINE[sample][power] / 6.0) as f32
        };
        Cubic(std::array::from_fn(|power| std::array::from_fn(|sample| blend(sample, power))))
    }

    /// Of both axes side by side, which is one vector.
    #[inline(always)]
    fn weights(&self, tx: f32, ty: f32) -> [f32; 8] {
        let t = [tx, tx, tx, tx, ty, ty, ty, ty];
        let [c0, c1, c2, c3] = &self.0;
        std::array::from_fn(|at| {
            let sample = at % 4;
            ((c3[sample] * t[at] + c2[sample]) * t[at] + c1[sample]) * t[at] + c0[sample]
        })
    }
}

/// An image prepared for [`refine_matches`](super::refine_matches): smoothed, and at halved sizes.
///
/// Pixel (x, y) of level `l` lies at `(x, y) * 2^l` of the image. Takes 2.7 bytes a pixel of the image.
#[derive(Debug, Clone)]
pub struct Pyramid {
    pub(super) levels: Vec<Level>,
}

/// One size of the image.
#[derive(Debug, Clone)]
pub(super) struct Level {
    pub(super) width: usize,
    pub(super) height: usize,
    /// Rows of grey values in fixed point.
    values: Vec<u16>,
}

impl Pyramid {
    /// Prepares an image of any size.
    pub fn new(image: &GrayImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        // 255 * 256 fits 16 bits.
        let values = image.as_raw().iter().map(|&value| u16::from(value) * UNITS as u16).collect();
        let mut levels = vec![Level { width, height, values }.smoothed([0, 4, 8, 4, 0], 1)];
        while levels.len() < MAX_LEVELS {
            let last = &levels[levels.len() - 1];
            if last.width.min(last.height) < 2 * SMALLEST_SIDE {
                break;
            }
            let next = last.smoothed([1, 4, 6, 4, 1], 2);
            levels.push(next);
        }
        Pyramid { levels }
    }
}

impl Level {
    /// Every `step`th pixel of every `step`th row after smoothing both ways with a filter that sums to 16, edges
    /// repeated.
    fn smoothed(&self, filter: [u32; 5], step: usize) -> Level {
        let (width, height) = (self.width.div_ceil(step), self.height.div_ceil(step));
        let mut values = Vec::with_capacity(width * height);
        if width == 0 || height == 0 {
            return Level { width, height, values };
        }
        let mut column_sums = vec![0u32; self.width + 4];
        for y in (0..self.height).step_by(step) {
            let row = |offset: isize| {
                let y = (y as isize + offset).clamp(0, self.height as isize - 1) as usize;
                &self.values[y * self.width..(y + 1) * self.width]
            };
            let [r0, r1, r2, r3, r4] = [-2, -1, 0, 1, 2].map(row);
            let sums = &mut column_sums[2..self.width + 2];
            for (x, sum) in sums.iter_mut().enumerate() {
                let outer = u32::from(r0[x]) + u32::from(r4[x]);
                let inner = u32::from(r1[x]) + u32::from(r3[x]);
                *sum = filter[0] * outer + filter[1] * inner + filter[2] * u32::from(r2[x]);
            }
            let (first, last) = (column_sums[2], column_sums[self.width + 1]);
            column_sums[..2].fill(first);
            column_sums[self.width + 2..].fill(last);
            values.extend((0..self.width).step_by(step).map(|x| {
                let s = &column_sums[x..x + 5];
                // At most 256 * 65280: fits; rounded to the nearest.
                ((filter[0] * (s[0] + s[4]) + filter[1] * (s[1] + s[3]) + filter[2] * s[2] + 128) >> 8) as u16
            }));
        }
        Level { width, height, values }
    }

    /// Whether a square patch of `count` samples a side can be interpolated.
    ///
    /// `centre`, `step` (the move in the level from one sample to the next in u and in v) and `bend` (what is added of
    /// second order: factors of uu, uv and vv for each axis) are in pixels of the level.
    pub(super) fn holds(&self, centre: [f64; 2], step: [[f32; 2]; 2], bend: [[f32; 3]; 2], count: usize) -> bool {
        let half = (count / 2) as f64;
        let reach = |axis: usize| {
            let linear = step[axis].iter().map(|value| value.abs()).sum::<f32>();
            let bent = bend[axis].iter().map(|value| value.abs()).sum::<f32>();
            half * (f64::from(linear) + half * f64::from(bent)) + 1.0
        };
        let inside = |axis: usize, size: usize| {
            centre[axis] - reach(axis) >= 1.0 && centre[axis] + reach(axis) <= size as f64 - 3.0
        };
        inside(0, self.width) && inside(1, self.height)
    }

    /// Samples the patch into the start of `into`, row by row, in grey values; the caller has asked [`Level::holds`].
    pub(super) fn sample(
        &self,
        centre: [f64; 2],
        step: [[f32; 2]; 2],
        bend: [[f32; 3]; 2],
        cubic: &Cubic,
        count: usize,
        into: &mut [f32],
    ) {
        let origin = centre.map(f64::floor);
        // From here the rest is small, so that single precision is enough; no patch reaches farther than this.
        let base = BASE as i64;
        let fraction = [(centre[0] - origin[0]) as f32 + BASE, (centre[1] - origin[1]) as f32 + BASE];
        let start = (origin[1] as i64 - base - 1) * self.width as i64 + origin[0] as i64 - base - 1;
        interpolate(&self.values, self.width, start, fraction, step, bend, cubic, count, into);
    }
}

/// Added to offsets within a patch, which makes them positive: to cut off their fraction is to round them down. More
/// than 15 samples to a side at eight pixels a sample along both axes.
const BASE: f32 = 256.0;

/// The inner loop of [`Level::sample`]; offsets count from the pixel that is number `start`, which may be negative.
#[multiversion(targets("x86_64+avx2"))]
#[allow(clippy::too_many_arguments)] // One call.
fn interpolate(
    values: &[u16],
    width: usize,
    start: i64,
    fraction: [f32; 2],
    step: [[f32; 2]; 2],
    bend: [[f32; 3]; 2],
    cubic: &Cubic,
    count: usize,
    into: &mut [f32],
) {
    let half = (count / 2) as f32;
    for (v, row) in into.chunks_exact_mut(count).take(count).enumerate() {
        let v = v as f32 - half;
        // Along a row the warp is a polynomial of u.
        let [start_x, start_y] = [0, 1].map(|axis| fraction[axis] + (step[axis][1] + bend[axis][2] * v) * v);
        let [step_x, step_y] = [0, 1].map(|axis| step[axis][0] + bend[axis][1] * v);
        for (u, value) in row.iter_mut().enumerate() {
            let u = u as f32 - half;
            let (x, y) = (start_x + (step_x + bend[0][0] * u) * u, start_y + (step_y + bend[1][0] * u) * u);
            let (floor_x, floor_y) = (x as i32, y as i32);
            let weights = cubic.weights(x - floor_x as f32, y - floor_y as f32);
            let first = (start + i64::from(floor_y) * width as i64 + i64::from(floor_x)) as usize;
            let mut columns = [0.0f32; 4];
            for (row, &weight) in weights[4..].iter().enumerate() {
                let at = first + row * width;
                let samples: &[u16; 4] = values[at..at + 4].try_into().expect("four values");
                for (column, sample) in columns.iter_mut().zip(samples) {
                    *column += weight * f32::from(*sample);
                }
            }
            let [w0, w1, w2, w3, ..] = weights;
            let sum = (columns[0] * w0 + columns[2] * w2) + (columns[1] * w1 + columns[3] * w3);
            *value = sum * (1.0 / UNITS);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRAIGHT: [[f32; 3]; 2] = [[0.0; 3]; 2];
    const BENT: [[f32; 3]; 2] = [[0.2, -0.1, 0.1], [-0.3, 0.1, 0.2]];

    #[test]
    fn a_ramp_is_reproduced_at_every_level_without_a_shift() {
        let image = GrayImage::from_fn(200, 180, |x, y| image::Luma([(x / 2 + y / 2) as u8]));
        let pyramid = Pyramid::new(&image);
        assert_eq!(pyramid.levels.len(), 3);
        for (number, level) in pyramid.levels.iter().enumerate() {
            let scale = f64::from(1 << number);
            let centre = [100.3 / scale, 90.7 / scale];
            let step = [[0.9, 0.2], [-0.1, 1.1]];
            // The border repeats and bends the ramp; stay away from it.
            assert!(level.holds(centre, step, STRAIGHT, 5));
            let mut patch = [0.0; 25];
            level.sample(centre, step, STRAIGHT, &Cubic::smoothing(0.1), 5, &mut patch);
            let mut bent = [0.0; 25];
            level.sample(centre, step, BENT, &Cubic::smoothing(0.1), 5, &mut bent);
            let change = f64::from(bent[3 * 5 + 4] - patch[3 * 5 + 4]);
            // At u = 2, v = 1: (4 * 0.2 - 2 * 0.1 + 0.1) + (-4 * 0.3 + 2 * 0.1 + 0.2) px, and half a grey value a
            // pixel.
            assert!((change - 0.5 * scale * (0.7 - 0.8)).abs() < 0.3, "{change}");
            assert!((bent[12] - patch[12]).abs() < 1e-6);
            // Halves are rounded down in x and in y by a quarter on average.
            let expected = (100.3 + 90.7) / 2.0 - 0.5;
            assert!((f64::from(patch[12]) - expected).abs() < 0.3, "{} is not {expected}", patch[12]);
        }
    }

    #[test]
    fn any_size_is_prepared() {
        for (width, height) in [(0, 0), (1, 1), (1, 50), (50, 1), (64, 64), (129, 65)] {
            let pyramid = Pyramid::new(&GrayImage::from_pixel(width, height, image::Luma([255])));
            assert!(pyramid.levels.iter().all(|level| level.values.iter().all(|&value| value == 255 * 256)));
            let level = &pyramid.levels[0];
            // What is declared to be inside is so at the very border.
            for x in 0..width {
                for y in 0..height {
                    let centre = [f64::from(x), f64::from(y)];
                    if level.holds(centre, [[1.0, 0.5], [0.5, 1.0]], BENT, 3) {
                        let mut patch = [0.0; 9];
                        level.sample(centre, [[1.0, 0.5], [0.5, 1.0]], BENT, &Cubic::smoothing(1.0), 3, &mut patch);
                        assert!(patch.iter().all(|value| (value - 255.0).abs() < 1e-3));
                    }
                }
            }
        }
    }
}
