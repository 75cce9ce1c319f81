//! How much of its surroundings a recording shows: coverage of the workspace, and holes.

use super::RunError;
use crate::dataset::Dataset;
use image::GrayImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Point3};
use skclam_kinematics::{JointKind, SerialChain};
use skclam_mapping::{OccupancyGrid, OccupancyOptions, View};
use skclam_rig::Rig;

/// What was seen, on a grid of cells of 5 cm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapCoverage {
    /// Radius of the ball that the flange stays in, around the first joint, metres; `null` without an arm or with
    /// sliding joints.
    pub reach_m: Option<f64>,
    /// Fraction of that ball that was observed to be free or occupied. Walls and the table cut off a part that nobody
    /// can see.
    pub observed_fraction_of_reach: Option<f64>,
    /// Fraction of the free space's border that no surface closes: holes, and the ends of the views. `null` without
    /// free space.
    pub open_boundary_fraction: Option<f64>,
    /// The same in square metres.
    pub open_boundary_m2: f64,
    /// Fraction of the depth images' pixels that have no value.
    pub depth_without_value: f64,
}

/// Edge of a cell, metres: what an arm's links do not pass through without touching it.
const CELL_M: f64 = 0.05;
/// Depth images that are used at most, evenly over the recording.
const MAX_IMAGES: usize = 120;
/// Images that are decoded side by side.
const DECODED_TOGETHER: usize = 8;

/// Of the depth images at the given poses; `None` where the data set has none.
pub fn map_coverage(
    dataset: &Dataset,
    poses: &[Isometry3],
    rig: &Rig,
    found_mask: Option<&GrayImage>,
    filter: skclam_mapping::DepthFilter,
) -> Result<Option<MapCoverage>, RunError> {
    let Some(depth_camera) = rig.depth else { return Ok(None) };
    let (color_mask, depth_mask) = (dataset.color_mask()?, dataset.depth_mask()?);
    let mut grid =
        OccupancyGrid::new(OccupancyOptions { filter, resolution_m: CELL_M, ..OccupancyOptions::default() })?;
    let chosen: Vec<usize> = (0..dataset.len()).step_by(dataset.len().div_ceil(MAX_IMAGES).max(1)).collect();
    let (mut pixels, mut holes) = (0usize, 0usize);
    for chunk in chosen.chunks(DECODED_TOGETHER) {
        let depths = chunk.par_iter().map(|&index| dataset.depth(index)).collect::<Result<Vec<_>, _>>()?;
        for (&index, depth) in chunk.iter().zip(&depths) {
            let Some(depth) = depth else { continue };
            pixels += depth.as_slice().len();
            holes += depth.as_slice().iter().filter(|z| **z <= 0.0).count();
            grid.add(&View {
                depth,
                color: None,
                depth_camera: &depth_camera,
                color_camera: &rig.color,
                base_from_color: poses[index],
                depth_mask: depth_mask.as_ref(),
                color_mask: color_mask.as_ref().or(found_mask),
            })?;
        }
    }
    if pixels == 0 {
        return Ok(None);
    }
    let ball = rig.robot.as_ref().and_then(reach);
    let observed = ball.map(|(centre, radius_m)| grid.observed_fraction_of_ball(centre, radius_m)).transpose()?;
    let boundary = grid.free_boundary();
    Ok(Some(MapCoverage {
        reach_m: ball.map(|(_, radius_m)| radius_m),
        observed_fraction_of_reach: observed,
        open_boundary_fraction: boundary.open_fraction(),
        open_boundary_m2: boundary.open_m2,
        depth_without_value: holes as f64 / pixels as f64,
    }))
}

/// The ball in the base's frame that the flange cannot leave: around the first joint, with the lengths of all links
/// after it.
fn reach(chain: &SerialChain) -> Option<(Point3, f64)> {
    if chain.joints().iter().any(|joint| joint.kind != JointKind::Revolute) {
        return None;
    }
    // Turning joints leave the distances of the links' origins as they are.
    let straight = vec![0.0; chain.joint_count()];
    let links = chain.base_from_links(&straight).ok()?;
    let flange = chain.base_from_flange(&straight).ok()?;
    let origins: Vec<Point3> = links.iter().chain([&flange]).map(|pose| pose * Point3::origin()).collect();
    let length: f64 = origins.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
    (length > 0.0).then(|| (origins[0], length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reach_is_that_of_the_stretched_arm() {
        let rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let (centre, radius_m) = reach(rig.robot.as_ref().unwrap()).unwrap();
        assert!((centre - Point3::new(0.0, 0.0, 0.29)).norm() < 1e-9, "{centre}");
        // 260 mm, then 30 mm and 270 mm at right angles, then 90 mm.
        let expected = 0.26 + 0.03f64.hypot(0.27) + 0.09;
        assert!((radius_m - expected).abs() < 0.031, "{radius_m} {expected}");
    }
}
