//! A real arm judged by an optical tracker, and by a second day.
//!
//! `cargo run --release -p skclam-experiments --bin real_arm`. Reads `nachi-mz25` and `nachi-mz25-second-day` in `../shared/data` (or in `SKCLAM_DATA`).
//! The tracker's points are those of `nachi-mz25/tracker.csv` for both days: it is one arm.

use anyhow::Result;
use clap::Parser;
use cpu_time::ProcessTime;
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::pipeline::{Config, Outcome, run};
use skclam::progress::Silent;
use skclam_experiments::measured::{claimed, shown};
use skclam_experiments::tracker;
use skclam_experiments::two_days::disagreement;
use std::io::Write;
use std::path::PathBuf;

/// RMS against the tracker beside claims, for both days.
#[derive(Parser)]
struct Arguments {
    /// Data sets of one arm; the first brings `tracker.csv`.
    #[arg(default_values = ["nachi-mz25", "nachi-mz25-second-day"])]
    datasets: Vec<String>,
    /// Settings as a JSON file, as `skclam run --config` takes them.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let config = match &arguments.config {
        None => Config::default(),
        Some(path) => Config::default().overlaid(&std::fs::read_to_string(path)?)?,
    };
    let shared = std::env::var_os("SKCLAM_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folders: Vec<PathBuf> = arguments.datasets.iter().map(|name| shared.join(name)).collect();
    let points = tracker::read(&folders[0].join("tracker.csv"))?;
    println!(
        "| recording | tracker RMS mm: nominal | mount alone | calibrated | first sentence mm | claimed at the tracker's points mm \
         | held-out px: nominal | mount alone | calibrated | status | CPU s |"
    );
    println!("|{}", " --- |".repeat(11));
    let mut outcomes: Vec<(String, Outcome)> = Vec::new();
    for folder in &folders {
        let dataset = Dataset::open(folder)?;
        let begun = ProcessTime::now();
        let outcome = run(&dataset, &config, &Silent)?;
        let seconds = begun.elapsed().as_secs_f64();
        let mount = Config { free: Free::parse("mount", &dataset.rig)?, ..config.clone() };
        let mount = skclam::pipeline::run_without_map(&dataset, &mount, &Silent)?;
        let shown = shown(&serde_json::to_value(&outcome.summary)?)?;
        let rms = [&dataset.rig, &mount.rig, &outcome.rig].map(|rig| tracker::rms_mm(rig, &points));
        let [nominal, mount_alone, calibrated] = rms;
        let postures: Vec<_> = points.iter().map(|point| point.posture.clone()).collect();
        let at_points = claimed(&dataset.rig, &outcome, &postures)?.map(|claimed| claimed.mm);
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.3}"));
        let held_out = shown.held_out.unwrap_or_default().map(number).join(" | ");
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        println!(
            "| {name} | {:.3} | {:.3} | {:.3} | {} | {} | {held_out} | {:?} | {seconds:.0} |",
            nominal?,
            mount_alone?,
            calibrated?,
            number(shown.sentence_sigma_mm),
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
