//! Whether sigmas hold on random virtual cells with images, the whole pipeline between.
//!
//! `cargo run --release -p skclam-experiments -- whole-pipeline [--cells N]`. Scene, arm, mount, postures, noise and
//! image size are drawn from each cell's seed; cells are kept under `--work`. NEES is taken over the combinations of
//! free parameters that move cameras, with the run's covariance, after the base's gauge; "camera" is over the recorded
//! postures.

use crate::cells::{Cell, CellOptions};
use crate::gauge::{Nees, ParameterScore, Score};
use crate::measured::{Measured, measure, parameters};
use crate::statistics::{chi_squared_band, mean, median, rms, sd};
use crate::true_poses::TruePoses;
use anyhow::Result;
use clap::Args;
use cpu_time::ProcessTime;
use skclam::inspection::{InspectionOptions, inspect};
use skclam::pipeline::{Config, run_without_map};
use skclam::progress::Silent;
use std::io::Write;
use std::path::{Path, PathBuf};

/// NEES, coverage and camera error over claim on random cells.
#[derive(Args)]
pub struct Arguments {
    /// How many cells.
    #[arg(long, default_value_t = 24)]
    cells: u64,
    /// Seed of the first cell; the others follow.
    #[arg(long, default_value_t = 101)]
    seed: u64,
    /// Postures of a cell.
    #[arg(long, default_value_t = 48)]
    postures: usize,
    /// Standard deviation of the encoders, degrees.
    #[arg(long, default_value_t = 0.003)]
    encoder_noise_deg: f64,
    /// Folder for cells.
    #[arg(long, default_value = "out/experiments", value_name = "DIR")]
    work: PathBuf,
    /// Draws the nominal rig's cameras within what such devices are known for, from each cell's seed; by default they
    /// are exact.
    #[arg(long)]
    instrument_errors: bool,
    /// Runs these data sets with a truth instead of random cells.
    #[arg(long, value_name = "DIR")]
    dataset: Vec<PathBuf>,
    /// Settings as a JSON file, as `skclam run --config` takes them.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// One cell.
struct Judged {
    measured: Measured,
    score: Score,
    predicted_mm: Option<f64>,
}

/// Prints the tables.
///
/// # Errors
/// Data that cannot be read; a single run that fails is a row.
pub fn run(arguments: &Arguments) -> Result<()> {
    let config = match &arguments.config {
        None => Config::default(),
        Some(path) => Config::default().overlaid(&std::fs::read_to_string(path)?)?,
    };
    println!(
        "| cell | image | n | NEES/n | with instruments | coverage | camera true mm | claimed mm | true/claimed | aligned mm \
         | first sentence mm | aligned/first sentence | workspace true/claimed | nominal mm | scale error % | inspect mm | inspect/claimed | status | CPU s |"
    );
    println!("|{}", " --- |".repeat(19));
    let mut all = Vec::new();
    for (name, cell) in cells(arguments) {
        match cell.and_then(|cell| Ok((judged(&cell, &config)?, cell.dataset.rig.color.width))) {
            Ok((judged, width)) => {
                print_row(&name, width, &judged);
                all.push(judged);
            }
            Err(error) => println!("| {name} | FAILED: {error:#} |{}", " |".repeat(17)),
        }
        std::io::stdout().flush()?;
    }
    print_pooled(&all);
    Ok(())
}

/// Cells by name, rendered as they are asked for.
fn cells(arguments: &Arguments) -> Box<dyn Iterator<Item = (String, Result<Cell>)> + '_> {
    let given = arguments.dataset.iter().map(|folder| (name_of(folder), Cell::open(folder)));
    if !arguments.dataset.is_empty() {
        return Box::new(given);
    }
    Box::new((arguments.seed..arguments.seed + arguments.cells).map(|seed| {
        // Image sizes spread evenly between 0.25 and 0.4, whatever the number of cells.
        let scale = 0.25 + 0.15 * (seed as f64 * 0.618_034).fract();
        let Arguments { postures, encoder_noise_deg, .. } = *arguments;
        let cell = Cell::rendered(&arguments.work, &CellOptions { seed, scale, postures, encoder_noise_deg });
        let drawn = cell.map(|cell| if arguments.instrument_errors { cell.with_instrument_errors(seed) } else { cell });
        (seed.to_string(), drawn)
    }))
}

fn name_of(folder: &Path) -> String {
    folder.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}

fn judged(cell: &Cell, config: &Config) -> Result<Judged> {
    let inspection = inspect(&cell.dataset, &InspectionOptions::default(), &Silent)?;
    let begun = ProcessTime::now();
    let outcome = run_without_map(&cell.dataset, config, &Silent)?;
    let seconds = begun.elapsed().as_secs_f64();
    let truth = TruePoses::of_rig(&cell.truth, &cell.postures())?;
    let measured = measure(&cell.dataset.rig, &cell.truth, &truth, &outcome, seconds)?;
    let score = parameters(&cell.dataset.rig, &cell.truth, &outcome)?;
    Ok(Judged { measured, score, predicted_mm: inspection.expected.map(|expected| expected.camera_sigma_mm.mean) })
}

/// Errors within 1.96 sigmas among the parameters of arm and mount that are identifiable by themselves.
fn covered(score: &Score) -> (usize, usize) {
    let judged = score.parameters.iter().filter(|parameter| parameter.identifiable && parameter.moves_camera);
    let judged: Vec<&ParameterScore> = judged.collect();
    (judged.iter().filter(|parameter| parameter.z().abs() < 1.959_964).count(), judged.len())
}

/// Positions with the base frame fitted, over what the first sentence claims.
fn aligned_ratio(measured: &Measured) -> Option<f64> {
    Some(measured.recorded?.aligned_mm / measured.shown.sentence_sigma_mm?)
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

fn print_row(name: &str, width: u32, Judged { measured, score, predicted_mm }: &Judged) {
    let (recorded, workspace) = (measured.recorded, measured.workspace);
    let (within, of) = covered(score);
    let cells = [
        name.to_owned(),
        width.to_string(),
        score.camera.degrees.to_string(),
        format!("{:.2}", score.camera.sum / score.camera.degrees as f64),
        format!("{:.2} of {}", score.all.sum / score.all.degrees as f64, score.all.degrees),
        format!("{within}/{of}"),
        number(recorded.map(|r| r.truth.mm), 4),
        number(recorded.and_then(|r| r.claimed).map(|claimed| claimed.mm), 4),
        number(recorded.and_then(|r| r.ratio()), 2),
        number(recorded.map(|r| r.aligned_mm), 4),
        number(measured.shown.sentence_sigma_mm, 4),
        number(aligned_ratio(measured), 2),
        number(workspace.and_then(|w| w.ratio()), 2),
        number(recorded.map(|r| r.nominal.mm), 2),
        number(measured.scale_error_percent, 4),
        number(*predicted_mm, 4),
        number(predicted_mm.zip(measured.shown.camera_sigma_mm).map(|(predicted, run)| predicted / run), 2),
        format!("{:?}", measured.shown.status),
        format!("{:.0}", measured.seconds),
    ];
    println!("| {} |", cells.join(" | "));
}

fn print_pooled(all: &[Judged]) {
    let pooled = |of: &dyn Fn(&Score) -> Nees| {
        let one = all.iter().map(|one| of(&one.score));
        let sum = one.fold(Nees::default(), |a, b| Nees { sum: a.sum + b.sum, degrees: a.degrees + b.degrees });
        (sum.sum / sum.degrees as f64, chi_squared_band(sum.degrees.max(1)))
    };
    let (nees, [low, high]) = pooled(&|score| score.camera);
    let (nees_all, [low_all, high_all]) = pooled(&|score| score.all);
    let (within, of) =
        all.iter().map(|one| covered(&one.score)).fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    let ratios =
        |of: &dyn Fn(&Measured) -> Option<f64>| all.iter().filter_map(|one| of(&one.measured)).collect::<Vec<f64>>();
    let recorded = ratios(&|measured| measured.recorded?.ratio());
    let workspace = ratios(&|measured| measured.workspace?.ratio());
    let scale = ratios(&|measured| measured.scale_error_percent);
    let predicted: Vec<f64> =
        all.iter().filter_map(|one| Some(one.predicted_mm? / one.measured.shown.camera_sigma_mm?)).collect();
    let extremes = predicted.iter().fold([f64::INFINITY, 0f64], |[low, high], &one| [low.min(one), high.max(one)]);
    println!("\n| over {} cells | | needed |\n| --- | --- | --- |", all.len());
    println!("| NEES/n of arm and mount (95 % band {low:.2} to {high:.2}) | {nees:.2} | 0.8 to 1.3 |");
    let per_cell = all.iter().map(|one| one.score.camera.sum / one.score.camera.degrees as f64);
    println!("| NEES/n, median of cells | {:.2} | |", median(&per_cell.collect::<Vec<f64>>()));
    println!("| NEES/n with the instruments (95 % band {low_all:.2} to {high_all:.2}) | {nees_all:.2} | |");
    println!("| coverage of 95 % intervals | {:.3} | at least 0.93 |", within as f64 / of as f64);
    println!("| camera error / claimed sigma, RMS | {:.2} | at most 1.2 |", rms(&recorded));
    let aligned = ratios(&aligned_ratio);
    println!("| camera error with the base frame fitted / first sentence, RMS | {:.2} | |", rms(&aligned));
    println!("| the same over the workspace | {:.2} | |", rms(&workspace));
    println!("| scale error, mean and sd, % | {:.4}, {:.4} | mean at most 0.01 |", mean(&scale), sd(&scale));
    println!(
        "| inspect's predicted sigma / the run's: least, median, largest | {:.2}, {:.2}, {:.2} | 0.5 to 2 |",
        extremes[0],
        median(&predicted),
        extremes[1]
    );
    print_parameters(all);
}

fn print_parameters(all: &[Judged]) {
    let mut names: Vec<&str> = Vec::new();
    for parameter in all.iter().flat_map(|one| &one.score.parameters).filter(|parameter| parameter.identifiable) {
        if !names.contains(&parameter.name.as_str()) {
            names.push(&parameter.name);
        }
    }
    println!("\n| parameter | mean z | rms z | mean error | median sigma |\n| --- | --- | --- | --- | --- |");
    for name in names {
        let of = |value: &dyn Fn(&ParameterScore) -> f64| -> Vec<f64> {
            all.iter()
                .flat_map(|one| &one.score.parameters)
                .filter(|p| p.name == name && p.identifiable)
                .map(value)
                .collect()
        };
        let z = of(&ParameterScore::z);
        let (error, sigma) = (mean(&of(&|p| p.error)), median(&of(&|p| p.sigma)));
        println!("| {name} | {:+.2} | {:.2} | {error:+.5} | {sigma:.5} |", mean(&z), rms(&z));
    }
}
