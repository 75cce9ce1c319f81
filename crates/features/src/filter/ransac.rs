//! The fundamental matrix in spite of wrong matches: RANSAC with a truncated squared loss and local optimisation.
//!
//! Fischler and Bolles 1981; the loss is that of MSAC (Torr and Zisserman 2000); after each better sample the matrix is
//! fitted again to its inliers (Chum, Matas, Kittler 2003). Planes and pure rotations do not determine F, yet their
//! points satisfy every member of the family that remains: matches are still separated from outliers, the matrix is
//! then one of many and [`FundamentalFit::homography_inliers`] says so.

use super::epipolar::check_positions;
use super::homography;
use super::seven_point::{self, Normalisation};
use crate::FeaturesError;
use nalgebra::{Matrix3, Point2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// How matches are verified by RANSAC.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RansacOptions {
    /// Largest Sampson distance of an inlier, px.
    pub threshold_px: f64,
    /// Probability with which a sample without outliers is to be drawn before it ends.
    pub confidence: f64,
    /// Samples at most.
    pub max_iterations: usize,
    /// Fewer inliers verify nothing; at least 8, since seven points always fit.
    pub min_inliers: usize,
    /// Seed of the samples.
    pub seed: u64,
}

impl Default for RansacOptions {
    fn default() -> Self {
        RansacOptions { threshold_px: 2.0, confidence: 0.999, max_iterations: 2000, min_inliers: 10, seed: 0 }
    }
}

/// A fundamental matrix and the matches that agree with it.
#[derive(Debug, Clone, PartialEq)]
pub struct FundamentalFit {
    /// `in_a^T F in_b = 0`, of rank two, scaled to the largest entry 1.
    pub fundamental: Matrix3<f64>,
    /// Indices of the inliers in what was given, ascending.
    pub inliers: Vec<usize>,
    /// How many of the inliers one homography explains as well. If nearly all: a plane or a pure rotation, and the
    /// matrix is one of many that fit.
    pub homography_inliers: usize,
    /// Samples drawn.
    pub iterations: usize,
}

/// How the verification ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Verification {
    /// Enough matches agree.
    Verified(FundamentalFit),
    /// There are too few matches to verify anything.
    TooFewMatches {
        /// Matches given.
        got: usize,
        /// Matches needed.
        need: usize,
    },
    /// No matrix has enough inliers.
    NoConsensus {
        /// Inliers of the best matrix.
        got: usize,
        /// Inliers needed.
        need: usize,
    },
}

/// Finds the fundamental matrix that most correspondences agree with (`in_a[i]` with `in_b[i]`, undistorted pixels).
///
/// Deterministic for a seed. Runs on the calling thread.
///
/// # Errors
/// Lists of different length, positions that are not finite, options out of range. Too few matches or no consensus are
/// outcomes, no errors.
pub fn verify_epipolar(
    in_a: &[Point2<f64>],
    in_b: &[Point2<f64>],
    options: &RansacOptions,
) -> Result<Verification, FeaturesError> {
    check(in_a, in_b, options)?;
    let need = options.min_inliers.max(8);
    if in_a.len() < need {
        return Ok(Verification::TooFewMatches { got: in_a.len(), need });
    }
    let search = Search::new(in_a, in_b, options.threshold_px);
    let mut random = ChaCha8Rng::seed_from_u64(options.seed);
    let mut best = Scored { fundamental: Matrix3::zeros(), cost: f64::INFINITY };
    let (mut iterations, mut enough) = (0, options.max_iterations);
    while iterations < enough {
        iterations += 1;
        let sample = distinct::<7>(&mut random, in_a.len());
        let points_a = sample.map(|index| search.normalised_a[index]);
        let points_b = sample.map(|index| search.normalised_b[index]);
        for candidate in seven_point::from_seven(&points_a, &points_b) {
            let Some(scored) = search.score(&candidate, best.cost) else { continue };
            best = search.optimise(scored);
            let fraction = search.inliers(&best.fundamental).len() as f64 / in_a.len() as f64;
            enough = enough.min(samples_needed(fraction, options.confidence, options.max_iterations));
        }
    }
    let inliers = search.inliers(&best.fundamental);
    if !best.cost.is_finite() || inliers.len() < need {
        return Ok(Verification::NoConsensus { got: inliers.len(), need });
    }
    let homography_inliers =
        homography::fit(in_a, in_b, &inliers, options.threshold_px, &mut random).map_or(0, |(_, count)| count);
    Ok(Verification::Verified(FundamentalFit {
        fundamental: best.fundamental,
        inliers,
        homography_inliers,
        iterations,
    }))
}

fn check(in_a: &[Point2<f64>], in_b: &[Point2<f64>], options: &RansacOptions) -> Result<(), FeaturesError> {
    if in_a.len() != in_b.len() {
        let what = "points of image B for those of image A";
        return Err(FeaturesError::CountMismatch { what, got: in_b.len(), need: in_a.len() });
    }
    check_positions(in_a)?;
    check_positions(in_b)?;
    if !(options.threshold_px > 0.0 && options.threshold_px.is_finite()) {
        let got = options.threshold_px.to_string();
        return Err(FeaturesError::BadOption { option: "threshold_px", got, need: "a positive number of pixels" });
    }
    if !(options.confidence > 0.0 && options.confidence < 1.0) {
        let got = options.confidence.to_string();
        return Err(FeaturesError::BadOption { option: "confidence", got, need: "a number between 0 and 1" });
    }
    Ok(())
}

/// Samples to draw until one of seven inliers is in them with the wanted probability.
fn samples_needed(fraction: f64, confidence: f64, at_most: usize) -> usize {
    let failure = 1.0 - fraction.powi(7);
    if failure <= 0.0 {
        return 1;
    }
    let needed = ((1.0 - confidence).ln() / failure.ln()).ceil();
    if needed.is_finite() { (needed.max(1.0) as usize).min(at_most) } else { at_most }
}

/// Distinct indices below `count`, which is at least `N`.
pub(super) fn distinct<const N: usize>(random: &mut ChaCha8Rng, count: usize) -> [usize; N] {
    let mut chosen = [usize::MAX; N];
    for place in 0..N {
        chosen[place] = loop {
            let index = random.random_range(0..count as u64) as usize;
            if !chosen[..place].contains(&index) {
                break index;
            }
        };
    }
    chosen
}

struct Scored {
    fundamental: Matrix3<f64>,
    cost: f64,
}

/// The correspondences in pixels and normalised.
struct Search<'a> {
    in_a: &'a [Point2<f64>],
    in_b: &'a [Point2<f64>],
    normalised_a: Vec<Point2<f64>>,
    normalised_b: Vec<Point2<f64>>,
    to_normalised_a: Matrix3<f64>,
    to_normalised_b: Matrix3<f64>,
    threshold_squared: f64,
}

impl<'a> Search<'a> {
    fn new(in_a: &'a [Point2<f64>], in_b: &'a [Point2<f64>], threshold_px: f64) -> Self {
        let (of_a, of_b) = (Normalisation::of(in_a), Normalisation::of(in_b));
        Search {
            in_a,
            in_b,
            normalised_a: in_a.iter().map(|p| of_a.apply(p)).collect(),
            normalised_b: in_b.iter().map(|p| of_b.apply(p)).collect(),
            to_normalised_a: of_a.matrix(),
            to_normalised_b: of_b.matrix(),
            threshold_squared: threshold_px * threshold_px,
        }
    }

    /// A matrix for normalised points, made one for pixels.
    fn for_pixels(&self, normalised: &Matrix3<f64>) -> Matrix3<f64> {
        let fundamental = self.to_normalised_a.transpose() * normalised * self.to_normalised_b;
        let largest = fundamental.amax();
        if largest > 0.0 { fundamental / largest } else { fundamental }
    }

    /// The truncated cost of a matrix for normalised points, if it is below `limit`.
    fn score(&self, normalised: &Matrix3<f64>, limit: f64) -> Option<Scored> {
        let fundamental = self.for_pixels(normalised);
        let mut cost = 0.0;
        for (in_a, in_b) in self.in_a.iter().zip(self.in_b) {
            cost += sampson_squared(&fundamental, in_a, in_b).0.min(self.threshold_squared);
            if cost >= limit {
                return None;
            }
        }
        cost.is_finite().then_some(Scored { fundamental, cost })
    }

    fn inliers(&self, fundamental: &Matrix3<f64>) -> Vec<usize> {
        let close = |&index: &usize| {
            sampson_squared(fundamental, &self.in_a[index], &self.in_b[index]).0 <= self.threshold_squared
        };
        (0..self.in_a.len()).filter(close).collect()
    }

    /// Fits to the inliers again and again, weighted as the Sampson distance asks, as long as the cost falls.
    fn optimise(&self, mut best: Scored) -> Scored {
        for _ in 0..10 {
            let inliers = self.inliers(&best.fundamental);
            if inliers.len() < 8 {
                break;
            }
            let weighted = inliers.iter().map(|&index| {
                let weight = 1.0 / sampson_squared(&best.fundamental, &self.in_a[index], &self.in_b[index]).1;
                let weight = if weight.is_finite() { weight } else { 0.0 };
                (self.normalised_a[index], self.normalised_b[index], weight)
            });
            let better = seven_point::from_many(weighted).and_then(|matrix| self.score(&matrix, best.cost));
            match better {
                Some(better) => best = better,
                None => break,
            }
        }
        best
    }
}

/// The squared Sampson distance in px², and the squared gradient it was divided by. A pair at both epipoles is at 0.
fn sampson_squared(fundamental: &Matrix3<f64>, in_a: &Point2<f64>, in_b: &Point2<f64>) -> (f64, f64) {
    let line_in_a = fundamental * in_b.to_homogeneous();
    let line_in_b_x = fundamental.m11 * in_a.x + fundamental.m21 * in_a.y + fundamental.m31;
    let line_in_b_y = fundamental.m12 * in_a.x + fundamental.m22 * in_a.y + fundamental.m32;
    let algebraic = line_in_a.x * in_a.x + line_in_a.y * in_a.y + line_in_a.z;
    let gradient =
        line_in_a.x * line_in_a.x + line_in_a.y * line_in_a.y + line_in_b_x * line_in_b_x + line_in_b_y * line_in_b_y;
    if gradient > 0.0 { (algebraic * algebraic / gradient, gradient) } else { (0.0, gradient) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Rotation3, Vector3};

    /// Two views of `count` points by a camera with f = 1000 px, a fraction of them replaced by nonsense; with the
    /// truth.
    fn scene(count: usize, outliers: f64, noise_px: f64, plane: bool, move_b: Vector3<f64>) -> [Vec<Point2<f64>>; 2] {
        let mut random = ChaCha8Rng::seed_from_u64(7);
        let mut uniform = |half: f64| (random.random::<f64>() * 2.0 - 1.0) * half;
        let turn = Rotation3::new(Vector3::new(0.05, -0.1, 0.2));
        let project = |p: Vector3<f64>| Point2::new(960.0 + 1000.0 * p.x / p.z, 540.0 + 1000.0 * p.y / p.z);
        let mut views = [Vec::new(), Vec::new()];
        for index in 0..count {
            let depth = if plane { 2.0 } else { 2.0 + uniform(0.6) };
            let in_b = Vector3::new(uniform(0.7), uniform(0.5), depth);
            let mut pair = [project(turn * in_b + move_b), project(in_b)];
            if (index as f64) < outliers * count as f64 {
                pair[0] = Point2::new(960.0 + uniform(900.0), 540.0 + uniform(500.0));
            }
            for (view, p) in views.iter_mut().zip(pair) {
                view.push(Point2::new(p.x + uniform(noise_px), p.y + uniform(noise_px)));
            }
        }
        views
    }

    fn fit(views: &[Vec<Point2<f64>>; 2]) -> FundamentalFit {
        match verify_epipolar(&views[0], &views[1], &RansacOptions::default()).unwrap() {
            Verification::Verified(fit) => fit,
            other => panic!("{other:?}"),
        }
    }

    const SIDEWAYS: Vector3<f64> = Vector3::new(0.2, -0.05, 0.1);

    #[test]
    fn half_of_the_matches_may_be_wrong() {
        let views = scene(300, 0.5, 0.5, false, SIDEWAYS);
        let fit = fit(&views);
        let right = fit.inliers.iter().filter(|&&index| index >= 150).count();
        assert!(right >= 148, "{right} of 150 right matches found");
        // An outlier lands in a band of 2 px to both sides with a chance of a percent.
        assert!(fit.inliers.len() - right <= 8, "{} wrong ones taken", fit.inliers.len() - right);
        assert!(fit.homography_inliers < fit.inliers.len() / 2);
        assert!(fit.fundamental.determinant().abs() < 1e-12);
    }

    #[test]
    fn exact_points_give_the_matrix_exactly() {
        let views = scene(60, 0.0, 0.0, false, SIDEWAYS);
        let fit = fit(&views);
        assert_eq!(fit.inliers.len(), 60);
        for (in_a, in_b) in views[0].iter().zip(&views[1]) {
            assert!(sampson_squared(&fit.fundamental, in_a, in_b).0 < 1e-12);
        }
    }

    #[test]
    fn planes_and_pure_rotations_are_verified_and_named() {
        for (plane, move_b) in [(true, SIDEWAYS), (false, Vector3::zeros())] {
            let fit = fit(&scene(200, 0.3, 0.5, plane, move_b));
            let right = fit.inliers.iter().filter(|&&index| index >= 60).count();
            assert!(right >= 137, "{right} of 140");
            assert!(fit.homography_inliers >= 137, "{}", fit.homography_inliers);
        }
    }

    #[test]
    fn one_image_twice_agrees_with_itself() {
        let views = scene(50, 0.0, 0.0, false, SIDEWAYS);
        let fit = fit(&[views[0].clone(), views[0].clone()]);
        assert_eq!((fit.inliers.len(), fit.homography_inliers), (50, 50));
        // Even if all of it is one point or one line.
        for slope in [0.0, 1.0] {
            let line: Vec<_> = (0..40).map(|x| Point2::new(5.0 + slope * f64::from(x), 7.0)).collect();
            assert!(verify_epipolar(&line, &line, &RansacOptions::default()).is_ok());
        }
    }

    #[test]
    fn noise_alone_has_no_consensus() {
        let views = scene(60, 1.0, 0.0, false, SIDEWAYS);
        let options = RansacOptions { min_inliers: 25, ..Default::default() };
        let end = verify_epipolar(&views[0], &views[1], &options).unwrap();
        assert!(matches!(end, Verification::NoConsensus { need: 25, .. }), "{end:?}");
        let few = verify_epipolar(&views[0][..9], &views[1][..9], &RansacOptions::default()).unwrap();
        assert_eq!(few, Verification::TooFewMatches { got: 9, need: 10 });
    }

    #[test]
    fn a_seed_gives_one_answer() {
        let views = scene(200, 0.4, 1.0, false, SIDEWAYS);
        assert_eq!(fit(&views), fit(&views));
    }

    #[test]
    fn wrong_input_is_refused() {
        let (p, q) = (vec![Point2::new(1.0, 1.0); 20], vec![Point2::new(f64::NAN, 1.0); 20]);
        let options = RansacOptions::default();
        assert!(matches!(verify_epipolar(&p, &p[..19], &options), Err(FeaturesError::CountMismatch { .. })));
        assert!(matches!(verify_epipolar(&p, &q, &options), Err(FeaturesError::NotFinite { .. })));
        let options = RansacOptions { threshold_px: 0.0, ..Default::default() };
        assert!(matches!(verify_epipolar(&p, &p, &options), Err(FeaturesError::BadOption { .. })));
        let options = RansacOptions { confidence: 1.0, ..Default::default() };
        assert!(matches!(verify_epipolar(&p, &p, &options), Err(FeaturesError::BadOption { .. })));
    }
}
