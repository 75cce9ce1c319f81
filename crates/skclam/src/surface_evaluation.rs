//! How far a map is from a known surface, over the part of it that the recording observed.

use crate::dataset::Dataset;
use crate::evaluation::base_gauge;
use crate::pipeline::RunError;
use rayon::prelude::*;
use skclam_geometry::{DepthImage, Isometry3};
use skclam_mapping::{Model, ReferenceOptions, SurfaceScore, View, score_surface};
use skclam_rig::{PostureState, Rig};

/// Compares a map that was built with `rig` with the true surface, after the base's gauge. `dataset` carries the true
/// rig: the true poses decide what was observed.
pub fn evaluate_surface(map: Model, reference: &Model, rig: &Rig, dataset: &Dataset) -> Result<SurfaceScore, RunError> {
    let cameras = |rig: &Rig| {
        dataset.records.iter().map(|record| rig.base_from_color(&record.posture)).collect::<Result<Vec<_>, _>>()
    };
    let (estimated, truth) = (cameras(rig)?, cameras(&dataset.rig)?);
    let gauge = match (dataset.records.first().map(|record| &record.posture.state), &rig.robot) {
        (Some(PostureState::Joints(joints)), Some(robot)) => base_gauge(robot, joints, &estimated, &truth),
        _ => Isometry3::identity(),
    };
    let depths: Vec<Option<DepthImage>> =
        (0..dataset.len()).into_par_iter().map(|index| dataset.depth(index)).collect::<Result<_, _>>()?;
    let depth_mask = dataset.depth_mask()?;
    let depth_camera = dataset.rig.depth;
    let views: Vec<View<'_>> = depths
        .iter()
        .zip(&truth)
        .filter_map(|(depth, pose)| {
            Some(View {
                depth: depth.as_ref()?,
                color: None,
                depth_camera: depth_camera.as_ref()?,
                color_camera: &dataset.rig.color,
                base_from_color: *pose,
                depth_mask: depth_mask.as_ref(),
                color_mask: None,
            })
        })
        .collect();
    Ok(score_surface(&map.transformed(&gauge), reference, &views, &ReferenceOptions::default())?)
}
