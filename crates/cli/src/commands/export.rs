//! `skclam export`.

use crate::args::Cli;
use crate::screen;
use anyhow::{Context, Result, bail};
use clap::{Args, ValueHint};
use skclam::export::{ExportOptions, UrdfSource, export as write_export};
use skclam::kinematics::urdf_ends;
use skclam::output::StagedFolder;
use skclam::rig::Rig;
use std::path::{Path, PathBuf};

/// Arguments of `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// A result folder (with rig.toml), or a calibrated rig file.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub result: PathBuf,
    /// The rig that the calibration began with; with --urdf it may be left out.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath, required_unless_present = "urdf")]
    pub nominal: Option<PathBuf>,
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
    /// ROS optical frame of the colour camera.
    #[arg(long, value_name = "FRAME", default_value_t = ExportOptions::default().camera_frame)]
    pub camera_frame: String,
    /// Folder for the files; made if it is not there.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
}

/// Writes the calibrated arm in the forms that other programs read.
pub fn export(cli: &Cli, args: &ExportArgs) -> Result<()> {
    let path = if args.result.is_dir() { args.result.join("rig.toml") } else { args.result.clone() };
    let calibrated = Rig::read(path)?;
    let nominal = args.nominal.as_ref().map(Rig::read).transpose()?;
    let urdf = match &args.urdf {
        Some(path) => Some(urdf_source(path, args)?),
        None => None,
    };
    let options = ExportOptions {
        flange_frame: args.flange_frame.clone(),
        camera_frame: args.camera_frame.clone(),
        ..ExportOptions::default()
    };
    let staged = StagedFolder::new(&args.out)?;
    let exported = write_export(nominal.as_ref(), &calibrated, urdf.as_ref(), &options, &staged)?;
    let folder = staged.publish()?;
    if cli.json {
        println!("{}", serde_json::to_string_pretty(&exported)?);
        return Ok(());
    }
    screen::warn(cli.quiet, &exported.left_out.iter().map(|reason| format!("left out: {reason}")).collect::<Vec<_>>());
    if let (true, Some(diff)) = (args.diff, &exported.urdf_diff) {
        print!("{diff}");
    }
    println!("{}\nFiles: {} in {}", exported.static_transform, exported.files.join(", "), folder.display());
    Ok(())
}

/// The largest robot description that is read; meshes lie in files of their own.
const MAX_URDF_BYTES: u64 = 16 << 20;

fn urdf_source(path: &Path, args: &ExportArgs) -> Result<UrdfSource> {
    let shown = path.display();
    let length = std::fs::metadata(path).with_context(|| shown.to_string())?.len();
    if length > MAX_URDF_BYTES {
        bail!("{shown}: {length} bytes; a robot description has at most {MAX_URDF_BYTES}");
    }
    let text = std::fs::read_to_string(path).with_context(|| shown.to_string())?;
    let (bases, tips) = urdf_ends(&text).with_context(|| shown.to_string())?;
    let choose = |option: &str, given: &Option<String>, found: Vec<String>| match (given, found.as_slice()) {
        (Some(link), _) => Ok(link.clone()),
        (None, [only]) => Ok(only.clone()),
        (None, _) => bail!("{shown}: choose one of {} with {option}", found.join(", ")),
    };
    let base_link = choose("--base-link", &args.base_link, bases)?;
    let tip_link = choose("--tip-link", &args.tip_link, tips)?;
    Ok(UrdfSource { text, base_link, tip_link })
}
