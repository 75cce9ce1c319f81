//! Recordings of robots as a stream of images, joints and cameras, and which of them are postures.
//!
//! Read are ROS 1 `.bag` (none, lz4, bz2; those of the RealSense Viewer too), ROS 2 `.mcap` (none, lz4, zstd) and
//! `.db3`, and folders in the layout of the TUM RGB-D benchmark. Begin with [`Recording::open`], then
//! [`Recording::scan`]; [`plan_postures`] says which images are worth decoding.
//!
//! Everything is read as a stream in memory that does not grow with the recording, and no length that a file claims
//! is trusted before the bytes are there: what is damaged is an error with its place, never a giant allocation. The
//! published readers of these formats map whole files into memory or allocate what a length field says, hence ours.
//!
//! This crate knows joints by name and cameras by their intrinsics. It knows no estimator, no features and no map.
//!
#![doc = include_str!("../README.md")]

mod bag;
mod budget;
mod bytes;
mod camera;
mod database;
mod error;
mod joint_merge;
mod joint_series;
mod joints;
mod jumps;
mod mcap;
mod messages;
mod opening;
mod pairing;
mod pixels;
mod recording;
mod sharpness;
mod stationary;
mod survey;
mod tum;
mod unpacked;
mod wire;

pub use camera::pinhole_from_info;
pub use error::RecordingError;
pub use joint_merge::{FoundJumps, Merged};
pub use joint_series::{Clock, JointCollector, JointPlace, JointSeries, TopicJoints};
pub use joints::{JointNames, JointTrack, interpolated};
pub use messages::{
    CameraInfo, CompressedImage, Float32, Header, Image, ImageHead, JointState, MessageKind, Stamp, TransformMessage,
    TransformStamped, parse_tf_message,
};
pub use pairing::{Candidate, ImageStamp, PlannedPosture, PosturePlan, Selection, SelectionOptions, plan_postures};
pub use pixels::{ColorPixels, DepthPixels, FLOAT_DEPTH_UNIT_M};
pub use recording::{Message, Place, Recording, RecordingFormat, Topic, Wanted};
pub use sharpness::{Exposure, exposure, sharpness};
pub use stationary::{StationaryInterval, find_stationary_intervals};
pub use survey::{ClockJump, Survey, TopicSurvey, survey};
pub use wire::WireFormat;

/// Bytes of one message at most: an image of 8192 x 5461 pixels in `rgb8`.
pub const MAX_MESSAGE_BYTES: u64 = 128 << 20;
