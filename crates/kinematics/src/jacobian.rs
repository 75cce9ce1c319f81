//! The analytic Jacobian of the flange's pose: one twist a parameter and a joint value.
//!
//! With `T = P M(x) S` for an elementary motion `M` about or along the unit axis `u`, a change of `x` is the twist
//! `Ad(P) u`: `omega = R_P u`, `v = t_P x omega` for a rotation, `v = R_P u` for a translation. Murray, Li and
//! Sastry, "A Mathematical Introduction to Robotic Manipulation", section 3.4.

use crate::chain::{JointKind, renormalized};
use crate::{ElementaryMotion, Isometry3, KinematicsError, ParameterId, ParameterKind, SerialChain, Twist};
use nalgebra::Vector3;

/// The flange's pose and how it changes. Twists are in the base frame: `T(x + s) = Exp(s twist) T(x)` to first order.
#[derive(Debug, Clone)]
pub struct ChainJacobian {
    /// The pose at which the derivatives were taken.
    pub base_from_flange: Isometry3,
    /// A twist for each of [`SerialChain::parameter_ids`], in that order; per radian or per metre.
    pub by_parameter: Vec<(ParameterId, Twist)>,
    /// A twist for each joint value; per radian or per metre.
    pub by_joint: Vec<Twist>,
}

impl SerialChain {
    /// Pose and Jacobian of the flange. `joint_values`: radians or metres, one a joint.
    pub fn jacobian(&self, joint_values: &[f64]) -> Result<ChainJacobian, KinematicsError> {
        self.check(joint_values)?;
        let mut pose = *self.base_from_first();
        let mut by_parameter = Vec::with_capacity(4 * self.joint_count());
        let mut by_joint = Vec::with_capacity(self.joint_count());
        for (joint, (description, &value)) in self.joints().iter().zip(joint_values).enumerate() {
            let (q_angle, q_length) = description.split(value);
            let driven = match description.kind {
                JointKind::Revolute => ParameterKind::ThetaOffset,
                JointKind::Prismatic => ParameterKind::D,
            };
            for (kind, motion) in description.link.motions(q_angle, q_length) {
                let twist = twist_of(&pose, motion);
                by_parameter.push((ParameterId { joint, kind }, twist));
                if kind == driven {
                    by_joint.push(twist);
                }
                pose *= motion.transform();
            }
        }
        Ok(ChainJacobian { base_from_flange: renormalized(pose * self.last_from_flange()), by_parameter, by_joint })
    }
}

fn twist_of(base_from_before: &Isometry3, motion: ElementaryMotion) -> Twist {
    let turn = |axis: Vector3<f64>| {
        let omega = base_from_before.rotation * axis;
        stack(&base_from_before.translation.vector.cross(&omega), &omega)
    };
    let slide = |axis: Vector3<f64>| stack(&(base_from_before.rotation * axis), &Vector3::zeros());
    match motion {
        ElementaryMotion::RotateX(_) => turn(Vector3::x()),
        ElementaryMotion::RotateY(_) => turn(Vector3::y()),
        ElementaryMotion::RotateZ(_) => turn(Vector3::z()),
        ElementaryMotion::TranslateX(_) => slide(Vector3::x()),
        ElementaryMotion::TranslateZ(_) => slide(Vector3::z()),
    }
}

fn stack(v: &Vector3<f64>, omega: &Vector3<f64>) -> Twist {
    Twist::new(v.x, v.y, v.z, omega.x, omega.y, omega.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Joint, Link};
    use nalgebra::Matrix4;
    use proptest::prelude::*;

    /// `[twist]^ T`: the derivative of the homogeneous matrix that belongs to the twist.
    fn matrix_derivative(twist: &Twist, pose: &Isometry3) -> Matrix4<f64> {
        let mut hat = Matrix4::zeros();
        hat.fixed_view_mut::<3, 3>(0, 0).copy_from(&Vector3::new(twist[3], twist[4], twist[5]).cross_matrix());
        hat.fixed_view_mut::<3, 1>(0, 3).copy_from(&Vector3::new(twist[0], twist[1], twist[2]));
        hat * pose.to_homogeneous()
    }

    proptest! {
        #[test]
        fn jacobian_agrees_with_differences(
            numbers in prop::collection::vec(-1.5..1.5f64, 20),
            values in prop::collection::vec(-2.0..2.0f64, 5),
        ) {
            let n = |joint: usize, index: usize| numbers[4 * joint + index];
            let chain = SerialChain::with_ends(
                Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(0.3, -0.2, 0.1)),
                vec![
                    Joint::revolute("1", Link::modified_dh(n(0, 0), n(0, 1), n(0, 2), n(0, 3))),
                    Joint::revolute("2", Link::hayati(n(1, 0), n(1, 1), n(1, 2), n(1, 3))),
                    Joint { kind: JointKind::Prismatic, ..Joint::revolute("3", Link::modified_dh(n(2, 0), n(2, 1), n(2, 2), n(2, 3))) },
                    Joint::revolute("4", Link::standard_dh(n(3, 0), n(3, 1), n(3, 2), n(3, 3))),
                    Joint::revolute("5", Link { form: crate::LinkForm::StandardHayati, ..Link::hayati(n(4, 0), n(4, 1), n(4, 2), n(4, 3)) }),
                ],
                Isometry3::new(Vector3::new(-0.1, 0.05, 0.2), Vector3::new(0.0, 0.4, 0.2)),
            ).unwrap();
            let jacobian = chain.jacobian(&values).unwrap();
            prop_assert!((jacobian.base_from_flange.to_homogeneous() - chain.base_from_flange(&values).unwrap().to_homogeneous()).norm() < 1e-12);
            let step = 1e-6;
            for (id, twist) in &jacobian.by_parameter {
                let at = |change: f64| {
                    let mut moved = chain.clone();
                    moved.set_parameter(*id, chain.parameter(*id).unwrap() + change).unwrap();
                    moved.base_from_flange(&values).unwrap().to_homogeneous()
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - matrix_derivative(twist, &jacobian.base_from_flange)).norm() < 1e-7, "{id}");
            }
            for (joint, twist) in jacobian.by_joint.iter().enumerate() {
                let at = |change: f64| {
                    let mut moved = values.clone();
                    moved[joint] += change;
                    chain.base_from_flange(&moved).unwrap().to_homogeneous()
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - matrix_derivative(twist, &jacobian.base_from_flange)).norm() < 1e-7);
            }
        }
    }
}
