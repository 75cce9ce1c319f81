//! Is the estimator as good as it can be, and does it know how good it is?
//!
//! RMSE of every parameter over many noisy recordings against the Cramer-Rao bound (at most 1.2 times), and the mean
//! normalised estimation error squared (NEES) against its 95 % band. The bound is computed here by differences, apart
//! from the library's own Jacobians.
//!
//! `cargo run --release -p skclam-calibration --example monte_carlo [RUNS [PART...]]`: 200 runs by default, and of the
//! parts `pairwise`, `tracks`, `full`, `encoder`, `known` all but the last. Runs are spread over the cores; each has a
//! seed of its own, so that the tables do not depend on their number.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector3};
use rayon::prelude::*;
use skclam_calibration::*;
use skclam_geometry::{Isometry3, Point3};
use skclam_rig::{PostureState, Rig};

#[path = "../testing/synthetic.rs"]
mod synthetic;
use synthetic::{
    Errors, Sensing, box_points, diverse_postures, half_pixel, hp3j, joints, manufacture, normal, paper_postures,
    perturbed, seeded,
};

/// A scene without noise: points, and who sees them.
struct Scene {
    truth: Rig,
    postures: Vec<skclam_rig::Posture>,
    points: Vec<Point3>,
    exact: Correspondences,
    free: Free,
    sensing: Sensing,
}

/// Sigma of the encoders' noise, degrees.
const ENCODER_DEG: f64 = 0.003;

/// What a run says of itself.
struct Run {
    /// Estimate less truth.
    error: DVector<f64>,
    nees: f64,
    noise: Noise,
    /// Postures that were left out although nothing is wrong with any.
    left_out: usize,
}

enum Estimator {
    Pairwise,
    Bundle(PostureErrorPolicy),
}

fn main() {
    let runs = std::env::args().nth(1).and_then(|runs| runs.parse().ok()).unwrap_or(200usize);
    let angles =
        Errors { angle: 1f64.to_radians(), length: 0.0, mount_angle: 0.0, mount_length: 0.0, fixed_size: true };
    let rgbd = Sensing { depth_relative: Some(0.01 / 2.25 * 1.5), ..half_pixel() };
    let mut all: Vec<Parameter> = Free::Auto.candidates(&hp3j(), true, false).expect("the arm's own parameters");
    all.retain(|parameter| !parameter.is_nuisance());
    let scene = |free: &Free, errors: Errors, diverse: usize, sensing: Sensing| {
        let mut rng = seeded(2026);
        let truth = perturbed(&hp3j(), free, errors, &mut rng);
        let postures = if diverse > 0 { diverse_postures(&hp3j(), diverse, &mut rng) } else { paper_postures(&hp3j()) };
        let points = box_points(6000, &mut rng);
        let silent =
            Sensing { sigma_px: 0.0, depth_relative: sensing.depth_relative.map(|_| 0.0), encoder: 0.0, ..sensing };
        tracked(truth, postures, &points, silent, free.clone(), sensing)
    };
    let asked: Vec<String> = std::env::args().skip(2).collect();
    let part = |name: &str| if asked.is_empty() { name != "known" } else { asked.iter().any(|asked| asked == name) };
    println!("{runs} runs each, 1920 x 1080, 70 deg, 0.5 px; bound by differences\n");
    if part("pairwise") || part("tracks") {
        let ten = scene(&Free::Angles, angles, 0, half_pixel());
        if part("pairwise") {
            let name = "ten angles, the paper's 73 postures, pairwise: 72 pairs x 30 matches";
            report(name, &two_view(&ten, 30), &Estimator::Pairwise, runs);
        }
        if part("tracks") {
            let name = "ten angles, the paper's 73 postures, bundle adjustment of tracks";
            report(name, &ten, &Estimator::Bundle(PostureErrorPolicy::Off), runs);
        }
    }
    let list = Free::List(all);
    if part("full") {
        let full = scene(&list, manufacture(), 40, rgbd);
        let name = "24 parameters, RGB-D, 40 diverse postures, bundle adjustment";
        report(name, &full, &Estimator::Bundle(PostureErrorPolicy::Off), runs);
    }
    if part("encoder") || part("known") {
        let noisy = scene(&list, manufacture(), 40, Sensing { encoder: ENCODER_DEG.to_radians(), ..rgbd });
        if part("encoder") {
            let name = "the same with encoder noise of 0.003 deg, joint errors and their sigma estimated";
            report(name, &noisy, &Estimator::Bundle(PostureErrorPolicy::Estimated), runs);
        }
        if part("known") {
            let name = "the same with the sigma of the joint errors given";
            report(name, &noisy, &Estimator::Bundle(PostureErrorPolicy::SigmaDeg(ENCODER_DEG)), runs);
        }
    }
}

/// Keeps each track beside its point.
fn tracked(
    truth: Rig,
    postures: Vec<skclam_rig::Posture>,
    points: &[Point3],
    silent: Sensing,
    free: Free,
    sensing: Sensing,
) -> Scene {
    let (mut kept, mut tracks) = (Vec::new(), Vec::new());
    // One point at a time, so that tracks and points stay together; the limit an image is met by the number of points.
    for point in points {
        let one = synthetic::record(&truth, &postures, &[*point], silent, &mut seeded(0));
        if let Some(track) = one.tracks.into_iter().next() {
            kept.push(*point);
            tracks.push(track);
        }
    }
    let exact = Correspondences { postures: postures.clone(), tracks, ..Default::default() };
    Scene { truth, postures, points: kept, exact, free, sensing }
}

/// The paper's matches: neighbours only, each match with a point of its own.
fn two_view(scene: &Scene, per_pair: usize) -> Scene {
    let mut count = vec![0; scene.postures.len()];
    let (mut tracks, mut points) = (Vec::new(), Vec::new());
    for (track, point) in scene.exact.tracks.iter().zip(&scene.points) {
        for two in track.observations.windows(2).filter(|two| two[1].posture == two[0].posture + 1) {
            count[two[0].posture] += 1;
            if count[two[0].posture] <= per_pair {
                tracks.push(Track { observations: two.to_vec() });
                points.push(*point);
            }
        }
    }
    let exact = Correspondences { tracks, ..scene.exact.clone() };
    Scene {
        truth: scene.truth.clone(),
        postures: scene.postures.clone(),
        points,
        exact,
        free: scene.free.clone(),
        sensing: scene.sensing,
    }
}

fn report(name: &str, scene: &Scene, estimator: &Estimator, runs: usize) {
    let parameters = scene.free.candidates(&scene.truth, true, false).expect("a list without gaps");
    let bound = cramer_rao(scene, &parameters);
    let results: Vec<Run> = (0..runs).into_par_iter().map(|run| one_run(scene, estimator, run, &parameters)).collect();
    let count = parameters.len();
    let squares = results.iter().fold(DVector::zeros(count), |sum, run| sum + run.error.component_mul(&run.error));
    let mean = |of: &dyn Fn(&Run) -> f64| results.iter().map(of).sum::<f64>() / runs as f64;
    let nees = mean(&|run| run.nees);
    let half = 1.96 * (2.0 * count as f64 / runs as f64).sqrt();
    println!("## {name}\n");
    println!("{} tracks, {} observations\n", scene.exact.tracks.len(), scene.exact.observation_count());
    println!("| parameter | bound | RMSE | RMSE / bound |\n| --- | --- | --- | --- |");
    let mut worst: f64 = 0.0;
    for (k, parameter) in parameters.iter().enumerate() {
        let rmse = (squares[k] / runs as f64).sqrt();
        let (unit, size) = match parameter.unit() {
            Unit::Radian => (180.0 / std::f64::consts::PI, "deg"),
            Unit::Metre => (1e3, "mm"),
            _ => (1.0, ""),
        };
        let ratio = rmse / bound[k];
        worst = worst.max(ratio);
        println!("| {parameter} | {:.5} {size} | {:.5} {size} | {ratio:.3} |", bound[k] * unit, rmse * unit);
    }
    let (low, high) = (count as f64 - half, count as f64 + half);
    let verdict = |good: bool| if good { "ok" } else { "NOT REACHED" };
    println!("\nlargest ratio {worst:.3} (at most 1.2: {})", verdict(worst <= 1.2));
    println!("mean NEES {nees:.2} of {count}, 95 % band {low:.2} to {high:.2}: {}", verdict(nees > low && nees < high));
    print!("means: pixel noise {:.4} px", mean(&|run| run.noise.pixel));
    if let Some(depth) = scene.sensing.depth_relative {
        print!(", depth noise / truth {:.4}", mean(&|run| run.noise.depth_sigma_per_m2.unwrap_or(f64::NAN)) / depth);
    }
    if results.iter().all(|run| run.noise.posture_angular.is_some()) {
        let sigma = |run: &Run| run.noise.posture_angular.unwrap_or(f64::NAN).to_degrees();
        let of = mean(&sigma);
        let spread = mean(&|run| (sigma(run) - of).powi(2)).sqrt();
        print!(", sigma of joint errors {of:.5} deg (standard deviation {spread:.5})");
    }
    let left_out: usize = results.iter().map(|run| run.left_out).sum();
    println!("; postures left out in all runs: {left_out}\n");
}

fn one_run(scene: &Scene, estimator: &Estimator, run: usize, parameters: &[Parameter]) -> Run {
    let mut rng = seeded(1000 + run as u64);
    let nominal = hp3j();
    let mut data = scene.exact.clone();
    if scene.sensing.encoder > 0.0 {
        // The arm is where the postures say; the encoders report something else.
        for posture in &mut data.postures {
            if let PostureState::Joints(values) = &mut posture.state {
                values.iter_mut().for_each(|value| *value += scene.sensing.encoder * normal(&mut rng));
            }
        }
    }
    for observation in data.tracks.iter_mut().flat_map(|track| &mut track.observations) {
        observation.pixel.x += scene.sensing.sigma_px * normal(&mut rng);
        observation.pixel.y += scene.sensing.sigma_px * normal(&mut rng);
        if let (Some(depth), Some(relative)) = (&mut observation.depth_m, scene.sensing.depth_relative) {
            *depth += relative * *depth * *depth * normal(&mut rng);
        }
    }
    let result = match estimator {
        Estimator::Pairwise => {
            let mut pairs: Vec<PairMatches> =
                (1..scene.postures.len()).map(|b| PairMatches { a: b - 1, b, matches: Vec::new() }).collect();
            for track in &data.tracks {
                let [a, b] = &track.observations[..] else { continue };
                pairs[a.posture].matches.push(PairMatch { in_a: a.pixel, in_b: b.pixel, sigma_px: 1.0, distance: 0 });
            }
            let data = Correspondences { pairs, tracks: Vec::new(), ..data };
            calibrate_pairwise(&nominal, &data, &PairwiseOptions { free: scene.free.clone(), ..Default::default() })
        }
        Estimator::Bundle(posture_errors) => {
            let options =
                BundleOptions { free: scene.free.clone(), posture_errors: *posture_errors, ..Default::default() };
            calibrate_bundle(&nominal, &data, &options)
        }
    }
    .expect("a recording that can be calibrated");
    let truth = Model::new(scene.truth.clone());
    let error = DVector::from_iterator(
        parameters.len(),
        result.parameters.iter().map(|e| e.value - truth.value(&nominal, e.parameter).expect("known")),
    );
    let covariance = result.covariance.expect("least squares has one");
    let scale = DVector::from_fn(parameters.len(), |k, _| 1.0 / covariance[(k, k)].sqrt());
    let unit = DMatrix::from_fn(parameters.len(), parameters.len(), |i, j| covariance[(i, j)] * scale[i] * scale[j]);
    let scaled = error.component_mul(&scale);
    let solved = unit.cholesky().expect("a covariance").solve(&scaled);
    let left_out = |warning: &&Warning| matches!(warning, Warning::OutlierPosture { excluded: true, .. });
    let left_out = result.warnings.iter().filter(left_out).count();
    Run { nees: scaled.dot(&solved), error, noise: result.noise, left_out }
}

/// Sigmas of the bound: information of all observations with points (and joint errors under their prior) eliminated.
fn cramer_rao(scene: &Scene, parameters: &[Parameter]) -> Vec<f64> {
    let count = parameters.len();
    let model = Model::new(scene.truth.clone());
    let encoder = scene.sensing.encoder;
    let joint_count = if encoder > 0.0 { 6 } else { 0 };
    let total = count + joint_count * scene.postures.len();
    // camera_from_base of every posture for a change of every unknown, by differences.
    let step = |k: usize| if k < count { parameters[k].scale() * 1e-4 } else { 1e-6 };
    let pose = |posture: usize, unknown: usize, sign: f64| -> Isometry3 {
        let mut at = scene.postures[posture].clone();
        if unknown < count {
            let moved = model.stepped(&[parameters[unknown]], &[sign * step(unknown)]).expect("a small step");
            return moved.rig.base_from_color(&at).expect("a pose").inverse();
        }
        if let PostureState::Joints(values) = &mut at.state {
            values[unknown - count] += sign * step(unknown);
        }
        scene
            .truth
            .base_from_color(&joints(
                posture,
                match &at.state {
                    PostureState::Joints(v) => v,
                    _ => &[],
                },
            ))
            .expect("a pose")
            .inverse()
    };
    let moved: Vec<Vec<(Isometry3, Isometry3)>> = (0..scene.postures.len())
        .map(|posture| (0..count + joint_count).map(|k| (pose(posture, k, 1.0), pose(posture, k, -1.0))).collect())
        .collect();
    let camera = &scene.truth.color;
    let measure = |camera_from_base: &Isometry3, point: &Point3, depth: bool| -> Vector3<f64> {
        let at = camera_from_base * point;
        let pixel = camera.project(&at).expect("in front");
        let relative = scene.sensing.depth_relative.unwrap_or(1.0);
        // The depth in its own sigmas (of the true depth), pixels in theirs.
        let z = if depth { -1.0 / (relative * at.z) } else { 0.0 };
        Vector3::new(pixel.x / scene.sensing.sigma_px, pixel.y / scene.sensing.sigma_px, z)
    };
    let mut information = DMatrix::<f64>::zeros(total, total);
    for (track, point) in scene.exact.tracks.iter().zip(&scene.points) {
        let mut own = Matrix3::zeros();
        let mut rows: Vec<(usize, SMatrix<f64, 3, 3>, Vec<Vector3<f64>>)> = Vec::new();
        for observation in &track.observations {
            let depth = observation.depth_m.is_some();
            let here = scene.truth.base_from_color(&scene.postures[observation.posture]).expect("a pose").inverse();
            let by_point = Matrix3::from_columns(&std::array::from_fn::<_, 3, _>(|axis| {
                let mut offset = Vector3::zeros();
                offset[axis] = 1e-6;
                (measure(&here, &(point + offset), depth) - measure(&here, &(point - offset), depth)) / 2e-6
            }));
            let by_unknown = (0..count + joint_count)
                .map(|k| {
                    let (up, down) = &moved[observation.posture][k];
                    (measure(up, point, depth) - measure(down, point, depth)) / (2.0 * step(k))
                })
                .collect();
            own += by_point.transpose() * by_point;
            rows.push((observation.posture, by_point, by_unknown));
        }
        let index = |posture: usize, k: usize| if k < count { k } else { count + posture * joint_count + k - count };
        let mut coupling: std::collections::BTreeMap<usize, Vector3<f64>> = Default::default();
        for (posture, by_point, by_unknown) in &rows {
            for (k, a) in by_unknown.iter().enumerate() {
                *coupling.entry(index(*posture, k)).or_insert_with(Vector3::zeros) += by_point.transpose() * a;
                for (l, b) in by_unknown.iter().enumerate() {
                    information[(index(*posture, k), index(*posture, l))] += a.dot(b);
                }
            }
        }
        let inverse = own.try_inverse().expect("a point that two images fix");
        for (i, a) in &coupling {
            let y = inverse * a;
            for (j, b) in &coupling {
                information[(*i, *j)] -= y.dot(b);
            }
        }
    }
    for k in count..total {
        information[(k, k)] += 1.0 / (encoder * encoder);
    }
    let scale = DVector::from_fn(total, |k, _| 1.0 / information[(k, k)].sqrt());
    let unit = DMatrix::from_fn(total, total, |i, j| information[(i, j)] * scale[i] * scale[j]);
    let inverse = unit.cholesky().expect("a normal matrix of full rank").inverse();
    (0..count).map(|k| inverse[(k, k)].sqrt() * scale[k]).collect()
}
