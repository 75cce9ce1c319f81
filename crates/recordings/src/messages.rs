//! The message types that matter here, parsed without copying pixels. Both wire formats have the same fields in the
//! same order (the `.msg` files of `common_interfaces`), but for `seq` in the header of ROS 1.

use crate::wire::{Wire, WireProblem};
use crate::{RecordingError, WireFormat};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::Serialize;

/// What a topic's messages are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MessageKind {
    /// `sensor_msgs/Image`.
    Image,
    /// `sensor_msgs/CompressedImage`.
    CompressedImage,
    /// `sensor_msgs/CameraInfo`.
    CameraInfo,
    /// `sensor_msgs/JointState`.
    JointState,
    /// `tf2_msgs/TFMessage`, `tf/tfMessage`.
    Transforms,
    /// `geometry_msgs/Transform`: the extrinsics of the RealSense Viewer.
    Transform,
    /// `std_msgs/Float32`: options of the RealSense Viewer.
    Float32,
    /// An image file of a TUM folder.
    ImageFile,
    /// A camera pose of a TUM folder.
    PoseLine,
    /// Anything else.
    Other,
}

impl MessageKind {
    /// By the name of the type, `sensor_msgs/Image` or `sensor_msgs/msg/Image`.
    pub fn of(type_name: &str) -> Self {
        match type_name.replace("/msg/", "/").as_str() {
            "sensor_msgs/Image" => MessageKind::Image,
            "sensor_msgs/CompressedImage" => MessageKind::CompressedImage,
            "sensor_msgs/CameraInfo" => MessageKind::CameraInfo,
            "sensor_msgs/JointState" => MessageKind::JointState,
            "tf2_msgs/TFMessage" | "tf/tfMessage" => MessageKind::Transforms,
            "geometry_msgs/Transform" => MessageKind::Transform,
            "std_msgs/Float32" => MessageKind::Float32,
            _ => MessageKind::Other,
        }
    }

    /// Whether messages of this kind begin with a header.
    pub fn has_header(self) -> bool {
        use MessageKind::{CameraInfo, CompressedImage, Image, JointState};
        matches!(self, Image | CompressedImage | CameraInfo | JointState)
    }
}

/// Nanoseconds on the recording's clock.
pub type Stamp = i64;

/// Stamp and coordinate frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header<'a> {
    /// When the data was taken.
    pub stamp: Stamp,
    /// Coordinate frame.
    pub frame_id: &'a str,
}

fn header<'a>(wire: &mut Wire<'a>) -> Result<Header<'a>, WireProblem> {
    let ros1 = wire.is_ros1();
    if ros1 {
        wire.u32()?;
    }
    // Seconds are unsigned in ROS 1 and signed in ROS 2.
    let seconds = wire.u32()?;
    let seconds = if ros1 { i64::from(seconds) } else { i64::from(seconds as i32) };
    let nanoseconds = wire.u32()?;
    if nanoseconds >= 1_000_000_000 {
        return Err(format!("the stamp has {nanoseconds} nanoseconds; less than 1e9 are possible"));
    }
    Ok(Header { stamp: seconds * 1_000_000_000 + i64::from(nanoseconds), frame_id: wire.string()? })
}

/// Size and encoding of an image, which come before its pixels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageHead<'a> {
    /// Stamp and frame.
    pub header: Header<'a>,
    /// Pixels, for a compressed image 0.
    pub width: u32,
    /// Pixels, for a compressed image 0.
    pub height: u32,
    /// `mono8`, `16UC1`, ...; for a compressed image its format, `png`, `rgb8; jpeg compressed bgr8`, ...
    pub encoding: &'a str,
}

/// `sensor_msgs/Image`.
#[derive(Debug, Clone)]
pub struct Image<'a> {
    /// Stamp, frame, size and encoding.
    pub head: ImageHead<'a>,
    /// Whether numbers of more than a byte are big-endian.
    pub big_endian: bool,
    /// Bytes of a row.
    pub step: u32,
    /// The rows.
    pub data: &'a [u8],
    /// Metres a count, which the RealSense Viewer appends.
    pub depth_unit_m: Option<f32>,
}

/// `sensor_msgs/CompressedImage`.
#[derive(Debug, Clone)]
pub struct CompressedImage<'a> {
    /// Stamp, frame and format.
    pub head: ImageHead<'a>,
    /// A JPEG or PNG file; for `compressedDepth` after twelve bytes of parameters.
    pub data: &'a [u8],
}

/// `sensor_msgs/CameraInfo`, what is needed of it.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInfo {
    /// Coordinate frame of the camera.
    pub frame_id: String,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// `plumb_bob`, ...
    pub distortion_model: String,
    /// Distortion coefficients `D`.
    pub distortion: Vec<f64>,
    /// `K`, row by row.
    pub matrix: [f64; 9],
    /// `P`, row by row: the camera of the rectified image.
    pub projection: [f64; 12],
}

/// `sensor_msgs/JointState`, what is needed of it.
#[derive(Debug, Clone, PartialEq)]
pub struct JointState<'a> {
    /// Stamp and frame.
    pub header: Header<'a>,
    /// Names, one a joint, or none.
    pub names: Vec<&'a str>,
    /// Radians or metres, one a name; NaN where a joint has no sensor.
    pub positions: Vec<f64>,
}

/// `geometry_msgs/TransformStamped`: `parent_from_child`.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformStamped {
    /// Frame of the parent.
    pub parent: String,
    /// Frame of the child.
    pub child: String,
    /// Metres.
    pub parent_from_child: Isometry3<f64>,
}

/// `geometry_msgs/Transform`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransformMessage(pub Isometry3<f64>);

/// `std_msgs/Float32`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Float32(pub f32);

fn parsed<'a, T>(
    topic: &str,
    format: WireFormat,
    bytes: &'a [u8],
    parse: impl FnOnce(&mut Wire<'a>) -> Result<T, WireProblem>,
) -> Result<T, RecordingError> {
    Wire::new(format, bytes)
        .and_then(|mut wire| parse(&mut wire))
        .map_err(|problem| RecordingError::message(topic, problem))
}

impl<'a> Header<'a> {
    /// Parses the header of any message that has one, from its first bytes. `topic` appears in errors, here and below.
    pub fn parse(topic: &str, format: WireFormat, bytes: &'a [u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, header)
    }
}

fn image_head<'a>(wire: &mut Wire<'a>) -> Result<ImageHead<'a>, WireProblem> {
    let header = header(wire)?;
    let (height, width) = (wire.u32()?, wire.u32()?);
    Ok(ImageHead { header, width, height, encoding: wire.string()? })
}

fn compressed_head<'a>(wire: &mut Wire<'a>) -> Result<ImageHead<'a>, WireProblem> {
    Ok(ImageHead { header: header(wire)?, width: 0, height: 0, encoding: wire.string()? })
}

impl<'a> ImageHead<'a> {
    /// Parses the first bytes of an `Image` or a `CompressedImage`.
    pub fn parse(kind: MessageKind, topic: &str, format: WireFormat, bytes: &'a [u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| match kind {
            MessageKind::Image => image_head(wire),
            MessageKind::CompressedImage => compressed_head(wire),
            _ => Err(format!("{kind:?} is no image")),
        })
    }
}

impl<'a> Image<'a> {
    /// Parses a whole message.
    pub fn parse(topic: &str, format: WireFormat, bytes: &'a [u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| {
            let head = image_head(wire)?;
            let big_endian = wire.u8()? != 0;
            let step = wire.u32()?;
            let data = wire.byte_sequence()?;
            let depth_unit_m = if wire.is_ros1() && wire.rest().len() == 4 { Some(wire.f32()?) } else { None };
            Ok(Image { head, big_endian, step, data, depth_unit_m })
        })
    }
}

impl<'a> CompressedImage<'a> {
    /// Parses a whole message.
    pub fn parse(topic: &str, format: WireFormat, bytes: &'a [u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| {
            Ok(CompressedImage { head: compressed_head(wire)?, data: wire.byte_sequence()? })
        })
    }
}

impl CameraInfo {
    /// Parses a whole message.
    pub fn parse(topic: &str, format: WireFormat, bytes: &[u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| {
            let frame_id = header(wire)?.frame_id.to_owned();
            let (height, width) = (wire.u32()?, wire.u32()?);
            let distortion_model = wire.string()?.to_owned();
            let distortion = wire.f64s()?;
            let matrix = wire.f64_array::<9>()?;
            wire.f64_array::<9>()?;
            let projection = wire.f64_array::<12>()?;
            Ok(CameraInfo { frame_id, width, height, distortion_model, distortion, matrix, projection })
        })
    }
}

impl<'a> JointState<'a> {
    /// Parses a whole message.
    ///
    /// Positions may be NaN: a wheel without a sensor says so, and matters to nobody. Names may be missing altogether.
    ///
    /// # Errors
    /// Also where names and positions differ in number.
    pub fn parse(topic: &str, format: WireFormat, bytes: &'a [u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| {
            let header = header(wire)?;
            let names = wire.strings()?;
            let positions = wire.f64s()?;
            if names.len() != positions.len() && !positions.is_empty() && !names.is_empty() {
                return Err(format!("{} joint names, but {} positions", names.len(), positions.len()));
            }
            Ok(JointState { header, names, positions })
        })
    }
}

fn rigid([x, y, z, qx, qy, qz, qw]: [f64; 7]) -> Result<Isometry3<f64>, WireProblem> {
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    let norm = quaternion.norm();
    if !(x.is_finite() && y.is_finite() && z.is_finite() && (norm - 1.0).abs() < 1e-2) {
        return Err(format!("the transform ({x}, {y}, {z}), ({qx}, {qy}, {qz}, {qw}) is no rigid one"));
    }
    Ok(Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(quaternion)))
}

/// Parses a `TFMessage`. A transform that is no rigid one is left out: it says nothing, and the others are right.
pub fn parse_tf_message(
    topic: &str,
    format: WireFormat,
    bytes: &[u8],
) -> Result<Vec<TransformStamped>, RecordingError> {
    parsed(topic, format, bytes, |wire| {
        // Header, child frame and seven numbers.
        let count = wire.count(72)?;
        let mut transforms = Vec::new();
        for _ in 0..count {
            let parent = header(wire)?.frame_id.to_owned();
            let child = wire.string()?.to_owned();
            if let Ok(parent_from_child) = rigid(wire.f64_array::<7>()?) {
                transforms.push(TransformStamped { parent, child, parent_from_child });
            }
        }
        Ok(transforms)
    })
}

impl TransformMessage {
    /// Parses a whole message.
    pub fn parse(topic: &str, format: WireFormat, bytes: &[u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| rigid(wire.f64_array::<7>()?).map(TransformMessage))
    }
}

impl Float32 {
    /// Parses a whole message.
    pub fn parse(topic: &str, format: WireFormat, bytes: &[u8]) -> Result<Self, RecordingError> {
        parsed(topic, format, bytes, |wire| wire.f32().map(Float32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint state as ROS 1 lays it out.
    fn joint_state(names: &[&str], positions: &[f64]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for number in [1u32, 10, 5, 0, names.len() as u32] {
            bytes.extend(number.to_le_bytes());
        }
        for name in names {
            bytes.extend((name.len() as u32).to_le_bytes());
            bytes.extend(name.as_bytes());
        }
        bytes.extend((positions.len() as u32).to_le_bytes());
        positions.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
        bytes
    }

    #[test]
    fn joint_states_come_with_their_names() {
        let bytes = joint_state(&["b", "a"], &[1.5, -2.0]);
        let state = JointState::parse("/j", WireFormat::Ros1, &bytes).unwrap();
        assert_eq!(
            (state.header.stamp, state.names, state.positions),
            (10_000_000_005, vec!["b", "a"], vec![1.5, -2.0])
        );
        let message = |names: &[&str], positions: &[f64]| {
            JointState::parse("/j", WireFormat::Ros1, &joint_state(names, positions)).unwrap_err().to_string()
        };
        assert_eq!(message(&["a"], &[1.0, 2.0]), "topic /j: 1 joint names, but 2 positions");
        let nameless = joint_state(&[], &[1.0, f64::NAN]);
        let nameless = JointState::parse("/j", WireFormat::Ros1, &nameless).unwrap();
        assert!(nameless.names.is_empty() && nameless.positions[1].is_nan());
    }

    #[test]
    fn every_prefix_of_a_message_is_an_error_and_no_panic() {
        let bytes = joint_state(&["b", "a"], &[1.5, -2.0]);
        for end in 0..bytes.len() {
            assert!(JointState::parse("/j", WireFormat::Ros1, &bytes[..end]).is_err());
            for kind in [MessageKind::Image, MessageKind::CompressedImage] {
                // What is read is no image; nothing but an answer is asked for.
                let _ = ImageHead::parse(kind, "/i", WireFormat::Cdr, &bytes[..end]);
            }
            let _ = CameraInfo::parse("/c", WireFormat::Ros1, &bytes[..end]);
            let _ = parse_tf_message("/tf", WireFormat::Ros1, &bytes[..end]);
        }
    }

    #[test]
    fn kinds_are_known_by_either_name() {
        assert_eq!(MessageKind::of("sensor_msgs/msg/Image"), MessageKind::Image);
        assert_eq!(MessageKind::of("sensor_msgs/Image"), MessageKind::Image);
        assert_eq!(MessageKind::of("std_msgs/String"), MessageKind::Other);
    }
}
