//! The second point of a match, refined to a few hundredths of a pixel.
//!
//! A detector finds the same point in two images to some tenths of a pixel. Where the surface around it is smooth, far
//! more is known: the patch around the point of image A, warped as the change of view predicts, is to be found in
//! image B. The point of image A is taken as it is (it *names* the point), the one in image B is moved until the
//! patches agree, by Lucas and Kanade's method (in `align`), and gets a covariance from the gradients of the patch and
//! from what remains of the difference.
//!
//! Large keypoints are first aligned at a coarse level of a pyramid and then at finer ones, as long as that makes the
//! answer more certain.

mod align;
mod pyramid;

pub use pyramid::Pyramid;

use crate::{FeaturesError, KeyPoint};
use align::{Fit, Template, Warp, WarpDof};
use nalgebra::{Matrix2, Point2, Rotation2, Vector2};
use pyramid::{Cubic, Level};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What is refined, how far, and what is accepted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineOptions {
    /// Samples along a side of the patch; odd, from 7 to 31. One sample is one pixel at the level of the keypoint.
    pub patch: usize,
    /// What of the predicted warp may be improved.
    pub model: WarpModel,
    /// Iterations at most, at each level.
    pub max_iterations: usize,
    /// The point may move this many samples at its coarsest level (pixels, for small keypoints).
    pub max_shift: f64,
    /// Least zero-mean normalised correlation of the patches when aligned.
    pub min_correlation: f64,
    /// Largest standard deviation of the refined point in its worst direction, px.
    pub max_sigma_px: f64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        RefineOptions {
            patch: 15,
            model: WarpModel::Affine,
            max_iterations: 12,
            max_shift: 3.0,
            min_correlation: 0.8,
            max_sigma_px: 0.5,
        }
    }
}

/// What of the predicted warp may be improved beside the position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WarpModel {
    /// Nothing: the prediction is trusted (from pose and depth, say).
    Translation,
    /// Its linear part: the prediction is rough (from the scale and orientation of keypoints).
    Affine,
}

/// A match to refine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seed {
    /// The point in image A, px of the image as it is (with its distortion).
    pub in_a: Point2<f64>,
    /// Where it is expected to be in image B, px.
    pub in_b: Point2<f64>,
    /// The predicted change of the patch: a small offset `d` in image A becomes `b_from_a * d` in image B.
    pub b_from_a: Matrix2<f64>,
    /// Diameter of the keypoint in image A, px; chooses the level.
    pub size_px: f64,
}

impl Seed {
    /// A match of two keypoints, its warp from their sizes and orientations.
    pub fn from_keypoints(a: &KeyPoint, b: &KeyPoint) -> Self {
        Seed {
            in_a: Point2::new(f64::from(a.x), f64::from(a.y)),
            in_b: Point2::new(f64::from(b.x), f64::from(b.y)),
            b_from_a: similarity(a, b),
            size_px: f64::from(a.size),
        }
    }
}

/// The change from A's neighbourhood to B's by sizes and orientations.
pub fn similarity(a: &KeyPoint, b: &KeyPoint) -> Matrix2<f64> {
    let turn = Rotation2::new(f64::from(b.angle) - f64::from(a.angle));
    turn.matrix() * (f64::from(b.size) / f64::from(a.size))
}

/// The part of second order of a patch's change: an offset (u, v) px in image A moves what image B shows by `c0 uu + c1
/// uv + c2 vv` px beside the linear part, with three factors for each axis of B, 1/px.
///
/// A plane seen from two places has one (its homography is no affine map), and so has a lens with distortion. It is an
/// even function: over a window it does not cancel, and what is aligned without it lies off by its weighted mean.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Bend(pub [[f64; 3]; 2]);

/// Predicts the [`Bend`] of a match from its linear part and its place in image B (px) as they were found so far.
/// `None` where nothing is known: the change is then taken as affine.
pub type BendPrediction<'a> = &'a dyn Fn(&Matrix2<f64>, &Point2<f64>) -> Option<Bend>;

/// A refined match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// The point in image B that shows what the point in image A shows, px.
    pub in_b: Point2<f64>,
    /// Its covariance, px².
    pub covariance: Matrix2<f64>,
    /// Zero-mean normalised correlation of the patches.
    pub correlation: f64,
    /// The change of the patch as it was found.
    pub b_from_a: Matrix2<f64>,
}

/// Why a match could not be refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rejection {
    /// The patch leaves one of the images.
    OutsideImage,
    /// The patch has too little structure to be found again.
    NoTexture,
    /// The prediction is not finite, turns the patch over, or changes its size more than eightfold.
    BadPrediction,
    /// The point moved farther than allowed, or the patch was distorted beyond belief.
    MovedTooFar,
    /// The iterations did not come to rest.
    NotConverged,
    /// The patches do not look alike.
    PoorCorrelation,
    /// The point is not certain enough.
    Uncertain,
}

/// Samples along a side of the smallest patch that still determines six parameters.
const SMALLEST_PATCH: usize = 7;
/// Keypoint diameter for which one sample is one pixel of the full image (AKAZE's finest level has 4.8).
const FINEST_SIZE_PX: f64 = 5.0;
/// At rest, px of the level: the step after one of this length is a fraction of it.
const AT_REST: f64 = 0.008;
/// Nearly so, px of the level: the linear part then gives the slant of the surface well enough for what is of second
/// order.
const NEARLY_AT_REST: f64 = 0.05;
/// Least contrast (standard deviation) of a patch, grey values.
const MIN_CONTRAST: f64 = 1.0;
/// Noise of neighbouring samples is alike, since the image is smoothed and interpolated: so many samples count as one.
const SAMPLES_IN_ONE: f64 = 4.0 * std::f64::consts::PI * pyramid::SMOOTHING_PX2;
/// What interpolation and sensor leave whatever the noise says, px.
const FLOOR_SIGMA_PX: f64 = 0.005;

impl RefineOptions {
    fn check(&self) -> Result<(), FeaturesError> {
        let bad = |option, got: String, need| Err(FeaturesError::BadOption { option, got, need });
        if !(SMALLEST_PATCH..=31).contains(&self.patch) || self.patch.is_multiple_of(2) {
            return bad("patch", self.patch.to_string(), "an odd number from 7 to 31");
        }
        if !(self.max_shift > 0.0 && self.max_shift.is_finite()) {
            return bad("max_shift", self.max_shift.to_string(), "a positive number of samples");
        }
        if !(self.min_correlation >= -1.0 && self.min_correlation <= 1.0) {
            return bad("min_correlation", self.min_correlation.to_string(), "a number from -1 to 1");
        }
        if self.max_sigma_px.is_nan() || self.max_sigma_px <= 0.0 {
            return bad("max_sigma_px", self.max_sigma_px.to_string(), "a positive number of pixels");
        }
        Ok(())
    }
}

/// Refines matches between two images; the answers are in the order of the seeds.
///
/// Uses rayon's current pool; the result does not depend on it.
///
/// # Errors
/// Options out of range. What is wrong with a single match is its [`Rejection`].
pub fn refine_matches(
    a: &Pyramid,
    b: &Pyramid,
    seeds: &[Seed],
    options: &RefineOptions,
) -> Result<Vec<Result<Refined, Rejection>>, FeaturesError> {
    let refiner = Refiner::new(options)?;
    let refine = |refiner: &mut Refiner, seed: &Seed| refiner.refine(a, b, seed);
    Ok(seeds.par_iter().with_min_len(32).map_init(|| refiner.clone(), refine).collect())
}

/// Refines one match after the other, on the calling thread, with buffers of its own.
#[derive(Debug, Clone)]
pub struct Refiner {
    template: Template,
    /// A smaller window, to compare with; `None` where the window is as small as can be.
    narrow: Option<Template>,
    options: RefineOptions,
}

impl Refiner {
    /// A refiner with these options.
    ///
    /// # Errors
    /// [`FeaturesError::BadOption`].
    pub fn new(options: &RefineOptions) -> Result<Self, FeaturesError> {
        options.check()?;
        let narrow = ((3 * options.patch / 5) | 1).max(SMALLEST_PATCH);
        Ok(Refiner {
            template: Template::new(options.patch),
            narrow: (narrow < options.patch).then(|| Template::new(narrow)),
            options: options.clone(),
        })
    }

    /// Refines a match between image A and image B.
    ///
    /// # Errors
    /// Why the match is not to be used.
    pub fn refine(&mut self, a: &Pyramid, b: &Pyramid, seed: &Seed) -> Result<Refined, Rejection> {
        self.refine_bent(a, b, seed, &|_, _| None)
    }

    /// The same where the part of second order is predicted once the linear part is known roughly; the errors are the
    /// same.
    pub fn refine_bent(
        &mut self,
        a: &Pyramid,
        b: &Pyramid,
        seed: &Seed,
        bend: BendPrediction<'_>,
    ) -> Result<Refined, Rejection> {
        let (refined, level) = refine_one(&mut self.template, a, b, seed, bend, &self.options)?;
        let Some(narrow) = &mut self.narrow else { return Ok(refined) };
        let doubt = disagreement(narrow, [a, b], seed, bend, level, &refined, &self.options);
        let covariance = refined.covariance + doubt;
        let largest = self.options.max_sigma_px * self.options.max_sigma_px;
        if covariance.symmetric_eigenvalues().max() > largest {
            return Err(Rejection::Uncertain);
        }
        Ok(Refined { covariance, ..refined })
    }
}

/// What a smaller window makes of the match beside the larger one, as a covariance of the error that is none of noise.
///
/// Where the surface is a plane both windows see the same point, and they differ by noise with the difference of their
/// covariances: the smaller one uses a part of the larger one's samples (Hausman, "Specification tests in
/// econometrics", 1978). What they differ more is an error of the kind that grows with the window, and the larger one
/// has it at least once.
fn disagreement(
    narrow: &mut Template,
    images: [&Pyramid; 2],
    seed: &Seed,
    bend: BendPrediction<'_>,
    level: usize,
    refined: &Refined,
    options: &RefineOptions,
) -> Matrix2<f64> {
    let from = Seed { in_b: refined.in_b, b_from_a: refined.b_from_a, ..*seed };
    let lax = RefineOptions { min_correlation: -1.0, max_sigma_px: f64::INFINITY, ..options.clone() };
    let Ok(other) = refine_at(narrow, images, &from, bend, level, options.max_shift, &lax) else {
        return Matrix2::zeros();
    };
    let apart = other.in_b - refined.in_b;
    let more = other.covariance - refined.covariance;
    let by_noise = if more.determinant() > 0.0 && more.trace() > 0.0 { more } else { other.covariance };
    let Some(inverse) = by_noise.try_inverse() else { return Matrix2::zeros() };
    // Two is what noise alone makes of it in the mean.
    let squared = apart.dot(&(inverse * apart));
    if squared > 2.0 { apart * apart.transpose() * (1.0 - 2.0 / squared) } else { Matrix2::zeros() }
}

/// Coarse to fine for one match; the answer and the level that gave it.
fn refine_one(
    template: &mut Template,
    a: &Pyramid,
    b: &Pyramid,
    seed: &Seed,
    bend: BendPrediction<'_>,
    options: &RefineOptions,
) -> Result<(Refined, usize), Rejection> {
    let finite = seed.in_a.iter().chain(seed.in_b.iter()).chain(seed.b_from_a.iter()).all(|value| value.is_finite());
    let determinant = seed.b_from_a.determinant();
    if !finite || !(1.0 / 64.0..=64.0).contains(&determinant) || seed.size_px.is_nan() || seed.size_px <= 0.0 {
        return Err(Rejection::BadPrediction);
    }
    let coarsest = (seed.size_px / FINEST_SIZE_PX).log2().round().clamp(0.0, (a.levels.len() - 1) as f64) as usize;
    let mut best: Option<(Refined, usize)> = None;
    let mut from = *seed;
    for level in (0..=coarsest).rev() {
        // Later levels only correct what the coarser one left.
        let reach = if best.is_none() { options.max_shift } else { options.max_shift.min(1.5) };
        match refine_at(template, [a, b], &from, bend, level, reach, options) {
            Ok(refined) => {
                let finer = best.is_none_or(|(best, _)| refined.covariance.trace() < best.covariance.trace());
                if !finer {
                    break;
                }
                best = Some((refined, level));
                (from.in_b, from.b_from_a) = (refined.in_b, refined.b_from_a);
            }
            // The finer level adds nothing, or the coarse one did not fit and the finer might.
            Err(rejection) if level == 0 || best.is_some() => return best.ok_or(rejection),
            Err(_) => {}
        }
    }
    best.ok_or(Rejection::NotConverged)
}

/// Aligns at one level of image A, and at that of image B where a sample is about one pixel.
fn refine_at(
    template: &mut Template,
    [a, b]: [&Pyramid; 2],
    seed: &Seed,
    bend: BendPrediction<'_>,
    level_a: usize,
    reach: f64,
    options: &RefineOptions,
) -> Result<Refined, Rejection> {
    let scale_a = f64::from(1u32 << level_a);
    let magnification = seed.b_from_a.determinant().sqrt();
    let level_b = (level_a as f64 + magnification.log2().round()).clamp(0.0, (b.levels.len() - 1) as f64) as usize;
    let scale_b = f64::from(1u32 << level_b);
    let level = &b.levels[level_b];
    // The image that shows the patch larger is smoothed more, so that both show the same detail.
    let larger_in_b = magnification * scale_a / scale_b;
    let more = |ratio: f64| Cubic::smoothing(pyramid::SMOOTHING_PX2 * (ratio * ratio - 1.0));
    let (cubic_a, cubic_b) = (more(1.0 / larger_in_b), more(larger_in_b));
    if !template.cut(&a.levels[level_a], [seed.in_a.x / scale_a, seed.in_a.y / scale_a], &cubic_a) {
        return Err(Rejection::OutsideImage);
    }
    if template.contrast() < MIN_CONTRAST {
        return Err(Rejection::NoTexture);
    }
    let start = Warp {
        centre: seed.in_b.coords / scale_b,
        linear: seed.b_from_a * (scale_a / scale_b),
        bend: Default::default(),
        cubic: cubic_b,
    };
    let bent = |warp: &Warp| {
        let Bend(factors) = bend(&(warp.linear * (scale_b / scale_a)), &Point2::from(warp.centre * scale_b))?;
        Some(factors.map(|axis| axis.map(|factor| (factor * scale_a * scale_a / scale_b) as f32)))
    };
    let (warp, dof) = come_to_rest(template, level, start, &bent, reach, options)?;
    let Fit { correlation, covariance } = template.fit(&warp, dof).ok_or(Rejection::NoTexture)?;
    if correlation < options.min_correlation {
        return Err(Rejection::PoorCorrelation);
    }
    let floor = Matrix2::identity() * (FLOOR_SIGMA_PX * FLOOR_SIGMA_PX);
    let covariance = (covariance * SAMPLES_IN_ONE + floor) * (scale_b * scale_b);
    if covariance.symmetric_eigenvalues().max() > options.max_sigma_px * options.max_sigma_px {
        return Err(Rejection::Uncertain);
    }
    let in_b: Vector2<f64> = warp.centre * scale_b;
    Ok(Refined { in_b: in_b.into(), covariance, correlation, b_from_a: warp.linear * (scale_b / scale_a) })
}

/// Steps until nothing moves any more; the second-order part is asked for as soon as the linear part is about right.
fn come_to_rest(
    template: &mut Template,
    level: &Level,
    start: Warp,
    bent: &dyn Fn(&Warp) -> Option<[[f32; 3]; 2]>,
    reach: f64,
    options: &RefineOptions,
) -> Result<(Warp, WarpDof), Rejection> {
    let mut warp = start;
    let reach = reach * start.linear.determinant().sqrt();
    let mut dof = WarpDof::Shift;
    let mut is_bent = false;
    for iteration in 0..options.max_iterations {
        let moved = template.step(level, &mut warp, dof).ok_or(Rejection::OutsideImage)?;
        let change = warp.linear.determinant() / start.linear.determinant();
        if (warp.centre - start.centre).norm() > reach || !(0.4..2.5).contains(&change) {
            return Err(Rejection::MovedTooFar);
        }
        match (options.model, dof) {
            // First the shift alone: the linear part of a displaced patch is noise.
            (WarpModel::Affine, WarpDof::Shift) if moved < 0.3 || iteration >= 3 => dof = WarpDof::Affine,
            (WarpModel::Affine, WarpDof::Shift) => {}
            _ if moved < NEARLY_AT_REST && !is_bent => {
                is_bent = true;
                match bent(&warp) {
                    Some(bend) => warp.bend = bend,
                    None if moved < AT_REST => return Ok((warp, dof)),
                    None => {}
                }
            }
            _ if moved < AT_REST => return Ok((warp, dof)),
            _ => {}
        }
    }
    Err(Rejection::NotConverged)
}

#[cfg(test)]
mod tests;
