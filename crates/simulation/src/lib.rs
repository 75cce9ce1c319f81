//! The virtual cell: scene, renderer, sensor noise, postures and perturbed arms.
//!
//! The paper used Gazebo and ROS; this is the same experiment as a library. It knows rigs and surfaces, and nothing
//! of the estimator that is to be tested with its images, and it writes no files. Start at [`Simulation`].
//!
//! Everything is drawn from seeds: the same configuration gives the same bytes, on any number of threads.
//!
#![doc = include_str!("../README.md")]

mod arm_body;
mod diverse_postures;
mod error;
mod laser;
mod noise;
mod paper_postures;
mod perturb;
mod render;
mod scene;
mod scene_rng;
mod simulate;

pub use arm_body::ArmBody;
pub use diverse_postures::{DiverseOptions, diverse_postures};
pub use error::SimulationError;
pub use laser::{LaserExperiment, LaserOptions, LaserPose, laser_experiment};
pub use noise::{ColorNoiseOptions, DepthNoiseOptions, EncoderNoiseOptions, depth_counts};
pub use paper_postures::{PAPER_POSTURES, PAPER_STEP_DEG, PaperView, paper_postures};
pub use perturb::{PAPER_ERROR_DEG, PerturbationSigmas, paper_parameters, perturb_paper, perturb_random};
pub use render::{Antialiasing, Renderer};
pub use scene::{Face, Hit, Model, RayCaster, Scene, SceneOptions, Texture, Triangle};
pub use simulate::{Capture, Perturbation, PosturePlan, Simulation, SimulationConfig};
