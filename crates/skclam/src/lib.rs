//! Simultaneous kinematic calibration, localization and mapping: datasets, the pipeline, evaluation.
//!
//! Begin with [`pipeline::run`]: a [`dataset::Dataset`] and a [`pipeline::Config`] in, a [`pipeline::Outcome`] out. The
//! crates below it are re-exported: [`geometry`], [`kinematics`], [`rig`], [`features`], [`calibration`], [`mapping`],
//! [`simulation`] and [`recordings`].
//!
#![doc = include_str!("../README.md")]

pub mod camera_frames;
pub mod compensation;
pub mod dataset;
pub mod evaluation;
pub mod export;
pub mod import;
pub mod inspection;
pub mod marker_points;
pub mod output;
pub mod pipeline;
pub mod progress;
pub mod report_data;
pub mod reproduction;
pub mod result_recording;
pub mod robot_recording;
pub mod summary;
pub mod surface_evaluation;
pub mod trajectory;
pub mod virtual_cell;

pub use skclam_calibration as calibration;
pub use skclam_features as features;
pub use skclam_geometry as geometry;
pub use skclam_kinematics as kinematics;
pub use skclam_mapping as mapping;
pub use skclam_recordings as recordings;
pub use skclam_rig as rig;
pub use skclam_simulation as simulation;
