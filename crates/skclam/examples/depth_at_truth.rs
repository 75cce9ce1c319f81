//! The depth that the pipeline reads at features, against the true surface.
//!
//! `cargo run --release -p skclam --example depth_at_truth [DATASET]`, by default `../shared/data/virtual-cell` (or the
//! folder of that name in `SKCLAM_DATA`). The dataset brings `truth/rig.toml`, `truth/trajectory.txt` and
//! `truth/scene.ply`.
//!
//! Errors are taken in inverse depth, where the noise of a triangulating sensor is the same at any range, and printed
//! in units of 0.1 % per metre: 1 is 1 mm at 1 m, 4 mm at 2 m; positive where the sensor reads too far.

mod truth;

use skclam::calibration::Loss;
use skclam::dataset::Dataset;
use skclam::geometry::{DepthCamera, DepthImage, PinholeCamera, Pixel, Point3};
use skclam::pipeline::{Config, RegisteredDepth, correspondences, extract_features, match_pairs, pairs_to_match};
use skclam::progress::Silent;
use skclam::simulation::DepthNoiseOptions;
use truth::{Surroundings, Truth, summary};

/// Beyond this an error is no noise.
const GATE: f64 = 20.0;

struct Reading {
    z_m: f64,
    read_m: f64,
    incidence: f64,
    around: Surroundings,
    /// Of the point that the whole track shows from the true cameras, beside the surface on this ray.
    point_off: Option<f64>,
}

impl Reading {
    fn error(&self) -> f64 {
        inverse_error(self.read_m, self.z_m)
    }
}

fn inverse_error(read_m: f64, true_m: f64) -> f64 {
    1e3 * (1.0 / true_m - 1.0 / read_m)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (folder, dataset) = truth::dataset()?;
    let truth = Truth::read(&folder)?;
    let config = Config { max_observations: None, ..Config::default() };
    sensor(&dataset, &truth)?;
    let images = extract_features(&dataset, &config, &Silent)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, &config);
    let pairs = match_pairs(&dataset, &images, chosen, &config, &Silent)?;
    let (data, _) = correspondences(&dataset, &images, &pairs, &config, &Silent)?;
    let mut readings = Vec::new();
    let mut without = 0;
    for track in &data.tracks {
        let seen: Vec<_> =
            track.observations.iter().map(|o| (truth.base_from_color[o.posture], o.pixel, o.covariance)).collect();
        let first = &track.observations[0];
        let point = truth.at(first.posture, &first.pixel).and_then(|surface| {
            let start = Point3::from(truth.rig.color.unproject(&first.pixel) * surface.z_m);
            truth::triangulate(&truth.rig.color, &seen, &(seen[0].0 * start))
        });
        for observation in &track.observations {
            let Some(surface) = truth.at(observation.posture, &observation.pixel) else { continue };
            let Some(read_m) = observation.depth_m else {
                without += 1;
                continue;
            };
            let Some(around) = truth.surroundings(observation.posture, &observation.pixel, 0.01) else { continue };
            let point_off = point.as_ref().filter(|(_, covariance)| covariance.trace() < 1e-6).map(|(point, _)| {
                inverse_error((truth.base_from_color[observation.posture].inverse() * point).z, surface.z_m)
            });
            readings.push(Reading { z_m: surface.z_m, read_m, incidence: surface.incidence(), around, point_off });
        }
    }
    println!("{} observations with depth, {without} without", readings.len());
    tables(&readings);
    offset_and_scale(&readings);
    let seen: Vec<(usize, Pixel)> =
        data.tracks.iter().flat_map(|track| track.observations.iter().map(|o| (o.posture, o.pixel))).collect();
    rendered(&dataset, &truth, &seen)
}

/// The same places read from depth images of the true surface: exact, and with noise of several seeds, which separates
/// a bias of the reading from the luck of one recording. The middle of four pixels (bilinear in depth, steps of up to 4
/// %) is given beside it.
fn rendered(dataset: &Dataset, truth: &Truth, seen: &[(usize, Pixel)]) -> Result<(), Box<dyn std::error::Error>> {
    const SEEDS: u64 = 6;
    let Some(camera) = truth.rig.depth else { return Err("no depth camera".into()) };
    let (width, height) = (camera.camera.width, camera.camera.height);
    let noises = std::iter::once(DepthNoiseOptions::none())
        .chain((0..SEEDS).map(|seed| DepthNoiseOptions { seed: 77 + seed, ..DepthNoiseOptions::default() }));
    let noises: Vec<DepthNoiseOptions> = noises.collect();
    let mut errors = vec![[Vec::new(), Vec::new()]; noises.len()];
    for posture in 0..dataset.len() {
        let base_from_depth = truth.base_from_color[posture] * camera.color_from_depth;
        let exact = (0..height).flat_map(|y| (0..width).map(move |x| Pixel::new(f64::from(x), f64::from(y))));
        let exact = exact.map(|pixel| truth.along(&base_from_depth, &camera.camera.unproject(&pixel)));
        let exact = DepthImage::new(width, height, exact.map(|s| s.map_or(0.0, |s| s.z_m as f32)).collect())?;
        for (noise, errors) in noises.iter().zip(&mut errors) {
            let image = noise.apply(&exact, camera.unit_m, posture as u64)?;
            let Some(registered) = RegisteredDepth::new(&image, &camera, &truth.rig.color) else { continue };
            for (_, pixel) in seen.iter().filter(|(of, _)| *of == posture) {
                let Some(surface) = truth.at(posture, pixel) else { continue };
                let read = [registered.at(pixel), bilinear(&image, &camera, &truth.rig.color, pixel, surface.z_m)];
                for (errors, read_m) in errors.iter_mut().zip(read) {
                    errors.extend(read_m.map(|read_m| inverse_error(read_m, surface.z_m)));
                }
            }
        }
    }
    println!("read at the same places from images of the true surface");
    for (which, name) in [(0, "fitted plane"), (1, "bilinear")] {
        println!("  exact, {name:<13}{}", summary(&errors[0][which], GATE));
        for of_seed in &errors[1..] {
            println!("  noise, {name:<13}{}", summary(&of_seed[which], GATE));
        }
        let all: Vec<f64> = errors[1..].iter().flat_map(|of_seed| of_seed[which].iter().copied()).collect();
        println!("  all,   {name:<13}{}", summary(&all, GATE));
    }
    Ok(())
}

/// The former reading, from the true place.
fn bilinear(
    image: &DepthImage,
    camera: &DepthCamera,
    color: &PinholeCamera,
    pixel: &Pixel,
    true_m: f64,
) -> Option<f64> {
    let in_color = Point3::from(color.unproject(pixel) * true_m);
    let at = camera.camera.project(&(camera.color_from_depth.inverse() * in_color))?;
    Some(camera.point_in_color(&at, image.interpolate(&at, 0.04)?).z)
}

/// The depth images themselves.
fn sensor(dataset: &Dataset, truth: &Truth) -> Result<(), Box<dyn std::error::Error>> {
    println!("the depth image's own pixels, by range: count, mean +- its error, median, sigma, beyond the gate");
    let Some(camera) = truth.rig.depth else { return Err("no depth camera".into()) };
    let mut errors: Vec<(f64, f64)> = Vec::new();
    for posture in 0..dataset.len() {
        let Some(depth) = dataset.depth(posture)? else { continue };
        let base_from_depth = truth.base_from_color[posture] * camera.color_from_depth;
        for (x, y) in (0..depth.height()).step_by(5).flat_map(|y| (0..depth.width()).step_by(5).map(move |x| (x, y))) {
            let Some(read_m) = depth.at(x, y).map(f64::from) else { continue };
            let ray = camera.camera.unproject(&Pixel::new(f64::from(x), f64::from(y)));
            let Some(surface) = truth.along(&base_from_depth, &ray) else { continue };
            errors.push((surface.z_m, inverse_error(read_m, surface.z_m)));
        }
    }
    by_range(&errors);
    Ok(())
}

fn by_range(errors: &[(f64, f64)]) {
    for (low, high) in [(0.0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 1.0), (1.0, 1.4), (1.4, 2.0), (2.0, 4.0)] {
        let of: Vec<f64> = errors.iter().filter(|(z, _)| (low..high).contains(z)).map(|(_, error)| *error).collect();
        println!("  {low:>4.1} to {high:>4.1} m     {}", summary(&of, GATE));
    }
    println!("  all              {}", summary(&errors.iter().map(|(_, error)| *error).collect::<Vec<_>>(), GATE));
}

fn tables(readings: &[Reading]) {
    println!("read at features, by range");
    by_range(&readings.iter().map(|r| (r.z_m, r.error())).collect::<Vec<_>>());
    println!("... of those, where the surface is a plane for 16 px around");
    let plane = |r: &&Reading| r.around.radius_px.is_infinite();
    by_range(&readings.iter().filter(plane).map(|r| (r.z_m, r.error())).collect::<Vec<_>>());
    println!("by the distance to what is not on the plane, px");
    for radius_px in [1.0, 2.0, 4.0, 8.0, 16.0, f64::INFINITY] {
        for nearer in [true, false] {
            let of = readings.iter().filter(|r| r.around == Surroundings { radius_px, nearer });
            let errors: Vec<f64> = of.map(Reading::error).collect();
            let which = if nearer { "nearer" } else { "farther" };
            println!("  {radius_px:>4} {which:<8}   {}", summary(&errors, GATE));
        }
    }
    println!("by the cosine of incidence, planes alone");
    for (low, high) in [(0.0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.01)] {
        let of = readings.iter().filter(plane).filter(|r| (low..high).contains(&r.incidence));
        println!("  {low:.1} to {high:.1}       {}", summary(&of.map(Reading::error).collect::<Vec<_>>(), GATE));
    }
    println!("the point of the whole track beside the surface, by range");
    by_range(&readings.iter().filter_map(|r| Some((r.z_m, r.point_off?))).collect::<Vec<_>>());
    println!("the reading beside the point of the whole track, by range");
    by_range(&readings.iter().filter_map(|r| Some((r.z_m, r.error() - r.point_off?))).collect::<Vec<_>>());
}

/// What an adjustment with offset and scale free makes of these readings at the true poses.
fn offset_and_scale(readings: &[Reading]) {
    let loss = Loss::Tukey(7.0);
    for (name, with_scale, use_point) in [
        ("offset alone", false, false),
        ("offset and scale", true, false),
        ("offset and scale, beside the points", true, true),
    ] {
        let (mut offset, mut scale, mut sigma) = (0.0, 1.0, 3.0);
        let mut deviation = [f64::NAN; 2];
        for _ in 0..30 {
            let (mut normal, mut right) = (nalgebra::Matrix2::<f64>::zeros(), nalgebra::Vector2::<f64>::zeros());
            let mut sizes: Vec<f64> = Vec::new();
            for r in readings {
                let inverse = 1.0 / r.z_m - if use_point { 1e-3 * r.point_off.unwrap_or(f64::NAN) } else { 0.0 };
                if inverse.is_nan() {
                    continue;
                }
                let z = 1.0 / inverse;
                let expected = (z - offset) / scale;
                let residual = 1e3 * (1.0 / expected - 1.0 / r.read_m);
                sizes.push(residual.abs());
                let weight = loss.weight(residual / sigma) / (sigma * sigma);
                let by = nalgebra::Vector2::new(1.0, expected) * (1e3 / (expected * expected * scale));
                normal += by * by.transpose() * weight;
                right -= by * residual * weight;
            }
            sizes.sort_by(f64::total_cmp);
            sigma = sizes[sizes.len() / 2] * 1.4826;
            if with_scale {
                let Some(inverse) = normal.try_inverse() else { return };
                let step = inverse * right;
                offset += step.x;
                scale += step.y;
                deviation = [inverse[(0, 0)].sqrt(), inverse[(1, 1)].sqrt()];
            } else {
                offset += right.x / normal[(0, 0)];
                deviation[0] = normal[(0, 0)].sqrt().recip();
            }
        }
        println!(
            "{name}: {:.3} +- {:.3} mm, scale {:+.4} +- {:.4} %, sigma {sigma:.2}",
            1e3 * offset,
            1e3 * deviation[0],
            1e2 * (scale - 1.0),
            1e2 * deviation[1]
        );
    }
}
