//! From the rig to the tables.

use super::tables::{
    BoardKind, BoardTable, CameraTable, Convention, DepthTable, JointTable, RigFile, RobotTable, TransformTable,
};
use crate::corrections_table::CorrectionsTable;
use crate::{Board, BoardPattern, Prior, Rig};
use skclam_geometry::{Isometry3, PinholeCamera};
use skclam_kinematics::{JointKind, LinkForm, SerialChain};

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

pub(super) fn file_of(rig: &Rig) -> RigFile {
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
