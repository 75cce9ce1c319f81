//! Whether the corners of a grid lie on a plane, and how far they scatter about it.
//!
//! A homography takes the counted corners of a plane to the image. What a lens adds is smooth over the board: a
//! polynomial of low degree over the image takes it up, as far as there are corners to carry it. What is then left is
//! the scatter of the corners; corners far beyond it are none of the board, and a grid that scatters by a fair part of
//! its squares is no board at all.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A corner as counted and as seen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counted {
    pub column: f64,
    pub row: f64,
    pub x: f64,
    pub y: f64,
}

/// How a grid fits a plane.
#[derive(Debug, Clone)]
pub(super) struct PlaneFit {
    /// Which of the corners belong to it.
    pub keeps: Vec<bool>,
    /// Scatter of those along an axis, px.
    pub scatter_px: f64,
}

/// Samples of four corners from which the fit may start.
const SAMPLES: usize = 80;
/// A lens bends a board by less than this from the homography through four of its corners, in squares.
const MAX_BEND: f64 = 0.35;
/// Rounds of weighting.
const ROUNDS: usize = 8;
/// Corners beyond so many sigma are weighted zero (Tukey's biweight).
const TUKEY: f64 = 4.685;
/// A corner so many sigma off, and by the first part of a square, is none; nor is one by the second part.
const OUTLIER_SIGMAS: f64 = 8.0;
const OUTLIER_SQUARES: (f64, f64) = (0.015, 0.12);
/// A grid that scatters by more than this part of a square is none.
const MAX_SCATTER_SQUARES: f64 = 0.05;
/// Corners from which a polynomial is fitted besides the homography, its degree, and the parameters of both.
const FOR_DEGREE: [(usize, i32, f64); 4] = [(0, 1, 8.0), (14, 2, 12.0), (24, 3, 20.0), (60, 5, 42.0)];

/// The homography from (column, row) to pixels by weighted least squares; `None` where the corners do not determine it.
pub(super) fn homography(corners: &[Counted], weights: &[f64]) -> Option<Matrix3<f64>> {
    let total: f64 = weights.iter().sum();
    let mean = |pick: fn(&Counted) -> f64| corners.iter().zip(weights).map(|(c, w)| w * pick(c)).sum::<f64>() / total;
    let middle = [mean(|c| c.column), mean(|c| c.row), mean(|c| c.x), mean(|c| c.y)];
    let spread = |a: fn(&Counted) -> f64, b: fn(&Counted) -> f64, at: usize| {
        let square = |c: &Counted| (a(c) - middle[at]).powi(2) + (b(c) - middle[at + 1]).powi(2);
        (corners.iter().zip(weights).map(|(c, w)| w * square(c)).sum::<f64>() / total).sqrt()
    };
    let (board, image) = (spread(|c| c.column, |c| c.row, 0), spread(|c| c.x, |c| c.y, 2));
    let usable = total > 0.0 && board > 0.0 && image > 0.0;
    if !usable {
        return None;
    }
    let to_unit =
        |scale: f64, x: f64, y: f64| Matrix3::new(scale, 0.0, -scale * x, 0.0, scale, -scale * y, 0.0, 0.0, 1.0);
    let unit_from_board = to_unit(1.0 / board, middle[0], middle[1]);
    let unit_from_image = to_unit(1.0 / image, middle[2], middle[3]);
    let mut h = Matrix3::identity();
    // The algebraic residual is the geometric one times the third coordinate: divided out by the one before.
    for _ in 0..3 {
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for (corner, weight) in corners.iter().zip(weights) {
            let p = unit_from_board * Vector3::new(corner.column, corner.row, 1.0);
            let q = unit_from_image * Vector3::new(corner.x, corner.y, 1.0);
            let depth = (h.row(2) * p)[0];
            let weight = weight / (depth * depth);
            let rows = [
                (SVector::<f64, 8>::from([p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y]), q.x),
                (SVector::<f64, 8>::from([0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y]), q.y),
            ];
            for (row, value) in rows {
                normal += weight * row * row.transpose();
                right += weight * value * row;
            }
        }
        // Corners on a line leave the normal matrix singular.
        let diagonal = normal.diagonal().max();
        let solved = normal.cholesky().filter(|factor| factor.l_dirty().diagonal().min().powi(2) > 1e-9 * diagonal)?;
        let h8 = solved.solve(&right);
        h = Matrix3::new(h8[0], h8[1], h8[2], h8[3], h8[4], h8[5], h8[6], h8[7], 1.0);
    }
    Some(unit_from_image.try_inverse()? * h * unit_from_board)
}

/// Where a homography takes a point.
pub(super) fn project(h: &Matrix3<f64>, x: f64, y: f64) -> (f64, f64) {
    let p = h * Vector3::new(x, y, 1.0);
    (p.x / p.z, p.y / p.z)
}

/// What a homography and a polynomial of the given degree leave of the corners, px.
fn residuals(corners: &[Counted], weights: &[f64], degree: i32) -> Option<Vec<(f64, f64)>> {
    let h = homography(corners, weights)?;
    let left: Vec<(f64, f64)> = corners
        .iter()
        .map(|corner| {
            let (x, y) = project(&h, corner.column, corner.row);
            (corner.x - x, corner.y - y)
        })
        .collect();
    if degree < 2 {
        return Some(left);
    }
    // A lens bends by where the image is, not by where the board is.
    let places: Vec<(f64, f64)> =
        corners.iter().zip(&left).map(|(corner, r)| (corner.x - r.0, corner.y - r.1)).collect();
    let range = |pick: fn(&(f64, f64)) -> f64| {
        let (low, high) = places.iter().map(pick).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
        (0.5 * (low + high), (0.5 * (high - low)).max(1.0))
    };
    let (across, down) = (range(|place| place.0), range(|place| place.1));
    let powers: Vec<(i32, i32)> = (0..=degree).flat_map(|a| (0..=degree - a).map(move |b| (a, b))).collect();
    let basis = DMatrix::from_fn(corners.len(), powers.len(), |at, k| {
        let (u, v) = ((places[at].0 - across.0) / across.1, (places[at].1 - down.0) / down.1);
        u.powi(powers[k].0) * v.powi(powers[k].1)
    });
    let weighted = DMatrix::from_fn(powers.len(), corners.len(), |k, at| weights[at] * basis[(at, k)]);
    // A strip of two columns carries no square of them: the least bit of damping.
    let normal = &weighted * &basis;
    let damping = 1e-9 * normal.trace();
    let solved = (normal + DMatrix::identity(powers.len(), powers.len()) * damping).cholesky()?;
    let axis = |pick: fn(&(f64, f64)) -> f64| {
        let values = DVector::from_iterator(left.len(), left.iter().map(pick));
        &basis * solved.solve(&(&weighted * &values))
    };
    let (x, y) = (axis(|r| r.0), axis(|r| r.1));
    Some(left.iter().enumerate().map(|(at, r)| (r.0 - x[at], r.1 - y[at])).collect())
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Weights from the homography through four corners that leaves the least median distance.
fn start(corners: &[Counted], step_px: f64) -> Option<Vec<f64>> {
    // A fixed seed: the same corners, the same answer.
    let mut rng = ChaCha8Rng::seed_from_u64(corners.len() as u64);
    let mut best: Option<(f64, Vec<f64>)> = None;
    for _ in 0..SAMPLES {
        let four: [Counted; 4] = std::array::from_fn(|_| corners[rng.random_range(0..corners.len())]);
        let Some(h) = homography(&four, &[1.0; 4]) else { continue };
        let distances: Vec<f64> = corners
            .iter()
            .map(|corner| {
                let (x, y) = project(&h, corner.column, corner.row);
                (corner.x - x).hypot(corner.y - y)
            })
            .collect();
        let middle = median(&mut distances.clone());
        if best.as_ref().is_none_or(|(least, _)| middle < *least) {
            best = Some((middle, distances));
        }
    }
    let (middle, distances) = best?;
    let tolerance = (3.0 * middle).clamp(0.05 * step_px, MAX_BEND * step_px);
    Some(distances.iter().map(|distance| f64::from(u8::from(*distance <= tolerance))).collect())
}

/// How corners fit a plane whose squares are about `step_px` wide; `None` where they are no plane, or fewer than
/// `min_corners` of them are on it.
pub(super) fn fit(corners: &[Counted], step_px: f64, min_corners: usize) -> Option<PlaneFit> {
    if corners.len() < min_corners.max(5) {
        return None;
    }
    let mut weights = start(corners, step_px)?;
    let mut lengths = vec![0.0; corners.len()];
    let mut sigma = 0.0;
    for _ in 0..ROUNDS {
        let used = weights.iter().filter(|weight| **weight > 0.0).count();
        let &(_, degree, _) = FOR_DEGREE.iter().rfind(|entry| used >= entry.0)?;
        let left = residuals(corners, &weights, degree)?;
        lengths = left.iter().map(|r| r.0.hypot(r.1)).collect();
        // The median length of residuals of sigma 1 on each axis is 1.177. Below a hundredth of a pixel nothing is to
        // be distinguished.
        sigma = (median(&mut lengths.clone()) / 1.177).max(0.01);
        let weigh = |length: &f64| {
            let t = length / (TUKEY * sigma);
            if t < 1.0 { (1.0 - t * t).powi(2) } else { 0.0 }
        };
        weights = lengths.iter().map(weigh).collect();
    }
    let tolerance = (OUTLIER_SIGMAS * sigma).clamp(OUTLIER_SQUARES.0 * step_px, OUTLIER_SQUARES.1 * step_px);
    let keeps: Vec<bool> = lengths.iter().map(|length| *length <= tolerance).collect();
    let kept = keeps.iter().filter(|keep| **keep).count();
    let &(_, _, parameters) = FOR_DEGREE.iter().rfind(|entry| kept >= entry.0)?;
    let sum: f64 = lengths.iter().zip(&keeps).filter(|(_, keep)| **keep).map(|(length, _)| length * length).sum();
    let scatter_px = (sum / (2.0 * kept as f64 - parameters).max(1.0)).sqrt();
    let is_plane = kept >= min_corners && 4 * kept >= 3 * corners.len();
    (is_plane && scatter_px <= MAX_SCATTER_SQUARES * step_px).then_some(PlaneFit { keeps, scatter_px })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A board of the given size under a steep view through a lens, with noise.
    fn board(columns: usize, rows: usize, k1: f64, noise_px: f64, seed: u64) -> Vec<Counted> {
        let h = Matrix3::new(38.0, 4.0, -150.0, -3.0, 33.0, -100.0, 2e-2, 8e-3, 1.0);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut noise = || noise_px * ((0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0);
        (0..columns * rows)
            .map(|at| {
                let (column, row) = ((at % columns) as f64, (at / columns) as f64);
                let (x, y) = project(&h, column, row);
                let bend = 1.0 + k1 * (x * x + y * y) / (500.0 * 500.0);
                Counted { column, row, x: x * bend + noise(), y: y * bend + noise() }
            })
            .collect()
    }

    #[test]
    fn the_scatter_is_that_of_the_corners_with_and_without_a_lens() {
        for (columns, rows, k1) in [(11, 8, 0.0), (11, 8, -0.3), (7, 5, 0.1), (4, 3, 0.0)] {
            let scatters: Vec<f64> = (0..40)
                .map(|seed| fit(&board(columns, rows, k1, 0.1, seed), 35.0, 9).expect("a plane").scatter_px)
                .collect();
            let mean = (scatters.iter().map(|s| s * s).sum::<f64>() / 40.0).sqrt();
            assert!((0.08..0.125).contains(&mean), "{columns} x {rows}, k1 {k1}: {mean}");
        }
    }

    #[test]
    fn corners_beside_the_plane_are_left_out() {
        let mut corners = board(7, 5, 0.1, 0.1, 3);
        for (at, off) in [(3, 4.0), (17, -6.0), (30, 9.0)] {
            corners[at].x += off;
        }
        let fit = fit(&corners, 35.0, 9).unwrap();
        let left_out: Vec<usize> = (0..35).filter(|&at| !fit.keeps[at]).collect();
        assert_eq!(left_out, [3, 17, 30]);
        assert!(fit.scatter_px < 0.15, "{}", fit.scatter_px);
    }

    #[test]
    fn what_is_no_plane_is_refused() {
        // Thirteen corners that are neighbours of each other, and no more: each a fifth of a square off.
        for seed in 0..50 {
            let mut corners = board(4, 4, 0.0, 6.0, seed);
            corners.truncate(13);
            assert!(fit(&corners, 35.0, 9).is_none(), "seed {seed}");
        }
        // A line, and too few.
        assert!(fit(&board(13, 1, 0.0, 0.1, 1), 35.0, 9).is_none());
        assert!(fit(&board(4, 2, 0.0, 0.1, 1), 35.0, 9).is_none());
        // A board folded by 60 degrees along its middle.
        let mut folded = board(9, 6, 0.0, 0.1, 1);
        for corner in folded.iter_mut().filter(|corner| corner.column > 4.0) {
            corner.y += 14.0 * (corner.column - 4.0);
        }
        assert!(fit(&folded, 35.0, 9).is_none_or(|fit| fit.keeps.iter().any(|keep| !keep)));
    }
}
