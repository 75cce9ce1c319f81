//! The last two stages: where the camera was, and the map in the base frame, section 4.1.2.

use super::{Config, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use crate::trajectory::StampedPose;
use image::GrayImage;
use rayon::prelude::*;
use skclam_geometry::{DepthCamera, Isometry3};
use skclam_mapping::{CloudBuilder, CloudOptions, PointCloud, TsdfOptions, View};
use skclam_rig::Rig;

/// `base_from_camera` at every posture.
pub fn localize(dataset: &Dataset, rig: &Rig) -> Result<Vec<StampedPose>, RunError> {
    dataset
        .records
        .iter()
        .map(|record| {
            let timestamp_s = record.posture.timestamp_s.unwrap_or(record.posture.index as f64);
            Ok(StampedPose { timestamp_s, base_from_camera: rig.base_from_color(&record.posture)? })
        })
        .collect()
}

/// One map for each list of poses (one pose a posture), in one pass over the images.
///
/// `None` where the data set has no depth.
pub fn build_maps<const N: usize>(
    dataset: &Dataset,
    poses: [&[Isometry3]; N],
    rig: &Rig,
    found_mask: Option<&GrayImage>,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Option<[PointCloud; N]>, RunError> {
    let Some(depth_camera) = rig.depth.filter(|_| dataset.records.iter().any(|record| record.depth.is_some())) else {
        return Ok(None);
    };
    progress.begin(Stage::Map, dataset.len() as u64);
    let options = CloudOptions { voxel_m: Some(voxel_m(dataset, &depth_camera, config)?), ..config.cloud };
    let mut builders = (0..N).map(|_| CloudBuilder::new(options)).collect::<Result<Vec<_>, _>>()?;
    for_each_posture(dataset, rig, found_mask, progress, |posture, view| {
        let Some((first, _)) = builders.split_first_mut() else { return Ok(()) };
        let points = first.points(&View { base_from_color: Isometry3::identity(), ..*view })?;
        for (builder, poses) in builders.iter_mut().zip(poses) {
            builder.add_points(&points, &poses[posture])?;
        }
        Ok(())
    })?;
    let clouds: Vec<PointCloud> = builders.into_iter().map(CloudBuilder::finish).collect();
    Ok(clouds.try_into().ok())
}

/// Images that are decoded side by side before they are handed out in order.
const DECODED_TOGETHER: usize = 8;

/// Hands out every depth image with its colour image at its pose, in the order of the recording; one step of progress
/// each. `found_mask` (0 where the colour camera sees what moves with it) serves where the rig brings no mask.
pub fn for_each_view(
    dataset: &Dataset,
    poses: &[Isometry3],
    rig: &Rig,
    found_mask: Option<&GrayImage>,
    progress: &dyn Progress,
    mut take: impl FnMut(&View<'_>) -> Result<(), RunError>,
) -> Result<(), RunError> {
    for_each_posture(dataset, rig, found_mask, progress, |posture, view| {
        take(&View { base_from_color: poses[posture], ..*view })
    })
}

/// As [`for_each_view`], without poses (they are the identity) but with the position of the posture in the recording.
pub fn for_each_posture(
    dataset: &Dataset,
    rig: &Rig,
    found_mask: Option<&GrayImage>,
    progress: &dyn Progress,
    mut take: impl FnMut(usize, &View<'_>) -> Result<(), RunError>,
) -> Result<(), RunError> {
    let Some(depth_camera) = rig.depth else { return Ok(()) };
    let (color_mask, depth_mask) = (dataset.color_mask()?, dataset.depth_mask()?);
    let indices: Vec<usize> = (0..dataset.len()).collect();
    for chunk in indices.chunks(DECODED_TOGETHER) {
        if progress.stop_requested() {
            return Err(RunError::Interrupted);
        }
        let decoded = chunk
            .par_iter()
            .map(|&index| match dataset.depth(index)? {
                Some(depth) => Ok(Some((depth, dataset.color(index)?))),
                None => Ok(None),
            })
            .collect::<Result<Vec<_>, RunError>>()?;
        for (&index, images) in chunk.iter().zip(&decoded) {
            if let Some((depth, color)) = images {
                let view = View {
                    depth,
                    color: Some(color),
                    depth_camera: &depth_camera,
                    color_camera: &rig.color,
                    base_from_color: Isometry3::identity(),
                    depth_mask: depth_mask.as_ref(),
                    color_mask: color_mask.as_ref().or(found_mask),
                };
                take(index, &view)?;
            }
            progress.step();
        }
    }
    Ok(())
}

/// Images that are looked at for the range of depths.
const RANGE_IMAGES: usize = 8;

/// The edge of a voxel: as configured, or what fits the depth camera at the range at which it was used. Metres.
pub fn voxel_m(dataset: &Dataset, depth_camera: &DepthCamera, config: &Config) -> Result<f64, RunError> {
    if let Some(voxel_m) = config.voxel_m {
        return Ok(voxel_m);
    }
    let mut depths = Vec::new();
    for index in (0..dataset.len()).step_by(dataset.len().div_ceil(RANGE_IMAGES)) {
        if let Some(depth) = dataset.depth(index)? {
            depths.extend(depth.as_slice().iter().copied().step_by(7).filter(|&z| z > 0.0));
        }
    }
    if depths.is_empty() {
        return Ok(TsdfOptions::default().voxel_m);
    }
    let middle = depths.len() / 2;
    let (_, median, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
    Ok(TsdfOptions::voxel_for(&depth_camera.camera, f64::from(*median), &config.cloud.filter))
}
