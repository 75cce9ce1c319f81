//! A real arm judged by an optical tracker, and by a second day.
//!
//! `cargo run --release -p skclam-experiments -- real-arm`. Reads `nachi-mz25` and `nachi-mz25-second-day` in
//! `../shared/data` (or in `SKCLAM_DATA`). The tracker's points are those of `nachi-mz25/tracker.csv` for both days: it
//! is one arm.

use crate::measured::{claimed, shown};
use crate::two_days::disagreement;
use anyhow::Result;
use clap::Args;
use cpu_time::ProcessTime;
use skclam::dataset::Dataset;
use skclam::marker_points::{MarkerPoints, validate_points};
use skclam::pipeline::{self, Config, Outcome};
use skclam::progress::Silent;
use skclam::rig::{Posture, PostureState};
use std::io::Write;
use std::path::PathBuf;

/// RMS against the tracker beside claims, for both days.
#[derive(Args)]
pub struct Arguments {
    /// Data sets of one arm; the first brings `tracker.csv`.
    #[arg(default_values = ["nachi-mz25", "nachi-mz25-second-day"])]
    datasets: Vec<String>,
    /// Settings as a JSON file, as `skclam run --config` takes them.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Prints the tables.
///
/// # Errors
/// Data that cannot be read, or a run that fails.
pub fn run(arguments: &Arguments) -> Result<()> {
    let config = match &arguments.config {
        None => Config::default(),
        Some(path) => Config::default().overlaid(&std::fs::read_to_string(path)?)?,
    };
    let shared = std::env::var_os("SKCLAM_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folders: Vec<PathBuf> = arguments.datasets.iter().map(|name| shared.join(name)).collect();
    let points = MarkerPoints::read(folders[0].join("tracker.csv"))?;
    let posture_of = |(at, joints): (usize, &Vec<f64>)| Posture::new(at as u64, PostureState::Joints(joints.clone()));
    let postures: Vec<Posture> = points.points.iter().map(|point| &point.joints).enumerate().map(posture_of).collect();
    println!(
        "| recording | tracker RMS mm: nominal | calibrated | first sentence mm | calibrated / first sentence | claimed at the tracker's points mm \
         | held-out px: nominal | mount alone | calibrated | status | CPU s |"
    );
    println!("|{}", " --- |".repeat(11));
    let mut outcomes: Vec<(String, Outcome)> = Vec::new();
    for folder in &folders {
        let dataset = Dataset::open(folder)?;
        let begun = ProcessTime::now();
        let outcome = pipeline::run(&dataset, &config, &Silent)?;
        let seconds = begun.elapsed().as_secs_f64();
        let shown = shown(&serde_json::to_value(&outcome.summary)?)?;
        let validation = validate_points(&points, &outcome.rig, Some(&dataset.rig))?;
        let (calibrated, nominal) = (validation.tested.rms_mm, validation.nominal.map(|nominal| nominal.rms_mm));
        let at_points = claimed(&dataset.rig, &outcome, &postures)?.map(|claimed| claimed.mm);
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.3}"));
        let held_out = shown.held_out.unwrap_or_default().map(number).join(" | ");
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        println!(
            "| {name} | {} | {calibrated:.3} | {} | {} | {} | {held_out} | {:?} | {seconds:.0} |",
            number(nominal),
            number(shown.sentence_sigma_mm),
            number(shown.sentence_sigma_mm.map(|sigma| calibrated / sigma)),
            number(at_points),
            shown.status
        );
        std::io::stdout().flush()?;
        outcomes.push((format!("{name}: {}", shown.sentence), outcome));
    }
    println!();
    outcomes.iter().for_each(|(sentence, _)| println!("- {sentence}"));
    for pair in outcomes.windows(2) {
        let (chi_squared, count) = disagreement(&pair[0].1.calibration, &pair[1].1.calibration)?;
        println!("\nchi2/n of the arm's {count} shared parameters between the two: {:.2}", chi_squared / count as f64);
    }
    Ok(())
}
