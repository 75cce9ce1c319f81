//! A data set as the robot would have recorded it: an MCAP of ROS 2 messages (CDR), to practise `import` and to test
//! it.
//!
//! The arm drives from posture to posture and stands still at each; joint states come all the while, one colour and one
//! depth image at each rest, with their `CameraInfo` and the static transform between the two cameras.

use crate::dataset::{Dataset, DatasetError};
use crate::progress::{Progress, Stage};
use image::ImageFormat;
use mcap::WriteOptions;
use mcap::records::MessageHeader;
use skclam_geometry::{Isometry3, PinholeCamera};
use skclam_rig::PostureState;
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// Why no recording was written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RobotRecordingError {
    /// The data set.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The file.
    #[error("recording: {0}")]
    Mcap(#[from] mcap::McapError),
    /// Flange poses have no joint states.
    #[error("posture {index} has no joint values; a recording of a robot needs them")]
    NoJoints {
        /// The posture's index.
        index: u64,
    },
    /// The user asked to stop.
    #[error("interrupted; nothing was written")]
    Interrupted,
}

/// Seconds between two joint states.
const JOINT_PERIOD_S: f64 = 0.02;
/// Seconds at rest, and of the drive to the next.
const REST_S: f64 = 2.0;
const DRIVE_S: f64 = 1.0;
/// When the images are taken, after the rest began.
const IMAGE_AFTER_S: f64 = 1.2;
/// The recording begins here, so that no stamp is zero.
const START_S: f64 = 1000.0;

const COLOR_FRAME: &str = "camera_color_optical_frame";
const DEPTH_FRAME: &str = "camera_depth_optical_frame";

/// Writes the recording; the colour images as their files are (JPEG, PNG), the depth as 16-bit millimetres.
pub fn write_robot_recording(
    dataset: &Dataset,
    out: impl Write + Seek,
    progress: &dyn Progress,
) -> Result<(), RobotRecordingError> {
    progress.begin(Stage::Record, dataset.len() as u64);
    let joints = dataset
        .records
        .iter()
        .map(|record| match &record.posture.state {
            PostureState::Joints(values) => Ok(values.as_slice()),
            PostureState::FlangePose(_) => Err(RobotRecordingError::NoJoints { index: record.posture.index }),
        })
        .collect::<Result<Vec<_>, _>>()?;
    let names: Vec<&str> =
        dataset.rig.robot.iter().flat_map(|robot| robot.joints().iter().map(|joint| joint.name.as_str())).collect();
    let mut file = Recorder::new(out)?;
    if let Some(depth) = &dataset.rig.depth {
        file.write("/tf_static", START_S, TF_MESSAGE, &static_transform(&depth.color_from_depth))?;
    }
    for (at, here) in joints.iter().enumerate() {
        if progress.stop_requested() {
            return Err(RobotRecordingError::Interrupted);
        }
        let begin = START_S + at as f64 * (REST_S + DRIVE_S);
        let next = joints.get(at + 1);
        let until = REST_S + if next.is_some() { DRIVE_S } else { 0.0 };
        let mut images_taken = false;
        for step in 0..(until / JOINT_PERIOD_S).round() as usize {
            let after = step as f64 * JOINT_PERIOD_S;
            if after >= IMAGE_AFTER_S && !images_taken {
                images(&mut file, dataset, at, begin + IMAGE_AFTER_S)?;
                images_taken = true;
            }
            let fraction = ((after - REST_S) / DRIVE_S).max(0.0);
            let values: Vec<f64> = match next {
                Some(next) if fraction > 0.0 => here.iter().zip(*next).map(|(a, b)| a + fraction * (b - a)).collect(),
                _ => here.to_vec(),
            };
            file.write("/joint_states", begin + after, JOINT_STATE, &joint_state(begin + after, &names, &values))?;
        }
        progress.step();
    }
    file.mcap.finish()?;
    Ok(())
}

fn images<W: Write + Seek>(
    file: &mut Recorder<W>,
    dataset: &Dataset,
    at: usize,
    time_s: f64,
) -> Result<(), RobotRecordingError> {
    let (format, bytes) = dataset.color_file(at)?;
    let format = if format == ImageFormat::Png { "rgb8; png compressed" } else { "rgb8; jpeg compressed bgr8" };
    let mut message = Cdr::header(time_s, COLOR_FRAME);
    message.string(format);
    message.sequence(&bytes);
    file.write("/camera/color/image_raw/compressed", time_s, COMPRESSED_IMAGE, &message.bytes)?;
    let info = camera_info(time_s, COLOR_FRAME, &dataset.rig.color);
    file.write("/camera/color/camera_info", time_s, CAMERA_INFO, &info)?;
    let (Some(depth), Some(camera)) = (dataset.depth(at)?, &dataset.rig.depth) else { return Ok(()) };
    let mut message = Cdr::header(time_s, DEPTH_FRAME);
    let (width, height) = (camera.camera.width, camera.camera.height);
    message.u32(height);
    message.u32(width);
    message.string("16UC1");
    message.bytes.push(0);
    message.u32(2 * width);
    let millimetres = depth.as_slice().iter().map(|&z| (f64::from(z) * 1e3).round().clamp(0.0, 65535.0) as u16);
    message.sequence(&millimetres.flat_map(u16::to_le_bytes).collect::<Vec<u8>>());
    file.write("/camera/depth/image_rect_raw", time_s, IMAGE, &message.bytes)?;
    file.write("/camera/depth/camera_info", time_s, CAMERA_INFO, &camera_info(time_s, DEPTH_FRAME, &camera.camera))?;
    Ok(())
}

fn joint_state(time_s: f64, names: &[&str], values: &[f64]) -> Vec<u8> {
    let mut message = Cdr::header(time_s, "");
    message.u32(names.len() as u32);
    names.iter().for_each(|name| message.string(name));
    message.f64s(values);
    // Neither velocities nor efforts.
    message.f64s(&[]);
    message.f64s(&[]);
    message.bytes
}

fn camera_info(time_s: f64, frame: &str, camera: &PinholeCamera) -> Vec<u8> {
    let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = camera.intrinsics();
    let mut message = Cdr::header(time_s, frame);
    message.u32(camera.height);
    message.u32(camera.width);
    message.string("plumb_bob");
    message.f64s(&[k1, k2, p1, p2, k3]);
    let k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
    let r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    k.iter().chain(&r).chain(&p).for_each(|&number| message.f64(number));
    // No binning, the whole image.
    (0..6).for_each(|_| message.u32(0));
    message.bytes.push(0);
    message.bytes
}

fn static_transform(color_from_depth: &Isometry3) -> Vec<u8> {
    let mut message = Cdr::new();
    message.u32(1);
    message.stamp(START_S);
    message.string(COLOR_FRAME);
    message.string(DEPTH_FRAME);
    let (t, q) = (color_from_depth.translation.vector, color_from_depth.rotation.coords);
    [t.x, t.y, t.z, q.x, q.y, q.z, q.w].into_iter().for_each(|number| message.f64(number));
    message.bytes
}

/// Plain little-endian CDR (OMG DDS-XTypes 7.4.1): every number is aligned to its size, counted from behind the header
/// of four bytes.
struct Cdr {
    bytes: Vec<u8>,
}

impl Cdr {
    const HEADER: usize = 4;

    fn new() -> Self {
        Cdr { bytes: vec![0, 1, 0, 0] }
    }

    fn header(time_s: f64, frame: &str) -> Self {
        let mut message = Cdr::new();
        message.stamp(time_s);
        message.string(frame);
        message
    }

    fn align(&mut self, size: usize) {
        while !(self.bytes.len() - Self::HEADER).is_multiple_of(size) {
            self.bytes.push(0);
        }
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend(value.to_le_bytes());
    }

    fn f64s(&mut self, values: &[f64]) {
        self.u32(values.len() as u32);
        values.iter().for_each(|&value| self.f64(value));
    }

    fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }

    fn sequence(&mut self, bytes: &[u8]) {
        self.u32(bytes.len() as u32);
        self.bytes.extend(bytes);
    }

    fn stamp(&mut self, time_s: f64) {
        let nanoseconds = nanoseconds(time_s);
        self.u32((nanoseconds / 1_000_000_000) as u32);
        self.u32((nanoseconds % 1_000_000_000) as u32);
    }
}

fn nanoseconds(time_s: f64) -> u64 {
    (time_s * 1e9).round() as u64
}

/// A message type: its name and its fields as ROS 2 writes them.
#[derive(Clone, Copy)]
struct MessageType {
    name: &'static str,
    fields: &'static str,
}

const HEADER_FIELDS: &str = "\n================================================================================\n\
    MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
const JOINT_STATE: MessageType = MessageType {
    name: "sensor_msgs/msg/JointState",
    fields: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
};
const COMPRESSED_IMAGE: MessageType = MessageType {
    name: "sensor_msgs/msg/CompressedImage",
    fields: "std_msgs/Header header\nstring format\nuint8[] data\n",
};
const IMAGE: MessageType = MessageType {
    name: "sensor_msgs/msg/Image",
    fields: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n",
};
const CAMERA_INFO: MessageType = MessageType {
    name: "sensor_msgs/msg/CameraInfo",
    fields: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n\
             float64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n\
             \n================================================================================\n\
             MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
};
const TF_MESSAGE: MessageType = MessageType {
    name: "tf2_msgs/msg/TFMessage",
    fields: "geometry_msgs/TransformStamped[] transforms\n\
             ================================================================================\n\
             MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n\
             ================================================================================\n\
             MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n\
             ================================================================================\n\
             MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n\
             ================================================================================\n\
             MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
};

struct Recorder<W: Write + Seek> {
    mcap: mcap::Writer<W>,
    /// By topic: the channel and the number of messages so far.
    channels: BTreeMap<&'static str, (u16, u32)>,
}

impl<W: Write + Seek> Recorder<W> {
    fn new(out: W) -> Result<Self, RobotRecordingError> {
        let options = WriteOptions::new()
            .profile("ros2")
            .compression(None)
            .library(concat!("skclam ", env!("CARGO_PKG_VERSION")));
        Ok(Recorder { mcap: options.create(out)?, channels: BTreeMap::new() })
    }

    fn write(
        &mut self,
        topic: &'static str,
        time_s: f64,
        message_type: MessageType,
        data: &[u8],
    ) -> Result<(), RobotRecordingError> {
        if !self.channels.contains_key(topic) {
            let definition = format!("{}{HEADER_FIELDS}", message_type.fields);
            let schema = self.mcap.add_schema(message_type.name, "ros2msg", definition.as_bytes())?;
            let channel = self.mcap.add_channel(schema, topic, "cdr", &BTreeMap::new())?;
            self.channels.insert(topic, (channel, 0));
        }
        if let Some((channel_id, sequence)) = self.channels.get_mut(topic) {
            let time = nanoseconds(time_s);
            let header =
                MessageHeader { channel_id: *channel_id, sequence: *sequence, log_time: time, publish_time: time };
            *sequence += 1;
            self.mcap.write_to_known_channel(&header, data)?;
        }
        Ok(())
    }
}
