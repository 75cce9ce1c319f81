//! Depth images that belong to other rows than the colour images beside them.
//!
//! The images alone, at the estimated poses, give every track a point and with it the depth at which a view should have
//! measured it. The depth image that belongs to the view scatters little about that; the scale is not asked for, as an
//! estimate that trusted wrong depths has it wrong.

use super::relative_pose::median;
use crate::dataset::Dataset;
use crate::pipeline::{RegisteredDepth, RunError};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Track};
use skclam_geometry::{Isometry3, Pixel, Point3};

/// Depth images that are shifted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthShift {
    /// The depth image of a posture is so many rows further down (above, where negative).
    pub by: i64,
    /// How far depths scatter about what the images say, with the rows unchanged: median of the relative error about
    /// its own median, percent.
    pub before_percent: f64,
    /// The same with the depth images at their rows, percent.
    pub after_percent: f64,
    /// Points at which depths were compared with the rows shifted.
    pub points: usize,
}

/// Rows by which depth images are shifted at most.
const MAX_SHIFT: i64 = 3;
/// Tracks that take part at most.
const TRACKS: usize = 4000;
/// Points of fewer rays, or rays that meet at less than this angle (1 deg), say little about a depth.
const MIN_RAYS: usize = 3;
const MIN_PARALLAX_RAD: f64 = 0.0175;
/// With fewer points nothing is decided.
const MIN_POINTS: usize = 50;
/// The scatter has to fall by this factor, and from more than that many percent, which no depth camera has.
const MIN_GAIN: f64 = 3.0;
const MIN_BEFORE_PERCENT: f64 = 2.0;

/// Whether depth images belong to other rows; asked when the images fit and the depths do not. `None` where they are
/// right where they are, or there are too few.
///
/// # Errors
/// Depth images that cannot be read, postures that the rig refuses.
pub fn find_depth_shift(
    dataset: &Dataset,
    calibration: &Calibration,
    tracks: &[Track],
) -> Result<Option<DepthShift>, RunError> {
    let rig = calibration.model.corrected_rig();
    let Some(depth_camera) = &dataset.rig.depth else { return Ok(None) };
    let poses = dataset
        .records
        .iter()
        .map(|record| rig.base_from_color(&record.posture))
        .collect::<Result<Vec<Isometry3>, _>>()?;
    let expected = expected_depths(&rig.color, &poses, tracks);
    let most = MAX_SHIFT.min(dataset.len() as i64 / 3);
    let shifts: Vec<i64> = (-most..=most).collect();
    let mut ratios: Vec<Vec<f64>> = vec![Vec::new(); shifts.len()];
    for row in 0..dataset.len() {
        let Some(depth) = dataset.depth(row)? else { continue };
        let Some(registered) = RegisteredDepth::new(&depth, depth_camera, &rig.color) else { continue };
        for (by, ratios) in shifts.iter().zip(&mut ratios) {
            // The depth image of this row belongs to the posture `by` rows above it.
            let views = usize::try_from(row as i64 - by).ok().and_then(|view| expected.get(view));
            let measured = views.into_iter().flatten().filter_map(|(pixel, z)| Some((registered.at(pixel)? / z).ln()));
            ratios.extend(measured);
        }
    }
    let scatter = |ratios: &Vec<f64>| {
        let mut sorted = ratios.clone();
        sorted.sort_by(f64::total_cmp);
        let Some(middle) = sorted.get(sorted.len() / 2) else { return f64::INFINITY };
        1e2 * median(sorted.iter().map(|ratio| ratio - middle).collect())
    };
    let unchanged = &ratios[most as usize];
    let before_percent = scatter(unchanged);
    let shifted = shifts
        .iter()
        .zip(&ratios)
        .filter(|(by, ratios)| **by != 0 && ratios.len() >= MIN_POINTS && 3 * ratios.len() >= unchanged.len());
    let best = shifted
        .map(|(&by, ratios)| DepthShift { by, before_percent, after_percent: scatter(ratios), points: ratios.len() })
        .min_by(|x, y| x.after_percent.total_cmp(&y.after_percent));
    Ok(best.filter(|shift| before_percent > MIN_BEFORE_PERCENT && MIN_GAIN * shift.after_percent <= before_percent))
}

/// Posture by posture, where a track's point is seen and the z-depth that it has there by all rays together, metres.
fn expected_depths(
    camera: &skclam_geometry::PinholeCamera,
    poses: &[Isometry3],
    tracks: &[Track],
) -> Vec<Vec<(Pixel, f64)>> {
    let mut expected: Vec<Vec<(Pixel, f64)>> = vec![Vec::new(); poses.len()];
    for track in tracks.iter().step_by(tracks.len().div_ceil(TRACKS).max(1)) {
        let rays: Vec<(Point3, Vector3<f64>)> = track
            .observations
            .iter()
            .map(|seen| {
                let pose = &poses[seen.posture];
                (Point3::from(pose.translation.vector), (pose.rotation * camera.unproject(&seen.pixel)).normalize())
            })
            .collect();
        let Some(point) = meeting_point(&rays) else { continue };
        for seen in &track.observations {
            let z = poses[seen.posture].inverse_transform_point(&point).z;
            if z > 0.0 {
                expected[seen.posture].push((seen.pixel, z));
            }
        }
    }
    expected
}

/// The point nearest to all rays, least squares.
fn meeting_point(rays: &[(Point3, Vector3<f64>)]) -> Option<Point3> {
    let sine = MIN_PARALLAX_RAD.sin();
    let wide = rays.iter().enumerate().any(|(k, a)| rays[k + 1..].iter().any(|b| a.1.cross(&b.1).norm() > sine));
    if rays.len() < MIN_RAYS || !wide {
        return None;
    }
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (center, direction) in rays {
        let across = Matrix3::identity() - direction * direction.transpose();
        normal += across;
        right += across * center.coords;
    }
    normal.cholesky().map(|factor| Point3::from(factor.solve(&right)))
}
