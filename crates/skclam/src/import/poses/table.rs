//! A table (CSV) of poses as a controller shows them; columns by name, in any order and any case.

use super::notation::{PoseNotation, RotationPart};
use crate::import::ImportError;
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use std::io::Read;
use std::path::Path;

/// How a table of poses is to be read.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseTableOptions {
    /// Whose notation.
    pub notation: PoseNotation,
    /// Metres a unit of length where the columns do not say (`x_mm`, `x_m`); `None`: as the maker does.
    pub length_m: Option<f64>,
    /// Radians a unit of angle where the columns do not say (`a_deg`, `a_rad`); `None`: as the maker does.
    pub angle: Option<f64>,
}

/// A line of the table.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PoseLine {
    pub base_from_flange: Isometry3,
    pub color: Option<String>,
    pub depth: Option<String>,
    pub timestamp_s: Option<f64>,
}

/// A column of numbers and what they are multiplied with.
#[derive(Debug, Clone, Copy)]
struct Column {
    at: usize,
    scale: f64,
}

struct Table<'a> {
    path: &'a Path,
    header: Vec<String>,
    options: PoseTableOptions,
}

/// Poses that an arm reaches, metres: beyond, the unit is in doubt.
const PLAUSIBLE_M: [f64; 2] = [0.02, 20.0];

/// Reads a table.
///
/// # Errors
/// [`ImportError::Poses`] with the line: a column that is missing, a cell that is no number, numbers that are no rotation,
/// lengths that no arm has.
pub(super) fn read_poses(path: &Path, options: PoseTableOptions) -> Result<Vec<PoseLine>, ImportError> {
    let file = skclam_files::open(path, skclam_files::Kind::Postures)
        .map_err(|source| ImportError::Io { path: path.to_owned(), source })?
        .take(skclam_files::Kind::Postures.max_bytes());
    let wrong = |line: u64, problem: String| ImportError::Poses { path: path.to_owned(), line, problem };
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(std::io::BufReader::new(file));
    let header = reader.headers().map_err(|error| wrong(1, error.to_string()))?;
    let header = header.iter().map(|name| name.trim_start_matches('\u{feff}').to_ascii_lowercase()).collect();
    let table = Table { path, header, options };
    let (place, rotation) = (table.place()?, table.rotation()?);
    let named = |names: &[&str]| table.header.iter().position(|found| names.contains(&found.as_str()));
    let texts = [named(&["color", "colour", "image", "file", "filename"]), named(&["depth"])];
    let time = named(&["timestamp_s", "timestamp", "time"]);
    let mut lines = Vec::new();
    for record in reader.records() {
        let record =
            record.map_err(|error| wrong(error.position().map_or(0, csv::Position::line), error.to_string()))?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |column: &Column| {
            let text = record.get(column.at).unwrap_or_default();
            let value = text.parse().ok().filter(|value: &f64| value.is_finite() && value.abs() < 1e9);
            let value = value
                .ok_or_else(|| wrong(line, format!("{} is {text:?}; a number is expected", table.header[column.at])))?;
            Ok::<f64, ImportError>(value * column.scale)
        };
        let place = [number(&place[0])?, number(&place[1])?, number(&place[2])?];
        let rotation = rotation.iter().map(number).collect::<Result<Vec<_>, _>>()?;
        let base_from_flange = options.notation.pose(place, &rotation).map_err(|problem| wrong(line, problem))?;
        let text = |at: Option<usize>| at.and_then(|at| record.get(at)).filter(|t| !t.is_empty()).map(str::to_owned);
        let timestamp_s = time.map(|at| number(&Column { at, scale: 1.0 })).transpose()?;
        lines.push(PoseLine { base_from_flange, color: text(texts[0]), depth: text(texts[1]), timestamp_s });
    }
    table.plausible(&lines)?;
    Ok(lines)
}

impl Table<'_> {
    fn wrong(&self, problem: String) -> ImportError {
        ImportError::Poses { path: self.path.to_owned(), line: 1, problem }
    }

    /// The column of a name with a unit at its end, or without.
    fn column(&self, names: &[String], units: [(&str, f64); 2], usual: Option<f64>) -> Result<Column, ImportError> {
        for name in names {
            for (unit, scale) in units {
                let with_unit = [format!("{name}_{unit}"), format!("{name}[{unit}]"), format!("{name} [{unit}]")];
                if let Some(at) = self.header.iter().position(|found| with_unit.contains(found)) {
                    return Ok(Column { at, scale });
                }
            }
            if let Some(at) = self.header.iter().position(|found| found == name) {
                let [(first, _), (second, _)] = units;
                let scale = usual.ok_or_else(|| {
                    self.wrong(format!(
                        "column {name} has no unit; name it {name}_{first} or {name}_{second}, or give --poses-length {first} or {second}"
                    ))
                })?;
                return Ok(Column { at, scale });
            }
        }
        let [(first, _), (second, _)] = units;
        let wanted = &names[0];
        Err(self.wrong(format!(
            "there is no column {wanted} (nor {wanted}_{first}, {wanted}_{second}); the columns are {}",
            self.header.join(", ")
        )))
    }

    fn length(&self, names: &[&str]) -> Result<Column, ImportError> {
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        let usual = self.options.length_m.or(self.options.notation.usual_length_m());
        self.column(&names, [("mm", 1e-3), ("m", 1.0)], usual)
    }

    fn place(&self) -> Result<[Column; 3], ImportError> {
        match self.options.notation {
            PoseNotation::Matrix => {
                Ok([self.length(&["m14", "x"])?, self.length(&["m24", "y"])?, self.length(&["m34", "z"])?])
            }
            _ => Ok([self.length(&["x"])?, self.length(&["y"])?, self.length(&["z"])?]),
        }
    }

    fn rotation(&self) -> Result<Vec<Column>, ImportError> {
        let angle = |name: &&str| {
            let usual = Some(self.options.angle.unwrap_or(self.options.notation.usual_angle()));
            self.column(&[(*name).to_owned()], [("deg", 1f64.to_radians()), ("rad", 1.0)], usual)
        };
        let plain = |name: &str| match self.header.iter().position(|found| found == name) {
            Some(at) => Ok(Column { at, scale: 1.0 }),
            None => Err(self.wrong(format!("there is no column {name}; the columns are {}", self.header.join(", ")))),
        };
        match self.options.notation.rotation_part() {
            RotationPart::Angles(names) | RotationPart::RotationVector(names) => names.iter().map(angle).collect(),
            RotationPart::Quaternion(names) => names.into_iter().map(plain).collect(),
            RotationPart::Matrix => (1..=3)
                .flat_map(|row| (1..=3).map(move |column| format!("m{row}{column}")))
                .map(|name| plain(&name))
                .collect(),
        }
    }

    /// Millimetres taken for metres, and the other way round, are noticed.
    fn plausible(&self, lines: &[PoseLine]) -> Result<(), ImportError> {
        let far = lines.iter().map(|line| line.base_from_flange.translation.vector.norm()).fold(0.0, f64::max);
        if lines.is_empty() {
            return Err(self.wrong("there is no line of values".to_owned()));
        }
        if (PLAUSIBLE_M[0]..=PLAUSIBLE_M[1]).contains(&far) {
            return Ok(());
        }
        let other = if far < PLAUSIBLE_M[0] { "m" } else { "mm" };
        Err(self.wrong(format!(
            "the farthest flange is {far:.4} m off the base, where no arm has it; are the lengths in {other} (--poses-length {other}, or columns x_{other})?"
        )))
    }
}
