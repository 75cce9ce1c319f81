//! What a calibration can be expected to determine, from postures and scene points alone: the Cramer-Rao bound before
//! any image is matched.
//!
//! The information about the parameters does not depend on what was measured, only on where the measurements are made.
//! So observations predicted by the nominal rig, with the noise that is expected of them, give the covariance of a
//! calibration that has not been made.

use crate::bundle::adjust::{Adjustment, marginal, posed_state};
use crate::bundle::noise::LossCorrection;
use crate::bundle::observations::Observations;
use crate::bundle::posterior::{Likelihood, PosteriorInputs};
use crate::bundle::random_effects::PostureErrorModel;
use crate::bundle::start::triangulate_all;
use crate::bundle::state::NoiseScales;
use crate::camera_kinematics::CameraKinematics;
use crate::pose_covariance::propagate_to_poses;
use crate::prior::Priors;
use crate::uncertainty::{covariance, describe};
use crate::{
    BundleOptions, CalibrationError, Correspondences, Free, Identifiability, Loss, Model, ParameterEstimate,
    PoseCovariance, PostureErrorPolicy, PriorPolicy,
};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use skclam_rig::Rig;

/// What is expected of the measurements, and what is to be calibrated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ExpectationOptions {
    /// What is free.
    pub free: Free,
    /// Which priors are used.
    pub priors: PriorPolicy,
    /// Sigma of a pixel coordinate whose covariance is the unit matrix, px.
    pub pixel_sigma: f64,
    /// `s` of `sigma = s z^2` of the measured depth, 1/m.
    pub depth_sigma_per_m2: f64,
    /// Sigma of what joints are off their values where the rig does not state it, degrees; 0 for none.
    pub joint_error_deg: f64,
    /// Unknown posture errors at most; beyond, they are taken as zero.
    pub max_posture_errors: usize,
}

impl Default for ExpectationOptions {
    /// Refined matches, a stereo depth camera, an industrial arm.
    fn default() -> Self {
        ExpectationOptions {
            free: Free::Auto,
            priors: PriorPolicy::Auto,
            pixel_sigma: 0.2,
            depth_sigma_per_m2: 3e-3,
            joint_error_deg: 3e-3,
            max_posture_errors: 1800,
        }
    }
}

/// What a calibration can be expected to determine.
#[derive(Debug, Clone, PartialEq)]
pub struct ExpectedCalibration {
    /// The free parameters; `value` is the nominal one.
    pub parameters: Vec<ParameterEstimate>,
    /// Covariance of the free parameters in their order and units, the data and the priors together.
    pub covariance: DMatrix<f64>,
    /// Which parameters are identifiable.
    pub identifiability: Identifiability,
    /// Covariances of flange and camera, one a posture of the data.
    pub poses: Vec<PoseCovariance>,
}

/// Covariances that [`calibrate_bundle`](crate::calibrate_bundle) can be expected to reach. `data`: tracks and board
/// corners as the nominal rig would see them; pairs are not used. Nothing is solved. Fails where `data` are malformed,
/// or are fewer than the free parameters.
pub fn expected_calibration(
    nominal: &Rig,
    data: &Correspondences,
    options: &ExpectationOptions,
) -> Result<ExpectedCalibration, CalibrationError> {
    data.check()?;
    for (name, value) in [("pixel_sigma", options.pixel_sigma), ("depth_sigma_per_m2", options.depth_sigma_per_m2)] {
        if !(value > 0.0 && value.is_finite()) {
            return Err(CalibrationError::Option { name, value: value.to_string(), expected: "it must be above zero" });
        }
    }
    let motion = CameraKinematics::new(nominal, &data.postures)?;
    let mut observations = Observations::new(nominal, data, &|_| true, &mut Vec::new())?;
    let parameters = options.free.candidates(nominal, motion.has_joints(), observations.depth_count() > 0)?;
    if parameters.is_empty() {
        return Err(CalibrationError::NothingFree);
    }
    let deg = nominal.prior.joint_error_deg.unwrap_or(options.joint_error_deg);
    let posture_errors = if deg > 0.0 { PostureErrorPolicy::SigmaDeg(deg) } else { PostureErrorPolicy::Off };
    let limits = BundleOptions { posture_errors, max_posture_errors: options.max_posture_errors, ..Default::default() };
    let errors = PostureErrorModel::new(nominal, &motion, &limits, &mut Vec::new());
    let noise = NoiseScales { pixel: options.pixel_sigma, depth: options.depth_sigma_per_m2, posture: errors.first };
    let priors = Priors::new(nominal, &options.free, options.priors, &parameters);
    let model = Model::new(nominal.clone());
    let mut state = posed_state(
        &model,
        vec![0.0; errors.kinds.len() * motion.len()],
        &motion,
        &observations,
        &noise,
        Loss::Squared,
    )?;
    let points = triangulate_all(&observations, &state.view(&noise, Loss::Squared), None);
    observations.retain_tracks(&points.iter().map(Option::is_some).collect::<Vec<_>>());
    state.points = points.into_iter().flatten().collect();
    let residuals = 2 * observations.observations.len() + observations.depth_count() + 2 * observations.corners.len();
    let got =
        residuals.saturating_sub(3 * observations.track_count() + 6 * usize::from(!observations.corners.is_empty()));
    let need = 2 * parameters.len();
    if got < need {
        let what = "residuals of tracks and board corners (beyond those that their own points take)".to_owned();
        return Err(CalibrationError::TooFew { what, need, got, parameters: parameters.len() });
    }
    let adjustment = Adjustment {
        nominal,
        motion: &motion,
        observations: &observations,
        parameters: &parameters,
        priors: &priors,
        loss: Loss::Squared,
        noise,
        errors: &errors,
        balance: LossCorrection::EVEN,
        held: None,
    };
    let normal = marginal(&adjustment.normal_matrix(&state, &noise.posture)?, parameters.len());
    let ruler = crate::free::ruler(nominal, &options.free, &parameters, motion.has_joints());
    let ruler = ruler.and_then(|ruler| parameters.iter().position(|parameter| *parameter == ruler));
    let count = parameters.len();
    let mut prior_normal = DMatrix::zeros(count, count);
    priors.add_to(nominal, &model, &parameters, &mut prior_normal, &mut DVector::zeros(count));
    let likelihood = Likelihood { normal, gradient: DVector::zeros(count), offsets: DVector::zeros(count) };
    let inputs = PosteriorInputs { likelihood, prior_normal, priors: priors.clone(), ruler, held: true };
    // Predicted data lie at the nominal arm and would say that it has no errors: what arms are made to is averaged over
    // instead.
    let nearest = || covariance(&(&inputs.likelihood.normal + &inputs.prior_normal), &parameters);
    let covariance = inputs.expected_covariance().unwrap_or_else(nearest);
    let normal = inputs.with_instruments(&parameters);
    let (identifiability, estimates) =
        describe(nominal, &model, &data.postures, &parameters, &priors, &normal, &covariance);
    let poses = propagate_to_poses(nominal, &model, &parameters, &covariance, &data.postures)?;
    Ok(ExpectedCalibration { parameters: estimates, covariance, identifiability, poses })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        Errors, Sensing, box_points, diverse_postures, half_pixel, hp3j, manufacture, perturbed, record, seeded,
    };
    use crate::{PostureErrorPolicy, calibrate_bundle};
    use skclam_rig::{Posture, PostureState};

    /// Tracks as the nominal rig sees them.
    fn predicted(postures: &[Posture], points: usize) -> Correspondences {
        let exact = Sensing { sigma_px: 0.0, depth_relative: Some(0.0), ..half_pixel() };
        let mut rng = seeded(8);
        let rig = perturbed(&hp3j(), &Free::Auto, nothing(), &mut rng);
        record(&rig, postures, &box_points(points, &mut rng), exact, &mut rng)
    }

    fn nothing() -> Errors {
        Errors { angle: 0.0, length: 0.0, mount_angle: 0.0, mount_length: 0.0, fixed_size: false }
    }

    #[test]
    fn what_is_expected_is_what_a_calibration_reports() {
        let mut rng = seeded(5);
        let postures = diverse_postures(&hp3j(), 24, &mut rng);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        // Two scenes with as many points, but not the same.
        let sensing = Sensing { sigma_px: 0.5, ..half_pixel() };
        let data = record(&truth, &postures, &box_points(1000, &mut rng), sensing, &mut rng);
        let fitted = calibrate_bundle(
            &hp3j(),
            &data,
            &BundleOptions { posture_errors: PostureErrorPolicy::Off, ..Default::default() },
        )
        .unwrap();
        let mut views = predicted(&postures, 1000);
        views
            .tracks
            .iter_mut()
            .flat_map(|track| &mut track.observations)
            .for_each(|observation| observation.depth_m = None);
        let options = ExpectationOptions { pixel_sigma: 0.5, joint_error_deg: 0.0, ..Default::default() };
        let expected = expected_calibration(&hp3j(), &views, &options).unwrap();
        assert_eq!(expected.parameters.len(), fitted.parameters.len());
        let mut compared = 0;
        for (expected, fitted) in expected.parameters.iter().zip(&fitted.parameters) {
            let (Some(before), Some(after)) = (expected.sigma, fitted.sigma) else { continue };
            compared += 1;
            // How far the arm's lengths are off is averaged over beforehand and known afterwards.
            let range = if fitted.parameter.unit() == crate::Unit::Radian { 0.6..1.7 } else { 0.25..4.0 };
            assert!(range.contains(&(before / after)), "{}: {expected:?} {fitted:?}", fitted.parameter);
        }
        assert!(compared > 20, "{compared}");
        let twice = ExpectationOptions { pixel_sigma: 1.0, priors: PriorPolicy::Never, ..options.clone() };
        let alone = ExpectationOptions { priors: PriorPolicy::Never, ..options };
        let [twice, alone] = [twice, alone].map(|options| expected_calibration(&hp3j(), &views, &options).unwrap());
        for (twice, alone) in twice.parameters.iter().zip(&alone.parameters) {
            if let (Some(twice), Some(one)) = (twice.sigma, alone.sigma) {
                assert!((twice / one - 2.0).abs() < 1e-6, "{}: noise and sigma are proportional", alone.parameter);
            }
        }
    }

    #[test]
    fn a_joint_that_does_not_move_is_named() {
        let mut postures = diverse_postures(&hp3j(), 24, &mut seeded(5));
        for posture in &mut postures {
            if let PostureState::Joints(values) = &mut posture.state {
                values[4] = 0.4;
            }
        }
        let expected = expected_calibration(&hp3j(), &predicted(&postures, 1000), &Default::default()).unwrap();
        let reasons: Vec<&str> =
            expected.identifiability.unobservable.iter().map(|direction| direction.reason.as_str()).collect();
        assert!(reasons.iter().any(|reason| reason.starts_with("joint 5 moved by only 0.0 deg")), "{reasons:?}");
        assert!(expected.parameters.iter().any(|parameter| parameter.note.is_some()));
        assert_eq!(expected.poses.len(), 24);
    }

    #[test]
    fn nothing_seen_and_noise_that_is_none_are_refused() {
        let postures = diverse_postures(&hp3j(), 5, &mut seeded(5));
        let blind = Correspondences { postures: postures.clone(), ..Default::default() };
        let message = |data: &Correspondences, options: &ExpectationOptions| {
            expected_calibration(&hp3j(), data, options).unwrap_err().to_string()
        };
        assert!(message(&blind, &Default::default()).contains("0 usable residuals"));
        let options = ExpectationOptions { pixel_sigma: f64::NAN, ..Default::default() };
        assert!(message(&predicted(&postures, 300), &options).contains("pixel_sigma"));
    }
}
