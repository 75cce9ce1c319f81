//! Sampson distances of the pipeline's matches at the true poses, before and after refinement.
//!
//! `cargo run --release -p skclam --example sampson_at_truth [DATASET]`, by default `../shared/data/virtual-cell` (or
//! the folder of that name in `SKCLAM_DATA`). The dataset brings `truth/rig.toml` and `truth/trajectory.txt`.
//!
//! The pipeline's own stages run as in `skclam run`: features, guided matching with all filters, tracks; then the
//! positions of the observations are taken as detected and as refined. Only matches of tracks count; those that
//! refinement rejects are in the first line alone.

use skclam::calibration::{Correspondences, PairMatch};
use skclam::dataset::Dataset;
use skclam::features::{RefineOptions, WarpModel};
use skclam::geometry::{FundamentalMatrix, Isometry3, PinholeCamera};
use skclam::pipeline::{Config, correspondences, extract_features, match_pairs, pairs_to_match};
use skclam::progress::Silent;
use skclam::rig::Rig;
use skclam::trajectory::read_trajectory;
use std::path::PathBuf;

/// Quantiles of the Sampson distances of all matches, px, and their number.
fn sampson(data: &Correspondences, poses: &[Isometry3], camera: &PinholeCamera) -> (usize, [f64; 3]) {
    let mut distances = Vec::new();
    for pair in &data.pairs {
        let a_from_b = poses[pair.a].inverse() * poses[pair.b];
        if a_from_b.translation.vector.norm() < 1e-4 {
            continue;
        }
        let fundamental = FundamentalMatrix::from_pose(camera, camera, &a_from_b);
        let of =
            |m: &PairMatch| fundamental.sampson_distance(&camera.undistort(&m.in_a), &camera.undistort(&m.in_b)).abs();
        distances.extend(pair.matches.iter().map(of));
    }
    distances.sort_by(f64::total_cmp);
    let at = |fraction: f64| distances.get((distances.len() as f64 * fraction) as usize).copied().unwrap_or(f64::NAN);
    (distances.len(), [at(0.25), at(0.5), at(0.9)])
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let shared = std::env::var_os("SKCLAM_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = std::env::args().nth(1).map_or_else(|| shared.join("virtual-cell"), PathBuf::from);
    let dataset = Dataset::open(&folder)?;
    let truth = Rig::read(folder.join("truth/rig.toml"))?;
    let stamped = read_trajectory(&folder.join("truth/trajectory.txt"))?;
    let poses: Vec<Isometry3> = stamped.iter().map(|stamped| stamped.base_from_camera).collect();
    if poses.len() != dataset.len() {
        return Err(format!("{} true poses for {} postures", poses.len(), dataset.len()).into());
    }
    let config = Config { max_observations: None, ..Config::default() };
    let images = extract_features(&dataset, &config, &Silent)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, &config);
    let pairs = match_pairs(&dataset, &images, chosen, &config, &Silent)?;
    println!(
        "positions: matches; Sampson distance at the true poses, px: lower quartile, median, 90 %; of the median before"
    );
    let kinds = [
        ("as detected", None),
        ("refined (default)", Some(RefineOptions::default())),
        ("refined, patch 21", Some(RefineOptions { patch: 21, ..RefineOptions::default() })),
        ("refined, shift alone", Some(RefineOptions { model: WarpModel::Translation, ..RefineOptions::default() })),
    ];
    let mut before = f64::NAN;
    for (name, refine) in kinds {
        let config = Config { refine, ..config.clone() };
        let (data, _) = correspondences(&dataset, &images, &pairs, &config, &Silent)?;
        let (count, [low, median, high]) = sampson(&data, &poses, &truth.color);
        if before.is_nan() {
            before = median;
        }
        println!("{name}: {count}; {low:.4}, {median:.4}, {high:.4}; {:.3}", median / before);
    }
    Ok(())
}
