//! The first level of the scale space, and the contrast factor of the diffusion.
//!
//! The first level is the image, grey levels in [0, 1], convolved with a Gaussian of `base_sigma`. The contrast factor
//! `k` is a quantile of the magnitudes of Scharr's gradient after a Gaussian of 1 pixel, without the border pixels and
//! without the lowest of 300 bins (flat background).

use super::bands::{Ring, band, band_count, for_each, mirrored, split_rows};
use super::options::AkazeOptions;
use super::rows;

/// Contrast factor of an image without gradients.
const FLAT_CONTRAST: f32 = 0.03;
/// Bins of the histogram of gradient magnitudes.
const BINS: usize = 300;

/// Weights of a Gaussian from its centre outwards, cut at `radius` and normalised.
pub(crate) fn gaussian_taps(sigma: f64, radius: usize) -> Vec<f32> {
    let weight = |i: usize| (-0.5 * (i as f64 / sigma).powi(2)).exp();
    let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
    (0..=radius).map(|i| (weight(i) / sum) as f32).collect()
}

/// Radius at which the reference cuts a Gaussian: size `2 (1 + (sigma - 0.8) / 0.3)`, rounded up to an odd number.
pub(crate) fn gaussian_radius(sigma: f64) -> usize {
    let size = (2.0 * (1.0 + (sigma - 0.8) / 0.3)).ceil() as usize | 1;
    (size / 2).clamp(2, rows::MAX_BLUR_RADIUS)
}

/// Weights of the small blur before gradients are taken: 1 pixel, 5 x 5.
pub(crate) fn small_blur() -> Vec<f32> {
    gaussian_taps(1.0, 2)
}

/// Buffers of one band.
#[derive(Debug, Default)]
pub(crate) struct InitialScratch {
    grey: Ring,
    smooth: Ring,
    lines: [Vec<f32>; 2],
    histogram: Vec<u32>,
    maximum: f32,
}

/// Makes the first level into `first` and returns the contrast factor. `magnitude` is working memory of the same size.
pub(crate) fn first_level_and_contrast(
    grey: &[u8],
    width: usize,
    options: &AkazeOptions,
    scratch: &mut Vec<InitialScratch>,
    first: &mut [f32],
    magnitude: &mut [f32],
) -> f32 {
    let height = grey.len() / width;
    let count = band_count(height, options.threading);
    if scratch.len() < count {
        scratch.resize_with(count, InitialScratch::default);
    }
    let sigma = f64::from(options.base_sigma);
    let (large, small) = (gaussian_taps(sigma, gaussian_radius(sigma)), small_blur());

    let jobs: Vec<_> = split_rows(first, width, height, count)
        .into_iter()
        .zip(split_rows(magnitude, width, height, count))
        .zip(scratch.iter_mut())
        .enumerate()
        .collect();
    for_each(jobs, options.threading, |(index, ((first, magnitude), scratch))| {
        let range = band(height, index, count);
        blur_band(grey, width, height, range, [&large, &small], scratch, first, magnitude);
    });

    let maximum = scratch[..count].iter().fold(0.0f32, |m, s| m.max(s.maximum));
    if maximum <= 0.0 || width < 3 || height < 3 {
        return FLAT_CONTRAST;
    }
    let to_bin = (BINS - 1) as f32 / maximum;
    let magnitude = &*magnitude;
    let jobs: Vec<_> = scratch[..count].iter_mut().enumerate().collect();
    for_each(jobs, options.threading, |(index, scratch)| {
        // Four histograms in turn: successive pixels are alike and would wait for each other's increments.
        scratch.histogram.clear();
        scratch.histogram.resize(4 * BINS, 0);
        for y in band(height, index, count).start.max(1)..band(height, index, count).end.min(height - 1) {
            for (x, &m) in magnitude[y * width..][..width][1..width - 1].iter().enumerate() {
                scratch.histogram[(x & 3) * BINS + ((m * to_bin) as usize).min(BINS - 1)] += 1;
            }
        }
    });
    let mut histogram = [0u64; BINS];
    for scratch in &scratch[..count] {
        for (i, &n) in scratch.histogram.iter().enumerate() {
            histogram[i % BINS] += u64::from(n);
        }
    }
    quantile(&histogram, maximum, options.contrast_percentile)
}

/// The magnitude below which the fraction `percentile` of all but the first bin lies.
fn quantile(histogram: &[u64; BINS], maximum: f32, percentile: f32) -> f32 {
    let wanted = (histogram[1..].iter().sum::<u64>() as f64 * f64::from(percentile)) as u64;
    let mut below = 0;
    for (bin, &n) in histogram.iter().enumerate().skip(1) {
        if below >= wanted {
            return maximum * bin as f32 / BINS as f32;
        }
        below += n;
    }
    FLAT_CONTRAST
}

/// One band of the first level and of the gradient's magnitude.
#[allow(clippy::too_many_arguments)]
fn blur_band(
    grey: &[u8],
    width: usize,
    height: usize,
    range: std::ops::Range<usize>,
    [large, small]: [&[f32]; 2],
    scratch: &mut InitialScratch,
    first: &mut [f32],
    magnitude: &mut [f32],
) {
    let InitialScratch { grey: float, smooth, lines, maximum, .. } = scratch;
    let (r_large, r_small) = (large.len() - 1, small.len() - 1);
    // The magnitude reads one row of the small blur around, which reads `r_small` rows of the image.
    let reach = r_large.max(r_small + 1);
    float.reset(width, 2 * reach + 1);
    smooth.reset(width, 3);
    for line in lines.iter_mut() {
        line.resize(line.len().max(width + 2 * reach), 0.0);
    }
    *maximum = 0.0;
    let top = range.start.saturating_sub(reach);
    let [line, line2] = lines;
    for t in top..range.end + reach {
        if t < height {
            rows::to_float(&grey[t * width..][..width], float.row_mut(t));
        }
        let replicated = |y: isize| y.clamp(0, height as isize - 1) as usize;
        // Row `t - r` has all of its neighbours now, down to row `t`.
        if t >= range.start + r_large && t - r_large < range.end {
            let y = t - r_large;
            let mut around: [&[f32]; 2 * rows::MAX_BLUR_RADIUS + 1] = Default::default();
            for (j, row) in around[..=2 * r_large].iter_mut().enumerate() {
                *row = float.row(replicated((y + j) as isize - r_large as isize));
            }
            rows::blur(&around[..=2 * r_large], large, line, &mut first[(y - range.start) * width..][..width]);
        }
        if t >= r_small && t - r_small < height && t - r_small + 1 >= range.start && t - r_small <= range.end {
            let y = t - r_small;
            let around: [&[f32]; 5] = std::array::from_fn(|j| float.row(replicated((y + j) as isize - 2)));
            rows::blur(&around, small, line, smooth.row_mut(y));
        }
        if t > r_small && t - r_small > range.start && t - r_small <= range.end {
            let y = t - r_small - 1;
            let around = [-1, 0, 1].map(|d| smooth.row(mirrored(y as isize + d, height)));
            let out = &mut magnitude[(y - range.start) * width..][..width];
            rows::gradient_magnitude(around, [line, line2], out);
            if y > 0 && y + 1 < height && width > 2 {
                *maximum = maximum.max(rows::maximum(&out[1..width - 1]));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaussians_are_normalised_and_fall() {
        for (sigma, radius) in [(1.0, 2), (1.6, 4), (3.0, 8)] {
            let taps = gaussian_taps(sigma, radius);
            let sum: f32 = taps[0] + 2.0 * taps[1..].iter().sum::<f32>();
            assert!((sum - 1.0).abs() < 1e-6);
            assert!(taps.windows(2).all(|t| t[1] < t[0]));
        }
        assert_eq!(gaussian_radius(1.6), 4);
    }

    #[test]
    fn the_quantile_leaves_out_the_background() {
        let mut histogram = [0u64; BINS];
        histogram[0] = 1_000_000;
        (histogram[10], histogram[100], histogram[200]) = (60, 20, 20);
        assert_eq!(quantile(&histogram, 3.0, 0.7), 3.0 * 101.0 / 300.0);
    }
}
