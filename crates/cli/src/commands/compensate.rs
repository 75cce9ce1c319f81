//! `skclam compensate`.

use crate::args::Cli;
use crate::screen::{self, say};
use anyhow::{Context, Result, bail};
use clap::{Args, ValueHint};
use skclam::compensation::{CompensationOptions, TrueArm, read_targets, write_compensated};
use skclam::kinematics::SerialChain;
use skclam::output::StagedFile;
use skclam::rig::Rig;
use std::path::{Path, PathBuf};

/// Arguments of `compensate`.
#[derive(Debug, Args)]
pub struct CompensateArgs {
    /// Targets: CSV with q1_deg ... (joints for the nominal arm) or x_mm, y_mm, z_mm, qx, qy, qz, qw (flange in base).
    #[arg(value_hint = ValueHint::FilePath)]
    pub targets: PathBuf,
    /// The rig that the controller uses.
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
    if same_file(&args.targets, &args.out) {
        bail!("{}: holds the targets, which would be lost; name another file", args.out.display());
    }
    let staged = StagedFile::new(&args.out)?;
    let nominal = arm(&args.nominal)?;
    let rig = Rig::read(&args.calibrated)?;
    let chain = rig.robot.as_ref().with_context(|| no_robot(&args.calibrated))?;
    let calibrated = TrueArm { chain, joint_corrections: &rig.joint_corrections };
    let options = CompensationOptions::default();
    let table = read_targets(&args.targets, &nominal)?;
    let answers = table.compensate(&nominal, calibrated, &options)?;
    let mut unreachable = Vec::new();
    // How far the uncorrected commands would have been off, by the calibrated arm.
    let mut misses = Vec::new();
    for (target, answer) in table.targets.iter().zip(&answers) {
        match answer {
            Ok(answer) => {
                let reached = calibrated.base_from_flange(&answer.nominal_joints)?;
                misses.push(1e3 * (reached.translation.vector - answer.base_from_flange.translation.vector).norm());
            }
            Err(problem) => unreachable.push((target.line, problem.to_string())),
        }
    }
    if let (true, Some((line, problem))) = (misses.is_empty(), unreachable.first()) {
        let (targets, count) = (args.targets.display(), answers.len());
        bail!("{targets}, line {line}: {problem} (nor is there a command for another of the {count} targets)");
    }
    staged.write(write_compensated(&table, &answers, &nominal))?;
    staged.publish()?;
    let warnings: Vec<String> = unreachable
        .iter()
        .map(|(line, problem)| format!("{}, line {line}: no command: {problem}", args.targets.display()))
        .collect();
    screen::warn_of(cli.quiet, &warnings, &format!("the column \"status\" of {}", args.out.display()));
    let mean = misses.iter().sum::<f64>() / misses.len() as f64;
    let largest = misses.iter().copied().fold(0.0, f64::max);
    if cli.json {
        let unreachable: Vec<_> =
            unreachable.iter().map(|(line, problem)| serde_json::json!({ "line": line, "problem": problem })).collect();
        let summary = serde_json::json!({
            "targets": answers.len(), "compensated": misses.len(), "without_command": unreachable,
            "uncorrected_mean_mm": mean, "uncorrected_max_mm": largest,
        });
        screen::json(&summary)?;
    } else {
        let of = if unreachable.is_empty() { String::new() } else { format!("{} of ", misses.len()) };
        say!(
            "{of}{} targets; uncorrected they would be missed by {mean:.3} mm in the mean, {largest:.3} mm at most\nCommands: {}",
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

fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}
