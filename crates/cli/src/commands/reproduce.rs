//! `skclam reproduce`: the paper's experiments from the first pixel to the tables.

use crate::args::{Cli, ReproduceArgs};
use crate::commands::run::stages;
use crate::progress::{Screen, peak_memory_mib};
use crate::screen::{note, say};
use anyhow::{Context, Result};
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::evaluation::evaluate;
use skclam::output::{Contents, StagedFolder};
use skclam::pipeline::{self, Config};
use skclam::reproduction::{Reproduction, Trial};
use skclam::rig::{Rig, builtin_rig};
use skclam::simulation::{
    ColorNoiseOptions, LaserOptions, SceneOptions, Simulation, SimulationConfig, laser_experiment,
};
use skclam::virtual_cell::{scaled_rig, write_virtual_cell};
use std::path::Path;

/// Scale of the images with `--quick`.
const QUICK_SCALE: f64 = 0.5;

/// Repeats the experiments.
pub fn reproduce(cli: &Cli, args: &ReproduceArgs) -> Result<()> {
    let nominal = builtin_rig("hp3j").context("the rig hp3j is built in")??;
    let nominal = if args.quick { scaled_rig(&nominal, QUICK_SCALE) } else { nominal };
    let mut simulation_s = Vec::new();
    for (noise, name) in [(false, "cell"), (true, "cell_noise")] {
        simulation_s.push(simulate(cli, args, &nominal, noise, &args.out.join(name))?);
    }
    let mut trials = Vec::new();
    for (preset, config) in
        [("paper", Config::paper()), ("default", Config { free: Free::Angles, ..Config::default() })]
    {
        for (noise, name) in [(false, "cell"), (true, "cell_noise")] {
            let config = Config { seed: args.seed, ..config.clone() };
            let out = args.out.join(format!("{preset}_{name}"));
            trials.push(trial(cli, preset, &config, noise, &args.out.join(name), &out)?);
        }
    }
    let reproduction = Reproduction {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        image: [nominal.color.width, nominal.color.height],
        postures: trials.first().map_or(0, |trial| trial.evaluation.postures),
        seed: args.seed,
        simulation_s,
        trials,
    };
    let json = serde_json::to_string_pretty(&reproduction)?;
    let staged = StagedFolder::new(&args.out, Contents::Reproduction)?;
    staged.write("report.md", reproduction.markdown())?;
    staged.write("report.json", &json)?;
    staged.publish()?;
    if cli.json {
        say!("{json}");
    } else {
        say!("{}", reproduction.markdown());
        say!("Report: {}; data sets, rigs and maps lie beside it", args.out.join("report.md").display());
    }
    Ok(())
}

fn say(cli: &Cli, text: &str) {
    if !cli.quiet {
        note!("{text}");
    }
}

/// Renders a data set; wall-clock seconds.
fn simulate(cli: &Cli, args: &ReproduceArgs, nominal: &Rig, noise: bool, out: &Path) -> Result<f64> {
    say(cli, &format!("rendering {}", out.display()));
    let color_noise = if noise { ColorNoiseOptions::paper() } else { ColorNoiseOptions::default() };
    let config = SimulationConfig {
        scene: SceneOptions { seed: args.seed, ..SceneOptions::default() },
        color_noise: ColorNoiseOptions { seed: args.seed, ..color_noise },
        ..SimulationConfig::default()
    };
    let screen = Screen::new(cli.quiet);
    let simulation = Simulation::new(nominal, &config)?;
    let staged = StagedFolder::new(out, Contents::DataSet)?;
    write_virtual_cell(&simulation, &staged, &screen)?;
    staged.publish()?;
    Ok(stages(&screen).iter().map(|stage| stage.wall_s).sum())
}

/// Calibrates, maps, compares with the truth.
fn trial(cli: &Cli, preset: &str, config: &Config, noise: bool, folder: &Path, out: &Path) -> Result<Trial> {
    say(cli, &format!("calibrating {}, preset {preset}", folder.display()));
    let dataset = Dataset::open(folder)?;
    let truth = Rig::read(folder.join("truth/rig.toml"))?;
    let staged = StagedFolder::new(out, Contents::Result)?;
    let screen = Screen::new(cli.quiet);
    let mut outcome = pipeline::run(&dataset, config, &screen)?;
    outcome.summary.stages = stages(&screen);
    outcome.summary.peak_memory_mib = peak_memory_mib();
    outcome.write(&staged)?;
    staged.publish()?;
    let postures: Vec<_> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let chain = |rig: &Rig| rig.robot.clone().context("the rig has an arm");
    let laser =
        laser_experiment(&chain(&dataset.rig)?, &chain(&outcome.rig)?, &chain(&truth)?, &LaserOptions::default())?;
    let timed = outcome.summary.stages.iter().filter(|stage| stage.stage != "map").cloned().collect();
    Ok(Trial {
        preset: preset.to_owned(),
        noise,
        evaluation: evaluate(&outcome.rig, &truth, &postures)?,
        nominal: evaluate(&dataset.rig, &truth, &postures)?,
        stages: timed,
        laser,
        summary: outcome.summary,
    })
}
