//! Boards apart from the adjustment: where one lies, how well its corners fit, and how that is on postures that were
//! held out.
//!
//! A board that stood still is laid where some postures saw it, and its corners are compared in others: nothing is
//! fitted to those, which makes the comparison stricter than that of [`crate::cross_validate`], where scene points and
//! the board are fitted anew.

use crate::robust::median;
use crate::{
    BoardObservation, BundleOptions, CalibrationError, Correspondences, Free, Loss, Model, MountComponent, Parameter,
    PostureErrorPolicy, PriorPolicy, ReprojectionStatistics, calibrate_bundle, without_postures,
};
use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector6};
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, PinholeCamera, Pixel, Point3};
use skclam_rig::{Board, Rig};

/// One fold: how the board's corners fit in postures that took no part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BoardFold {
    /// Positions of the held-out postures.
    pub held_out: Vec<usize>,
    /// Under the nominal arm, with the mount fitted to the other postures.
    pub nominal: ReprojectionStatistics,
    /// Under the rig that was calibrated with the other postures.
    pub calibrated: ReprojectionStatistics,
}

/// Where the board lies when held-out postures are judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BoardPlace {
    /// Where the other postures saw it: nothing at all is fitted to the held-out ones, and an arm posture unlike the
    /// others shows how far the calibration may be extrapolated.
    AsTrained,
    /// Laid anew into the held-out postures, as if they were another day's recording: what they must agree on is the
    /// board among themselves.
    Anew,
}

/// The corner of a board in the board's frame, metres.
pub(crate) fn point_in_board(board: &Board, column: u32, row: u32) -> Point3 {
    Point3::new(f64::from(column), f64::from(row), 0.0) * board.square_m
}

/// The pose of the camera relative to a board that one image shows: from the homography of the plane (Zhang, "A
/// flexible new technique for camera calibration", 2000, appendix A), refined. `None` with fewer than four corners, or
/// where they lie on a line.
pub fn color_from_board(camera: &PinholeCamera, board: &Board, corners: &[(u32, u32, Pixel)]) -> Option<Isometry3> {
    // In squares about the middle, and in undistorted normalised coordinates, the equations are well scaled.
    let middle = (0.5 * f64::from(board.columns), 0.5 * f64::from(board.rows));
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for &(column, row, pixel) in corners {
        let (x, y) = (f64::from(column) - middle.0, f64::from(row) - middle.1);
        let ray = camera.unproject(&pixel);
        let (u, v) = (ray.x / ray.z, ray.y / ray.z);
        let first = SVector::<f64, 9>::from([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u]);
        let second = SVector::<f64, 9>::from([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]);
        normal += first * first.transpose() + second * second.transpose();
    }
    if corners.len() < 4 || !normal.iter().all(|value| value.is_finite()) {
        return None;
    }
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let second = eigen.eigenvalues.iter().enumerate().filter(|(k, _)| *k != least).map(|(_, v)| *v);
    if second.fold(f64::INFINITY, f64::min) <= 1e-12 * eigen.eigenvalues.max() {
        return None;
    }
    let h = eigen.eigenvectors.column(least);
    let (a, b, c) = (Vector3::new(h[0], h[3], h[6]), Vector3::new(h[1], h[4], h[7]), Vector3::new(h[2], h[5], h[8]));
    // The board is in front of the camera.
    let scale = 2.0 / (a.norm() + b.norm()) * if c.z < 0.0 { -1.0 } else { 1.0 };
    let (a, b, c) = (a * scale, b * scale, c * scale);
    let svd = Matrix3::from_columns(&[a, b, a.cross(&b)]).svd(true, true);
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
    let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&rotation);
    let to_first = Vector3::new(-middle.0, -middle.1, 0.0);
    let start = Isometry3::from_parts(((c + rotation * to_first) * board.square_m).into(), rotation);
    let seen = corners.iter().map(|(column, row, pixel)| (point_in_board(board, *column, *row), *pixel));
    Some(lay(start, &seen.map(|(point, pixel)| (Isometry3::identity(), point, pixel)).collect::<Vec<_>>(), camera))
}

/// Robust Gauss-Newton on the pose of a board that cameras at known poses see; the pose is that in the cameras' common
/// frame.
fn lay(start: Isometry3, seen: &[(Isometry3, Point3, Pixel)], camera: &PinholeCamera) -> Isometry3 {
    let mut pose = start;
    for _ in 0..30 {
        let mut distances: Vec<f64> =
            seen.iter().filter_map(|observation| Some(residual(&pose, observation, camera)?.0.norm())).collect();
        let loss = Loss::Cauchy(5.0);
        let sigma = (median(&mut distances) / 1.18).max(1e-9);
        let (mut normal_matrix, mut rhs) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
        for observation in seen {
            let Some((difference, jacobian)) = residual(&pose, observation, camera) else { continue };
            let weight = loss.weight(difference.norm() / sigma);
            normal_matrix += jacobian.transpose() * jacobian * weight;
            rhs += jacobian.transpose() * difference * weight;
        }
        let Some(step) = normal_matrix.cholesky().map(|factor| factor.solve(&rhs)) else { break };
        pose *= Isometry3::new(step.fixed_rows::<3>(0).into_owned(), step.fixed_rows::<3>(3).into_owned());
        pose.rotation.renormalize();
        if step.norm() < 1e-12 {
            break;
        }
    }
    pose
}

/// Pixel as seen less pixel as predicted, and the latter's change with a twist of the board in its own frame.
fn residual(
    board: &Isometry3,
    (frame_from_camera, point, pixel): &(Isometry3, Point3, Pixel),
    camera: &PinholeCamera,
) -> Option<(nalgebra::Vector2<f64>, SMatrix<f64, 2, 6>)> {
    let camera_from_board = frame_from_camera.inverse() * board;
    let projection = camera.project_with_jacobian(&(camera_from_board * point))?;
    let turned = camera_from_board.rotation.to_rotation_matrix();
    let mut by_twist = SMatrix::<f64, 3, 6>::zeros();
    by_twist.fixed_view_mut::<3, 3>(0, 0).copy_from(turned.matrix());
    by_twist.fixed_view_mut::<3, 3>(0, 3).copy_from(&-(turned.matrix() * point.coords.cross_matrix()));
    Some((pixel - projection.pixel, projection.by_point * by_twist))
}

fn board_of(rig: &Rig, posture: usize) -> Result<&Board, CalibrationError> {
    let reason = "the rig has no [board]".to_owned();
    rig.board.as_ref().ok_or(CalibrationError::Board { posture, reason })
}

/// Camera poses, corners in the board's frame (with the size that the model gives its squares) and pixels. `errors`: of
/// the single postures, or empty.
fn corner_observations(
    model: &Model,
    errors: &[f64],
    data: &Correspondences,
    postures: &[usize],
) -> Result<Vec<(Isometry3, Point3, Pixel)>, CalibrationError> {
    let motion = crate::camera_kinematics::CameraKinematics::new(&model.rig, &data.postures)?;
    let mut observations = Vec::new();
    for seen in data.boards.iter().filter(|seen| postures.contains(&seen.posture)) {
        let board = board_of(&model.rig, seen.posture)?;
        let base_from_camera = motion.pose(model, seen.posture, motion.error_of(errors, seen.posture))?;
        let point = |&(column, row, pixel): &(u32, u32, Pixel)| {
            (base_from_camera, point_in_board(board, column, row) * model.board_scale, pixel)
        };
        observations.extend(seen.corners.iter().map(point));
    }
    Ok(observations)
}

/// Where a model's cameras saw the board in some postures, joint values taken as exact; `None` where none of them saw
/// it.
pub fn base_from_board(
    model: &Model,
    data: &Correspondences,
    postures: &[usize],
) -> Result<Option<Isometry3>, CalibrationError> {
    base_from_board_with(model, &[], data, postures)
}

/// The same with the errors of the single postures.
pub(crate) fn base_from_board_with(
    model: &Model,
    errors: &[f64],
    data: &Correspondences,
    postures: &[usize],
) -> Result<Option<Isometry3>, CalibrationError> {
    let motion = crate::camera_kinematics::CameraKinematics::new(&model.rig, &data.postures)?;
    let observations = corner_observations(model, errors, data, postures)?;
    let camera = &model.rig.color;
    let mut best: Option<(f64, Isometry3)> = None;
    // The start is the posture whose board fits the others best.
    for seen in data.boards.iter().filter(|seen| postures.contains(&seen.posture)) {
        let board = board_of(&model.rig, seen.posture)?;
        let Some(in_camera) = color_from_board(camera, board, &seen.corners) else { continue };
        let base_from_camera = motion.pose(model, seen.posture, motion.error_of(errors, seen.posture))?;
        let start = base_from_camera * in_camera;
        let mut distances: Vec<f64> = observations
            .iter()
            .map(|observation| residual(&start, observation, camera).map_or(f64::MAX, |(r, _)| r.norm()))
            .collect();
        let middle = median(&mut distances);
        if best.is_none_or(|(least, _)| middle < least) {
            best = Some((middle, start));
        }
    }
    Ok(best.map(|(_, start)| lay(start, &observations, camera)))
}

/// Distances of the board's corners in the postures `seen_in` to where they should be if it lies where the postures
/// `laid_by` saw it. Every corner counts, also one that fits badly; `None` where no corner is seen.
pub fn board_residuals(
    model: &Model,
    data: &Correspondences,
    laid_by: &[usize],
    seen_in: &[usize],
) -> Result<Option<ReprojectionStatistics>, CalibrationError> {
    data.check()?;
    let Some(pose) = base_from_board(model, data, laid_by)? else { return Ok(None) };
    let observations = corner_observations(model, &[], data, seen_in)?;
    let mut distances: Vec<f64> = observations
        .iter()
        .filter_map(|observation| residual(&pose, observation, &model.rig.color))
        .map(|(difference, _)| difference.norm())
        .collect();
    if distances.is_empty() {
        return Ok(None);
    }
    let squares: f64 = distances.iter().map(|d| d * d).sum();
    Ok(Some(ReprojectionStatistics {
        rms_px: (squares / distances.len() as f64).sqrt(),
        median_px: median(&mut distances),
        observations: observations.len(),
        inliers: distances.len(),
    }))
}

/// The nominal arm with the mount fitted to the board, every other number untouched: what can be had without
/// calibrating the arm, and the fair thing to compare a calibration with.
pub fn fit_mount_to_board(nominal: &Rig, data: &Correspondences) -> Result<Model, CalibrationError> {
    let boards: Vec<BoardObservation> =
        data.boards.iter().map(|seen| BoardObservation { sigma_px: 1.0, ..seen.clone() }).collect();
    let only = Correspondences { postures: data.postures.clone(), boards, ..Default::default() };
    let options = BundleOptions {
        free: Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec()),
        priors: PriorPolicy::Never,
        posture_errors: PostureErrorPolicy::Off,
        exclude_outlier_postures: false,
        ..Default::default()
    };
    Ok(calibrate_bundle(nominal, &only, &options)?.model)
}

/// Calibrates with all postures but those of a group, group by group, and compares the corners of the group.
pub fn cross_validate_board(
    nominal: &Rig,
    data: &Correspondences,
    options: &BundleOptions,
    groups: &[Vec<usize>],
    place: BoardPlace,
) -> Result<Vec<BoardFold>, CalibrationError> {
    let mut folds = Vec::new();
    for held_out in groups {
        let kept: Vec<usize> = (0..data.postures.len()).filter(|posture| !held_out.contains(posture)).collect();
        let rest = without_postures(data, held_out);
        let calibrated = calibrate_bundle(nominal, &rest, options)?.model;
        let fitted = fit_mount_to_board(nominal, &rest)?;
        let laid_by = match place {
            BoardPlace::AsTrained => &kept,
            BoardPlace::Anew => held_out,
        };
        let on = |model: &Model| board_residuals(model, data, laid_by, held_out);
        if let (Some(nominal), Some(calibrated)) = (on(&fitted)?, on(&calibrated)?) {
            folds.push(BoardFold { held_out: held_out.clone(), nominal, calibrated });
        }
    }
    Ok(folds)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{diverse_postures, hp3j, manufacture, perturbed, record_board, seeded};

    fn recording(sigma_px: f64, seed: u64) -> (Rig, Rig, Isometry3, Correspondences) {
        let mut rng = seeded(seed);
        let mut truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let pose = Isometry3::new(Vector3::new(0.6, -0.08, 0.0), Vector3::new(0.0, 0.0, 0.3));
        let drawn = diverse_postures(&hp3j(), 20_000, &mut rng);
        let (board, seen) = record_board(&truth, &drawn, &pose, sigma_px, &mut rng);
        let mut data = Correspondences::default();
        for observation in seen.into_iter().take(20) {
            data.postures.push(drawn[observation.posture].clone());
            data.boards.push(BoardObservation { posture: data.boards.len(), ..observation });
        }
        let mut nominal = hp3j();
        (nominal.board, truth.board) = (Some(board.clone()), Some(board));
        (nominal, truth, pose, data)
    }

    #[test]
    fn one_image_gives_the_pose_of_the_board() {
        let (_, truth, pose, data) = recording(0.0, 31);
        let board = truth.board.as_ref().unwrap();
        for seen in &data.boards {
            let expected = truth.base_from_color(&data.postures[seen.posture]).unwrap().inverse() * pose;
            let found = color_from_board(&truth.color, board, &seen.corners).unwrap();
            assert!((found.to_homogeneous() - expected.to_homogeneous()).amax() < 1e-8);
            assert!(color_from_board(&truth.color, board, &seen.corners[..3]).is_none());
            // One row is a line.
            assert!(color_from_board(&truth.color, board, &seen.corners[..11]).is_none());
        }
    }

    #[test]
    fn residuals_are_those_of_the_board_where_the_others_saw_it() {
        let (_, truth, pose, data) = recording(0.0, 32);
        let model = Model::new(truth);
        let found = base_from_board(&model, &data, &[0, 1, 2]).unwrap().unwrap();
        assert!((found.to_homogeneous() - pose.to_homogeneous()).amax() < 1e-8);
        let fits = board_residuals(&model, &data, &[0, 1, 2], &[5, 6]).unwrap().unwrap();
        assert!(fits.rms_px < 1e-6 && fits.observations == 176, "{fits:?}");
        assert!(board_residuals(&model, &data, &[], &[1]).unwrap().is_none());
    }

    #[test]
    fn a_calibrated_arm_beats_a_fitted_mount_on_held_out_postures() {
        let (nominal, _, _, data) = recording(0.1, 33);
        let options = BundleOptions { posture_errors: PostureErrorPolicy::Off, ..Default::default() };
        let groups: Vec<Vec<usize>> = (0..4).map(|fold| (5 * fold..5 * fold + 5).collect()).collect();
        let folds = cross_validate_board(&nominal, &data, &options, &groups, BoardPlace::AsTrained).unwrap();
        assert_eq!(folds.len(), 4);
        assert!(folds.iter().all(|fold| fold.calibrated.rms_px < 0.5 * fold.nominal.rms_px), "{folds:?}");
        let anew = cross_validate_board(&nominal, &data, &options, &groups, BoardPlace::Anew).unwrap();
        assert!(anew.iter().zip(&folds).all(|(a, b)| a.calibrated.rms_px < b.calibrated.rms_px), "{anew:?}");
        let sloppy = Correspondences {
            boards: vec![BoardObservation { sigma_px: 0.0, ..data.boards[0].clone() }],
            ..data.clone()
        };
        assert!(sloppy.check().unwrap_err().to_string().contains("board observation 0"));
    }
}
