//! Draws the cell from a few places and says how long it took: `cargo run --release --example preview -- DIR`.

use nalgebra::{Rotation3, Translation3, UnitQuaternion, Vector3};
use skclam_geometry::{Isometry3, PinholeCamera};
use skclam_simulation::{Antialiasing, Renderer, Scene, SceneOptions};
use std::time::Instant;

fn looking(from: Vector3<f64>, to: Vector3<f64>) -> Isometry3 {
    let z = (to - from).normalize();
    let x = z.cross(&Vector3::z()).normalize();
    let rotation = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
    Isometry3::from_parts(Translation3::from(from), UnitQuaternion::from_rotation_matrix(&rotation))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::path::PathBuf::from(std::env::args().nth(1).ok_or("give a folder for the images")?);
    let camera = PinholeCamera::from_hfov(1920, 1080, 70f64.to_radians());
    let start = Instant::now();
    let scene = Scene::new(&SceneOptions::default(), camera.fx)?;
    println!(
        "scene: {} surfaces, {} triangles, {:.1} Mtexel, {:.2} s",
        scene.surface_count(),
        scene.model.triangles.len(),
        scene.model.textures.iter().map(|t| f64::from(t.size().0) * f64::from(t.size().1)).sum::<f64>() * 1e-6,
        start.elapsed().as_secs_f64()
    );
    let renderer = Renderer::new(&camera, Antialiasing::Eight)?;
    for index in 0..8 {
        let angle = std::f64::consts::TAU * f64::from(index) / 8.0;
        let outward = Vector3::new(angle.cos(), angle.sin(), 0.0);
        let from = 0.4 * outward + Vector3::new(0.0, 0.0, 0.5);
        let pose = looking(from, from + outward + Vector3::new(0.0, 0.0, -0.2));
        let start = Instant::now();
        let image = renderer.color(&pose, &[&scene.model]);
        println!("view {index}: {:.3} s", start.elapsed().as_secs_f64());
        image.save(folder.join(format!("view{index}.png")))?;
    }
    let wide = PinholeCamera::from_hfov(1920, 1080, 95f64.to_radians());
    let pose = looking(Vector3::new(-1.6, -1.5, 1.45), Vector3::new(0.5, 0.4, 0.0));
    Renderer::new(&wide, Antialiasing::Eight)?.color(&pose, &[&scene.model]).save(folder.join("room.png"))?;
    Ok(())
}
