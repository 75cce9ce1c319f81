//! Piles a dataset up into a cloud, fuses it into a mesh, and draws both from several sides.
//!
//! `cargo run --release -p skclam-mapping --example draw_map -- ../shared/data/virtual-cell OUT_DIR [VOXEL_MM]`

#[path = "../tests/dataset/mod.rs"]
mod dataset;

use skclam_mapping::{
    CloudBuilder, CloudOptions, Model, RenderCamera, RenderOptions, SurfaceOptions, Tsdf, TsdfOptions, ViewPreset,
    render, write_ply,
};
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::PathBuf;
use std::time::Instant;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("the dataset's folder is needed")?);
    let out = PathBuf::from(arguments.next().ok_or("a folder for the images is needed")?);
    let voxel_m = arguments.next().map_or(Ok(3.0), |text| text.parse::<f64>())? / 1000.0;
    let dataset = dataset::load(&folder, usize::MAX);
    std::fs::create_dir_all(&out)?;

    let start = Instant::now();
    let mut builder = CloudBuilder::new(CloudOptions { voxel_m: Some(voxel_m), ..Default::default() })?;
    let mut pixels = 0;
    for index in 0..dataset.shots.len() {
        pixels += builder.add(&dataset.view(index))?;
    }
    let model = Model::Cloud(builder.finish());
    println!("{} views, {pixels} pixels, {} points, {:?}", dataset.shots.len(), model.points().len(), start.elapsed());
    write_ply(&model, BufWriter::new(File::create(out.join("map.ply"))?))?;

    use ViewPreset::*;
    let options = RenderOptions { point_radius_m: voxel_m, ..Default::default() };
    for preset in [Front, Top, Left, Isometric, Perspective] {
        let start = Instant::now();
        let image = render(&model, &RenderCamera::framing(&model, preset, 1200, 900), &options)?;
        let path = out.join(format!("{preset:?}.png").to_lowercase());
        image.save(&path)?;
        println!("{} {:?}", path.display(), start.elapsed());
    }
    let eye = RenderCamera::from_camera(&dataset.color_camera, dataset.shots[0].base_from_color);
    render(&model, &eye, &options)?.save(out.join("shot0.png"))?;

    let mut tsdf = Tsdf::new(TsdfOptions { voxel_m, ..Default::default() })?;
    for index in 0..dataset.shots.len() {
        tsdf.integrate(&dataset.view(index))?;
    }
    let mesh = Model::Mesh(tsdf.surface(&SurfaceOptions::default())?);
    for preset in [Top, Isometric, Perspective] {
        let image = render(&mesh, &RenderCamera::framing(&model, preset, 1200, 900), &options)?;
        image.save(out.join(format!("mesh_{preset:?}.png").to_lowercase()))?;
    }
    render(&mesh, &eye, &options)?.save(out.join("mesh_shot0.png"))?;
    Ok(())
}
