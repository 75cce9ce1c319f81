//! `postures.csv`: one line a posture; columns are found by name, in any order.

use super::DatasetError;
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use skclam_geometry::Isometry3;
use skclam_kinematics::JointKind;
use skclam_rig::{Posture, PostureState};
use std::io::Read;
use std::path::{Path, PathBuf};

/// A posture and its images.
#[derive(Debug, Clone, PartialEq)]
pub struct PostureRecord {
    /// Joints or flange pose.
    pub posture: Posture,
    /// Name of the colour image: in a folder the path relative to it.
    pub color: PathBuf,
    /// Name of the depth image.
    pub depth: Option<PathBuf>,
}

/// The most postures that are accepted; a recording of weeks has fewer.
const MAX_POSTURES: usize = 1_000_000;
/// Values of joints and poses are smaller, radians or metres (millimetres for poses).
const LARGEST_VALUE: f64 = 1e9;
/// The most joints that are accepted.
const MAX_JOINTS: usize = 64;

const POSE_COLUMNS: [&str; 7] = ["x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"];

/// Where the columns are.
struct Columns {
    index: usize,
    timestamp: Option<usize>,
    state: StateColumns,
    color: usize,
    depth: Option<usize>,
}

enum StateColumns {
    /// Column of each joint, and what a unit of the file is in radians or metres.
    Joints(Vec<(usize, f64)>),
    Pose([usize; 7]),
}

/// Reads the table. Indices must rise; every number must be finite.
pub fn read_postures(path: &Path) -> Result<Vec<PostureRecord>, DatasetError> {
    let file = skclam_files::open(path, skclam_files::Kind::Postures)
        .map_err(|source| DatasetError::Io { path: path.to_owned(), source })?
        .take(skclam_files::Kind::Postures.max_bytes());
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(std::io::BufReader::new(file));
    let table = Table { path };
    let header = reader.headers().map_err(|error| table.csv(1, &error))?.clone();
    let columns = table.columns(&header)?;
    let mut records: Vec<PostureRecord> = Vec::new();
    for row in reader.records() {
        let row = row.map_err(|error| {
            let line = error.position().map_or(0, |position| position.line() as usize);
            table.csv(line, &error)
        })?;
        let line = row.position().map_or(0, |position| position.line() as usize);
        if records.len() >= MAX_POSTURES {
            return Err(table.error(line, format!("more than {MAX_POSTURES} postures; split the recording")));
        }
        let record = table.record(&columns, &header, &row, line)?;
        if let Some(previous) = records.last() {
            let (index, before) = (record.posture.index, previous.posture.index);
            if index <= before {
                let problem =
                    format!("index {index} follows {before}; the index must rise from line to line (a duplicate?)");
                return Err(table.error(line, problem));
            }
        }
        records.push(record);
    }
    skclam_rig::fill_joint_rates(records.iter_mut().map(|record| &mut record.posture));
    Ok(records)
}

struct Table<'a> {
    path: &'a Path,
}

impl Table<'_> {
    fn error(&self, line: usize, problem: impl Into<String>) -> DatasetError {
        DatasetError::Table { path: self.path.to_owned(), line, problem: problem.into() }
    }

    fn csv(&self, line: usize, error: &csv::Error) -> DatasetError {
        self.error(line, csv_problem(error))
    }

    fn columns(&self, header: &csv::StringRecord) -> Result<Columns, DatasetError> {
        let names: Vec<&str> = header.iter().collect();
        let mut known = std::collections::BTreeSet::new();
        if let Some(twice) = names.iter().find(|name| !known.insert(**name)) {
            return Err(self.error(1, format!("duplicate column \"{twice}\"")));
        }
        let find = |name: &str| names.iter().position(|candidate| *candidate == name);
        let need = |name: &str| find(name).ok_or_else(|| self.error(1, format!("column \"{name}\" is missing")));
        let joints: Vec<(usize, usize, f64)> = names
            .iter()
            .enumerate()
            .filter_map(|(column, name)| joint_column(name).map(|(joint, unit)| (joint, column, unit)))
            .collect();
        let pose: Vec<usize> = POSE_COLUMNS.iter().filter_map(|name| find(name)).collect();
        for name in &names {
            let known = ["index", "timestamp_s", "color", "depth"].contains(name)
                || POSE_COLUMNS.contains(name)
                || joint_column(name).is_some();
            if !known {
                let expected =
                    "index, timestamp_s, q1_deg ... (or _rad, _mm), x_mm y_mm z_mm qx qy qz qw, color, depth";
                return Err(self.error(1, format!("unknown column \"{name}\"; the columns are {expected}")));
            }
        }
        let state = match (joints.is_empty(), pose.len()) {
            (false, 0) => StateColumns::Joints(self.joint_columns(joints)?),
            (true, 7) => StateColumns::Pose(std::array::from_fn(|i| pose[i])),
            (true, 0) => return Err(self.error(1, "neither joint columns (q1_deg ...) nor flange poses (x_mm ... qw)")),
            (true, _) => return Err(self.error(1, format!("a flange pose needs all of {}", POSE_COLUMNS.join(", ")))),
            (false, _) => {
                return Err(self.error(1, "joint columns and flange poses are both given; keep one"));
            }
        };
        Ok(Columns {
            index: need("index")?,
            timestamp: find("timestamp_s"),
            state,
            color: need("color")?,
            depth: find("depth"),
        })
    }

    fn joint_columns(&self, mut joints: Vec<(usize, usize, f64)>) -> Result<Vec<(usize, f64)>, DatasetError> {
        joints.sort_by_key(|&(joint, ..)| joint);
        for (position, &(joint, ..)) in joints.iter().enumerate() {
            if joint != position + 1 {
                let problem = format!("joint columns must be q1 to q{}, each once and with one unit", joints.len());
                return Err(self.error(1, problem));
            }
        }
        Ok(joints.into_iter().map(|(_, column, unit)| (column, unit)).collect())
    }

    fn record(
        &self,
        columns: &Columns,
        header: &csv::StringRecord,
        row: &csv::StringRecord,
        line: usize,
    ) -> Result<PostureRecord, DatasetError> {
        let field = |column: usize| row.get(column).unwrap_or_default();
        let number = |column: usize| {
            let text = field(column);
            match text.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(value),
                _ => {
                    let name = header.get(column).unwrap_or_default();
                    Err(self.error(line, format!("{name} is \"{text}\"; a finite number is needed")))
                }
            }
        };
        // In radians and metres: what is larger is no posture, and infinite in another unit.
        let scaled = |column: usize, unit: f64| {
            let value = number(column)? * unit;
            if value.abs() < LARGEST_VALUE {
                return Ok(value);
            }
            let name = header.get(column).unwrap_or_default();
            Err(self.error(line, format!("{name} is {}; no joint turns or moves so far", field(column))))
        };
        let index_text = field(columns.index);
        let index = index_text
            .parse::<u64>()
            .map_err(|_| self.error(line, format!("index is \"{index_text}\"; a whole number is needed")))?;
        let timestamp_s = match columns.timestamp {
            Some(column) if !field(column).is_empty() => Some(number(column)?),
            _ => None,
        };
        let state = match &columns.state {
            StateColumns::Joints(joints) => PostureState::Joints(
                joints.iter().map(|&(column, unit)| scaled(column, unit)).collect::<Result<_, DatasetError>>()?,
            ),
            StateColumns::Pose(pose) => {
                let mut values = [0.0; 7];
                for (value, &column) in values.iter_mut().zip(pose) {
                    *value = scaled(column, 1.0)?;
                }
                PostureState::FlangePose(self.pose(values, line)?)
            }
        };
        let color = field(columns.color);
        if color.is_empty() {
            return Err(self.error(line, "no colour image is named"));
        }
        let depth = columns.depth.map(field).filter(|name| !name.is_empty()).map(PathBuf::from);
        Ok(PostureRecord { posture: Posture::new(index, state).at(timestamp_s), color: PathBuf::from(color), depth })
    }

    fn pose(&self, [x, y, z, qx, qy, qz, qw]: [f64; 7], line: usize) -> Result<Isometry3, DatasetError> {
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        let norm = quaternion.norm();
        if !norm.is_finite() || (norm - 1.0).abs() > 1e-3 {
            return Err(self.error(
                line,
                format!("the quaternion qx qy qz qw has the norm {norm}; a rotation needs a unit quaternion"),
            ));
        }
        Ok(Isometry3::from_parts(
            Translation3::new(x * 1e-3, y * 1e-3, z * 1e-3),
            UnitQuaternion::from_quaternion(quaternion),
        ))
    }
}

/// What is wrong with a table, without its place: the caller names file and line.
pub(crate) fn csv_problem(error: &csv::Error) -> String {
    match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("{len} fields, but the header names {expected_len} columns")
        }
        csv::ErrorKind::Utf8 { .. } => "the text is not UTF-8".to_owned(),
        _ => error.to_string(),
    }
}

/// `q3_deg` is joint 3 with the unit of a degree.
pub(crate) fn joint_column(name: &str) -> Option<(usize, f64)> {
    let (number, unit) = name.strip_prefix('q')?.split_once('_')?;
    let joint = number.parse::<usize>().ok().filter(|joint| (1..=MAX_JOINTS).contains(joint))?;
    let unit = match unit {
        "deg" => 1f64.to_radians(),
        "rad" => 1.0,
        "mm" => 1e-3,
        _ => return None,
    };
    Some((joint, unit))
}

/// Writes the table as text; `kinds` gives the unit of each joint (degrees or millimetres).
pub fn write_postures(records: &[PostureRecord], kinds: &[JointKind]) -> Result<String, DatasetError> {
    let path = PathBuf::from("postures.csv");
    let table = Table { path: &path };
    let mut writer = csv::Writer::from_writer(Vec::new());
    let with_time = records.iter().any(|record| record.posture.timestamp_s.is_some());
    let with_depth = records.iter().any(|record| record.depth.is_some());
    let joints = matches!(records.first().map(|record| &record.posture.state), Some(PostureState::Joints(_)));
    let mut header = vec!["index".to_owned()];
    header.extend(with_time.then(|| "timestamp_s".to_owned()));
    if joints {
        header.extend(kinds.iter().enumerate().map(|(joint, kind)| match kind {
            JointKind::Revolute => format!("q{}_deg", joint + 1),
            JointKind::Prismatic => format!("q{}_mm", joint + 1),
        }));
    } else {
        header.extend(POSE_COLUMNS.map(str::to_owned));
    }
    header.push("color".to_owned());
    header.extend(with_depth.then(|| "depth".to_owned()));
    writer.write_record(&header).map_err(|error| table.csv(1, &error))?;
    for (row, record) in records.iter().enumerate() {
        let mut fields = vec![record.posture.index.to_string()];
        if with_time {
            fields.push(record.posture.timestamp_s.map(|time| format!("{time:.6}")).unwrap_or_default());
        }
        match &record.posture.state {
            PostureState::Joints(values) => fields.extend(values.iter().zip(kinds).map(|(value, kind)| match kind {
                JointKind::Revolute => format!("{:.9}", value.to_degrees()),
                JointKind::Prismatic => format!("{:.9}", value * 1e3),
            })),
            PostureState::FlangePose(pose) => {
                fields.extend(pose.translation.vector.iter().map(|length| format!("{:.9}", length * 1e3)));
                fields.extend(pose.rotation.coords.iter().map(|value| format!("{value:.12}")));
            }
        }
        fields.push(record.color.to_string_lossy().into_owned());
        if with_depth {
            fields.push(record.depth.as_ref().map(|path| path.to_string_lossy().into_owned()).unwrap_or_default());
        }
        writer.write_record(&fields).map_err(|error| table.csv(row + 2, &error))?;
    }
    let bytes = writer.into_inner().map_err(|error| table.error(0, error.to_string()))?;
    String::from_utf8(bytes).map_err(|error| table.error(0, error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Vec<PostureRecord>, DatasetError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("postures.csv");
        std::fs::write(&path, text).unwrap();
        read_postures(&path)
    }

    #[test]
    fn columns_are_found_by_name_and_units_converted() {
        let records =
            read("color,q2_rad,index,q1_deg,q3_mm,depth\na.png,0.5,3,180,250,\nb.png,1,7,0,0,d.png\n").unwrap();
        let PostureState::Joints(values) = &records[0].posture.state else { panic!("joints expected") };
        assert_eq!(values, &[std::f64::consts::PI, 0.5, 0.25]);
        assert_eq!((records[0].posture.index, records[0].depth.clone()), (3, None));
        assert_eq!(records[1].depth, Some(PathBuf::from("d.png")));
    }

    #[test]
    fn what_is_written_is_read_back_the_same() {
        let text = "index,timestamp_s,q1_deg,q2_mm,color,depth\n1,0.5,12.5,3.25,a.png,d.png\n2,1,-7,4,b.png,\n";
        let records = read(text).unwrap();
        let written = write_postures(&records, &[JointKind::Revolute, JointKind::Prismatic]).unwrap();
        assert_eq!(read(&written).unwrap(), records);
        let poses = read("index,x_mm,y_mm,z_mm,qx,qy,qz,qw,color\n0,1,2,3,0,0,0.6,0.8,a.png\n").unwrap();
        assert_eq!(read(&write_postures(&poses, &[]).unwrap()).unwrap(), poses);
    }

    #[test]
    fn errors_name_line_column_and_cure() {
        let message = |text: &str| read(text).unwrap_err().to_string();
        let header = "index,q1_deg,color\n";
        for (text, expected) in [
            (format!("{header}0,1,a.png\n0,2,b.png\n"), "line 3: index 0 follows 0"),
            (format!("{header}0,nan,a.png\n"), "line 2: q1_deg is \"nan\""),
            (format!("{header}0,1\n"), "line 2: 2 fields, but the header names 3 columns"),
            (format!("{header}-1,1,a.png\n"), "whole number"),
            (format!("{header}0,1,\n"), "no colour image"),
            ("index,q1_deg,colour\n".to_owned(), "unknown column \"colour\""),
            ("index,q1_deg,q3_deg,color\n".to_owned(), "q1 to q2"),
            ("index,q1_deg,q1_rad,color\n".to_owned(), "each once"),
            ("index,q1_deg,x_mm,color\n".to_owned(), "both given"),
            ("index,x_mm,y_mm,color\n".to_owned(), "a flange pose needs all of"),
            ("index,color\n".to_owned(), "neither joint columns"),
            ("index,q1_deg,q1_deg,color\n".to_owned(), "duplicate column"),
            ("index,x_mm,y_mm,z_mm,qx,qy,qz,qw,color\n0,1,2,3,0,0,0,0.2,a.png\n".to_owned(), "unit quaternion"),
        ] {
            let got = message(&text);
            assert!(got.contains(expected), "{got} lacks {expected}");
        }
    }
}
