//! What a run claims when the depth camera's scale is wrong: the shared virtual cell as it is, and with its depth
//! scaled.
//!
//! `cargo run --release -p skclam-experiments -- boards-and-ruler [DATASET] [--scales 1,1.005]`, by default
//! `../shared/data/virtual-cell` (or the folder of that name in `SKCLAM_DATA`). The dataset brings `truth/rig.toml`.
//! The depth images are scaled by the unit of their counts.

use crate::cells::Cell;
use crate::measured::{measure, run_default};
use crate::true_poses::TruePoses;
use anyhow::{Context, Result};
use clap::Args;
use cpu_time::ProcessTime;
use skclam::dataset::Dataset;
use skclam::rig::Rig;
use std::io::Write;
use std::path::PathBuf;

/// True and claimed camera error with a wrong ruler.
#[derive(Args)]
pub struct Arguments {
    /// A data set with its truth.
    dataset: Option<PathBuf>,
    /// Factors of the depth.
    #[arg(long, value_delimiter = ',', default_value = "1,1.005,0.995,1.002")]
    scales: Vec<f64>,
}

/// Prints the tables.
///
/// # Errors
/// Data that cannot be read, or a run that fails.
pub fn run(arguments: &Arguments) -> Result<()> {
    let shared = std::env::var_os("SKCLAM_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = arguments.dataset.clone().unwrap_or_else(|| shared.join("virtual-cell"));
    let cell = Cell::open(&folder)?;
    let truth = TruePoses::of_rig(&cell.truth, &cell.postures())?;
    println!(
        "| depth times | true mm | claimed mm (RMS) | true / claimed | aligned mm | first sentence mm | true deg | claimed deg | workspace true / claimed | scale error % | nominal mm \
         | status | first sentence | CPU s |"
    );
    println!("|{}", " --- |".repeat(14));
    for &factor in &arguments.scales {
        let mut rig: Rig = cell.dataset.rig.clone();
        rig.depth.as_mut().context("the data set has no depth")?.unit_m *= factor;
        let dataset = Dataset { rig, ..cell.dataset.clone() };
        let begun = ProcessTime::now();
        let outcome = run_default(&dataset)?;
        let measured = measure(&dataset.rig, &cell.truth, &truth, &outcome, begun.elapsed().as_secs_f64())?;
        let recorded = measured.recorded.context("a run has an answer")?;
        let claimed = recorded.claimed.context("least squares has a covariance")?;
        let shown = &measured.shown;
        println!(
            "| {factor} | {:.4} | {:.4} | {:.2} | {:.4} | {} | {:.4} | {:.4} | {} | {} | {:.2} | {:?} | {} | {:.0} |",
            recorded.truth.mm,
            claimed.mm,
            recorded.truth.mm / claimed.mm,
            recorded.aligned_mm,
            shown.sentence_sigma_mm.map_or("-".to_owned(), |sigma| format!("{sigma:.4}")),
            recorded.truth.deg,
            claimed.deg,
            measured.workspace.and_then(|w| w.ratio()).map_or("-".to_owned(), |ratio| format!("{ratio:.2}")),
            measured.scale_error_percent.map_or("-".to_owned(), |error| format!("{error:.4}")),
            recorded.nominal.mm,
            shown.status,
            shown.sentence,
            measured.seconds
        );
        std::io::stdout().flush()?;
    }
    Ok(())
}
