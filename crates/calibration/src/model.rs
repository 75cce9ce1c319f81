//! The calibrated state: a rig, and how its measured depth is to be read.

use crate::{CalibrationError, MountComponent, Parameter};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use skclam_rig::{BoardPattern, JointCorrection, JointCorrections, Rig};

/// `z = offset + scale z_measured`, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthCorrection {
    /// Dimensionless.
    pub scale: f64,
    /// Metres.
    pub offset_m: f64,
    /// What the depth camera's place beside the colour camera is off: translation, metres, then rotation vector,
    /// radians, in the colour camera's axes; `color_from_depth` is `Exp` of it times what the rig says.
    pub extrinsics: [f64; 6],
}

impl Default for DepthCorrection {
    fn default() -> Self {
        DepthCorrection { scale: 1.0, offset_m: 0.0, extrinsics: [0.0; 6] }
    }
}

/// Place of a component in [`DepthCorrection::extrinsics`]: translations first.
pub(crate) fn extrinsic_index(component: MountComponent) -> usize {
    component.axis() + if component.is_rotation() { 3 } else { 0 }
}

/// A rig, and how its measured depth is to be read.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Arm, what its joints do beside their encoders, mount, cameras. Its depth camera's unit is untouched: see
    /// `depth`, and [`Model::corrected_rig`].
    pub rig: Rig,
    /// Of the measured depth.
    pub depth: DepthCorrection,
    /// The board's squares as a multiple of what the rig says.
    pub board_scale: f64,
}

impl Model {
    /// A rig as it is.
    pub fn new(mut rig: Rig) -> Self {
        let joints = rig.robot.as_ref().map_or(0, |robot| robot.joint_count());
        rig.joint_corrections.joints.resize(joints, JointCorrection::default());
        Model { rig, depth: DepthCorrection::default(), board_scale: 1.0 }
    }

    /// The rig with the depth correction worked into its depth camera's unit and offset.
    pub fn corrected_rig(&self) -> Rig {
        let mut rig = self.rig.clone();
        if let Some(depth) = &mut rig.depth {
            depth.unit_m *= self.depth.scale;
            depth.offset_m = self.depth.offset_m + self.depth.scale * depth.offset_m;
            let [x, y, z, rx, ry, rz] = self.depth.extrinsics;
            depth.color_from_depth =
                Isometry3::new(Vector3::new(x, y, z), Vector3::new(rx, ry, rz)) * depth.color_from_depth;
        }
        if let Some(board) = &mut rig.board {
            board.square_m *= self.board_scale;
            if let BoardPattern::Charuco { marker_um, .. } = &mut board.pattern {
                *marker_um = (*marker_um as f64 * self.board_scale).round() as u64;
            }
        }
        if rig.joint_corrections.is_none() {
            rig.joint_corrections = JointCorrections::default();
        }
        rig
    }

    /// A parameter's value in its unit. A mount rotation is relative to `nominal`'s mount: the rotation vector from
    /// that to this in the flange's axes. `None` where there is no such joint or parameter.
    pub fn value(&self, nominal: &Rig, parameter: Parameter) -> Option<f64> {
        Some(match parameter {
            Parameter::Chain(id) => self.rig.robot.as_ref()?.parameter(id)?,
            Parameter::Mount(component) if component.is_rotation() => {
                let change = self.rig.flange_from_color.rotation * nominal.flange_from_color.rotation.inverse();
                change.scaled_axis()[component.axis()]
            }
            Parameter::Mount(component) => self.rig.flange_from_color.translation.vector[component.axis()],
            Parameter::Intrinsic(intrinsic) => self.rig.color.intrinsics()[intrinsic as usize],
            Parameter::DepthScale => self.depth.scale,
            Parameter::DepthOffset => self.depth.offset_m,
            Parameter::DepthExtrinsic(component) => self.depth.extrinsics[extrinsic_index(component)],
            Parameter::BoardScale => self.board_scale,
            Parameter::TimeOffset => self.rig.joint_corrections.time_offset_s,
            Parameter::TransmissionSin(joint) => self.rig.joint_corrections.joints.get(joint)?.transmission_sin,
            Parameter::TransmissionCos(joint) => self.rig.joint_corrections.joints.get(joint)?.transmission_cos,
            Parameter::Compliance(joint) => self.rig.joint_corrections.joints.get(joint)?.compliance,
        })
    }

    /// The model after a step: `delta[k]` is added to `parameters[k]`. Rotations of the mount are composed as one
    /// rotation vector in the flange's axes, `Exp(delta) R`, so that a step from here is always small and has no
    /// singularity.
    pub fn stepped(&self, parameters: &[Parameter], delta: &[f64]) -> Result<Model, CalibrationError> {
        let mut model = self.clone();
        let mut turn = Vector3::zeros();
        let mut intrinsics = self.rig.color.intrinsics();
        fn of_joint(model: &mut Model, joint: usize) -> Option<&mut JointCorrection> {
            model.rig.joint_corrections.joints.get_mut(joint)
        }
        for (&parameter, &change) in parameters.iter().zip(delta) {
            let missing = || CalibrationError::NoSuchParameter { parameter, reason: "no such joint".to_owned() };
            match parameter {
                Parameter::Chain(id) => {
                    let robot = model.rig.robot.as_mut().ok_or_else(missing)?;
                    let value = robot.parameter(id).ok_or_else(missing)? + change;
                    robot.set_parameter(id, value)?;
                }
                Parameter::Mount(component) if component.is_rotation() => turn[component.axis()] += change,
                Parameter::Mount(component) => {
                    model.rig.flange_from_color.translation.vector[component.axis()] += change;
                }
                Parameter::Intrinsic(intrinsic) => intrinsics[intrinsic as usize] += change,
                Parameter::DepthScale => model.depth.scale += change,
                Parameter::DepthOffset => model.depth.offset_m += change,
                Parameter::DepthExtrinsic(component) => model.depth.extrinsics[extrinsic_index(component)] += change,
                Parameter::BoardScale => model.board_scale += change,
                Parameter::TimeOffset => model.rig.joint_corrections.time_offset_s += change,
                Parameter::TransmissionSin(joint) => {
                    of_joint(&mut model, joint).ok_or_else(missing)?.transmission_sin += change
                }
                Parameter::TransmissionCos(joint) => {
                    of_joint(&mut model, joint).ok_or_else(missing)?.transmission_cos += change
                }
                Parameter::Compliance(joint) => of_joint(&mut model, joint).ok_or_else(missing)?.compliance += change,
            }
        }
        model.rig.color = model.rig.color.with_intrinsics(intrinsics);
        if turn != Vector3::zeros() {
            let mut rotation = UnitQuaternion::from_scaled_axis(turn) * self.rig.flange_from_color.rotation;
            rotation.renormalize();
            model.rig.flange_from_color.rotation = rotation;
        }
        Ok(model)
    }

    /// `nominal` with the parameters set to values: the inverse of reading [`Model::value`] one by one.
    pub fn with_values(nominal: &Rig, parameters: &[Parameter], values: &[f64]) -> Result<Model, CalibrationError> {
        let model = Model::new(nominal.clone());
        let delta: Vec<f64> = parameters
            .iter()
            .zip(values)
            .map(|(&parameter, value)| {
                model
                    .value(nominal, parameter)
                    .map(|from| value - from)
                    .ok_or_else(|| CalibrationError::NoSuchParameter { parameter, reason: "no such joint".to_owned() })
            })
            .collect::<Result<_, _>>()?;
        model.stepped(parameters, &delta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Free;
    use crate::synthetic::hp3j;

    #[test]
    fn a_depth_correction_goes_into_the_depth_camera() {
        let mut model = Model::new(hp3j());
        let nominal = skclam_geometry::DepthCamera { offset_m: 2e-3, ..model.rig.depth.unwrap() };
        model.rig.depth = Some(nominal);
        model.depth = DepthCorrection { scale: 1.01, offset_m: -5e-3, ..Default::default() };
        let corrected = model.corrected_rig().depth.unwrap();
        let measured = |camera: &skclam_geometry::DepthCamera| camera.offset_m + 700.0 * camera.unit_m;
        assert!((measured(&corrected) - (-5e-3 + 1.01 * measured(&nominal))).abs() < 1e-12);
    }

    #[test]
    fn gears_that_were_estimated_go_into_the_rig_and_pose_its_cameras() {
        use crate::synthetic::{box_points, diverse_postures, half_pixel, record, seeded};
        use crate::{BundleOptions, calibrate_bundle, camera_poses};
        let mut rng = seeded(6);
        let mut truth = hp3j();
        let one = JointCorrection { transmission_sin: 2e-3, transmission_cos: -1e-3, compliance: 0.0 };
        truth.joint_corrections.joints = vec![one; 6];
        let postures = diverse_postures(&truth, 40, &mut rng);
        let data = record(&truth, &postures, &box_points(3000, &mut rng), half_pixel(), &mut rng);
        let free = Free::parse("auto,gears", &hp3j()).unwrap();
        let found = calibrate_bundle(&hp3j(), &data, &BundleOptions { free, ..Default::default() }).unwrap();
        let rig = found.model.corrected_rig();
        let error = |rig: &Rig, posture: &skclam_rig::Posture| {
            let [is, nominal] = [&truth, rig].map(|rig| rig.base_from_color(posture).unwrap());
            // The base's turn about joint 1 is free: heights and radii are compared.
            let [is, nominal] = [is, nominal].map(|pose| pose.translation.vector);
            (is.z - nominal.z).hypot(is.xy().norm() - nominal.xy().norm())
        };
        for (posture, pose) in postures.iter().zip(camera_poses(&found.model, &postures).unwrap()) {
            assert!((rig.base_from_color(posture).unwrap().to_homogeneous() - pose.to_homogeneous()).norm() < 1e-6);
        }
        let mean = |rig: &Rig| postures.iter().map(|posture| error(rig, posture)).sum::<f64>() / 40.0;
        let (before, after) = (mean(&hp3j()), mean(&rig));
        assert!(before > 1e-3 && after < 0.2e-3, "{before} m, then {after} m");
    }

    #[test]
    fn values_that_were_set_are_read_back() {
        let nominal = hp3j();
        let mut parameters = Free::All.candidates(&nominal, true, true).unwrap();
        parameters.extend([
            Parameter::TimeOffset,
            Parameter::TransmissionSin(1),
            Parameter::TransmissionCos(5),
            Parameter::Compliance(2),
        ]);
        let start = Model::new(nominal.clone());
        let values: Vec<f64> = parameters
            .iter()
            .enumerate()
            .map(|(k, &p)| start.value(&nominal, p).unwrap() + 0.01 * (1.0 + k as f64))
            .collect();
        let model = Model::with_values(&nominal, &parameters, &values).unwrap();
        for (&parameter, value) in parameters.iter().zip(&values) {
            assert!((model.value(&nominal, parameter).unwrap() - value).abs() < 1e-12, "{parameter}");
        }
        assert!(Model::with_values(&nominal, &[Parameter::TransmissionSin(6)], &[0.0]).is_err());
    }
}
