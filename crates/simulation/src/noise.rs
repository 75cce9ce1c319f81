//! What sensors add: noise on colour, on depth and on the encoders. Each has its seed; an image's noise depends on
//! that and on the image's number, not on what was drawn before.

use crate::SimulationError;
use crate::scene_rng::SceneRng;
use image::RgbImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::DepthImage;

/// Noise of the colour image, in the order in which it is applied.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ColorNoiseOptions {
    /// Seed of this noise.
    pub seed: u64,
    /// Standard deviation of what the sensor adds to each value, grey levels of 255.
    pub sensor_sigma: f64,
    /// Pixels set to a random colour at random places; the paper: 20,000 (section 4.1.1).
    pub colored_pixels: u32,
    /// Side of the Gaussian blur in pixels, odd; 0 or 1: none; the paper: 9. Its sigma is OpenCV's for the size,
    /// `0.3 ((size - 1) / 2 - 1) + 0.8`.
    pub blur_size: u32,
}

impl Default for ColorNoiseOptions {
    /// No noise.
    fn default() -> Self {
        ColorNoiseOptions { seed: 11, sensor_sigma: 0.0, colored_pixels: 0, blur_size: 0 }
    }
}

impl ColorNoiseOptions {
    /// The paper's noise (section 4.1.1): 20,000 coloured pixels, then a 9 x 9 Gaussian blur.
    pub fn paper() -> Self {
        ColorNoiseOptions { colored_pixels: 20_000, blur_size: 9, ..ColorNoiseOptions::default() }
    }

    pub(crate) fn check(&self) -> Result<(), SimulationError> {
        if !(0.0..=255.0).contains(&self.sensor_sigma) {
            return Err(out_of_range("sensor_sigma", self.sensor_sigma, "0 to 255 grey levels are needed"));
        }
        if self.blur_size > 99 || (self.blur_size > 0 && self.blur_size.is_multiple_of(2)) {
            return Err(out_of_range("blur_size", self.blur_size, "0 or an odd number up to 99 is needed"));
        }
        if self.colored_pixels > 100_000_000 {
            return Err(out_of_range("colored_pixels", self.colored_pixels, "at most 100,000,000 are possible"));
        }
        Ok(())
    }

    /// Adds the noise of image number `index`. Errors: an option out of range.
    pub fn apply(&self, image: &mut RgbImage, index: u64) -> Result<(), SimulationError> {
        self.check()?;
        if image.is_empty() {
            return Ok(());
        }
        if self.sensor_sigma > 0.0 {
            self.add_sensor_noise(image, index);
        }
        let mut rng = SceneRng::new(self.seed, 2 * index);
        for _ in 0..self.colored_pixels {
            let (x, y) = (rng.below(image.width() as usize) as u32, rng.below(image.height() as usize) as u32);
            let [r, g, b, _] = rng.bits().to_le_bytes();
            image.put_pixel(x, y, image::Rgb([r, g, b]));
        }
        if self.blur_size > 1 {
            gaussian_blur(image, self.blur_size);
        }
        Ok(())
    }

    fn add_sensor_noise(&self, image: &mut RgbImage, index: u64) {
        // The sum of a word's four bytes is near enough to normal; its variance is 4 (256^2 - 1) / 12.
        let scale = (self.sensor_sigma / (4.0f64 * 65535.0 / 12.0).sqrt()) as f32;
        let row_bytes = 3 * image.width() as usize;
        image.par_chunks_mut(row_bytes).enumerate().for_each(|(row, bytes)| {
            let mut rng = SceneRng::new(self.seed ^ ((row as u64 + 1) << 32), 2 * index + 1);
            for value in bytes {
                let sum: u32 = rng.bits().to_le_bytes().into_iter().map(u32::from).sum();
                let noisy = f32::from(*value) + scale * (sum as f32 - 510.0);
                *value = (noisy + 0.5) as u8;
            }
        });
    }
}

fn out_of_range(option: &'static str, value: impl ToString, need: &'static str) -> SimulationError {
    SimulationError::Option { option, value: value.to_string(), need }
}

/// Weights of a Gaussian of odd `size`, OpenCV's sigma for it.
fn gaussian_kernel(size: u32) -> Vec<f32> {
    let half = f64::from(size / 2);
    let sigma = 0.3 * (half - 1.0) + 0.8;
    let weights: Vec<f64> = (0..size).map(|i| (-0.5 * ((f64::from(i) - half) / sigma).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| (weight / sum) as f32).collect()
}

/// Mirrors an index at the border pixels' centres, as OpenCV's default border does.
fn mirrored(index: i64, size: usize) -> usize {
    if size == 1 {
        return 0;
    }
    let period = 2 * (size as i64 - 1);
    let folded = index.rem_euclid(period);
    folded.min(period - folded) as usize
}

fn gaussian_blur(image: &mut RgbImage, size: u32) {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let kernel = gaussian_kernel(size);
    let half = (size / 2) as usize;
    let row_bytes = 3 * width;
    let mut across = vec![0.0f32; row_bytes * height];
    across.par_chunks_mut(row_bytes).zip(image.par_chunks(row_bytes)).for_each(|(out, bytes)| {
        // The row with its mirrored margins, so that the inner loop is one long vector.
        let mut padded = Vec::with_capacity(row_bytes + 6 * half);
        for column in -(half as i64)..(width + half) as i64 {
            let start = 3 * mirrored(column, width);
            padded.extend(bytes[start..start + 3].iter().map(|&value| f32::from(value)));
        }
        for (tap, weight) in kernel.iter().enumerate() {
            for (out, value) in out.iter_mut().zip(&padded[3 * tap..]) {
                *out += weight * value;
            }
        }
    });
    image.par_chunks_mut(row_bytes).enumerate().for_each_init(
        || vec![0.0f32; row_bytes],
        |sum, (row, bytes)| {
            sum.fill(0.5);
            for (tap, weight) in kernel.iter().enumerate() {
                let source = mirrored(row as i64 + tap as i64 - half as i64, height) * row_bytes;
                for (sum, value) in sum.iter_mut().zip(&across[source..source + row_bytes]) {
                    *sum += weight * value;
                }
            }
            for (byte, value) in bytes.iter_mut().zip(sum.iter()) {
                *byte = *value as u8;
            }
        },
    );
}

/// Noise of the depth image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthNoiseOptions {
    /// Seed of this noise.
    pub seed: u64,
    /// k of `sigma = k z^2`, per metre: the error of triangulation.
    pub depth_sigma_per_m2: f64,
    /// Fraction of the variance that neighbours have in common, 0 to 1.
    pub correlated_fraction: f64,
    /// Distance over which it changes, pixels.
    pub correlation_px: u32,
    /// A step to a neighbour of more than this fraction of the depth is an edge ...
    pub edge_step: f64,
    /// ... and a pixel at an edge has no value with this probability.
    pub edge_hole_probability: f64,
    /// Nothing is measured nearer, metres.
    pub nearest_m: f64,
    /// Nothing is measured farther, metres.
    pub farthest_m: f64,
}

impl Default for DepthNoiseOptions {
    fn default() -> Self {
        DepthNoiseOptions {
            seed: 12,
            depth_sigma_per_m2: 0.003,
            correlated_fraction: 0.5,
            correlation_px: 6,
            edge_step: 0.03,
            edge_hole_probability: 0.85,
            nearest_m: 0.2,
            farthest_m: 4.0,
        }
    }
}

impl DepthNoiseOptions {
    /// An ideal sensor: no noise, no holes, any distance.
    pub fn none() -> Self {
        DepthNoiseOptions {
            depth_sigma_per_m2: 0.0,
            edge_hole_probability: 0.0,
            nearest_m: 0.0,
            farthest_m: 60.0,
            ..DepthNoiseOptions::default()
        }
    }

    pub(crate) fn check(&self) -> Result<(), SimulationError> {
        let fraction = |option, value: f64| {
            if (0.0..=1.0).contains(&value) { Ok(()) } else { Err(out_of_range(option, value, "0 to 1 is needed")) }
        };
        let positive = |option, value: f64| {
            let fine = value >= 0.0 && value.is_finite();
            if fine { Ok(()) } else { Err(out_of_range(option, value, "a finite number of at least 0 is needed")) }
        };
        fraction("correlated_fraction", self.correlated_fraction)?;
        fraction("edge_hole_probability", self.edge_hole_probability)?;
        positive("depth_sigma_per_m2", self.depth_sigma_per_m2)?;
        positive("edge_step", self.edge_step)?;
        positive("nearest_m", self.nearest_m)?;
        positive("farthest_m", self.farthest_m)?;
        if self.correlation_px == 0 {
            return Err(out_of_range("correlation_px", 0, "at least 1 pixel is needed"));
        }
        Ok(())
    }

    /// What the sensor delivers of an exact depth image: noisy, with holes, in whole units of `unit_m` that fit into
    /// 16 bits. Errors: an option out of range.
    pub fn apply(&self, exact: &DepthImage, unit_m: f64, index: u64) -> Result<DepthImage, SimulationError> {
        self.check()?;
        if !(unit_m > 0.0 && unit_m.is_finite()) {
            return Err(out_of_range("unit_m", unit_m, "a positive length in metres is needed"));
        }
        let (width, height) = (exact.width(), exact.height());
        let cell = f64::from(self.correlation_px);
        let columns = (f64::from(width) / cell).ceil() as usize + 2;
        let rows = (f64::from(height) / cell).ceil() as usize + 2;
        let mut rng = SceneRng::new(self.seed, 2 * index);
        let grid: Vec<f64> = (0..columns * rows).map(|_| rng.normal()).collect();
        let mut rng = SceneRng::new(self.seed, 2 * index + 1);
        let (own, common) = ((1.0 - self.correlated_fraction).sqrt(), self.correlated_fraction.sqrt());
        let mut depth_m = Vec::with_capacity(width as usize * height as usize);
        for y in 0..height {
            for x in 0..width {
                // The same number of draws a pixel, whatever is seen: a hole here changes no noise there.
                let (draw, hole) = (rng.normal(), rng.chance(self.edge_hole_probability));
                let Some(z) = exact.at(x, y).map(f64::from) else {
                    depth_m.push(0.0);
                    continue;
                };
                let noise = own * draw + common * smooth(&grid, columns, f64::from(x) / cell, f64::from(y) / cell);
                let noisy = z + self.depth_sigma_per_m2 * z * z * noise;
                let counts = (noisy / unit_m).round();
                let measured = noisy >= self.nearest_m && noisy <= self.farthest_m && counts <= 65535.0;
                let lost = !measured || counts < 1.0 || (hole && self.is_edge(exact, x, y));
                depth_m.push(if lost { 0.0 } else { (counts * unit_m) as f32 });
            }
        }
        Ok(DepthImage::new(width, height, depth_m).expect("quantised depths are finite and not negative"))
    }

    fn is_edge(&self, exact: &DepthImage, x: u32, y: u32) -> bool {
        let Some(z) = exact.at(x, y) else { return false };
        let limit = (self.edge_step as f32) * z;
        (-1i64..=1).any(|dy| {
            (-1i64..=1).any(|dx| {
                let (nx, ny) = (i64::from(x) + dx, i64::from(y) + dy);
                let neighbour =
                    u32::try_from(nx).ok().zip(u32::try_from(ny).ok()).and_then(|(nx, ny)| exact.at(nx, ny));
                neighbour.is_some_and(|neighbour| (neighbour - z).abs() > limit)
            })
        })
    }
}

/// A field of unit variance: bilinear between independent draws, the weights' loss of variance made good.
fn smooth(grid: &[f64], columns: usize, x: f64, y: f64) -> f64 {
    let (column, row) = (x as usize, y as usize);
    let (u, v) = (x.fract(), y.fract());
    let at = |dx: usize, dy: usize| grid[(row + dy) * columns + column + dx];
    let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
    let value = weights[0] * at(0, 0) + weights[1] * at(1, 0) + weights[2] * at(0, 1) + weights[3] * at(1, 1);
    value / weights.iter().map(|weight| weight * weight).sum::<f64>().sqrt()
}

/// The counts of a 16-bit image, 0 where nothing was measured; values beyond 65535 are lost (0).
pub fn depth_counts(depth: &DepthImage, unit_m: f64) -> Vec<u16> {
    depth
        .as_slice()
        .iter()
        .map(|&z| {
            let counts = (f64::from(z) / unit_m).round();
            if counts <= 65535.0 { counts as u16 } else { 0 }
        })
        .collect()
}

/// Noise of the joints: where the arm really was differs from what was written down.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EncoderNoiseOptions {
    /// Seed of this noise.
    pub seed: u64,
    /// Standard deviation of a revolute joint, degrees.
    pub sigma_deg: f64,
    /// Standard deviation of a prismatic joint, millimetres.
    pub sigma_mm: f64,
}

impl Default for EncoderNoiseOptions {
    /// No noise.
    fn default() -> Self {
        EncoderNoiseOptions { seed: 13, sigma_deg: 0.0, sigma_mm: 0.0 }
    }
}

impl EncoderNoiseOptions {
    pub(crate) fn check(&self) -> Result<(), SimulationError> {
        for (option, value) in [("sigma_deg", self.sigma_deg), ("sigma_mm", self.sigma_mm)] {
            if !(0.0..=1000.0).contains(&value) {
                return Err(out_of_range(option, value, "a number from 0 to 1000 is needed"));
            }
        }
        Ok(())
    }

    /// Where the arm was at posture number `index` when the encoders said `joint_values`.
    pub fn apply(
        &self,
        chain: &skclam_kinematics::SerialChain,
        joint_values: &[f64],
        index: u64,
    ) -> Result<Vec<f64>, SimulationError> {
        self.check()?;
        let mut rng = SceneRng::new(self.seed, index);
        let sigma = |joint: &skclam_kinematics::Joint| match joint.kind {
            skclam_kinematics::JointKind::Revolute => self.sigma_deg.to_radians(),
            skclam_kinematics::JointKind::Prismatic => 1e-3 * self.sigma_mm,
        };
        Ok(joint_values.iter().zip(chain.joints()).map(|(value, joint)| value + sigma(joint) * rng.normal()).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_blur_keeps_the_mean_and_spreads_a_point_as_a_gaussian_of_sigma_1_7() {
        let mut image = RgbImage::new(41, 31);
        image.put_pixel(20, 15, image::Rgb([255, 255, 255]));
        let before = gaussian_kernel(9);
        assert!((before.iter().sum::<f32>() - 1.0).abs() < 1e-6);
        gaussian_blur(&mut image, 9);
        let (mut sum, mut square) = (0.0, 0.0);
        for (x, y, pixel) in image.enumerate_pixels() {
            sum += f64::from(pixel[1]);
            square += f64::from(pixel[1]) * (f64::from(x) - 20.0).powi(2);
            assert_eq!(pixel, image.get_pixel(40 - x, 30 - y), "symmetric");
        }
        // Nine taps cut the tails of sigma 1.7; rounding to bytes cuts a little more.
        assert!((sum - 255.0).abs() < 12.0, "{sum}");
        assert!(((square / sum).sqrt() - 1.6).abs() < 0.1, "{}", (square / sum).sqrt());
        assert_eq!([mirrored(-1, 5), mirrored(5, 5), mirrored(-9, 5), mirrored(3, 1)], [1, 3, 1, 0]);
    }

    #[test]
    fn coloured_pixels_and_sensor_noise_have_their_numbers() {
        let grey = RgbImage::from_pixel(640, 480, image::Rgb([128; 3]));
        let mut spotted = grey.clone();
        ColorNoiseOptions { colored_pixels: 20_000, ..Default::default() }.apply(&mut spotted, 0).unwrap();
        let changed = spotted.pixels().filter(|pixel| pixel.0 != [128; 3]).count();
        assert!((18_500..=20_000).contains(&changed), "{changed}: some places are drawn twice");
        let mut noisy = grey.clone();
        let options = ColorNoiseOptions { sensor_sigma: 3.0, ..Default::default() };
        options.apply(&mut noisy, 0).unwrap();
        let variance = noisy.iter().map(|&v| (f64::from(v) - 128.0).powi(2)).sum::<f64>() / noisy.as_raw().len() as f64;
        assert!((variance.sqrt() - 3.0).abs() < 0.05, "{}", variance.sqrt());
        let mut other = grey.clone();
        options.apply(&mut other, 1).unwrap();
        assert_ne!(noisy, other);
    }

    #[test]
    fn depth_noise_grows_with_the_square_and_edges_have_holes() {
        let plane = |z: f32| DepthImage::new(160, 120, vec![z; 160 * 120]).unwrap();
        let options = DepthNoiseOptions::default();
        let sigma = |z: f32| {
            let measured = options.apply(&plane(z), 0.0001, 3).unwrap();
            let errors: Vec<f64> = measured.as_slice().iter().map(|&v| f64::from(v - z)).collect();
            (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
        };
        assert!((sigma(1.0) - 0.003).abs() < 0.0003, "{}", sigma(1.0));
        assert!((sigma(2.0) / sigma(1.0) - 4.0).abs() < 0.05);
        let step: Vec<f32> = (0..160 * 120).map(|i| if i % 160 < 80 { 1.0 } else { 2.0 }).collect();
        let measured = options.apply(&DepthImage::new(160, 120, step).unwrap(), 0.001, 0).unwrap();
        let holes = |x: u32| (0..120).filter(|&y| measured.at(x, y).is_none()).count();
        assert!(holes(79) > 80 && holes(80) > 80 && holes(40) == 0);
        assert_eq!(options.apply(&plane(5.0), 0.001, 0).unwrap().at(3, 3), None, "beyond the range");
        for &z in measured.as_slice() {
            let counts = f64::from(z) / 0.001;
            assert!((counts - counts.round()).abs() < 1e-3, "whole millimetres");
        }
        assert_eq!(depth_counts(&plane(1.234), 0.001)[0], 1234);
    }

    #[test]
    fn wrong_options_are_named() {
        let mut image = RgbImage::new(4, 4);
        let error = ColorNoiseOptions { blur_size: 4, ..Default::default() }.apply(&mut image, 0).unwrap_err();
        assert_eq!(error.to_string(), "blur_size is 4; 0 or an odd number up to 99 is needed");
        let options = DepthNoiseOptions { depth_sigma_per_m2: f64::NAN, ..Default::default() };
        let depth = DepthImage::new(1, 1, vec![1.0]).unwrap();
        assert!(matches!(options.apply(&depth, 0.001, 0), Err(SimulationError::Option { .. })));
    }
}
