//! Joint values that were recorded apart from the images: a CSV with `timestamp_s` and the joint columns of
//! `postures.csv` (`q1_deg` ..., `q1_rad` ..., `q1_mm` ...), columns by name.

use super::ImportError;
use skclam_kinematics::{JointKind, SerialChain};
use skclam_recordings::JointTrack;
use std::io::Read;
use std::path::Path;

/// Reads a log. `offset_s`: what is to be added to its times to get the times of the images.
///
/// # Errors
/// [`ImportError::JointLog`] with the line; [`ImportError::Io`].
pub fn read_joint_log(path: &Path, robot: &SerialChain, offset_s: f64) -> Result<JointTrack, ImportError> {
    let file = skclam_files::open(path, skclam_files::Kind::JointLog)
        .map_err(|source| ImportError::Io { path: path.to_owned(), source })?
        .take(skclam_files::Kind::JointLog.max_bytes());
    let wrong = |line: u64, problem: String| ImportError::JointLog { path: path.to_owned(), line, problem };
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(std::io::BufReader::new(file));
    let header = reader.headers().map_err(|error| wrong(1, error.to_string()))?.clone();
    let time_column = header
        .iter()
        .position(|name| name == "timestamp_s")
        .ok_or_else(|| wrong(1, "there is no column timestamp_s".to_owned()))?;
    let mut columns = Vec::new();
    for (index, joint) in robot.joints().iter().enumerate() {
        let units: &[(&str, f64)] = match joint.kind {
            JointKind::Revolute => &[("deg", std::f64::consts::PI / 180.0), ("rad", 1.0)],
            JointKind::Prismatic => &[("mm", 1e-3)],
        };
        let column = units.iter().find_map(|(unit, scale)| {
            let name = format!("q{}_{unit}", index + 1);
            header.iter().position(|found| found == name).map(|column| (column, *scale))
        });
        columns.push(column.ok_or_else(|| {
            let unit = if joint.kind == JointKind::Revolute { "deg or _rad" } else { "mm" };
            wrong(
                1,
                format!("there is no column q{}_{unit}, and the arm has {} joints", index + 1, robot.joint_count()),
            )
        })?);
    }
    if !offset_s.is_finite() {
        return Err(wrong(1, format!("the offset of the clocks is {offset_s} s")));
    }
    let mut track = JointTrack::new(robot.joints().iter().map(|joint| joint.kind == JointKind::Revolute).collect());
    for record in reader.records() {
        let record = record.map_err(|error| {
            let line = error.position().map_or(0, csv::Position::line);
            wrong(line, error.to_string())
        })?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |column: usize| {
            let text = record.get(column).unwrap_or_default();
            let value = text.parse().ok().filter(|value: &f64| value.is_finite() && value.abs() < 1e12);
            value.ok_or_else(|| wrong(line, format!("{} is {text:?}; a number is expected", &header[column])))
        };
        let stamp = ((number(time_column)? + offset_s) * 1e9).round();
        if stamp.abs() > 9e18 {
            return Err(wrong(line, "timestamp_s is beyond 9e9 s".to_owned()));
        }
        let values = columns
            .iter()
            .map(|&(column, scale)| Ok(number(column)? * scale))
            .collect::<Result<Vec<_>, ImportError>>()?;
        track.push(stamp as i64, &values);
    }
    if track.is_empty() {
        return Err(wrong(1, "there is no line of values".to_owned()));
    }
    Ok(track)
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_kinematics::{Joint, Link};

    fn read(text: &str) -> Result<JointTrack, ImportError> {
        let link = Link::modified_dh(0.0, 0.1, 0.0, 0.0);
        let slider = Joint { kind: JointKind::Prismatic, ..Joint::revolute("b", link) };
        let robot = SerialChain::new(vec![Joint::revolute("a", link), slider]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("joints.csv");
        std::fs::write(&path, text).unwrap();
        read_joint_log(&path, &robot, 0.5)
    }

    #[test]
    fn columns_have_units_and_lines_have_numbers() {
        let track = read("q2_mm,timestamp_s,q1_deg\n250,1.0,180\n500,1.5,90\n").unwrap();
        assert_eq!(track.times(), [1_500_000_000, 2_000_000_000]);
        assert_eq!(track.at(0), [std::f64::consts::PI, 0.25]);
        for (text, expected) in [
            ("timestamp_s,q1_deg\n", "line 1: there is no column q2_mm"),
            ("q1_deg,q2_mm\n", "no column timestamp_s"),
            ("timestamp_s,q1_rad,q2_mm\n1,2,3\n1,x,3\n", "line 3: q1_rad is \"x\""),
            ("timestamp_s,q1_rad,q2_mm\n1,inf,3\n", "line 2: q1_rad is \"inf\""),
            ("timestamp_s,q1_rad,q2_mm\n1,2\n", "line"),
            ("timestamp_s,q1_rad,q2_mm\n", "no line of values"),
        ] {
            let message = read(text).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
