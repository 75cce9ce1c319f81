//! Virtual cells with images, rendered once and kept in a folder.

use anyhow::{Context, Result};
use nalgebra::{Isometry3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use skclam::dataset::Dataset;
use skclam::output::{Contents, StagedFolder};
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

    /// The same with a nominal rig whose cameras are wrong by normal errors of the size that such devices are known
    /// for: focal length 0.2 %, centre 0.15 % of the image's width, k1 0.005, depth scale 0.3 %, depth offset 1 mm,
    /// depth camera beside the colour camera 1 mm and 0.1 deg.
    pub fn with_instrument_errors(mut self, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = |sigma: f64| {
            // The sum of twelve even numbers is near enough to normal.
            sigma * ((0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0)
        };
        let color = &mut self.dataset.rig.color;
        let focal = 1.0 + normal(0.002);
        (color.fx, color.fy) = (color.fx * focal, color.fy * focal);
        color.cx += normal(0.0015 * f64::from(color.width));
        color.cy += normal(0.0015 * f64::from(color.width));
        color.distortion[0] += normal(0.005);
        if let Some(depth) = &mut self.dataset.rig.depth {
            depth.unit_m *= 1.0 + normal(0.003);
            depth.offset_m += normal(0.001);
            let shift = Vector3::from_fn(|_, _| normal(0.001));
            let turn = Vector3::from_fn(|_, _| normal(0.1f64.to_radians()));
            depth.color_from_depth = Isometry3::new(shift, turn) * depth.color_from_depth;
        }
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
    let staged = StagedFolder::new(folder, Contents::DataSet)?;
    write_virtual_cell(&simulation, &staged, &Silent)?;
    staged.publish()?;
    Ok(())
}
