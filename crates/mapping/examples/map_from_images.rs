//! Maps depth images whose poses are known, from memory: `cargo run --release -p skclam-mapping --example
//! map_from_images -- OUT.ply`. A room of 4 x 3 x 2.5 m takes the place of the camera's images.

use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera, Pixel};
use skclam_mapping::{Model, SurfaceOptions, Tsdf, TsdfOptions, View, write_ply};
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;

const HALF_ROOM_M: [f64; 3] = [2.0, 1.25, 1.5];

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).ok_or("OUT.ply is needed: the file of the surface")?;
    let color_camera = PinholeCamera::from_hfov(320, 240, 1.2);
    let depth_camera =
        DepthCamera { camera: color_camera, unit_m: 1e-3, offset_m: 0.0, color_from_depth: Isometry3::identity() };
    let mut surface = Tsdf::new(TsdfOptions { voxel_m: 0.02, ..TsdfOptions::default() })?;
    for step in 0..12 {
        let turn = std::f64::consts::TAU * f64::from(step) / 12.0;
        let base_from_color = Isometry3::rotation(nalgebra::Vector3::y() * turn);
        let depth = room(&color_camera, &base_from_color)?;
        surface.integrate(&View {
            depth: &depth,
            color: None,
            depth_camera: &depth_camera,
            color_camera: &color_camera,
            base_from_color,
            depth_mask: None,
            color_mask: None,
        })?;
    }
    let mesh = surface.surface(&SurfaceOptions::default())?;
    println!("{} vertices, {} triangles", mesh.vertices.len(), mesh.triangles.len());
    write_ply(&Model::Mesh(mesh), &mut BufWriter::new(File::create(out)?))?;
    Ok(())
}

/// z-depth of the room's walls, seen from its middle.
fn room(camera: &PinholeCamera, base_from_color: &Isometry3) -> Result<DepthImage, Box<dyn Error>> {
    let pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
    let depth = pixels.map(|(x, y)| {
        // A ray of z-depth 1: its factor is the z-depth.
        let ray = base_from_color * camera.unproject(&Pixel::new(f64::from(x), f64::from(y)));
        let walls = ray.iter().zip(HALF_ROOM_M).map(|(component, half)| half / component.abs().max(1e-9));
        walls.fold(f64::INFINITY, f64::min) as f32
    });
    Ok(DepthImage::new(camera.width, camera.height, depth.collect())?)
}
