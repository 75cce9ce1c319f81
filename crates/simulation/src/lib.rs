//! The virtual cell: scene, renderer, sensor noise, postures and perturbed arms.
//!
//! The paper used Gazebo and ROS; this is the same experiment as a library. It knows rigs and surfaces, and nothing
//! of the estimator that is to be tested with its images, and it writes no files.

mod dice;
mod error;
mod render;
mod scene;

pub use error::SimulationError;
pub use render::{Antialiasing, Renderer};
pub use scene::{Face, Hit, Model, RayCaster, Scene, SceneOptions, Texture, Triangle};
