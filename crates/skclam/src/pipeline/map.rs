//! The last two stages: where the camera was, and the map in the base frame, section 4.1.2.

use super::{Config, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use crate::trajectory::StampedPose;
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

/// One map for each list of poses (one pose a posture): the images are decoded once for all of them.
///
/// `None` where the data set has no depth.
pub fn build_maps<const N: usize>(
    dataset: &Dataset,
    poses: [&[Isometry3]; N],
    rig: &Rig,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Option<[PointCloud; N]>, RunError> {
    let Some(depth_camera) = rig.depth.filter(|_| dataset.records.iter().any(|record| record.depth.is_some())) else {
        return Ok(None);
    };
    progress.begin(Stage::Map, dataset.len() as u64);
    let (color_mask, depth_mask) = (dataset.color_mask()?, dataset.depth_mask()?);
    let options = cloud_options(dataset, &depth_camera, config)?;
    let mut builders = Vec::with_capacity(N);
    for _ in 0..N {
        builders.push(CloudBuilder::new(options)?);
    }
    for index in 0..dataset.len() {
        if progress.stop_requested() {
            return Err(RunError::Interrupted);
        }
        if let Some(depth) = dataset.depth(index)? {
            let color = dataset.color(index)?;
            for (builder, poses) in builders.iter_mut().zip(poses) {
                builder.add(&View {
                    depth: &depth,
                    color: Some(&color),
                    depth_camera: &depth_camera,
                    color_camera: &rig.color,
                    base_from_color: poses[index],
                    depth_mask: depth_mask.as_ref(),
                    color_mask: color_mask.as_ref(),
                })?;
            }
        }
        progress.step();
    }
    let clouds: Vec<PointCloud> = builders.into_iter().map(CloudBuilder::finish).collect();
    Ok(clouds.try_into().ok())
}

/// Images that are looked at for the range of depths.
const RANGE_IMAGES: usize = 8;

/// The settings of the cloud with a voxel that fits the depth camera at the range at which it was used.
fn cloud_options(dataset: &Dataset, depth_camera: &DepthCamera, config: &Config) -> Result<CloudOptions, RunError> {
    if let Some(voxel_m) = config.voxel_m {
        return Ok(CloudOptions { voxel_m: Some(voxel_m), ..config.cloud });
    }
    let mut depths = Vec::new();
    for index in (0..dataset.len()).step_by(dataset.len().div_ceil(RANGE_IMAGES)) {
        if let Some(depth) = dataset.depth(index)? {
            depths.extend(depth.as_slice().iter().copied().step_by(7).filter(|&z| z > 0.0));
        }
    }
    if depths.is_empty() {
        return Ok(config.cloud);
    }
    let middle = depths.len() / 2;
    let (_, median, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
    let voxel_m = TsdfOptions::voxel_for(&depth_camera.camera, f64::from(*median), &config.cloud.filter);
    Ok(CloudOptions { voxel_m: Some(voxel_m), ..config.cloud })
}
