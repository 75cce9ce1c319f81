//! `skclam inspect`.

use crate::args::Cli;
use crate::progress::Screen;
use crate::screen;
use anyhow::Result;
use clap::{Args, ValueHint};
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::inspection::{ExpectedSigmas, Inspection, InspectionOptions, inspect as judge};
use skclam::recordings::{Recording, Survey, survey};
use std::path::PathBuf;

/// Arguments of `inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// A recording (.bag, .mcap, .db3, a folder of them, a TUM folder), or a data set folder.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// What is to be calibrated, as `--free` of `run`: auto, angles, all, or a list.
    #[arg(long, value_name = "PARAMETERS", default_value = "auto")]
    pub free: String,
}

/// Tells what a recording holds, or judges a data set.
pub fn inspect(cli: &Cli, args: &InspectArgs) -> Result<()> {
    if args.path.join("postures.csv").is_file() {
        let dataset = Dataset::open(&args.path)?;
        let screen = Screen::new(cli.quiet);
        let mut options = InspectionOptions::default();
        options.expected.expectation.free = Free::parse(&args.free, &dataset.rig)?;
        let inspection = judge(&dataset, &options, &screen)?;
        screen.finish();
        if cli.json {
            println!("{}", serde_json::to_string_pretty(&inspection)?);
        } else {
            show_dataset(cli, &inspection);
        }
        return Ok(());
    }
    let survey = survey(&mut Recording::open(&args.path)?)?;
    if cli.json {
        println!("{}", serde_json::to_string_pretty(&survey)?);
    } else {
        show_recording(cli, &survey);
    }
    Ok(())
}

fn show_recording(cli: &Cli, survey: &Survey) {
    let mut table = screen::table(&["topic", "type", "messages", "MB", "Hz", "largest gap s", "clock jumps"]);
    for topic in &survey.topics {
        table.add_row([
            topic.topic.clone(),
            topic.type_name.clone(),
            topic.messages.to_string(),
            format!("{:.1}", topic.bytes as f64 * 1e-6),
            format!("{:.1}", topic.rate_hz),
            format!("{:.3}", topic.largest_gap_s),
            topic.clock_jumps.to_string(),
        ]);
    }
    println!("{table}");
    for topic in survey.topics.iter().filter(|topic| !topic.detail.is_empty()) {
        println!("{}: {}", topic.topic, topic.detail);
    }
    println!("{} messages in {:.3} s", survey.messages, survey.duration_s);
    let mut warnings = Vec::new();
    for topic in survey.topics.iter().filter(|topic| topic.read) {
        for jump in topic.first_jumps.iter().take(3) {
            warnings.push(format!("{}: the clock jumps by {:+.3} s at {:.3} s", topic.topic, jump.jump_s, jump.at_s));
        }
        if topic.messages > 10 && topic.largest_gap_s > 10.0 / topic.rate_hz.max(1e-9) {
            warnings.push(format!(
                "{}: nothing for {:.3} s at {:.3} s",
                topic.topic, topic.largest_gap_s, topic.largest_gap_at_s
            ));
        }
        if topic.messages > 0 && topic.stamp_minus_log_s.abs() > 1.0 {
            warnings.push(format!(
                "{}: stamps differ by {:+.3} s from the time of recording; do all devices have one clock?",
                topic.topic, topic.stamp_minus_log_s
            ));
        }
    }
    screen::warn(cli.quiet, &warnings);
}

fn show_dataset(cli: &Cli, inspection: &Inspection) {
    if !inspection.joints.is_empty() {
        let mut table = screen::table(&["joint", "from", "to", "limits", "unit", "distinct values"]);
        for joint in &inspection.joints {
            table.add_row([
                joint.joint.clone(),
                format!("{:.1}", joint.min),
                format!("{:.1}", joint.max),
                joint.limits.map_or_else(String::new, |[lower, upper]| format!("{lower:.0} to {upper:.0}")),
                joint.unit.to_owned(),
                joint.distinct.to_string(),
            ]);
        }
        println!("{table}\n");
    }
    let partners =
        |position: usize| inspection.pairs.iter().filter(|pair| pair.a == position || pair.b == position).count();
    let mut table =
        screen::table(&["posture", "sharp", "grey", "dark %", "bright %", "depth m", "depth %", "partners"]);
    for (position, image) in inspection.images.iter().enumerate() {
        let optional = |value: Option<f64>, scale: f64| value.map_or_else(String::new, |v| format!("{:.2}", scale * v));
        table.add_row([
            image.index.to_string(),
            format!("{:.3}", image.sharpness),
            format!("{:.0}", image.exposure.mean),
            format!("{:.1}", 100.0 * image.exposure.dark),
            format!("{:.1}", 100.0 * image.exposure.bright),
            optional(image.median_depth_m, 1.0),
            optional(image.depth_share, 100.0),
            partners(position).to_string(),
        ]);
    }
    println!("{table}");
    println!(
        "{} postures, {} pairs that should see the same, {} connected group(s)",
        inspection.postures,
        inspection.pairs.len(),
        inspection.groups.len()
    );
    if let Some(expected) = &inspection.expected {
        show_expected(expected);
    }
    screen::warn(cli.quiet, &inspection.warnings);
}

fn show_expected(expected: &ExpectedSigmas) {
    println!();
    let mut table = screen::table(&["parameter", "expected sigma", "unit"]);
    for parameter in &expected.parameters {
        table.add_row([
            parameter.name.clone(),
            parameter.sigma.map_or("-".to_owned(), |sigma| format!("{sigma:.4}")),
            parameter.unit.to_owned(),
        ]);
    }
    println!("{table}");
    println!(
        "camera over the postures: expected sigma {:.3} mm and {:.4} deg in the mean, {:.3} mm and {:.4} deg at most",
        expected.camera_sigma_mm.mean,
        expected.camera_sigma_deg.mean,
        expected.camera_sigma_mm.max,
        expected.camera_sigma_deg.max
    );
    let depth = expected.depth_sigma_per_m.map_or(String::new(), |s| format!(" and {s} z^2 m of depth"));
    println!(
        "predicted for {} sights with {} px{depth} of noise; {} of {} combinations can be told",
        expected.sights, expected.pixel_sigma, expected.rank, expected.free
    );
}
