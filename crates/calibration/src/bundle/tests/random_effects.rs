//! Flange poses that are off in every posture anew.

use super::rgbd;
use crate::synthetic::{box_points, diverse_postures, hp3j, manufacture, normal, perturbed, record, seeded};
use crate::{BundleOptions, Correspondences, Free, Model, Parameter, PostureErrorPolicy, calibrate_bundle};
use nalgebra::Vector3;
use skclam_geometry::Isometry3;
use skclam_rig::{PostureState, Rig};

const TRANSLATION_M: f64 = 4e-4;
const ROTATION_RAD: f64 = 8e-4;

/// Flange poses as a controller says, whose truth is off by a translation and a rotation in the flange's axes.
fn flange_poses(seed: u64) -> (Rig, Correspondences, Vec<[f64; 6]>) {
    let mut rng = seeded(seed);
    let mount = Free::parse("mount", &hp3j()).unwrap();
    let truth = perturbed(&hp3j(), &mount, manufacture(), &mut rng);
    let mut reported = diverse_postures(&hp3j(), 30, &mut rng);
    let mut errors = Vec::new();
    let mut actual = reported.clone();
    for (reported, actual) in reported.iter_mut().zip(&mut actual) {
        let pose = truth.base_from_flange(reported).unwrap();
        let size = |k: usize| if k < 3 { TRANSLATION_M } else { ROTATION_RAD };
        let error: [f64; 6] = std::array::from_fn(|k| size(k) * normal(&mut rng));
        let [x, y, z, rx, ry, rz] = error;
        let off = Isometry3::new(Vector3::new(x, y, z), Vector3::new(rx, ry, rz));
        (reported.state, actual.state) = (PostureState::FlangePose(pose), PostureState::FlangePose(pose * off));
        errors.push(error);
    }
    let mut data = record(&truth, &actual, &box_points(3000, &mut rng), rgbd(), &mut rng);
    data.postures = reported;
    (truth, data, errors)
}

#[test]
fn errors_of_flange_poses_and_their_sigmas_are_recovered() {
    let (truth, data, errors) = flange_poses(41);
    let result = calibrate_bundle(&hp3j(), &data, &BundleOptions::default()).unwrap();
    let (angular, linear) = (result.noise.posture_angular.unwrap(), result.noise.posture_linear.unwrap());
    assert!((angular / ROTATION_RAD - 1.0).abs() < 0.2, "{angular}");
    assert!((linear / TRANSLATION_M - 1.0).abs() < 0.2, "{linear}");
    assert_eq!(result.posture_errors.len(), 30);
    let known = result.posture_error_knowledge.as_ref().unwrap();
    assert_eq!((known.components, known.mean.len()), (6, 180));
    // In their own sigmas.
    let off = |k: usize| (known.mean[k] - errors[k / 6][k % 6]) / known.covariance[(k, k)].sqrt();
    let mean_square = (0..180).map(|k| off(k) * off(k)).sum::<f64>() / 180.0;
    assert!((0.5..2.0).contains(&mean_square), "{mean_square}");
    let truth = Model::new(truth);
    for estimate in result.parameters.iter().filter(|e| matches!(e.parameter, Parameter::Mount(_))) {
        let off = (estimate.value - truth.value(&hp3j(), estimate.parameter).unwrap()) / estimate.sigma.unwrap();
        assert!(off.abs() < 3.5, "{}: {off} sigma", estimate.parameter);
    }
    // Without them the scatter of the poses goes into everything else.
    let options = BundleOptions { posture_errors: PostureErrorPolicy::Off, ..Default::default() };
    let without = calibrate_bundle(&hp3j(), &data, &options).unwrap();
    assert!(without.noise.pixel > 1.2 * result.noise.pixel, "{:?} {:?}", without.noise, result.noise);
}
