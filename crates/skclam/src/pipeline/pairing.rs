//! Which images to match with which: neighbours, as in the paper, or those that should see the same by the nominal rig.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera, Pixel, Point3};

/// How pairs are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pairing {
    /// Each posture with the next one, as in the paper's section 4.1.1.
    Adjacent,
    /// Each posture with those whose images overlap most by the nominal rig, and with the next one.
    Overlap,
}

/// Options of the choice of pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairingOptions {
    /// Neighbours or overlap.
    pub pairing: Pairing,
    /// Neighbours of one posture at most.
    pub max_neighbors: usize,
    /// Least predicted overlap: the part of an image that the other shows too.
    pub min_overlap: f64,
    /// Largest angle between the viewing directions of what both see, degrees: descriptors do not survive more.
    pub max_view_angle_deg: f64,
    /// Range of depths tried where there is no depth image, metres.
    pub assumed_depth_m: [f64; 2],
}

impl Default for PairingOptions {
    fn default() -> Self {
        PairingOptions {
            pairing: Pairing::Overlap,
            max_neighbors: 8,
            min_overlap: 0.25,
            max_view_angle_deg: 50.0,
            assumed_depth_m: [0.25, 2.5],
        }
    }
}

/// What is known of one posture's view before any matching.
#[derive(Debug, Clone)]
pub struct PredictedView {
    /// Pose of the colour camera by the nominal rig.
    pub base_from_color: Isometry3,
    /// Points that the view shows, in the colour camera's frame.
    pub points_in_color: Vec<Point3>,
}

/// Grid of rays per image in the prediction.
const GRID: [u32; 2] = [16, 10];

impl PredictedView {
    /// From a depth image: the points of a coarse grid.
    pub fn from_depth(base_from_color: Isometry3, depth: &DepthImage, depth_camera: &DepthCamera) -> Self {
        PredictedView { base_from_color, points_in_color: measured_points(depth, depth_camera, GRID) }
    }

    /// Without depth: each ray of the grid at one of several depths in turn, in geometric steps over the range.
    pub fn from_assumed_depth(base_from_color: Isometry3, camera: &PinholeCamera, range_m: [f64; 2]) -> Self {
        PredictedView { base_from_color, points_in_color: assumed_points(camera, range_m, GRID) }
    }
}

/// What a depth image measured on a grid of columns and rows, in the colour camera's frame.
pub(crate) fn measured_points(depth: &DepthImage, camera: &DepthCamera, [columns, rows]: [u32; 2]) -> Vec<Point3> {
    let mut points_in_color = Vec::new();
    for row in 0..rows {
        for column in 0..columns {
            let x = (2 * column + 1) * depth.width() / (2 * columns);
            let y = (2 * row + 1) * depth.height() / (2 * rows);
            if let Some(z) = depth.at(x, y) {
                points_in_color.push(camera.point_in_color(&Pixel::new(f64::from(x), f64::from(y)), f64::from(z)));
            }
        }
    }
    points_in_color
}

/// Points of a grid of rays, each at one of several depths in turn.
pub(crate) fn assumed_points(
    camera: &PinholeCamera,
    [near_m, far_m]: [f64; 2],
    [columns, rows]: [u32; 2],
) -> Vec<Point3> {
    const DEPTHS: u32 = 5;
    (0..rows * columns)
        .map(|cell| {
            let (column, row) = (cell % columns, cell / columns);
            let x = (f64::from(column) + 0.5) / f64::from(columns) * f64::from(camera.width);
            let y = (f64::from(row) + 0.5) / f64::from(rows) * f64::from(camera.height);
            let fraction = f64::from((column * 3 + row * 2) % DEPTHS) / f64::from(DEPTHS - 1);
            Point3::from(camera.unproject(&Pixel::new(x, y)) * (near_m * (far_m / near_m).powf(fraction)))
        })
        .collect()
}

/// Two images that are to be matched.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ImagePair {
    /// Position of the first posture.
    pub a: usize,
    /// Position of the second posture, above `a`.
    pub b: usize,
    /// Predicted overlap, 0 to 1.
    pub overlap: f64,
}

/// Chooses pairs, in ascending order of `a`, then `b`.
pub fn choose_pairs(views: &[PredictedView], camera: &PinholeCamera, options: &PairingOptions) -> Vec<ImagePair> {
    let overlap = |a: usize, b: usize| predicted_overlap(&views[a], &views[b], camera, options);
    // Both directions must agree: a close-up and an overview share little of the overview.
    let mutual = |a: usize, b: usize| overlap(a, b).min(overlap(b, a));
    let mut chosen = vec![];
    match options.pairing {
        Pairing::Adjacent => chosen.extend((1..views.len()).map(|b| (b - 1, b))),
        Pairing::Overlap => {
            let row = |a: usize| (0..views.len()).map(|b| if a == b { 0.0 } else { mutual(a, b) }).collect();
            let shared: Vec<Vec<f64>> = (0..views.len()).into_par_iter().map(row).collect();
            for (a, row) in shared.iter().enumerate() {
                let mut neighbors: Vec<usize> =
                    (0..views.len()).filter(|&b| b != a && row[b] >= options.min_overlap).collect();
                neighbors.sort_by(|&x, &y| row[y].total_cmp(&row[x]).then(x.cmp(&y)));
                chosen.extend(neighbors.into_iter().take(options.max_neighbors).map(|b| (a.min(b), a.max(b))));
            }
            // The order of a recording is knowledge too: what follows was seldom taken far away.
            chosen.extend((1..views.len()).map(|b| (b - 1, b)).filter(|&(a, b)| shared[a][b] > 0.0));
            chosen.sort_unstable();
            chosen.dedup();
        }
    }
    chosen.into_iter().map(|(a, b)| ImagePair { a, b, overlap: mutual(a, b) }).collect()
}

/// The part of what A shows that B should show too, from a direction that is not too different.
fn predicted_overlap(a: &PredictedView, b: &PredictedView, camera: &PinholeCamera, options: &PairingOptions) -> f64 {
    if a.points_in_color.is_empty() {
        return 0.0;
    }
    let b_from_a = b.base_from_color.inverse() * a.base_from_color;
    let shared = a.points_in_color.iter().filter(|point| shown_to(point, &b_from_a, camera, options).is_some()).count();
    shared as f64 / a.points_in_color.len() as f64
}

/// Where image B should show a point of image A, if that lies inside it and looks much the same from there; and the
/// point in B's camera.
pub(crate) fn shown_to(
    point_in_a: &Point3,
    b_from_a: &Isometry3,
    camera: &PinholeCamera,
    options: &PairingOptions,
) -> Option<(Pixel, Point3)> {
    let point_in_b = b_from_a * point_in_a;
    let pixel = camera.project(&point_in_b).filter(|pixel| camera.contains(pixel))?;
    let direction_in_b = b_from_a.rotation * point_in_a.coords.normalize();
    // Scale matters as well: at twice the distance a keypoint lies an octave away.
    let ratio = point_in_b.coords.norm() / point_in_a.coords.norm();
    let alike = direction_in_b.dot(&point_in_b.coords.normalize()) > options.max_view_angle_deg.to_radians().cos();
    (alike && (0.4..2.5).contains(&ratio)).then_some((pixel, point_in_b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Cameras in a circle that look outwards, 10 degrees apart.
    fn ring(count: usize) -> (Vec<PredictedView>, PinholeCamera) {
        let camera = PinholeCamera::from_hfov(640, 480, 70f64.to_radians());
        let views = (0..count)
            .map(|i| {
                let turn = Isometry3::rotation(Vector3::y() * (10.0 * i as f64).to_radians());
                PredictedView::from_assumed_depth(turn * Isometry3::translation(0.0, 0.0, 0.3), &camera, [0.8, 1.5])
            })
            .collect();
        (views, camera)
    }

    #[test]
    fn neighbours_overlap_and_opposite_views_do_not() {
        let (views, camera) = ring(36);
        let options = PairingOptions { max_neighbors: 4, ..Default::default() };
        let pairs = choose_pairs(&views, &camera, &options);
        assert!(pairs.iter().any(|pair| (pair.a, pair.b) == (0, 1)));
        assert!(pairs.iter().any(|pair| (pair.a, pair.b) == (0, 35)), "the ring closes");
        assert!(
            pairs
                .iter()
                .all(|pair| pair.overlap >= options.min_overlap && (pair.b - pair.a).min(36 + pair.a - pair.b) < 6)
        );
        assert!(pairs.windows(2).all(|two| (two[0].a, two[0].b) < (two[1].a, two[1].b)));
    }

    #[test]
    fn adjacent_pairs_are_the_papers() {
        let (views, camera) = ring(5);
        let options = PairingOptions { pairing: Pairing::Adjacent, ..Default::default() };
        let pairs: Vec<_> = choose_pairs(&views, &camera, &options).into_iter().map(|pair| (pair.a, pair.b)).collect();
        assert_eq!(pairs, [(0, 1), (1, 2), (2, 3), (3, 4)]);
    }
}
