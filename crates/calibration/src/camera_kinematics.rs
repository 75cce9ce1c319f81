//! Camera poses of all postures under a model, and how each free parameter moves them.
//!
//! A camera pose changes by a twist in the camera's own frame: `T(x + s) = T(x) Exp(s (v, omega))` to first order. The
//! arm's twists come from the chain's Jacobian in the base frame and are brought to the camera by one adjoint each.
//! Corrections of joint values (gears, compliance, time) are linear in their parameters, so that their columns are
//! multiples of the joints' own.

use crate::{CalibrationError, Model, Parameter};
use nalgebra::{Vector3, Vector6};
use skclam_geometry::Isometry3;
use skclam_rig::{JointReading, Posture, PostureState, Rig, RigError, joint_readings};

/// The postures of a recording, ready to be posed by any model of the same arm.
#[derive(Debug, Clone)]
pub(crate) struct CameraKinematics {
    postures: Vec<PostureMotion>,
}

#[derive(Debug, Clone)]
enum PostureMotion {
    Joints { index: u64, readings: Vec<JointReading> },
    Flange(Isometry3),
}

/// A camera's pose and its derivatives: twists in the camera's frame.
#[derive(Debug, Clone)]
pub(crate) struct CameraMotion {
    pub base_from_camera: Isometry3,
    /// One a parameter; zero for those that do not move the camera.
    pub by_parameter: Vec<Vector6<f64>>,
    /// One an error component of the posture: its joints, or the six of a flange pose
    /// ([`CameraKinematics::error_components`]).
    pub by_joint: Vec<Vector6<f64>>,
}

impl CameraKinematics {
    pub(crate) fn new(nominal: &Rig, postures: &[Posture]) -> Result<Self, CalibrationError> {
        let postures = postures.iter().map(|posture| match &posture.state {
            PostureState::FlangePose(base_from_flange) => Ok(PostureMotion::Flange(*base_from_flange)),
            PostureState::Joints(joints) => {
                let index = posture.index;
                let robot = nominal.robot.as_ref().ok_or(RigError::NoRobot { index })?;
                let readings = joint_readings(robot, joints, &posture.joint_rates)
                    .map_err(|source| RigError::Kinematics { index, source })?;
                Ok(PostureMotion::Joints { index, readings })
            }
        });
        Ok(CameraKinematics { postures: postures.collect::<Result<_, CalibrationError>>()? })
    }

    pub(crate) fn len(&self) -> usize {
        self.postures.len()
    }

    /// Whether every posture gives joint values.
    pub(crate) fn has_joints(&self) -> bool {
        !self.postures.is_empty() && self.postures.iter().all(|posture| matches!(posture, PostureMotion::Joints { .. }))
    }

    /// How many numbers the error of one posture has: one a joint, or six where only flange poses are known
    /// (translation of the flange, then its rotation vector, in its own axes); 0 where some postures give joints and
    /// others flange poses.
    pub(crate) fn error_components(&self) -> usize {
        let of = |posture: &PostureMotion| match posture {
            PostureMotion::Joints { readings, .. } => readings.len(),
            PostureMotion::Flange(_) => 6,
        };
        match self.postures.first() {
            Some(first) if self.has_joints() || self.postures.iter().all(|p| matches!(p, PostureMotion::Flange(_))) => {
                of(first)
            }
            _ => 0,
        }
    }

    /// The readings of a posture's joints; empty for a flange pose.
    pub(crate) fn readings(&self, posture: usize) -> &[JointReading] {
        match &self.postures[posture] {
            PostureMotion::Joints { readings, .. } => readings,
            PostureMotion::Flange(_) => &[],
        }
    }

    /// Camera pose of a posture. `error`: the posture's error ([`CameraKinematics::error_components`]); empty for none.
    pub(crate) fn pose(&self, model: &Model, posture: usize, error: &[f64]) -> Result<Isometry3, CalibrationError> {
        let base_from_flange = match &self.postures[posture] {
            PostureMotion::Flange(base_from_flange) => base_from_flange * flange_error(error),
            PostureMotion::Joints { index, readings } => {
                let robot = model.rig.robot.as_ref().ok_or(RigError::NoRobot { index: *index })?;
                robot.base_from_flange(&corrected(model, readings, error))?
            }
        };
        Ok(base_from_flange * model.rig.flange_from_color)
    }

    /// Camera poses of all postures. `errors`: component by component, posture by posture; empty for none.
    pub(crate) fn poses(&self, model: &Model, errors: &[f64]) -> Result<Vec<Isometry3>, CalibrationError> {
        (0..self.len()).map(|posture| self.pose(model, posture, self.error_of(errors, posture))).collect()
    }

    /// The part of `errors` that belongs to a posture.
    pub(crate) fn error_of<'a>(&self, errors: &'a [f64], posture: usize) -> &'a [f64] {
        let components = errors.len().checked_div(self.len()).unwrap_or(0);
        &errors[posture * components..(posture + 1) * components]
    }

    /// Camera pose and its derivatives.
    pub(crate) fn linearize(
        &self,
        model: &Model,
        parameters: &[Parameter],
        posture: usize,
        error: &[f64],
    ) -> Result<CameraMotion, CalibrationError> {
        let (base_from_flange, chain, by_joint, readings) = match &self.postures[posture] {
            PostureMotion::Flange(pose) => {
                let base_from_flange = pose * flange_error(error);
                (base_from_flange, Vec::new(), flange_twists(&base_from_flange), &[][..])
            }
            PostureMotion::Joints { index, readings } => {
                let robot = model.rig.robot.as_ref().ok_or(RigError::NoRobot { index: *index })?;
                let jacobian = robot.jacobian(&corrected(model, readings, error))?;
                (jacobian.base_from_flange, jacobian.by_parameter, jacobian.by_joint, &readings[..])
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
                by_joint.iter().zip(readings).fold(Vector6::zeros(), |sum, (twist, r)| sum + twist * r.rate)
            }
            Parameter::TransmissionSin(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * readings[joint].value.sin())
            }
            Parameter::TransmissionCos(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * readings[joint].value.cos())
            }
            Parameter::Compliance(joint) => {
                by_joint.get(joint).map_or_else(Vector6::zeros, |t| t * readings[joint].gravity_arm)
            }
            Parameter::Intrinsic(_)
            | Parameter::DepthScale
            | Parameter::DepthOffset
            | Parameter::DepthExtrinsic(_)
            | Parameter::BoardScale => Vector6::zeros(),
        };
        let by_parameter = parameters.iter().map(column).collect();
        Ok(CameraMotion { base_from_camera, by_parameter, by_joint })
    }
}

/// The error of a flange pose in the flange's own axes: translation, then rotation vector; none where it is empty.
fn flange_error(error: &[f64]) -> Isometry3 {
    match *error {
        [x, y, z, rx, ry, rz] => Isometry3::new(Vector3::new(x, y, z), Vector3::new(rx, ry, rz)),
        _ => Isometry3::identity(),
    }
}

/// Twists of the base frame that the six components of a flange pose's error make, to first order about no error.
fn flange_twists(base_from_flange: &Isometry3) -> Vec<Vector6<f64>> {
    (0..6).map(|component| in_base(base_from_flange, &Vector6::ith(component, 1.0))).collect()
}

fn corrected(model: &Model, readings: &[JointReading], error: &[f64]) -> Vec<f64> {
    let mut values = model.rig.joint_corrections.applied(readings);
    values.iter_mut().zip(error).for_each(|(value, error)| *value += error);
    values
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
        let motion = CameraKinematics::new(&nominal, &postures).unwrap();
        let mut parameters = Free::All.candidates(&nominal, true, true).unwrap();
        parameters
            .extend((0..6).flat_map(|j| {
                [Parameter::TransmissionSin(j), Parameter::TransmissionCos(j), Parameter::Compliance(j)]
            }));
        parameters.push(Parameter::TimeOffset);
        let mut model = Model::new(perturbed(&nominal, &Free::Auto, manufacture(), &mut rng));
        model.rig.joint_corrections.time_offset_s = 0.01;
        model.rig.joint_corrections.joints[1].transmission_sin = 0.002;
        model.rig.joint_corrections.joints[2].compliance = 0.004;
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

    #[test]
    fn columns_of_a_flange_poses_error_agree_with_differences() {
        let nominal = hp3j();
        let mut rng = seeded(2);
        let postures: Vec<Posture> = diverse_postures(&nominal, 4, &mut rng)
            .into_iter()
            .map(|posture| {
                let pose = nominal.base_from_flange(&posture).unwrap();
                Posture { state: PostureState::FlangePose(pose), ..posture }
            })
            .collect();
        let motion = CameraKinematics::new(&nominal, &postures).unwrap();
        assert_eq!((motion.error_components(), motion.has_joints()), (6, false));
        let model = Model::new(nominal);
        let step = 1e-6;
        // About an error that is not zero they are right to first order.
        let errors = [([0.0; 6], 1e-7), ([2e-3, -1e-3, 1e-3, 1e-3, 2e-3, -1e-3], 4e-3)];
        for (posture, (error, tolerance)) in (0..postures.len()).flat_map(|p| errors.map(|e| (p, e))) {
            let linear = motion.linearize(&model, &[], posture, &error).unwrap();
            let exact = motion.pose(&model, posture, &error).unwrap();
            assert!((linear.base_from_camera.to_homogeneous() - exact.to_homogeneous()).amax() < 1e-14);
            for component in 0..6 {
                let at = |change: f64| {
                    let mut moved = error;
                    moved[component] += change;
                    motion.pose(&model, posture, &moved).unwrap()
                };
                let expected = difference(&at(-step), &at(0.0), &at(step), step);
                let off = (linear.by_joint[component] - expected).norm();
                assert!(off < tolerance, "component {component} in posture {posture}: {off}");
            }
        }
    }

    #[test]
    fn postures_of_two_kinds_have_no_errors_of_their_own() {
        let nominal = hp3j();
        let mut postures = diverse_postures(&nominal, 3, &mut seeded(3));
        assert_eq!(CameraKinematics::new(&nominal, &postures).unwrap().error_components(), 6);
        postures[1].state = PostureState::FlangePose(Isometry3::identity());
        assert_eq!(CameraKinematics::new(&nominal, &postures).unwrap().error_components(), 0);
    }
}
