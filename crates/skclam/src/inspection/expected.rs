//! How well the arm can be calibrated with these postures: observations that the nominal rig predicts, and the
//! covariance that they would give.
//!
//! A grid of each image's points (from its depth image, else at assumed depths) is followed into the images that should
//! be matched with it, as long as they lie inside, are not hidden there and look alike. Corners of the rig's board are
//! not predicted but found, and used as a run uses them: alone where (nearly) every posture shows them and there is no
//! depth.

use crate::dataset::Dataset;
use crate::evaluation::Statistics;
use crate::pipeline::{BoardUse, ImagePair, PairingOptions, assumed_points, board_alone, measured_points, shown_to};
use crate::summary::file_unit;
use nalgebra::DMatrix;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    BoardObservation, CalibrationError, Correspondences, ExpectationOptions, ExpectedCalibration, Parameter,
    ParameterEstimate, Track, TrackObservation, default_sigma, expected_calibration, isotropic_covariance,
    orientation_sigma_rad, position_sigma_m, stated_sigma,
};
use skclam_geometry::{DepthImage, Isometry3, PinholeCamera, Pixel, Point3};
use skclam_rig::Rig;

use super::JointCoverage;

/// What is predicted of images that have not been matched.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ExpectedSigmaOptions {
    /// Points of the grid on each image, columns and rows.
    pub grid: [u32; 2],
    /// Images that show a point, at most: the one of the grid and some of its neighbours in turn.
    pub observations_per_point: usize,
    /// Noise, priors and what is free.
    pub expectation: ExpectationOptions,
    /// A revolute joint that turned by less is named where a parameter stays unknown, degrees.
    pub ample_joint_range_deg: f64,
    /// A prismatic one that slid by less, millimetres.
    pub ample_joint_range_mm: f64,
}

impl Default for ExpectedSigmaOptions {
    /// As many observations an image as the pipeline finds in a textured cell.
    fn default() -> Self {
        ExpectedSigmaOptions {
            grid: [28, 18],
            observations_per_point: 3,
            expectation: ExpectationOptions::default(),
            ample_joint_range_deg: 45.0,
            ample_joint_range_mm: 150.0,
        }
    }
}

/// What a calibration with these postures should reach.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectedSigmas {
    /// Points that were followed.
    pub points: usize,
    /// Observations of them.
    pub observations: usize,
    /// Corners of the rig's board in all images.
    pub corners: usize,
    /// Sigma of a pixel coordinate that was assumed, px.
    pub pixel_sigma: f64,
    /// `s` of the depth noise `s z^2` that was assumed, 1/m; `null` without depth.
    pub depth_sigma_per_m2: Option<f64>,
    /// Each free parameter.
    pub parameters: Vec<ExpectedParameter>,
    /// Number of free parameters.
    pub free: usize,
    /// How many combinations of them the residuals depend on.
    pub rank: usize,
    /// How many combinations become known to half of their tolerance or better; the others stay about as they were
    /// before.
    pub identifiable: usize,
    /// Greatest over smallest singular value of what is identifiable.
    pub condition_number: Option<f64>,
    /// What is not identifiable, and why, in words.
    pub not_identifiable: Vec<String>,
    /// Standard deviation of the camera's position over the postures, mm.
    pub camera_sigma_mm: Statistics,
    /// Standard deviation of its orientation, degrees.
    pub camera_sigma_deg: Statistics,
    /// Joints that should move more.
    pub joints_to_move: Vec<JointToMove>,
}

/// What is expected of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExpectedParameter {
    /// "alpha_2".
    pub name: String,
    /// Expected standard deviation in `unit`; `null` where the postures do not determine it.
    pub sigma: Option<f64>,
    /// "deg", "mm", "px" or "" (no unit).
    pub unit: &'static str,
    /// Why there is no sigma.
    pub note: Option<String>,
}

/// A joint whose little motion leaves parameters unknown.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JointToMove {
    /// The joint's name.
    pub joint: String,
    /// By how much it moved.
    pub range: f64,
    /// "deg" or "mm".
    pub unit: &'static str,
    /// What would be known better.
    pub parameters: Vec<String>,
}

/// What is kept of an image to predict observations.
pub(super) struct Predicted {
    base_from_color: Isometry3,
    points_in_color: Vec<Point3>,
    surface: Option<Surface>,
}

/// The nearest depth in each cell of the colour image.
struct Surface {
    nearest_m: Vec<f32>,
}

/// Cells of a [`Surface`].
const CELLS: [usize; 2] = [40, 25];
/// What lies so much behind the nearest surface of its cell is hidden; a slanted surface alone reaches 7 %.
const HIDDEN: f64 = 1.1;

impl Surface {
    fn new(depth: &DepthImage, rig: &Rig) -> Option<Self> {
        let camera = rig.depth.as_ref()?;
        let mut nearest_m = vec![f32::INFINITY; CELLS[0] * CELLS[1]];
        let stride = (depth.width() / 160).max(1) as usize;
        for y in (0..depth.height()).step_by(stride) {
            for x in (0..depth.width()).step_by(stride) {
                let Some(z) = depth.at(x, y) else { continue };
                let point = camera.point_in_color(&Pixel::new(f64::from(x), f64::from(y)), f64::from(z));
                if let Some(cell) = rig.color.project(&point).and_then(|pixel| cell(&rig.color, &pixel)) {
                    nearest_m[cell] = nearest_m[cell].min(point.z as f32);
                }
            }
        }
        Some(Surface { nearest_m })
    }

    fn hides(&self, camera: &PinholeCamera, pixel: &Pixel, z: f64) -> bool {
        cell(camera, pixel).is_some_and(|cell| z > HIDDEN * f64::from(self.nearest_m[cell]))
    }
}

fn cell(camera: &PinholeCamera, pixel: &Pixel) -> Option<usize> {
    let at = |value: f64, size: u32, cells: usize| ((value + 0.5) / f64::from(size) * cells as f64) as usize;
    camera.contains(pixel).then(|| {
        let column = at(pixel.x, camera.width, CELLS[0]).min(CELLS[0] - 1);
        let row = at(pixel.y, camera.height, CELLS[1]).min(CELLS[1] - 1);
        row * CELLS[0] + column
    })
}

impl Predicted {
    pub(super) fn new(
        base_from_color: Isometry3,
        depth: Option<&DepthImage>,
        rig: &Rig,
        options: &ExpectedSigmaOptions,
        assumed_depth_m: [f64; 2],
    ) -> Self {
        let (points_in_color, surface) = match (depth, &rig.depth) {
            (Some(depth), Some(camera)) => (measured_points(depth, camera, options.grid), Surface::new(depth, rig)),
            _ => (assumed_points(&rig.color, assumed_depth_m, options.grid), None),
        };
        Predicted { base_from_color, points_in_color, surface }
    }
}

/// What the images are expected to show.
pub(super) struct Observations<'a> {
    /// One a posture.
    pub views: &'a [Predicted],
    /// Which of them should show the same.
    pub pairs: &'a [ImagePair],
    /// Corners of the board that were found.
    pub boards: Vec<BoardObservation>,
}

/// What a calibration of this data set should reach, by its nominal rig.
pub(super) fn expected_sigmas(
    dataset: &Dataset,
    seen: Observations<'_>,
    joints: &[JointCoverage],
    pairing: &PairingOptions,
    options: &ExpectedSigmaOptions,
) -> Result<ExpectedSigmas, CalibrationError> {
    let rig = &dataset.rig;
    let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let Observations { views, pairs, mut boards } = seen;
    let has_depth = views.iter().any(|view| view.surface.is_some());
    let mut tracks = Vec::new();
    if board_alone(BoardUse::Auto, boards.len(), dataset.len(), has_depth) {
        boards.iter_mut().for_each(|board| board.sigma_px = 1.0);
    } else {
        tracks = predicted_tracks(views, pairs, &rig.color, pairing, options.observations_per_point);
    }
    let corners = boards.iter().map(|board| board.corners.len()).sum();
    let data = Correspondences { postures, tracks, boards, ..Default::default() };
    let expected = expected_calibration(rig, &data, &options.expectation)?;
    let over = |value: &dyn Fn(&skclam_calibration::PoseCovariance) -> f64| {
        Statistics::of(&expected.poses.iter().map(value).collect::<Vec<_>>())
    };
    Ok(ExpectedSigmas {
        points: data.tracks.len(),
        observations: data.observation_count(),
        corners,
        pixel_sigma: options.expectation.pixel_sigma,
        depth_sigma_per_m2: has_depth.then_some(options.expectation.depth_sigma_per_m2),
        parameters: expected.parameters.iter().map(ExpectedParameter::of).collect(),
        free: expected.parameters.len(),
        rank: expected.identifiability.rank,
        identifiable: identifiable_combinations(rig, &expected),
        condition_number: Some(expected.identifiability.condition_number).filter(|number| number.is_finite()),
        not_identifiable: expected
            .identifiability
            .unobservable
            .iter()
            .map(|direction| direction.reason.clone())
            .collect(),
        camera_sigma_mm: over(&|pose| 1e3 * position_sigma_m(&pose.camera)),
        camera_sigma_deg: over(&|pose| orientation_sigma_rad(&pose.camera).to_degrees()),
        joints_to_move: joints_to_move(rig, &expected, joints, options),
    })
}

/// Variance that is left of a combination's tolerance where it counts as determined: half the standard deviation.
const IDENTIFIABLE_VARIANCE: f64 = 0.25;

/// Combinations of parameters that the data make known: directions in which the expected covariance, measured by the
/// tolerances, is small. What the residuals do not depend on is none, whatever its variance is taken as.
fn identifiable_combinations(rig: &Rig, expected: &ExpectedCalibration) -> usize {
    let tolerance = |k: usize| {
        let parameter = expected.parameters[k].parameter;
        stated_sigma(rig, parameter).unwrap_or_else(|| default_sigma(rig, parameter))
    };
    let count = expected.parameters.len();
    let relative = DMatrix::from_fn(count, count, |i, j| expected.covariance[(i, j)] / (tolerance(i) * tolerance(j)));
    let left = relative.symmetric_eigenvalues();
    left.iter().filter(|&&variance| variance < IDENTIFIABLE_VARIANCE).count().min(expected.identifiability.rank)
}

/// Each image's points and where its neighbours show them.
fn predicted_tracks(
    views: &[Predicted],
    pairs: &[ImagePair],
    camera: &PinholeCamera,
    pairing: &PairingOptions,
    observations_per_point: usize,
) -> Vec<Track> {
    let mut neighbors: Vec<Vec<usize>> = vec![vec![]; views.len()];
    for pair in pairs {
        neighbors[pair.a].push(pair.b);
        neighbors[pair.b].push(pair.a);
    }
    let of_view = |a: usize| -> Vec<Track> {
        let from = &views[a];
        let depth_of = |posture: usize, point: &Point3| views[posture].surface.as_ref().map(|_| point.z);
        let observation = |posture: usize, pixel: Pixel, point: &Point3| TrackObservation {
            posture,
            pixel,
            covariance: isotropic_covariance(1.0),
            depth_m: depth_of(posture, point),
            depth_slope: [0.0; 2],
        };
        let others: Vec<(usize, Isometry3)> =
            neighbors[a].iter().map(|&b| (b, views[b].base_from_color.inverse() * from.base_from_color)).collect();
        let follow = |(number, point): (usize, &Point3)| {
            let own = camera.project(point).filter(|pixel| camera.contains(pixel))?;
            let mut observations = vec![observation(a, own, point)];
            for step in 0..others.len() {
                if observations.len() >= observations_per_point {
                    break;
                }
                // In turn, so that no neighbour is preferred.
                let (b, b_from_a) = &others[(number + step) % others.len()];
                let Some((pixel, in_b)) = shown_to(point, b_from_a, camera, pairing) else { continue };
                if !views[*b].surface.as_ref().is_some_and(|surface| surface.hides(camera, &pixel, in_b.z)) {
                    observations.push(observation(*b, pixel, &in_b));
                }
            }
            (observations.len() > 1).then_some(Track { observations })
        };
        from.points_in_color.iter().enumerate().filter_map(follow).collect()
    };
    (0..views.len()).into_par_iter().map(of_view).collect::<Vec<_>>().concat()
}

impl ExpectedParameter {
    fn of(estimate: &ParameterEstimate) -> Self {
        let (factor, unit) = file_unit(estimate.parameter.unit());
        ExpectedParameter {
            name: estimate.parameter.to_string(),
            sigma: estimate.sigma.map(|sigma| sigma * factor),
            unit,
            note: estimate.note.clone(),
        }
    }
}

/// Parameters that the postures determine badly blame the joint beside them that moved least, unless that moved amply.
fn joints_to_move(
    rig: &Rig,
    expected: &ExpectedCalibration,
    joints: &[JointCoverage],
    options: &ExpectedSigmaOptions,
) -> Vec<JointToMove> {
    let fraction = |joint: &JointCoverage| {
        let ample = if joint.unit == "deg" { options.ample_joint_range_deg } else { options.ample_joint_range_mm };
        (joint.max - joint.min) / ample
    };
    let mut blamed: Vec<Vec<String>> = vec![vec![]; joints.len()];
    for estimate in &expected.parameters {
        let Parameter::Chain(id) = estimate.parameter else { continue };
        // Half of what the maker's tolerance says already is no calibration.
        let known = estimate.sigma.is_some_and(|sigma| sigma < 0.5 * default_sigma(rig, estimate.parameter));
        let beside = id.joint.saturating_sub(1)..(id.joint + 2).min(joints.len());
        let least = beside.min_by(|&a, &b| fraction(&joints[a]).total_cmp(&fraction(&joints[b])).then(a.cmp(&b)));
        if let Some(joint) = least.filter(|&joint| !known && fraction(&joints[joint]) < 1.0) {
            blamed[joint].push(estimate.parameter.to_string());
        }
    }
    let blamed_joints = joints.iter().zip(blamed).filter(|(_, parameters)| !parameters.is_empty());
    blamed_joints
        .map(|(joint, parameters)| JointToMove {
            joint: joint.joint.clone(),
            range: joint.max - joint.min,
            unit: joint.unit,
            parameters,
        })
        .collect()
}
