//! Points of the maps for the report's 3D view: the same pixels at the nominal and at the calibrated poses, with their
//! colour, their image, and how far the other images' surfaces are from them.

use super::Packed;
use crate::dataset::Dataset;
use crate::pipeline::{PointToPlaneSample, RunError};
use image::GrayImage;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{Pixel, Point3};
use skclam_rig::Rig;

/// Points of both maps, in the same order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapSamples {
    /// How many.
    pub points: usize,
    /// Base frame, metres: x, y, z of each point, 32-bit floating point, at the nominal poses.
    pub nominal_m: Packed,
    /// The same at the calibrated poses.
    pub calibrated_m: Packed,
    /// Red, green, blue, a byte each.
    pub colors: Packed,
    /// Position of the posture whose image gave the point, 16 bits.
    pub postures: Packed,
    /// Median distance to the surfaces of other images at the nominal poses, mm, 32-bit floating point; NaN where no
    /// other image shows the point.
    pub point_to_plane_nominal_mm: Packed,
    /// The same at the calibrated poses.
    pub point_to_plane_calibrated_mm: Packed,
}

/// Grey for pixels that the colour camera does not see.
const UNOBSERVED: [u8; 3] = [128, 128, 128];

/// Colours the points and packs them. `found_mask` is 0 where the colour camera sees what moves with it: such points
/// are left out.
pub fn sample_map(
    dataset: &Dataset,
    rig: &Rig,
    found_mask: Option<&GrayImage>,
    samples: [&[PointToPlaneSample]; 2],
) -> Result<Option<MapSamples>, RunError> {
    let Some(depth_camera) = rig.depth else { return Ok(None) };
    let [calibrated, nominal] = samples;
    if calibrated.len() != nominal.len() || calibrated.is_empty() {
        return Ok(None);
    }
    let own_mask = dataset.color_mask()?;
    let mask = own_mask.as_ref().or(found_mask);
    // Runs of samples of one posture.
    let groups: Vec<&[PointToPlaneSample]> = calibrated.chunk_by(|x, y| x.posture == y.posture).collect();
    let colors: Vec<Vec<Option<[u8; 3]>>> = groups
        .par_iter()
        .map(|group| {
            let posture = group[0].posture;
            let (image, depth) = (dataset.color(posture)?, dataset.depth(posture)?);
            let of_pixel = |index: usize| {
                let width = depth_camera.camera.width as usize;
                let z = depth.as_ref().map_or(0.0, |depth| f64::from(depth.as_slice()[index]));
                let pixel = Pixel::new((index % width) as f64, (index / width) as f64);
                let in_depth = Point3::from(depth_camera.camera.unproject(&pixel) * z);
                let seen = rig.color.project(&(depth_camera.color_from_depth * in_depth));
                let seen = seen.filter(|pixel| rig.color.contains(pixel))?;
                Some((seen.x.round().max(0.0) as u32, seen.y.round().max(0.0) as u32))
            };
            Ok(group
                .iter()
                .map(|sample| match of_pixel(sample.pixel) {
                    None => Some(UNOBSERVED),
                    Some((x, y)) => {
                        let (x, y) = (x.min(image.width() - 1), y.min(image.height() - 1));
                        let hidden = mask.is_some_and(|mask| mask.get_pixel(x, y).0[0] == 0);
                        (!hidden).then(|| image.get_pixel(x, y).0)
                    }
                })
                .collect())
        })
        .collect::<Result<_, RunError>>()?;
    let colors: Vec<Option<[u8; 3]>> = colors.into_iter().flatten().collect();
    let kept: Vec<usize> = (0..colors.len()).filter(|&k| colors[k].is_some()).collect();
    let positions =
        |samples: &[PointToPlaneSample]| Packed::of_f32(kept.iter().flat_map(|&k| samples[k].point_in_base));
    let millimetres = |samples: &[PointToPlaneSample]| {
        let mm = |distance_m: f32| (distance_m * 1e5).round() / 1e2;
        Packed::of_f32(kept.iter().map(|&k| samples[k].median_m.map_or(f32::NAN, mm)))
    };
    Ok(Some(MapSamples {
        points: kept.len(),
        nominal_m: positions(nominal),
        calibrated_m: positions(calibrated),
        colors: Packed::of_u8(&kept.iter().filter_map(|&k| colors[k]).flatten().collect::<Vec<u8>>()),
        postures: Packed::of_u16(kept.iter().map(|&k| calibrated[k].posture.min(usize::from(u16::MAX)) as u16)),
        point_to_plane_nominal_mm: millimetres(nominal),
        point_to_plane_calibrated_mm: millimetres(calibrated),
    }))
}
