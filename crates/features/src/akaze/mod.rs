//! AKAZE: keypoints in a nonlinear scale space and their binary descriptors (Alcantarilla, Nuevo, Bartoli, "Fast
//! Explicit Diffusion for Accelerated Features in Nonlinear Scale Spaces", BMVC 2013).
//!
//! The stages, each in a file of its own:
//!
//! 1. `plan`: levels, scales and times; `fed`: the time steps between them;
//! 2. `initial`: the first level and the contrast factor `k`;
//! 3. `evolve`: diffusion from level to level, first derivatives, determinant of the Hessian and its maxima, in one
//!    sweep of cached rows over each band of the image (`bands`), with the loops over a row in `rows`;
//! 4. `suppress`: extrema over space and neighbouring levels; `peak`: their place between the pixels;
//! 5. `orientation` and `mldb`: main direction and descriptor;
//! 6. `select`: a limit on the number of keypoints.
//!
//! A level is described as soon as the level above it has been searched, so that only two levels are in memory at any
//! time. The result does not depend on the number of threads or on the instruction set.
//!
//! Differences from OpenCV's implementation, each measured in `benchmarks/features`:
//!
//! - descriptor and orientation are sampled about the keypoint's true centre at every octave, and symmetrically;
//! - neighbourhoods are symmetric and do not depend on the order of the search;
//! - the window that finds the main direction has soft ends (`orientation`);
//! - the position is fitted to as many pixels as the level's filters span (`peak`);
//! - odd rows and columns are dropped when the resolution is halved, so that an octave is exactly twice as coarse.
//!
//! The reference's scale of a keypoint is that of its level, and so is this one's: a parabola over the responses of the
//! neighbouring levels was tried and made the scale worse (rms error of its logarithm 0.13 to 0.18 instead of 0.07 to
//! 0.14 under zooms of 0.8 to 1.4), since the derivative filters' integer steps and the edge-stopping diffusion make
//! the responses uneven over the levels.

mod bands;
mod evolve;
mod fed;
mod initial;
mod mldb;
mod options;
mod orientation;
mod peak;
mod plan;
#[cfg(test)]
mod reference;
mod rows;
mod select;
mod suppress;

pub use options::{AkazeOptions, Diffusivity, Orientation, Threading};

use crate::{Descriptor, Features, FeaturesError, KeyPoint};
use evolve::{BandOutput, BandScratch, Candidate, LevelTask};
use image::GrayImage;
use initial::InitialScratch;
use orientation::Disc;
use plan::Level;
use rayon::prelude::*;
use suppress::{LevelMaxima, Rows};

/// Largest supported image: its two levels in memory take 24 bytes a pixel.
const MAX_PIXELS: u64 = 1 << 28;

/// Detector and descriptor with the buffers that it reuses from image to image.
#[derive(Debug)]
pub struct Akaze {
    options: AkazeOptions,
    disc: Disc,
    planes: [Plane; 2],
    halved: Vec<f32>,
    initial: Vec<InitialScratch>,
    bands: Vec<BandScratch>,
    /// All maxima of the current level.
    maxima: Rows,
    /// Those of the current level and of the one before that may become keypoints.
    maxima_pair: [LevelMaxima; 2],
}

/// What stays of a level until its keypoints are described.
#[derive(Debug, Default)]
struct Plane {
    image: Vec<f32>,
    gradient: Vec<[f32; 2]>,
}

impl Akaze {
    /// A detector with the given options, which are checked when it is used.
    pub fn new(options: AkazeOptions) -> Self {
        Akaze {
            options,
            disc: Disc::new(),
            planes: Default::default(),
            halved: Vec::new(),
            initial: Vec::new(),
            bands: Vec::new(),
            maxima: Rows::default(),
            maxima_pair: Default::default(),
        }
    }

    /// The options it was made with.
    pub fn options(&self) -> &AkazeOptions {
        &self.options
    }

    /// Keypoints of a grey image and their descriptors, finest level first and row by row within a level.
    ///
    /// Where the `mask`, of the image's size, is 0, keypoints are left out. An image in which nothing can be found
    /// (too small, or flat) gives no keypoints.
    ///
    /// # Errors
    /// [`FeaturesError::BadOption`], [`FeaturesError::MaskSize`] and [`FeaturesError::ImageTooLarge`] (2^28 pixels).
    pub fn detect_and_describe(
        &mut self,
        image: &GrayImage,
        mask: Option<&GrayImage>,
    ) -> Result<Features, FeaturesError> {
        self.options.check()?;
        let (width, height) = image.dimensions();
        if let Some(mask) = mask.filter(|m| m.dimensions() != image.dimensions()) {
            let (mask_width, mask_height) = mask.dimensions();
            return Err(FeaturesError::MaskSize { width, height, mask_width, mask_height });
        }
        if u64::from(width) * u64::from(height) > MAX_PIXELS {
            return Err(FeaturesError::ImageTooLarge { width, height, max_pixels: MAX_PIXELS });
        }
        let levels = plan::levels(width as usize, height as usize, &self.options);
        let mut features = Features::default();
        if !levels[0].searchable() {
            return Ok(features);
        }

        let mut contrast = self.prepare(image, &levels[0]);
        let blur = initial::small_blur();
        for (i, level) in levels.iter().enumerate() {
            let (this, before) = (i % 2, (i + 1) % 2);
            if i > 0 && level.octave > levels[i - 1].octave {
                self.halve(before, &levels[i - 1], level);
                // The gradients of a halved image are steeper; the reference lowers the factor all the same.
                contrast *= 0.75;
            }
            self.evolve(i, &levels, contrast, &blur);
            let [a, b] = &mut self.maxima_pair;
            let (maxima_this, maxima_before) = if this == 0 { (a, b) } else { (b, a) };
            maxima_this.fill(&self.maxima, level);
            if i > 0 {
                suppress::suppress_between(maxima_before, &levels[i - 1], maxima_this, level);
                self.describe(i - 1, &levels, mask, &mut features);
            }
        }
        self.describe(levels.len() - 1, &levels, mask, &mut features);

        if let Some(limit) = self.options.max_keypoints {
            let chosen = select::spread(&features.keypoints, width, height, limit);
            features = Features {
                keypoints: chosen.iter().map(|&i| features.keypoints[i]).collect(),
                descriptors: chosen.iter().map(|&i| features.descriptors[i]).collect(),
            };
        }
        Ok(features)
    }

    /// Makes the first level; returns the contrast factor.
    fn prepare(&mut self, image: &GrayImage, level: &Level) -> f32 {
        let pixels = level.width * level.height;
        for plane in &mut self.planes {
            plane.image.resize(plane.image.len().max(pixels), 0.0);
            plane.gradient.resize(plane.gradient.len().max(pixels), [0.0; 2]);
        }
        let [first, second] = &mut self.planes;
        initial::first_level_and_contrast(
            image.as_raw(),
            level.width,
            &self.options,
            &mut self.initial,
            &mut first.image[..pixels],
            &mut second.image[..pixels],
        )
    }

    /// The last level of an octave at half the resolution, as the next octave's beginning.
    fn halve(&mut self, before: usize, fine: &Level, coarse: &Level) {
        let pixels = coarse.width * coarse.height;
        self.halved.resize(self.halved.len().max(pixels), 0.0);
        let image = &self.planes[before].image;
        for (y, out) in self.halved[..pixels].chunks_exact_mut(coarse.width).enumerate() {
            let (upper, lower) = image[2 * y * fine.width..][..2 * fine.width].split_at(fine.width);
            rows::halve(upper, lower, out);
        }
    }

    /// Makes level `index` from the one before and finds its maxima.
    fn evolve(&mut self, index: usize, levels: &[Level], contrast: f32, blur: &[f32]) {
        let level = &levels[index];
        let (width, height) = (level.width, level.height);
        let pixels = width * height;
        let threading = self.options.threading;
        let count = bands::band_count(height, threading);
        if self.bands.len() < count {
            self.bands.resize_with(count, BandScratch::default);
        }
        let [a, b] = &mut self.planes;
        let (this, before) = if index.is_multiple_of(2) { (a, b) } else { (b, a) };
        let new_octave = index > 0 && level.octave > levels[index - 1].octave;
        let (source, images) = if index == 0 {
            (&this.image[..pixels], None)
        } else {
            let source = if new_octave { &self.halved[..pixels] } else { &before.image[..pixels] };
            (source, Some(bands::split_rows(&mut this.image[..pixels], width, height, count)))
        };
        let task = LevelTask {
            level,
            source,
            diffusivity: self.options.diffusivity,
            inverse_k2: 1.0 / (contrast * contrast),
            blur: (index > 0).then_some(blur),
            threshold: self.options.threshold,
        };
        let images: Vec<Option<&mut [f32]>> = match images {
            Some(images) => images.into_iter().map(Some).collect(),
            None => (0..count).map(|_| None).collect(),
        };
        let gradients = bands::split_rows(&mut this.gradient[..pixels], width, height, count);
        let jobs: Vec<_> = images.into_iter().zip(gradients).zip(&mut self.bands).enumerate().collect();
        bands::for_each(jobs, threading, |(i, ((image, gradient), scratch))| {
            let range = bands::band(height, i, count);
            let gradient = level.searchable().then_some(gradient);
            evolve::run_band(&task, scratch, BandOutput { range, image, gradient });
        });
        let found = self.bands[..count].iter().flat_map(|band| band.candidates.iter().copied());
        self.maxima.fill(found, height);
    }

    /// Appends the keypoints of level `index`, both of whose neighbours have been searched.
    fn describe(&self, index: usize, levels: &[Level], mask: Option<&GrayImage>, features: &mut Features) {
        let level = &levels[index];
        let plane = &self.planes[index % 2];
        let maxima_pair = &self.maxima_pair[index % 2];
        let points: Vec<(KeyPoint, [f32; 2])> = (0..maxima_pair.kept.points.len())
            .filter(|&i| maxima_pair.is_extremum(i))
            .filter_map(|i| keypoint(&maxima_pair.kept.points[i], level, index, self.options.derivative_factor))
            .filter(|(k, _)| mask.is_none_or(|m| unmasked(m, k)))
            .collect();
        let complete = |&(mut keypoint, centre): &(KeyPoint, [f32; 2])| -> (KeyPoint, Descriptor) {
            let (width, step) = (level.width, level.step);
            let gradient = &plane.gradient[..];
            if self.options.orientation == Orientation::Main {
                let [x, y] = centre.map(|c| c.round() as usize);
                keypoint.angle = orientation::main_direction(gradient, width, x, y, step, &self.disc);
            }
            let direction = [keypoint.angle.cos(), keypoint.angle.sin()];
            let square = mldb::Square { centre, step: step as f32, direction };
            (keypoint, mldb::describe(&plane.image, gradient, width, square))
        };
        let described: Vec<(KeyPoint, Descriptor)> = match self.options.threading {
            Threading::RowBands => points.par_iter().with_min_len(64).map(complete).collect(),
            Threading::Caller => points.iter().map(complete).collect(),
        };
        for (keypoint, descriptor) in described {
            features.keypoints.push(keypoint);
            features.descriptors.push(descriptor);
        }
    }
}

/// The keypoint at a maximum and its centre in the level's pixels; none where the maximum is not stable.
fn keypoint(at: &Candidate, level: &Level, index: usize, derivative_factor: f32) -> Option<(KeyPoint, [f32; 2])> {
    let offset = at.offset?;
    let centre = [at.x as f32 + offset[0], at.y as f32 + offset[1]];
    let keypoint = KeyPoint {
        x: level.to_image(centre[0]),
        y: level.to_image(centre[1]),
        size: 2.0 * level.sigma * derivative_factor,
        angle: 0.0,
        response: at.response,
        octave: level.octave as u16,
        level: index as u16,
    };
    Some((keypoint, centre))
}

/// Whether the mask is not 0 at the pixel of a keypoint.
fn unmasked(mask: &GrayImage, keypoint: &KeyPoint) -> bool {
    let [x, y] = [keypoint.x, keypoint.y].map(|c| c.round().max(0.0) as u32);
    mask.get_pixel(x.min(mask.width() - 1), y.min(mask.height() - 1)).0[0] != 0
}
