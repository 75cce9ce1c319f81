//! A texture with its mip levels, and the anisotropic filter that reads it.
//!
//! The texel with index i of level 0 covers `[i, i + 1)`, so its centre is at `i + 0.5`, and a texel of the next
//! level covers exactly two: filtering moves nothing. The filter averages trilinear probes along the longer axis of
//! the pixel's footprint (McCormack et al., "Feline", SIGGRAPH 1999, without its Gaussian weights), placed
//! symmetrically about the footprint's centre.

/// Texels in the 8-bit values that the camera will deliver: the simulated camera answers linearly.
#[derive(Debug, Clone)]
pub struct Texture {
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    width: i32,
    height: i32,
    texels: Vec<[u8; 4]>,
}

/// Where a pixel falls on a texture: position and derivatives in texels of level 0.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Footprint {
    pub s: f32,
    pub t: f32,
    /// d(s, t) / d(x) and d(s, t) / d(y) for one pixel to the right and one pixel down.
    pub by_x: (f32, f32),
    pub by_y: (f32, f32),
}

/// More probes than this only matter on surfaces seen almost edge on.
const MAX_PROBES: f32 = 12.0;

impl Texture {
    /// Builds the mip levels. `texels` is row-major with at least one texel; the fourth value is unused.
    pub(crate) fn new(width: usize, height: usize, texels: Vec<[u8; 4]>) -> Self {
        debug_assert!(width > 0 && height > 0 && texels.len() == width * height);
        let mut levels = vec![Level { width: width as i32, height: height as i32, texels }];
        while let Some(level) = levels.last()
            && (level.width > 1 || level.height > 1)
        {
            levels.push(level.halved());
        }
        Texture { levels }
    }

    /// Columns and rows of level 0.
    pub fn size(&self) -> (u32, u32) {
        (self.levels[0].width as u32, self.levels[0].height as u32)
    }

    /// The colour of a texel of level 0; positions beyond the border take the border's.
    pub fn texel(&self, column: i64, row: i64) -> [u8; 3] {
        let level = &self.levels[0];
        let clamp = |index: i64, size: i32| index.clamp(0, i64::from(size) - 1) as usize;
        let [r, g, b, _] = level.texels[clamp(row, level.height) * level.width as usize + clamp(column, level.width)];
        [r, g, b]
    }

    /// The mean colour under a pixel's footprint.
    pub(crate) fn sample(&self, footprint: &Footprint) -> [f32; 4] {
        let Footprint { s, t, by_x, by_y } = *footprint;
        let length_x = (by_x.0 * by_x.0 + by_x.1 * by_x.1).sqrt();
        let length_y = (by_y.0 * by_y.0 + by_y.1 * by_y.1).sqrt();
        let (major, along) = if length_x >= length_y { (length_x, by_x) } else { (length_y, by_y) };
        // The narrow side of the parallelogram is its area over its long side, not the other edge.
        let area = (by_x.0 * by_y.1 - by_x.1 * by_y.0).abs();
        let minor = (area / major.max(1e-6)).max(1e-6);
        let count = (major / minor.max(1.0) + 0.85).clamp(1.0, MAX_PROBES) as u32;
        let probes = count as f32;
        let width = minor.max(major / probes);
        let level = if width <= 1.0 { 0.0 } else { width.log2().min((self.levels.len() - 1) as f32) };
        let fine = level as usize;
        let blend = level - fine as f32;
        let mut sum = [0.0f32; 4];
        for probe in 0..count {
            let offset = (probe as f32 + 0.5) / probes - 0.5;
            let (ps, pt) = (s + offset * along.0, t + offset * along.1);
            self.levels[fine].add_bilinear(ps, pt, fine, 1.0 - blend, &mut sum);
            if blend > 0.0 {
                self.levels[fine + 1].add_bilinear(ps, pt, fine + 1, blend, &mut sum);
            }
        }
        sum.map(|value| value / probes)
    }
}

impl Level {
    fn halved(&self) -> Level {
        let (width, height) = ((self.width + 1) / 2, (self.height + 1) / 2);
        let mut texels = Vec::with_capacity(width as usize * height as usize);
        for row in 0..height {
            let upper = (2 * row * self.width) as usize;
            let lower = ((2 * row + 1).min(self.height - 1) * self.width) as usize;
            for column in 0..width {
                let left = (2 * column) as usize;
                let right = (2 * column + 1).min(self.width - 1) as usize;
                let four = [
                    self.texels[upper + left],
                    self.texels[upper + right],
                    self.texels[lower + left],
                    self.texels[lower + right],
                ];
                let mean = |channel: usize| {
                    let sum: u32 = four.iter().map(|texel| u32::from(texel[channel])).sum();
                    ((sum + 2) / 4) as u8
                };
                texels.push([mean(0), mean(1), mean(2), 0]);
            }
        }
        Level { width, height, texels }
    }

    #[inline]
    fn add_bilinear(&self, s: f32, t: f32, level: usize, weight: f32, sum: &mut [f32; 4]) {
        let scale = 1.0 / (1u32 << level) as f32;
        let (x, y) = (s * scale - 0.5, t * scale - 0.5);
        // Rounding down by hand: the library's floor is a call without SSE 4.1. A float beyond the range of i32
        // saturates, and the clamps bring it back.
        let (x0, y0) = (x as i32, y as i32);
        let (x0, y0) = (x0.saturating_sub(i32::from(x0 as f32 > x)), y0.saturating_sub(i32::from(y0 as f32 > y)));
        let (u, v) = ((x - x0 as f32).clamp(0.0, 1.0), (y - y0 as f32).clamp(0.0, 1.0));
        let left = x0.clamp(0, self.width - 1) as usize;
        let right = x0.saturating_add(1).clamp(0, self.width - 1) as usize;
        let upper = y0.clamp(0, self.height - 1) as usize * self.width as usize;
        let lower = y0.saturating_add(1).clamp(0, self.height - 1) as usize * self.width as usize;
        let (w00, w10) = (weight * (1.0 - u) * (1.0 - v), weight * u * (1.0 - v));
        let (w01, w11) = (weight * (1.0 - u) * v, weight * u * v);
        let (a, b) = (self.texels[upper + left], self.texels[upper + right]);
        let (c, d) = (self.texels[lower + left], self.texels[lower + right]);
        for channel in 0..4 {
            sum[channel] += w00 * f32::from(a[channel])
                + w10 * f32::from(b[channel])
                + w01 * f32::from(c[channel])
                + w11 * f32::from(d[channel]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Texture {
        let texels = (0..64 * 64).map(|i| [(i % 64) as u8 * 2, (i / 64) as u8 * 2, 100, 0]).collect();
        Texture::new(64, 64, texels)
    }

    #[test]
    fn filtering_a_ramp_moves_nothing_at_any_footprint() {
        let texture = ramp();
        for (by_x, by_y) in [
            ((0.3, 0.0), (0.0, 0.3)),
            ((1.7, 0.2), (-0.2, 1.7)),
            ((4.0, 0.0), (0.0, 1.0)),
            ((0.5, 5.5), (-1.0, 0.1)),
            ((3.0, 3.0), (-3.0, 3.0)),
        ] {
            for (s, t) in [(31.3f32, 30.8f32), (28.0, 35.5)] {
                let colour = texture.sample(&Footprint { s, t, by_x, by_y });
                // Texel i has value 2 i and its centre at i + 0.5.
                assert!((colour[0] - 2.0 * (s - 0.5)).abs() < 0.55, "{colour:?} at {s}");
                assert!((colour[1] - 2.0 * (t - 0.5)).abs() < 0.55, "{colour:?} at {t}");
                assert!((colour[2] - 100.0).abs() < 0.01);
            }
        }
    }

    #[test]
    fn odd_sizes_and_far_positions_are_safe() {
        let texture = Texture::new(3, 1, vec![[10, 0, 0, 0], [20, 0, 0, 0], [30, 0, 0, 0]]);
        let far = Footprint { s: 1e30, t: -1e30, by_x: (1e20, 0.0), by_y: (0.0, 1e20) };
        assert!(texture.sample(&far)[0].is_finite());
        assert_eq!(texture.texel(-5, 9), [10, 0, 0]);
    }
}
