//! Sizes of all residuals, and what their own points leave them of their degrees of freedom.

use crate::bundle::observations::{Observations, Sighting};
use crate::bundle::reduced::{Chunk, point_covariance};
use crate::bundle::state::PlacedBoard;
use crate::bundle::view::View;
use nalgebra::{Matrix3, Vector2};
use rayon::prelude::*;
use skclam_geometry::Point3;

/// Size and leverage of one sight's residuals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ResidualSize {
    pub posture: u32,
    /// From where the point should appear to where it was seen, px, not whitened; infinite behind the camera.
    pub way_px: Vector2<f64>,
    /// Norm of the pixel residual in sigmas; infinite behind the camera.
    pub pixel: f64,
    /// Its two degrees of freedom less what its own point takes.
    pub pixel_freedom: f64,
    /// Depth residual in sigmas and what is left of its degree of freedom.
    pub depth: Option<(f64, f64)>,
}

impl ResidualSize {
    pub(crate) fn distance_px(&self) -> f64 {
        self.way_px.norm()
    }
}

/// `spread`: covariance of the point in the base frame.
fn residual_size(view: &View<'_>, sighting: &Sighting, point: &Point3, spread: &Matrix3<f64>) -> ResidualSize {
    let posture = sighting.posture;
    let frame = view.frame(sighting);
    let in_camera = frame.in_camera(point);
    let Some((pixel, by_point)) = view.camera.project_with_point_jacobian(&in_camera) else {
        return ResidualSize {
            posture,
            way_px: Vector2::repeat(f64::INFINITY),
            pixel: f64::INFINITY,
            pixel_freedom: 2.0,
            depth: None,
        };
    };
    let difference = sighting.pixel - pixel;
    let size = sighting.size(&difference) / view.scales.pixel;
    let by_base = by_point * frame.camera_from_base;
    let pixel_spread = by_base * spread * by_base.transpose();
    let [xx, xy, yy] = sighting.information;
    let traced = xx * pixel_spread[(0, 0)] + 2.0 * xy * pixel_spread[(0, 1)] + yy * pixel_spread[(1, 1)];
    let leverage = traced * view.scales.loss.weight(size) / (view.scales.pixel * view.scales.pixel);
    let depth = (sighting.depth_m > 0.0).then(|| {
        let (u, slope) = view.depth_residual(sighting, &in_camera);
        let along = frame.camera_from_base.row(2).transpose();
        let leverage = view.scales.loss.weight(u) * along.dot(&(spread * along)) * slope * slope;
        (u, (1.0 - leverage).clamp(0.0, 1.0))
    });
    ResidualSize { posture, way_px: difference, pixel: size, pixel_freedom: (2.0 - leverage).clamp(0.0, 2.0), depth }
}

/// All residuals, tracks first, then board corners.
pub(crate) fn residual_sizes(
    observations: &Observations,
    chunks: &[Chunk],
    view: &View<'_>,
    points: &[Point3],
    board: Option<&PlacedBoard>,
) -> Vec<ResidualSize> {
    let of_chunk = |&(from, to): &Chunk| -> Vec<ResidualSize> {
        let mut sizes = Vec::with_capacity(observations.offsets[to] - observations.offsets[from]);
        for (track, point) in (from..to).zip(&points[from..to]) {
            let sightings = observations.track(track);
            let spread = point_covariance(view, sightings, point).unwrap_or_else(Matrix3::zeros);
            sizes.extend(sightings.iter().map(|sighting| residual_size(view, sighting, point, &spread)));
        }
        sizes
    };
    let mut sizes = chunks.par_iter().map(of_chunk).collect::<Vec<_>>().concat();
    if let Some(board) = board {
        sizes.extend(
            observations
                .corners
                .iter()
                .map(|corner| residual_size(view, &corner.sighting, &board.point_in_base(corner), &Matrix3::zeros())),
        );
    }
    sizes
}
