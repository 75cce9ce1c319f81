//! How far off flange and camera are expected to be, at the recorded postures and over the whole workspace.

use super::RunError;
use crate::dataset::Dataset;
use crate::evaluation::{Statistics, base_gauge};
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    AlignedPositions, Calibration, aligned_positions, orientation_sigma_rad, pose_covariances, position_sigma_m,
};
use skclam_geometry::Isometry3;
use skclam_kinematics::{JointKind, SerialChain};
use skclam_rig::{Posture, PostureState, Rig};
use std::fmt::Write;

/// Where a posture of the table comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PostureSource {
    /// The recording.
    Recorded,
    /// Spread over the joints' limits.
    Workspace,
}

/// What is known of flange and camera at one posture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PoseSigma {
    /// Where the posture comes from.
    pub source: PostureSource,
    /// The recording's index, or a running number.
    pub index: u64,
    /// Position of the camera in the base frame by the calibrated rig, mm.
    pub camera_mm: [f64; 3],
    /// How far the calibration moves the camera there, after the base's gauge, mm: the nominal rig's position error as
    /// far as the calibration knows it.
    pub camera_change_mm: f64,
    /// Standard deviation of the camera's position in space, mm; `null` where the estimator gives no covariance.
    pub camera_sigma_mm: Option<f64>,
    /// Standard deviation of the camera's orientation, degrees.
    pub camera_sigma_deg: Option<f64>,
    /// Standard deviation of the flange's position in space, mm; `null` where the controller's pose of it is taken as
    /// exact.
    pub flange_sigma_mm: Option<f64>,
    /// Standard deviation of the flange's orientation, degrees.
    pub flange_sigma_deg: Option<f64>,
}

/// Position error of the camera (root of the mean square over some postures), with the base frame fitted to them: what
/// is left for whoever registers the base with the arm itself, as standards of absolute accuracy have it (ISO 9283).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RegisteredError {
    /// How far the calibration moves the camera, mm.
    pub change_mm: f64,
    /// Standard deviation of its position in space, mm.
    pub sigma_mm: f64,
    /// The part of that which comes from the standard of length, mm.
    pub ruler_sigma_mm: f64,
    /// Expected error under the nominal rig, mm: the root of the sum of squares of change and standard deviation.
    pub nominal_mm: f64,
    /// Whether the base frame was fitted; with flange poses from a controller it is given.
    pub base_fitted: bool,
}

impl RegisteredError {
    fn of(nominal: &Rig, calibration: &Calibration, postures: &[Posture]) -> Result<Option<Self>, RunError> {
        let AlignedPositions { change_m, sigma_m, ruler_sigma_m } = aligned_positions(nominal, calibration, postures)?;
        Ok(sigma_m.map(|sigma_m| RegisteredError {
            change_mm: change_m * 1e3,
            sigma_mm: sigma_m * 1e3,
            ruler_sigma_mm: ruler_sigma_m.unwrap_or(0.0) * 1e3,
            nominal_mm: change_m.hypot(sigma_m) * 1e3,
            base_fitted: postures.iter().all(|posture| matches!(posture.state, PostureState::Joints(_))),
        }))
    }
}

/// Mean, standard deviation and maximum over some postures of what [`PoseSigma`] holds for each.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseSigmaSummary {
    /// Postures.
    pub postures: usize,
    /// How far the calibration moves the camera, after the base's gauge, mm.
    pub camera_change_mm: Statistics,
    /// What the position error of the camera is about, with the base frame fitted to the postures; `null` where the
    /// estimator gives no covariance.
    pub registered: Option<RegisteredError>,
    /// Standard deviation of the camera's position, mm.
    pub camera_sigma_mm: Option<Statistics>,
    /// Standard deviation of the camera's orientation, degrees.
    pub camera_sigma_deg: Option<Statistics>,
    /// Standard deviation of the flange's position, mm.
    pub flange_sigma_mm: Option<Statistics>,
    /// Standard deviation of the flange's orientation, degrees.
    pub flange_sigma_deg: Option<Statistics>,
}

impl PoseSigmaSummary {
    /// Over the postures of one source; `None` where there are none.
    pub fn of(poses: &[PoseSigma], source: PostureSource, registered: Option<RegisteredError>) -> Option<Self> {
        let poses: Vec<&PoseSigma> = poses.iter().filter(|pose| pose.source == source).collect();
        let over = |value: &dyn Fn(&PoseSigma) -> Option<f64>| {
            let values: Option<Vec<f64>> = poses.iter().map(|pose| value(pose)).collect();
            values.map(|values| Statistics::of(&values))
        };
        (!poses.is_empty()).then(|| PoseSigmaSummary {
            postures: poses.len(),
            camera_change_mm: over(&|pose| Some(pose.camera_change_mm)).unwrap_or_default(),
            registered,
            camera_sigma_mm: over(&|pose| pose.camera_sigma_mm),
            camera_sigma_deg: over(&|pose| pose.camera_sigma_deg),
            flange_sigma_mm: over(&|pose| pose.flange_sigma_mm),
            flange_sigma_deg: over(&|pose| pose.flange_sigma_deg),
        })
    }
}

/// Postures over the workspace: enough for a 95th percentile, and done in milliseconds.
const WORKSPACE_POSTURES: usize = 256;

/// What is known of the poses of flange and camera.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSigmas {
    /// Over recorded postures, then over the workspace (arms with joint values only).
    pub table: Vec<PoseSigma>,
    /// Over the recorded postures.
    pub recorded: Option<PoseSigmaSummary>,
    /// Over the workspace; `None` for flange poses.
    pub workspace: Option<PoseSigmaSummary>,
}

/// The table over recorded postures, then over the workspace (arms with joint values only), and both in short.
pub fn pose_sigmas(dataset: &Dataset, calibration: &Calibration) -> Result<PoseSigmas, RunError> {
    let nominal = &dataset.rig;
    let recorded: Vec<Posture> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let mut table = table(nominal, calibration, PostureSource::Recorded, &recorded)?;
    let registered = RegisteredError::of(nominal, calibration, &recorded)?;
    let of_recorded = PoseSigmaSummary::of(&table, PostureSource::Recorded, registered);
    let mut workspace = None;
    if let Some(robot) = nominal.robot.as_ref().filter(|_| dataset.has_joints()) {
        let spread = spread_postures(robot, &recorded, WORKSPACE_POSTURES);
        let rows = self::table(nominal, calibration, PostureSource::Workspace, &spread)?;
        let registered = RegisteredError::of(nominal, calibration, &spread)?;
        workspace = PoseSigmaSummary::of(&rows, PostureSource::Workspace, registered);
        table.extend(rows);
    }
    Ok(PoseSigmas { table, recorded: of_recorded, workspace })
}

fn table(
    nominal: &Rig,
    calibration: &Calibration,
    source: PostureSource,
    postures: &[Posture],
) -> Result<Vec<PoseSigma>, RunError> {
    let covariances = pose_covariances(nominal, calibration, postures)?;
    let cameras =
        |rig: &Rig| postures.iter().map(|posture| rig.base_from_color(posture)).collect::<Result<Vec<Isometry3>, _>>();
    let (before, after) = (cameras(nominal)?, cameras(&calibration.model.rig)?);
    let gauge = match (postures.first().map(|posture| &posture.state), &nominal.robot) {
        (Some(PostureState::Joints(joints)), Some(robot)) => base_gauge(robot, joints, &before, &after),
        _ => Isometry3::identity(),
    };
    let row = |at: usize| {
        let covariance = covariances.as_ref().map(|covariances| covariances[at]);
        let of_arm = covariance.filter(|_| matches!(postures[at].state, PostureState::Joints(_)));
        let change = (gauge * before[at]).translation.vector - after[at].translation.vector;
        PoseSigma {
            source,
            index: postures[at].index,
            camera_mm: (after[at].translation.vector * 1e3).into(),
            camera_change_mm: change.norm() * 1e3,
            camera_sigma_mm: covariance.map(|c| position_sigma_m(&c.camera) * 1e3),
            camera_sigma_deg: covariance.map(|c| orientation_sigma_rad(&c.camera).to_degrees()),
            flange_sigma_mm: of_arm.map(|c| position_sigma_m(&c.flange) * 1e3),
            flange_sigma_deg: of_arm.map(|c| orientation_sigma_rad(&c.flange).to_degrees()),
        }
    };
    Ok((0..postures.len()).map(row).collect())
}

/// Postures spread evenly over the joints' limits, by Halton's sequence. A revolute joint without limits turns once
/// around; a prismatic one keeps to the range of the recording.
fn spread_postures(robot: &SerialChain, recorded: &[Posture], count: usize) -> Vec<Posture> {
    let ranges: Vec<[f64; 2]> = robot
        .joints()
        .iter()
        .enumerate()
        .map(|(joint, of)| match (of.limits, of.kind) {
            (Some(limits), _) if limits.iter().all(|limit| limit.is_finite()) => limits,
            (_, JointKind::Prismatic) => {
                let values = recorded.iter().filter_map(|posture| match &posture.state {
                    PostureState::Joints(values) => values.get(joint).copied(),
                    PostureState::FlangePose(_) => None,
                });
                values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], q| [low.min(q), high.max(q)])
            }
            _ => [-std::f64::consts::PI, std::f64::consts::PI],
        })
        .collect();
    let posture = |index: usize| {
        let joints = ranges
            .iter()
            .enumerate()
            .map(|(joint, [low, high])| low + (high - low) * radical_inverse(index as u64 + 1, prime(joint)));
        Posture::new(index as u64, PostureState::Joints(joints.collect()))
    };
    (0..count).map(posture).collect()
}

/// Halton's sequence: the digits of `index` behind the point.
fn radical_inverse(mut index: u64, base: u64) -> f64 {
    let (mut value, mut weight) = (0.0, 1.0 / base as f64);
    while index > 0 {
        value += (index % base) as f64 * weight;
        index /= base;
        weight /= base as f64;
    }
    value
}

fn prime(nth: usize) -> u64 {
    (2..).filter(|number| (2..*number).all(|divisor| number % divisor != 0)).nth(nth).unwrap_or(2)
}

/// The table as CSV.
pub fn pose_sigmas_csv(poses: &[PoseSigma]) -> String {
    let mut text =
        "postures,index,camera_x_mm,camera_y_mm,camera_z_mm,camera_change_mm,camera_sigma_mm,camera_sigma_deg,\
                    flange_sigma_mm,flange_sigma_deg\n"
            .to_owned();
    let optional = |value: Option<f64>| value.map_or(String::new(), |value| format!("{value:.6}"));
    for pose in poses {
        let source = match pose.source {
            PostureSource::Recorded => "recorded",
            PostureSource::Workspace => "workspace",
        };
        let [x, y, z] = pose.camera_mm;
        let sigmas = [pose.camera_sigma_mm, pose.camera_sigma_deg, pose.flange_sigma_mm, pose.flange_sigma_deg];
        let sigmas = sigmas.map(optional).join(",");
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{source},{},{x:.4},{y:.4},{z:.4},{:.4},{sigmas}", pose.index, pose.camera_change_mm);
    }
    text
}

/// The covariance of the free parameters as CSV, in the units of the header (deg, mm, px ...); `None` where the
/// estimator gives none.
pub fn covariance_csv(calibration: &Calibration) -> Option<String> {
    let covariance = calibration.covariance.as_ref()?;
    let names: Vec<(String, f64)> = calibration
        .parameters
        .iter()
        .map(|estimate| {
            let (factor, unit) = crate::summary::file_unit(estimate.parameter.unit());
            let unit = if unit.is_empty() { String::new() } else { format!("_{}", unit.replace('/', "_per_")) };
            (format!("{}{unit}", estimate.parameter), factor)
        })
        .collect();
    let mut text = String::from("parameter");
    names.iter().for_each(|(name, _)| text.extend([",", name]));
    text.push('\n');
    for (i, (name, factor)) in names.iter().enumerate() {
        text.push_str(name);
        for (j, (_, other)) in names.iter().enumerate() {
            let _ = write!(text, ",{:e}", covariance[(i, j)] * factor * other);
        }
        text.push('\n');
    }
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halton_fills_the_limits_evenly() {
        let robot = skclam_rig::builtin_rig("ur5e").unwrap().unwrap().robot.unwrap();
        let postures = spread_postures(&robot, &[], 256);
        for (joint, of) in robot.joints().iter().enumerate() {
            let values: Vec<f64> = postures
                .iter()
                .map(|posture| match &posture.state {
                    PostureState::Joints(values) => values[joint],
                    PostureState::FlangePose(_) => f64::NAN,
                })
                .collect();
            assert!(values.iter().all(|&q| of.admits(q)), "{joint}");
            let [low, high] = of.limits.unwrap_or([-std::f64::consts::PI, std::f64::consts::PI]);
            let below = values.iter().filter(|&&q| q < 0.5 * (low + high)).count();
            assert!((120..=136).contains(&below), "joint {joint}: {below} of 256 in the lower half");
        }
    }
}
