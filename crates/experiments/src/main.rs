//! The experiments as one program.

use anyhow::Result;
use clap::{Parser, Subcommand};
use skclam_experiments::experiments::{boards_and_ruler, flange_poses, misspecification, real_arm, whole_pipeline};

/// Experiments that compare what a run claims with the truth. Tables are printed as Markdown, row by row.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Subcommand)]
enum Experiment {
    /// NEES, coverage and camera error over claim on random cells with images.
    WholePipeline(whole_pipeline::Arguments),
    /// Wrong assumptions: true and claimed error, status, named cause.
    Misspecification(misspecification::Arguments),
    /// Mount errors with the flange poses of a wrong arm, by default and with --free mount.
    FlangePoses(flange_poses::Arguments),
    /// A real arm judged by an optical tracker, and by a second day.
    RealArm(real_arm::Arguments),
    /// True and claimed camera error with a wrong ruler.
    BoardsAndRuler(boards_and_ruler::Arguments),
}

fn main() -> Result<()> {
    match Arguments::parse().experiment {
        Experiment::WholePipeline(arguments) => whole_pipeline::run(&arguments),
        Experiment::Misspecification(arguments) => misspecification::run(&arguments),
        Experiment::FlangePoses(arguments) => flange_poses::run(&arguments),
        Experiment::RealArm(arguments) => real_arm::run(&arguments),
        Experiment::BoardsAndRuler(arguments) => boards_and_ruler::run(&arguments),
    }
}
