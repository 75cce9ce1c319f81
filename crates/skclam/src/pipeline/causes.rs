//! What does not fit, by name: instruments beyond their tolerance, patterns of the posture errors, and noise that no
//! such device has.
//!
//! Nothing here is a guess from thresholds on residuals: each cause was estimated (an instrument's parameter, freed
//! within its tolerance) or score-tested (a pattern), and carries its value and twice the gain of the logarithm of the
//! likelihood, by which causes are ranked.

use super::{
    Config, DepthShift, Evidence, GrossFinding, ImageFeatures, RunError, Status, find_depth_shift, find_gross_cause,
};
use crate::dataset::Dataset;
use crate::progress::Progress;
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    Calibration, Correspondences, ErrorPattern, Intrinsic, MountComponent, Parameter, PatternFinding, Unit, Warning,
    arm_positions,
};
use skclam_rig::Posture;

/// A device, or a part of the rig, whose description can be wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Instrument {
    /// `fx`, `fy` of the colour camera.
    FocalLength,
    /// `cx`, `cy` of the colour camera.
    PrincipalPoint,
    /// Its distortion.
    Distortion,
    /// `unit_mm` of the depth camera.
    DepthScale,
    /// `offset_mm` of the depth camera.
    DepthOffset,
    /// `color_from_depth`.
    Extrinsics,
    /// `square_mm` of the board.
    BoardSquares,
    /// `[mount]`.
    Mount,
    /// A parameter of the arm.
    Arm,
    /// The clock of the joints.
    Clock,
}

/// One thing that does not fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Cause {
    /// A part of the rig is farther from what `rig.toml` says than such a part is expected to be.
    Beyond {
        /// Which.
        what: Instrument,
        /// From its nominal value, in `unit`: of the parameter that moved farthest in sigmas.
        change: f64,
        /// Sigma of what is expected, in `unit`.
        tolerance: f64,
        /// "deg", "mm", "px", "%", "" ...
        unit: String,
        /// Square of the change in sigmas of its estimate.
        chi_squared: f64,
    },
    /// The arm's nominal lengths and the standard of length contradict each other.
    Ruler {
        /// [`Instrument::BoardSquares`] or [`Instrument::DepthScale`].
        what: Instrument,
        /// How much larger than nominal it seems to be, %.
        scale_error_percent: f64,
        /// Sigma of that, %.
        sigma_percent: f64,
        /// Whether it is beyond what is a matter of chance.
        certain: bool,
    },
    /// The errors of the postures have a pattern.
    Pattern {
        /// Which; postures by their position.
        pattern: ErrorPattern,
        /// The recording's index of the posture where a step begins.
        posture: Option<u64>,
        /// Its size, in `unit`.
        size: f64,
        /// Sigma of that.
        sigma: f64,
        /// "deg", "ms", "deg/m".
        unit: String,
        /// Twice the gain of the logarithm of the likelihood.
        chi_squared: f64,
    },
    /// Depth readings scatter more than those of any such camera.
    DepthNoise {
        /// `s` of `sigma = s z^2`, 1/m.
        depth_sigma_per_m2: f64,
        /// What is expected at most.
        tolerance_per_m: f64,
    },
    /// A gross mistake in the data set: the images are explained without it.
    Gross {
        /// What was tried and found.
        finding: GrossFinding,
    },
    /// Depth images belong to other rows.
    DepthShift {
        /// What was found.
        shift: DepthShift,
    },
    /// Too few arm positions for what was freed.
    FewPostures {
        /// Arm positions with observations.
        positions: usize,
        /// How many there should be at least.
        needed: usize,
    },
    /// Joints are off in every posture anew by more than encoders, gears and bending make.
    PostureNoise {
        /// Sigma of a joint, deg.
        sigma_deg: f64,
        /// What is expected at most.
        tolerance_deg: f64,
    },
}

/// The noisiest depth camera: a stereo camera of short baseline and low resolution, 1/m.
const DEPTH_TOLERANCE_PER_M: f64 = 0.02;
/// The least exact arm that is calibrated at all.
const JOINT_TOLERANCE_DEG: f64 = 0.05;
/// The standard of length is doubted from so many sigmas on.
const DOUBTED_SIGMAS: f64 = 2.0;

impl Cause {
    /// What it calls for by itself.
    pub fn status(&self) -> Status {
        match self {
            // An arm or a mount that was far off is what a calibration is for.
            Cause::Beyond { what: Instrument::Arm | Instrument::Mount, .. } => Status::Good,
            Cause::Gross { .. } | Cause::DepthShift { .. } => Status::Bad,
            _ => Status::Caution,
        }
    }

    /// Rank: twice the gain of the logarithm of the likelihood, as far as it is known.
    fn rank(&self) -> f64 {
        match self {
            Cause::Beyond { chi_squared, .. } | Cause::Pattern { chi_squared, .. } => *chi_squared,
            Cause::Ruler { scale_error_percent, sigma_percent, .. } => (scale_error_percent / sigma_percent).powi(2),
            Cause::Gross { .. } | Cause::DepthShift { .. } => f64::INFINITY,
            Cause::FewPostures { .. } | Cause::DepthNoise { .. } | Cause::PostureNoise { .. } => 0.0,
        }
    }
}

/// Joints that are off by more in every posture anew (degrees) are no noise: something gross is wrong.
const GROSS_DEG: f64 = 0.1;

/// The causes of what does not fit: those that call for something first, in the order of what they explain. Gross
/// mistakes are tried where the rig does not explain the images; other rows of the depth images where depths scatter as
/// no camera's do.
///
/// # Errors
/// An interruption, and what trying the mistakes refuses.
pub fn causes(
    dataset: &Dataset,
    images: &[ImageFeatures],
    data: &Correspondences,
    calibration: &Calibration,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Vec<Cause>, RunError> {
    let mut found = estimated_causes(dataset, calibration);
    let noise_deg = calibration.noise.posture_angular.unwrap_or(0.0).to_degrees();
    let evidence = Evidence::of(calibration, None, None, dataset.has_joints());
    if evidence.is_unexplained() || dataset.has_joints() && noise_deg > GROSS_DEG {
        let gross = find_gross_cause(dataset, images, config, progress)?;
        found.extend(gross.map(|finding| Cause::Gross { finding }));
    }
    if found.iter().any(|cause| matches!(cause, Cause::DepthNoise { .. })) {
        let shift = find_depth_shift(dataset, calibration, &data.tracks)?;
        found.extend(shift.map(|shift| Cause::DepthShift { shift }));
    }
    found.sort_by(|a, b| b.status().cmp(&a.status()).then(b.rank().total_cmp(&a.rank())));
    Ok(found)
}

fn estimated_causes(dataset: &Dataset, calibration: &Calibration) -> Vec<Cause> {
    let mut found = beyond(calibration);
    found.extend(ruler(calibration));
    let index = |position: usize| dataset.records.get(position).map(|record| record.posture.index);
    found.extend(calibration.error_patterns.iter().map(|pattern| of_pattern(pattern, &index)));
    if let Some(depth_sigma_per_m2) =
        calibration.noise.depth_sigma_per_m2.filter(|sigma| *sigma > DEPTH_TOLERANCE_PER_M)
    {
        found.push(Cause::DepthNoise { depth_sigma_per_m2, tolerance_per_m: DEPTH_TOLERANCE_PER_M });
    }
    found.extend(few_postures(dataset, calibration));
    let sigma_deg = calibration.noise.posture_angular.unwrap_or(0.0).to_degrees();
    if dataset.has_joints() && sigma_deg > JOINT_TOLERANCE_DEG {
        found.push(Cause::PostureNoise { sigma_deg, tolerance_deg: JOINT_TOLERANCE_DEG });
    }
    found
}

fn instrument(parameter: Parameter) -> Instrument {
    match parameter {
        Parameter::Intrinsic(Intrinsic::Fx | Intrinsic::Fy) => Instrument::FocalLength,
        Parameter::Intrinsic(Intrinsic::Cx | Intrinsic::Cy) => Instrument::PrincipalPoint,
        Parameter::Intrinsic(_) => Instrument::Distortion,
        Parameter::DepthScale => Instrument::DepthScale,
        Parameter::DepthOffset => Instrument::DepthOffset,
        // Along the optical axis it cannot be separated from an offset of the depth.
        Parameter::DepthExtrinsic(MountComponent::TranslationZ) => Instrument::DepthOffset,
        Parameter::DepthExtrinsic(_) => Instrument::Extrinsics,
        Parameter::BoardScale => Instrument::BoardSquares,
        Parameter::Mount(_) => Instrument::Mount,
        Parameter::TimeOffset => Instrument::Clock,
        Parameter::Chain(_)
        | Parameter::TransmissionSin(_)
        | Parameter::TransmissionCos(_)
        | Parameter::Compliance(_) => Instrument::Arm,
    }
}

/// One cause an instrument: its parameter that moved farthest in sigmas of its estimate.
fn beyond(calibration: &Calibration) -> Vec<Cause> {
    let mut found: Vec<Cause> = Vec::new();
    for warning in &calibration.warnings {
        let Warning::BeyondPrior { parameter, change, prior_sigma } = *warning else { continue };
        let (factor, unit) = match parameter.unit() {
            Unit::One if matches!(parameter, Parameter::DepthScale | Parameter::BoardScale) => (100.0, "%"),
            unit => unit.of_files(),
        };
        let at = calibration.parameters.iter().position(|estimate| estimate.parameter == parameter);
        let variance = at.zip(calibration.covariance.as_ref()).map_or(f64::INFINITY, |(at, c)| c[(at, at)]);
        let cause = Cause::Beyond {
            what: instrument(parameter),
            change: change * factor,
            tolerance: prior_sigma * factor,
            unit: unit.to_owned(),
            chi_squared: change * change / variance,
        };
        let same = |other: &&mut Cause| matches!(other, Cause::Beyond { what, .. } if *what == instrument(parameter));
        match found.iter_mut().find(same) {
            Some(other) if other.rank() < cause.rank() => *other = cause,
            Some(_) => {}
            None => found.push(cause),
        }
    }
    found
}

/// Each arm position gives six numbers; a redundancy of four leaves enough to separate errors of single postures from
/// those of the arm.
const REDUNDANCY: usize = 4;

fn few_postures(dataset: &Dataset, calibration: &Calibration) -> Option<Cause> {
    let of_arm = |parameter: Parameter| matches!(parameter, Parameter::Chain(_));
    if !calibration.parameters.iter().any(|estimate| of_arm(estimate.parameter)) {
        return None;
    }
    let postures: Vec<Posture> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let mut positions = arm_positions(&postures);
    let mut observed = calibration.postures.iter().map(|fit| fit.observations > 0);
    positions.retain(|_| observed.next().unwrap_or(false));
    positions.sort_unstable();
    positions.dedup();
    let unknown = calibration.parameters.iter().filter(|estimate| !estimate.parameter.is_nuisance()).count();
    let needed = (REDUNDANCY * unknown).div_ceil(6);
    (positions.len() < needed).then_some(Cause::FewPostures { positions: positions.len(), needed })
}

fn ruler(calibration: &Calibration) -> Option<Cause> {
    let contradicted = calibration.warnings.iter().find_map(|warning| match *warning {
        Warning::RulerContradicted { parameter, mean, sigma } => Some((parameter, mean, sigma, true)),
        _ => None,
    });
    let doubted = calibration.ruler.as_ref().map(|ruler| (ruler.parameter, ruler.mean, ruler.sigma, false));
    let (parameter, mean, sigma, certain) = contradicted.or(doubted)?;
    (certain || mean.abs() > DOUBTED_SIGMAS * sigma).then(|| Cause::Ruler {
        what: instrument(parameter),
        scale_error_percent: mean * 100.0,
        sigma_percent: sigma * 100.0,
        certain,
    })
}

fn of_pattern(finding: &PatternFinding, index: &dyn Fn(usize) -> Option<u64>) -> Cause {
    let (factor, unit) = match finding.pattern {
        ErrorPattern::TimeOffset => (1e3, "ms"),
        ErrorPattern::Compliance { .. } => (1f64.to_degrees(), "deg/m"),
        _ => (1f64.to_degrees(), "deg"),
    };
    let posture = match finding.pattern {
        ErrorPattern::JointStep { from, .. } | ErrorPattern::CameraSlip { from, .. } => index(from),
        _ => None,
    };
    Cause::Pattern {
        pattern: finding.pattern,
        posture,
        size: finding.size * factor,
        sigma: finding.sigma * factor,
        unit: unit.to_owned(),
        chi_squared: finding.chi_squared,
    }
}
