//! The spine: one run from images and joints to a calibrated rig and a map.

mod boards;
mod calibrate;
mod causes;
mod config;
mod coverage;
mod depth_consistency;
mod ego_mask;
mod error;
mod features;
mod front_end;
mod held_out;
mod hypotheses;
mod judgement;
mod map;
mod map_files;
mod matches;
mod mount;
mod observations;
mod pairing;
mod plane_warp;
mod pose_sigmas;
mod registered_depth;
mod run;
mod scale;
mod sentences;
mod validate;
mod verdict;

pub(crate) use boards::board_alone;
pub use boards::{BoardSummary, board_layout, find_boards};
pub use calibrate::calibrate;
pub use causes::{Cause, Instrument, causes};
pub use config::{BoardUse, Config, Estimator};
pub use coverage::{MapCoverage, map_coverage};
pub use depth_consistency::{
    DepthConsistencySummary, MeasuredConsistency, PointToPlaneSample, measure_depth_consistency,
};
pub use ego_mask::{EgoMaskSummary, drop_ego_masked};
pub use error::RunError;
pub use features::{ImageFeatures, extract_features};
pub use held_out::{FoldSummary, HeldOutOptions, HeldOutSummary, hold_out};
pub use hypotheses::{
    DepthShift, GrossCause, GrossFinding, describe, describe_depth_shift, find_depth_shift, find_gross_cause,
};
pub use judgement::{Check, CheckResult, judge, worst};
pub use map::{build_maps, for_each_posture, for_each_view, localize, voxel_m};
pub use map_files::{MapFile, MapFilesSummary, write_map_files};
pub use matches::{MatchedPair, Search, match_pairs, pairs_to_match};
pub use mount::{FoundMount, find_mount};
pub use observations::{TrackSummary, correspondences};
pub use pairing::{ImagePair, Pairing, PairingOptions, PredictedView, choose_pairs};
pub(crate) use pairing::{assumed_points, measured_points, shown_to};
pub use plane_warp::PlaneWarp;
pub use pose_sigmas::{PoseSigma, PoseSigmaSummary, PoseSigmas, PostureSource, RegisteredError, pose_sigmas};
pub use registered_depth::{DepthSample, RegisteredDepth};
pub use run::{Maps, Outcome, run, run_without_map, write_cloud};
pub use scale::{RulerSummary, Scale, ScaleSource};
pub use sentences::{cause_text, check_text, verdict_sentence};
pub use validate::{PostureMetric, Validation, ValidationCase, validate};
pub use verdict::{Evidence, Status, VerdictCase};
