//! `skclam compensate`.

use crate::args::Cli;
use anyhow::{Context, Result};
use clap::{Args, ValueHint};
use skclam::compensation::{CompensationOptions, TrueArm, read_targets, write_compensated};
use skclam::kinematics::SerialChain;
use skclam::output::StagedFolder;
use skclam::rig::Rig;
use std::path::{Path, PathBuf};

/// Arguments of `compensate`.
#[derive(Debug, Args)]
pub struct CompensateArgs {
    /// Targets: CSV with q1_deg ... (joints for the nominal arm) or x_mm, y_mm, z_mm, qx, qy, qz, qw (flange in base).
    #[arg(value_hint = ValueHint::FilePath)]
    pub targets: PathBuf,
    /// The rig that the controller believes in.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath)]
    pub nominal: PathBuf,
    /// The calibrated rig.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath)]
    pub calibrated: PathBuf,
    /// CSV for the result: the joints to command, and the pose to command where the controller takes poses only.
    #[arg(long, short, value_name = "CSV", value_hint = ValueHint::FilePath)]
    pub out: PathBuf,
}

/// Turns targets into what to command.
pub fn compensate(cli: &Cli, args: &CompensateArgs) -> Result<()> {
    let nominal = arm(&args.nominal)?;
    let rig = Rig::read(&args.calibrated)?;
    let chain = rig.robot.as_ref().with_context(|| no_robot(&args.calibrated))?;
    let calibrated = TrueArm { chain, joint_corrections: &rig.joint_corrections };
    let options = CompensationOptions::default();
    let table = read_targets(&args.targets, &nominal)?;
    let answers = table.compensate(&nominal, calibrated, &options)?;
    write_whole(&args.out, &write_compensated(&table, &answers, &nominal))?;
    // How far the uncorrected commands would have been off, by the calibrated arm.
    let mut misses = Vec::new();
    for answer in &answers {
        let reached = calibrated.base_from_flange(&answer.nominal_joints)?;
        misses.push(1e3 * (reached.translation.vector - answer.base_from_flange.translation.vector).norm());
    }
    let mean = misses.iter().sum::<f64>() / misses.len() as f64;
    let largest = misses.iter().copied().fold(0.0, f64::max);
    if cli.json {
        let summary =
            serde_json::json!({ "targets": answers.len(), "uncorrected_mean_mm": mean, "uncorrected_max_mm": largest });
        println!("{}", serde_json::to_string_pretty(&summary)?);
    } else {
        println!(
            "{} targets; uncorrected they would be missed by {mean:.3} mm in the mean, {largest:.3} mm at most\nCommands: {}",
            answers.len(),
            args.out.display()
        );
    }
    Ok(())
}

fn arm(path: &Path) -> Result<SerialChain> {
    Rig::read(path)?.robot.with_context(|| no_robot(path))
}

fn no_robot(path: &Path) -> String {
    format!("{}: the rig has no [robot]", path.display())
}

/// A single file, whole or not at all.
fn write_whole(path: &Path, text: &str) -> Result<()> {
    let name = path.file_name().with_context(|| format!("{}: name a file", path.display()))?;
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let staged = StagedFolder::new(folder)?;
    staged.write(name, text)?;
    staged.publish()?;
    Ok(())
}
