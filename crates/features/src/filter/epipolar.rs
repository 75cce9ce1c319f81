//! Distances to predicted epipolar lines, and the gate of Eq. (6).

use crate::{FeaturesError, Match};
use nalgebra::{Matrix3, Point2, Vector3};
use serde::{Deserialize, Serialize};

/// What the epipolar gate did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum GateOutcome {
    /// No prediction or no threshold was given; every match passed.
    #[default]
    NotAsked,
    /// The predicted fundamental matrix is zero: the two cameras are in one place (the same posture twice), there
    /// are no epipolar lines, and every match passed.
    NoBaseline,
    /// Matches farther than the threshold from their line in either image were dropped.
    Applied,
}

/// The gate for one pair of images: is a match within a threshold of its predicted lines, in both images?
///
/// With `in_a^T F in_b = 0`, `F in_b` is a line in image A and `F^T in_a` one in image B.
#[derive(Debug, Clone)]
pub(crate) struct Gate {
    fundamental: Matrix3<f64>,
    transposed: Matrix3<f64>,
    threshold_px: f64,
}

impl Gate {
    /// `None` for a zero matrix, which predicts nothing.
    ///
    /// # Errors
    /// A matrix with a number that is not finite, or a threshold that is not positive and finite.
    pub(crate) fn new(fundamental: &Matrix3<f64>, threshold_px: f64) -> Result<Option<Gate>, FeaturesError> {
        if !(threshold_px > 0.0 && threshold_px.is_finite()) {
            let got = threshold_px.to_string();
            return Err(FeaturesError::BadOption { option: "gate_px", got, need: "a positive number of pixels" });
        }
        if let Some(value) = fundamental.iter().find(|value| !value.is_finite()) {
            let what = "the predicted fundamental matrix";
            return Err(FeaturesError::NotFinite { what, value: value.to_string() });
        }
        let largest = fundamental.amax();
        if largest == 0.0 {
            return Ok(None);
        }
        // The scale of F means nothing; a common one keeps squares of lines far from under- and overflow.
        let fundamental = fundamental / largest;
        Ok(Some(Gate { fundamental, transposed: fundamental.transpose(), threshold_px }))
    }

    /// Half the width of the band around a line, px.
    pub(crate) fn half_width_px(&self) -> f64 {
        self.threshold_px
    }

    /// The line in image B for a point of image A, its normal of length one; zero if the point is the epipole.
    pub(crate) fn line_in_b(&self, in_a: &Point2<f64>) -> Vector3<f64> {
        with_unit_normal(self.transposed * in_a.to_homogeneous())
    }

    /// The line in image A for a point of image B, its normal of length one; zero if the point is the epipole.
    pub(crate) fn line_in_a(&self, in_b: &Point2<f64>) -> Vector3<f64> {
        with_unit_normal(self.fundamental * in_b.to_homogeneous())
    }

    /// Whether the point lies within the threshold of the line. An epipole has no line and admits every point.
    #[inline(always)]
    pub(crate) fn admits(&self, line: &Vector3<f64>, point: &Point2<f64>) -> bool {
        (line.x * point.x + line.y * point.y + line.z).abs() <= self.threshold_px
    }

    /// Whether each point lies within the threshold of the other's line.
    pub(crate) fn passes(&self, in_a: &Point2<f64>, in_b: &Point2<f64>) -> bool {
        self.admits(&self.line_in_b(in_a), in_b) && self.admits(&self.line_in_a(in_b), in_a)
    }
}

fn with_unit_normal(line: Vector3<f64>) -> Vector3<f64> {
    // The gate's matrix has entries of at most one: no overflow, and what underflows is the epipole.
    let normal = (line.x * line.x + line.y * line.y).sqrt();
    if normal > 0.0 { line / normal } else { Vector3::zeros() }
}

/// Drops matches of which either point lies farther than `threshold_px` from the line that `fundamental`
/// (`in_a^T F in_b = 0`) predicts for it (paper, 3.2.3; the threshold is `theta_th / theta_h * q_h` of Eq. (6)).
///
/// Positions are undistorted pixels, one a keypoint. A zero matrix drops nothing and says so in the outcome; a baseline
/// so short that the lines are noise cannot be read off the matrix, whose scale means nothing: do not predict then.
///
/// # Errors
/// Numbers that are not finite, a threshold that is not positive, and matches without a position.
pub fn epipolar_gate(
    matches: &mut Vec<Match>,
    positions_a: &[Point2<f64>],
    positions_b: &[Point2<f64>],
    fundamental: &Matrix3<f64>,
    threshold_px: f64,
) -> Result<GateOutcome, FeaturesError> {
    check_matches(matches, positions_a.len(), positions_b.len())?;
    check_positions(positions_a)?;
    check_positions(positions_b)?;
    let Some(gate) = Gate::new(fundamental, threshold_px)? else { return Ok(GateOutcome::NoBaseline) };
    matches.retain(|m| gate.passes(&positions_a[m.a as usize], &positions_b[m.b as usize]));
    Ok(GateOutcome::Applied)
}

/// Refuses indices past the end.
pub(crate) fn check_matches(matches: &[Match], count_a: usize, count_b: usize) -> Result<(), FeaturesError> {
    for m in matches {
        for (index, count, what) in
            [(m.a as usize, count_a, "keypoint of image A"), (m.b as usize, count_b, "keypoint of image B")]
        {
            if index >= count {
                return Err(FeaturesError::NoSuchIndex { what, index, count });
            }
        }
    }
    Ok(())
}

/// Refuses positions that are not finite.
pub(crate) fn check_positions(positions: &[Point2<f64>]) -> Result<(), FeaturesError> {
    match positions.iter().enumerate().find(|(_, p)| !(p.x.is_finite() && p.y.is_finite())) {
        Some((index, p)) => Err(FeaturesError::NotFinite {
            what: "the positions of keypoints",
            value: format!("({}, {}) at index {index}", p.x, p.y),
        }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matching(a: u32, b: u32) -> Match {
        Match { a, b, distance: 10, second_distance: 100 }
    }

    #[test]
    fn a_sideways_camera_has_level_lines() {
        // Translation along x of identical cameras: rows must agree.
        let fundamental = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        let positions_a = [Point2::new(10.0, 50.0), Point2::new(300.0, 70.0)];
        let positions_b = [Point2::new(90.0, 54.9), Point2::new(5.0, 75.1)];
        let mut matches = vec![matching(0, 0), matching(1, 1)];
        let outcome = epipolar_gate(&mut matches, &positions_a, &positions_b, &fundamental, 5.0).unwrap();
        assert_eq!((outcome, matches), (GateOutcome::Applied, vec![matching(0, 0)]));
    }

    #[test]
    fn one_posture_twice_has_no_lines_and_drops_nothing() {
        let positions = [Point2::new(10.0, 50.0)];
        let mut matches = vec![matching(0, 0)];
        let outcome = epipolar_gate(&mut matches, &positions, &positions, &Matrix3::zeros(), 5.0).unwrap();
        assert_eq!((outcome, matches.len()), (GateOutcome::NoBaseline, 1));
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        let positions = [Point2::new(10.0, 50.0)];
        let gate = |matrix: Matrix3<f64>, threshold, b: u32, at: &[Point2<f64>]| {
            epipolar_gate(&mut vec![matching(0, b)], &positions, at, &matrix, threshold)
        };
        let one = Matrix3::identity();
        assert!(matches!(gate(one * f64::NAN, 5.0, 0, &positions), Err(FeaturesError::NotFinite { .. })));
        assert!(matches!(gate(one, f64::NAN, 0, &positions), Err(FeaturesError::BadOption { .. })));
        assert!(matches!(gate(one, 5.0, 1, &positions), Err(FeaturesError::NoSuchIndex { .. })));
        let nowhere = [Point2::new(f64::INFINITY, 0.0)];
        assert!(matches!(gate(one, 5.0, 0, &nowhere), Err(FeaturesError::NotFinite { .. })));
    }
}
