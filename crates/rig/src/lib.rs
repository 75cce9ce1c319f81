//! A robot, its camera mount and its cameras as one value and as one file; postures.
//!
//! "The rig" is [`Rig`]: the nominal one that comes in, the true one of a simulation, the
//! calibrated one that goes out. This crate knows no image content, no estimator and no scene.
//!
#![doc = include_str!("../README.md")]

mod board;
mod builtin;
mod corrections_table;
mod file;
mod joint_corrections;
mod posture;
mod prior;
mod rig;

pub use board::{Board, BoardPattern};
pub use builtin::{builtin_names, builtin_rig};
pub use file::{RigFileError, RobotDescription};
pub use joint_corrections::{JointCorrection, JointCorrections, JointReading, fill_joint_rates, joint_readings};
pub use posture::{Posture, PostureState};
pub use prior::Prior;
pub use rig::{Rig, RigError};
