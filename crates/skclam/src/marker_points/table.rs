//! The table of measured points: one line a point; columns are found by name, in any order.

use super::{MarkerPoint, MarkerPoints};
use crate::dataset::{DatasetError, csv_problem, joint_column};
use nalgebra::Vector3;
use std::io::Read;
use std::path::Path;

/// The most points that are read.
const MAX_POINTS: usize = 1_000_000;
/// The most markers on one flange; a column of numbers read as names would have as many as points.
const MAX_MARKERS: usize = 20;
/// Instruments measure nearer than this, metres.
const MAX_POSITION_M: f64 = 1e6;
/// Joint values are smaller, radians or metres.
const MAX_JOINT_VALUE: f64 = 1e9;

const EXPECTED_COLUMNS: &str = "index, group, marker, timestamp_s, q1_deg ... (or _rad, _mm), x_mm y_mm z_mm (or _m), \
                                sigma_mm or sigma_x_mm sigma_y_mm sigma_z_mm (or _m)";

/// Where a length is, and how many metres its unit has.
type LengthColumn = (usize, f64);

struct Columns {
    index: Option<usize>,
    group: Option<usize>,
    marker: Option<usize>,
    /// Column of each joint, and its unit in radians or metres.
    joints: Vec<(usize, f64)>,
    position: [LengthColumn; 3],
    sigma: Option<[LengthColumn; 3]>,
}

/// Reads the table: joints as in `postures.csv`, positions in the instrument's frame, and optional columns.
///
/// # Errors
/// File, line and column of what is wrong, and what was expected.
pub(super) fn read(path: &Path) -> Result<MarkerPoints, DatasetError> {
    let file = skclam_files::open(path, skclam_files::Kind::Targets)
        .map_err(|source| DatasetError::Io { path: path.to_owned(), source })?
        .take(skclam_files::Kind::Targets.max_bytes());
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(std::io::BufReader::new(file));
    let table = Table { path };
    let header = reader.headers().map_err(|error| table.error(1, csv_problem(&error)))?.clone();
    let columns = table.columns(&header)?;
    let mut points = MarkerPoints {
        path: path.to_owned(),
        points: Vec::new(),
        markers: Vec::new(),
        grouped: columns.group.is_some(),
    };
    for row in reader.records() {
        let row = row.map_err(|error| {
            let line = error.position().map_or(0, |position| position.line() as usize);
            table.error(line, csv_problem(&error))
        })?;
        let line = row.position().map_or(0, |position| position.line() as usize);
        if points.points.len() >= MAX_POINTS {
            return Err(table.error(line, format!("more than {MAX_POINTS} points; split the table")));
        }
        let point = Row { table: &table, header: &header, row: &row, line }.point(&columns, &mut points.markers)?;
        points.points.push(point);
    }
    Ok(points)
}

struct Table<'a> {
    path: &'a Path,
}

impl Table<'_> {
    fn error(&self, line: usize, problem: impl Into<String>) -> DatasetError {
        DatasetError::Table { path: self.path.to_owned(), line, problem: problem.into() }
    }

    fn columns(&self, header: &csv::StringRecord) -> Result<Columns, DatasetError> {
        let names: Vec<&str> = header.iter().collect();
        for (column, name) in names.iter().enumerate() {
            if names[..column].contains(name) {
                return Err(self.error(1, format!("duplicate column \"{name}\"")));
            }
            if !known(name) {
                return Err(self.error(1, format!("unknown column \"{name}\"; the columns are {EXPECTED_COLUMNS}")));
            }
        }
        let find = |name: &str| names.iter().position(|candidate| *candidate == name);
        let need = |quantity: &str| {
            self.length(&names, quantity)?.ok_or_else(|| {
                self.error(
                    1,
                    format!("column \"{quantity}_mm\" (or \"{quantity}_m\") is missing: the measured position"),
                )
            })
        };
        Ok(Columns {
            index: find("index"),
            group: find("group"),
            marker: find("marker"),
            joints: self.joints(&names)?,
            position: [need("x")?, need("y")?, need("z")?],
            sigma: self.sigma(&names)?,
        })
    }

    /// A length in millimetres or metres, whichever the header names.
    fn length(&self, names: &[&str], quantity: &str) -> Result<Option<LengthColumn>, DatasetError> {
        let [mm, m] = ["_mm", "_m"].map(|unit| names.iter().position(|name| *name == format!("{quantity}{unit}")));
        match (mm, m) {
            (Some(_), Some(_)) => {
                let problem = format!("columns \"{quantity}_mm\" and \"{quantity}_m\" are both given; keep one");
                Err(self.error(1, problem))
            }
            (mm, m) => Ok(mm.map(|column| (column, 1e-3)).or(m.map(|column| (column, 1.0)))),
        }
    }

    fn sigma(&self, names: &[&str]) -> Result<Option<[LengthColumn; 3]>, DatasetError> {
        let one = self.length(names, "sigma")?;
        let axes = [self.length(names, "sigma_x")?, self.length(names, "sigma_y")?, self.length(names, "sigma_z")?];
        match (one, axes) {
            (None, [None, None, None]) => Ok(None),
            (Some(all), [None, None, None]) => Ok(Some([all; 3])),
            (None, [Some(x), Some(y), Some(z)]) => Ok(Some([x, y, z])),
            _ => Err(self.error(1, "give either sigma_mm or all of sigma_x_mm, sigma_y_mm, sigma_z_mm (or _m)")),
        }
    }

    fn joints(&self, names: &[&str]) -> Result<Vec<(usize, f64)>, DatasetError> {
        let mut joints: Vec<(usize, usize, f64)> = names
            .iter()
            .enumerate()
            .filter_map(|(column, name)| joint_column(name).map(|(joint, unit)| (joint, column, unit)))
            .collect();
        joints.sort_by_key(|&(joint, ..)| joint);
        if joints.is_empty() {
            return Err(self.error(1, "no joint columns (q1_deg ..., q1_rad ... or qk_mm)"));
        }
        for (position, &(joint, ..)) in joints.iter().enumerate() {
            if joint != position + 1 {
                let problem = format!("joint columns must be q1 to q{}, each once and with one unit", joints.len());
                return Err(self.error(1, problem));
            }
        }
        Ok(joints.into_iter().map(|(_, column, unit)| (column, unit)).collect())
    }
}

fn known(name: &str) -> bool {
    const TEXT: [&str; 4] = ["index", "group", "marker", "timestamp_s"];
    const LENGTHS: [&str; 7] = ["x", "y", "z", "sigma", "sigma_x", "sigma_y", "sigma_z"];
    let length = name.strip_suffix("_mm").or(name.strip_suffix("_m"));
    TEXT.contains(&name) || length.is_some_and(|quantity| LENGTHS.contains(&quantity)) || joint_column(name).is_some()
}

struct Row<'a> {
    table: &'a Table<'a>,
    header: &'a csv::StringRecord,
    row: &'a csv::StringRecord,
    line: usize,
}

impl Row<'_> {
    fn point(&self, columns: &Columns, markers: &mut Vec<String>) -> Result<MarkerPoint, DatasetError> {
        let index =
            match columns.index {
                None => None,
                Some(column) => Some(self.text(column)?.parse::<u64>().map_err(|_| {
                    self.error(format!("index is \"{}\"; a whole number is needed", &self.row[column]))
                })?),
            };
        let marker = match columns.marker {
            None => "marker",
            Some(column) => self.text(column)?,
        };
        let marker = markers.iter().position(|known| known == marker).unwrap_or_else(|| {
            markers.push(marker.to_owned());
            markers.len() - 1
        });
        if markers.len() > MAX_MARKERS {
            return Err(
                self.error(format!("more than {MAX_MARKERS} markers; the column names which of few on the flange"))
            );
        }
        let joints = columns.joints.iter().map(|&(column, unit)| self.scaled(column, unit, MAX_JOINT_VALUE));
        let sigma = columns.sigma.map(|sigma| self.lengths(sigma)).transpose()?;
        if sigma.is_some_and(|sigma| sigma.iter().any(|&value| value <= 0.0)) {
            return Err(self.error("the standard deviation of a position must be above 0"));
        }
        Ok(MarkerPoint {
            line: self.line,
            index,
            group: columns.group.map(|column| self.text(column).map(str::to_owned)).transpose()?,
            marker,
            joints: joints.collect::<Result<_, _>>()?,
            position_m: self.lengths(columns.position)?,
            sigma_m: sigma,
        })
    }

    fn lengths(&self, columns: [LengthColumn; 3]) -> Result<Vector3<f64>, DatasetError> {
        let [x, y, z] = columns.map(|(column, unit)| self.scaled(column, unit, MAX_POSITION_M));
        Ok(Vector3::new(x?, y?, z?))
    }

    /// A number in radians or metres.
    fn scaled(&self, column: usize, unit: f64, limit: f64) -> Result<f64, DatasetError> {
        let (name, text) = (&self.header[column], &self.row[column]);
        let Some(value) = text.parse::<f64>().ok().filter(|value| value.is_finite()) else {
            return Err(self.error(format!("{name} is \"{text}\"; a finite number is needed")));
        };
        if (value * unit).abs() < limit {
            return Ok(value * unit);
        }
        Err(self.error(format!("{name} is {text}; no joint and no instrument reaches so far")))
    }

    /// A name or number that may not be empty.
    fn text(&self, column: usize) -> Result<&str, DatasetError> {
        match &self.row[column] {
            "" => Err(self.error(format!("{} is empty; give it a name or leave the column out", &self.header[column]))),
            text => Ok(text),
        }
    }

    fn error(&self, problem: impl Into<String>) -> DatasetError {
        self.table.error(self.line, problem)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<MarkerPoints, DatasetError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.csv");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn columns_are_found_by_name_and_units_converted() {
        let text = "z_m,group,q2_mm,x_mm,q1_deg,y_mm,marker,sigma_mm\n\
                    3,left,250,1000,180,-500,ball,0.2\n1,right,0,1,2,3,cone,0.1\n";
        let points = read_text(text).unwrap();
        assert_eq!((points.markers.clone(), points.grouped), (vec!["ball".to_owned(), "cone".to_owned()], true));
        let first = &points.points[0];
        assert_eq!(first.joints, [std::f64::consts::PI, 0.25]);
        assert_eq!((first.position_m, first.sigma_m), (Vector3::new(1.0, -0.5, 3.0), Some(Vector3::repeat(2e-4))));
        assert_eq!((first.line, first.index, first.group.as_deref(), first.marker), (2, None, Some("left"), 0));
        assert_eq!((points.points[1].line, points.points[1].marker), (3, 1));
    }

    #[test]
    fn errors_name_line_column_and_what_was_expected() {
        let header = "index,q1_rad,x_mm,y_mm,z_mm\n";
        for (text, expected) in [
            (String::new(), "line 1: no joint columns"),
            ("x_mm,y_mm,z_mm\n".to_owned(), "line 1: no joint columns"),
            ("q1_rad,x_mm,y_mm\n".to_owned(), "line 1: column \"z_mm\" (or \"z_m\") is missing"),
            ("q1_rad,x_mm,x_m,y_mm,z_mm\n".to_owned(), "\"x_mm\" and \"x_m\" are both given"),
            ("q1_rad,x_mm,x_mm,y_mm,z_mm\n".to_owned(), "duplicate column \"x_mm\""),
            ("q1_rad,x_in,y_mm,z_mm\n".to_owned(), "unknown column \"x_in\"; the columns are index, group"),
            ("q1_rad,q3_rad,x_mm,y_mm,z_mm\n".to_owned(), "q1 to q2"),
            ("q1_rad,x_mm,y_mm,z_mm,sigma_x_mm\n".to_owned(), "either sigma_mm or all of"),
            (format!("{header}0,1,2,3\n"), "line 2: 4 fields, but the header names 5 columns"),
            (format!("{header}0,1,2,3,4\n1,nan,2,3,4\n"), "line 3: q1_rad is \"nan\"; a finite number"),
            (format!("{header}0,1,2,,4\n"), "line 2: y_mm is \"\""),
            (format!("{header}0,1,2,3,1e300\n"), "line 2: z_mm is 1e300; no joint and no instrument"),
            (format!("{header}-1,1,2,3,4\n"), "index is \"-1\"; a whole number"),
            ("group,q1_rad,x_mm,y_mm,z_mm\n,1,2,3,4\n".to_owned(), "line 2: group is empty"),
            ("q1_rad,x_mm,y_mm,z_mm,sigma_mm\n1,2,3,4,0\n".to_owned(), "must be above 0"),
        ] {
            let got = read_text(&text).map(|_| ()).unwrap_err().to_string();
            assert!(got.contains("points.csv") && got.contains(expected), "{got} lacks {expected}");
        }
        let many: String = (0..30).map(|at| format!("m{at},1,2,3,4\n")).collect();
        let got = read_text(&format!("marker,q1_rad,x_mm,y_mm,z_mm\n{many}")).unwrap_err().to_string();
        assert!(got.contains("line 22: more than 20 markers"), "{got}");
        let missing = MarkerPoints::read("nowhere/points.csv").unwrap_err().to_string();
        assert!(missing.contains("nowhere/points.csv"), "{missing}");
    }
}
