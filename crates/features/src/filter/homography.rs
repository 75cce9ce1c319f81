//! Whether one homography explains what a fundamental matrix explains: the mark of a plane or of a pure rotation.

use super::ransac::distinct;
use super::seven_point::Normalisation;
use nalgebra::{Matrix3, Point2, SMatrix, SVector};
use rand_chacha::ChaCha8Rng;

/// Samples drawn; with two thirds of the points on a plane, one free of others is missed once in 10^9.
const SAMPLES: usize = 100;

/// The homography `a_from_b` that maps most of the chosen points from B to within the threshold in A, of those through
/// four of them, and how many; `None` if no four determine one.
pub(crate) fn fit(
    in_a: &[Point2<f64>],
    in_b: &[Point2<f64>],
    chosen: &[usize],
    threshold_px: f64,
    random: &mut ChaCha8Rng,
) -> Option<(Matrix3<f64>, usize)> {
    if chosen.len() < 4 {
        return None;
    }
    let points_a: Vec<_> = chosen.iter().map(|&index| in_a[index]).collect();
    let points_b: Vec<_> = chosen.iter().map(|&index| in_b[index]).collect();
    let (of_a, of_b) = (Normalisation::of(&points_a), Normalisation::of(&points_b));
    let to_pixels = of_a.matrix().try_inverse()?;
    let mut best: Option<(Matrix3<f64>, usize)> = None;
    for _ in 0..SAMPLES {
        let sample = distinct::<4>(random, chosen.len());
        let Some(normalised) = from_four(
            &sample.map(|index| of_a.apply(&points_a[index])),
            &sample.map(|index| of_b.apply(&points_b[index])),
        ) else {
            continue;
        };
        let a_from_b = to_pixels * normalised * of_b.matrix();
        let close = |(in_a, in_b): &(&Point2<f64>, &Point2<f64>)| {
            let mapped = a_from_b * in_b.to_homogeneous();
            let (x, y) = (mapped.x / mapped.z - in_a.x, mapped.y / mapped.z - in_a.y);
            x * x + y * y <= threshold_px * threshold_px
        };
        let inliers = points_a.iter().zip(&points_b).filter(close).count();
        if best.is_none_or(|(_, most)| inliers > most) {
            best = Some((a_from_b, inliers));
        }
        if inliers == chosen.len() {
            break;
        }
    }
    best
}

/// The homography through four correspondences, its last entry 1; `None` where they do not determine one.
fn from_four(in_a: &[Point2<f64>; 4], in_b: &[Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let mut matrix = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (point, (a, b)) in in_a.iter().zip(in_b).enumerate() {
        for (axis, value) in [a.x, a.y].into_iter().enumerate() {
            let row = 2 * point + axis;
            let start = 3 * axis;
            (matrix[(row, start)], matrix[(row, start + 1)], matrix[(row, start + 2)]) = (b.x, b.y, 1.0);
            (matrix[(row, 6)], matrix[(row, 7)]) = (-value * b.x, -value * b.y);
            right[row] = value;
        }
    }
    let h = matrix.full_piv_lu().solve(&right)?;
    h.iter().all(|value| value.is_finite()).then(|| Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_points_are_met() {
        let in_b = [(0.0, 0.0), (1.0, 0.1), (0.9, 1.2), (-0.2, 0.8)].map(|(x, y)| Point2::new(x, y));
        let in_a = [(3.0, 1.0), (5.0, 1.5), (4.5, 4.0), (2.0, 3.0)].map(|(x, y)| Point2::new(x, y));
        let homography = from_four(&in_a, &in_b).unwrap();
        for (a, b) in in_a.iter().zip(&in_b) {
            let mapped = homography * b.to_homogeneous();
            assert!((mapped.xy() / mapped.z - a.coords).norm() < 1e-9);
        }
        assert!(from_four(&in_a, &[in_b[0]; 4]).is_none());
    }
}
