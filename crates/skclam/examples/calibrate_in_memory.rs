//! Calibrates an arm from images in memory; no file is read or written.
//!
//! `cargo run --release -p skclam --example calibrate_in_memory`. The virtual cell plays robot and camera; with real
//! ones, fill the `Frame`s with joint values (radians) and the images that were taken there.

use skclam::dataset::{Dataset, Frame};
use skclam::pipeline::{Config, run};
use skclam::progress::Silent;
use skclam::rig::builtin_rig;
use skclam::simulation::{DiverseOptions, PosturePlan, Simulation, SimulationConfig};
use skclam::virtual_cell::{render_frames, scaled_rig};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    // What the robot's maker says of the arm, with a camera on its flange; a third of the pixels keeps it quick.
    let nominal = scaled_rig(&builtin_rig("hp3j").ok_or("a built-in rig")??, 0.33);
    let diverse = PosturePlan::Diverse { options: DiverseOptions { count: 16, ..DiverseOptions::default() } };
    let cell = Simulation::new(&nominal, &SimulationConfig { postures: diverse, ..SimulationConfig::default() })?;
    let frames: Vec<Frame> = render_frames(&cell, &Silent)?;

    let dataset = Dataset::from_frames(nominal, frames)?;
    let outcome = run(&dataset, &Config::default(), &Silent)?;
    println!("{}", outcome.summary.verdict);
    if let Some(maps) = &outcome.maps {
        println!("a map of {} points", maps.calibrated.len());
    }
    println!("{}", outcome.rig.to_toml()?);
    Ok(())
}
