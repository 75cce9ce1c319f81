//! From correspondences and a nominal rig to a calibrated rig with its covariance.
//!
//! Three estimators of the same [`Model`], from the paper's own to the one that reaches the Cramer-Rao bound. All of
//! them free an explicit, ordered list of [`Parameter`]s, say how they ended ([`Termination`]) and what the data do not
//! determine. This crate knows pixels, postures and rigs; it knows no images, no files, no map and no simulation.
//!
#![doc = include_str!("../README.md")]

mod board;
mod bundle;
mod camera_kinematics;
mod correspondences;
mod epipolar_residuals;
mod error;
mod error_function;
mod free;
mod held_out;
mod identifiability;
mod levenberg_marquardt;
mod model;
mod mount_search;
mod nelder_mead;
mod outcome;
mod pairwise;
mod pairwise_system;
mod parameter;
mod pose_covariance;
mod prior;
mod reprojection_residuals;
mod robust;
mod sampson;
mod termination;
mod uncertainty;
mod warning;

pub use board::{
    BoardFold, BoardPlace, base_from_board, board_residuals, color_from_board, cross_validate_board, fit_mount_to_board,
};
pub use bundle::{
    BundleOptions, ErrorKind, ErrorPattern, ExpectationOptions, ExpectedCalibration, PatternFinding,
    PostureErrorPolicy, RulerPolicy, calibrate_bundle, expected_calibration,
};
pub use correspondences::{
    BoardObservation, Correspondences, PairMatch, PairMatches, Track, TrackObservation, isotropic_covariance,
};
pub use epipolar_residuals::{EpipolarResidual, camera_poses, epipolar_residuals};
pub use error::CalibrationError;
pub use error_function::{EpipolarStatistics, epipolar_statistics};
pub use free::{Free, ParseFreeError};
pub use held_out::{
    Comparison, CrossValidation, Estimate, Fold, Jackknife, RecordingComparison, Rigs, Trained, arm_positions,
    compare_on_recording, compare_trained, cross_validate, held_out_groups, jackknife, neighbouring_folds,
    without_postures,
};
pub use identifiability::{Identifiability, RANK_THRESHOLD, UnobservableCause, UnobservableDirection};
pub use model::{DepthCorrection, Model};
pub use mount_search::find_mount;
pub use nelder_mead::{NelderMeadOptions, calibrate_nelder_mead};
pub use outcome::{
    Calibration, Noise, ParameterEstimate, PostureErrorKnowledge, PostureFit, PriorScale, ReprojectionStatistics, Ruler,
};
pub use pairwise::{PairwiseOptions, Search, calibrate_pairwise, calibrate_pairwise_from};
pub use parameter::{Intrinsic, MountComponent, Parameter, ParseParameterError, Unit};
pub use pose_covariance::{
    AlignedPositions, PoseCovariance, aligned_positions, orientation_sigma_rad, pose_covariances, position_sigma_m,
};
pub use prior::{PriorGroup, PriorPolicy, default_sigma, stated_sigma};
pub use reprojection_residuals::{ReprojectionResidual, reprojection_residuals};
pub use robust::Loss;
pub use termination::{StopReason, Termination};
pub use warning::Warning;

#[cfg(test)]
#[path = "../testing/synthetic.rs"]
mod synthetic;
