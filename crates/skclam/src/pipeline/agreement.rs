//! How well the depth images agree with each other at the poses of a rig: a judgement that the matches did not take part in.

use super::RunError;
use crate::dataset::Dataset;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{DepthImage, Isometry3};
use skclam_mapping::{GapOptions, View, surface_gaps};
use skclam_rig::Rig;

/// Distances between the surfaces of overlapping depth images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SurfaceAgreement {
    /// Pairs of depth images that overlap.
    pub pairs: usize,
    /// Median distance, millimetres.
    pub median_mm: f64,
    /// 90th percentile, millimetres.
    pub p90_mm: f64,
}

/// Depth images that are compared at the most, evenly over the recording; the cost grows with the square.
const COMPARED: usize = 120;

/// One answer for each list of poses; `None` where the data set has no depth, or where no two images overlap.
pub fn surface_agreement<const N: usize>(
    dataset: &Dataset,
    poses: [&[Isometry3]; N],
    rig: &Rig,
) -> Result<[Option<SurfaceAgreement>; N], RunError> {
    let Some(depth_camera) = rig.depth else { return Ok([None; N]) };
    let chosen: Vec<usize> = (0..dataset.len()).step_by(dataset.len().div_ceil(COMPARED).max(1)).collect();
    let depths: Vec<Option<DepthImage>> =
        chosen.par_iter().map(|&index| dataset.depth(index)).collect::<Result<_, _>>()?;
    let depth_mask = dataset.depth_mask()?;
    let mut answers = [None; N];
    for (answer, poses) in answers.iter_mut().zip(poses) {
        let views: Vec<View<'_>> = chosen
            .iter()
            .zip(&depths)
            .filter_map(|(&index, depth)| {
                Some(View {
                    depth: depth.as_ref()?,
                    color: None,
                    depth_camera: &depth_camera,
                    color_camera: &rig.color,
                    base_from_color: poses[index],
                    depth_mask: depth_mask.as_ref(),
                    color_mask: None,
                })
            })
            .collect();
        let gaps = surface_gaps(&views, &GapOptions::default())?;
        if let (Some(median_m), Some(p90_m)) = (gaps.median_m, gaps.p90_m) {
            *answer =
                Some(SurfaceAgreement { pairs: gaps.pairs.len(), median_mm: median_m * 1e3, p90_mm: p90_m * 1e3 });
        }
    }
    Ok(answers)
}
