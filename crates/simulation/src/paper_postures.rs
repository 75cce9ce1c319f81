//! The 73 postures of section 4.1.1: one flange pose, its eight inverse kinematics solutions, joint 1 turned by 5 deg
//! each time, nine rounds, and the first posture once more at the end.

use crate::SimulationError;
use nalgebra::{Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use skclam_kinematics::{SerialChain, spherical_wrist_solutions};
use skclam_rig::Rig;

/// Postures of the paper: 8 solutions, 9 rounds, the first again.
pub const PAPER_POSTURES: usize = 73;
/// Turn of joint 1 from posture to posture, degrees.
pub const PAPER_STEP_DEG: f64 = 5.0;

/// Where the colour camera is and looks in the first solution, joint 1 not yet turned.
///
/// The camera is at azimuth 0 of the base; without angles it looks along the base's x axis, away from the arm, with
/// the image upright.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PaperView {
    /// Distance from joint 1's axis, millimetres.
    pub radius_mm: f64,
    /// Height above the base, millimetres.
    pub height_mm: f64,
    /// Turn to the left about the vertical, degrees.
    pub yaw_deg: f64,
    /// Downward tilt, degrees.
    pub pitch_deg: f64,
    /// Turn about the optical axis, clockwise as the image is seen, degrees.
    pub roll_deg: f64,
}

impl Default for PaperView {
    /// Of some 4,000 views of the HP3J that an ignored test of this crate draws, one of the best: with the paper's 30
    /// matches a pair and 0.5 px, no angle's Cramer-Rao bound exceeds 0.01 deg; no link comes near the table.
    fn default() -> Self {
        PaperView { radius_mm: 210.0, height_mm: 615.0, yaw_deg: -62.0, pitch_deg: 16.0, roll_deg: 0.0 }
    }
}

impl PaperView {
    /// `base_from_color` of this view.
    pub fn base_from_color(&self) -> Isometry3 {
        // Camera axes (right, down, forward) when it looks along the base's x axis.
        let level = Rotation3::from_basis_unchecked(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
        let turn =
            |axis: &nalgebra::Unit<Vector3<f64>>, deg: f64| UnitQuaternion::from_axis_angle(axis, deg.to_radians());
        let rotation = turn(&Vector3::z_axis(), self.yaw_deg)
            * turn(&Vector3::y_axis(), self.pitch_deg)
            * UnitQuaternion::from_rotation_matrix(&level)
            * turn(&Vector3::z_axis(), self.roll_deg);
        let position = 1e-3 * Vector3::new(self.radius_mm, 0.0, self.height_mm);
        Isometry3::from_parts(Translation3::from(position), rotation)
    }

    /// The flange pose that brings a rig's colour camera there.
    pub fn base_from_flange(&self, rig: &Rig) -> Isometry3 {
        self.base_from_color() * rig.flange_from_color.inverse()
    }
}

/// The 73 postures as joint values in radians: posture k = 0..71 is solution k mod 8 with joint 1 turned by 5 deg k,
/// brought into (-pi, pi]; the 73rd is the first. Joint limits are not applied: the paper's sweep is a full turn.
///
/// # Errors
/// Fewer than eight solutions, or no closed form for this arm.
pub fn paper_postures(chain: &SerialChain, base_from_flange: &Isometry3) -> Result<Vec<Vec<f64>>, SimulationError> {
    let solutions = spherical_wrist_solutions(chain, base_from_flange)?;
    if solutions.len() != 8 {
        return Err(SimulationError::Solutions { need: 8, got: solutions.len() });
    }
    let mut postures: Vec<Vec<f64>> = (0..PAPER_POSTURES - 1)
        .map(|k| {
            let mut joints = solutions[k % 8].joint_values.clone();
            joints[0] = wrapped(joints[0] + (PAPER_STEP_DEG * k as f64).to_radians());
            joints
        })
        .collect();
    postures.push(postures[0].clone());
    Ok(postures)
}

/// An angle brought into (-pi, pi].
fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let turned = angle.rem_euclid(TAU);
    if turned > PI { turned - TAU } else { turned }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hp3j() -> Rig {
        skclam_rig::builtin_rig("hp3j").unwrap().unwrap()
    }

    #[test]
    fn all_postures_but_for_joint_1_reach_one_flange_pose() {
        let rig = hp3j();
        let chain = rig.robot.as_ref().unwrap();
        let target = PaperView::default().base_from_flange(&rig);
        let postures = paper_postures(chain, &target).unwrap();
        assert_eq!(postures.len(), 73);
        assert_eq!(postures[72], postures[0]);
        for (k, joints) in postures[..72].iter().enumerate() {
            assert!(joints[0] > -std::f64::consts::PI && joints[0] <= std::f64::consts::PI);
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), (5.0 * k as f64).to_radians());
            let pose = chain.base_from_flange(joints).unwrap();
            let error = (turn * target).inverse() * pose;
            assert!(error.translation.vector.norm() < 1e-9 && error.rotation.angle() < 1e-9, "posture {k}");
            for other in &postures[..k] {
                assert!(joints.iter().zip(other).any(|(a, b)| (a - b).abs() > 1e-3), "all 72 differ");
            }
        }
        let far = Isometry3::translation(3.0, 0.0, 0.0);
        assert!(matches!(paper_postures(chain, &far), Err(SimulationError::Solutions { need: 8, got: 0 })));
    }

    #[test]
    fn the_view_without_angles_looks_outward_and_upright() {
        let view = PaperView { yaw_deg: 0.0, pitch_deg: 0.0, roll_deg: 0.0, ..Default::default() };
        let pose = view.base_from_color();
        assert!(
            (pose * Vector3::z() - Vector3::x()).norm() < 1e-12 && (pose * Vector3::y() + Vector3::z()).norm() < 1e-12
        );
        let down = PaperView { pitch_deg: 30.0, ..view }.base_from_color() * Vector3::z();
        let left = PaperView { yaw_deg: 30.0, ..view }.base_from_color() * Vector3::z();
        assert!((down.z + 0.5).abs() < 1e-12 && (left.y - 0.5).abs() < 1e-12);
    }
}
