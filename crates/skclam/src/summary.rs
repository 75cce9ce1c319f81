//! `summary.json`: every number of a run that a person or a script may want. Units are in the names.

use crate::pipeline::{
    BoardSummary, Cause, CheckResult, Config, DepthConsistencySummary, EgoMaskSummary, Evidence, HeldOutSummary,
    MapCoverage, MatchedPair, PoseSigmaSummary, Scale, Status, TrackSummary, VerdictCase,
};
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    Calibration, EpipolarStatistics, ParameterEstimate, ReprojectionStatistics, Termination, Unit, UnobservableCause,
    UnobservableDirection,
};
use skclam_features::MatchCounts;

/// Version of `summary.json`. It rises when a key changes its name or its meaning, or is taken away; a new key leaves
/// it as it is. `schema/summary.schema.json` of this crate describes it.
pub const SCHEMA_VERSION: u32 = 2;

fn unversioned() -> u32 {
    1
}

/// What a run found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// "skclam".
    pub program: String,
    /// Version of the program.
    pub version: String,
    /// Version of the keys and their meaning: [`SCHEMA_VERSION`]. Summaries without it are of version 1.
    #[serde(default = "unversioned")]
    pub schema_version: u32,
    /// The verdict in one sentence.
    pub verdict: String,
    /// The worst that any of the checks calls for.
    pub status: Status,
    /// The case of the verdict.
    pub case: VerdictCase,
    /// The numbers that it follows from.
    pub evidence: Evidence,
    /// What does not fit, by name, the likeliest first.
    pub causes: Vec<Cause>,
    /// The checks, worst first.
    pub checks: Vec<CheckResult>,
    /// Where lengths come from.
    pub scale: Scale,
    /// The rig's name.
    pub rig: String,
    /// What came in.
    pub counts: Counts,
    /// What each filter left, summed over all pairs.
    pub matching: MatchCounts,
    /// What each filter left, pair by pair.
    pub pairs: Vec<PairSummary>,
    /// Keypoints of each image.
    pub keypoints: Vec<usize>,
    /// What moves with the camera; `null` where it was not looked for.
    pub ego_mask: Option<EgoMaskSummary>,
    /// How tracks were built; `null` for pairs alone.
    pub tracks: Option<TrackSummary>,
    /// The board; `null` where the rig has none.
    pub board: Option<BoardSummary>,
    /// Residuals and parameters.
    pub calibration: CalibrationSummary,
    /// Residuals on postures that the fit did not see; `null` where that could not be measured, see the warnings.
    pub held_out: Option<HeldOutSummary>,
    /// What is known of flange and camera at the recorded postures.
    pub recorded_poses: Option<PoseSigmaSummary>,
    /// The same over the workspace; `null` for flange poses.
    pub workspace_poses: Option<PoseSigmaSummary>,
    /// The map; `null` without depth.
    pub map: Option<MapSummary>,
    /// What a user should know.
    pub warnings: Vec<String>,
    /// The settings in force: they are a valid `--config` file.
    pub configuration: Config,
    /// Wall and CPU seconds of each stage; filled in by the program that owns the clock.
    pub stages: Vec<StageSeconds>,
    /// Largest resident memory, MiB; filled in by the program.
    pub peak_memory_mib: Option<f64>,
}

/// What came in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Postures.
    pub postures: usize,
    /// Postures with a depth image.
    pub depth_images: usize,
    /// Image pairs that were matched.
    pub pairs: usize,
    /// Matches that reached the estimator.
    pub matches: usize,
    /// Points followed over several images.
    pub tracks: usize,
    /// Their observations.
    pub observations: usize,
}

/// One image pair.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairSummary {
    /// The recording's index of the first posture.
    pub a: u64,
    /// The recording's index of the second posture.
    pub b: u64,
    /// Overlap predicted by the nominal rig, 0 to 1.
    pub predicted_overlap: f64,
    /// What each filter left.
    pub counts: MatchCounts,
}

/// Residuals and parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationSummary {
    /// Whether the arm could be calibrated; with flange poses alone it cannot.
    pub arm: bool,
    /// Epipolar distances of the matches under the nominal rig.
    pub epipolar_before: EpipolarStatistics,
    /// The same under the calibrated rig.
    pub epipolar_after: EpipolarStatistics,
    /// Reprojection under the nominal rig.
    pub reprojection_before: Option<ReprojectionStatistics>,
    /// The same under the calibrated rig.
    pub reprojection_after: Option<ReprojectionStatistics>,
    /// Each free parameter.
    pub parameters: Vec<ParameterSummary>,
    /// Number of free parameters.
    pub free: usize,
    /// How many combinations of them are identifiable; `null` for Nelder-Mead.
    pub rank: Option<usize>,
    /// Greatest over smallest singular value of what is identifiable.
    pub condition_number: Option<f64>,
    /// Observability indices O1 to O5.
    pub observability: Option<[f64; 5]>,
    /// What is not identifiable, and why.
    pub not_identifiable: Vec<NotIdentifiable>,
    /// By how much pixels scatter more than their own sigmas say; px where these are 1 (board corners, features that
    /// were not refined).
    pub pixel_sigma: f64,
    /// `s` of the depth noise `s z^2`, 1/m.
    pub depth_sigma_per_m2: Option<f64>,
    /// Sigma of the joint error per posture, degrees.
    pub joint_error_sigma_deg: Option<f64>,
    /// Part of the correspondences that do not fit.
    pub outlier_fraction: f64,
    /// How the solver ended.
    pub termination: Termination,
    /// The same in words.
    pub ended: String,
}

/// One free parameter in the units of the rig's file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterSummary {
    /// "alpha_2".
    pub name: String,
    /// "deg", "mm", "px", "s", "deg/m" or "" (no unit).
    pub unit: String,
    /// Nominal value.
    pub nominal: f64,
    /// Calibrated value.
    pub calibrated: f64,
    /// Standard deviation; `null` where the data do not contribute, or the estimator has none.
    pub sigma: Option<f64>,
    /// Why there is no sigma.
    pub note: Option<String>,
}

/// The map.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapSummary {
    /// Points of map.ply.
    pub points: usize,
    /// Point-to-plane distance between overlapping depth images at the nominal poses.
    pub depth_consistency_nominal: Option<DepthConsistencySummary>,
    /// The same at the calibrated poses.
    pub depth_consistency_calibrated: Option<DepthConsistencySummary>,
    /// How much was observed, at the calibrated poses.
    pub coverage: Option<MapCoverage>,
}

/// How long a stage took.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StageSeconds {
    /// The stage.
    pub stage: String,
    /// Images, pairs, ...
    pub steps: u64,
    /// Wall-clock seconds.
    pub wall_s: f64,
    /// CPU seconds over all threads.
    pub cpu_s: f64,
}

/// What a unit inside the program is in the unit of files and screens, and that unit's name.
pub fn file_unit(unit: Unit) -> (f64, &'static str) {
    let degree = 1f64.to_degrees();
    match unit {
        Unit::Radian => (degree, "deg"),
        Unit::Metre => (1e3, "mm"),
        Unit::Pixel => (1.0, "px"),
        Unit::One => (1.0, ""),
        Unit::Second => (1.0, "s"),
        Unit::RadianPerMetre => (degree, "deg/m"),
    }
}

impl ParameterSummary {
    fn of(estimate: &ParameterEstimate) -> Self {
        let (factor, unit) = file_unit(estimate.parameter.unit());
        ParameterSummary {
            name: estimate.parameter.to_string(),
            unit: unit.to_owned(),
            nominal: estimate.nominal * factor,
            calibrated: estimate.value * factor,
            sigma: estimate.sigma.map(|sigma| sigma * factor),
            note: estimate.note.clone(),
        }
    }
}

/// A combination of parameters that the data do not determine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotIdentifiable {
    /// Why.
    pub cause: UnobservableCause,
    /// Which parameters, and why, in words.
    pub text: String,
}

impl NotIdentifiable {
    fn of(direction: &UnobservableDirection) -> Self {
        NotIdentifiable { cause: direction.cause, text: direction.reason.clone() }
    }
}

impl CalibrationSummary {
    /// Of a calibration.
    pub fn of(calibration: &Calibration, arm: bool) -> Self {
        let identifiability = calibration.identifiability.as_ref();
        CalibrationSummary {
            arm,
            epipolar_before: calibration.epipolar_before,
            epipolar_after: calibration.epipolar_after,
            reprojection_before: calibration.reprojection_before,
            reprojection_after: calibration.reprojection_after,
            parameters: calibration.parameters.iter().map(ParameterSummary::of).collect(),
            free: calibration.parameters.len(),
            rank: identifiability.map(|found| found.rank),
            condition_number: identifiability.map(|found| found.condition_number).filter(|number| number.is_finite()),
            observability: identifiability.map(|found| found.observability),
            not_identifiable: identifiability
                .map(|found| found.unobservable.iter().map(NotIdentifiable::of).collect())
                .unwrap_or_default(),
            pixel_sigma: calibration.noise.pixel,
            depth_sigma_per_m2: calibration.noise.depth_sigma_per_m2,
            joint_error_sigma_deg: calibration.noise.posture_angular.map(f64::to_degrees),
            outlier_fraction: calibration.noise.outlier_fraction,
            termination: calibration.termination,
            ended: calibration.termination.reason.to_string(),
        }
    }
}

/// Sums the counts of all pairs; a step that no pair took stays `None`.
pub fn total_counts(pairs: &[MatchedPair]) -> MatchCounts {
    let add = |sum: &mut Option<usize>, one: Option<usize>| {
        if let Some(one) = one {
            *sum = Some(sum.unwrap_or(0) + one);
        }
    };
    pairs.iter().fold(MatchCounts::default(), |mut sum, pair| {
        let one = &pair.counts;
        sum.keypoints_a += one.keypoints_a;
        sum.keypoints_b += one.keypoints_b;
        sum.candidates += one.candidates;
        add(&mut sum.after_max_distance, one.after_max_distance);
        add(&mut sum.after_ratio, one.after_ratio);
        add(&mut sum.after_gate, one.after_gate);
        add(&mut sum.after_cross_check, one.after_cross_check);
        add(&mut sum.after_best, one.after_best);
        add(&mut sum.after_ransac, one.after_ransac);
        sum
    })
}
