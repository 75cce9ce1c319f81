//! How sharp and how well exposed an image is, for choosing among images of one scene and for warnings.

use image::GrayImage;
use serde::Serialize;

/// Mean squared response of the Laplacian over the image, divided by the variance of the grey values: what fraction of
/// an image's contrast is fine detail. 0 for an even image; motion and defocus lower it. To be compared among images of
/// the same scene and size.
pub fn sharpness(image: &GrayImage) -> f64 {
    let (width, height) = (image.width() as usize, image.height() as usize);
    if width < 3 || height < 3 {
        return 0.0;
    }
    let pixels = image.as_raw();
    let (mut response, mut sum, mut squares) = (0i64, 0i64, 0i64);
    for y in 1..height - 1 {
        let row = |y: usize| &pixels[y * width..(y + 1) * width];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        for x in 1..width - 1 {
            let value = i64::from(here[x]);
            let around = i64::from(here[x - 1]) + i64::from(here[x + 1]) + i64::from(above[x]) + i64::from(below[x]);
            let laplacian = around - 4 * value;
            response += laplacian * laplacian;
            sum += value;
            squares += value * value;
        }
    }
    let count = ((width - 2) * (height - 2)) as f64;
    let variance = squares as f64 / count - (sum as f64 / count).powi(2);
    if variance <= 0.0 { 0.0 } else { response as f64 / count / variance }
}

/// Fractions of pixels at both ends of the scale, and the mean.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Exposure {
    /// Mean grey value, 0 to 255.
    pub mean: f64,
    /// Standard deviation of the grey values.
    pub sd: f64,
    /// Fraction of pixels at 4 or less.
    pub dark: f64,
    /// Fraction of pixels at 251 or more.
    pub bright: f64,
}

/// The exposure of an image.
pub fn exposure(image: &GrayImage) -> Exposure {
    let mut histogram = [0u64; 256];
    image.as_raw().iter().for_each(|&value| histogram[usize::from(value)] += 1);
    let count = image.as_raw().len().max(1) as f64;
    let moment = |power: i32| {
        histogram.iter().enumerate().map(|(value, &count)| (value as f64).powi(power) * count as f64).sum::<f64>()
            / count
    };
    let fraction = |range: &[u64]| range.iter().sum::<u64>() as f64 / count;
    let mean = moment(1);
    Exposure {
        mean,
        sd: (moment(2) - mean * mean).max(0.0).sqrt(),
        dark: fraction(&histogram[..=4]),
        bright: fraction(&histogram[251..]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_lowers_sharpness_and_brightness_does_not_matter() {
        let checks = GrayImage::from_fn(64, 48, |x, y| image::Luma([if (x / 4 + y / 4) % 2 == 0 { 40 } else { 200 }]));
        let blurred = image::imageops::blur(&checks, 1.5);
        let darker = GrayImage::from_fn(64, 48, |x, y| image::Luma([checks.get_pixel(x, y).0[0] / 4]));
        assert!(sharpness(&blurred) < 0.5 * sharpness(&checks));
        assert!((sharpness(&darker) / sharpness(&checks) - 1.0).abs() < 1e-9);
        assert_eq!(sharpness(&GrayImage::new(64, 48)), 0.0);
        assert_eq!(sharpness(&GrayImage::new(2, 2)), 0.0);
    }

    #[test]
    fn exposure_counts_both_ends() {
        let half = GrayImage::from_fn(10, 10, |x, _| image::Luma([if x < 5 { 0 } else { 255 }]));
        assert_eq!(exposure(&half), Exposure { mean: 127.5, sd: 127.5, dark: 0.5, bright: 0.5 });
    }
}
