//! What can be asked for on the command line.

use crate::commands::compensate::CompensateArgs;
use crate::commands::export::ExportArgs;
use crate::commands::import::ImportArgs;
use crate::commands::inspect::InspectArgs;
use crate::commands::report::{CompareArgs, ReportArgs};
use crate::commands::validate::ValidateArgs;
use clap::{Args, Parser, Subcommand, ValueEnum, ValueHint};
use std::path::PathBuf;

/// Calibrate a robot arm with the camera on its wrist.
///
/// Give skclam a folder with the colour images, the depth images and the joint values of 30 or more postures, and it
/// gives back the arm's true kinematic parameters, the camera's mount, where the camera was, and a map of the cell.
/// No target, no tracker. The folder's format: rig.toml, postures.csv, color/, depth/.
#[derive(Debug, Parser)]
#[command(name = "skclam", version, max_term_width = 100, propagate_version = true)]
#[command(after_help = "Try it on the built-in virtual cell:\n  skclam reproduce --quick --out out/reproduce\n\n\
                        Exit codes: 0 done, 1 failed, 2 wrong use. Results go to files and the table to standard output;\n\
                        warnings and progress go to standard error.")]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Threads to work with; all cores by default. The result does not depend on it.
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
    /// Print the summary as JSON on standard output instead of the table.
    #[arg(long, global = true)]
    pub json: bool,
    /// No progress and no warnings on standard error; errors still come.
    #[arg(long, short, global = true)]
    pub quiet: bool,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Everything: features, matches, calibration, trajectory, map.
    #[command(
        after_help = "Examples:\n  skclam run cell/ --out result/\n  skclam run cell/ --out result/ --preset paper --free angles\n\n\
                            Writes report.html (open it in a browser), rig.toml (the calibrated rig), trajectory.txt (TUM), map.ply,\n\
                            map_nominal.ply, summary.json and report_data.json, whole or not at all."
    )]
    Run(RunArgs),
    /// Only the calibration: writes report.html, rig.toml, trajectory.txt, summary.json and report_data.json.
    Calibrate(RunArgs),
    /// Only the map: every depth image at the pose that a rig gives it; writes map.ply and trajectory.txt.
    Map(MapArgs),
    /// Compare a rig with a known true one: errors of parameters and poses.
    Evaluate(EvaluateArgs),
    /// Measure a rig on a recording that it was not fitted to, beside the data set's own rig; or by points of a
    /// tracker.
    #[command(
        after_help = "Examples:\n  skclam validate tuesday/ --rig result/rig.toml\n  skclam validate tuesday/ --rig result/ --refit mount\n  \
                            skclam validate --points tracker.csv --rig result/ --nominal cell/rig.toml\n\n\
                            With --refit, these parameters of both rigs are fitted to the recording first, and nothing else:\n\
                            mount, after the camera was taken off and put back. With --points, the marker's place on the flange and the\n\
                            instrument's frame are fitted to each rig, and nothing else; without DATASET no image is needed."
    )]
    Validate(ValidateArgs),
    /// Render a data set in the virtual cell: images, depth, postures, nominal and true rig.
    Simulate(SimulateArgs),
    /// Draw a map (PLY) to a PNG file, without a window; two maps side by side with --beside.
    #[command(
        after_help = "Example:\n  skclam render result/map_nominal.ply --beside result/map.ply --view top --out maps.png"
    )]
    Render(RenderArgs),
    /// Repeat the paper's experiments in the virtual cell and print its tables beside ours.
    #[command(
        after_help = "With --quick: half-size images, a few minutes less. Without: 1920x1080, as in the paper.\n\
                            Writes report.md and report.json, and the maps."
    )]
    Reproduce(ReproduceArgs),
    /// Make a data set of a recording: ROS 1 and 2 bags, MCAP, RealSense Viewer, TUM RGB-D.
    #[command(
        after_help = "Examples:\n  skclam import capture.mcap --robot ur5e --out cell/\n  skclam import capture.bag --rig rig.toml --out cell/ --moving --every 15\n\n\
                            A posture is taken where the arm stands still: the sharpest image of each stationary interval, with its depth image.\n\
                            Writes rig.toml, postures.csv, color/ and depth/, whole or not at all."
    )]
    Import(ImportArgs),
    /// Summarise a recording; or judge a data set before calibrating: coverage, sharpness, exposure, overlap.
    #[command(after_help = "Examples:\n  skclam inspect capture.mcap\n  skclam inspect cell/")]
    Inspect(InspectArgs),
    /// Turn target poses or joints into the ones to command, for controllers that accept no parameters.
    #[command(
        after_help = "Example:\n  skclam compensate targets.csv --nominal cell/rig.toml --calibrated result/rig.toml --out commands.csv\n\n\
                            Joints in the result go to a controller that takes joints, poses to one that takes poses: not both corrections at once."
    )]
    Compensate(CompensateArgs),
    /// Write the calibrated arm as URDF, kinematics.yaml, static transform, table of corrections and JSON; the result
    /// as MCAP.
    #[command(
        after_help = "Examples:\n  skclam export result/ --nominal cell/rig.toml --urdf robot.urdf --base-link base_link --tip-link tool0 --diff --out export/\n  skclam export result/ --dataset cell/ --mcap --out export/\n\n\
                            The second writes export/result.mcap for Foxglove and Rerun: images, frames, trajectories, maps and residuals,\n\
                            nominal and calibrated. A xacro is to be expanded first: xacro robot.urdf.xacro > robot.urdf"
    )]
    Export(ExportArgs),
    /// Build report.html again from a result folder; it needs neither the data set nor a network.
    #[command(after_help = "Example:\n  skclam report result/")]
    Report(ReportArgs),
    /// Put several results side by side: parameters, residuals, held-out postures, surfaces.
    #[command(after_help = "Example:\n  skclam compare monday/ friday/ --out compare.html\n\n\
                            The first result is the one that the others are compared with. Different robots are allowed: rows go by name.")]
    Compare(CompareArgs),
    /// Print a completion script for a shell.
    #[command(after_help = "Example:\n  skclam completions bash > ~/.local/share/bash-completion/completions/skclam")]
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
}

/// Which set of options a run starts from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PresetArg {
    /// All good matches, refined; overlapping pairs; least squares with covariance.
    Default,
    /// The paper to the letter: neighbours, ratio 0.6, gate 7.3 deg, the 30 best, Eq. (7), Nelder-Mead.
    Paper,
}

/// Arguments of `run` and `calibrate`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Folder with rig.toml, postures.csv, color/ and depth/.
    #[arg(value_hint = ValueHint::DirPath)]
    pub dataset: PathBuf,
    /// Folder for the results; made if it is not there.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// Start from these options.
    #[arg(long, value_enum, default_value = "default")]
    pub preset: PresetArg,
    /// Which parameters are free: auto (what the data can identify), angles (the paper's ten), all, or a list such as
    /// "angles,mount", "alpha_2,theta_offset_3,fx" or "auto,gears". Groups: arm, lengths, mount, intrinsics, focal,
    /// depth, gears, compliance.
    #[arg(long, value_name = "SET")]
    pub free: Option<String>,
    /// Seed of every random choice.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Leave the depth images out, as if there were none: then hold a length with --free, or the scale comes from
    /// priors.
    #[arg(long)]
    pub no_depth: bool,
    /// Nothing is known of the mount: find it from the images first, with the nominal arm; the rig's own mount is
    /// ignored.
    #[arg(long)]
    pub find_mount: bool,
    /// Another nominal rig than the data set's rig.toml.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath)]
    pub rig: Option<PathBuf>,
    /// Options as a JSON file: the `configuration` of an earlier summary.json, or a part of it. --preset, --free and
    /// --seed on the command line come first.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub config: Option<PathBuf>,
    /// The robot's own body.
    #[command(flatten)]
    pub self_filter: SelfFilterArgs,
}

/// The robot's own body in the depth images.
#[derive(Debug, Clone, Args)]
pub struct SelfFilterArgs {
    /// The robot's URDF: its collision geometry at each posture (boxes, cylinders, spheres, STL meshes) is kept out of
    /// the map.
    #[arg(long, value_name = "URDF", value_hint = ValueHint::FilePath)]
    pub self_filter: Option<PathBuf>,
    /// The URDF's link whose frame is the rig's base; by default the URDF's root.
    #[arg(long, value_name = "LINK", requires = "self_filter")]
    pub self_filter_base: Option<String>,
    /// What is this near to the robot's body is taken for it, millimetres.
    #[arg(long, value_name = "MM", default_value_t = 20.0, requires = "self_filter")]
    pub self_filter_margin_mm: f64,
}

/// A file that `map` can write beside the cloud.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MapFileArg {
    /// mesh.ply: the fused surface.
    Mesh,
    /// mesh.obj.
    Obj,
    /// mesh.glb.
    Glb,
    /// collision.stl: fewer triangles, for planners.
    Stl,
    /// cloud.pcd: the surface's vertices.
    Pcd,
    /// map.bt and map.ot: free and occupied space.
    Octomap,
    /// esdf.npz: distance to the nearest obstacle.
    Esdf,
}

/// Arguments of `map`.
#[derive(Debug, Args)]
pub struct MapArgs {
    /// Folder with rig.toml, postures.csv, color/ and depth/.
    #[arg(value_hint = ValueHint::DirPath)]
    pub dataset: PathBuf,
    /// The rig whose poses are used: a calibrated rig.toml. Without it, the data set's own (nominal) rig.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath)]
    pub rig: Option<PathBuf>,
    /// Folder for the results; made if it is not there.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// Edge of a voxel, millimetres; by default what the depth camera resolves at the range at which it was used.
    #[arg(long, value_name = "MM")]
    pub voxel_mm: Option<f64>,
    /// More files, separated by commas: the fused surface and free space, for planners.
    #[arg(long, value_enum, value_delimiter = ',', value_name = "FILE,...")]
    pub also: Vec<MapFileArg>,
    /// The robot's own body.
    #[command(flatten)]
    pub self_filter: SelfFilterArgs,
}

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    /// A result folder (with rig.toml), or a rig file.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub result: PathBuf,
    /// The true rig.
    #[arg(long, value_name = "RIG", value_hint = ValueHint::FilePath)]
    pub truth: PathBuf,
    /// The data set whose postures are compared.
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub dataset: PathBuf,
    /// The true surface (PLY, base frame): the result's mesh.ply or map.ply is compared with it.
    #[arg(long, value_name = "PLY", value_hint = ValueHint::FilePath)]
    pub surface: Option<PathBuf>,
}

/// Image noise of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ImageNoiseArg {
    /// Clean images.
    None,
    /// 20,000 coloured pixels, then a Gaussian blur of 9x9, as in the paper's 4.1.1.
    Paper,
}

/// Postures of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PosturesArg {
    /// The 73 postures of the paper's 4.1.1.
    Paper,
    /// Random postures that look at the cell from all sides.
    Diverse,
}

/// True arm of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ErrorsArg {
    /// 1 deg on alpha_2..6 and theta_offset_2..6, as in the paper.
    Paper,
    /// Drawn at random over all parameters of arm and mount.
    Random,
}

/// Arguments of `simulate`.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Folder for the data set.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// A built-in robot (hp3j, hp3-like) or a rig file with the nominal rig.
    #[arg(long, default_value = "hp3j", value_name = "NAME|RIG")]
    pub robot: String,
    /// Postures.
    #[arg(long, value_enum, default_value = "paper")]
    pub postures: PosturesArg,
    /// How many, with --postures diverse.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u16).range(2..=5000))]
    pub count: u16,
    /// In what the true arm differs from the nominal one.
    #[arg(long, value_enum, default_value = "paper")]
    pub errors: ErrorsArg,
    /// Noise in the colour images.
    #[arg(long, value_enum, default_value = "none")]
    pub image_noise: ImageNoiseArg,
    /// Standard deviation of the encoders, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    pub encoder_noise_deg: f64,
    /// Scale of the colour image: 1 is 1920x1080.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    pub scale: f64,
    /// Seed of diverse postures, where they shall differ from those of another recording of the same arm; by default
    /// --seed.
    #[arg(long, value_name = "N")]
    pub posture_seed: Option<u64>,
    /// Also write the data set as a robot would have recorded it (MCAP, ROS 2 messages), to practise `import`.
    #[arg(long, value_name = "MCAP", value_hint = ValueHint::FilePath)]
    pub recording: Option<PathBuf>,
    /// Seed of scene, noise and random arm.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
}

/// Arguments of `reproduce`.
#[derive(Debug, Args)]
pub struct ReproduceArgs {
    /// Folder for data sets, results and the report.
    #[arg(long, short, value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// Half-size images, for a first look.
    #[arg(long)]
    pub quick: bool,
    /// Seed of scene, noise and RANSAC.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
}

/// From where a map is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ViewArg {
    /// From before the robot.
    Front,
    /// From behind the robot.
    Back,
    /// From the robot's left.
    Left,
    /// From the robot's right.
    Right,
    /// From above.
    Top,
    /// From above at an angle, parallel projection.
    Isometric,
    /// From above at an angle, in perspective.
    Perspective,
}

/// Arguments of `render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// The map: a cloud or a mesh as PLY.
    #[arg(value_hint = ValueHint::FilePath)]
    pub map: PathBuf,
    /// A second map, drawn to the right of the first from the same place.
    #[arg(long, value_name = "MAP", value_hint = ValueHint::FilePath)]
    pub beside: Option<PathBuf>,
    /// The image, PNG or JPEG.
    #[arg(long, short, value_name = "IMAGE", value_hint = ValueHint::FilePath)]
    pub out: PathBuf,
    /// From where.
    #[arg(long, value_enum, default_value = "perspective", conflicts_with_all = ["eye", "target"])]
    pub view: ViewArg,
    /// The viewer's place "x,y,z" in the base frame, metres.
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, requires = "target")]
    pub eye: Option<[f64; 3]>,
    /// What the viewer looks at, "x,y,z", metres.
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true, requires = "eye")]
    pub target: Option<[f64; 3]>,
    /// Horizontal field of view with --eye, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 60.0)]
    pub hfov_deg: f64,
    /// Width of the image of one map, pixels.
    #[arg(long, value_name = "PX", default_value_t = 1200, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub width: u32,
    /// Height of the image, pixels.
    #[arg(long, value_name = "PX", default_value_t = 800, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub height: u32,
    /// Radius of a point, millimetres.
    #[arg(long, value_name = "MM", default_value_t = 4.0)]
    pub point_radius_mm: f64,
}

/// Reads "x,y,z".
fn point(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|number| number.trim().parse::<f64>().ok().filter(|value| value.is_finite()))
        .collect::<Option<_>>()
        .ok_or_else(|| format!("\"{text}\" is not of the form 0.5,-1,1.2"))?;
    numbers.try_into().map_err(|numbers: Vec<f64>| format!("{} numbers where three are needed", numbers.len()))
}
