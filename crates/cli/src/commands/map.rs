//! `skclam map`.

use crate::args::{Cli, MapArgs, MapFileArg};
use crate::commands::run::{coverage_line, filter_self, stages};
use crate::progress::{Screen, peak_memory_mib};
use crate::screen::{self, say};
use anyhow::{Result, bail};
use skclam::dataset::Dataset;
use skclam::output::Contents;
use skclam::pipeline::{self, Config, MapFile};
use skclam::rig::Rig;
use skclam::trajectory::trajectory_text;

/// Builds a map at the poses of a rig.
pub fn map(cli: &Cli, args: &MapArgs) -> Result<()> {
    let mut dataset = match &args.rig {
        None => Dataset::open(&args.dataset)?,
        Some(path) => Dataset::open_with_rig(&args.dataset, Rig::read(path)?)?,
    };
    filter_self(&mut dataset, &args.self_filter, cli.quiet)?;
    let config = Config { voxel_m: args.voxel_mm.map(|voxel_mm| voxel_mm * 1e-3), ..Config::default() };
    let staged = screen::staged(cli.quiet, &args.out, Contents::Map)?;
    let screen = Screen::new(cli.quiet);
    let trajectory = pipeline::localize(&dataset, &dataset.rig)?;
    let poses: Vec<_> = trajectory.iter().map(|stamped| stamped.base_from_camera).collect();
    let Some([cloud]) = pipeline::build_maps(&dataset, [&poses], &dataset.rig, None, &config, &screen)? else {
        bail!("{}: there are no depth images, so there is nothing to build a map from", args.dataset.display());
    };
    pipeline::write_cloud(&staged, "map.ply", &cloud)?;
    staged.write("trajectory.txt", trajectory_text(&trajectory))?;
    let files: Vec<MapFile> = args.also.iter().map(|&file| map_file(file)).collect();
    let points = cloud.len();
    drop(cloud);
    let more = pipeline::write_map_files(&dataset, &poses, &dataset.rig, &config, &files, &staged, &screen)?;
    let filter = config.cloud.filter;
    let coverage = pipeline::map_coverage(&dataset, &poses, &dataset.rig, None, filter)?;
    let folder = staged.publish()?;
    let stages = stages(&screen);
    let wall: f64 = stages.iter().map(|stage| stage.wall_s).sum();
    if cli.json {
        let summary = serde_json::json!({
            "points": points, "images": dataset.len(), "wall_s": wall, "peak_memory_mib": peak_memory_mib(), "coverage": coverage,
            "files": more
        });
        screen::json(&summary)?;
        return Ok(());
    }
    say!("Map: {points} points from {} postures in {wall:.1} s; voxels of {:.1} mm", dataset.len(), more.voxel_mm);
    if let Some(coverage) = &coverage {
        say!("{}", coverage_line(coverage));
    }
    if let Some(triangles) = more.triangles {
        say!("Surface: {triangles} triangles");
    }
    if let Some(triangles) = more.collision_triangles {
        say!("Collision mesh: {triangles} triangles");
    }
    if let Some([free, occupied]) = more.free_and_occupied_cells {
        say!("Occupancy: {free} free cells, {occupied} occupied");
    }
    say!("Results: {}", folder.display());
    Ok(())
}

fn map_file(file: MapFileArg) -> MapFile {
    match file {
        MapFileArg::Mesh => MapFile::Mesh,
        MapFileArg::Obj => MapFile::Obj,
        MapFileArg::Glb => MapFile::Glb,
        MapFileArg::Stl => MapFile::Stl,
        MapFileArg::Pcd => MapFile::Pcd,
        MapFileArg::Octomap => MapFile::Octomap,
        MapFileArg::Esdf => MapFile::Esdf,
    }
}
