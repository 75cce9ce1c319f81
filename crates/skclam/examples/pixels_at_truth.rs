//! Refined pixels against where the true cameras see the true surface point that a track's reference names.
//!
//! `cargo run --release -p skclam --example pixels_at_truth [DATASET]`, by default `../shared/data/virtual-cell` (or
//! the folder of that name in `SKCLAM_DATA`). The dataset brings `truth/rig.toml`, `truth/trajectory.txt` and
//! `truth/scene.ply`.
//!
//! The reference of a track is where its keypoint is, by definition: its ray meets the true surface in the point that
//! all other observations should show. NEES/n is the mean squared error in units of the claimed covariance, over 2: 1
//! where the covariance is true.

mod truth;

use nalgebra::{Matrix2, Vector2};
use skclam::features::{
    KeyPoint, Observation, Pyramid, RefineOptions, TrackPoint, Tracks, WarpPrediction, build_tracks, refine_tracks,
};
use skclam::geometry::{Pixel, Point3};
use skclam::pipeline::{Config, ImageFeatures, PlaneWarp, extract_features, match_pairs, pairs_to_match};
use skclam::progress::Silent;
use truth::{Surface, Truth};

/// Beyond so many of its sigmas an observation is an outlier, which the estimator's loss leaves out.
const OUTLIER_SIGMAS: f64 = 7.0;

struct Residual {
    error: Vector2<f64>,
    covariance: Matrix2<f64>,
    /// What the warp has beyond its linear part, averaged over the window, px.
    bend: Vector2<f64>,
    /// Distance in the reference to what is not on the plane, px.
    planar_px: f64,
}

impl Residual {
    fn sigma_px(&self) -> f64 {
        (0.5 * self.covariance.trace()).sqrt()
    }

    fn nees(&self) -> f64 {
        let inverse = self.covariance.try_inverse().unwrap_or_default();
        0.5 * self.error.dot(&(inverse * self.error))
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (folder, dataset) = truth::dataset()?;
    let truth = Truth::read(&folder)?;
    let config = Config { max_observations: None, ..Config::default() };
    let images = extract_features(&dataset, &config, &Silent)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, &config);
    let pairs = match_pairs(&dataset, &images, chosen, &config, &Silent)?;
    let keypoints: Vec<&[KeyPoint]> = images.iter().map(|image| image.features.keypoints.as_slice()).collect();
    let counts: Vec<usize> = keypoints.iter().map(|keypoints| keypoints.len()).collect();
    let links: Vec<_> = pairs
        .iter()
        .map(|matched| skclam::features::ImagePair {
            a: matched.pair.a as u32,
            b: matched.pair.b as u32,
            matches: &matched.matches,
        })
        .collect();
    let tracks = build_tracks(&counts, &links, &config.tracks.unwrap_or_default())?;
    let pyramids: Vec<Pyramid> = (0..dataset.len())
        .map(|index| Ok(Pyramid::new(&dataset.gray(index)?)))
        .collect::<Result<_, Box<dyn std::error::Error>>>()?;
    let plane = PlaneWarp { images: &images, camera: &dataset.rig.color };
    for (name, bent, options) in kinds() {
        let predicted: Option<&dyn WarpPrediction> = if bent { Some(&plane) } else { None };
        let refined = refine_tracks(&tracks, &keypoints, &pyramids, predicted, &options)?;
        println!("{name}: {} refined, {} rejected", refined.refined(), refined.rejected());
        report(&residuals(&truth, &images, &tracks, &refined.points));
    }
    Ok(())
}

/// What is compared: name, whether the part of second order is predicted, options.
fn kinds() -> Vec<(String, bool, RefineOptions)> {
    let mut kinds = vec![("affine, default window".to_owned(), false, RefineOptions::default())];
    for patch in [9, 15, 21] {
        kinds.push((
            format!("as in a run, {patch} samples"),
            true,
            RefineOptions { patch, ..RefineOptions::default() },
        ));
    }
    kinds
}

fn position(images: &[ImageFeatures], observation: &Observation) -> Pixel {
    let keypoint = &images[observation.image as usize].features.keypoints[observation.keypoint as usize];
    Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))
}

fn residuals(truth: &Truth, images: &[ImageFeatures], tracks: &Tracks, points: &[TrackPoint]) -> Vec<Residual> {
    let mut residuals = Vec::new();
    for (track, range) in tracks.iter().zip(tracks.starts.windows(2)) {
        let points = &points[range[0]..range[1]];
        let Some(named) = points.iter().position(|point| matches!(point, TrackPoint::Reference { .. })) else {
            continue;
        };
        let reference = track[named].image as usize;
        let at = position(images, &track[named]);
        let Some(surface) = truth.at(reference, &at) else { continue };
        let Some(around) = truth.surroundings(reference, &at, 0.002) else { continue };
        for (observation, point) in track.iter().zip(points) {
            let TrackPoint::Refined(refined) = point else { continue };
            let warp = |d: Vector2<f64>| warped(truth, reference, observation.image as usize, &surface, &(at + d));
            let Some(expected) = warp(Vector2::zeros()) else { continue };
            residuals.push(Residual {
                error: refined.in_b - expected,
                covariance: refined.covariance,
                bend: bend(&warp).unwrap_or_default(),
                planar_px: around.radius_px,
            });
        }
    }
    residuals
}

/// Where image `to` shows what image `from` shows at a pixel, if the surface is the plane of `surface`.
fn warped(truth: &Truth, from: usize, to: usize, surface: &Surface, pixel: &Pixel) -> Option<Pixel> {
    let ray = truth.rig.color.unproject(pixel);
    let point = truth.base_from_color[from] * Point3::from(ray * surface.plane_z_m(&ray));
    truth.rig.color.project(&(truth.base_from_color[to].inverse() * point))
}

/// The mean of the warp less its linear part over a Gaussian window of 6.5 px.
fn bend(warp: &dyn Fn(Vector2<f64>) -> Option<Pixel>) -> Option<Vector2<f64>> {
    const SIGMA_PX: f64 = 6.5;
    let mut sum = Vector2::zeros();
    let here = warp(Vector2::zeros())?;
    for axis in [Vector2::x(), Vector2::y()] {
        sum += 0.5 * (warp(axis * SIGMA_PX)? - here + (warp(-axis * SIGMA_PX)? - here));
    }
    Some(sum)
}

fn report(all: &[Residual]) {
    let line = |name: &str, of: &mut dyn Iterator<Item = &Residual>| {
        let of: Vec<&Residual> = of.collect();
        let inside: Vec<&&Residual> = of.iter().filter(|r| r.nees() < 0.5 * OUTLIER_SIGMAS * OUTLIER_SIGMAS).collect();
        let n = inside.len().max(1) as f64;
        let mean = inside.iter().map(|r| r.error).sum::<Vector2<f64>>() / n;
        let rms = (inside.iter().map(|r| r.error.norm_squared()).sum::<f64>() / (2.0 * n)).sqrt();
        let claimed = (inside.iter().map(|r| r.covariance.trace()).sum::<f64>() / (2.0 * n)).sqrt();
        let nees = inside.iter().map(|r| r.nees()).sum::<f64>() / n;
        let (by, along) = inside.iter().fold((0.0, 0.0), |(by, along), r| {
            let weight = 1.0 / r.covariance.trace();
            (by + weight * r.bend.norm_squared(), along + weight * r.bend.dot(&r.error))
        });
        let mut sizes: Vec<f64> = of.iter().map(|r| r.nees()).collect();
        sizes.sort_by(f64::total_cmp);
        let median = sizes.get(sizes.len() / 2).copied().unwrap_or(f64::NAN) / 0.693;
        println!(
            "  {name:<22} {:>7}  mean {:>7.4} {:>7.4}  rms {rms:.4}  claimed {claimed:.4}  NEES/n {nees:>5.2} (median {median:.2})  bend {:>6.4} px x {:>5.2}  outliers {:.2} %",
            of.len(),
            mean.x,
            mean.y,
            (inside.iter().map(|r| r.bend.norm_squared()).sum::<f64>() / (2.0 * n)).sqrt(),
            along / by,
            100.0 * (1.0 - inside.len() as f64 / of.len().max(1) as f64)
        );
    };
    line("all", &mut all.iter());
    for (low, high) in [(0.0, 0.01), (0.01, 0.02), (0.02, 0.04), (0.04, 0.08), (0.08, 0.16), (0.16, 0.3), (0.3, 9.0)] {
        line(&format!("sigma {low} - {high}"), &mut all.iter().filter(|r| (low..high).contains(&r.sigma_px())));
    }
    for px in [1.0, 2.0, 4.0, 8.0, 16.0, f64::INFINITY] {
        line(&format!("not a plane from {px} px"), &mut all.iter().filter(|r| r.planar_px == px));
    }
    for (low, high) in [(0.0, 0.003), (0.003, 0.01), (0.01, 0.02), (0.02, 0.04), (0.04, 9.0)] {
        let of = all.iter().filter(|r| r.planar_px > 16.0 && (low..high).contains(&r.bend.norm()));
        line(&format!("plane, bend {low} - {high}"), &mut { of });
    }
}
