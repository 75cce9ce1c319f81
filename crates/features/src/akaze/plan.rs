//! The levels of the scale space: their sizes, scales and times.
//!
//! Level `j` of octave `o` has the standard deviation `sigma = base_sigma 2^(o + j / sublevels)` in pixels of the full
//! resolution and the diffusion time `sigma^2 / 2`. Octave `o` is stored at `1 / 2^o` of the resolution.

use super::fed::time_steps;
use super::options::AkazeOptions;

/// Half the side of the descriptor's square, in units of the level's scale.
pub(crate) const PATTERN_HALF: f32 = 10.0;

/// One level of the scale space.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Level {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Octave; a pixel of this level covers `2^octave` pixels of the image in x and y.
    pub octave: usize,
    /// Standard deviation in pixels of the full resolution.
    pub sigma: f32,
    /// Distance in this level's pixels between the taps of the derivative filters, and the sampling step of the
    /// descriptor.
    pub step: usize,
    /// Keypoints stay so many pixels of this level away from its borders, so that their descriptors lie inside.
    pub border: usize,
    /// FED steps from the level before to this one, already multiplied by 1/2 (the conductivity between two pixels
    /// is the mean of theirs, and the kernels work with the sum).
    pub half_steps: Vec<f32>,
}

impl Level {
    /// Whether any pixel is far enough from the borders to be a keypoint.
    pub(crate) fn searchable(&self) -> bool {
        self.width > 2 * self.border && self.height > 2 * self.border
    }

    /// Pixels of the full resolution a pixel of this level, in one direction.
    pub(crate) fn ratio(&self) -> f32 {
        (1usize << self.octave) as f32
    }

    /// Full-resolution coordinate of a coordinate of this level. Both refer to pixel centres: pixel 0 of octave `o`
    /// averages pixels `0..2^o` and its centre lies at `(2^o - 1) / 2`.
    pub(crate) fn to_image(&self, coordinate: f32) -> f32 {
        coordinate * self.ratio() + 0.5 * (self.ratio() - 1.0)
    }

    /// Inverse of [`Level::to_image`].
    pub(crate) fn level_from_image(&self, coordinate: f32) -> f32 {
        (coordinate - 0.5 * (self.ratio() - 1.0)) / self.ratio()
    }
}

/// The levels of an image of the given size, finest first.
pub(crate) fn levels(width: usize, height: usize, options: &AkazeOptions) -> Vec<Level> {
    let mut levels = Vec::new();
    let mut time_before = 0.0;
    for octave in 0..options.octaves {
        let (w, h) = (width >> octave, height >> octave);
        // The reference stops below 80 x 40; written for either side, a turned image has the same levels.
        if octave > 0 && (w.max(h) < 80 || w.min(h) < 40) {
            break;
        }
        for sublevel in 0..options.sublevels {
            let relative = (sublevel as f64 / options.sublevels as f64).exp2();
            let sigma = f64::from(options.base_sigma) * relative * (1u32 << octave) as f64;
            let step = (f64::from(options.base_sigma) * relative * f64::from(options.derivative_factor)).round();
            let step = (step as usize).max(1);
            let time = 0.5 * sigma * sigma;
            let half_steps = if levels.is_empty() {
                Vec::new()
            } else {
                time_steps(time - time_before).into_iter().map(|t| 0.5 * t).collect()
            };
            time_before = time;
            let border = (PATTERN_HALF * std::f32::consts::SQRT_2 * step as f32).round() as usize + 1;
            levels.push(Level { width: w, height: h, octave, sigma: sigma as f32, step, border, half_steps });
        }
    }
    levels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_levels_of_full_hd() {
        let levels = levels(1920, 1080, &AkazeOptions::default());
        assert_eq!(levels.len(), 16);
        let steps: Vec<usize> = levels[..4].iter().map(|l| l.step).collect();
        assert_eq!(steps, [2, 3, 3, 4]);
        let borders: Vec<usize> = levels[..4].iter().map(|l| l.border).collect();
        assert_eq!(borders, [29, 43, 43, 58]);
        assert_eq!((levels[15].width, levels[15].height, levels[15].octave), (240, 135, 3));
        assert!(levels.windows(2).all(|l| l[1].sigma > l[0].sigma));
    }

    #[test]
    fn small_images_have_fewer_octaves_in_either_orientation() {
        let options = AkazeOptions::default();
        assert_eq!(levels(1, 1, &options).len(), 4);
        for (w, h) in [(640, 120), (200, 90), (79, 300)] {
            assert_eq!(levels(w, h, &options).len(), levels(h, w, &options).len());
        }
    }

    #[test]
    fn pixel_centres_are_kept() {
        let levels = levels(640, 480, &AkazeOptions::default());
        assert_eq!(levels[0].to_image(7.0), 7.0);
        assert_eq!(levels[4].to_image(0.0), 0.5);
        assert_eq!(levels[8].to_image(1.0), 5.5);
        assert_eq!(levels[8].level_from_image(5.5), 1.0);
    }
}
