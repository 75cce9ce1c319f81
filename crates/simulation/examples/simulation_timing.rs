//! Draws the paper's 73 colour and depth images without writing them and says how long it took:
//! `cargo run --release -p skclam-simulation --example simulation_timing -- crates/rig/robots/hp3j.toml [noise]`.

use skclam_rig::Rig;
use skclam_simulation::{ColorNoiseOptions, Simulation, SimulationConfig};
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let rig = Rig::read(arguments.get(1).ok_or("give a rig file")?)?;
    let mut config = SimulationConfig::default();
    if arguments.get(2).is_some_and(|word| word == "noise") {
        config.color_noise = ColorNoiseOptions::paper();
    }
    let start = Instant::now();
    let simulation = Simulation::new(&rig, &config)?;
    println!("scene and postures: {:.2} s", start.elapsed().as_secs_f64());
    let start = Instant::now();
    let mut measured = 0usize;
    for capture in simulation.captures() {
        let depth = capture?.depth.ok_or("the rig has no depth camera")?;
        measured += depth.as_slice().iter().filter(|z| **z > 0.0).count();
    }
    println!(
        "{} postures: {:.2} s; {measured} depths measured",
        simulation.postures().len(),
        start.elapsed().as_secs_f64()
    );
    Ok(())
}
