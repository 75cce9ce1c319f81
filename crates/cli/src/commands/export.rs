//! `skclam export`.

use crate::args::Cli;
use crate::commands::rig_of;
use crate::progress::Screen;
use crate::screen::{self, say, say_on};
use anyhow::{Context, Result, bail};
use clap::{Args, ValueHint};
use serde::Serialize;
use skclam::camera_frames::CameraFrames;
use skclam::dataset::Dataset;
use skclam::export::{ExportOptions, Exported, USUAL_CAMERA_FRAME, UrdfSource, export as write_export};
use skclam::kinematics::{chain_from_urdf, urdf_ends};
use skclam::output::{Contents, StagedFolder};
use skclam::result_recording::{RecordedResult, ResultRecordingOptions, record_result};
use skclam::rig::{Rig, RobotDescription};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// A result folder (with rig.toml), or a calibrated rig file.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub result: PathBuf,
    /// The rig that the calibration began with; with --urdf or --dataset it may be left out.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath, required_unless_present_any = ["urdf", "dataset"])]
    pub nominal: Option<PathBuf>,
    /// The data set that was calibrated.
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub dataset: Option<PathBuf>,
    /// Write result.mcap too, for Foxglove and Rerun: images, frames, trajectories, maps, residuals, nominal and
    /// calibrated.
    #[arg(long, requires = "dataset")]
    pub mcap: bool,
    /// Leave the residuals out of result.mcap; otherwise the images are matched once more, as in the run.
    #[arg(long, requires = "mcap")]
    pub without_residuals: bool,
    /// Robot description to correct; xacro must be expanded before.
    #[arg(long, value_name = "URDF", value_hint = ValueHint::FilePath)]
    pub urdf: Option<PathBuf>,
    /// Link of the URDF that is the arm's base; may be left out where there is one choice.
    #[arg(long, value_name = "LINK", requires = "urdf")]
    pub base_link: Option<String>,
    /// Link of the URDF that is the arm's flange; may be left out where there is one choice.
    #[arg(long, value_name = "LINK", requires = "urdf")]
    pub tip_link: Option<String>,
    /// Print the changed lines of the URDF.
    #[arg(long, requires = "urdf")]
    pub diff: bool,
    /// ROS frame of the flange, for the static transform of the mount.
    #[arg(long, value_name = "FRAME", default_value_t = ExportOptions::default().flange_frame)]
    pub flange_frame: String,
    /// ROS optical frame of the colour camera, whose transform is written; by default the frame at the root of the tree
    /// of the camera's driver, as an imported data set knows it, else camera_color_optical_frame.
    #[arg(long, value_name = "FRAME")]
    pub camera_frame: Option<String>,
    /// Folder for the files; made if it is not there.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
}

/// What was written.
#[derive(Debug, Serialize)]
struct Done {
    /// The files of arm and mount.
    #[serde(flatten)]
    written: Exported,
    /// `result.mcap`.
    mcap: Option<RecordedResult>,
}

/// Writes the calibrated arm in the forms that other programs read, and the result as a recording.
pub fn export(cli: &Cli, args: &ExportArgs) -> Result<()> {
    let calibrated = rig_of(&args.result)?;
    let nominal = args.nominal.as_ref().map(Rig::read).transpose()?;
    let dataset = match (&args.dataset, &nominal) {
        (Some(folder), Some(rig)) => Some(Dataset::open_with_rig(folder, rig.clone())?),
        (Some(folder), None) => Some(Dataset::open(folder)?),
        (None, _) => None,
    };
    let urdf = match &args.urdf {
        Some(path) => Some(urdf_source(path, args)?),
        None => urdf_of_nominal(args)?,
    };
    let nominal = match (nominal, &dataset, &urdf) {
        (None, Some(dataset), None) => Some(dataset.rig.clone()),
        (nominal, _, _) => nominal,
    };
    let staged = screen::staged(cli.quiet, &args.out, Contents::Export)?;
    let frames = match &args.dataset {
        Some(folder) => CameraFrames::read(folder)?,
        None => None,
    };
    let written = write_export(nominal.as_ref(), &calibrated, urdf.as_ref(), &options(args, frames), &staged)?;
    let mcap = match (&dataset, args.mcap) {
        (Some(dataset), true) => Some(recording(cli, args, dataset, &staged)?),
        _ => None,
    };
    let folder = staged.publish()?;
    let done = Done { written, mcap };
    if cli.json {
        screen::json(&done)?;
    } else {
        show(cli, args, &done, &folder);
    }
    Ok(())
}

fn options(args: &ExportArgs, frames: Option<CameraFrames>) -> ExportOptions {
    ExportOptions {
        flange_frame: args.flange_frame.clone(),
        camera_frame: args.camera_frame.clone(),
        frames,
        ..ExportOptions::default()
    }
}

fn recording(cli: &Cli, args: &ExportArgs, dataset: &Dataset, staged: &StagedFolder) -> Result<RecordedResult> {
    let defaults = ResultRecordingOptions::default();
    let options = ResultRecordingOptions {
        flange_frame: args.flange_frame.clone(),
        camera_frame: args.camera_frame.clone().unwrap_or_else(|| USUAL_CAMERA_FRAME.to_owned()),
        residual_lines: defaults.residual_lines.filter(|_| !args.without_residuals),
        ..defaults
    };
    let path = staged.path("result.mcap")?;
    let file = File::create(&path).with_context(|| path.display().to_string())?;
    let screen = Screen::new(cli.quiet);
    let recorded = record_result(dataset, &args.result, &options, BufWriter::new(file), &screen)?;
    screen.finish();
    Ok(recorded)
}

fn show(cli: &Cli, args: &ExportArgs, done: &Done, folder: &Path) {
    let left_out = done.written.left_out.iter().chain(done.mcap.iter().flat_map(|mcap| &mcap.left_out));
    let left_out = left_out.map(|reason| format!("left out: {reason}"));
    screen::warn(cli.quiet, &left_out.chain(done.written.notes.iter().cloned()).collect::<Vec<_>>());
    if let (true, Some(diff)) = (args.diff, &done.written.urdf_diff) {
        say_on!("{diff}");
    }
    say!("{}", done.written.static_transform);
    let mut files: Vec<&str> = done.written.files.iter().map(String::as_str).collect();
    if let Some(mcap) = &done.mcap {
        let mut table = screen::table(&["topic", "messages"]);
        for (topic, count) in &mcap.messages {
            table.add_row([topic.clone(), count.to_string()]);
        }
        say!("{table}");
        files.push("result.mcap");
    }
    say!("Files: {} in {}", files.join(", "), folder.display());
}

fn urdf_source(path: &Path, args: &ExportArgs) -> Result<UrdfSource> {
    let shown = path.display();
    let text =
        skclam_files::read_text(path, skclam_files::Kind::RobotDescription).with_context(|| shown.to_string())?;
    let (bases, tips) = urdf_ends(&text).with_context(|| shown.to_string())?;
    let choose = |option: &str, given: &Option<String>, found: Vec<String>| match (given, found.as_slice()) {
        (Some(link), _) => Ok(link.clone()),
        (None, [only]) => Ok(only.clone()),
        (None, _) => bail!("{shown}: choose one of {} with {option}", found.join(", ")),
    };
    let base_link = choose("--base-link", &args.base_link, bases)?;
    let tip_link = choose("--tip-link", &args.tip_link, tips)?;
    // Links that are not there are reported with the file's name.
    chain_from_urdf(&text, &base_link, &tip_link).with_context(|| shown.to_string())?;
    Ok(UrdfSource { text, base_link, tip_link, is_wanted: true })
}

/// The URDF that the nominal rig names: its links are the frames of the reader.
fn urdf_of_nominal(args: &ExportArgs) -> Result<Option<UrdfSource>> {
    let path = match (&args.nominal, &args.dataset) {
        (Some(path), _) => path.clone(),
        (None, Some(folder)) => folder.join("rig.toml"),
        (None, None) => return Ok(None),
    };
    let description = RobotDescription::of_rig(path)?;
    Ok(description.map(|RobotDescription { text, base_link, tip_link, .. }| UrdfSource {
        text,
        base_link,
        tip_link,
        is_wanted: false,
    }))
}
