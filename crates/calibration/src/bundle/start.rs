//! Where the bundle adjustment starts: pair matches read off tracks and boards, points triangulated, the board laid
//! into its corners.

use crate::bundle::observations::{Observation, Observations};
use crate::bundle::projection_model::ProjectionModel;
use crate::bundle::reduced::track_chunks;
use crate::robust::median;
use crate::{
    CalibrationError, Correspondences, Free, Model, PairMatch, PairMatches, PairwiseOptions, Parameter, PriorPolicy,
    calibrate_pairwise,
};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use skclam_geometry::{Isometry3, Point3};
use skclam_rig::Rig;

/// Pairs of a track that are added as matches.
const PAIRS_A_TRACK: usize = 6;

/// Pairs that a posture keeps.
const PAIRS_A_POSTURE: usize = 4;

/// Pair matches from tracks and board corners: of a track of k observations, up to six pairs, near ones and wide ones;
/// of a posture, the pairs with the most matches.
pub(crate) fn pairs_from_tracks(observations: &Observations) -> Vec<PairMatches> {
    let mut by_pair: Vec<Vec<PairMatch>> = vec![Vec::new(); observations.postures * observations.postures];
    let mut add = |track: &[Observation]| {
        let count = track.len();
        let pairs: Vec<(usize, usize)> = (0..count).flat_map(|a| (a + 1..count).map(move |b| (a, b))).collect();
        for (a, b) in pairs.iter().step_by(pairs.len().div_ceil(PAIRS_A_TRACK).max(1)) {
            let (mut a, mut b) = (&track[*a], &track[*b]);
            if a.posture == b.posture {
                continue;
            }
            if a.posture > b.posture {
                std::mem::swap(&mut a, &mut b);
            }
            by_pair[a.posture as usize * observations.postures + b.posture as usize].push(PairMatch {
                in_a: a.pixel,
                in_b: b.pixel,
                sigma_px: 1.0,
                distance: 0,
            });
        }
    };
    (0..observations.track_count()).for_each(|track| add(observations.track(track)));
    observations.corner_tracks.iter().for_each(|(_, track)| add(track));
    let mut kept = vec![false; by_pair.len()];
    for posture in 0..observations.postures {
        let at = |other: usize| posture.min(other) * observations.postures + posture.max(other);
        let mut others: Vec<usize> =
            (0..observations.postures).filter(|other| !by_pair[at(*other)].is_empty()).collect();
        others.sort_by(|a, b| by_pair[at(*b)].len().cmp(&by_pair[at(*a)].len()).then(a.cmp(b)));
        others.iter().take(PAIRS_A_POSTURE).for_each(|&other| kept[at(other)] = true);
    }
    by_pair
        .into_iter()
        .enumerate()
        .filter(|(at, _)| kept[*at])
        .map(|(at, matches)| PairMatches { a: at / observations.postures, b: at % observations.postures, matches })
        .collect()
}

/// A point for every track; `None` for those that cannot be had. `known`: points to try first.
pub(crate) fn triangulate_all(
    observations: &Observations,
    view: &ProjectionModel<'_>,
    known: Option<&[Point3]>,
) -> Vec<Option<Point3>> {
    let chunks = track_chunks(observations);
    let of_chunk = |&(from, to): &(usize, usize)| -> Vec<Option<Point3>> {
        (from..to)
            .map(|track| view.triangulate(observations.track(track), known.map(|points| &points[track])))
            .collect()
    };
    chunks.par_iter().map(of_chunk).collect::<Vec<_>>().concat()
}

/// Lays the board into its triangulated corners (Kabsch 1976), the worst fitting third left out in a second pass.
pub(crate) fn place_board(observations: &Observations, view: &ProjectionModel<'_>) -> Option<Isometry3> {
    let corners: Vec<(Point3, Point3)> = observations
        .corner_tracks
        .iter()
        .filter_map(|(in_board, track)| Some((*in_board, view.triangulate(track, None)?)))
        .collect();
    let first = align(&corners)?;
    let error = |corner: &(Point3, Point3)| (first * corner.0 - corner.1).norm();
    let mut errors: Vec<f64> = corners.iter().map(error).collect();
    let gate = 2.0 * median(&mut errors) + 1e-12;
    align(&corners.iter().filter(|corner| error(corner) <= gate).copied().collect::<Vec<_>>()).or(Some(first))
}

fn align(corners: &[(Point3, Point3)]) -> Option<Isometry3> {
    if corners.len() < 3 {
        return None;
    }
    let count = corners.len() as f64;
    let mean = |pick: &dyn Fn(&(Point3, Point3)) -> Point3| {
        corners.iter().map(|corner| pick(corner).coords).sum::<Vector3<f64>>() / count
    };
    let (from, to) = (mean(&|c| c.0), mean(&|c| c.1));
    let covariance: Matrix3<f64> = corners.iter().map(|(a, b)| (b.coords - to) * (a.coords - from).transpose()).sum();
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let handedness = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(u * handedness * v_t);
    let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Isometry3::from_parts((to - rotation * from).into(), rotation))
}

/// Matches that the pairwise start looks at.
const START_MATCHES: usize = 20_000;

/// A model near enough for the minimisation, and the noise of its matches. Without enough pair matches it is the
/// nominal one.
pub(crate) fn start(
    nominal: &Rig,
    data: &Correspondences,
    observations: &Observations,
    parameters: &[Parameter],
) -> Result<(Model, f64), CalibrationError> {
    let mut pairs = if data.pairs.is_empty() { pairs_from_tracks(observations) } else { data.pairs.clone() };
    let total: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    let stride = total.div_ceil(START_MATCHES).max(1);
    for PairMatches { matches, .. } in &mut pairs {
        let mut at = 0;
        matches.retain(|_| {
            at += 1;
            (at - 1) % stride == 0
        });
    }
    let free = parameters.iter().copied().filter(|p| p.moves_camera() || matches!(p, Parameter::Intrinsic(_)));
    let options = PairwiseOptions {
        free: Free::List(free.collect()),
        priors: PriorPolicy::Always,
        max_rounds: 12,
        cost_tolerance: 1e-8,
        ..Default::default()
    };
    let sample = Correspondences { postures: data.postures.clone(), pairs, ..Default::default() };
    match calibrate_pairwise(nominal, &sample, &options) {
        Ok(found) if found.epipolar_after.median_sampson_px < found.epipolar_before.median_sampson_px => {
            // A Sampson distance has the sigma of a coordinate.
            Ok((found.model, found.noise.pixel.max(1e-3)))
        }
        Ok(found) => Ok((Model::new(nominal.clone()), found.noise.pixel.max(1.0))),
        Err(CalibrationError::TooFew { .. } | CalibrationError::NothingFree) => Ok((Model::new(nominal.clone()), 2.0)),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_of_corners_is_aligned() {
        let pose = Isometry3::new(Vector3::new(0.3, -0.2, 0.9), Vector3::new(2.0, 0.4, -1.0));
        let corner = |k: i32| Point3::new(f64::from(k % 4) * 0.02, f64::from(k / 4) * 0.03, 0.0);
        let corners: Vec<_> = (0..12).map(|k| (corner(k), pose * corner(k))).collect();
        let found = align(&corners).unwrap();
        assert!((found.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-12);
    }
}
