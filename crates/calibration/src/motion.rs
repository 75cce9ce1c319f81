//! Camera poses of all postures under a model, and how each free parameter moves them.
//!
//! A camera pose changes by a twist in the camera's own frame: `T(x + s) = T(x) Exp(s (v, omega))` to first order. The arm's twists come
//! from the chain's Jacobian in the base frame and are brought to the camera by one adjoint each. Corrections of joint values
//! (gears, compliance, time) are linear in their parameters, so that their columns are multiples of the joints' own.

use crate::{CalibrationError, Model, Parameter};
use nalgebra::{Vector3, Vector6};
use skclam_geometry::Isometry3;
use skclam_rig::{Posture, PostureState, Rig, RigError};

/// What multiplies the corrections of one joint in one posture.
#[derive(Debug, Clone, Copy)]
struct JointRegressor {
    /// The encoder's value.
    value: f64,
    /// Change a second, from the neighbouring postures' timestamps.
    rate: f64,
    /// Torque about the axis of a unit weight at the flange, metres, from the nominal arm; the base's z points up.
    lever: f64,
}

/// The postures of a recording, ready to be posed by any model of the same arm.
#[derive(Debug, Clone)]
pub(crate) struct Motion {
    postures: Vec<PostureMotion>,
}

#[derive(Debug, Clone)]
enum PostureMotion {
    Joints { index: u64, regressors: Vec<JointRegressor> },
    Flange(Isometry3),
}

/// A camera's pose and its derivatives: twists in the camera's frame.
#[derive(Debug, Clone)]
pub(crate) struct CameraMotion {
    pub base_from_camera: Isometry3,
    /// One a parameter; zero for those that do not move the camera.
    pub by_parameter: Vec<Vector6<f64>>,
    /// One a joint; empty for flange poses.
    pub by_joint: Vec<Vector6<f64>>,
}

impl Motion {
    pub(crate) fn new(nominal: &Rig, postures: &[Posture]) -> Result<Self, CalibrationError> {
        let values = |at: usize| match &postures[at].state {
            PostureState::Joints(values) => Some((postures[at].timestamp_s?, values)),
            PostureState::FlangePose(_) => None,
        };
        let postures = postures.iter().enumerate().map(|(at, posture)| match &posture.state {
            PostureState::FlangePose(base_from_flange) => Ok(PostureMotion::Flange(*base_from_flange)),
            PostureState::Joints(joints) => {
                let index = posture.index;
                let robot = nominal.robot.as_ref().ok_or(RigError::NoRobot { index })?;
                let jacobian = robot.jacobian(joints).map_err(|source| RigError::Kinematics { index, source })?;
                let flange = jacobian.base_from_flange.translation.vector;
                let before = values(at.saturating_sub(1));
                let after = values((at + 1).min(postures.len() - 1));
                let regressors = joints.iter().enumerate().map(|(joint, &value)| {
                    let twist = jacobian.by_joint[joint];
                    let omega = Vector3::new(twist[3], twist[4], twist[5]);
                    let rate = match (before, after) {
                        (Some((t0, q0)), Some((t1, q1))) if t1 > t0 && q0.len() == q1.len() => {
                            (q1[joint] - q0[joint]) / (t1 - t0)
                        }
                        _ => 0.0,
                    };
                    JointRegressor { value, rate, lever: -(twist[2] + omega.cross(&flange).z) }
                });
                Ok(PostureMotion::Joints { index, regressors: regressors.collect() })
            }
        });
        Ok(Motion { postures: postures.collect::<Result<_, CalibrationError>>()? })
    }

    pub(crate) fn len(&self) -> usize {
        self.postures.len()
    }

    /// Whether every posture gives joint values.
    pub(crate) fn has_joints(&self) -> bool {
        !self.postures.is_empty() && self.postures.iter().all(|posture| matches!(posture, PostureMotion::Joints { .. }))
    }

    /// Camera pose of a posture. `deviation`: what its joints stood off their values; empty for none.
    pub(crate) fn pose(&self, model: &Model, posture: usize, deviation: &[f64]) -> Result<Isometry3, CalibrationError> {
        let base_from_flange = match &self.postures[posture] {
            PostureMotion::Flange(base_from_flange) => *base_from_flange,
            PostureMotion::Joints { index, regressors } => {
                let robot = model.rig.robot.as_ref().ok_or(RigError::NoRobot { index: *index })?;
                robot.base_from_flange(&corrected(model, regressors, deviation))?
            }
        };
        Ok(base_from_flange * model.rig.flange_from_color)
    }

    /// Camera poses of all postures. `deviations`: joint by joint, posture by posture; empty for none.
    pub(crate) fn poses(&self, model: &Model, deviations: &[f64]) -> Result<Vec<Isometry3>, CalibrationError> {
        (0..self.len()).map(|posture| self.pose(model, posture, self.deviation(deviations, posture))).collect()
    }

    /// The part of `deviations` that belongs to a posture.
    pub(crate) fn deviation<'a>(&self, deviations: &'a [f64], posture: usize) -> &'a [f64] {
        let joints = deviations.len().checked_div(self.len()).unwrap_or(0);
        &deviations[posture * joints..(posture + 1) * joints]
    }

    /// Camera pose and its derivatives.
    pub(crate) fn linearize(
        &self,
        model: &Model,
        parameters: &[Parameter],
        posture: usize,
        deviation: &[f64],
    ) -> Result<CameraMotion, CalibrationError> {
        let (base_from_flange, chain, by_joint, regressors) = match &self.postures[posture] {
            PostureMotion::Flange(pose) => (*pose, Vec::new(), Vec::new(), &[][..]),
            PostureMotion::Joints { index, regressors } => {
                let robot = model.rig.robot.as_ref().ok_or(RigError::NoRobot { index: *index })?;
                let jacobian = robot.jacobian(&corrected(model, regressors, deviation))?;
                (jacobian.base_from_flange, jacobian.by_parameter, jacobian.by_joint, &regressors[..])
            }
        };
        let base_from_camera = base_from_flange * model.rig.flange_from_color;
        let by_joint: Vec<_> = by_joint.iter().map(|twist| in_camera(&base_from_camera, twist)).collect();
        let camera_from_flange = model.rig.flange_from_color.rotation.inverse();
        let column = |parameter: &Parameter| match *parameter {
            Parameter::Chain(id) => chain
                .iter()
                .find(|(of, _)| *of == id)
                .map_or_else(Vector6::zeros, |(_, twist)| in_camera(&base_from_camera, twist)),
            Parameter::Mount(component) => {
                // Rotations turn about the camera's own centre: no velocity there.
                let axis = camera_from_flange * Vector3::ith(component.axis(), 1.0);
                let zero = Vector3::zeros();
                if component.is_rotation() { stack(&zero, &axis) } else { stack(&axis, &zero) }
            }
            Parameter::TimeOffset => {
                by_joint.iter().zip(regressors).fold(Vector6::zeros(), |sum, (twist, r)| sum + twist * r.rate)
            }
            Parameter::GearSin(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * regressors[joint].value.sin())
            }
            Parameter::GearCos(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * regressors[joint].value.cos())
            }
            Parameter::Compliance(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * regressors[joint].lever)
            }
            Parameter::Intrinsic(_) | Parameter::DepthScale | Parameter::DepthOffset => Vector6::zeros(),
        };
        let by_parameter = parameters.iter().map(column).collect();
        Ok(CameraMotion { base_from_camera, by_parameter, by_joint })
    }
}

fn corrected(model: &Model, regressors: &[JointRegressor], deviation: &[f64]) -> Vec<f64> {
    let correct = |(joint, r): (usize, &JointRegressor)| {
        let gear = model
            .joints
            .get(joint)
            .map_or(0.0, |c| c.gear_sin * r.value.sin() + c.gear_cos * r.value.cos() + c.compliance * r.lever);
        r.value + gear + model.time_offset_s * r.rate + deviation.get(joint).copied().unwrap_or(0.0)
    };
    regressors.iter().enumerate().map(correct).collect()
}

/// A twist of the base frame as the camera sees it: `Ad(T^-1)`.
fn in_camera(base_from_camera: &Isometry3, twist: &Vector6<f64>) -> Vector6<f64> {
    let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
    let camera_from_base = base_from_camera.rotation.inverse();
    let at_camera = v + omega.cross(&base_from_camera.translation.vector);
    stack(&(camera_from_base * at_camera), &(camera_from_base * omega))
}

/// A twist of the camera's own frame in the base frame: `Ad(T)`.
pub(crate) fn in_base(base_from_camera: &Isometry3, twist: &Vector6<f64>) -> Vector6<f64> {
    let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
    let turned = base_from_camera.rotation * omega;
    stack(&(base_from_camera.rotation * v + base_from_camera.translation.vector.cross(&turned)), &turned)
}

pub(crate) fn stack(v: &Vector3<f64>, omega: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(v.x, v.y, v.z, omega.x, omega.y, omega.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Free;
    use crate::synthetic::{diverse_postures, hp3j, manufacture, perturbed, seeded};

    /// Central difference of a pose as a twist in the camera's frame.
    fn difference(lower: &Isometry3, middle: &Isometry3, upper: &Isometry3, step: f64) -> Vector6<f64> {
        let (up, down) = (middle.inverse() * upper, middle.inverse() * lower);
        let turn = up.rotation.scaled_axis() - down.rotation.scaled_axis();
        stack(&((up.translation.vector - down.translation.vector) / (2.0 * step)), &(turn / (2.0 * step)))
    }

    #[test]
    fn every_column_agrees_with_differences() {
        let nominal = hp3j();
        let mut rng = seeded(1);
        let postures = diverse_postures(&nominal, 6, &mut rng);
        let motion = Motion::new(&nominal, &postures).unwrap();
        let mut parameters = Free::All.candidates(&nominal, true, true).unwrap();
        parameters
            .extend((0..6).flat_map(|j| [Parameter::GearSin(j), Parameter::GearCos(j), Parameter::Compliance(j)]));
        parameters.push(Parameter::TimeOffset);
        let mut model = Model::new(perturbed(&nominal, &Free::Auto, manufacture(), &mut rng));
        model.time_offset_s = 0.01;
        model.joints[1].gear_sin = 0.002;
        model.joints[2].compliance = 0.004;
        let step = 1e-6;
        for posture in 0..postures.len() {
            let deviation = [1e-3, -2e-3, 1e-3, 0.0, 2e-3, 1e-3];
            let linear = motion.linearize(&model, &parameters, posture, &deviation).unwrap();
            for twist in &linear.by_parameter {
                let there_and_back = in_camera(&linear.base_from_camera, &in_base(&linear.base_from_camera, twist));
                assert!((there_and_back - twist).norm() < 1e-14);
            }
            for (k, parameter) in parameters.iter().enumerate() {
                let at = |change: f64| {
                    let moved = model.stepped(&[*parameter], &[change]).unwrap();
                    motion.pose(&moved, posture, &deviation).unwrap()
                };
                let expected = difference(&at(-step), &at(0.0), &at(step), step);
                assert!((linear.by_parameter[k] - expected).norm() < 1e-7, "{parameter} in posture {posture}");
            }
            for joint in 0..6 {
                let at = |change: f64| {
                    let mut moved = deviation;
                    moved[joint] += change;
                    motion.pose(&model, posture, &moved).unwrap()
                };
                let expected = difference(&at(-step), &at(0.0), &at(step), step);
                assert!((linear.by_joint[joint] - expected).norm() < 1e-7);
            }
        }
    }
}
