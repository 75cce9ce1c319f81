//! `trajectory.txt`: `base_from_camera` a posture in the TUM format, `timestamp tx ty tz qx qy qz qw`, metres.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use skclam_geometry::Isometry3;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// A pose with its time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampedPose {
    /// Seconds; the posture's index where no time is known.
    pub timestamp_s: f64,
    /// The pose.
    pub base_from_camera: Isometry3,
}

/// Why a trajectory could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// The file could not be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A line is not a stamped pose.
    #[error("{}, line {line}: {problem}; a line is `timestamp tx ty tz qx qy qz qw`, metres", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
        /// What is wrong.
        problem: String,
    },
}

/// The text of a trajectory. Nanometres and 1e-12 of a quaternion are kept.
pub fn trajectory_text(poses: &[StampedPose]) -> String {
    let mut text = String::from("# base_from_camera: timestamp tx ty tz qx qy qz qw (s, m)\n");
    for StampedPose { timestamp_s, base_from_camera } in poses {
        let t = &base_from_camera.translation.vector;
        let q = base_from_camera.rotation.coords;
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{timestamp_s:.6} {:.9} {:.9} {:.9} {:.12} {:.12} {:.12} {:.12}",
            t.x, t.y, t.z, q.x, q.y, q.z, q.w
        );
    }
    text
}

/// Reads a trajectory; lines that begin with `#` are comments.
pub fn read_trajectory(path: &Path) -> Result<Vec<StampedPose>, TrajectoryError> {
    let text = skclam_files::read_text(path, skclam_files::Kind::Trajectory)
        .map_err(|source| TrajectoryError::Io { path: path.to_owned(), source })?;
    let mut poses = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let error = |problem: String| TrajectoryError::Line { path: path.to_owned(), line: index + 1, problem };
        let numbers: Vec<f64> = line
            .split_whitespace()
            .map(|field| {
                field
                    .parse::<f64>()
                    .ok()
                    .filter(|value| value.is_finite())
                    .ok_or_else(|| error(format!("\"{field}\" is no finite number")))
            })
            .collect::<Result<_, _>>()?;
        let [timestamp_s, tx, ty, tz, qx, qy, qz, qw] = numbers[..] else {
            return Err(error(format!("{} numbers", numbers.len())));
        };
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if !quaternion.norm().is_finite() || (quaternion.norm() - 1.0).abs() > 1e-3 {
            return Err(error(format!("the quaternion has the norm {}", quaternion.norm())));
        }
        let base_from_camera =
            Isometry3::from_parts(Translation3::new(tx, ty, tz), UnitQuaternion::from_quaternion(quaternion));
        poses.push(StampedPose { timestamp_s, base_from_camera });
    }
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn what_is_written_is_read_back_and_bad_lines_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trajectory.txt");
        let pose = Isometry3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(0.3, 0.2, -0.5));
        std::fs::write(&path, trajectory_text(&[StampedPose { timestamp_s: 2.0, base_from_camera: pose }])).unwrap();
        let read = read_trajectory(&path).unwrap();
        assert!((read[0].base_from_camera.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-8);
        for bad in ["1 2 3", "0 0 0 0 0 0 0 nan", "0 0 0 0 0 0 0 2"] {
            std::fs::write(&path, bad).unwrap();
            assert!(read_trajectory(&path).unwrap_err().to_string().contains("line 1"));
        }
    }
}
