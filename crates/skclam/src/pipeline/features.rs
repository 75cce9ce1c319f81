//! The first stage, section 3.2: keypoints and descriptors of every image, and the depth at every keypoint.

use super::{Config, PredictedView, RegisteredDepth, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use image::GrayImage;
use rayon::prelude::*;
use skclam_features::akaze::Threading;
use skclam_features::{Akaze, AkazeOptions, Features};
use skclam_geometry::Pixel;

/// What one posture's images yield.
#[derive(Debug)]
pub struct ImageFeatures {
    /// Keypoints and descriptors.
    pub features: Features,
    /// Keypoint by keypoint, the pixel with the distortion removed.
    pub undistorted: Vec<Pixel>,
    /// Keypoint by keypoint, z-depth in the colour camera's frame, metres, where it was measured.
    pub depth_m: Vec<Option<f64>>,
    /// How that depth changes with the normalised image coordinates, m; zeros where it is not known.
    pub depth_slope: Vec<[f64; 2]>,
    /// The grey image, for the refinement; `None` where all of them together would take too much memory.
    pub gray: Option<GrayImage>,
    /// What the view should show by the nominal rig.
    pub view: PredictedView,
}

/// Grey images are kept in memory up to this size in total; beyond it they are decoded again when needed.
const KEPT_GRAY_BYTES: u64 = 512 << 20;

/// Detects and describes the keypoints of every image.
pub fn extract_features(
    dataset: &Dataset,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Vec<ImageFeatures>, RunError> {
    progress.begin(Stage::ExtractFeatures, dataset.len() as u64);
    let camera = &dataset.rig.color;
    let keep_gray = u64::from(camera.width) * u64::from(camera.height) * dataset.len() as u64 <= KEPT_GRAY_BYTES;
    let mask = dataset.color_mask()?;
    let options = AkazeOptions { threading: Threading::Caller, ..config.akaze.clone() };
    (0..dataset.len())
        .into_par_iter()
        .map_init(
            || Akaze::new(options.clone()),
            |akaze, index| {
                if progress.stop_requested() {
                    return Err(RunError::Interrupted);
                }
                let one = one_image(dataset, index, akaze, mask.as_ref(), config, keep_gray);
                progress.step();
                one
            },
        )
        .collect()
}

fn one_image(
    dataset: &Dataset,
    index: usize,
    akaze: &mut Akaze,
    mask: Option<&GrayImage>,
    config: &Config,
    keep_gray: bool,
) -> Result<ImageFeatures, RunError> {
    let camera = &dataset.rig.color;
    let gray = dataset.gray(index)?;
    let features = akaze.detect_and_describe(&gray, mask)?;
    let pixels: Vec<Pixel> = features.keypoints.iter().map(|k| Pixel::new(f64::from(k.x), f64::from(k.y))).collect();
    let undistorted = pixels.iter().map(|pixel| camera.undistort(pixel)).collect();
    let base_from_color = dataset.rig.base_from_color(&dataset.records[index].posture)?;
    let depth = dataset.depth(index)?;
    let registered = match (&depth, &dataset.rig.depth) {
        (Some(depth), Some(depth_camera)) => RegisteredDepth::new(depth, depth_camera, camera),
        _ => None,
    };
    let sample = |pixel: &Pixel| registered.as_ref().and_then(|registered| registered.sample_at(pixel));
    let samples: Vec<_> = pixels.iter().map(sample).collect();
    let depth_m = samples.iter().map(|sample| sample.map(|sample| sample.depth_m)).collect();
    let depth_slope = samples.iter().map(|s| s.and_then(|s| s.slope_m).unwrap_or_default()).collect();
    let view = match (&depth, &dataset.rig.depth) {
        (Some(depth), Some(depth_camera)) if registered.is_some() => {
            PredictedView::from_depth(base_from_color, depth, depth_camera)
        }
        _ => PredictedView::from_assumed_depth(base_from_color, camera, config.pairing.assumed_depth_m),
    };
    Ok(ImageFeatures { features, undistorted, depth_m, depth_slope, gray: keep_gray.then_some(gray), view })
}

impl ImageFeatures {
    /// Keeps the keypoints whose pixel (distortion included) the predicate accepts; how many were dropped.
    pub fn retain(&mut self, mut keep: impl FnMut(&Pixel) -> bool) -> usize {
        let accepted: Vec<bool> =
            self.features.keypoints.iter().map(|k| keep(&Pixel::new(f64::from(k.x), f64::from(k.y)))).collect();
        retain_marked(&mut self.features.keypoints, &accepted);
        retain_marked(&mut self.features.descriptors, &accepted);
        retain_marked(&mut self.undistorted, &accepted);
        retain_marked(&mut self.depth_m, &accepted);
        retain_marked(&mut self.depth_slope, &accepted);
        accepted.iter().filter(|accepted| !**accepted).count()
    }
}

fn retain_marked<T>(list: &mut Vec<T>, accepted: &[bool]) {
    let mut marks = accepted.iter();
    list.retain(|_| *marks.next().unwrap_or(&true));
}
