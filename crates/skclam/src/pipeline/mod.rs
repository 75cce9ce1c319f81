//! The spine: one run from images and joints to a calibrated rig and a map.

mod agreement;
mod calibrate;
mod camera_fixed;
mod config;
mod error;
mod features;
mod gather;
mod held_out;
mod map;
mod map_files;
mod matches;
mod pairing;
mod pose_sigmas;
mod registered_depth;
mod run;
mod sightings;
mod validate;
mod verdict;

pub use agreement::{Agreement, AgreementSample, SurfaceAgreement, surface_agreement};
pub use calibrate::calibrate;
pub use camera_fixed::{CameraFixedSummary, drop_camera_fixed};
pub use config::{Config, Estimator};
pub use error::RunError;
pub use features::{ImageFeatures, extract_features};
pub use held_out::{FoldSummary, HeldOutOptions, HeldOutSummary, hold_out};
pub use map::{build_maps, for_each_view, localize, voxel_m};
pub use map_files::{MapFile, MapFilesSummary, write_map_files};
pub use matches::{MatchedPair, Search, match_pairs, pairs_to_match};
pub use pairing::{ImagePair, Pairing, PairingOptions, PredictedView, choose_pairs};
pub use pose_sigmas::{PoseSigma, PoseSigmaSummary, PostureSource, pose_sigmas};
pub use registered_depth::RegisteredDepth;
pub use run::{Maps, Outcome, run, run_without_map, write_cloud};
pub use sightings::{TrackSummary, correspondences};
pub use validate::{Validation, validate};
pub use verdict::{ScaleSource, Verdict, VerdictGrade};
