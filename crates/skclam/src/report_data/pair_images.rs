//! The worst, the median and the best pair as small images, with some matches and their epipolar lines before and
//! after.

use super::residuals::PairResidualVectors;
use super::{EmbeddedImage, Packed, PairResiduals, ResidualData, rounded};
use crate::dataset::{Dataset, DatasetError};
use crate::pipeline::RunError;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{FilterType, resize};
use serde::{Deserialize, Serialize};
use skclam_calibration::{Correspondences, Model, PairMatch, camera_poses};
use skclam_geometry::{EpipolarLine, FundamentalMatrix, Isometry3, PinholeCamera, Pixel};

/// Longer edge of an image, px.
const IMAGE_PX: u32 = 640;
/// JPEG quality.
const QUALITY: u8 = 78;
/// Matches that are drawn on a pair.
const DRAWN: usize = 10;
/// Pairs with fewer matches are not chosen: one wrong match would decide.
const MIN_MATCHES: usize = 8;
/// Straight pieces of a line; distorted lines are bent.
const PIECES: usize = 24;

/// A pair with matches drawn on it. Pixels of the small images: (0, 0) is the outer corner of the top-left pixel, so
/// that an image spans its width and height.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairImages {
    /// "worst", "median" or "best", by the median distance after the calibration.
    pub rank: String,
    /// Position of the first posture.
    pub a: usize,
    /// Position of the second posture.
    pub b: usize,
    /// The two images.
    pub images: [EmbeddedImage; 2],
    /// Matches, evenly over the list.
    pub matches: Vec<DrawnMatch>,
}

/// A match and its lines.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrawnMatch {
    /// Where the two images show it.
    pub points: [[f64; 2]; 2],
    /// In each image, the line that the nominal rig gives its match.
    pub lines_before: [Vec<[f64; 2]>; 2],
    /// The same by the calibrated rig.
    pub lines_after: [Vec<[f64; 2]>; 2],
    /// Mean of its two distances by the nominal rig, px of the full image.
    pub before_px: f64,
    /// The same by the calibrated rig.
    pub after_px: f64,
}

/// Draws them. None where no pair has enough matches; fewer than three where pairs are few.
pub fn pair_images(
    dataset: &Dataset,
    data: &Correspondences,
    calibrated: &Model,
    residuals: &ResidualData,
    per_match: &[PairResidualVectors],
) -> Result<Vec<PairImages>, RunError> {
    let nominal = Model::new(dataset.rig.clone());
    let poses = [camera_poses(&nominal, &data.postures)?, camera_poses(calibrated, &data.postures)?];
    let cameras = [&nominal.rig.color, &calibrated.rig.color];
    let mut images = Vec::new();
    for (rank, chosen) in ranked(&residuals.pairs) {
        let (a, b) = (chosen.a, chosen.b);
        let found = data.pairs.iter().zip(per_match).find(|(pair, _)| (pair.a, pair.b) == (a, b));
        let Some((pair, Some(ends))) = found else { continue };
        let [in_a, in_b] = [small(dataset, a)?, small(dataset, b)?];
        let scale = f64::from(in_a.width) / f64::from(dataset.rig.color.width);
        let geometry = [0, 1].map(|which| {
            let a_from_b: Isometry3 = poses[which][a].inverse() * poses[which][b];
            FundamentalMatrix::from_pose(cameras[which], cameras[which], &a_from_b)
        });
        let drawn = |at: usize| {
            let m = &pair.matches[at];
            let size = |which: usize| {
                let residual = &ends[which][at];
                rounded(0.5 * (residual.in_a.norm() + residual.in_b.norm()), 3)
            };
            let lines = |which: usize| lines(&geometry[which], cameras[which], m, scale);
            DrawnMatch {
                points: [to_image(&m.in_a, scale), to_image(&m.in_b, scale)],
                lines_before: lines(0),
                lines_after: lines(1),
                before_px: size(0),
                after_px: size(1),
            }
        };
        let count = pair.matches.len().min(DRAWN);
        let matches = (0..count).map(|k| drawn((2 * k + 1) * pair.matches.len() / (2 * count))).collect();
        images.push(PairImages { rank: rank.to_owned(), a, b, images: [in_a, in_b], matches });
    }
    Ok(images)
}

/// Worst, median and best of the pairs that have enough matches, each pair once.
fn ranked(pairs: &[PairResiduals]) -> Vec<(&'static str, PairResiduals)> {
    let mut enough: Vec<PairResiduals> = pairs.iter().copied().filter(|pair| pair.matches >= MIN_MATCHES).collect();
    enough.sort_by(|x, y| y.median_after_px.total_cmp(&x.median_after_px).then((x.a, x.b).cmp(&(y.a, y.b))));
    match enough[..] {
        [] => Vec::new(),
        [one] => vec![("median", one)],
        [first, last] => vec![("worst", first), ("best", last)],
        [first, .., last] => vec![("worst", first), ("median", enough[enough.len() / 2]), ("best", last)],
    }
}

fn small(dataset: &Dataset, posture: usize) -> Result<EmbeddedImage, RunError> {
    let image = dataset.color(posture)?;
    let (width, height) = image.dimensions();
    let factor = (f64::from(IMAGE_PX) / f64::from(width.max(height))).min(1.0);
    let along = |pixels: u32| ((f64::from(pixels) * factor).round() as u32).max(1);
    let image = resize(&image, along(width), along(height), FilterType::Triangle);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode_image(&image).map_err(|error| DatasetError::Image {
        path: dataset.path_of(&dataset.records[posture].color),
        problem: error.to_string(),
    })?;
    Ok(EmbeddedImage { width: image.width(), height: image.height(), jpeg: Packed::of_u8(&jpeg) })
}

fn to_image(pixel: &Pixel, scale: f64) -> [f64; 2] {
    [rounded((pixel.x + 0.5) * scale, 1), rounded((pixel.y + 0.5) * scale, 1)]
}

fn lines(geometry: &FundamentalMatrix, camera: &PinholeCamera, m: &PairMatch, scale: f64) -> [Vec<[f64; 2]>; 2] {
    let (in_a, in_b) = (camera.undistort(&m.in_a), camera.undistort(&m.in_b));
    [bent(&geometry.line_in_a(&in_b), camera, scale), bent(&geometry.line_in_b(&in_a), camera, scale)]
}

/// A line of the ideal image as the real one shows it: pieces from border to border, a pixel or so beyond.
fn bent(line: &EpipolarLine, camera: &PinholeCamera, scale: f64) -> Vec<[f64; 2]> {
    let normal = line.0.xy();
    let length = normal.norm();
    if length == 0.0 {
        return Vec::new();
    }
    let normal = normal / length;
    // Foot of the image's centre on the line; from there half a diagonal and more reaches every border.
    let center = Pixel::new(0.5 * f64::from(camera.width), 0.5 * f64::from(camera.height));
    let foot = center - normal * (normal.dot(&center.coords) + line.0.z / length);
    let along = nalgebra::Vector2::new(-normal.y, normal.x);
    let reach = 0.7 * f64::from(camera.width).hypot(f64::from(camera.height));
    let ideal = PinholeCamera { distortion: Default::default(), ..*camera };
    let mut points: Vec<[f64; 2]> = Vec::new();
    for k in 0..=PIECES {
        let on_line = foot + along * (reach * (2.0 * k as f64 / PIECES as f64 - 1.0));
        let Some(pixel) = camera.project(&ideal.unproject(&on_line).into()) else { continue };
        let margin = 0.05 * f64::from(camera.width);
        let inside = pixel.x > -margin
            && pixel.y > -margin
            && pixel.x < f64::from(camera.width) + margin
            && pixel.y < f64::from(camera.height) + margin;
        if inside || !camera.is_distorted() {
            points.push(to_image(&pixel, scale));
        }
    }
    if camera.is_distorted() || points.len() < 2 {
        return points;
    }
    // Without distortion it is straight, and its endpoints define it.
    vec![points[0], points[points.len() - 1]]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(a: usize, median_after_px: f64, matches: usize) -> PairResiduals {
        PairResiduals { a, b: a + 1, matches, median_before_px: 9.0, median_after_px }
    }

    #[test]
    fn the_worst_the_median_and_the_best_are_chosen_among_pairs_that_count() {
        let pairs = [pair(0, 0.3, 20), pair(1, 0.9, 20), pair(2, 0.1, 20), pair(3, 7.0, 3), pair(4, 0.0, 7)];
        let chosen: Vec<(&str, usize)> = ranked(&pairs).into_iter().map(|(rank, pair)| (rank, pair.a)).collect();
        assert_eq!(chosen, [("worst", 1), ("median", 0), ("best", 2)]);
        assert_eq!(ranked(&pairs[..1]).len(), 1);
        assert_eq!(ranked(&pairs[3..]).len(), 0);
    }

    #[test]
    fn a_bent_line_passes_where_the_straight_one_does() {
        let mut camera = PinholeCamera::from_hfov(640, 480, 1.2);
        let line = EpipolarLine(nalgebra::Vector3::new(0.1, 1.0, -200.0));
        let straight = bent(&line, &camera, 1.0);
        assert_eq!(straight.len(), 2);
        for [x, y] in straight {
            assert!(line.distance(&Pixel::new(x - 0.5, y - 0.5)) < 0.1);
        }
        camera.distortion = [-0.2, 0.05, 0.001, 0.0, 0.0];
        let curve = bent(&line, &camera, 1.0);
        assert!(curve.len() > 5);
        for [x, y] in curve {
            let ideal = camera.undistort(&Pixel::new(x - 0.5, y - 0.5));
            assert!(line.distance(&ideal) < 0.2, "{ideal}");
        }
    }
}
