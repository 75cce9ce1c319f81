//! The cameras of frames: a voxel that is wide in the image asks for fewer pixels.

use super::TsdfOptions;
use crate::rays::Rays;
use skclam_geometry::{DepthImage, PinholeCamera};

/// The camera's rays, and those of every second pixel.
#[derive(Debug, Default)]
pub(super) struct FrameCameras {
    full: Option<Rays>,
    thinned: Option<Rays>,
}

impl FrameCameras {
    fn full(&mut self, camera: &PinholeCamera) -> &Rays {
        keep(&mut self.full, *camera)
    }

    /// The rays of a frame that was made with these cameras.
    pub(super) fn thinned(&mut self, camera: &PinholeCamera, thinning: usize) -> &Rays {
        if thinning == 1 {
            return self.full(camera);
        }
        let by = thinning as f64;
        let mut thin = *camera;
        (thin.width, thin.height) = (camera.width.div_ceil(thinning as u32), camera.height.div_ceil(thinning as u32));
        (thin.fx, thin.fy, thin.cx, thin.cy) = (camera.fx / by, camera.fy / by, camera.cx / by, camera.cy / by);
        keep(&mut self.thinned, thin)
    }
}

fn keep(kept: &mut Option<Rays>, camera: PinholeCamera) -> &Rays {
    if !kept.as_ref().is_some_and(|rays| rays.are_of(&camera)) {
        *kept = None;
    }
    kept.get_or_insert_with(|| Rays::new(&camera))
}

/// Voxels as wide as this many pixels take their planes from every second pixel: a quarter of the work, and no voxel's
/// pixel is farther away than a quarter of the voxel.
const WIDE_VOXEL_PX: f32 = 4.0;

/// Pixels between those that are fused, 1 or 2, by the width of a voxel at the mean depth.
pub(super) fn thinning(depth: &DepthImage, camera: &PinholeCamera, options: &TsdfOptions) -> usize {
    let (near, far) = (options.filter.min_depth_m as f32, options.filter.max_depth_m as f32);
    // A sample of the pixels gives the mean well enough.
    let seen = || depth.as_slice().iter().step_by(61).filter(|z| **z > 0.0 && **z >= near && **z <= far);
    let mean = seen().sum::<f32>() / seen().count().max(1) as f32;
    let width_px = options.voxel_m as f32 * camera.fx.min(camera.fy) as f32;
    if width_px >= WIDE_VOXEL_PX * mean { 2 } else { 1 }
}
