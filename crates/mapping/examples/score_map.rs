//! Scores a map against a dataset's true surface over the part that its views observe. One line of JSON on stdout.
//!
//! `cargo run --release -p skclam-mapping --example score_map -- DATASET MAP.ply`

#[path = "../tests/dataset/mod.rs"]
mod dataset;

use skclam_mapping::{ReferenceOptions, View, read_ply, score_surface};
use std::error::Error;
use std::fs::File;
use std::io::BufReader;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("the dataset's folder is needed")?);
    let map = PathBuf::from(arguments.next().ok_or("the map is needed")?);
    let dataset = dataset::load(&folder, usize::MAX);
    let views: Vec<View<'_>> = (0..dataset.shots.len()).map(|index| dataset.view(index)).collect();
    let map = read_ply(BufReader::new(File::open(map)?))?;
    let reference = read_ply(BufReader::new(File::open(folder.join("truth/scene.ply"))?))?;
    let score = score_surface(&map, &reference, &views, &ReferenceOptions::default())?;
    println!("{}", serde_json::to_string(&score)?);
    Ok(())
}
