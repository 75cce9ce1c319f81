//! Poses, cameras, images, clouds and residuals as Foxglove's messages.

use super::residuals::{PostureResiduals, ResidualLine};
use super::writer::Time;
use foxglove::messages::{
    CameraCalibration, Color, CompressedImage, FrameTransform, FrameTransforms, ImageAnnotations, LinePrimitive,
    PackedElementField, Point2, Point3, PointCloud, PointsAnnotation, Pose, PoseInFrame, PosesInFrame, Quaternion,
    RawImage, SceneEntity, SceneUpdate, TextAnnotation, Vector3, line_primitive, packed_element_field,
    points_annotation,
};
use skclam_geometry::{DepthImage, Isometry3, PinholeCamera, Pixel};
use skclam_mapping::PointCloud as Cloud;

/// Nominal things are red, calibrated ones green.
pub(super) const NOMINAL: Color = Color { r: 0.9, g: 0.2, b: 0.15, a: 1.0 };
pub(super) const CALIBRATED: Color = Color { r: 0.1, g: 0.75, b: 0.3, a: 1.0 };
const WHITE: Color = Color { r: 1.0, g: 1.0, b: 1.0, a: 1.0 };
const SHADE: Color = Color { r: 0.0, g: 0.0, b: 0.0, a: 0.6 };

fn translation(pose: &Isometry3) -> Option<Vector3> {
    let t = &pose.translation.vector;
    Some(Vector3 { x: t.x, y: t.y, z: t.z })
}

fn rotation(pose: &Isometry3) -> Option<Quaternion> {
    let q = pose.rotation.coords;
    Some(Quaternion { x: q.x, y: q.y, z: q.z, w: q.w })
}

fn pose(pose: &Isometry3) -> Pose {
    Pose { position: translation(pose), orientation: rotation(pose) }
}

/// One edge of the tree of frames: `parent_from_child`.
pub(super) struct Edge {
    pub parent: String,
    pub child: String,
    pub parent_from_child: Isometry3,
}

pub(super) fn transforms(time: Time, edges: &[Edge]) -> FrameTransforms {
    let one = |edge: &Edge| FrameTransform {
        timestamp: time.stamp(),
        parent_frame_id: edge.parent.clone(),
        child_frame_id: edge.child.clone(),
        translation: translation(&edge.parent_from_child),
        rotation: rotation(&edge.parent_from_child),
    };
    FrameTransforms { transforms: edges.iter().map(one).collect() }
}

pub(super) fn pose_in_frame(time: Time, frame: &str, base_from_camera: &Isometry3) -> PoseInFrame {
    PoseInFrame { timestamp: time.stamp(), frame_id: frame.to_owned(), pose: Some(pose(base_from_camera)) }
}

pub(super) fn poses_in_frame(time: Time, frame: &str, poses: &[Isometry3]) -> PosesInFrame {
    PosesInFrame { timestamp: time.stamp(), frame_id: frame.to_owned(), poses: poses.iter().map(pose).collect() }
}

/// Trajectories as lines.
pub(super) fn lines(time: Time, frame: &str, trajectories: [(&str, Color, &[Isometry3]); 2]) -> SceneUpdate {
    let entity = |(id, color, poses): (&str, Color, &[Isometry3])| {
        let point = |pose: &Isometry3| {
            let t = &pose.translation.vector;
            Point3 { x: t.x, y: t.y, z: t.z }
        };
        let line = LinePrimitive {
            r#type: line_primitive::Type::LineStrip as i32,
            pose: Some(self::pose(&Isometry3::identity())),
            thickness: 2.0,
            scale_invariant: true,
            points: poses.iter().map(point).collect(),
            color: Some(color),
            ..LinePrimitive::default()
        };
        SceneEntity {
            timestamp: time.stamp(),
            frame_id: frame.to_owned(),
            id: id.to_owned(),
            lines: vec![line],
            ..SceneEntity::default()
        }
    };
    SceneUpdate { deletions: vec![], entities: trajectories.map(entity).into() }
}

/// `plumb_bob` is the name of the model `k1 k2 p1 p2 k3` in ROS and Foxglove.
pub(super) fn camera_calibration(time: Time, frame: &str, camera: &PinholeCamera) -> CameraCalibration {
    let PinholeCamera { fx, fy, cx, cy, .. } = *camera;
    CameraCalibration {
        timestamp: time.stamp(),
        frame_id: frame.to_owned(),
        width: camera.width,
        height: camera.height,
        distortion_model: "plumb_bob".to_owned(),
        d: camera.distortion.to_vec(),
        k: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

/// `format`: "jpeg" or "png".
pub(super) fn compressed_image(time: Time, frame: &str, format: &str, data: Vec<u8>) -> CompressedImage {
    CompressedImage {
        timestamp: time.stamp(),
        frame_id: frame.to_owned(),
        data: data.into(),
        format: format.to_owned(),
    }
}

/// Whole millimetres in 16 bits, as viewers expect of depth; 0 where nothing was measured or it is too far.
pub(super) fn depth_image(time: Time, frame: &str, depth: &DepthImage) -> RawImage {
    let millimetres = |&z: &f32| {
        let count = (f64::from(z) * 1e3).round();
        if count <= f64::from(u16::MAX) { count as u16 } else { 0 }
    };
    RawImage {
        timestamp: time.stamp(),
        frame_id: frame.to_owned(),
        width: depth.width(),
        height: depth.height(),
        encoding: "16UC1".to_owned(),
        step: 2 * depth.width(),
        data: depth.as_slice().iter().flat_map(|z| millimetres(z).to_le_bytes()).collect::<Vec<u8>>().into(),
    }
}

/// A cloud: positions in metres as 32-bit floats, colours where there are any.
pub(super) fn point_cloud(time: Time, frame: &str, cloud: &Cloud) -> PointCloud {
    use packed_element_field::NumericType;
    let field = |name: &str, offset: u32, kind: NumericType| PackedElementField {
        name: name.to_owned(),
        offset,
        r#type: kind as i32,
    };
    let colored = cloud.colors.len() == cloud.points.len();
    let mut fields: Vec<PackedElementField> =
        ["x", "y", "z"].into_iter().zip([0, 4, 8]).map(|(name, at)| field(name, at, NumericType::Float32)).collect();
    let mut stride = 12;
    if colored {
        let names = ["red", "green", "blue", "alpha"];
        fields.extend(names.into_iter().zip(12..16).map(|(name, at)| field(name, at, NumericType::Uint8)));
        stride = 16;
    }
    let mut data = Vec::with_capacity(cloud.points.len() * stride);
    for (index, point) in cloud.points.iter().enumerate() {
        point.iter().for_each(|value| data.extend_from_slice(&value.to_le_bytes()));
        if colored {
            data.extend_from_slice(&cloud.colors[index]);
            data.push(u8::MAX);
        }
    }
    PointCloud {
        timestamp: time.stamp(),
        frame_id: frame.to_owned(),
        pose: Some(pose(&Isometry3::identity())),
        point_stride: stride as u32,
        fields,
        data: data.into(),
    }
}

/// Matches as points, each with a line to where its epipolar line passes; above them what they say in numbers.
pub(super) fn annotations(time: Time, residuals: &PostureResiduals, color: Color) -> ImageAnnotations {
    let point = |pixel: &Pixel| Point2 { x: pixel.x, y: pixel.y };
    let ends = |line: &ResidualLine| [point(&line.measured), point(&line.on_epipolar_line)];
    let shape = |kind: points_annotation::Type, points: Vec<Point2>, color: Color, thickness: f64| PointsAnnotation {
        timestamp: time.stamp(),
        r#type: kind as i32,
        points,
        outline_color: Some(color),
        thickness,
        ..PointsAnnotation::default()
    };
    use points_annotation::Type::{LineList, Points};
    let text = TextAnnotation {
        timestamp: time.stamp(),
        position: Some(Point2 { x: 8.0, y: 8.0 }),
        text: format!(
            "{} of {} matches, median {:.2} px from their epipolar lines",
            residuals.lines.len(),
            residuals.matches,
            residuals.median_px
        ),
        font_size: 14.0,
        text_color: Some(WHITE),
        background_color: Some(SHADE),
        ..TextAnnotation::default()
    };
    ImageAnnotations {
        timestamp: time.stamp(),
        points: vec![
            shape(LineList, residuals.lines.iter().flat_map(ends).collect(), color, 1.5),
            shape(Points, residuals.lines.iter().map(|line| point(&line.measured)).collect(), WHITE, 2.0),
        ],
        texts: vec![text],
        ..ImageAnnotations::default()
    }
}
