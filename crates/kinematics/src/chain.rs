//! A serial chain from base to flange and its forward kinematics.

use crate::{Isometry3, KinematicsError, Link, LinkForm, ParameterId, ParameterKind};
use serde::{Deserialize, Serialize};

/// What a joint does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointKind {
    /// Turns about its z axis; its value is an angle in radians.
    #[default]
    Revolute,
    /// Slides along its z axis; its value is a length in metres.
    Prismatic,
}

/// One joint with the link that carries it.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// What the controller calls it.
    pub name: String,
    /// Revolute or prismatic.
    pub kind: JointKind,
    /// The geometry.
    pub link: Link,
    /// Lower and upper limit of the joint value, radians or metres.
    pub limits: Option<[f64; 2]>,
}

impl Joint {
    /// A revolute joint without limits.
    pub fn revolute(name: impl Into<String>, link: Link) -> Self {
        Joint { name: name.into(), kind: JointKind::Revolute, link, limits: None }
    }

    /// The same joint with limits, radians or metres.
    #[must_use]
    pub fn with_limits(mut self, lower: f64, upper: f64) -> Self {
        self.limits = Some([lower, upper]);
        self
    }

    /// Whether a joint value lies within the limits; without limits every value does.
    pub fn admits(&self, value: f64) -> bool {
        self.limits.is_none_or(|[lower, upper]| (lower..=upper).contains(&value))
    }

    pub(crate) fn split(&self, value: f64) -> (f64, f64) {
        match self.kind {
            JointKind::Revolute => (value, 0.0),
            JointKind::Prismatic => (0.0, value),
        }
    }
}

/// A serial chain: `base_from_flange = base_from_first * link_1(q_1) * ... * link_n(q_n) * last_from_flange`.
///
/// The two fixed transforms at the ends are identities for a plain DH table; a chain that comes from a URDF needs
/// them because DH links cannot express every base and tool frame. Invariant: every number is finite.
#[derive(Debug, Clone, PartialEq)]
pub struct SerialChain {
    base_from_first: Isometry3,
    joints: Vec<Joint>,
    last_from_flange: Isometry3,
}

impl SerialChain {
    /// A chain whose base is the frame before the first link, and whose flange is the frame after the last.
    pub fn new(joints: Vec<Joint>) -> Result<Self, KinematicsError> {
        Self::with_ends(Isometry3::identity(), joints, Isometry3::identity())
    }

    /// A chain with fixed transforms before the first and after the last link.
    pub fn with_ends(
        base_from_first: Isometry3,
        joints: Vec<Joint>,
        last_from_flange: Isometry3,
    ) -> Result<Self, KinematicsError> {
        let finite = |what: &str, value: f64| {
            if value.is_finite() {
                Ok(())
            } else {
                Err(KinematicsError::NotFinite { what: what.to_owned(), value: value.to_string() })
            }
        };
        for (index, joint) in joints.iter().enumerate() {
            for kind in joint.link.parameters() {
                let id = ParameterId { joint: index, kind };
                finite(&id.to_string(), joint.link.get(kind).unwrap_or_default())?;
            }
            if let Some([lower, upper]) = joint.limits {
                finite(&format!("lower limit of joint {}", index + 1), lower)?;
                finite(&format!("upper limit of joint {}", index + 1), upper)?;
                if lower > upper {
                    return Err(KinematicsError::Limits { joint: index + 1, lower, upper });
                }
            }
            if joint.kind == JointKind::Prismatic
                && matches!(joint.link.form, LinkForm::Hayati | LinkForm::StandardHayati)
            {
                return Err(KinematicsError::PrismaticHayati { joint: index + 1 });
            }
        }
        for (what, end) in [("base_from_first", &base_from_first), ("last_from_flange", &last_from_flange)] {
            for value in end.to_homogeneous().iter() {
                finite(what, *value)?;
            }
        }
        Ok(SerialChain { base_from_first, joints, last_from_flange })
    }

    /// The joints, base to flange.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Number of joints.
    pub fn joint_count(&self) -> usize {
        self.joints.len()
    }

    /// The fixed transform before the first link.
    pub fn base_from_first(&self) -> &Isometry3 {
        &self.base_from_first
    }

    /// The fixed transform after the last link.
    pub fn last_from_flange(&self) -> &Isometry3 {
        &self.last_from_flange
    }

    /// Every kinematic parameter, joint by joint, in the order in which each link applies them.
    pub fn parameter_ids(&self) -> Vec<ParameterId> {
        self.joints
            .iter()
            .enumerate()
            .flat_map(|(joint, j)| j.link.parameters().map(|kind| ParameterId { joint, kind }))
            .collect()
    }

    /// A parameter's value, radians or metres; `None` where there is no such joint or parameter.
    pub fn parameter(&self, id: ParameterId) -> Option<f64> {
        self.joints.get(id.joint)?.link.get(id.kind)
    }

    /// Sets a parameter, radians or metres.
    pub fn set_parameter(&mut self, id: ParameterId, value: f64) -> Result<(), KinematicsError> {
        if !value.is_finite() {
            return Err(KinematicsError::NotFinite { what: id.to_string(), value: value.to_string() });
        }
        let known = self.joints.get_mut(id.joint).is_some_and(|joint| joint.link.set(id.kind, value));
        if known { Ok(()) } else { Err(KinematicsError::NoSuchParameter { parameter: id }) }
    }

    /// Forward kinematics. `joint_values`: radians or metres, one a joint.
    pub fn base_from_flange(&self, joint_values: &[f64]) -> Result<Isometry3, KinematicsError> {
        self.check(joint_values)?;
        let mut pose = self.base_from_first;
        for (joint, &value) in self.joints.iter().zip(joint_values) {
            let (q_angle, q_length) = joint.split(value);
            pose *= joint.link.transform(q_angle, q_length);
        }
        Ok(renormalized(pose * self.last_from_flange))
    }

    /// `base_from_link` after each link, in order; the flange's fixed transform is not applied.
    pub fn base_from_links(&self, joint_values: &[f64]) -> Result<Vec<Isometry3>, KinematicsError> {
        self.check(joint_values)?;
        let mut pose = self.base_from_first;
        Ok(self
            .joints
            .iter()
            .zip(joint_values)
            .map(|(joint, &value)| {
                let (q_angle, q_length) = joint.split(value);
                pose *= joint.link.transform(q_angle, q_length);
                pose
            })
            .collect())
    }

    /// `base_from_joint`: a frame on each joint's axis that moves with the joint, z along the axis. For the modified
    /// forms it is the frame after the link; the classic forms go on from there to the next axis.
    pub(crate) fn base_from_joint_frames(&self, joint_values: &[f64]) -> Result<Vec<Isometry3>, KinematicsError> {
        self.check(joint_values)?;
        let mut pose = self.base_from_first;
        let frames = self.joints.iter().zip(joint_values).map(|(joint, &value)| {
            let (q_angle, q_length) = joint.split(value);
            let mut frame = pose;
            for (kind, motion) in joint.link.motions(q_angle, q_length) {
                pose *= motion.transform();
                if matches!(kind, ParameterKind::ThetaOffset | ParameterKind::D) {
                    frame = pose;
                }
            }
            renormalized(frame)
        });
        Ok(frames.collect())
    }

    /// Whether every joint value lies within its joint's limits.
    pub fn admits(&self, joint_values: &[f64]) -> bool {
        joint_values.len() == self.joints.len()
            && self.joints.iter().zip(joint_values).all(|(joint, &value)| joint.admits(value))
    }

    pub(crate) fn check(&self, joint_values: &[f64]) -> Result<(), KinematicsError> {
        if joint_values.len() != self.joints.len() {
            return Err(KinematicsError::JointCount { need: self.joints.len(), got: joint_values.len() });
        }
        match joint_values.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(KinematicsError::NotFinite {
                what: format!("the value of joint {}", index + 1),
                value: joint_values[index].to_string(),
            }),
            None => Ok(()),
        }
    }
}

/// Products of unit quaternions drift off the unit sphere by rounding; one step of Newton's method brings them back.
pub(crate) fn renormalized(mut pose: Isometry3) -> Isometry3 {
    pose.rotation.renormalize_fast();
    pose
}

#[cfg(test)]
mod tests {
    use super::*;

    fn planar_arm() -> SerialChain {
        SerialChain::new(vec![
            Joint::revolute("1", Link::modified_dh(0.0, 0.0, 0.0, 0.5)),
            Joint::revolute("2", Link::modified_dh(0.0, 1.0, 0.0, 0.0)),
            Joint { kind: JointKind::Prismatic, ..Joint::revolute("3", Link::modified_dh(0.0, 2.0, 0.0, 0.0)) },
        ])
        .unwrap()
    }

    #[test]
    fn forward_kinematics_of_a_planar_arm_by_hand() {
        let quarter = std::f64::consts::FRAC_PI_2;
        let flange = planar_arm().base_from_flange(&[quarter, -quarter, 0.25]).unwrap();
        assert!((flange.translation.vector - nalgebra::Vector3::new(2.0, 1.0, 0.75)).norm() < 1e-12);
        assert!(flange.rotation.angle() < 1e-12);
    }

    #[test]
    fn wrong_input_is_named() {
        let arm = planar_arm();
        assert!(matches!(arm.base_from_flange(&[0.0]), Err(KinematicsError::JointCount { need: 3, got: 1 })));
        assert!(matches!(arm.base_from_flange(&[0.0, f64::NAN, 0.0]), Err(KinematicsError::NotFinite { .. })));
        let mut arm = arm;
        let beta = ParameterId { joint: 1, kind: ParameterKind::Beta };
        assert_eq!(arm.set_parameter(beta, 0.1).unwrap_err().to_string(), "joint 2 has no parameter beta_2");
        let sliding = Joint { kind: JointKind::Prismatic, ..Joint::revolute("x", Link::hayati(0.0, 0.0, 0.0, 0.0)) };
        assert!(matches!(SerialChain::new(vec![sliding]), Err(KinematicsError::PrismaticHayati { joint: 1 })));
    }
}
