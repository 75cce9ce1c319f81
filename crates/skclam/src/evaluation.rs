//! How far a rig is from the truth: errors of its parameters, and of the poses that it predicts.
//!
//! The base's own gauge: a turn about and a shift along the first joint's axis move every camera pose alike, so no
//! image determines them (`theta_offset_1` and `d_1`). Errors are given raw, and after that rotation and shift.

use nalgebra::{Translation3, Unit, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Point3};
use skclam_kinematics::SerialChain;
use skclam_rig::{Posture, PostureState, Rig, RigError};

/// Mean, standard deviation and largest value of a list of errors.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Statistics {
    /// Mean.
    pub mean: f64,
    /// Standard deviation over the list.
    pub sd: f64,
    /// Largest.
    pub max: f64,
}

impl Statistics {
    /// Of a list; all zero for an empty one.
    pub fn of(values: &[f64]) -> Self {
        if values.is_empty() {
            return Self::default();
        }
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count;
        Statistics { mean, sd: variance.sqrt(), max: values.iter().copied().fold(f64::MIN, f64::max) }
    }
}

/// Errors of poses over the postures.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PoseErrors {
    /// Distance between the positions, millimetres.
    pub position_mm: Statistics,
    /// Angle between the orientations, degrees.
    pub orientation_deg: Statistics,
}

impl PoseErrors {
    /// Of pairs of poses (estimated, true).
    pub fn between(estimated: &[Isometry3], truth: &[Isometry3]) -> Self {
        let pairs = || estimated.iter().zip(truth);
        let position: Vec<f64> =
            pairs().map(|(e, t)| (e.translation.vector - t.translation.vector).norm() * 1e3).collect();
        let orientation: Vec<f64> = pairs().map(|(e, t)| e.rotation.angle_to(&t.rotation).to_degrees()).collect();
        PoseErrors { position_mm: Statistics::of(&position), orientation_deg: Statistics::of(&orientation) }
    }
}

/// One parameter beside its truth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterError {
    /// Name as in `rig.toml` with the joint's number: "alpha_2", "mount_x".
    pub name: String,
    /// "deg" or "mm".
    pub unit: String,
    /// In the true rig.
    pub truth: f64,
    /// In the rig under evaluation.
    pub estimated: f64,
    /// `estimated - truth`, angles wrapped to (-180, 180].
    pub error: f64,
}

/// What a comparison with the truth gives.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Evaluation {
    /// Number of postures compared.
    pub postures: usize,
    /// Every parameter of arm and mount.
    pub parameters: Vec<ParameterError>,
    /// The flange's pose, raw.
    pub flange: PoseErrors,
    /// The camera's pose, raw.
    pub camera: PoseErrors,
    /// The flange's pose after a turn about and a shift along the first joint's axis.
    pub flange_after_base_gauge: PoseErrors,
    /// The camera's pose after a turn about and a shift along the first joint's axis.
    pub camera_after_base_gauge: PoseErrors,
}

/// Compares a rig with the true one over postures.
pub fn evaluate(rig: &Rig, truth: &Rig, postures: &[Posture]) -> Result<Evaluation, RigError> {
    let flanges =
        |rig: &Rig| postures.iter().map(|posture| rig.base_from_flange(posture)).collect::<Result<Vec<_>, _>>();
    let cameras =
        |rig: &Rig| postures.iter().map(|posture| rig.base_from_color(posture)).collect::<Result<Vec<_>, _>>();
    let (flange, flange_truth) = (flanges(rig)?, flanges(truth)?);
    let (camera, camera_truth) = (cameras(rig)?, cameras(truth)?);
    let gauge = match postures.first().map(|posture| (&posture.state, &rig.robot)) {
        Some((PostureState::Joints(joints), Some(robot))) => base_gauge(robot, joints, &camera, &camera_truth),
        // Flange poses come from the controller: its base is known and nothing is free there.
        _ => Isometry3::identity(),
    };
    let moved = |poses: &[Isometry3]| poses.iter().map(|pose| gauge * pose).collect::<Vec<_>>();
    Ok(Evaluation {
        postures: postures.len(),
        parameters: parameter_errors(rig, truth),
        flange: PoseErrors::between(&flange, &flange_truth),
        camera: PoseErrors::between(&camera, &camera_truth),
        flange_after_base_gauge: PoseErrors::between(&moved(&flange), &flange_truth),
        camera_after_base_gauge: PoseErrors::between(&moved(&camera), &camera_truth),
    })
}

/// The turn about and the shift along the first joint's axis that bring `estimated` positions closest to `truth`.
pub fn base_gauge(robot: &SerialChain, joints: &[f64], estimated: &[Isometry3], truth: &[Isometry3]) -> Isometry3 {
    let Some(twist) = robot.jacobian(joints).ok().and_then(|jacobian| jacobian.by_joint.first().copied()) else {
        return Isometry3::identity();
    };
    let omega = Vector3::new(twist[3], twist[4], twist[5]);
    let Some(axis) = Unit::try_new(omega, 1e-9) else {
        // A prismatic first joint: only the shift along it is free.
        let direction = Vector3::new(twist[0], twist[1], twist[2]).normalize();
        let shift = mean(
            estimated.iter().zip(truth).map(|(e, t)| (t.translation.vector - e.translation.vector).dot(&direction)),
        );
        return Isometry3::from_parts(Translation3::from(direction * shift), UnitQuaternion::identity());
    };
    // The point of the axis nearest to the base: omega x v for v = p x omega.
    let on_axis = Point3::from(axis.cross(&Vector3::new(twist[0], twist[1], twist[2])));
    let relative = |pose: &Isometry3| pose.translation.vector - on_axis.coords;
    let shift = mean(estimated.iter().zip(truth).map(|(e, t)| (relative(t) - relative(e)).dot(&axis)));
    let (mut sine, mut cosine) = (0.0, 0.0);
    for (e, t) in estimated.iter().zip(truth) {
        let radial = |v: Vector3<f64>| v - axis.into_inner() * v.dot(&axis);
        let (e, t) = (radial(relative(e)), radial(relative(t)));
        sine += e.cross(&t).dot(&axis);
        cosine += e.dot(&t);
    }
    let turn = UnitQuaternion::from_axis_angle(&axis, sine.atan2(cosine));
    let translation = on_axis.coords - turn * on_axis.coords + axis.into_inner() * shift;
    Isometry3::from_parts(Translation3::from(translation), turn)
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    values.sum::<f64>() / count
}

fn parameter_errors(rig: &Rig, truth: &Rig) -> Vec<ParameterError> {
    let mut errors = Vec::new();
    if let (Some(robot), Some(true_robot)) = (&rig.robot, &truth.robot) {
        for id in true_robot.parameter_ids() {
            if let (Some(estimated), Some(truth)) = (robot.parameter(id), true_robot.parameter(id)) {
                let difference = if id.kind.is_angle() { wrapped(estimated - truth) } else { estimated - truth };
                errors.push(entry(id.to_string(), id.kind.is_angle(), estimated, truth, difference));
            }
        }
    }
    let (mount, true_mount) = (&rig.flange_from_color, &truth.flange_from_color);
    for (axis, name) in ["mount_x", "mount_y", "mount_z"].into_iter().enumerate() {
        let (estimated, truth) = (mount.translation.vector[axis], true_mount.translation.vector[axis]);
        errors.push(entry(name.to_owned(), false, estimated, truth, estimated - truth));
    }
    // The rotation from the true to the estimated mount, about the flange's axes.
    let rotation = (mount.rotation * true_mount.rotation.inverse()).scaled_axis();
    for (axis, name) in ["mount_rx", "mount_ry", "mount_rz"].into_iter().enumerate() {
        errors.push(entry(name.to_owned(), true, rotation[axis], 0.0, rotation[axis]));
    }
    errors
}

fn entry(name: String, angle: bool, estimated: f64, truth: f64, error: f64) -> ParameterError {
    let unit = |value: f64| if angle { value.to_degrees() } else { value * 1e3 };
    let unit_name = if angle { "deg" } else { "mm" };
    ParameterError {
        name,
        unit: unit_name.to_owned(),
        truth: unit(truth),
        estimated: unit(estimated),
        error: unit(error),
    }
}

fn wrapped(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle - turn * (angle / turn).round()
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_geometry::PinholeCamera;
    use skclam_kinematics::{Joint, Link, ParameterId, ParameterKind};
    use skclam_rig::{JointCorrections, Prior};

    fn rig() -> Rig {
        let robot = SerialChain::new(vec![
            Joint::revolute("1", Link::modified_dh(0.0, 0.0, 0.0, 0.3)),
            Joint::revolute("2", Link::modified_dh(1.5, 0.1, 0.2, 0.0)),
            Joint::revolute("3", Link::modified_dh(0.1, 0.4, 0.0, 0.1)),
        ])
        .unwrap();
        Rig {
            name: String::new(),
            robot: Some(robot),
            joint_corrections: JointCorrections::default(),
            flange_from_color: Isometry3::translation(0.05, 0.0, 0.1),
            color: PinholeCamera::from_hfov(640, 480, 1.0),
            depth: None,
            board: None,
            prior: Prior::default(),
            color_mask: None,
            depth_mask: None,
        }
    }

    fn postures() -> Vec<Posture> {
        let state = |i: u64| PostureState::Joints(vec![0.3 * i as f64, 0.5 - 0.1 * i as f64, 0.2 * i as f64]);
        (0..6).map(|i| Posture::new(i, state(i))).collect()
    }

    #[test]
    fn what_the_base_gauge_hides_vanishes_after_it_and_nothing_else_does() {
        let truth = rig();
        let mut moved = truth.clone();
        let robot = moved.robot.as_mut().unwrap();
        robot.set_parameter(ParameterId { joint: 0, kind: ParameterKind::ThetaOffset }, 0.01).unwrap();
        robot.set_parameter(ParameterId { joint: 0, kind: ParameterKind::D }, 0.305).unwrap();
        let evaluation = evaluate(&moved, &truth, &postures()).unwrap();
        assert!(evaluation.camera.position_mm.mean > 4.0);
        assert!(evaluation.camera_after_base_gauge.position_mm.max < 1e-9);
        assert!(evaluation.camera_after_base_gauge.orientation_deg.max < 1e-6);
        robot_error(&evaluation, "theta_offset_1", 0.01f64.to_degrees());
        robot_error(&evaluation, "d_1", 5.0);

        let mut bent = truth.clone();
        let robot = bent.robot.as_mut().unwrap();
        robot.set_parameter(ParameterId { joint: 2, kind: ParameterKind::Alpha }, 0.11).unwrap();
        let evaluation = evaluate(&bent, &truth, &postures()).unwrap();
        assert!(evaluation.camera_after_base_gauge.position_mm.mean > 0.1);
    }

    fn robot_error(evaluation: &Evaluation, name: &str, expected: f64) {
        let found = evaluation.parameters.iter().find(|parameter| parameter.name == name).unwrap();
        assert!((found.error - expected).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn angles_are_compared_modulo_two_pi() {
        let truth = rig();
        let mut turned = truth.clone();
        let id = ParameterId { joint: 1, kind: ParameterKind::ThetaOffset };
        turned.robot.as_mut().unwrap().set_parameter(id, 0.2 + std::f64::consts::TAU).unwrap();
        robot_error(&evaluate(&turned, &truth, &postures()).unwrap(), "theta_offset_2", 0.0);
    }
}
