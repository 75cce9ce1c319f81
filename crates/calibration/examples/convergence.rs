//! From how far off do the estimators find the right minimum?
//!
//! Random true arms, each wrong by 3 deg in every angle, 10 mm in every length, 15 deg and 50 mm in the mount;
//! image-free recordings of 40 diverse postures with depth, half a pixel of noise and one pair match in five wrong.
//! Then mounts of which nothing is known at all.
//!
//! `cargo run --release -p skclam-calibration --example convergence [STARTS [far|mount]]` (100 by default, and both)

use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;
use skclam_calibration::*;
use skclam_geometry::Isometry3;
use skclam_rig::Rig;

#[path = "../testing/synthetic.rs"]
mod synthetic;
use synthetic::{
    Errors, Sensing, box_points, camera_error, diverse_postures, fresh_pairs, half_pixel, hp3j, manufacture, normal,
    perturbed, record, seeded,
};

/// A run has found the right minimum when the mean camera error over the postures is below this, m.
const FOUND: f64 = 1e-3;

fn main() {
    let starts = std::env::args().nth(1).and_then(|starts| starts.parse().ok()).unwrap_or(100usize);
    let part = std::env::args().nth(2).unwrap_or_default();
    if part != "mount" {
        far_starts(starts);
    }
    if part != "far" {
        unknown_mounts(starts);
    }
}

/// Everything wrong by much.
fn far_starts(starts: usize) {
    let far = Errors {
        angle: 3f64.to_radians(),
        length: 0.01,
        mount_angle: 15f64.to_radians() / 3f64.sqrt(),
        mount_length: 0.05 / 3f64.sqrt(),
        fixed_size: true,
    };
    report(
        "3 deg on all angles, 10 mm on all lengths, mount 15 deg and 50 mm off; bundle adjustment",
        starts,
        |seed| {
            let mut rng = seeded(10_000 + seed);
            let truth = perturbed(&hp3j(), &Free::Auto, far, &mut rng);
            let postures = diverse_postures(&hp3j(), 40, &mut rng);
            let sensing = Sensing { depth_relative: Some(0.0044), outliers: 0.106, ..half_pixel() };
            let data = record(&truth, &postures, &box_points(4000, &mut rng), sensing, &mut rng);
            // So far off are no tolerances of manufacture: the priors would only bias the answer.
            let options = BundleOptions {
                priors: PriorPolicy::Never,
                posture_errors: PostureErrorPolicy::Off,
                ..Default::default()
            };
            let found = calibrate_bundle(&hp3j(), &data, &options).ok()?;
            let out = found.warnings.iter().filter_map(|w| match w {
                Warning::OutlierPosture { posture, excluded: true, .. } => Some(*posture),
                _ => None,
            });
            let out: Vec<usize> = out.collect();
            let kept: Vec<_> =
                postures.iter().enumerate().filter(|(k, _)| !out.contains(k)).map(|(_, p)| p.clone()).collect();
            Some(camera_error(&truth, &found.model.rig, &kept))
        },
    );
}

/// Nothing known of the mount.
fn unknown_mounts(starts: usize) {
    report("no idea of the mount, an arm of 0.3 deg and 0.5 mm: find_mount, then bundle adjustment", starts, |seed| {
        let mut rng = seeded(20_000 + seed);
        let mut truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let turn =
            Vector3::from_fn(|_, _| normal(&mut rng)).normalize() * (std::f64::consts::PI * rng_fraction(&mut rng));
        let shift = Vector3::from_fn(|_, _| 0.06 * normal(&mut rng));
        truth.flange_from_color = Isometry3::from_parts(shift.into(), UnitQuaternion::from_scaled_axis(turn));
        let postures = diverse_postures(&hp3j(), 40, &mut rng);
        let sensing = Sensing { depth_relative: Some(0.0044), outliers: 0.106, ..half_pixel() };
        let mut data = record(&truth, &postures, &box_points(4000, &mut rng), sensing, &mut rng);
        let all: Vec<(usize, usize)> = (0..40).flat_map(|a| (a + 1..40).map(move |b| (a, b))).collect();
        // Matches that were made without an epipolar gate: two in five are wrong.
        data.pairs = fresh_pairs(&truth, &postures, &all, 8, Sensing { outliers: 0.4, ..half_pixel() }, &mut rng);
        let mount = find_mount(&hp3j(), &data).ok()?;
        let nominal = Rig { flange_from_color: mount.model.rig.flange_from_color, ..hp3j() };
        let options =
            BundleOptions { priors: PriorPolicy::Never, posture_errors: PostureErrorPolicy::Off, ..Default::default() };
        let found = calibrate_bundle(&nominal, &data, &options).ok()?;
        Some(camera_error(&truth, &found.model.rig, &postures))
    });
}

fn rng_fraction(rng: &mut rand_chacha::ChaCha8Rng) -> f64 {
    use rand::RngExt;
    rng.random::<f64>()
}

fn report(name: &str, starts: usize, run: impl Fn(u64) -> Option<f64> + Sync) {
    let mut errors: Vec<(u64, Option<f64>)> =
        (0..starts as u64).into_par_iter().map(|seed| (seed, run(seed))).collect();
    let found = errors.iter().filter(|(_, error)| error.is_some_and(|error| error < FOUND)).count();
    let missed: Vec<String> = errors
        .iter()
        .filter(|(_, error)| error.is_none_or(|error| error >= FOUND))
        .map(|(seed, error)| {
            error.map_or(format!("{seed}: an error"), |error| format!("{seed}: {:.1} mm", error * 1e3))
        })
        .collect();
    errors.sort_by(|a, b| a.1.unwrap_or(f64::INFINITY).total_cmp(&b.1.unwrap_or(f64::INFINITY)));
    let at = |k: usize| errors[k.min(errors.len() - 1)].1.unwrap_or(f64::INFINITY) * 1e3;
    println!("## {name}\n");
    println!(
        "{found} of {starts} found (camera error below {} mm); median error {:.4} mm, 95 % below {:.4} mm; missed: {missed:?}\n",
        FOUND * 1e3,
        at(starts / 2),
        at(starts * 95 / 100)
    );
}
