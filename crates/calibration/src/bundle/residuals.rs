//! Sizes of all residuals, and what their own points leave them of their degrees of freedom.

use crate::bundle::observations::{Observation, Observations};
use crate::bundle::projection_model::ProjectionModel;
use crate::bundle::reduced::{Chunk, point_covariance};
use crate::bundle::state::PlacedBoard;
use nalgebra::{Matrix3, Vector2};
use rayon::prelude::*;
use skclam_geometry::Point3;

/// Size and leverage of one observation's residuals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ResidualSize {
    pub posture: u32,
    /// From where the point should appear to where it was seen, px, not whitened; infinite behind the camera.
    pub residual_px: Vector2<f64>,
    /// Norm of the pixel residual in sigmas; infinite behind the camera.
    pub pixel: f64,
    /// Its two degrees of freedom less what its own point takes.
    pub pixel_dof: f64,
    /// Depth residual in sigmas and what is left of its degree of freedom.
    pub depth: Option<(f64, f64)>,
}

impl ResidualSize {
    pub(crate) fn distance_px(&self) -> f64 {
        self.residual_px.norm()
    }
}

/// `covariance`: covariance of the point in the base frame.
fn residual_size(
    view: &ProjectionModel<'_>,
    observation: &Observation,
    point: &Point3,
    covariance: &Matrix3<f64>,
) -> ResidualSize {
    let posture = observation.posture;
    let frame = view.frame(observation);
    let in_camera = frame.in_camera(point);
    let Some((pixel, by_point)) = view.camera.project_with_point_jacobian(&in_camera) else {
        return ResidualSize {
            posture,
            residual_px: Vector2::repeat(f64::INFINITY),
            pixel: f64::INFINITY,
            pixel_dof: 2.0,
            depth: None,
        };
    };
    let difference = observation.pixel - pixel;
    let size = observation.size(&difference) / view.scales.pixel;
    let by_base = by_point * frame.camera_from_base;
    let pixel_spread = by_base * covariance * by_base.transpose();
    let [xx, xy, yy] = observation.information;
    let traced = xx * pixel_spread[(0, 0)] + 2.0 * xy * pixel_spread[(0, 1)] + yy * pixel_spread[(1, 1)];
    let weight = view.scales.loss.weight(size) * observation.pixel_weight;
    let leverage = traced * weight / (view.scales.pixel * view.scales.pixel);
    let depth = (observation.depth_m > 0.0).then(|| {
        let (u, slope) = view.depth_residual(observation, &in_camera);
        let along = frame.camera_from_base.row(2).transpose();
        let weight = view.scales.loss.weight(u) * observation.depth_weight;
        let leverage = weight * along.dot(&(covariance * along)) * slope * slope;
        (u, (1.0 - leverage).clamp(0.0, 1.0))
    });
    ResidualSize { posture, residual_px: difference, pixel: size, pixel_dof: (2.0 - leverage).clamp(0.0, 2.0), depth }
}

/// All residuals, tracks first, then board corners.
pub(crate) fn residual_sizes(
    observations: &Observations,
    chunks: &[Chunk],
    view: &ProjectionModel<'_>,
    points: &[Point3],
    board: Option<&PlacedBoard>,
) -> Vec<ResidualSize> {
    let of_chunk = |&(from, to): &Chunk| -> Vec<ResidualSize> {
        let mut sizes = Vec::with_capacity(observations.offsets[to] - observations.offsets[from]);
        for (track, point) in (from..to).zip(&points[from..to]) {
            let observations = observations.track(track);
            let covariance = point_covariance(view, observations, point).unwrap_or_else(Matrix3::zeros);
            sizes.extend(observations.iter().map(|observation| residual_size(view, observation, point, &covariance)));
        }
        sizes
    };
    let mut sizes = chunks.par_iter().map(of_chunk).collect::<Vec<_>>().concat();
    if let Some(board) = board {
        sizes.extend(
            observations.corners.iter().map(|corner| {
                residual_size(view, &corner.observation, &board.point_in_base(corner), &Matrix3::zeros())
            }),
        );
    }
    sizes
}
