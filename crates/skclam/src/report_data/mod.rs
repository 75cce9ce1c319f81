//! `report_data.json`: what the report shows beside the metrics of `summary.json`, so that it can be built again from
//! the result folder alone.
//!
//! Everything here follows from the data set and the calibration, the same bytes on any number of threads. Lists of
//! numbers by the thousand are base64 of little-endian arrays ([`Packed`]); images are base64 of JPEG files. Positions
//! in the recording ("posture 3") count from 0; `index` is the recording's own name of a posture. A reader refuses a
//! `format` that it does not know.

mod map_samples;
mod packed;
mod pair_images;
mod residuals;

pub use map_samples::{MapSamples, sample_map};
pub use packed::{EmbeddedImage, Packed};
pub use pair_images::{DrawnMatch, PairImages, pair_images};
pub use residuals::{
    Histogram, ImageCell, PairResiduals, PostureResiduals, ResidualData, ResidualKind, ResidualQuantiles, residual_data,
};

use crate::dataset::Dataset;
use crate::pipeline::{PoseSigma, RunError, localize};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Correspondences};
use skclam_geometry::Isometry3;
use skclam_kinematics::JointKind;
use skclam_rig::{PostureState, Rig};

/// The `format` that this program writes.
pub const FORMAT: u32 = 2;

/// All of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReportData {
    /// Version of this structure: [`FORMAT`].
    pub format: u32,
    /// The data set's folder, as it was named.
    pub dataset: String,
    /// Width and height of the colour images, px.
    pub image_size: [u32; 2],
    /// The arm's joints; empty without an arm.
    pub joints: Vec<JointName>,
    /// One a posture, in the order of the recording.
    pub postures: Vec<PosturePlace>,
    /// How far the matches are from their epipolar lines, before and after.
    pub residuals: ResidualData,
    /// The worst, the median and the best pair.
    pub images: Vec<PairImages>,
    /// Correlations of the free parameters, in the order of the summary; `None` where the estimator has no covariance.
    pub correlations: Option<Vec<Vec<f64>>>,
    /// What is known of flange and camera at the recorded postures and over the workspace.
    pub pose_sigmas: Vec<PoseSigma>,
    /// Points of the maps; `None` without depth, or where no map was built.
    pub map: Option<MapSamples>,
}

/// A joint's name and the unit of its values.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JointName {
    /// From the rig; "joint 3" where it has none.
    pub name: String,
    /// "deg" or "mm".
    pub unit: String,
}

/// Where the camera was at one posture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PosturePlace {
    /// The recording's index of the posture.
    pub index: u64,
    /// Joint values in the joints' units; empty for flange poses.
    pub joints: Vec<f64>,
    /// Camera centre in the base frame by the nominal rig, metres.
    pub nominal_m: [f64; 3],
    /// The same by the calibrated rig.
    pub calibrated_m: [f64; 3],
}

impl ReportData {
    /// All but the map, which [`sample_map`] fills in.
    ///
    /// # Errors
    /// Of the images that are drawn, and of the rigs.
    pub fn new(
        dataset: &Dataset,
        data: &Correspondences,
        calibration: &Calibration,
        calibrated: &Rig,
        pose_sigmas: &[PoseSigma],
    ) -> Result<Self, RunError> {
        let [nominal_poses, calibrated_poses] = [localize(dataset, &dataset.rig)?, localize(dataset, calibrated)?];
        let joints = dataset.rig.robot.as_ref().map(|robot| robot.joints()).unwrap_or_default();
        let postures = dataset.records.iter().enumerate().map(|(at, record)| PosturePlace {
            index: record.posture.index,
            joints: match &record.posture.state {
                PostureState::FlangePose(_) => Vec::new(),
                PostureState::Joints(values) => values
                    .iter()
                    .zip(joints)
                    .map(|(value, joint)| rounded(value * file_factor(joint.kind), 4))
                    .collect(),
            },
            nominal_m: centre(&nominal_poses[at].base_from_camera),
            calibrated_m: centre(&calibrated_poses[at].base_from_camera),
        });
        let (residuals, per_match) = residual_data(dataset, data, calibration)?;
        let images = pair_images(dataset, data, &calibration.model, &residuals, &per_match)?;
        Ok(ReportData {
            format: FORMAT,
            dataset: dataset.source.place().display().to_string(),
            image_size: [dataset.rig.color.width, dataset.rig.color.height],
            joints: joints
                .iter()
                .enumerate()
                .map(|(at, joint)| JointName {
                    name: if joint.name.is_empty() { format!("joint {}", at + 1) } else { joint.name.clone() },
                    unit: if joint.kind == JointKind::Revolute { "deg" } else { "mm" }.to_owned(),
                })
                .collect(),
            postures: postures.collect(),
            residuals,
            images,
            correlations: calibration.covariance.as_ref().map(correlations),
            pose_sigmas: pose_sigmas.to_vec(),
            map: None,
        })
    }
}

fn file_factor(kind: JointKind) -> f64 {
    match kind {
        JointKind::Revolute => 1f64.to_degrees(),
        JointKind::Prismatic => 1e3,
    }
}

fn centre(base_from_camera: &Isometry3) -> [f64; 3] {
    let t = &base_from_camera.translation.vector;
    [rounded(t.x, 6), rounded(t.y, 6), rounded(t.z, 6)]
}

/// Correlations of a covariance; 0 with a parameter that has no variance.
fn correlations(covariance: &DMatrix<f64>) -> Vec<Vec<f64>> {
    let sigma = |k: usize| covariance[(k, k)].max(0.0).sqrt();
    let one = |i: usize, j: usize| {
        let product = sigma(i) * sigma(j);
        if product > 0.0 { rounded((covariance[(i, j)] / product).clamp(-1.0, 1.0), 4) } else { 0.0 }
    };
    (0..covariance.nrows()).map(|i| (0..covariance.ncols()).map(|j| one(i, j)).collect()).collect()
}

/// A number with so many decimals as the file needs.
fn rounded(value: f64, decimals: i32) -> f64 {
    let factor = 10f64.powi(decimals);
    let rounded = (value * factor).round() / factor;
    // No -0.
    if rounded == 0.0 { 0.0 } else { rounded }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn correlations_are_within_one_and_zero_without_variance() {
        let covariance = DMatrix::from_row_slice(3, 3, &[4.0, -3.0, 0.0, -3.0, 9.0, 0.0, 0.0, 0.0, 0.0]);
        let found = correlations(&covariance);
        assert_eq!(found, [[1.0, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, 0.0]]);
    }

    #[test]
    fn rounding_leaves_no_minus_zero() {
        assert_eq!(rounded(-1e-9, 4).to_bits(), 0f64.to_bits());
        assert_eq!(rounded(1.23456, 2), 1.23);
    }
}
