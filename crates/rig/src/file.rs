//! `rig.toml`: the rig as a file that people write and every run reads and writes.
//!
//! The file speaks degrees and millimetres, and every key carries its unit; the rig speaks radians and metres.
//! Unknown keys are refused by name. What is written can be read again and is the same rig to 1e-10 of a unit.

use crate::corrections_table::CorrectionsTable;
use crate::{Board, BoardPattern, Prior, Rig};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};
use skclam_geometry::{DISTORTION_COEFFICIENTS, DepthCamera, Isometry3, PinholeCamera};
use skclam_kinematics::{Joint, JointKind, KinematicsError, Link, LinkForm, SerialChain, chain_from_urdf, urdf_ends};
use std::path::{Path, PathBuf};

/// Why a rig file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RigFileError {
    /// The file could not be opened or read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The text is not TOML, or a key is missing, unknown or of another type. The message names line and key.
    #[error("{path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, key and what was expected.
        message: String,
    },
    /// A value makes no sense.
    #[error("{path}: {key}: {problem}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The key in question, with its table.
        key: String,
        /// What is wrong, and what to do.
        problem: String,
    },
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RigFile {
    #[serde(default)]
    name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    robot: Option<RobotTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    joint_corrections: Option<CorrectionsTable>,
    mount: TransformTable,
    color: CameraTable,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth: Option<DepthTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    board: Option<BoardTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    prior: Option<Prior>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RobotTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    convention: Option<Convention>,
    #[serde(skip_serializing_if = "Option::is_none")]
    urdf: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    base_link: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    tip_link: Option<String>,
    /// Fixed transform before the first link.
    #[serde(skip_serializing_if = "Option::is_none")]
    base_from_first: Option<TransformTable>,
    /// Fixed transform after the last link.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_from_flange: Option<TransformTable>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    joint: Vec<JointTable>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Convention {
    ModifiedDh,
    StandardDh,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct JointTable {
    name: String,
    #[serde(rename = "type", default, skip_serializing_if = "is_revolute")]
    kind: JointKind,
    /// Overrides the robot's convention for this joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    convention: Option<Convention>,
    alpha_deg: f64,
    a_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    d_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    beta_deg: Option<f64>,
    theta_offset_deg: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    limits_deg: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    limits_mm: Option<[f64; 2]>,
}

fn is_revolute(kind: &JointKind) -> bool {
    *kind == JointKind::Revolute
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TransformTable {
    translation_mm: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraTable {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    distortion: Option<[f64; DISTORTION_COEFFICIENTS]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask: Option<String>,
}

/// A depth camera without a bias needs no line for it.
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DepthTable {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    distortion: Option<[f64; DISTORTION_COEFFICIENTS]>,
    unit_mm: f64,
    #[serde(default, skip_serializing_if = "is_zero")]
    offset_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    mask: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    color_from_depth: Option<TransformTable>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct BoardTable {
    kind: BoardKind,
    columns: u32,
    rows: u32,
    square_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    dictionary: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    marker_mm: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum BoardKind {
    Checkerboard,
    Charuco,
}

/// The largest rig file that is read; a real one has a few kilobytes.
const MAX_RIG_BYTES: u64 = 4 << 20;
/// The largest robot description that is read; meshes lie in files of their own.
const MAX_URDF_BYTES: u64 = 16 << 20;
/// The smallest length above 0 that is believed, millimetres.
const LEAST_MM: f64 = 1e-6;
/// The largest image side that is believed, pixels.
const MAX_SIDE: u32 = 32_768;

impl Rig {
    /// Reads `rig.toml`.
    pub fn read(path: impl AsRef<Path>) -> Result<Rig, RigFileError> {
        let path = path.as_ref();
        let io = |source| RigFileError::Io { path: path.to_owned(), source };
        let length = std::fs::metadata(path).map_err(io)?.len();
        if length > MAX_RIG_BYTES {
            let problem = format!("the file has {length} bytes; a rig has a few thousand. Is this the right file?");
            return Err(RigFileError::Value { path: path.to_owned(), key: "file".to_owned(), problem });
        }
        let text = std::fs::read_to_string(path).map_err(io)?;
        Rig::from_toml(&text, path)
    }

    /// Reads a rig from text. `path` names the file in errors, and its folder is where a URDF is looked for.
    pub fn from_toml(text: &str, path: impl AsRef<Path>) -> Result<Rig, RigFileError> {
        let reader = Reader { path: path.as_ref() };
        let file: RigFile = toml::from_str(text).map_err(|error| RigFileError::Syntax {
            path: reader.path.to_owned(),
            message: error.to_string().trim_end().to_owned(),
        })?;
        reader.rig(file)
    }

    /// The rig as the text of `rig.toml`.
    pub fn to_toml(&self) -> Result<String, RigFileError> {
        let file = file_of(self);
        toml::to_string(&file)
            .map_err(|error| RigFileError::Syntax { path: PathBuf::from("rig.toml"), message: error.to_string() })
    }
}

struct Reader<'a> {
    path: &'a Path,
}

impl Reader<'_> {
    fn value(&self, key: impl Into<String>, problem: impl Into<String>) -> RigFileError {
        RigFileError::Value { path: self.path.to_owned(), key: key.into(), problem: problem.into() }
    }

    fn finite(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        if value.is_finite() { Ok(value) } else { Err(self.value(key, format!("{value} is no finite number"))) }
    }

    fn positive(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        // A subnormal number becomes 0 when millimetres become metres.
        if value.is_normal() && value > 0.0 {
            Ok(value)
        } else {
            Err(self.value(key, format!("{value} given; a number above 0 is needed")))
        }
    }

    /// A length above 0 that is still one when the file is written again: what is below a nanometre is a slip of units.
    fn positive_mm(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        if value.is_finite() && value >= LEAST_MM {
            Ok(value)
        } else {
            Err(self.value(key, format!("{value} given; a number above 0 is needed, in mm at least {LEAST_MM}")))
        }
    }

    fn rig(&self, file: RigFile) -> Result<Rig, RigFileError> {
        let robot = file.robot.map(|table| self.robot(table)).transpose()?;
        let joint_corrections = file.joint_corrections.unwrap_or_default();
        let joint_corrections =
            joint_corrections.corrections(robot.as_ref()).map_err(|(key, message)| self.value(&key, message))?;
        let flange_from_color = self.transform("mount", &file.mount)?;
        let (color, color_mask) = self.camera("color", file.color)?;
        let (depth, depth_mask) = match file.depth {
            None => (None, None),
            Some(table) => {
                let (depth, mask) = self.depth(table)?;
                (Some(depth), mask)
            }
        };
        let board = file.board.map(|table| self.board(table)).transpose()?;
        let prior = file.prior.unwrap_or_default();
        self.prior(&prior)?;
        let name = file.name;
        Ok(Rig {
            name,
            robot,
            joint_corrections,
            flange_from_color,
            color,
            depth,
            board,
            prior,
            color_mask,
            depth_mask,
        })
    }

    fn robot(&self, table: RobotTable) -> Result<SerialChain, RigFileError> {
        if table.urdf.is_some() {
            return self.urdf(table);
        }
        for (key, value) in [("robot.base_link", &table.base_link), ("robot.tip_link", &table.tip_link)] {
            if value.is_some() {
                return Err(self.value(key, "has a meaning only together with robot.urdf"));
            }
        }
        let convention = table.convention.ok_or_else(|| {
            self.value(
                "robot.convention",
                "is missing; give \"modified_dh\" or \"standard_dh\", or name a URDF with robot.urdf",
            )
        })?;
        if table.joint.is_empty() {
            return Err(
                self.value("robot.joint", "there is no joint; give one [[robot.joint]] table a joint, base to flange")
            );
        }
        let joints = table
            .joint
            .into_iter()
            .enumerate()
            .map(|(index, joint)| self.joint(index, convention, joint))
            .collect::<Result<Vec<_>, _>>()?;
        let end = |key: &str, end: Option<TransformTable>| match end {
            None => Ok(Isometry3::identity()),
            Some(table) => self.transform(key, &table),
        };
        let base_from_first = end("robot.base_from_first", table.base_from_first)?;
        let last_from_flange = end("robot.last_from_flange", table.last_from_flange)?;
        SerialChain::with_ends(base_from_first, joints, last_from_flange)
            .map_err(|error: KinematicsError| self.value("robot", error.to_string()))
    }

    /// The chain of a URDF that lies beside the rig's file; base and tip may be left out where there is only one choice.
    fn urdf(&self, table: RobotTable) -> Result<SerialChain, RigFileError> {
        if table.convention.is_some() || !table.joint.is_empty() {
            return Err(
                self.value("robot.urdf", "stands beside convention or [[robot.joint]]; describe the arm in one way")
            );
        }
        if table.base_from_first.is_some() || table.last_from_flange.is_some() {
            return Err(self.value(
                "robot.urdf",
                "the URDF's links say where base and tip are; choose them with base_link and tip_link",
            ));
        }
        let name = table.urdf.unwrap_or_default();
        let path = self.path.parent().unwrap_or(Path::new("")).join(&name);
        let io = |source| RigFileError::Io { path: path.clone(), source };
        let length = std::fs::metadata(&path).map_err(io)?.len();
        if length > MAX_URDF_BYTES {
            return Err(self.value(
                "robot.urdf",
                format!("{name} has {length} bytes; a robot description has at most {MAX_URDF_BYTES}"),
            ));
        }
        let text = std::fs::read_to_string(&path).map_err(io)?;
        let refused = |error: KinematicsError| self.value("robot.urdf", format!("{name}: {error}"));
        let (bases, tips) = urdf_ends(&text).map_err(refused)?;
        let choose = |key: &str, given: Option<String>, found: Vec<String>| match (given, found.as_slice()) {
            (Some(link), _) => Ok(link),
            (None, [only]) => Ok(only.clone()),
            (None, _) => {
                Err(self.value(key, format!("is missing, and {name} leaves the choice of {}", found.join(", "))))
            }
        };
        let base_link = choose("robot.base_link", table.base_link, bases)?;
        let tip_link = choose("robot.tip_link", table.tip_link, tips)?;
        chain_from_urdf(&text, &base_link, &tip_link).map_err(refused)
    }

    fn joint(&self, index: usize, convention: Convention, table: JointTable) -> Result<Joint, RigFileError> {
        let key = |name: &str| format!("robot.joint {} (\"{}\"): {name}", index + 1, table.name);
        let alpha = self.finite(&key("alpha_deg"), table.alpha_deg)?.to_radians();
        let a = self.finite(&key("a_mm"), table.a_mm)? * 1e-3;
        let theta_offset = self.finite(&key("theta_offset_deg"), table.theta_offset_deg)?.to_radians();
        let modified = table.convention.unwrap_or(convention) == Convention::ModifiedDh;
        let (form, beta, d) = match (table.d_mm, table.beta_deg) {
            (Some(d_mm), None) => {
                let form = if modified { LinkForm::ModifiedDh } else { LinkForm::StandardDh };
                (form, 0.0, self.finite(&key("d_mm"), d_mm)? * 1e-3)
            }
            (None, Some(beta_deg)) => {
                let form = if modified { LinkForm::Hayati } else { LinkForm::StandardHayati };
                (form, self.finite(&key("beta_deg"), beta_deg)?.to_radians(), 0.0)
            }
            (None, None) => {
                return Err(self.value(key("d_mm"), "is missing; give d_mm (DH), or beta_deg in its place (Hayati)"));
            }
            (Some(_), Some(_)) => {
                return Err(self.value(key("beta_deg"), "stands beside d_mm; a joint has one or the other"));
            }
        };
        let limits = match (table.kind, table.limits_deg, table.limits_mm) {
            (_, None, None) => None,
            (JointKind::Revolute, Some(limits), None) => Some(limits.map(f64::to_radians)),
            (JointKind::Prismatic, None, Some(limits)) => Some(limits.map(|limit| limit * 1e-3)),
            (JointKind::Revolute, ..) => return Err(self.value(key("limits_mm"), "a revolute joint has limits_deg")),
            (JointKind::Prismatic, ..) => return Err(self.value(key("limits_deg"), "a prismatic joint has limits_mm")),
        };
        Ok(Joint { name: table.name, kind: table.kind, link: Link { form, alpha, a, beta, theta_offset, d }, limits })
    }

    fn transform(&self, key: &str, table: &TransformTable) -> Result<Isometry3, RigFileError> {
        for value in table.translation_mm {
            self.finite(&format!("{key}.translation_mm"), value)?;
        }
        let [x, y, z, w] = table.quaternion_xyzw;
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        if !norm.is_finite() || (norm - 1.0).abs() > 1e-3 {
            let problem = format!("has the norm {norm}; a rotation needs a unit quaternion in the order x, y, z, w");
            return Err(self.value(format!("{key}.quaternion_xyzw"), problem));
        }
        let [tx, ty, tz] = table.translation_mm.map(|length| length * 1e-3);
        Ok(Isometry3::from_parts(Translation3::new(tx, ty, tz), UnitQuaternion::from_quaternion(quaternion)))
    }

    fn camera(&self, key: &str, table: CameraTable) -> Result<(PinholeCamera, Option<String>), RigFileError> {
        for (name, side) in [("width", table.width), ("height", table.height)] {
            if side == 0 || side > MAX_SIDE {
                return Err(
                    self.value(format!("{key}.{name}"), format!("{side} pixels given; 1 to {MAX_SIDE} are possible"))
                );
            }
        }
        let distortion = table.distortion.unwrap_or_default();
        for value in distortion {
            self.finite(&format!("{key}.distortion"), value)?;
        }
        let camera = PinholeCamera {
            width: table.width,
            height: table.height,
            fx: self.positive(&format!("{key}.fx"), table.fx)?,
            fy: self.positive(&format!("{key}.fy"), table.fy)?,
            cx: self.finite(&format!("{key}.cx"), table.cx)?,
            cy: self.finite(&format!("{key}.cy"), table.cy)?,
            distortion,
        };
        Ok((camera, table.mask))
    }

    fn depth(&self, table: DepthTable) -> Result<(DepthCamera, Option<String>), RigFileError> {
        let DepthTable { width, height, fx, fy, cx, cy, distortion, unit_mm, offset_mm, mask, color_from_depth } =
            table;
        let (camera, mask) = self.camera("depth", CameraTable { width, height, fx, fy, cx, cy, distortion, mask })?;
        let unit_m = self.positive_mm("depth.unit_mm", unit_mm)? * 1e-3;
        let offset_m = self.finite("depth.offset_mm", offset_mm)? * 1e-3;
        let color_from_depth = match color_from_depth {
            None => Isometry3::identity(),
            Some(table) => self.transform("depth.color_from_depth", &table)?,
        };
        Ok((DepthCamera { camera, unit_m, offset_m, color_from_depth }, mask))
    }

    fn board(&self, table: BoardTable) -> Result<Board, RigFileError> {
        for (name, count) in [("columns", table.columns), ("rows", table.rows)] {
            if !(2..=1000).contains(&count) {
                return Err(
                    self.value(format!("board.{name}"), format!("{count} inner corners given; 2 to 1000 are possible"))
                );
            }
        }
        let square_m = self.positive_mm("board.square_mm", table.square_mm)? * 1e-3;
        let pattern = match (table.kind, table.dictionary, table.marker_mm) {
            (BoardKind::Checkerboard, None, None) => BoardPattern::Checkerboard,
            (BoardKind::Checkerboard, ..) => {
                return Err(self.value("board", "dictionary and marker_mm belong to kind = \"charuco\""));
            }
            (BoardKind::Charuco, Some(dictionary), Some(marker_mm)) => {
                let marker_mm = self.positive_mm("board.marker_mm", marker_mm)?;
                let marker_um = (marker_mm * 1e3).round() as u64;
                if marker_um == 0 {
                    return Err(
                        self.value("board.marker_mm", format!("{marker_mm} given; at least 0.001 mm is needed"))
                    );
                }
                if marker_mm >= table.square_mm {
                    return Err(self.value("board.marker_mm", "a marker is smaller than the square it stands in"));
                }
                BoardPattern::Charuco { dictionary, marker_um }
            }
            (BoardKind::Charuco, ..) => {
                return Err(
                    self.value("board", "kind = \"charuco\" needs dictionary (such as \"DICT_4X4_50\") and marker_mm")
                );
            }
        };
        Ok(Board { pattern, columns: table.columns, rows: table.rows, square_m })
    }

    fn prior(&self, prior: &Prior) -> Result<(), RigFileError> {
        for (key, sigma) in prior.entries() {
            if let Some(sigma) = sigma {
                self.positive(&format!("prior.{key}"), sigma)?;
            }
        }
        Ok(())
    }
}

/// Degrees and millimetres to ten decimals: what rounding in the conversion adds is left out of the file.
fn decimals(value: f64) -> f64 {
    // Adding zero turns a negative zero into a plain one.
    format!("{value:.10}").parse::<f64>().unwrap_or(value) + 0.0
}

fn deg(angle: f64) -> f64 {
    decimals(angle.to_degrees())
}

fn mm(length: f64) -> f64 {
    decimals(length * 1e3)
}

fn file_of(rig: &Rig) -> RigFile {
    RigFile {
        name: rig.name.clone(),
        robot: rig.robot.as_ref().map(robot_of),
        joint_corrections: CorrectionsTable::of(&rig.joint_corrections),
        mount: transform_of(&rig.flange_from_color),
        color: camera_of(&rig.color, rig.color_mask.clone()),
        depth: rig.depth.as_ref().map(|depth| {
            let CameraTable { width, height, fx, fy, cx, cy, distortion, mask } =
                camera_of(&depth.camera, rig.depth_mask.clone());
            let color_from_depth = Some(transform_of(&depth.color_from_depth));
            let (unit_mm, offset_mm) = (mm(depth.unit_m), mm(depth.offset_m));
            DepthTable { width, height, fx, fy, cx, cy, distortion, unit_mm, offset_mm, mask, color_from_depth }
        }),
        board: rig.board.as_ref().map(board_of),
        prior: (rig.prior != Prior::default()).then_some(rig.prior),
    }
}

fn robot_of(chain: &SerialChain) -> RobotTable {
    let standard = |form: LinkForm| matches!(form, LinkForm::StandardDh | LinkForm::StandardHayati);
    let all_standard = chain.joints().iter().all(|joint| standard(joint.link.form));
    let end = |transform: &Isometry3| (*transform != Isometry3::identity()).then(|| transform_of(transform));
    RobotTable {
        convention: Some(if all_standard { Convention::StandardDh } else { Convention::ModifiedDh }),
        base_from_first: end(chain.base_from_first()),
        last_from_flange: end(chain.last_from_flange()),
        joint: chain
            .joints()
            .iter()
            .map(|joint| {
                let link = &joint.link;
                let hayati = matches!(link.form, LinkForm::Hayati | LinkForm::StandardHayati);
                let revolute = joint.kind == JointKind::Revolute;
                JointTable {
                    name: joint.name.clone(),
                    kind: joint.kind,
                    convention: (standard(link.form) && !all_standard).then_some(Convention::StandardDh),
                    alpha_deg: deg(link.alpha),
                    a_mm: mm(link.a),
                    d_mm: (!hayati).then(|| mm(link.d)),
                    beta_deg: hayati.then(|| deg(link.beta)),
                    theta_offset_deg: deg(link.theta_offset),
                    limits_deg: joint.limits.filter(|_| revolute).map(|limits| limits.map(deg)),
                    limits_mm: joint.limits.filter(|_| !revolute).map(|limits| limits.map(mm)),
                }
            })
            .collect(),
        ..RobotTable::default()
    }
}

fn transform_of(transform: &Isometry3) -> TransformTable {
    let [x, y, z]: [f64; 3] = transform.translation.vector.into();
    let [i, j, k, w]: [f64; 4] = transform.rotation.coords.into();
    TransformTable { translation_mm: [mm(x), mm(y), mm(z)], quaternion_xyzw: [i, j, k, w].map(|value| value + 0.0) }
}

fn camera_of(camera: &PinholeCamera, mask: Option<String>) -> CameraTable {
    CameraTable {
        width: camera.width,
        height: camera.height,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        distortion: camera.is_distorted().then_some(camera.distortion),
        mask,
    }
}

fn board_of(board: &Board) -> BoardTable {
    let (kind, dictionary, marker_mm) = match &board.pattern {
        BoardPattern::Checkerboard => (BoardKind::Checkerboard, None, None),
        BoardPattern::Charuco { dictionary, marker_um } => {
            (BoardKind::Charuco, Some(dictionary.clone()), Some(*marker_um as f64 * 1e-3))
        }
    };
    BoardTable { kind, columns: board.columns, rows: board.rows, square_mm: mm(board.square_m), dictionary, marker_mm }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: &str = r#"
name = "two joints"
[robot]
convention = "modified_dh"
[[robot.joint]]
name = "S"
alpha_deg = 0
a_mm = 0.0
d_mm = 290.0
theta_offset_deg = 0.0
limits_deg = [-170.0, 170.0]
[[robot.joint]]
name = "U"
alpha_deg = 181.0
a_mm = 260.0
beta_deg = 0.3
theta_offset_deg = -90.0
[[robot.joint]]
name = "rail"
type = "prismatic"
alpha_deg = 12.5
a_mm = 1.0
d_mm = 2.0
theta_offset_deg = 3.0
limits_mm = [0.0, 500.0]
[mount]
translation_mm = [-60.0, 0.0, 40.0]
quaternion_xyzw = [0.0, 0.0, -0.70710678, 0.70710678]
[color]
width = 1920
height = 1080
fx = 1371.02
fy = 1371.02
cx = 959.5
cy = 539.5
mask = "mask.png"
[depth]
width = 480
height = 360
fx = 424.2
fy = 424.2
cx = 239.5
cy = 179.5
unit_mm = 1.0
[depth.color_from_depth]
translation_mm = [15.0, 0.0, 0.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
[board]
kind = "charuco"
columns = 11
rows = 8
square_mm = 15
dictionary = "DICT_4X4_50"
marker_mm = 11
[prior]
angle_deg = 0.5
"#;

    #[test]
    fn what_is_written_is_read_back_the_same() {
        let biased = EXAMPLE.replace("unit_mm = 1.0", "unit_mm = 1.0\noffset_mm = -2.5");
        let rig = Rig::from_toml(&biased, "rig.toml").unwrap();
        assert_eq!(rig.depth.unwrap().offset_m, -2.5e-3);
        let robot = rig.robot.as_ref().unwrap();
        assert_eq!(robot.joints()[1].link.form, LinkForm::Hayati);
        assert_eq!(robot.joints()[2].limits, Some([0.0, 0.5]));
        let text = rig.to_toml().unwrap();
        assert!(text.contains("alpha_deg = 181.0\n"), "{text}");
        let again = Rig::from_toml(&text, "rig.toml").unwrap();
        assert_eq!(again.to_toml().unwrap(), text);
        assert_eq!(again, rig);
    }

    #[test]
    fn errors_name_the_file_the_key_and_the_cure() {
        let with =
            |from: &str, to: &str| Rig::from_toml(&EXAMPLE.replace(from, to), "cell/rig.toml").unwrap_err().to_string();
        let message = with("fx = 1371.02", "fx = nan");
        assert!(message.contains("cell/rig.toml") && message.contains("color.fx"), "{message}");
        assert!(with("unit_mm = 1.0", "unit_mm = 1.0\noffset_mm = nan").contains("depth.offset_mm"));
        let message = with("unit_mm = 1.0", "unit_mm = 1.0\nunits = 3");
        assert!(message.contains("units") && message.contains("line"), "{message}");
        let message = with("quaternion_xyzw = [0.0, 0.0, -0.70710678, 0.70710678]", "quaternion_xyzw = [0, 0, 0, 0]");
        assert!(message.contains("mount.quaternion_xyzw") && message.contains("unit quaternion"), "{message}");
        let message = with("beta_deg = 0.3\n", "");
        assert!(message.contains("robot.joint 2 (\"U\"): d_mm"), "{message}");
        let message = with("beta_deg = 0.3", "beta_deg = 0.3\nd_mm = 1");
        assert!(message.contains("one or the other"), "{message}");
        let message = with("width = 1920", "width = 0");
        assert!(message.contains("color.width"), "{message}");
        let message = with("limits_deg = [-170.0, 170.0]", "limits_deg = [170.0, -170.0]");
        assert!(message.contains("above the upper limit"), "{message}");
        let message = with("angle_deg = 0.5", "angle_deg = -0.5");
        assert!(message.contains("prior.angle_deg"), "{message}");
        let message = with("convention = \"modified_dh\"", "convention = \"craig\"");
        assert!(message.contains("modified_dh"), "{message}");
    }
}
