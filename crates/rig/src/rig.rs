//! The rig: robot, mount and cameras as one value.

use crate::joint_corrections::{JointCorrections, joint_readings};
use crate::{Board, Posture, PostureState, Prior};
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera};
use skclam_kinematics::{KinematicsError, SerialChain};

/// A robot that carries a camera: all that turns joint values into the pose of a camera, and points into pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// For people.
    pub name: String,
    /// The arm; `None` where only flange poses are known.
    pub robot: Option<SerialChain>,
    /// What its joints do beside their encoders.
    pub joint_corrections: JointCorrections,
    /// The mount: takes points from the colour camera to the flange.
    pub flange_from_color: Isometry3,
    /// The colour camera.
    pub color: PinholeCamera,
    /// The depth camera, where there is one.
    pub depth: Option<DepthCamera>,
    /// A board that stood still, where there was one.
    pub board: Option<Board>,
    /// Standard deviations about the nominal values.
    pub prior: Prior,
    /// Image file with 0 where the colour camera sees what moves with it; relative to the rig's file.
    pub color_mask: Option<String>,
    /// The same for the depth camera.
    pub depth_mask: Option<String>,
}

/// Why a pose could not be computed from a rig.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RigError {
    /// Joint values came for a rig that has no arm.
    #[error("posture {index} gives joint values, but the rig has no [robot]; name the arm or give flange poses")]
    NoRobot {
        /// The posture's index.
        index: u64,
    },
    /// The arm refused the joint values.
    #[error("posture {index}: {source}")]
    Kinematics {
        /// The posture's index.
        index: u64,
        /// Why.
        source: KinematicsError,
    },
}

impl Rig {
    /// `base_from_flange` at a posture.
    pub fn base_from_flange(&self, posture: &Posture) -> Result<Isometry3, RigError> {
        let index = posture.index;
        match &posture.state {
            PostureState::FlangePose(base_from_flange) => Ok(*base_from_flange),
            PostureState::Joints(joints) => {
                let robot = self.robot.as_ref().ok_or(RigError::NoRobot { index })?;
                let pose = if self.joint_corrections.is_none() {
                    robot.base_from_flange(joints)
                } else {
                    joint_readings(robot, joints, &posture.joint_rates)
                        .and_then(|readings| robot.base_from_flange(&self.joint_corrections.applied(&readings)))
                };
                pose.map_err(|source| RigError::Kinematics { index, source })
            }
        }
    }

    /// `base_from_color` at a posture.
    pub fn base_from_color(&self, posture: &Posture) -> Result<Isometry3, RigError> {
        Ok(self.base_from_flange(posture)? * self.flange_from_color)
    }
}
