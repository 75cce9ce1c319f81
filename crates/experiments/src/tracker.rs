//! How far a rig's flange is from an optical tracker's points.
//!
//! The marker's place on the flange and the tracker's frame are unknown: nine numbers, fitted by turns. With the marker given, the frame is a rigid fit (Kabsch 1976);
//! with the frame given, the marker is a mean.

use anyhow::{Context, Result, ensure};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use skclam::rig::{Posture, PostureState, Rig};
use std::path::Path;

/// A marker's place in the tracker's frame while the arm stood somewhere.
#[derive(Debug, Clone)]
pub struct TrackerPoint {
    /// The arm.
    pub posture: Posture,
    /// Metres.
    pub position: Point3<f64>,
}

/// Reads `index, group, q1_rad ..., x_mm, y_mm, z_mm`.
///
/// # Errors
/// Other columns, or fields that are no numbers.
pub fn read(path: &Path) -> Result<Vec<TrackerPoint>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().context("an empty table")?.split(',').map(str::trim).collect();
    let column = |name: &str| header.iter().position(|has| *has == name);
    let joints: Vec<usize> = (1..).map_while(|joint| column(&format!("q{joint}_rad"))).collect();
    let place: Option<Vec<usize>> = ["x_mm", "y_mm", "z_mm"].into_iter().map(column).collect();
    let place = place.context("x_mm, y_mm and z_mm are needed")?;
    ensure!(!joints.is_empty(), "q1_rad, q2_rad ... are needed");
    let point = |(number, line): (usize, &str)| {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let at = |column: usize| -> Result<f64> {
            let field = fields.get(column).with_context(|| format!("line {}: too few fields", number + 2))?;
            field.parse().with_context(|| format!("line {}: \"{field}\" is no number", number + 2))
        };
        let values = joints.iter().map(|&column| at(column)).collect::<Result<Vec<_>>>()?;
        let position = Point3::new(1e-3 * at(place[0])?, 1e-3 * at(place[1])?, 1e-3 * at(place[2])?);
        Ok(TrackerPoint { posture: Posture::new(number as u64, PostureState::Joints(values)), position })
    };
    lines.filter(|line| !line.trim().is_empty()).enumerate().map(point).collect()
}

/// RMS distance of the points from where a rig puts them, millimetres, with the best marker and frame.
///
/// # Errors
/// Joints that the rig does not have; too few points.
pub fn rms_mm(rig: &Rig, points: &[TrackerPoint]) -> Result<f64> {
    const ROUNDS: usize = 20_000;
    ensure!(points.len() >= 6, "{} points are too few", points.len());
    let flanges = points.iter().map(|point| rig.base_from_flange(&point.posture)).collect::<Result<Vec<_>, _>>()?;
    let mut marker = Point3::origin();
    let mut last = f64::INFINITY;
    for _ in 0..ROUNDS {
        let placed: Vec<Point3<f64>> = flanges.iter().map(|flange| flange * marker).collect();
        let frame = rigid_fit(&placed, points);
        let pairs = || flanges.iter().zip(points);
        let square = pairs().map(|(flange, point)| (frame * (flange * marker) - point.position).norm_squared());
        let mean_square = square.sum::<f64>() / points.len() as f64;
        let own = pairs().map(|(flange, point)| (frame * flange).inverse_transform_point(&point.position).coords);
        marker = Point3::from(own.sum::<Vector3<f64>>() / points.len() as f64);
        if last - mean_square < 1e-15 * mean_square {
            return Ok(1e3 * mean_square.sqrt());
        }
        last = mean_square;
    }
    anyhow::bail!("marker and frame were not found in {ROUNDS} rounds")
}

/// The pose that takes `from` closest to the points.
fn rigid_fit(from: &[Point3<f64>], to: &[TrackerPoint]) -> Isometry3<f64> {
    let count = from.len() as f64;
    let from_center: Vector3<f64> = from.iter().map(|point| point.coords).sum::<Vector3<f64>>() / count;
    let to_center: Vector3<f64> = to.iter().map(|point| point.position.coords).sum::<Vector3<f64>>() / count;
    let pairs = from.iter().zip(to);
    let cross: Matrix3<f64> =
        pairs.map(|(from, to)| (to.position.coords - to_center) * (from.coords - from_center).transpose()).sum();
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u.unwrap_or_else(Matrix3::identity), svd.v_t.unwrap_or_else(Matrix3::identity));
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * flip * v_t));
    Isometry3::from_parts(Translation3::from(to_center - rotation * from_center), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::true_poses::workspace_postures;
    use skclam::kinematics::{ParameterId, ParameterKind};
    use skclam::rig::builtin_rig;

    #[test]
    fn marker_and_frame_are_found_and_a_wrong_arm_is_told() {
        let mut rig = builtin_rig("hp3j").unwrap().unwrap();
        let frame = Isometry3::new(Vector3::new(0.5, -1.0, -2.0), Vector3::new(0.3, 2.0, -0.4));
        let marker = Point3::new(0.03, -0.05, 0.1);
        let points: Vec<TrackerPoint> = workspace_postures(rig.robot.as_ref().unwrap(), 40, 4)
            .into_iter()
            .map(|posture| {
                let position = frame * (rig.base_from_flange(&posture).unwrap() * marker);
                TrackerPoint { posture, position }
            })
            .collect();
        assert!(rms_mm(&rig, &points).unwrap() < 1e-3);
        let id = ParameterId { joint: 2, kind: ParameterKind::A };
        let robot = rig.robot.as_mut().unwrap();
        robot.set_parameter(id, robot.parameter(id).unwrap() + 0.002).unwrap();
        let error = rms_mm(&rig, &points).unwrap();
        assert!(error > 0.3 && error < 2.0, "{error}");
    }
}
