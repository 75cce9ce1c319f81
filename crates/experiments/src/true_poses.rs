//! Where the camera truly was, and how far a rig is from saying so.

use anyhow::Result;
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use skclam::evaluation::base_gauge;
use skclam::geometry::Isometry3;
use skclam::kinematics::SerialChain;
use skclam::rig::{Posture, PostureState, Rig, RigError};

/// Pairs of what a rig is given (a posture) and what it should answer (the camera's pose).
#[derive(Debug, Clone)]
pub struct TruePoses {
    /// What a rig is given.
    pub postures: Vec<Posture>,
    /// `base_from_color` at each of them.
    pub cameras: Vec<Isometry3>,
}

/// How far off a rig's camera is, root of the mean square over postures, after the base's own gauge.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraError {
    /// Position, mm.
    pub mm: f64,
    /// Orientation, degrees.
    pub deg: f64,
}

impl TruePoses {
    /// By the true rig at postures.
    ///
    /// # Errors
    /// Postures that do not belong to the rig.
    pub fn of_rig(truth: &Rig, postures: &[Posture]) -> Result<Self, RigError> {
        Ok(TruePoses { postures: postures.to_vec(), cameras: cameras(truth, postures)? })
    }

    /// How far a rig is off.
    ///
    /// # Errors
    /// Postures that do not belong to the rig.
    pub fn error_of(&self, rig: &Rig) -> Result<CameraError, RigError> {
        let found = self.after_base_gauge(rig)?;
        let count = found.len().max(1) as f64;
        let rms = |square: &dyn Fn(&Isometry3, &Isometry3) -> f64| {
            (found.iter().zip(&self.cameras).map(|(found, truth)| square(found, truth)).sum::<f64>() / count).sqrt()
        };
        Ok(CameraError {
            mm: 1e3 * rms(&|found, truth| (found.translation.vector - truth.translation.vector).norm_squared()),
            deg: rms(&|found, truth| found.rotation.angle_to(&truth.rotation).powi(2)).to_degrees(),
        })
    }

    /// RMS of the rig's camera positions after the best rigid motion of its whole base, mm: what is left for whoever
    /// registers the base with the arm itself.
    ///
    /// # Errors
    /// Postures that do not belong to the rig.
    pub fn aligned_error_mm(&self, rig: &Rig) -> Result<f64, RigError> {
        let found = positions(&cameras(rig, &self.postures)?);
        let truth = positions(&self.cameras);
        let count = found.len() as f64;
        let (found_center, true_center) = (center(&found), center(&truth));
        let pairs = || found.iter().zip(&truth).map(|(f, t)| (f - found_center, t - true_center));
        let cross: Matrix3<f64> = pairs().map(|(f, t)| t * f.transpose()).sum();
        let svd = cross.svd(true, true);
        let (u, v_t) = (svd.u.unwrap_or_else(Matrix3::identity), svd.v_t.unwrap_or_else(Matrix3::identity));
        // A rotation, not a reflection (Kabsch 1976).
        let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
        let turn = u * flip * v_t;
        Ok(1e3 * (pairs().map(|(f, t)| (turn * f - t).norm_squared()).sum::<f64>() / count).sqrt())
    }

    /// Scale error of the rig's camera positions, percent: the scale of the similarity that takes true positions to
    /// found ones (least squares, Umeyama 1991).
    ///
    /// # Errors
    /// Postures that do not belong to the rig.
    pub fn scale_error_percent(&self, rig: &Rig) -> Result<f64, RigError> {
        let (found, truth) = (positions(&cameras(rig, &self.postures)?), positions(&self.cameras));
        let (found_center, true_center) = (center(&found), center(&truth));
        let pairs = || found.iter().zip(&truth).map(|(f, t)| (f - found_center, t - true_center));
        let cross: Matrix3<f64> = pairs().map(|(f, t)| f * t.transpose()).sum();
        let spread: f64 = pairs().map(|(_, t)| t.norm_squared()).sum();
        // The arms differ by less than a half turn, so that the determinant of the cross covariance is positive.
        Ok(100.0 * (cross.singular_values().sum() / spread - 1.0))
    }

    fn after_base_gauge(&self, rig: &Rig) -> Result<Vec<Isometry3>, RigError> {
        let found = cameras(rig, &self.postures)?;
        let gauge = match (self.postures.first().map(|posture| &posture.state), &rig.robot) {
            (Some(PostureState::Joints(joints)), Some(robot)) => base_gauge(robot, joints, &found, &self.cameras),
            // The controller's base is known with flange poses: nothing is free there.
            _ => Isometry3::identity(),
        };
        Ok(found.iter().map(|pose| gauge * pose).collect())
    }
}

fn cameras(rig: &Rig, postures: &[Posture]) -> Result<Vec<Isometry3>, RigError> {
    postures.iter().map(|posture| rig.base_from_color(posture)).collect()
}

fn positions(poses: &[Isometry3]) -> Vec<Vector3<f64>> {
    poses.iter().map(|pose| pose.translation.vector).collect()
}

fn center(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len() as f64
}

/// Postures drawn evenly from the joints' limits, half a turn to each side at most.
pub fn workspace_postures(robot: &SerialChain, count: usize, seed: u64) -> Vec<Posture> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let half_turn = std::f64::consts::PI;
    let mut posture = |index: usize| {
        let joints = robot.joints().iter().map(|joint| {
            let [low, high] = joint.limits.unwrap_or([-half_turn, half_turn]);
            let (low, high) = (low.max(-half_turn), high.min(half_turn));
            low + (high - low) * rng.random::<f64>()
        });
        Posture::new(index as u64, PostureState::Joints(joints.collect()))
    };
    (0..count).map(&mut posture).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam::kinematics::{ParameterId, ParameterKind};
    use skclam::rig::builtin_rig;

    fn arm() -> (Rig, TruePoses) {
        let truth = builtin_rig("hp3j").unwrap().unwrap();
        let postures = workspace_postures(truth.robot.as_ref().unwrap(), 80, 1);
        let poses = TruePoses::of_rig(&truth, &postures).unwrap();
        (truth, poses)
    }

    #[test]
    fn the_bases_gauge_is_no_error_and_a_shifted_mount_is() {
        let (mut rig, poses) = arm();
        let robot = rig.robot.as_mut().unwrap();
        for (kind, change) in [(ParameterKind::ThetaOffset, 0.3), (ParameterKind::D, 0.05)] {
            let id = ParameterId { joint: 0, kind };
            robot.set_parameter(id, robot.parameter(id).unwrap() + change).unwrap();
        }
        let error = poses.error_of(&rig).unwrap();
        assert!(error.mm < 1e-9 && error.deg < 1e-6, "{error:?}");
        rig.flange_from_color.translation.vector.z += 0.002;
        let error = poses.error_of(&rig).unwrap();
        assert!(error.mm > 1.0 && error.mm < 2.001 && error.deg < 0.05, "{error:?}");
    }

    #[test]
    fn a_base_that_was_moved_is_no_error_of_aligned_positions() {
        let (rig, mut poses) = arm();
        let moved = Isometry3::new(Vector3::new(0.2, -0.1, 0.4), Vector3::new(0.3, 0.2, -1.0));
        poses.cameras.iter_mut().for_each(|camera| *camera = moved * *camera);
        assert!(poses.error_of(&rig).unwrap().mm > 10.0);
        assert!(poses.aligned_error_mm(&rig).unwrap() < 1e-9);
        poses.cameras[0].translation.vector.x += 0.08;
        let error = poses.aligned_error_mm(&rig).unwrap();
        assert!(error > 7.0 && error < 80.0 / 80f64.sqrt(), "{error}");
    }

    #[test]
    fn longer_links_are_a_scale_error() {
        let (mut rig, poses) = arm();
        assert!(poses.scale_error_percent(&rig).unwrap().abs() < 1e-9);
        let robot = rig.robot.as_mut().unwrap();
        for id in robot.parameter_ids().into_iter().filter(|id| !id.kind.is_angle()) {
            robot.set_parameter(id, 1.001 * robot.parameter(id).unwrap()).unwrap();
        }
        rig.flange_from_color.translation.vector *= 1.001;
        assert!((poses.scale_error_percent(&rig).unwrap() - 0.1).abs() < 1e-9);
    }
}
