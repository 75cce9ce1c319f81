//! The standard of length: held where nothing contradicts it, weighed where the arm does.

use crate::synthetic::{Errors, diverse_postures, hp3j, manufacture, perturbed, record_board, seeded};
use crate::{
    BoardObservation, BundleOptions, Calibration, Correspondences, Free, Parameter, RulerPolicy, Warning,
    calibrate_bundle,
};
use nalgebra::Vector3;
use skclam_geometry::Isometry3;
use skclam_rig::Rig;

/// Thirty postures over a board whose squares are larger by a factor than the rig says.
fn board_that_is_larger(factor: f64, errors: Errors, seed: u64) -> (Rig, Rig, Correspondences) {
    let mut rng = seeded(seed);
    let truth = perturbed(&hp3j(), &Free::Auto, errors, &mut rng);
    let base_from_board = Isometry3::new(Vector3::new(0.6, -0.08, 0.0), Vector3::new(0.0, 0.0, 0.3));
    let drawn = diverse_postures(&hp3j(), 30_000, &mut rng);
    let (mut board, seen) = record_board(&truth, &drawn, &base_from_board, 0.1, &mut rng);
    board.square_m /= factor;
    let mut data = Correspondences::default();
    for observation in seen.into_iter().take(30) {
        let posture = data.postures.len();
        data.postures.push(drawn[observation.posture].clone());
        data.boards.push(BoardObservation { posture, ..observation });
    }
    assert_eq!(data.postures.len(), 30);
    let mut nominal = hp3j();
    nominal.board = Some(board);
    (truth, nominal, data)
}

fn precise() -> Errors {
    Errors { length: 1e-4, ..manufacture() }
}

fn contradicted(result: &Calibration) -> bool {
    result.warnings.iter().any(|w| matches!(w, Warning::RulerContradicted { .. }))
}

fn board_scale(result: &Calibration) -> f64 {
    result.parameters.iter().find(|e| e.parameter == Parameter::BoardScale).unwrap().value
}

#[test]
fn a_standard_of_length_that_nothing_contradicts_is_held_and_in_the_covariance() {
    let (_, nominal, data) = board_that_is_larger(1.0, precise(), 51);
    let result = calibrate_bundle(&nominal, &data, &BundleOptions::default()).unwrap();
    let ruler = result.ruler.as_ref().unwrap();
    assert!(ruler.held && ruler.parameter == Parameter::BoardScale && !contradicted(&result), "{ruler:?}");
    assert_eq!(board_scale(&result), 1.0);
    assert_eq!(ruler.prior_sigma, 1e-3);
    assert!(ruler.sigma <= ruler.prior_sigma && ruler.mean.abs() < 3.0 * ruler.sigma, "{ruler:?}");
    // Lengths are as uncertain as it, and no more than that without it.
    let covariance = result.covariance.as_ref().unwrap();
    let rest = result.covariance_without_ruler().unwrap();
    let at = result.parameters.iter().position(|e| e.parameter.to_string() == "a_3").unwrap();
    let [with, without] = [covariance, &rest].map(|c| c[(at, at)].sqrt());
    assert!(without < with && (with.powi(2) - without.powi(2)).sqrt() > 0.3 * 0.29 * ruler.sigma, "{with} {without}");
    // Estimated, it is where that mean says.
    let options = BundleOptions { ruler: RulerPolicy::Estimated, ..Default::default() };
    let estimated = calibrate_bundle(&nominal, &data, &options).unwrap();
    let found = board_scale(&estimated) - 1.0;
    assert!((found - ruler.mean).abs() < 0.3 * ruler.sigma, "{found} {ruler:?}");
    assert!(!estimated.ruler.unwrap().held);
}

#[test]
fn a_standard_of_length_that_the_arm_contradicts_is_weighed_and_reported() {
    let (_, nominal, data) = board_that_is_larger(1.005, precise(), 52);
    let result = calibrate_bundle(&nominal, &data, &BundleOptions::default()).unwrap();
    let ruler = result.ruler.as_ref().unwrap();
    assert!(contradicted(&result) && !ruler.held, "{ruler:?} {:?}", result.warnings);
    let scale = board_scale(&result);
    assert!((scale - 1.005).abs() < 1.5e-3 && (scale - 1.0 - ruler.mean).abs() < ruler.sigma, "{scale} {ruler:?}");
}

/// Squares that are ten and more of their sigmas off, beside an arm whose lengths are true to 0.1 mm: every length
/// would have to be off by the same fraction.
#[test]
fn a_standard_of_length_that_is_grossly_wrong_is_reported() {
    for factor in [1.01, 1.05] {
        let (_, nominal, data) = board_that_is_larger(factor, precise(), 52);
        let result = calibrate_bundle(&nominal, &data, &BundleOptions::default()).unwrap();
        let ruler = result.ruler.as_ref().unwrap();
        assert!(contradicted(&result), "{factor}: {ruler:?} {:?} {:?}", result.prior_scales, result.warnings);
    }
}
