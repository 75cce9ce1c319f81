//! `skclam import`.

use crate::args::Cli;
use crate::commands::simulate::rig as builtin_or_file;
use crate::progress::Screen;
use crate::screen::{self, say};
use anyhow::{Context, Result, bail};
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, ValueEnum, ValueHint};
use skclam::import::{
    CameraSource, ClockChoice, DepthChoice, ImportOptions, ImportSummary, PoseNotation, PoseTableOptions, import_poses,
    import_recording, read_joint_log,
};
use skclam::output::{Contents, StagedFolder};
use skclam::recordings::{Recording, Selection, SelectionOptions};
use skclam::rig::{Rig, builtin_names, builtin_rig};
use std::path::{Path, PathBuf};

/// Arguments of `import`.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// A ROS 1 .bag, a ROS 2 .mcap or .db3 or the folder that holds them (compressed with zstd too), a RealSense Viewer
    /// .bag, a TUM RGB-D folder.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub recording: PathBuf,
    /// Folder for the data set; made if it is not there.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// Rig file with the arm and the mount; its cameras are taken where the recording has no CameraInfo that can be read.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath, conflicts_with = "robot")]
    pub rig: Option<PathBuf>,
    /// A built-in robot by name (ur5e, franka-fr3, ...): its mount is a guess that you should replace.
    #[arg(long, value_name = "NAME")]
    pub robot: Option<String>,
    /// Topic of the colour images; by default the only one.
    #[arg(long, value_name = "TOPIC")]
    pub color_topic: Option<String>,
    /// Topic of the depth images; by default the only one. "none" leaves depth out.
    #[arg(long, value_name = "TOPIC")]
    pub depth_topic: Option<String>,
    /// Topic of the joint states; by default the only one that has the arm's joints.
    #[arg(long, value_name = "TOPIC")]
    pub joint_topic: Option<String>,
    /// The recording's names of the joints from base to flange, where they are not those of the rig; for positions
    /// without names, names in their order, "-" for one that is no joint of the arm.
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub joint_names: Option<Vec<String>>,
    /// Joints that were recorded apart: CSV with timestamp_s and q1_deg (or q1_rad, q1_mm) ...
    #[arg(long, value_name = "CSV", value_hint = ValueHint::FilePath, conflicts_with = "joint_topic")]
    pub joints: Option<PathBuf>,
    /// What is to be added to the times of --joints to get those of the images, seconds.
    #[arg(long, value_name = "S", default_value_t = 0.0, allow_negative_numbers = true, requires = "joints")]
    pub joint_offset_s: f64,
    /// A folder of images and a table of the flange's poses, as this maker's controller shows them, instead of a recording.
    #[arg(long, value_name = "MAKER", value_enum, conflicts_with_all = ["joints", "joint_topic", "joint_names", "robot"])]
    pub poses: Option<PosesArg>,
    /// The table of poses; by default the only .csv of the folder.
    #[arg(long, value_name = "CSV", value_hint = ValueHint::FilePath, requires = "poses")]
    pub pose_table: Option<PathBuf>,
    /// Unit of lengths where the columns do not say (x_mm, x_m); by default the maker's.
    #[arg(long, value_name = "UNIT", value_enum, requires = "poses")]
    pub poses_length: Option<LengthArg>,
    /// Unit of angles where the columns do not say (a_deg, a_rad); by default the maker's.
    #[arg(long, value_name = "UNIT", value_enum, requires = "poses")]
    pub poses_angle: Option<AngleArg>,
    /// Keep the intrinsics of --rig even where the recording has its own.
    #[arg(long)]
    pub rig_cameras: bool,
    /// Which times pair images and joints: the stamps in the headers, or the times of recording.
    #[arg(long, value_name = "CLOCK", value_enum, default_value_t = ClockArg::Auto)]
    pub clock: ClockArg,
    /// Take images of the moving arm, with interpolated joints; without it, one image each time that the arm stands still.
    #[arg(long)]
    pub moving: bool,
    /// With --moving: every N-th image.
    #[arg(long, value_name = "N", default_value_t = 10, requires = "moving", value_parser = clap::value_parser!(u32).range(1..))]
    pub every: u32,
    /// Take every image that has joints beside it: for recordings that were made posture by posture.
    #[arg(long, conflicts_with = "moving")]
    pub snapshots: bool,
    /// The arm stands still while every joint is slower than this, deg/s (mm/s for sliding joints: 17 times the
    /// number).
    #[arg(long, value_name = "DEG_PER_S", default_value_t = 0.3)]
    pub still_below: f64,
    /// ... for at least so long, seconds.
    #[arg(long, value_name = "S", default_value_t = SelectionOptions::default().min_stationary_s)]
    pub still_for: f64,
    /// Images within so many seconds after a stop are not used.
    #[arg(long, value_name = "S", default_value_t = SelectionOptions::default().settle_s)]
    pub settle: f64,
}

/// Which of a message's times counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ClockArg {
    /// The stamps in the headers; the times of recording where the stamps stand still.
    Auto,
    /// The stamps in the headers.
    Header,
    /// The times of recording.
    Log,
}

/// Whose controller wrote the poses, by its columns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PosesArg {
    /// X Y Z A B C.
    Kuka,
    /// X Y Z W P R.
    Fanuc,
    /// X Y Z q1 q2 q3 q4, the real part first.
    Abb,
    /// X Y Z Rx Ry Rz: a rotation vector.
    Ur,
    /// X Y Z Rx Ry Rz: about x, the new y, the newest z.
    Staubli,
    /// X Y Z Rx Ry Rz: about the fixed x, y, z.
    Yaskawa,
    /// m11 m12 ... m34, row by row.
    Matrix,
}

/// A unit of length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LengthArg {
    /// Millimetres.
    Mm,
    /// Metres.
    M,
}

/// A unit of angle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum AngleArg {
    /// Degrees.
    Deg,
    /// Radians.
    Rad,
}

fn pose_options(args: &ImportArgs, poses: PosesArg) -> PoseTableOptions {
    PoseTableOptions {
        notation: match poses {
            PosesArg::Kuka => PoseNotation::Kuka,
            PosesArg::Fanuc => PoseNotation::Fanuc,
            PosesArg::Abb => PoseNotation::Abb,
            PosesArg::Ur => PoseNotation::Ur,
            PosesArg::Staubli => PoseNotation::Staubli,
            PosesArg::Yaskawa => PoseNotation::Yaskawa,
            PosesArg::Matrix => PoseNotation::Matrix,
        },
        length_m: args.poses_length.map(|unit| if unit == LengthArg::Mm { 1e-3 } else { 1.0 }),
        angle: args.poses_angle.map(|unit| if unit == AngleArg::Deg { 1f64.to_radians() } else { 1.0 }),
    }
}

/// Makes a data set of a folder of images and a table of poses.
fn import_pose_folder(cli: &Cli, args: &ImportArgs, poses: PosesArg) -> Result<()> {
    let Some(path) = &args.rig else { bail!("--poses: the cameras are missing: give them in a rig (--rig RIG)") };
    let rig = Rig::read(path)?;
    let staged = screen::staged(cli.quiet, &args.out, Contents::DataSet)?;
    let table = args.pose_table.as_deref();
    let summary = import_poses(&args.recording, table, &rig, pose_options(args, poses), &staged)?;
    copy_masks(&rig, path, &staged)?;
    let folder = staged.publish()?;
    show(cli, args, &summary, &folder)
}

/// Makes a data set of a recording.
pub fn import(cli: &Cli, args: &ImportArgs) -> Result<()> {
    if let Some(poses) = args.poses {
        return import_pose_folder(cli, args, poses);
    }
    let rig = match (&args.rig, &args.robot) {
        (Some(path), _) => Rig::read(path)?,
        (None, Some(name)) => builtin_or_file(name)?,
        (None, None) => no_arm(),
    };
    let joint_log = match (&args.joints, &rig.robot) {
        (Some(path), Some(robot)) => Some(read_joint_log(path, robot, args.joint_offset_s)?),
        (Some(_), None) => bail!("--joints: the rig has no [robot]"),
        (None, _) => None,
    };
    let staged = screen::staged(cli.quiet, &args.out, Contents::DataSet)?;
    let screen = Screen::new(cli.quiet);
    let mut recording = Recording::open(&args.recording)?;
    let summary = import_recording(&mut recording, &rig, joint_log, &options(args), &staged, &screen)?;
    if let Some(path) = &args.rig {
        copy_masks(&rig, path, &staged)?;
    }
    let folder = staged.publish()?;
    screen.finish();
    show(cli, args, &summary, &folder)
}

fn show(cli: &Cli, args: &ImportArgs, summary: &ImportSummary, folder: &Path) -> Result<()> {
    if cli.json {
        screen::json(summary)?;
        return Ok(());
    }
    let mut warnings = summary.warnings.clone();
    if options(args).builtin_rig {
        warnings.push("the mount is that of the built-in robot, a guess: put yours into rig.toml".to_owned());
    }
    screen::warn(cli.quiet, &warnings);
    let depth = summary.depth_topic.as_deref().unwrap_or("none");
    say!("Colour: {} ({} images)\nDepth:  {depth}", summary.color_topic, summary.color_images);
    say!("Joints: {}", summary.joint_topic);
    let lacking = match summary.without_depth {
        0 => String::new(),
        count => format!(", {count} without depth"),
    };
    say!("{} postures{lacking}\nData set: {}", summary.postures, folder.display());
    say!("Look at it before you calibrate: skclam inspect {}", folder.display());
    Ok(())
}

/// Ends the program as clap does, with both ways out.
fn no_arm() -> ! {
    let mut command = Cli::command();
    command.build();
    let names = builtin_names().collect::<Vec<_>>().join(", ");
    let text = format!("the arm is missing: --rig RIG (a rig file), or --robot NAME (built in: {names})");
    let import = command.find_subcommand_mut("import").cloned();
    import.unwrap_or(command).error(ErrorKind::MissingRequiredArgument, text).exit()
}

fn options(args: &ImportArgs) -> ImportOptions {
    let selection = match (args.moving, args.snapshots) {
        (true, _) => Selection::Moving { every: args.every },
        (false, true) => Selection::Snapshots,
        (false, false) => Selection::Automatic,
    };
    ImportOptions {
        color_topic: args.color_topic.clone(),
        depth: match args.depth_topic.as_deref() {
            None => DepthChoice::Automatic,
            Some("none") => DepthChoice::None,
            Some(topic) => DepthChoice::Topic(topic.to_owned()),
        },
        joint_topic: args.joint_topic.clone(),
        joint_names: args.joint_names.clone(),
        // --robot may name a file too, whose cameras somebody has described.
        builtin_rig: args.robot.as_ref().is_some_and(|name| builtin_rig(name).is_some()),
        clock: match args.clock {
            ClockArg::Auto => ClockChoice::Automatic,
            ClockArg::Header => ClockChoice::Header,
            ClockArg::Log => ClockChoice::Log,
        },
        cameras: if args.rig_cameras { CameraSource::Rig } else { CameraSource::Recording },
        selection: SelectionOptions {
            selection,
            max_joint_speed: args.still_below.to_radians(),
            min_stationary_s: args.still_for,
            settle_s: args.settle,
            ..SelectionOptions::default()
        },
    }
}

/// The masks that a rig names lie beside it, and are to lie beside the new one.
fn copy_masks(rig: &Rig, path: &Path, staged: &StagedFolder) -> Result<()> {
    let folder = path.parent().unwrap_or(Path::new(""));
    for name in [&rig.color_mask, &rig.depth_mask].into_iter().flatten() {
        let bytes = skclam_files::inside(folder, name)
            .and_then(|mask| skclam_files::read(mask, skclam_files::Kind::Image))
            .with_context(|| format!("the mask {}", folder.join(name).display()))?;
        staged.write(name, bytes)?;
    }
    Ok(())
}
