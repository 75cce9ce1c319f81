//! What a run claims and which cause it names when one assumption is wrong, row by row.
//!
//! `cargo run --release -p skclam-experiments -- misspecification [--seed N] [--scale F] [--only ROW]`. The cell is
//! rendered once and kept under `--work`; each row's data set stays there, for `skclam run` by hand.

use crate::cells::{Cell, CellOptions};
use crate::limited::run_again;
use crate::measured::{Measured, measure, refused, run_default};
use crate::rows::{RENDERED_POSTURES, Row, all};
use crate::verdict_rules::{Verdict, judge};
use anyhow::{Context, Result};
use clap::Args;
use cpu_time::ProcessTime;
use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

/// Wrong assumptions: true and claimed error, status, named cause.
#[derive(Args)]
pub struct Arguments {
    /// Seed of the cell; several are run one after another.
    #[arg(long, default_value = "7", value_delimiter = ',')]
    seed: Vec<u64>,
    /// Scale of the colour image: 1 is 1920x1080.
    #[arg(long, default_value_t = 0.25)]
    scale: f64,
    /// Standard deviation of the encoders, degrees.
    #[arg(long, default_value_t = 0.003)]
    encoder_noise_deg: f64,
    /// Only rows whose name contains this.
    #[arg(long, value_name = "ROW")]
    only: Option<String>,
    /// Seconds after which a row is given up.
    #[arg(long, default_value_t = 900)]
    limit_s: u64,
    /// Prints what a person would see, below each row.
    #[arg(long)]
    verbose: bool,
    /// Folder for cells and data sets.
    #[arg(long, default_value = "out/experiments", value_name = "DIR")]
    work: PathBuf,
    /// Measures this one row and prints it as JSON: what the program starts itself with.
    #[arg(long, hide = true)]
    row: Option<String>,
}

/// Prints the tables.
///
/// # Errors
/// Data that cannot be read; a single run that fails is a row.
pub fn run(arguments: &Arguments) -> Result<()> {
    let rows = all();
    if let Some(name) = &arguments.row {
        let row = rows.iter().find(|row| row.name == name).context("no such row")?;
        let seed = *arguments.seed.first().context("no seed")?;
        println!("{}", serde_json::to_string(&measure_row(arguments, seed, row)?)?);
        return Ok(());
    }
    let chosen = |row: &&Row| arguments.only.as_ref().is_none_or(|only| row.name.contains(only.as_str()));
    println!(
        "| seed | row | true mm | claimed mm | nominal mm | true deg | claimed deg | aligned mm | first sentence mm | status | named first | expected | verdict | CPU s |"
    );
    println!("|{}", " --- |".repeat(14));
    let mut verdicts = Vec::new();
    for &seed in &arguments.seed {
        // Rendered here, so that no row's time limit pays for it.
        cell(arguments, seed)?;
        for row in rows.iter().filter(chosen) {
            let measured =
                match run_again::<Measured>(&again(arguments, seed, row), Duration::from_secs(arguments.limit_s)) {
                    Ok(measured) => measured,
                    Err(error) => {
                        println!(
                            "| {seed} | {} | - | - | - | - | - | - | - | no result: {error:#} | | | FAILED | |",
                            row.name
                        );
                        verdicts.push(None);
                        continue;
                    }
                };
            let verdict = judge(&measured, row.expected);
            print_row(seed, row, &measured, &verdict);
            if arguments.verbose {
                measured.shown.statements.iter().for_each(|statement| println!("<!-- {statement} -->"));
            }
            std::io::stdout().flush()?;
            verdicts.push(Some(verdict));
        }
    }
    print_totals(&verdicts);
    Ok(())
}

fn cell(arguments: &Arguments, seed: u64) -> Result<Cell> {
    let Arguments { scale, encoder_noise_deg, .. } = *arguments;
    Cell::rendered(&arguments.work, &CellOptions { seed, scale, postures: RENDERED_POSTURES, encoder_noise_deg })
}

fn again(arguments: &Arguments, seed: u64, row: &Row) -> Vec<String> {
    let work = arguments.work.display().to_string();
    let pairs = [
        ("--seed", seed.to_string()),
        ("--scale", arguments.scale.to_string()),
        ("--encoder-noise-deg", arguments.encoder_noise_deg.to_string()),
        ("--work", work),
        ("--row", row.name.to_owned()),
    ];
    let options = pairs.into_iter().flat_map(|(key, value)| [key.to_owned(), value]);
    std::iter::once("misspecification".to_owned()).chain(options).collect()
}

fn measure_row(arguments: &Arguments, seed: u64, row: &Row) -> Result<Measured> {
    let cell = cell(arguments, seed)?;
    let variant = (row.make)(&cell)?;
    let slug: String = row.name.chars().map(|c| if c.is_alphanumeric() { c } else { '-' }).collect();
    let folder = arguments.work.join(format!("rows/seed-{seed}-scale-{:.3}/{slug}", arguments.scale));
    if folder.exists() {
        std::fs::remove_dir_all(&folder)?;
    }
    let begun = ProcessTime::now();
    let outcome = variant.write(&cell, &folder).and_then(|dataset| run_default(&dataset));
    let seconds = begun.elapsed().as_secs_f64();
    match outcome {
        Ok(outcome) => measure(&variant.rig, &cell.truth, &variant.truth, &outcome, seconds),
        Err(error) => Ok(refused(&error, seconds)),
    }
}

fn print_row(seed: u64, row: &Row, measured: &Measured, verdict: &Verdict) {
    let numbers = match &measured.recorded {
        Some(recorded) => {
            let claimed = recorded.claimed;
            let claimed = |value: &dyn Fn(f64, f64) -> f64| {
                claimed.map_or("-".to_owned(), |c| format!("{:.3}", value(c.mm, c.deg)))
            };
            format!(
                "{:.3} | {} | {:.2} | {:.3} | {} | {:.3} | {}",
                recorded.truth.mm,
                claimed(&|mm, _| mm),
                recorded.nominal.mm,
                recorded.truth.deg,
                claimed(&|_, deg| deg),
                recorded.aligned_mm,
                measured.shown.sentence_sigma_mm.map_or("-".to_owned(), |sigma| format!("{sigma:.3}"))
            )
        }
        None => "- | - | - | - | - | - | -".to_owned(),
    };
    let first = measured.shown.causes.first().map_or("-".to_owned(), |cause| format!("{cause:?}"));
    let expected: Vec<String> = row.expected.iter().map(|cause| format!("{cause:?}")).collect();
    let (status, expected) = (measured.shown.status, expected.join(" or "));
    let (name, text, seconds) = (row.name, verdict.text(), measured.seconds);
    println!("| {seed} | {name} | {numbers} | {status:?} | {first} | {expected} | {text} | {seconds:.0} |");
}

fn print_totals(verdicts: &[Option<Verdict>]) {
    let total = |rule: &dyn Fn(&Verdict) -> Option<bool>| {
        let judged: Vec<bool> = verdicts.iter().flatten().filter_map(rule).collect();
        let held = judged.iter().filter(|held| **held).count();
        let percent = 100.0 * held as f64 / judged.len().max(1) as f64;
        format!("{held} of {} ({percent:.0} %)", judged.len())
    };
    println!("\n| rule | rows in which it holds | needed |\n| --- | --- | --- |");
    println!(
        "| no green where the true error exceeds twice the claim or the nominal error | {} | all |",
        total(&|v| v.green_is_true)
    );
    println!("| claimed at least half of true where not red | {} | all |", total(&|v| v.claim_is_honest));
    println!("| the right cause first, rows that are not harmless | {} | 85 % |", total(&|v| v.cause_is_named));
    println!("| no red where the answer is within its claim | {} | all |", total(&|v| v.no_false_alarm));
    let failed = verdicts.iter().filter(|verdict| verdict.is_none()).count();
    println!("| rows without a result | {failed} | 0 |");
}
