//! `skclam map`.

use crate::args::{Cli, MapArgs};
use crate::commands::run::stages;
use crate::progress::Screen;
use anyhow::{Result, bail};
use skclam::dataset::Dataset;
use skclam::output::StagedFolder;
use skclam::pipeline::{self, Config};
use skclam::rig::Rig;
use skclam::trajectory::trajectory_text;

/// Builds a map at the poses of a rig.
pub fn map(cli: &Cli, args: &MapArgs) -> Result<()> {
    let dataset = match &args.rig {
        None => Dataset::open(&args.dataset)?,
        Some(path) => Dataset::open_with_rig(&args.dataset, Rig::read(path)?)?,
    };
    let staged = StagedFolder::new(&args.out)?;
    let screen = Screen::new(cli.quiet);
    let trajectory = pipeline::localize(&dataset, &dataset.rig)?;
    let poses: Vec<_> = trajectory.iter().map(|stamped| stamped.base_from_camera).collect();
    let Some([cloud]) = pipeline::build_maps(&dataset, [&poses], &dataset.rig, &Config::default(), &screen)? else {
        bail!("{}: there are no depth images, so there is nothing to build a map from", args.dataset.display());
    };
    pipeline::write_cloud(&staged, "map.ply", &cloud)?;
    staged.write("trajectory.txt", trajectory_text(&trajectory))?;
    let folder = staged.publish()?;
    let stages = stages(&screen);
    let wall: f64 = stages.iter().map(|stage| stage.wall_s).sum();
    if cli.json {
        let summary = serde_json::json!({ "points": cloud.len(), "images": dataset.len(), "wall_s": wall });
        println!("{}", serde_json::to_string_pretty(&summary)?);
    } else {
        println!(
            "Map: {} points from {} postures in {wall:.1} s\nResults: {}",
            cloud.len(),
            dataset.len(),
            folder.display()
        );
    }
    Ok(())
}
