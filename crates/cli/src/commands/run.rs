//! `skclam run` and `skclam calibrate`.

use crate::args::{Cli, PresetArg, RunArgs, SelfFilterArgs};
use crate::commands::report::write_report;
use crate::progress::{Screen, peak_memory_mib};
use crate::screen::{self, say};
use anyhow::{Context, Result};
use skclam::calibration::Free;
use skclam::dataset::{Dataset, SelfFilter, SelfFilterOptions};
use skclam::inspection::likely_cause;
use skclam::output::Contents;
use skclam::pipeline::{self, BoardSummary, Check, CheckResult, Config, MapCoverage, RunError, Status};
use skclam::rig::Rig;
use skclam::summary::{StageSeconds, Summary};

/// How far the run goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Extent {
    /// To the map.
    Everything,
    /// To the rig and the trajectory.
    CalibrationOnly,
}

/// Takes the robot's body out of the data set's depth images, if asked for, and warns of shapes that cannot be used.
pub fn filter_self(dataset: &mut Dataset, args: &SelfFilterArgs, quiet: bool) -> Result<()> {
    let Some(urdf) = &args.self_filter else { return Ok(()) };
    let options =
        SelfFilterOptions { base_link: args.self_filter_base.clone(), margin_m: args.self_filter_margin_mm * 1e-3 };
    let filter = SelfFilter::read(urdf, &dataset.rig, options)?;
    let warnings: Vec<String> = filter.left_out().iter().map(|link| format!("self filter without {link}")).collect();
    screen::warn(quiet, &warnings);
    dataset.self_filter = Some(filter);
    Ok(())
}

/// Runs, writes the results, shows the table.
pub fn run(cli: &Cli, args: &RunArgs, extent: Extent) -> Result<()> {
    let mut dataset = match &args.rig {
        None => Dataset::open(&args.dataset)?,
        Some(path) => Dataset::open_with_rig(&args.dataset, Rig::read(path)?)?,
    };
    if args.no_depth {
        dataset.rig.depth = None;
        dataset.records.iter_mut().for_each(|record| record.depth = None);
    }
    let config = config(args, &dataset.rig)?;
    filter_self(&mut dataset, &args.self_filter, cli.quiet)?;
    let mut staged = screen::staged(cli.quiet, &args.out, Contents::Result)?;
    let screen = Screen::new(cli.quiet);
    let found = match args.find_mount {
        true => Some(pipeline::find_mount(&dataset, &config, &screen)?),
        false => None,
    };
    if let Some(found) = &found {
        dataset.rig.flange_from_color = found.flange_from_color;
    }
    let done = match extent {
        Extent::Everything => pipeline::run(&dataset, &config, &screen),
        Extent::CalibrationOnly => pipeline::run_without_map(&dataset, &config, &screen),
    };
    let mut outcome = done.map_err(|error| with_cause(&dataset, error))?;
    outcome.summary.warnings.extend(found.map(|found| {
        format!(
            "the nominal mount was found from {} matches in {} pairs of images ({:.2} px from their epipolar lines in the median); \
             the rig's own was {:.0} mm and {:.1} deg off",
            found.matches, found.pairs, found.median_sampson_px, found.shifted_by_mm, found.turned_by_deg
        )
    }));
    outcome.summary.stages = stages(&screen);
    outcome.summary.peak_memory_mib = peak_memory_mib();
    outcome.write(&staged)?;
    write_report(&mut staged)?;
    let folder = staged.publish()?;
    screen::warn(cli.quiet, &outcome.summary.warnings);
    if cli.json {
        screen::json(&outcome.summary)?;
    } else {
        show(&outcome.summary);
        say!("Results: {}; open report.html in a browser", folder.display());
    }
    Ok(())
}

/// The error of a failed estimator is about matrices; where the data have a slip that explains it, that is said first.
fn with_cause(dataset: &Dataset, error: RunError) -> anyhow::Error {
    let of_the_data = matches!(error, RunError::Calibration(_) | RunError::Features(_));
    match of_the_data.then(|| likely_cause(dataset)).flatten() {
        Some(cause) => anyhow::Error::new(error).context(cause),
        None => error.into(),
    }
}

/// The times that the screen measured, as the summary keeps them.
pub fn stages(screen: &Screen) -> Vec<StageSeconds> {
    let times = screen.finish().into_iter();
    times
        .map(|time| StageSeconds { stage: time.stage, steps: time.steps, wall_s: time.wall_s, cpu_s: time.cpu_s })
        .collect()
}

fn config(args: &RunArgs, rig: &Rig) -> Result<Config> {
    let preset = match args.preset {
        PresetArg::Default => Config::default(),
        PresetArg::Paper => Config::paper(),
    };
    let mut config = match &args.config {
        None => preset,
        Some(path) => {
            let text = skclam_files::read_text(path, skclam_files::Kind::Configuration)
                .with_context(|| path.display().to_string())?;
            preset.overlaid(&text).with_context(|| path.display().to_string())?
        }
    };
    if let Some(free) = &args.free {
        config.free = Free::parse(free, rig)?;
    }
    if let Some(seed) = args.seed {
        config.seed = seed;
    }
    Ok(config)
}

/// The table of a run.
pub fn show(summary: &Summary) {
    let calibration = &summary.calibration;
    say!("{}", summary.verdict);
    // The verdict is a check too, and has been printed.
    let shown = |check: &&CheckResult| check.status != Status::Good && !matches!(check.check, Check::Verdict { .. });
    for check in summary.checks.iter().filter(shown) {
        say!("  check: {}", check.text);
    }
    say!();
    if !calibration.parameters.is_empty() {
        let mut table = screen::table(&["parameter", "nominal", "calibrated", "change", "sigma", "unit"]);
        for parameter in &calibration.parameters {
            table.add_row([
                parameter.name.clone(),
                format!("{:.4}", parameter.nominal),
                format!("{:.4}", parameter.calibrated),
                format!("{:+.4}", parameter.calibrated - parameter.nominal),
                parameter.sigma.map_or("-".to_owned(), |sigma| format!("{sigma:.4}")),
                parameter.unit.clone(),
            ]);
        }
        say!("{table}\n");
    }
    let mut table = screen::table(&["residuals, px", "nominal", "calibrated"]);
    // A board alone has no matches, and so no distances to lines.
    if summary.counts.matches > 0 {
        let (before, after) = (&calibration.epipolar_before, &calibration.epipolar_after);
        for (name, before, after) in [
            ("error function, Eq. (7)", before.error_function, after.error_function),
            ("epipolar distance, RMS", before.rms_px, after.rms_px),
            ("epipolar distance, median", before.median_px, after.median_px),
        ] {
            table.add_row([name.to_owned(), format!("{before:.3}"), format!("{after:.3}")]);
        }
    }
    if let (Some(before), Some(after)) = (&calibration.reprojection_before, &calibration.reprojection_after) {
        table.add_row([
            "reprojection, RMS".to_owned(),
            format!("{:.3}", before.rms_px),
            format!("{:.3}", after.rms_px),
        ]);
        table.add_row([
            "reprojection, median".to_owned(),
            format!("{:.3}", before.median_px),
            format!("{:.3}", after.median_px),
        ]);
    }
    if let Some(held_out) = &summary.held_out {
        let px = &held_out.metric_px;
        let name = format!("held out: {}", held_out.metric);
        table.add_row([name, format!("{:.3}", px.nominal), format!("{:.3}", px.calibrated)]);
        if let Some(mount_only) = px.mount_only {
            table.add_row(["  the same with the mount alone".to_owned(), String::new(), format!("{mount_only:.3}")]);
        }
    }
    if let Some((before, after)) =
        summary.map.and_then(|map| Some((map.depth_consistency_nominal?, map.depth_consistency_calibrated?)))
    {
        let mm = |value: f64| format!("{value:.2} mm");
        table.add_row(["depth consistency, median".to_owned(), mm(before.median_mm), mm(after.median_mm)]);
        table.add_row(["depth consistency, 90 %".to_owned(), mm(before.p90_mm), mm(after.p90_mm)]);
    }
    let board_rms = |of: fn(&BoardSummary) -> Option<f64>| {
        summary.board.as_ref().and_then(of).map_or("-".to_owned(), |rms| format!("{rms:.3}"))
    };
    if summary.board.as_ref().is_some_and(|board| board.corners > 0) {
        let after = board_rms(|board| board.calibrated_rms_px);
        table.add_row(["board corners, RMS".to_owned(), board_rms(|board| board.nominal_rms_px), after.clone()]);
        let fitted = board_rms(|board| board.mount_fitted_rms_px);
        table.add_row(["the same, nominal with its mount fitted".to_owned(), fitted, after]);
    }
    say!("{table}\n");
    show_poses(summary);
    let counts = &summary.counts;
    say!(
        "{} postures, {} pairs, {} keypoints, {} matches, {} tracks with {} observations",
        counts.postures,
        counts.pairs,
        summary.keypoints.iter().sum::<usize>(),
        counts.matches,
        counts.tracks,
        counts.observations
    );
    if let Some(board) = &summary.board {
        say!("Board: {} corners in {} postures", board.corners, board.postures);
    }
    if let Some(found) = summary.ego_mask.filter(|found| found.dropped_keypoints > 0) {
        say!(
            "{:.0} % of the image moves with the camera and was masked ({} keypoints); see mask.png",
            found.masked_fraction * 100.0,
            found.dropped_keypoints
        );
    }
    say!("Solver {}; {} iterations", calibration.ended, calibration.termination.iterations);
    if let Some(rank) = calibration.rank {
        say!("{rank} of {} free parameters are identifiable", calibration.free);
        if calibration.arm && matches!(summary.configuration.free, Free::Auto | Free::With(..)) {
            say!("Held, not identifiable: base about and along axis 1; flange about and along the last");
        }
    }
    for combination in &calibration.not_identifiable {
        say!("  not identifiable: {}", combination.text);
    }
    if let Some(map) = &summary.map {
        say!("Map: {} points", map.points);
        if let Some(coverage) = map.coverage {
            say!("{}", coverage_line(&coverage));
        }
    }
    let wall: f64 = summary.stages.iter().map(|stage| stage.wall_s).sum();
    let cpu: f64 = summary.stages.iter().map(|stage| stage.cpu_s).sum();
    let list: Vec<String> = summary.stages.iter().map(|stage| format!("{} {:.1}", stage.stage, stage.wall_s)).collect();
    say!("Time: {wall:.1} s ({}), CPU {cpu:.1} s", list.join(", "));
    if let Some(memory) = summary.peak_memory_mib {
        say!("Peak memory: {memory:.0} MiB");
    }
}

/// What was seen, in at most 80 columns.
pub fn coverage_line(coverage: &MapCoverage) -> String {
    let percent = |fraction: f64| format!("{:.0} %", fraction * 100.0);
    let mut parts = Vec::new();
    if let (Some(fraction), Some(reach_m)) = (coverage.observed_fraction_of_reach, coverage.reach_m) {
        parts.push(format!("{} of the reach ({reach_m:.2} m)", percent(fraction)));
    }
    if let Some(fraction) = coverage.open_boundary_fraction {
        parts.push(format!("border open {}", percent(fraction)));
    }
    parts.push(format!("no depth {}", percent(coverage.depth_without_value)));
    format!("Observed: {}", parts.join("; "))
}

/// What is known of flange and camera.
fn show_poses(summary: &Summary) {
    let mut table = screen::table(&["expected error (sigma)", "mean", "max", "unit"]);
    for (of, poses) in [("your postures", &summary.recorded_poses), ("the workspace", &summary.workspace_poses)] {
        let Some(poses) = poses else { continue };
        let rows = [
            ("camera", poses.camera_sigma_mm, poses.camera_sigma_deg),
            ("flange", poses.flange_sigma_mm, poses.flange_sigma_deg),
        ];
        for (frame, position, orientation) in rows {
            for (unit, statistics) in [("mm", position), ("deg", orientation)] {
                let Some(statistics) = statistics else { continue };
                let number = |value: f64| format!("{value:.4}");
                let name = format!("{frame} over {of}");
                table.add_row([name, number(statistics.mean), number(statistics.max), unit.to_owned()]);
            }
        }
    }
    if table.row_count() > 0 {
        say!("{table}\n");
    }
}
