//! `skclam validate`.

use super::{rig_of, validate_points};
use crate::args::Cli;
use crate::progress::Screen;
use crate::screen::{self, say};
use anyhow::{Result, bail};
use clap::{Args, ValueEnum, ValueHint};
use serde::Serialize;
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::marker_points::{MarkerPoints, PointsValidation, validate_points};
use skclam::pipeline::{self, Config, Status, Validation};
use skclam::rig::Rig;
use std::path::{Path, PathBuf};

/// From which status on `validate` fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FailOnArg {
    /// Not distinguishable, or worse.
    Caution,
    /// Worse.
    Bad,
}

/// Arguments of `validate`.
#[derive(Debug, Args)]
pub struct ValidateArgs {
    /// Folder with rig.toml (the rig to compare with), postures.csv, color/ and depth/; may be left out with --points.
    #[arg(value_hint = ValueHint::DirPath, required_unless_present = "points")]
    pub dataset: Option<PathBuf>,
    /// The rig under test: a rig file or a result folder.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::AnyPath)]
    pub rig: PathBuf,
    /// Parameters to fit anew on this recording, such as "mount" or "mount,depth_offset".
    #[arg(long, value_name = "SET", requires = "dataset")]
    pub refit: Option<String>,
    /// Positions of a marker on the flange by an optical or laser tracker: CSV with q1_deg ..., x_mm, y_mm, z_mm and,
    /// better, group.
    #[arg(long, value_name = "CSV", value_hint = ValueHint::FilePath)]
    pub points: Option<PathBuf>,
    /// The rig to compare with on --points: a rig file or a result folder; by default that of DATASET.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::AnyPath, requires = "points")]
    pub nominal: Option<PathBuf>,
    /// Exit with 1 where the rig's status is this or worse. By images: bad is no better than the data set's own rig,
    /// caution better without explaining the recording. By --points: bad is worse than the rig to compare with by more
    /// than two standard errors, caution not distinguishable from it.
    #[arg(long, value_enum, value_name = "STATUS")]
    pub fail_on: Option<FailOnArg>,
    /// Seed of every random choice.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
}

/// What `--json` prints: the validation by images as ever, and beside it the one by points.
#[derive(Serialize)]
struct Printed<'a> {
    #[serde(flatten)]
    images: Option<&'a Validation>,
    #[serde(skip_serializing_if = "Option::is_none")]
    points: Option<&'a PointsValidation>,
}

/// Measures a rig on a recording that it was not fitted to, by points of a tracker, or both.
pub fn validate(cli: &Cli, args: &ValidateArgs) -> Result<()> {
    let rig = rig_of(&args.rig)?;
    let dataset = args.dataset.as_deref().map(Dataset::open).transpose()?;
    // First, since it takes no time: what is wrong with the points is said before the images are looked at.
    let points = args.points.as_deref().map(|path| by_points(path, args, &rig, dataset.as_ref())).transpose()?;
    let images = dataset.map(|dataset| by_images(cli, args, &rig, &dataset)).transpose()?;
    if let Some(points) = &points {
        screen::warn_of(cli.quiet, &validate_points::warnings(points), "--json");
    }
    if cli.json {
        let printed = Printed { images: images.as_ref(), points: points.as_ref() };
        screen::json(&printed)?;
    } else {
        images.iter().for_each(show);
        points.iter().for_each(validate_points::show);
    }
    let of_images = images.as_ref().map(|images| ("images", images.status));
    let of_points = points.as_ref().and_then(|points| Some(("points", points.comparison?.status)));
    [of_images, of_points].into_iter().flatten().try_for_each(|(by, status)| fail_on(args.fail_on, by, status))
}

fn by_images(cli: &Cli, args: &ValidateArgs, rig: &Rig, dataset: &Dataset) -> Result<Validation> {
    let refit = args.refit.as_deref().map(|free| Free::parse(free, rig)).transpose()?;
    let config = Config { seed: args.seed, ..Config::default() };
    let screen = Screen::new(cli.quiet);
    let validation = pipeline::validate(dataset, rig, refit.as_ref(), &config, &screen)?;
    screen.finish();
    screen::warn(cli.quiet, &validation.warnings);
    Ok(validation)
}

fn by_points(path: &Path, args: &ValidateArgs, rig: &Rig, dataset: Option<&Dataset>) -> Result<PointsValidation> {
    let nominal = args.nominal.as_deref().map(rig_of).transpose()?;
    let nominal = nominal.as_ref().or(dataset.map(|dataset| &dataset.rig));
    if args.fail_on.is_some() && nominal.is_none() {
        bail!("--fail-on needs a rig to compare with: give --nominal RIG or a DATASET");
    }
    Ok(validate_points(&MarkerPoints::read(path)?, rig, nominal)?)
}

/// Turns a status that the caller does not accept into a failure.
fn fail_on(limit: Option<FailOnArg>, by: &str, status: Status) -> Result<()> {
    let (limit, name) = match limit {
        Some(FailOnArg::Caution) => (Status::Caution, "caution"),
        Some(FailOnArg::Bad) => (Status::Bad, "bad"),
        None => return Ok(()),
    };
    if status >= limit {
        let status = if status == Status::Bad { "bad" } else { "caution" };
        bail!("the rig's status by {by} is {status}, and --fail-on {name} was asked for");
    }
    Ok(())
}

fn show(validation: &Validation) {
    say!("{}\n", validation.verdict);
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
        row("epipolar distance, RMS", before.rms_px, after.rms_px, "px");
        row("epipolar distance, median", before.median_px, after.median_px, "px");
    }
    if let Some(consistency) = &validation.depth_consistency {
        row("depth consistency, median", consistency.nominal.median_mm, consistency.calibrated.median_mm, "mm");
        row("depth consistency, 90 %", consistency.nominal.p90_mm, consistency.calibrated.p90_mm, "mm");
    }
    say!("{table}\n");
    say!(
        "{} postures, {} matches, {} observations; refitted: {}",
        validation.postures,
        validation.matches,
        validation.observations,
        if validation.refit.is_empty() { "nothing" } else { &validation.refit }
    );
}
