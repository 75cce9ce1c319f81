//! The mount when nothing is known of it: a global start.
//!
//! Rotations spread evenly over all orientations (Alexa, "Super-Fibonacci spirals", 2022) are each refined by a few
//! steps on a small sample of the pair matches, with the camera at the flange's origin at first; the better ones go on
//! on a larger sample, and the best of those on all: the one whose epipolar distances are smallest wins. Every relative
//! motion with a baseline constrains the mount through the matches themselves, so that no camera motion has to be
//! decomposed first.

use crate::pairwise::{Search, calibrate_pairwise_from};
use crate::{
    Calibration, CalibrationError, Correspondences, Free, Model, MountComponent, PairMatches, PairwiseOptions,
    Parameter, PriorPolicy,
};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use rayon::prelude::*;
use skclam_geometry::Isometry3;
use skclam_rig::Rig;

/// Orientations that are tried: no orientation is further than about 35 deg from one of them.
const ORIENTATIONS: usize = 120;
/// What is looked at with how much effort, and how many of the best go on.
struct Stage {
    matches: usize,
    iterations: usize,
    kept: usize,
}

/// The last keeps those that are refined on all matches.
const STAGES: [Stage; 2] =
    [Stage { matches: 400, iterations: 8, kept: 20 }, Stage { matches: 1500, iterations: 15, kept: 3 }];

/// Finds `flange_from_color` from pair matches alone; the rig's own mount is ignored. The arm stays nominal.
pub fn find_mount(nominal: &Rig, data: &Correspondences) -> Result<Calibration, CalibrationError> {
    data.check()?;
    let options = PairwiseOptions {
        free: Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec()),
        priors: PriorPolicy::Never,
        ..Default::default()
    };
    let started = |rotation: UnitQuaternion<f64>| {
        let mut rig = nominal.clone();
        rig.flange_from_color = Isometry3::from_parts(Translation3::identity(), rotation);
        Model::new(rig)
    };
    let mut starts: Vec<Model> = (0..ORIENTATIONS).map(|k| started(orientation(k))).collect();
    for Stage { matches, iterations, kept } in STAGES {
        let sample = sample(data, matches);
        let quick =
            PairwiseOptions { max_iterations: iterations, max_rounds: 1, search: Search::Off, ..options.clone() };
        let mut refined = starts
            .par_iter()
            .enumerate()
            .map(|(k, start)| {
                let refined = calibrate_pairwise_from(start, &start.rig, &sample, &quick)?;
                Ok((refined.epipolar_after.median_sampson_px, k, refined.model))
            })
            .collect::<Result<Vec<(f64, usize, Model)>, CalibrationError>>()?;
        refined.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        starts = refined.into_iter().take(kept).map(|(_, _, model)| model).collect();
    }
    let mut best: Option<Calibration> = None;
    for start in starts {
        let options = PairwiseOptions { search: Search::Off, ..options.clone() };
        let refined = calibrate_pairwise_from(&start, nominal, data, &options)?;
        let error = |calibration: &Calibration| calibration.epipolar_after.median_sampson_px;
        if best.as_ref().is_none_or(|best| error(&refined) < error(best)) {
            best = Some(refined);
        }
    }
    best.ok_or(CalibrationError::NothingFree)
}

/// About so many of the pair matches, every k-th.
fn sample(data: &Correspondences, matches: usize) -> Correspondences {
    let stride = data.match_count().div_ceil(matches).max(1);
    let mut at = 0;
    let mut thinned = |pair: &PairMatches| {
        let from = at;
        at += pair.matches.len();
        let kept = pair.matches.iter().enumerate().filter(|(k, _)| (from + k) % stride == 0);
        PairMatches { a: pair.a, b: pair.b, matches: kept.map(|(_, m)| *m).collect() }
    };
    let pairs = data.pairs.iter().map(&mut thinned).filter(|pair| !pair.matches.is_empty()).collect();
    Correspondences { postures: data.postures.clone(), pairs, ..Default::default() }
}

/// The k-th of the orientations.
fn orientation(k: usize) -> UnitQuaternion<f64> {
    let tau = std::f64::consts::TAU;
    let s = k as f64 + 0.5;
    let t = s / ORIENTATIONS as f64;
    let d = tau * s;
    let (r, big_r) = (t.sqrt(), (1.0 - t).sqrt());
    let (alpha, beta) = (d / std::f64::consts::SQRT_2, d / 1.533_751_168_755_204_3);
    let quaternion = Quaternion::new(big_r * beta.cos(), r * alpha.sin(), r * alpha.cos(), big_r * beta.sin());
    UnitQuaternion::from_quaternion(quaternion)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Sensing, diverse_postures, fresh_pairs, half_pixel, hp3j, seeded};
    use nalgebra::Vector3;

    #[test]
    fn any_mount_is_found_without_a_guess() {
        for seed in 0..3 {
            let mut rng = seeded(100 + seed);
            let mut truth = hp3j();
            let axis = Vector3::new(synthetic_normal(&mut rng), synthetic_normal(&mut rng), synthetic_normal(&mut rng));
            let postures = diverse_postures(&truth, 15, &mut rng);
            truth.flange_from_color = Isometry3::new(Vector3::new(0.05, -0.08, 0.06), axis.normalize() * 2.6);
            let all: Vec<(usize, usize)> = (0..15).flat_map(|a| (a + 1..15).map(move |b| (a, b))).collect();
            let sensing = Sensing { outliers: 0.2, ..half_pixel() };
            let pairs = fresh_pairs(&truth, &postures, &all, 25, sensing, &mut rng);
            let data = Correspondences { postures, pairs, ..Default::default() };
            let found = find_mount(&hp3j(), &data).unwrap().model.rig.flange_from_color;
            let error = found.inverse() * truth.flange_from_color;
            assert!(error.rotation.angle() < 0.003, "seed {seed}: {} rad", error.rotation.angle());
            assert!(error.translation.vector.norm() < 0.003, "seed {seed}: {}", error.translation.vector);
        }
    }

    fn synthetic_normal(rng: &mut rand_chacha::ChaCha8Rng) -> f64 {
        crate::synthetic::normal(rng)
    }
}
