//! Simulates a data set's first images, shows the cell from outside, and says how long it took: `cargo run --release -p
//! skclam-simulation --example preview -- crates/rig/robots/hp3j.toml DIR [POSTURES] [STEP] [paper|diverse]`.

use image::{GrayImage, Luma};
use nalgebra::{Rotation3, Translation3, UnitQuaternion, Vector3};
use skclam_geometry::{Isometry3, PinholeCamera};
use skclam_rig::Rig;
use skclam_simulation::{Antialiasing, DiverseOptions, PosturePlan, Renderer, Simulation, SimulationConfig};
use std::time::Instant;

fn looking(from: Vector3<f64>, to: Vector3<f64>) -> Isometry3 {
    let z = (to - from).normalize();
    let x = z.cross(&Vector3::z()).normalize();
    let rotation = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
    Isometry3::from_parts(Translation3::from(from), UnitQuaternion::from_rotation_matrix(&rotation))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, rig, folder, rest @ ..] = arguments.as_slice() else {
        return Err("give a rig file and a folder for the images".into());
    };
    let rig = Rig::read(rig)?;
    let folder = std::path::Path::new(folder);
    let count: usize = rest.first().map_or(Ok(8), |text| text.parse())?;
    let step: usize = rest.get(1).map_or(Ok(1), |text| text.parse())?;
    let mut config = SimulationConfig::default();
    if rest.get(2).is_some_and(|kind| kind == "diverse") {
        config.postures = PosturePlan::Diverse { options: DiverseOptions::default() };
    }
    let start = Instant::now();
    let simulation = Simulation::new(&rig, &config)?;
    let scene = simulation.scene();
    println!(
        "scene: {} surfaces, {} triangles, {:.1} million texels, {} postures, {:.2} s",
        scene.surface_count(),
        scene.model.triangles.len(),
        scene.model.textures.iter().map(|t| f64::from(t.size().0) * f64::from(t.size().1)).sum::<f64>() * 1e-6,
        simulation.postures().len(),
        start.elapsed().as_secs_f64()
    );
    let mut trajectory = String::new();
    for number in (0..simulation.postures().len()).step_by(step).take(count) {
        let start = Instant::now();
        let capture = simulation.capture(number)?;
        println!("posture {number}: {:.3} s", start.elapsed().as_secs_f64());
        let (t, q) = (capture.true_base_from_color.translation, capture.true_base_from_color.rotation);
        trajectory += &format!("{number} {} {} {} {} {} {} {}\n", t.x, t.y, t.z, q.i, q.j, q.k, q.w);
        capture.color.save(folder.join(format!("color{number:02}.png")))?;
        if let Some(depth) = &capture.depth {
            let image = GrayImage::from_fn(depth.width(), depth.height(), |x, y| {
                Luma([(80.0 * depth.at(x, y).unwrap_or(0.0)).min(255.0) as u8])
            });
            image.save(folder.join(format!("depth{number:02}.png")))?;
        }
    }
    std::fs::write(folder.join("trajectory.txt"), trajectory)?;
    let wide = PinholeCamera::from_hfov(1920, 1080, 84f64.to_radians());
    let pose = looking(Vector3::new(-1.55, -1.45, 1.35), Vector3::new(0.35, 0.3, 0.05));
    let body = simulation.arm_body().model_at(&[-0.3, 0.55, 0.75, 0.35, 1.25, 0.0])?;
    Renderer::new(&wide, Antialiasing::Sixteen)?.color(&pose, &[&scene.model, &body]).save(folder.join("cell.png"))?;
    Ok(())
}
