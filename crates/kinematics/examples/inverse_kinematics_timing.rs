//! Times the inverse kinematics of the HP3-like arm and prints how often and how fast the refinement converges on an
//! arm that is off by up to 1 deg and 1 mm in every parameter.
//!
//! `cargo run --release -p skclam-kinematics --example inverse_kinematics_timing`

use skclam_kinematics::{
    RefinementOptions, SerialChain, Termination, refine_inverse_kinematics, spherical_wrist_solutions,
};
use std::hint::black_box;
use std::time::Instant;

/// Numbers in [-1, 1) from a linear congruential generator (Knuth's MMIX constants).
struct Draws(u64);

impl Draws {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let nominal =
        skclam_rig::builtin_rig("hp3-like").ok_or("a built-in robot")??.robot.ok_or("the rig has no [robot]")?;
    let mut draws = Draws(1);
    let mut real: SerialChain = nominal.clone();
    for id in nominal.parameter_ids() {
        let size = if id.kind.is_angle() { 1f64.to_radians() } else { 1e-3 };
        real.set_parameter(id, nominal.parameter(id).unwrap_or_default() + size * draws.next())?;
    }
    let mut poses = Vec::new();
    for _ in 0..10_000 {
        let joint_values: Vec<f64> = (0..6).map(|_| 3.0 * draws.next()).collect();
        poses.push(nominal.base_from_flange(&joint_values)?);
    }
    let start = Instant::now();
    let mut solutions = Vec::with_capacity(poses.len());
    for pose in &poses {
        solutions.push(black_box(spherical_wrist_solutions(&nominal, pose)?));
    }
    let closed_form = start.elapsed();
    let branches: usize = solutions.iter().map(Vec::len).sum();
    let start = Instant::now();
    let (mut converged, mut iterations) = (0, 0);
    for (pose, solutions) in poses.iter().zip(&solutions) {
        for solution in solutions {
            let got = refine_inverse_kinematics(&real, pose, &solution.joint_values, &RefinementOptions::default())?;
            if got.termination == Termination::Converged {
                converged += 1;
                iterations += got.iterations;
            }
        }
    }
    let refinement = start.elapsed();
    println!("closed form: {:.2} us a pose, {branches} branches", 1e6 * closed_form.as_secs_f64() / poses.len() as f64);
    println!(
        "refinement on the arm that is off: {:.1} us a branch, {:.2} iterations, {:.1} % of all branches converged",
        1e6 * refinement.as_secs_f64() / branches as f64,
        iterations as f64 / converged as f64,
        100.0 * converged as f64 / branches as f64,
    );
    Ok(())
}
