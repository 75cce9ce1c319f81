//! Virtual cells with images, rendered once and kept in a folder.

use anyhow::{Context, Result};
use skclam::dataset::Dataset;
use skclam::output::StagedFolder;
use skclam::progress::Silent;
use skclam::rig::{Posture, Rig, builtin_rig};
use skclam::simulation::{
    DepthNoiseOptions, DiverseOptions, EncoderNoiseOptions, Perturbation, PerturbationSigmas, PosturePlan,
    SceneOptions, Simulation, SimulationConfig,
};
use skclam::virtual_cell::{scaled_rig, write_virtual_cell};
use std::path::{Path, PathBuf};

/// Which cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellOptions {
    /// Scene, arm, postures and noise are drawn from it.
    pub seed: u64,
    /// Scale of the colour image: 1 is 1920 x 1080.
    pub scale: f64,
    /// Diverse postures.
    pub postures: usize,
    /// Standard deviation of the encoders, degrees.
    pub encoder_noise_deg: f64,
}

/// A recording of a virtual cell, and its truth.
#[derive(Debug, Clone)]
pub struct Cell {
    /// The recording with the nominal rig.
    pub dataset: Dataset,
    /// The true rig.
    pub truth: Rig,
}

impl Cell {
    /// Reads a folder as `skclam simulate` writes it.
    ///
    /// # Errors
    /// What cannot be read.
    pub fn open(folder: &Path) -> Result<Self> {
        Ok(Cell { dataset: Dataset::open(folder)?, truth: Rig::read(folder.join("truth/rig.toml"))? })
    }

    /// The cell of these options, rendered into a folder under `work` unless it lies there already.
    ///
    /// # Errors
    /// Options out of range, files that cannot be written.
    pub fn rendered(work: &Path, options: &CellOptions) -> Result<Self> {
        let folder = folder_of(work, options);
        if !folder.join("truth/rig.toml").exists() {
            render(&folder, options).with_context(|| format!("rendering {}", folder.display()))?;
        }
        Cell::open(&folder)
    }

    /// The postures as the controller wrote them down.
    pub fn postures(&self) -> Vec<Posture> {
        self.dataset.records.iter().map(|record| record.posture.clone()).collect()
    }

    /// Only the first postures.
    pub fn truncated(mut self, count: usize) -> Self {
        self.dataset.records.truncate(count);
        self
    }
}

fn folder_of(work: &Path, options: &CellOptions) -> PathBuf {
    let CellOptions { seed, scale, postures, encoder_noise_deg } = options;
    work.join(format!("cells/seed-{seed}-scale-{scale:.3}-postures-{postures}-encoders-{encoder_noise_deg}"))
}

fn render(folder: &Path, options: &CellOptions) -> Result<()> {
    let nominal = scaled_rig(&builtin_rig("hp3j").context("the rig hp3j is built in")??, options.scale);
    // One seed in, a stream of its own for each kind of noise, as `skclam simulate` has them.
    let stream = |number: u64| options.seed.wrapping_mul(1000).wrapping_add(number);
    let config = SimulationConfig {
        scene: SceneOptions { seed: options.seed, ..SceneOptions::default() },
        perturbation: Perturbation::Random { seed: stream(1), sigmas: PerturbationSigmas::default() },
        postures: PosturePlan::Diverse {
            options: DiverseOptions { seed: stream(2), count: options.postures, ..DiverseOptions::default() },
        },
        depth_noise: DepthNoiseOptions { seed: stream(4), ..DepthNoiseOptions::default() },
        encoder_noise: EncoderNoiseOptions {
            seed: stream(5),
            sigma_deg: options.encoder_noise_deg,
            ..EncoderNoiseOptions::default()
        },
        ..SimulationConfig::default()
    };
    let simulation = Simulation::new(&nominal, &config)?;
    let staged = StagedFolder::new(folder)?;
    write_virtual_cell(&simulation, &staged, &Silent)?;
    staged.publish()?;
    Ok(())
}
