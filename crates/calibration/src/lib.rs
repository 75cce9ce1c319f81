//! From correspondences and a nominal rig to a calibrated rig with its covariance.
//!
//! Three estimators of the same [`Model`], from the paper's own to the one that reaches the Cramer-Rao bound. All of
//! them free an explicit, ordered list of [`Parameter`]s, say how they ended ([`Termination`]) and what the data
//! cannot tell. This crate knows pixels, postures and rigs; it knows no images, no files, no map and no simulation.

mod correspondences;
mod error;
mod free;
mod model;
mod parameter;
mod termination;
mod warning;

pub use correspondences::{
    BoardObservation, Correspondences, PairMatch, PairMatches, Track, TrackObservation, isotropic_covariance,
};
pub use error::CalibrationError;
pub use free::{Free, ParseFreeError};
pub use model::{DepthCorrection, JointCorrection, Model};
pub use parameter::{Intrinsic, MountComponent, Parameter, ParseParameterError, Unit};
pub use termination::{StopReason, Termination};
pub use warning::Warning;

#[cfg(test)]
#[path = "../testing/synthetic.rs"]
mod synthetic;
