//! Targets as CSV: one a line, columns by name. In: `q1_deg` ... (`q1_rad`, `q1_mm`) or `x_mm, y_mm, z_mm, qx, qy, qz,
//! qw` of the flange in the base, or both: then the pose counts and the joints choose the branch. Other columns are
//! handed on. Out: the other columns, the joints to command in the units that came in, the pose to command, and
//! `status`: "ok", or why there is nothing to command; then the cells of joints and pose are empty. A column `status`
//! that came in is of an earlier compensation and is replaced.

use super::{Compensated, CompensationOptions, Compensator, TargetProblem, TrueArm};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use skclam_files::csv_cell;
use skclam_kinematics::{Isometry3, JointKind, KinematicsError, SerialChain};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Why a table of targets could not be compensated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompensationError {
    /// The file could not be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The table is not well formed.
    #[error("{}, line {line}: {problem}", path.display())]
    Table {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: u64,
        /// What is wrong.
        problem: String,
    },
    /// The two arms do not fit together.
    #[error("the nominal and the calibrated arm: {0}")]
    Arms(#[from] KinematicsError),
}

/// A target and what is beside it.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// Line of the file, counted from 1 (the header).
    pub line: u64,
    /// The flange pose that is wanted, where the table has poses.
    pub base_from_flange: Option<Isometry3>,
    /// Joint values, radians or metres, where the table has them.
    pub joints: Option<Vec<f64>>,
    /// The other columns.
    pub others: Vec<String>,
}

/// Targets in the order of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetTable {
    /// The file, for errors.
    pub path: PathBuf,
    /// Names of the other columns.
    pub others: Vec<String>,
    /// Whether angles are in radians.
    pub radians: bool,
    /// The targets.
    pub targets: Vec<Target>,
}

/// "ok", or why there is nothing to command.
const STATUS: &str = "status";
const POSE_COLUMNS: [&str; 7] = ["x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"];
/// Targets of a table at most.
const MAX_TARGETS: usize = 1 << 20;

/// Reads a table of targets for an arm.
///
/// # Errors
/// [`CompensationError::Table`] with the line: a column missing or double, a number that is none, a quaternion that is
/// no unit one, no target.
pub fn read_targets(path: &Path, arm: &SerialChain) -> Result<TargetTable, CompensationError> {
    let file = skclam_files::open(path, skclam_files::Kind::Targets)
        .map_err(|source| CompensationError::Io { path: path.to_owned(), source })?
        .take(skclam_files::Kind::Targets.max_bytes());
    let wrong = |line: u64, problem: String| CompensationError::Table { path: path.to_owned(), line, problem };
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(std::io::BufReader::new(file));
    let header = reader.headers().map_err(|error| wrong(1, error.to_string()))?.clone();
    let mut names = std::collections::BTreeSet::new();
    if let Some(twice) = header.iter().find(|name| !names.insert(*name)) {
        return Err(wrong(1, format!("duplicate column \"{twice}\"")));
    }
    let columns = Columns::of(&header, arm).map_err(|problem| wrong(1, problem))?;
    let mut targets = Vec::new();
    for record in reader.records() {
        let record =
            record.map_err(|error| wrong(error.position().map_or(0, csv::Position::line), error.to_string()))?;
        let line = record.position().map_or(0, csv::Position::line);
        if targets.len() == MAX_TARGETS {
            return Err(wrong(line, format!("there are more than {MAX_TARGETS} targets; split the table")));
        }
        targets.push(columns.target(&header, &record, line).map_err(|problem| wrong(line, problem))?);
    }
    if targets.is_empty() {
        return Err(wrong(1, "there is no target below the header".to_owned()));
    }
    let others = columns.others.iter().map(|&column| header[column].to_owned()).collect();
    Ok(TargetTable { path: path.to_owned(), others, radians: columns.radians, targets })
}

struct Columns {
    /// Column and what its numbers are multiplied by.
    joints: Option<Vec<(usize, f64)>>,
    pose: Option<[usize; 7]>,
    others: Vec<usize>,
    radians: bool,
}

impl Columns {
    fn of(header: &csv::StringRecord, arm: &SerialChain) -> Result<Self, String> {
        let find = |name: &str| header.iter().position(|found| found == name);
        let (mut joints, mut missing, mut radians) = (Vec::new(), Vec::new(), false);
        for (index, joint) in arm.joints().iter().enumerate() {
            let units: &[(&str, f64)] = match joint.kind {
                JointKind::Revolute => &[("deg", std::f64::consts::PI / 180.0), ("rad", 1.0)],
                JointKind::Prismatic => &[("mm", 1e-3)],
            };
            let found =
                units.iter().find_map(|&(unit, scale)| Some((find(&format!("q{}_{unit}", index + 1))?, scale, unit)));
            match found {
                Some((column, scale, unit)) => {
                    radians |= unit == "rad";
                    joints.push((column, scale));
                }
                None => missing.push(format!("q{}_{}", index + 1, units[0].0)),
            }
        }
        let pose: Vec<usize> = POSE_COLUMNS.iter().filter_map(|name| find(name)).collect();
        if !joints.is_empty() && !missing.is_empty() {
            return Err(format!(
                "the arm has {} joints, but there is no column {}",
                arm.joint_count(),
                missing.join(", ")
            ));
        }
        let pose = match <[usize; 7]>::try_from(pose) {
            Ok(pose) => Some(pose),
            Err(some) if some.is_empty() => None,
            Err(_) => return Err(format!("a pose needs all of {}", POSE_COLUMNS.join(", "))),
        };
        if joints.is_empty() && pose.is_none() {
            return Err(format!(
                "there are neither joint columns (q1_deg to q{}_deg) nor pose columns ({})",
                arm.joint_count(),
                POSE_COLUMNS.join(", ")
            ));
        }
        let used = |column: &usize| {
            joints.iter().any(|(joint, _)| joint == column) || pose.is_some_and(|pose| pose.contains(column))
        };
        let others = (0..header.len()).filter(|column| !used(column) && &header[*column] != STATUS).collect();
        Ok(Columns { joints: (!joints.is_empty()).then_some(joints), pose, others, radians })
    }

    fn target(&self, header: &csv::StringRecord, record: &csv::StringRecord, line: u64) -> Result<Target, String> {
        let number = |column: usize| -> Result<f64, String> {
            let text = record.get(column).unwrap_or_default();
            let value = text.parse().ok().filter(|value: &f64| value.is_finite() && value.abs() < 1e9);
            value.ok_or_else(|| format!("{} is {text:?}; a number is expected", &header[column]))
        };
        let joints = match &self.joints {
            Some(columns) => Some(
                columns
                    .iter()
                    .map(|&(column, scale)| Ok(number(column)? * scale))
                    .collect::<Result<Vec<_>, String>>()?,
            ),
            None => None,
        };
        let base_from_flange = match self.pose {
            None => None,
            Some(columns) => {
                let mut values = [0.0; 7];
                for (value, column) in values.iter_mut().zip(columns) {
                    *value = number(column)?;
                }
                let [x, y, z, qx, qy, qz, qw] = values;
                let quaternion = Quaternion::new(qw, qx, qy, qz);
                let norm = quaternion.norm();
                if (norm - 1.0).abs() > 1e-3 {
                    return Err(format!("qx qy qz qw has the norm {norm}; a rotation needs a unit quaternion"));
                }
                let translation = Translation3::new(x * 1e-3, y * 1e-3, z * 1e-3);
                Some(Isometry3::from_parts(translation, UnitQuaternion::from_quaternion(quaternion)))
            }
        };
        let others = self.others.iter().map(|&column| record.get(column).unwrap_or_default().to_owned()).collect();
        Ok(Target { line, base_from_flange, joints, others })
    }
}

impl TargetTable {
    /// Compensates every target; one that cannot be reached does not hold up the others.
    ///
    /// # Errors
    /// [`CompensationError::Arms`] if the arms do not fit together.
    pub fn compensate<'a>(
        &self,
        nominal: &'a SerialChain,
        calibrated: impl Into<TrueArm<'a>>,
        options: &'a CompensationOptions,
    ) -> Result<Vec<Result<Compensated, TargetProblem>>, CompensationError> {
        let mut compensator = Compensator::new(nominal, calibrated, options)?;
        let answers = self.targets.iter().map(|target| match (&target.base_from_flange, &target.joints) {
            (Some(pose), near) => compensator.pose(pose, near.as_deref()),
            (None, Some(joints)) => compensator.joints(joints),
            // A table has one or the other.
            (None, None) => compensator.joints(&[]),
        });
        Ok(answers.collect())
    }
}

/// The table of what to command: the other columns, joints, pose of the flange by the nominal arm, status.
pub fn write_compensated(
    table: &TargetTable,
    answers: &[Result<Compensated, TargetProblem>],
    arm: &SerialChain,
) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let units: Vec<(&str, f64)> = arm
        .joints()
        .iter()
        .map(|joint| match (joint.kind, table.radians) {
            (JointKind::Prismatic, _) => ("mm", 1e3),
            (JointKind::Revolute, true) => ("rad", 1.0),
            (JointKind::Revolute, false) => ("deg", 1f64.to_degrees()),
        })
        .collect();
    let cells = |others: &[String]| others.iter().map(|cell| csv_cell(cell).into_owned()).collect::<Vec<_>>();
    let mut header = cells(&table.others);
    header.extend(units.iter().enumerate().map(|(index, (unit, _))| format!("q{}_{unit}", index + 1)));
    header.extend(POSE_COLUMNS.map(str::to_owned));
    header.push(STATUS.to_owned());
    let rows = table.targets.iter().zip(answers).map(|(target, answer)| {
        let mut row = cells(&target.others);
        match answer {
            Ok(answer) => {
                row.extend(answer.joints.iter().zip(&units).map(|(value, (_, scale))| shown(value * scale)));
                let pose = &answer.commanded_pose;
                row.extend(pose.translation.vector.iter().map(|length| shown(length * 1e3)));
                row.extend(pose.rotation.coords.iter().map(|value| shown(*value)));
                row.push("ok".to_owned());
            }
            Err(problem) => {
                row.resize(row.len() + units.len() + POSE_COLUMNS.len(), String::new());
                row.push(csv_cell(&problem.to_string()).into_owned());
            }
        }
        row
    });
    // Writing to memory does not fail, and every row has the header's length.
    for row in std::iter::once(header).chain(rows) {
        if writer.write_record(&row).is_err() {
            debug_assert!(false, "rows of one length");
        }
    }
    writer.into_inner().ok().and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default()
}

/// Ten decimals, which are 1e-10 deg or mm; no minus zero.
fn shown(value: f64) -> String {
    let text = format!("{value:.10}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_rig::builtin_rig;

    fn arm() -> SerialChain {
        builtin_rig("hp3j").unwrap().unwrap().robot.unwrap()
    }

    fn read(text: &str) -> Result<TargetTable, CompensationError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("targets.csv");
        std::fs::write(&path, text).unwrap();
        read_targets(&path, &arm())
    }

    const HEADER: &str = "name,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n";

    #[test]
    fn without_errors_of_the_arm_targets_come_back() {
        let table = read(&format!("{HEADER}pick,10,20,-10,5,40,0\nplace,-10,10,0,0,30,90\n")).unwrap();
        let options = CompensationOptions::default();
        let answers = table.compensate(&arm(), &arm(), &options).unwrap();
        let text = write_compensated(&table, &answers, &arm());
        let mut lines = text.lines();
        assert_eq!(lines.next().unwrap(), format!("{},{},status", HEADER.trim(), POSE_COLUMNS.join(",")));
        let first = lines.next().unwrap();
        assert!(first.starts_with("pick,10,20,-10,5,40,0,") && first.ends_with(",ok"), "{text}");
        // What is written is read back: the pose that was commanded with the joints beside it.
        let again = read(&text).unwrap();
        let back = again.compensate(&arm(), &arm(), &options).unwrap();
        assert_eq!(again.others, ["name"], "the status is not handed on");
        for (a, b) in answers.iter().zip(&back) {
            let (Ok(a), Ok(b)) = (a, b) else { panic!("{a:?} {b:?}") };
            assert!(a.joints.iter().zip(&b.joints).all(|(a, b)| (a - b).abs() < 1e-8));
        }
    }

    #[test]
    fn errors_name_line_and_column() {
        for (text, expected) in [
            (format!("{HEADER}a,1,2,3,4,5\n"), "line"),
            (format!("{HEADER}a,1,2,3,4,5,x\n"), "line 2: q6_deg is \"x\""),
            (format!("{HEADER}a,1,2,3,4,5,6\nb,1,2,3,4,5,nan\n"), "line 3: q6_deg"),
            (HEADER.to_owned(), "no target"),
            ("q1_deg,q2_deg\n1,2\n".to_owned(), "no column q3_deg, q4_deg, q5_deg, q6_deg"),
            ("x_mm,y_mm\n1,2\n".to_owned(), "a pose needs all of"),
            ("name\na\n".to_owned(), "neither joint columns"),
            ("q1_deg,q1_deg\n".to_owned(), "duplicate column"),
            ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n1,2,3,0,0,0,0.5\n".to_owned(), "line 2: qx qy qz qw has the norm 0.5"),
        ] {
            let message = read(&text).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_target_out_of_reach_holds_up_no_other() {
        let table = read(
            "x_mm,y_mm,z_mm,qx,qy,qz,qw,name\n300,0,300,0,0,0,1,near\n5000,0,0,0,0,0,1,far\n300,50,300,0,0,0,1,next\n",
        )
        .unwrap();
        let answers = table.compensate(&arm(), &arm(), &CompensationOptions::default()).unwrap();
        assert_eq!(answers.iter().map(Result::is_ok).collect::<Vec<_>>(), [true, false, true]);
        let text = write_compensated(&table, &answers, &arm());
        let lines: Vec<&str> = text.lines().collect();
        let commas = |line: &str| line.split(',').count();
        assert_eq!(lines.len(), 4);
        assert_eq!(commas(lines[0]), commas(lines[1]));
        assert!(lines[2].starts_with(&format!("far{}", ",".repeat(14))), "{text}");
        assert!(lines[2].contains("the nominal arm does not reach the pose"), "{text}");
        assert!(lines[3].starts_with("next,") && lines[3].ends_with(",ok"), "{text}");
    }
}
