//! The last two stages: where the camera was, and the map in the base frame, section 4.1.2.

use super::{Config, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use crate::trajectory::StampedPose;
use image::GrayImage;
use rayon::prelude::*;
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera};
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

/// One map for each list of poses (one pose a posture), one after the other, so that only one of them is under
/// construction at a time.
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
    progress.begin(Stage::Map, (N * dataset.len()) as u64);
    let options = cloud_options(dataset, &depth_camera, config)?;
    let sensors = Sensors {
        depth_camera,
        color_camera: rig.color,
        color_mask: dataset.color_mask()?,
        depth_mask: dataset.depth_mask()?,
    };
    let mut clouds = Vec::with_capacity(N);
    for poses in poses {
        clouds.push(build_map(dataset, poses, &sensors, options, progress)?);
    }
    Ok(clouds.try_into().ok())
}

/// What all views have in common.
struct Sensors {
    depth_camera: DepthCamera,
    color_camera: PinholeCamera,
    color_mask: Option<GrayImage>,
    depth_mask: Option<GrayImage>,
}

/// Images that are decoded side by side before they are added in order.
const DECODED_TOGETHER: usize = 8;

fn build_map(
    dataset: &Dataset,
    poses: &[Isometry3],
    sensors: &Sensors,
    options: CloudOptions,
    progress: &dyn Progress,
) -> Result<PointCloud, RunError> {
    let mut builder = CloudBuilder::new(options)?;
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
                builder.add(&View {
                    depth,
                    color: Some(color),
                    depth_camera: &sensors.depth_camera,
                    color_camera: &sensors.color_camera,
                    base_from_color: poses[index],
                    depth_mask: sensors.depth_mask.as_ref(),
                    color_mask: sensors.color_mask.as_ref(),
                })?;
            }
            progress.step();
        }
    }
    Ok(builder.finish())
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
