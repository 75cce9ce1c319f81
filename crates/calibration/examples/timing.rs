//! How long the estimators take.
//!
//! `cargo run --release -p skclam-calibration --example timing [pairwise|bundle]`

use skclam_calibration::*;
use skclam_geometry::Pixel;
use std::time::Instant;

#[path = "../testing/synthetic.rs"]
mod synthetic;
use synthetic::{
    Errors, Sensing, box_points, diverse_postures, fresh_pairs, half_pixel, hp3j, manufacture, neighbours,
    paper_postures, perturbed, record, seeded,
};

fn main() {
    let which = std::env::args().nth(1).unwrap_or_default();
    if which != "bundle" {
        pairwise();
    }
    if which != "pairwise" {
        bundle();
    }
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(peak) = status.lines().find(|line| line.starts_with("VmHWM")) {
        println!("peak memory {}", peak.trim_start_matches("VmHWM:").trim());
    }
}

/// User and system time of all threads so far; 0 where `/proc` is missing (ticks of 10 ms).
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace();
    fields.skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// 1e5 Sampson residuals, the paper's ten angles. The same problem is written for the comparison with SciPy and Ceres
/// when `SKCLAM_DUMP` names a file.
fn pairwise() {
    let mut rng = seeded(1);
    let errors =
        Errors { angle: 1f64.to_radians(), length: 0.0, mount_angle: 0.0, mount_length: 0.0, fixed_size: true };
    let truth = perturbed(&hp3j(), &Free::Angles, errors, &mut rng);
    let postures = paper_postures(&hp3j());
    let pairs = fresh_pairs(&truth, &postures, &neighbours(73), 1389, half_pixel(), &mut rng);
    let data = Correspondences { postures, pairs, ..Default::default() };
    if let Ok(path) = std::env::var("SKCLAM_DUMP") {
        dump(&truth, &data, &path);
    }
    for loss in [Loss::Squared, Loss::Tukey(7.0)] {
        let options = PairwiseOptions { free: Free::Angles, loss, ..Default::default() };
        let mut best = f64::INFINITY;
        let mut outcome = String::new();
        for _ in 0..5 {
            let start = Instant::now();
            let result = calibrate_pairwise(&hp3j(), &data, &options).expect("a calibration");
            best = best.min(start.elapsed().as_secs_f64());
            outcome = result.termination.to_string();
        }
        println!(
            "pairwise, {} residuals, 10 parameters, {loss:?}, everything included: {:.1} ms; {outcome}",
            data.match_count(),
            best * 1e3
        );
    }
    let refine = PairwiseOptions {
        free: Free::Angles,
        loss: Loss::Squared,
        search: Search::Off,
        max_rounds: 1,
        ..Default::default()
    };
    let (mut best, mut best_cpu) = (f64::INFINITY, f64::INFINITY);
    let mut outcome = String::new();
    for _ in 0..20 {
        let (start, cpu) = (Instant::now(), precise_cpu_seconds());
        let result = calibrate_pairwise(&hp3j(), &data, &refine).expect("a calibration");
        best_cpu = best_cpu.min(precise_cpu_seconds() - cpu);
        best = best.min(start.elapsed().as_secs_f64());
        outcome = format!("{}; theta_offset_6 {:.9} rad", result.termination, result.parameters[9].value);
    }
    // As `compare_solvers.py` reads it.
    println!(
        "cpu_ms={:.3} wall_ms={:.3} solver=ours, one plain least-squares solve from the nominal arm, covariance and statistics included (threads {}): {outcome}",
        best_cpu * 1e3,
        best * 1e3,
        rayon::current_num_threads()
    );
}

/// Time that all threads have run so far, in nanoseconds where the kernel counts it; else as [`cpu_seconds`].
fn precise_cpu_seconds() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let run = tasks.filter_map(|task| {
        let outcome = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
        outcome.split_whitespace().next()?.parse::<f64>().ok()
    });
    let nanoseconds: f64 = run.sum();
    if nanoseconds > 0.0 { nanoseconds * 1e-9 } else { cpu_seconds() }
}

/// Angles nominal and true, joint values, and matches as CSV.
fn dump(truth: &skclam_rig::Rig, data: &Correspondences, path: &str) {
    use std::fmt::Write;
    let mut text = String::from("a,b,x_a,y_a,x_b,y_b\n");
    for pair in &data.pairs {
        for PairMatch { in_a: Pixel { coords: a }, in_b: Pixel { coords: b }, .. } in &pair.matches {
            let _ = writeln!(text, "{},{},{},{},{},{}", pair.a, pair.b, a.x, a.y, b.x, b.y);
        }
    }
    std::fs::write(format!("{path}-matches.csv"), text).expect("a file");
    let mut text = String::new();
    for posture in &data.postures {
        if let skclam_rig::PostureState::Joints(values) = &posture.state {
            let _ = writeln!(text, "{}", values.iter().map(f64::to_string).collect::<Vec<_>>().join(","));
        }
    }
    std::fs::write(format!("{path}-joints.csv"), text).expect("a file");
    let mut text = String::new();
    let model = Model::new(truth.clone());
    for parameter in Free::Angles.candidates(truth, true, false).expect("ten") {
        let nominal = Model::new(hp3j()).value(&hp3j(), parameter).expect("known");
        let _ = writeln!(text, "{parameter},{nominal},{}", model.value(&hp3j(), parameter).expect("known"));
    }
    std::fs::write(format!("{path}-angles.csv"), text).expect("a file");
}

/// A million observations, 60 parameters, as `--free all` with gears and compliance.
fn bundle() {
    let mut rng = seeded(2);
    let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
    let postures = diverse_postures(&hp3j(), 100, &mut rng);
    // Fewer observations on demand: `timing bundle 100000`.
    let observations =
        std::env::args().nth(2).and_then(|observations| observations.parse().ok()).unwrap_or(1_000_000usize);
    let points = box_points(observations, &mut rng);
    let sensing = Sensing { depth_relative: Some(0.0044), keypoints: observations / 100, ..half_pixel() };
    let data = record(&truth, &postures, &points, sensing, &mut rng);
    drop(points);
    let mut parameters = Free::All.candidates(&hp3j(), true, true).expect("the rig's own");
    parameters.extend((0..6).flat_map(|j| [Parameter::TransmissionSin(j), Parameter::TransmissionCos(j)]));
    parameters.push(Parameter::Compliance(1));
    parameters.push(Parameter::Compliance(2));
    parameters.push(Parameter::TimeOffset);
    println!(
        "bundle: {} observations, {} tracks, {} postures, {} parameters",
        data.observation_count(),
        data.tracks.len(),
        data.postures.len(),
        parameters.len()
    );
    let options = BundleOptions {
        free: Free::List(parameters),
        priors: PriorPolicy::Always,
        posture_errors: PostureErrorPolicy::Off,
        ..Default::default()
    };
    for (name, options) in [
        ("no joint errors", options.clone()),
        ("joint errors estimated", BundleOptions { posture_errors: PostureErrorPolicy::Estimated, ..options }),
    ] {
        let (start, cpu) = (Instant::now(), cpu_seconds());
        let result = calibrate_bundle(&hp3j(), &data, &options).expect("a calibration");
        println!(
            "{name}, everything included: {:.2} s, {:.2} s of CPU; {}; {:?}",
            start.elapsed().as_secs_f64(),
            cpu_seconds() - cpu,
            result.termination,
            result.noise
        );
    }
}
