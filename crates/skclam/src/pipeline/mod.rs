//! The spine: one run from images and joints to a calibrated rig and a map.

mod agreement;
mod boards;
mod calibrate;
mod camera_fixed;
mod config;
mod coverage;
mod error;
mod features;
mod gather;
mod held_out;
mod hypotheses;
mod judgement;
mod map;
mod map_files;
mod matches;
mod mount;
mod pairing;
mod pose_sigmas;
mod registered_depth;
mod run;
mod scale;
mod sightings;
mod validate;
mod verdict;

pub use agreement::{Agreement, AgreementSample, SurfaceAgreement, surface_agreement};
pub(crate) use boards::board_alone;
pub use boards::{BoardSummary, board_layout, find_boards};
pub use calibrate::calibrate;
pub use camera_fixed::{CameraFixedSummary, drop_camera_fixed};
pub use config::{BoardUse, Config, Estimator};
pub use coverage::{MapCoverage, map_coverage};
pub use error::RunError;
pub use features::{ImageFeatures, extract_features};
pub use held_out::{FoldSummary, HeldOutOptions, HeldOutSummary, hold_out};
pub use hypotheses::{
    DepthShift, GrossCause, GrossFinding, describe, describe_depth_shift, find_depth_shift, find_gross_cause,
};
pub use judgement::{Reason, judge, worst};
pub use map::{build_maps, for_each_posture, for_each_view, localize, voxel_m};
pub use map_files::{MapFile, MapFilesSummary, write_map_files};
pub use matches::{MatchedPair, Search, match_pairs, pairs_to_match};
pub use mount::{FoundMount, find_mount};
pub use pairing::{ImagePair, Pairing, PairingOptions, PredictedView, choose_pairs};
pub(crate) use pairing::{assumed_points, measured_points, shown_to};
pub use pose_sigmas::{PoseSigma, PoseSigmaSummary, PostureSource, pose_sigmas};
pub use registered_depth::RegisteredDepth;
pub use run::{Maps, Outcome, run, run_without_map, write_cloud};
pub use scale::{Scale, ScaleSource};
pub use sightings::{TrackSummary, correspondences};
pub use validate::{Validation, validate};
pub use verdict::{Verdict, VerdictGrade};
