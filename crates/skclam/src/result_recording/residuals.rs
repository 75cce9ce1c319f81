//! How far the matches of a posture lie from their epipolar lines, Eq. (8), as lines to draw into its image.

use super::ResultRecordingError;
use crate::dataset::Dataset;
use crate::pipeline::{Config, correspondences, drop_ego_masked, extract_features, match_pairs, pairs_to_match};
use crate::progress::Progress;
use skclam_calibration::{Correspondences, PairMatches};
use skclam_geometry::{FundamentalMatrix, Isometry3, PinholeCamera, Pixel, Point3};
use skclam_rig::Rig;

/// The matches of a run, found once more: the same images and configuration give the same matches.
pub(super) fn matches_again(
    dataset: &Dataset,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Correspondences, ResultRecordingError> {
    let mut images = extract_features(dataset, config, progress)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, config);
    if dataset.rig.color_mask.is_none() {
        drop_ego_masked(&mut images, &chosen, &dataset.rig.color, config)?;
    }
    let pairs = match_pairs(dataset, &images, chosen, config, progress)?;
    Ok(correspondences(dataset, &images, &pairs, config, progress)?.0)
}

/// A match in one image. Pixels as the image has them, distortion included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ResidualLine {
    pub measured: Pixel,
    /// The nearest point of the epipolar line that the match's pixel in the other image makes in this one.
    pub on_epipolar_line: Pixel,
}

/// The matches of one image with all its neighbours.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PostureResiduals {
    /// Evenly taken from all matches.
    pub lines: Vec<ResidualLine>,
    /// All matches.
    pub matches: usize,
    /// Median distance of all matches, px without distortion.
    pub median_px: f64,
}

/// The residuals of a posture under a rig; `None` where it has no match with a baseline. At most about `most` lines.
pub(super) fn posture_residuals(
    rig: &Rig,
    poses: &[Isometry3],
    data: &Correspondences,
    posture: usize,
    most: usize,
) -> Option<PostureResiduals> {
    let of_posture = data.pairs.iter().filter(|pair| pair.a == posture || pair.b == posture);
    let total: usize = of_posture.clone().map(|pair| pair.matches.len()).sum();
    let stride = total.div_ceil(most.max(1)).max(1);
    let mut distances = Vec::with_capacity(total);
    let mut lines = Vec::new();
    let mut at = 0;
    for pair in of_posture {
        let neighbor = if pair.a == posture { pair.b } else { pair.a };
        let this_from_neighbor = poses[posture].inverse() * poses[neighbor];
        let fundamental = FundamentalMatrix::from_pose(&rig.color, &rig.color, &this_from_neighbor);
        for (in_this, in_neighbor) in pixels(pair, posture) {
            at += 1;
            let undistorted = rig.color.undistort(&in_this);
            let line = fundamental.line_in_a(&rig.color.undistort(&in_neighbor)).0;
            let normal_squared = line.x * line.x + line.y * line.y;
            let along = (line.x * undistorted.x + line.y * undistorted.y + line.z) / normal_squared;
            let foot = Pixel::new(undistorted.x - along * line.x, undistorted.y - along * line.y);
            if !(foot.x.is_finite() && foot.y.is_finite()) {
                continue;
            }
            distances.push((foot - undistorted).norm());
            if (at - 1) % stride == 0
                && let Some(on_epipolar_line) = distorted(&rig.color, &foot)
            {
                lines.push(ResidualLine { measured: in_this, on_epipolar_line });
            }
        }
    }
    let middle = distances.len() / 2;
    let median_px = match distances.is_empty() {
        true => return None,
        false => *distances.select_nth_unstable_by(middle, f64::total_cmp).1,
    };
    Some(PostureResiduals { lines, matches: distances.len(), median_px })
}

/// The pixels of a pair's matches: in the image of `posture`, and in the other's.
fn pixels(pair: &PairMatches, posture: usize) -> impl Iterator<Item = (Pixel, Pixel)> + '_ {
    let first = pair.a == posture;
    pair.matches.iter().map(move |m| if first { (m.in_a, m.in_b) } else { (m.in_b, m.in_a) })
}

fn distorted(camera: &PinholeCamera, undistorted: &Pixel) -> Option<Pixel> {
    let ideal = PinholeCamera { distortion: Default::default(), ..*camera };
    camera.project(&Point3::from(ideal.unproject(undistorted)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_calibration::PairMatch;
    use skclam_rig::{PostureState, builtin_rig};

    #[test]
    fn true_matches_have_short_lines_and_a_shifted_one_has_the_shift() {
        let mut rig = builtin_rig("hp3j").unwrap().unwrap();
        rig.color.distortion = [0.05, -0.02, 1e-3, -5e-4, 0.0];
        // Two cameras beside one another: epipolar lines are rows.
        let poses = [Isometry3::identity(), Isometry3::translation(0.2, 0.0, 0.0)];
        let see = |camera: usize, point: &Point3| rig.color.project(&(poses[camera].inverse() * point)).unwrap();
        let points = (0..40).map(|k| Point3::new(0.02 * f64::from(k % 8) - 0.1, 0.03 * f64::from(k / 8), 1.0));
        let matched =
            |point: Point3| PairMatch { in_a: see(0, &point), in_b: see(1, &point), sigma_px: 1.0, distance: 0 };
        let mut pair = PairMatches { a: 0, b: 1, matches: points.map(matched).collect() };
        let posture = skclam_rig::Posture::new(0, PostureState::Joints(vec![]));
        let data = |pair: &PairMatches| Correspondences {
            postures: vec![posture.clone(), posture.clone()],
            pairs: vec![pair.clone()],
            ..Correspondences::default()
        };
        for posture in 0..2 {
            let found = posture_residuals(&rig, &poses, &data(&pair), posture, 10).unwrap();
            assert_eq!((found.matches, found.lines.len()), (40, 10));
            assert!(found.median_px < 1e-6, "{}", found.median_px);
            assert!(found.lines.iter().all(|line| (line.measured - line.on_epipolar_line).norm() < 1e-6));
        }
        pair.matches.iter_mut().for_each(|m| m.in_b.y += 3.0);
        let found = posture_residuals(&rig, &poses, &data(&pair), 1, 1000).unwrap();
        assert_eq!(found.lines.len(), 40);
        assert!((found.median_px - 3.0).abs() < 0.2, "{}", found.median_px);
        // Without a baseline there is no line.
        assert_eq!(posture_residuals(&rig, &[poses[0], poses[0]], &data(&pair), 0, 10), None);
    }
}
