//! From the tables to the rig: every number is checked and named by its key.

use super::tables::{
    BoardKind, BoardTable, CameraTable, Convention, DepthTable, JointTable, RigFile, RobotTable, TransformTable,
};
use super::{RigFileError, RobotDescription};
use crate::{Board, BoardPattern, Prior, Rig};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera};
use skclam_kinematics::{Joint, JointKind, KinematicsError, Link, LinkForm, SerialChain, chain_from_urdf, urdf_ends};
use std::path::Path;

/// The smallest length above 0 that is accepted, millimetres.
const MIN_MM: f64 = 1e-6;
/// The largest length that is accepted, millimetres: a kilometre.
const MAX_MM: f64 = 1e6;
/// The largest angle that is accepted, degrees.
const MAX_DEG: f64 = 1e5;
/// The largest image side that is accepted, pixels.
const MAX_SIDE: u32 = 32_768;
/// The most pixels of an image; what is made of one takes some tens of bytes for each.
const MAX_PIXELS: u64 = 1 << 27;
/// Focal lengths that are accepted, in widths of the image: fields of view from 179 deg to 0.06 deg.
const FOCAL_WIDTHS: [f64; 2] = [0.005, 1000.0];
/// Lengths of a count of a depth image that are accepted, millimetres.
const UNIT_MM: [f64; 2] = [1e-3, 100.0];

/// The reader of one file.
pub(super) struct Reader<'a> {
    pub(super) path: &'a Path,
}

impl Reader<'_> {
    fn value(&self, key: impl Into<String>, problem: impl Into<String>) -> RigFileError {
        RigFileError::Value { path: self.path.to_owned(), key: key.into(), problem: problem.into() }
    }

    fn finite(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        if value.is_finite() { Ok(value) } else { Err(self.value(key, format!("{value} is no finite number"))) }
    }

    /// A length of an arm or a camera.
    fn mm(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        match self.finite(key, value)? {
            value if value.abs() <= MAX_MM => Ok(value),
            value => Err(self.value(key, format!("{value:e} mm given; no arm is that long"))),
        }
    }

    fn deg(&self, key: &str, value: f64) -> Result<f64, RigFileError> {
        match self.finite(key, value)? {
            value if value.abs() <= MAX_DEG => Ok(value),
            value => Err(self.value(key, format!("{value:e} deg given; at most {MAX_DEG} are possible"))),
        }
    }

    fn focal(&self, key: &str, value: f64, side: u32) -> Result<f64, RigFileError> {
        let focal = self.positive(key, value)?;
        let widths = focal / f64::from(side);
        if (FOCAL_WIDTHS[0]..=FOCAL_WIDTHS[1]).contains(&widths) {
            return Ok(focal);
        }
        let view_deg = 2.0 * (0.5 / widths).atan().to_degrees();
        let problem =
            format!("{focal:e} px given for {side} px: a field of view of {view_deg:.2e} deg, which no camera has");
        Err(self.value(key, problem))
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
        if value.is_finite() && value >= MIN_MM {
            Ok(value)
        } else {
            Err(self.value(key, format!("{value} given; a number above 0 is needed, in mm at least {MIN_MM}")))
        }
    }

    pub(super) fn rig(&self, file: RigFile) -> Result<Rig, RigFileError> {
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
        let mut names = std::collections::BTreeSet::new();
        if let Some(twice) = joints.iter().find(|joint| !names.insert(&joint.name)) {
            return Err(
                self.value("robot.joint", format!("{:?} is the name of two joints; give each its own", twice.name))
            );
        }
        let end = |key: &str, end: Option<TransformTable>| match end {
            None => Ok(Isometry3::identity()),
            Some(table) => self.transform(key, &table),
        };
        let base_from_first = end("robot.base_from_first", table.base_from_first)?;
        let last_from_flange = end("robot.last_from_flange", table.last_from_flange)?;
        SerialChain::with_ends(base_from_first, joints, last_from_flange)
            .map_err(|error: KinematicsError| self.value("robot", error.to_string()))
    }

    /// The chain of a URDF that lies beside the rig's file; base and tip may be left out where there is only one
    /// choice.
    fn urdf(&self, table: RobotTable) -> Result<SerialChain, RigFileError> {
        let RobotDescription { file, text, base_link, tip_link } = self.description(table)?;
        chain_from_urdf(&text, &base_link, &tip_link)
            .map_err(|error| self.value("robot.urdf", format!("{file}: {error}")))
    }

    /// The URDF that a rig names.
    pub(super) fn description(&self, table: RobotTable) -> Result<RobotDescription, RigFileError> {
        if table.convention.is_some() || !table.joint.is_empty() {
            return Err(
                self.value("robot.urdf", "is given beside convention or [[robot.joint]]; describe the arm in one way")
            );
        }
        if table.base_from_first.is_some() || table.last_from_flange.is_some() {
            return Err(self.value(
                "robot.urdf",
                "the URDF's links say where base and tip are; choose them with base_link and tip_link",
            ));
        }
        let name = table.urdf.unwrap_or_default();
        let folder = self.path.parent().unwrap_or(Path::new(""));
        let text = skclam_files::inside(folder, &name)
            .and_then(|path| skclam_files::read_text(path, skclam_files::Kind::RobotDescription))
            .map_err(|error| self.value("robot.urdf", format!("{name}: {error}")))?;
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
        Ok(RobotDescription { file: name, text, base_link, tip_link })
    }

    fn joint(&self, index: usize, convention: Convention, table: JointTable) -> Result<Joint, RigFileError> {
        let key = |name: &str| format!("robot.joint {} (\"{}\"): {name}", index + 1, table.name);
        let alpha = self.deg(&key("alpha_deg"), table.alpha_deg)?.to_radians();
        let a = self.mm(&key("a_mm"), table.a_mm)? * 1e-3;
        let theta_offset = self.deg(&key("theta_offset_deg"), table.theta_offset_deg)?.to_radians();
        let modified = table.convention.unwrap_or(convention) == Convention::ModifiedDh;
        let (form, beta, d) = match (table.d_mm, table.beta_deg) {
            (Some(d_mm), None) => {
                let form = if modified { LinkForm::ModifiedDh } else { LinkForm::StandardDh };
                (form, 0.0, self.mm(&key("d_mm"), d_mm)? * 1e-3)
            }
            (None, Some(beta_deg)) => {
                let form = if modified { LinkForm::Hayati } else { LinkForm::StandardHayati };
                (form, self.deg(&key("beta_deg"), beta_deg)?.to_radians(), 0.0)
            }
            (None, None) => {
                return Err(self.value(key("d_mm"), "is missing; give d_mm (DH), or beta_deg in its place (Hayati)"));
            }
            (Some(_), Some(_)) => {
                return Err(self.value(key("beta_deg"), "is given beside d_mm; a joint has one or the other"));
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
            self.mm(&format!("{key}.translation_mm"), value)?;
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

    /// A coordinate of the principal point; that of a crop may lie outside of the image, but not far from it.
    fn principal(&self, key: &str, value: f64, side: u32) -> Result<f64, RigFileError> {
        let side = f64::from(side);
        match self.finite(key, value)? {
            value if (-2.0 * side..=3.0 * side).contains(&value) => Ok(value),
            value => Err(self.value(key, format!("{value:e} px given, far outside of an image of {side} px"))),
        }
    }

    fn camera(&self, key: &str, table: CameraTable) -> Result<(PinholeCamera, Option<String>), RigFileError> {
        for (name, side) in [("width", table.width), ("height", table.height)] {
            if side == 0 || side > MAX_SIDE {
                return Err(
                    self.value(format!("{key}.{name}"), format!("{side} pixels given; 1 to {MAX_SIDE} are possible"))
                );
            }
        }
        if u64::from(table.width) * u64::from(table.height) > MAX_PIXELS {
            let problem = format!("{} x {} pixels given; at most {MAX_PIXELS} are read", table.width, table.height);
            return Err(self.value(format!("{key}.width"), problem));
        }
        let distortion = table.distortion.unwrap_or_default();
        for value in distortion {
            self.finite(&format!("{key}.distortion"), value)?;
        }
        let camera = PinholeCamera {
            width: table.width,
            height: table.height,
            fx: self.focal(&format!("{key}.fx"), table.fx, table.width)?,
            fy: self.focal(&format!("{key}.fy"), table.fy, table.height)?,
            cx: self.principal(&format!("{key}.cx"), table.cx, table.width)?,
            cy: self.principal(&format!("{key}.cy"), table.cy, table.height)?,
            distortion,
        };
        if let Some(mask) = table.mask.as_deref().filter(|mask| !skclam_files::is_inside(Path::new(mask))) {
            let problem = format!("{mask:?} leaves the folder; name a file within it");
            return Err(self.value(format!("{key}.mask"), problem));
        }
        Ok((camera, table.mask))
    }

    fn depth(&self, table: DepthTable) -> Result<(DepthCamera, Option<String>), RigFileError> {
        let DepthTable { width, height, fx, fy, cx, cy, distortion, unit_mm, offset_mm, mask, color_from_depth } =
            table;
        let (camera, mask) = self.camera("depth", CameraTable { width, height, fx, fy, cx, cy, distortion, mask })?;
        let unit_mm = self.positive_mm("depth.unit_mm", unit_mm)?;
        if !(UNIT_MM[0]..=UNIT_MM[1]).contains(&unit_mm) {
            let reach_m = unit_mm * f64::from(u16::MAX) * 1e-3;
            let problem = format!(
                "{unit_mm} mm a count given, so that 16 bits reach {reach_m:.1e} m; cameras have 0.1 to 5 (1 for most)"
            );
            return Err(self.value("depth.unit_mm", problem));
        }
        let unit_m = unit_mm * 1e-3;
        let offset_m = self.mm("depth.offset_mm", offset_mm)? * 1e-3;
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
                    return Err(self.value("board.marker_mm", "a marker is smaller than the square around it"));
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
