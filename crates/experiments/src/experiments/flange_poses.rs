//! Flange poses of a controller whose arm is wrong: is the mount found by default as well as by `--free mount`, and is
//! its sigma right?
//!
//! `cargo run --release -p skclam-experiments -- flange-poses [--cells N]`. Images are taken by a perturbed arm;
//! `postures.csv` holds the *nominal* arm's flange poses. Two truths are compared: the mount of the true arm, and the
//! one that fits the true camera poses best to the controller's flange poses, which no method can beat.

use crate::cells::{Cell, CellOptions};
use crate::measured::shown;
use crate::statistics::{median, rms};
use anyhow::{Context, Result};
use clap::Args;
use cpu_time::ProcessTime;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::pipeline::{Config, Outcome, run_without_map};
use skclam::progress::Silent;
use skclam::rig::{PostureState, Rig};
use skclam::trajectory::read_trajectory;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Mount errors with flange poses of a wrong arm.
#[derive(Args)]
pub struct Arguments {
    /// How many cells.
    #[arg(long, default_value_t = 10)]
    cells: u64,
    /// Seed of the first cell; the others follow.
    #[arg(long, default_value_t = 101)]
    seed: u64,
    /// Scale of the colour image: 1 is 1920x1080. By default as `whole_pipeline` draws it, so that both share their
    /// cells.
    #[arg(long)]
    scale: Option<f64>,
    /// Postures of a cell.
    #[arg(long, default_value_t = 48)]
    postures: usize,
    /// Standard deviation of the encoders, degrees.
    #[arg(long, default_value_t = 0.003)]
    encoder_noise_deg: f64,
    /// Without the depth camera.
    #[arg(long)]
    no_depth: bool,
    /// Folder for cells.
    #[arg(long, default_value = "out/experiments", value_name = "DIR")]
    work: PathBuf,
}

/// Position and orientation.
#[derive(Clone, Copy)]
struct MountError {
    mm: f64,
    deg: f64,
}

/// A mount beside its truths.
struct Judged {
    to_true: MountError,
    to_best: MountError,
    sigma: MountError,
    status: String,
}

/// Prints the tables.
///
/// # Errors
/// Data that cannot be read; a single run that fails is a row.
pub fn run(arguments: &Arguments) -> Result<()> {
    println!(
        "| cell | best possible mm, deg | default: to true mm, deg | to best mm, deg | sigma mm, deg | status | --free mount: to true mm, deg \
         | to best mm, deg | sigma mm, deg | status | default / --free mount | CPU s |"
    );
    println!("|{}", " --- |".repeat(12));
    let mut all = Vec::new();
    for seed in arguments.seed..arguments.seed + arguments.cells {
        let begun = ProcessTime::now();
        let scale = arguments.scale.unwrap_or(0.25 + 0.15 * (seed as f64 * 0.618_034).fract());
        let Arguments { postures, encoder_noise_deg, .. } = *arguments;
        let cell = Cell::rendered(&arguments.work, &CellOptions { seed, scale, postures, encoder_noise_deg })?;
        match both(&cell, arguments.no_depth) {
            Ok((best, by_default, mount_alone)) => {
                let of_best = error(&best, &cell.truth.flange_from_color);
                let ratio = by_default.to_true.mm / mount_alone.to_true.mm;
                let seconds = begun.elapsed().as_secs_f64();
                let [one, two] = [&by_default, &mount_alone].map(text);
                println!("| {seed} | {} | {one} | {two} | {ratio:.2} | {seconds:.0} |", pair(of_best));
                all.push((by_default, mount_alone));
            }
            Err(problem) => println!("| {seed} | FAILED: {problem:#} |{}", " |".repeat(10)),
        }
        std::io::stdout().flush()?;
    }
    print_pooled(&all);
    Ok(())
}

/// The best mount there is, and those that were found with the default and with `--free mount`.
fn both(cell: &Cell, no_depth: bool) -> Result<(Isometry3<f64>, Judged, Judged)> {
    let dataset = controllers_view(cell, no_depth)?;
    let poses = read_trajectory(&cell.dataset.path_of(Path::new("truth/trajectory.txt")))?;
    let pairs = dataset.records.iter().zip(&poses).map(|(record, pose)| match &record.posture.state {
        PostureState::FlangePose(flange) => Ok(flange.inverse() * pose.base_from_camera),
        PostureState::Joints(_) => anyhow::bail!("joint values where flange poses are wanted"),
    });
    let best = average(&pairs.collect::<Result<Vec<_>>>()?);
    let judged = |free: Free| -> Result<Judged> {
        let outcome = run_without_map(&dataset, &Config { free, ..Config::default() }, &Silent)?;
        let mount = outcome.rig.flange_from_color;
        Ok(Judged {
            to_true: error(&mount, &cell.truth.flange_from_color),
            to_best: error(&mount, &best),
            sigma: sigma(&outcome)?,
            status: format!("{:?}", shown(&serde_json::to_value(&outcome.summary)?)?.status),
        })
    };
    Ok((best, judged(Free::Auto)?, judged(Free::parse("mount", &dataset.rig)?)?))
}

/// The recording with what the controller, which uses the nominal arm, says of the flange.
fn controllers_view(cell: &Cell, no_depth: bool) -> Result<Dataset> {
    let mut dataset = cell.dataset.clone();
    for record in &mut dataset.records {
        let flange = dataset.rig.base_from_flange(&record.posture)?;
        record.posture.state = PostureState::FlangePose(flange);
        record.posture.joint_rates.clear();
        if no_depth {
            record.depth = None;
        }
    }
    let depth = dataset.rig.depth.filter(|_| !no_depth);
    dataset.rig = Rig { robot: None, depth, ..dataset.rig };
    Ok(dataset)
}

/// Mean translation, and the rotation with the least sum of squared angles (a few rounds of averaging in the tangent
/// space).
fn average(poses: &[Isometry3<f64>]) -> Isometry3<f64> {
    let count = poses.len() as f64;
    let center: Vector3<f64> = poses.iter().map(|pose| pose.translation.vector).sum::<Vector3<f64>>() / count;
    let mut rotation = poses.first().map_or_else(UnitQuaternion::identity, |pose| pose.rotation);
    for _ in 0..20 {
        let off: Vector3<f64> = poses.iter().map(|pose| (rotation.inverse() * pose.rotation).scaled_axis()).sum();
        rotation *= UnitQuaternion::from_scaled_axis(off / count);
    }
    Isometry3::from_parts(Translation3::from(center), rotation)
}

fn error(found: &Isometry3<f64>, truth: &Isometry3<f64>) -> MountError {
    MountError {
        mm: 1e3 * (found.translation.vector - truth.translation.vector).norm(),
        deg: found.rotation.angle_to(&truth.rotation).to_degrees(),
    }
}

/// Roots of the summed variances of the mount's translations and rotations.
fn sigma(outcome: &Outcome) -> Result<MountError> {
    let sum = |names: [&str; 3]| -> Result<f64> {
        let parameters = &outcome.calibration.parameters;
        let of = |name: &str| parameters.iter().find(|estimate| estimate.parameter.to_string() == name)?.sigma;
        let squares = names.map(|name| of(name).map(|sigma| sigma * sigma));
        let sum: Option<f64> = squares.into_iter().sum();
        Ok(sum.context("the mount has no sigma")?.sqrt())
    };
    Ok(MountError {
        mm: 1e3 * sum(["mount_x", "mount_y", "mount_z"])?,
        deg: sum(["mount_rx", "mount_ry", "mount_rz"])?.to_degrees(),
    })
}

fn pair(error: MountError) -> String {
    format!("{:.2}, {:.3}", error.mm, error.deg)
}

fn text(judged: &Judged) -> String {
    format!("{} | {} | {} | {}", pair(judged.to_true), pair(judged.to_best), pair(judged.sigma), judged.status)
}

fn print_pooled(all: &[(Judged, Judged)]) {
    let of = |value: &dyn Fn(&(Judged, Judged)) -> f64| all.iter().map(value).collect::<Vec<f64>>();
    let ratio = of(&|(by_default, mount)| by_default.to_true.mm / mount.to_true.mm);
    println!("\n| over {} cells | | needed |\n| --- | --- | --- |", all.len());
    let worst = ratio.iter().copied().fold(0.0, f64::max);
    println!("| default / --free mount, median and largest | {:.2}, {worst:.2} | at most 1.1 |", median(&ratio));
    let both = [of(&|(d, _)| d.to_true.mm), of(&|(_, m)| m.to_true.mm)].map(|errors| rms(&errors));
    println!("| RMS mount error, default and --free mount, mm | {:.2}, {:.2} | |", both[0], both[1]);
    // A position's error over the root of its summed variances is 1 in the root of the mean square.
    let honest = |judged: &dyn Fn(&(Judged, Judged)) -> f64| rms(&of(judged));
    println!(
        "| error / sigma, RMS: default to true, default to best, --free mount to true | {:.2}, {:.2}, {:.2} | about 1 |",
        honest(&|(d, _)| d.to_true.mm / d.sigma.mm),
        honest(&|(d, _)| d.to_best.mm / d.sigma.mm),
        honest(&|(_, m)| m.to_true.mm / m.sigma.mm)
    );
}
