//! `skclam validate`.

use crate::args::{Cli, ValidateArgs};
use crate::progress::Screen;
use crate::screen;
use anyhow::Result;
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::pipeline::{self, Config, Validation};
use skclam::rig::Rig;

/// Measures a rig on a recording that it was not fitted to.
pub fn validate(cli: &Cli, args: &ValidateArgs) -> Result<()> {
    let path = if args.rig.is_dir() { args.rig.join("rig.toml") } else { args.rig.clone() };
    let rig = Rig::read(path)?;
    let dataset = Dataset::open(&args.dataset)?;
    let refit = args.refit.as_deref().map(|free| Free::parse(free, &rig)).transpose()?;
    let config = Config { seed: args.seed, ..Config::default() };
    let screen = Screen::new(cli.quiet);
    let validation = pipeline::validate(&dataset, &rig, refit.as_ref(), &config, &screen)?;
    screen.finish();
    screen::warn(cli.quiet, &validation.warnings);
    if cli.json {
        println!("{}", serde_json::to_string_pretty(&validation)?);
    } else {
        show(&validation);
    }
    Ok(())
}

fn show(validation: &Validation) {
    println!("{}\n", validation.verdict);
    let mut table = screen::table(&["residuals", "data set's rig", "rig under test", "unit"]);
    let mut row = |name: &str, before: f64, after: f64, unit: &str| {
        table.add_row([name.to_owned(), format!("{before:.3}"), format!("{after:.3}"), unit.to_owned()]);
    };
    let (before, after) = (&validation.reprojection.nominal, &validation.reprojection.calibrated);
    if after.observations > 0 {
        row("reprojection, RMS", before.rms_px, after.rms_px, "px");
        row("reprojection, median", before.median_px, after.median_px, "px");
    }
    let (before, after) = (&validation.epipolar.nominal, &validation.epipolar.calibrated);
    if after.matches > 0 {
        row("point-line distance, RMS", before.rms_px, after.rms_px, "px");
        row("point-line distance, median", before.median_px, after.median_px, "px");
    }
    if let Some(agreement) = &validation.depth_agreement {
        row("depth images apart, median", agreement.nominal.median_mm, agreement.calibrated.median_mm, "mm");
        row("depth images apart, 90 %", agreement.nominal.p90_mm, agreement.calibrated.p90_mm, "mm");
    }
    println!("{table}\n");
    println!(
        "{} postures, {} matches, {} sights; refitted: {}",
        validation.postures,
        validation.matches,
        validation.observations,
        if validation.refit.is_empty() { "nothing" } else { &validation.refit }
    );
}
