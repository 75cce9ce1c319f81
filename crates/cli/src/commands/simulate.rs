//! `skclam simulate`.

use crate::args::{Cli, ErrorsArg, ImageNoiseArg, PosturesArg, SimulateArgs};
use crate::commands::run::stages;
use crate::progress::Screen;
use crate::screen::{self, say};
use anyhow::{Result, bail};
use skclam::dataset::Dataset;
use skclam::output::{Contents, StagedFile};
use skclam::rig::{Rig, builtin_names, builtin_rig};
use skclam::robot_recording::write_robot_recording;
use skclam::simulation::{
    ColorNoiseOptions, DepthNoiseOptions, DiverseOptions, EncoderNoiseOptions, PaperView, Perturbation,
    PerturbationSigmas, PosturePlan, SceneOptions, Simulation, SimulationConfig,
};
use skclam::virtual_cell::{scaled_rig, write_virtual_cell};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

/// Renders a data set.
pub fn simulate(cli: &Cli, args: &SimulateArgs) -> Result<()> {
    if !(args.scale > 0.01 && args.scale <= 4.0) {
        bail!("--scale {}: a factor above 0.01 and up to 4 is needed", args.scale);
    }
    let nominal = scaled_rig(&rig(&args.robot)?, args.scale);
    let simulation = Simulation::new(&nominal, &config(args))?;
    let staged = screen::staged(cli.quiet, &args.out, Contents::DataSet)?;
    // Before the work, like the folder.
    let recording = args.recording.as_ref().map(StagedFile::new).transpose()?;
    let screen = Screen::new(cli.quiet);
    write_virtual_cell(&simulation, &staged, &screen)?;
    let folder = staged.publish()?;
    if let Some(staged) = recording {
        write_recording(&folder, staged, &screen)?;
    }
    let wall: f64 = stages(&screen).iter().map(|stage| stage.wall_s).sum();
    let postures = simulation.postures().len();
    if cli.json {
        screen::json(&serde_json::json!({ "postures": postures, "wall_s": wall, "folder": folder }))?;
    } else {
        say!("{postures} postures in {wall:.1} s\nData set: {} (the truth lies in truth/)", folder.display());
    }
    Ok(())
}

/// The data set as the robot would have recorded it; whole or not at all.
fn write_recording(folder: &Path, staged: StagedFile, screen: &Screen) -> Result<()> {
    let dataset = Dataset::open(folder)?;
    let out = BufWriter::new(File::create(staged.path())?);
    write_robot_recording(&dataset, out, screen)?;
    staged.publish()?;
    Ok(())
}

/// A built-in rig by its name, or a rig file.
pub fn rig(name: &str) -> Result<Rig> {
    if let Some(rig) = builtin_rig(name) {
        return Ok(rig?);
    }
    if !Path::new(name).exists() {
        let known: Vec<_> = builtin_names().collect();
        bail!("\"{name}\" is neither a file nor a built-in robot; built in are {}", known.join(", "));
    }
    Ok(Rig::read(name)?)
}

fn config(args: &SimulateArgs) -> SimulationConfig {
    // One seed in, a stream of its own for each kind of noise.
    let stream = |seed: u64, stream: u64| seed.wrapping_mul(1000).wrapping_add(stream);
    let seed = |number: u64| stream(args.seed, number);
    let posture_seed = stream(args.posture_seed.unwrap_or(args.seed), 2);
    SimulationConfig {
        scene: SceneOptions { seed: args.seed, ..SceneOptions::default() },
        perturbation: match args.errors {
            ErrorsArg::Paper => Perturbation::Paper,
            ErrorsArg::Random => Perturbation::Random { seed: seed(1), sigmas: PerturbationSigmas::default() },
        },
        postures: match args.postures {
            PosturesArg::Paper => PosturePlan::Paper { view: PaperView::default() },
            PosturesArg::Diverse => PosturePlan::Diverse {
                options: DiverseOptions {
                    seed: posture_seed,
                    count: usize::from(args.count),
                    ..DiverseOptions::default()
                },
            },
        },
        color_noise: match args.image_noise {
            ImageNoiseArg::None => ColorNoiseOptions { seed: seed(3), ..ColorNoiseOptions::default() },
            ImageNoiseArg::Paper => ColorNoiseOptions { seed: seed(3), ..ColorNoiseOptions::paper() },
        },
        depth_noise: DepthNoiseOptions { seed: seed(4), ..DepthNoiseOptions::default() },
        encoder_noise: EncoderNoiseOptions {
            seed: seed(5),
            sigma_deg: args.encoder_noise_deg,
            ..EncoderNoiseOptions::default()
        },
        ..SimulationConfig::default()
    }
}
