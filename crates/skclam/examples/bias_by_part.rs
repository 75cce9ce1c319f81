//! Which part of the observations biases a calibration: pixels and depths are replaced by the truth with noise, one
//! after the other.
//!
//! `cargo run --release -p skclam --example bias_by_part [DATASET [SETTINGS]]`, by default
//! `../shared/data/virtual-cell` (or the folder of that name in `SKCLAM_DATA`). The dataset brings `truth/rig.toml`,
//! `truth/trajectory.txt` and `truth/scene.ply`.
//!
//! A line per mixture: the depth offset that is found (mm, 0 is true), the error of the arm's long links together (%),
//! and the NEES of the arm's free lengths and angles over their number (1 where the claimed covariance is true).

mod truth;

use nalgebra::{DVector, Vector2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use skclam::calibration::{Correspondences, Parameter, Track, TrackObservation};
use skclam::dataset::Dataset;
use skclam::evaluation::evaluate;
use skclam::geometry::{Pixel, Point3};
use skclam::pipeline::{Config, calibrate, correspondences, extract_features, match_pairs, pairs_to_match};
use skclam::progress::Silent;
use truth::Truth;

/// `s` of the sensor's `sigma = s z^2`, 1/m.
const DEPTH_NOISE_PER_M: f64 = 0.0025;

/// Links longer than this determine the scale, m.
const LONG_M: f64 = 0.05;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Part {
    Measured,
    /// The truth with noise of the claimed covariance.
    TruthWithNoise,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (folder, dataset) = truth::dataset()?;
    let truth = Truth::read(&folder)?;
    let config = config()?;
    let images = extract_features(&dataset, &config, &Silent)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, &config);
    let pairs = match_pairs(&dataset, &images, chosen, &config, &Silent)?;
    let (data, _) = correspondences(&dataset, &images, &pairs, &config, &Silent)?;
    for (pixels, depths) in [
        (Part::Measured, Part::Measured),
        (Part::Measured, Part::TruthWithNoise),
        (Part::TruthWithNoise, Part::Measured),
        (Part::TruthWithNoise, Part::TruthWithNoise),
    ] {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let tracks: Vec<Track> =
            data.tracks.iter().filter_map(|track| mixed(&truth, track, pixels, depths, &mut rng)).collect();
        let mixed = Correspondences { tracks, ..data.clone() };
        print!("pixels {pixels:?}, depths {depths:?}: ");
        report(&dataset, &truth, &mixed, &config)?;
    }
    Ok(())
}

/// The pipeline's settings, with those of a second argument in JSON, such as `{"refine": {"patch": 9}}`.
fn config() -> Result<Config, Box<dyn std::error::Error>> {
    let default = Config::default();
    Ok(match std::env::args().nth(2) {
        Some(text) => default.overlaid(&text)?,
        None => default,
    })
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random_range(f64::MIN_POSITIVE..1.0), rng.random_range(0.0..1.0));
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A track with parts replaced; `None` where its point is not on the known surface.
fn mixed(truth: &Truth, track: &Track, pixels: Part, depths: Part, rng: &mut ChaCha8Rng) -> Option<Track> {
    // The observation that names the point is the one whose coordinates have the same sigma and no correlation.
    let named = track
        .observations
        .iter()
        .find(|o| o.covariance[(0, 1)] == 0.0 && o.covariance[(0, 0)] == o.covariance[(1, 1)])?;
    let surface = truth.at(named.posture, &named.pixel)?;
    let in_camera = Point3::from(truth.rig.color.unproject(&named.pixel) * surface.z_m);
    let point = truth.base_from_color[named.posture] * in_camera;
    let observation = |o: &TrackObservation| {
        let in_camera = truth.base_from_color[o.posture].inverse() * point;
        let mut new = *o;
        let expected = truth.rig.color.project(&in_camera)?;
        // A wrong match stays out of all mixtures.
        if (expected - o.pixel).norm() > 1.0 {
            return None;
        }
        if pixels == Part::TruthWithNoise {
            let factor = o.covariance.cholesky()?.l();
            new.pixel = Pixel::from(expected.coords + factor * Vector2::new(normal(rng), normal(rng)));
        }
        if depths == Part::TruthWithNoise {
            let z = in_camera.z;
            new.depth_m = o.depth_m.map(|_| z + DEPTH_NOISE_PER_M * z * z * normal(rng));
        }
        Some(new)
    };
    let observations: Vec<_> = track.observations.iter().map(observation).collect::<Option<_>>()?;
    Some(Track { observations })
}

fn report(
    dataset: &Dataset,
    truth: &Truth,
    data: &Correspondences,
    config: &Config,
) -> Result<(), Box<dyn std::error::Error>> {
    let found = calibrate(dataset, data, config, &Silent)?;
    let Some(true_arm) = &truth.rig.robot else { return Err("no arm".into()) };
    let Some(covariance) = &found.covariance else { return Err("no covariance".into()) };
    let (mut chosen, mut errors) = (Vec::new(), Vec::new());
    let (mut long_m, mut long_error_m) = (0.0, 0.0);
    for (index, estimate) in found.parameters.iter().enumerate() {
        let Parameter::Chain(id) = estimate.parameter else { continue };
        let Some(true_value) = true_arm.parameter(id) else { continue };
        chosen.push(index);
        errors.push(estimate.value - true_value);
        if !id.kind.is_angle() && true_value.abs() > LONG_M {
            long_m += true_value.abs();
            long_error_m += (estimate.value - true_value) * true_value.signum();
        }
    }
    let errors = DVector::from_vec(errors);
    let own = covariance.select_rows(&chosen).select_columns(&chosen);
    let nees = own.cholesky().map_or(f64::NAN, |own| errors.dot(&own.solve(&errors)) / errors.len() as f64);
    let offset = found.parameters.iter().find(|estimate| estimate.parameter == Parameter::DepthOffset);
    let postures: Vec<_> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let camera = evaluate(&found.model.corrected_rig(), &truth.rig, &postures)?.camera_after_base_gauge;
    println!(
        "offset {:.3} +- {:.3} mm, lengths {:+.4} %, camera {:.4} mm {:.4} deg, NEES/n {nees:.2} of {}, sigma of pixels {:.2}, of depths {:.2}",
        offset.map_or(f64::NAN, |estimate| 1e3 * estimate.value),
        offset.and_then(|estimate| estimate.sigma).map_or(f64::NAN, |sigma| 1e3 * sigma),
        100.0 * long_error_m / long_m,
        camera.position_mm.mean,
        camera.orientation_deg.mean,
        errors.len(),
        found.noise.pixel,
        1e3 * found.noise.depth_sigma_per_m2.unwrap_or(f64::NAN)
    );
    Ok(())
}
