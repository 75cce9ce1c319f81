//! Depth consistency: how far apart the surfaces of overlapping depth images are at the poses of a rig. The matches
//! take no part in it.

use super::RunError;
use crate::dataset::Dataset;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{DepthImage, Isometry3};
use skclam_mapping::{DepthConsistencyOptions, View, depth_consistency};
use skclam_rig::Rig;

/// Point-to-plane distances between overlapping depth images.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct DepthConsistencySummary {
    /// Pairs of depth images that overlap.
    pub pairs: usize,
    /// Median distance, millimetres.
    pub median_mm: f64,
    /// 90th percentile, millimetres.
    pub p90_mm: f64,
}

/// A point of a depth image, and how far the other images' surfaces are from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointToPlaneSample {
    /// Position of the posture.
    pub posture: usize,
    /// Place of the pixel in its depth image, row by row.
    pub pixel: usize,
    /// Where the pose puts it, metres.
    pub point_in_base: [f32; 3],
    /// Median distance to the surfaces of the other images that show it, metres.
    pub median_m: Option<f32>,
}

/// The answer for one list of poses.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MeasuredConsistency {
    /// Over all images; `None` without depth, or where no two images overlap.
    pub surfaces: Option<DepthConsistencySummary>,
    /// Points one by one, the same pixels for every list of poses.
    pub samples: Vec<PointToPlaneSample>,
}

/// Points that are listed one by one, roughly at most.
const SAMPLES: usize = 60_000;
/// Depth images that are compared at most, evenly over the recording; the cost grows with the square.
const COMPARED: usize = 120;

/// One answer for each list of poses.
pub fn measure_depth_consistency<const N: usize>(
    dataset: &Dataset,
    poses: [&[Isometry3]; N],
    rig: &Rig,
) -> Result<[MeasuredConsistency; N], RunError> {
    let mut answers: [MeasuredConsistency; N] = std::array::from_fn(|_| MeasuredConsistency::default());
    let Some(depth_camera) = rig.depth else { return Ok(answers) };
    let chosen: Vec<usize> = (0..dataset.len()).step_by(dataset.len().div_ceil(COMPARED).max(1)).collect();
    let depths: Vec<Option<DepthImage>> =
        chosen.par_iter().map(|&index| dataset.depth(index)).collect::<Result<_, _>>()?;
    let depth_mask = dataset.depth_mask()?;
    let mut options = DepthConsistencyOptions::default();
    let pixels = f64::from(depth_camera.camera.width) * f64::from(depth_camera.camera.height) * chosen.len() as f64;
    let taken = pixels / (options.stride * options.stride) as f64;
    options.sample_every = (taken / SAMPLES as f64).sqrt().ceil().max(1.0) as usize;
    for (answer, poses) in answers.iter_mut().zip(poses) {
        let mut postures = Vec::new();
        let views: Vec<View<'_>> = chosen
            .iter()
            .zip(&depths)
            .filter_map(|(&index, depth)| {
                let depth = depth.as_ref()?;
                postures.push(index);
                Some(View {
                    depth,
                    color: None,
                    depth_camera: &depth_camera,
                    color_camera: &rig.color,
                    base_from_color: poses[index],
                    depth_mask: depth_mask.as_ref(),
                    color_mask: None,
                })
            })
            .collect();
        let found = depth_consistency(&views, &options)?;
        if let (Some(median_m), Some(p90_m)) = (found.median_m, found.p90_m) {
            answer.surfaces = Some(DepthConsistencySummary {
                pairs: found.pairs.len(),
                median_mm: median_m * 1e3,
                p90_mm: p90_m * 1e3,
            });
        }
        let samples = found.samples.iter().map(|sample| PointToPlaneSample {
            posture: postures[sample.view],
            pixel: sample.pixel,
            point_in_base: sample.point_in_base,
            median_m: sample.median_m,
        });
        answer.samples = samples.collect();
    }
    Ok(answers)
}
