//! Scene points from known camera poses: rays, robustly chosen, then refined.

use crate::bundle::observations::Sighting;
use crate::{DepthCorrection, Loss};
use nalgebra::{Matrix3, Vector3};
use skclam_geometry::{Isometry3, PinholeCamera, Point3};

/// Rays that meet at less than this angle say nothing about depth, rad (0.15 deg).
const SMALLEST_PARALLAX: f64 = 2.6e-3;
/// Pairs of rays from which a point is guessed where all rays together do not fit.
const MOST_GUESSES: usize = 21;

/// What residuals are measured with.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scales {
    pub loss: Loss,
    /// Sigma of a whitened pixel coordinate.
    pub pixel: f64,
    /// `s` of `sigma = s z^2`: the sigma of an inverse depth.
    pub depth: f64,
}

/// The cameras that look at a track.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub camera: &'a PinholeCamera,
    pub poses: &'a [Isometry3],
    pub depth: DepthCorrection,
    pub scales: Scales,
}

impl View<'_> {
    /// Robust cost of a point; what lies behind a camera costs as an outlier.
    pub(crate) fn cost(&self, track: &[Sighting], point: &Point3) -> f64 {
        track.iter().map(|sighting| self.cost_of(sighting, point)).sum()
    }

    pub(crate) fn cost_of(&self, sighting: &Sighting, point: &Point3) -> f64 {
        let in_camera = self.poses[sighting.posture as usize].inverse_transform_point(point);
        let loss = self.scales.loss;
        let Some(pixel) = self.camera.project(&in_camera) else { return 2.0 * loss.rho(BEHIND) };
        let u = sighting.whiten(sighting.pixel - pixel).norm() / self.scales.pixel;
        let depth = if sighting.depth_m > 0.0 { loss.rho(self.depth_residual(sighting, in_camera.z).0) } else { 0.0 };
        loss.rho(u) + depth
    }

    /// How much farther the sensor saw a point than it should have at `z`, in sigmas, and by how much that falls a metre of z.
    ///
    /// It is taken in *inverse* depth of the sensor's own reading, where the noise `s z^2` of a depth is the constant `s`: weights made of
    /// noisy depths would count near readings more than far ones and shrink the world, and a residual in corrected metres would shrink with the
    /// depth's scale. The mean of the reciprocal of a reading with normal noise, `1/z + s^2 z`, is allowed for.
    pub(crate) fn depth_residual(&self, sighting: &Sighting, z: f64) -> (f64, f64) {
        let s = self.scales.depth;
        let expected = ((z - self.depth.offset_m) / self.depth.scale).max(NEAREST_M);
        let measured = 1.0 / sighting.depth_m - s * s * sighting.depth_m;
        ((1.0 / expected - measured) / s, 1.0 / (expected * expected * self.depth.scale * s))
    }

    /// A point for a track; `None` where the rays do not meet in front of the cameras, or at too small an angle.
    pub(crate) fn triangulate(&self, track: &[Sighting]) -> Option<Point3> {
        let rays: Vec<(Point3, Vector3<f64>, &Sighting)> = track
            .iter()
            .map(|sighting| {
                let pose = &self.poses[sighting.posture as usize];
                let direction = pose.rotation * self.camera.unproject(&sighting.pixel).normalize();
                (Point3::from(pose.translation.vector), direction, sighting)
            })
            .collect();
        let has_depth = track.iter().any(|sighting| sighting.depth_m > 0.0);
        let widest = rays
            .iter()
            .enumerate()
            .flat_map(|(k, a)| rays[k + 1..].iter().map(move |b| a.1.cross(&b.1).norm()))
            .fold(0.0, f64::max);
        if widest < SMALLEST_PARALLAX && !has_depth {
            return None;
        }
        let mut guesses: Vec<Point3> = Vec::new();
        if widest >= SMALLEST_PARALLAX {
            guesses.extend(meet(&rays.iter().map(|(c, d, _)| (*c, *d)).collect::<Vec<_>>()));
        }
        if rays.len() > 2 {
            let pairs = (0..rays.len()).flat_map(|a| (a + 1..rays.len()).map(move |b| (a, b)));
            let pairs = pairs.filter(|(a, b)| rays[*a].1.cross(&rays[*b].1).norm() >= SMALLEST_PARALLAX);
            let all: Vec<_> = pairs.collect();
            // Evenly spread over all pairs, so that a few wrong sights do not spoil every guess.
            let stride = all.len().div_ceil(MOST_GUESSES).max(1);
            let chosen = all.iter().step_by(stride);
            guesses.extend(chosen.filter_map(|(a, b)| meet(&[(rays[*a].0, rays[*a].1), (rays[*b].0, rays[*b].1)])));
        }
        if has_depth {
            let measured = track.iter().filter(|sighting| sighting.depth_m > 0.0).take(4);
            guesses.extend(measured.map(|sighting| {
                let z = self.depth.offset_m + self.depth.scale * sighting.depth_m;
                let in_camera = self.camera.unproject(&sighting.pixel) * z;
                self.poses[sighting.posture as usize] * Point3::from(in_camera)
            }));
        }
        let in_front = |point: &Point3| {
            track.iter().filter(|s| self.poses[s.posture as usize].inverse_transform_point(point).z > 1e-3).count()
        };
        let best = guesses
            .into_iter()
            .filter(|point| point.coords.iter().all(|x| x.is_finite()) && in_front(point) >= 2)
            .map(|point| (self.cost(track, &point), point))
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        Some(self.refine(track, best.1))
    }

    /// Damped Gauss-Newton on one point, cameras fixed.
    pub(crate) fn refine(&self, track: &[Sighting], start: Point3) -> Point3 {
        let (mut point, mut cost, mut damping) = (start, self.cost(track, &start), 1e-4);
        for _ in 0..12 {
            let mut information = Matrix3::zeros();
            let mut descent = Vector3::zeros();
            for sighting in track {
                let pose = &self.poses[sighting.posture as usize];
                if let Some(linear) = linearize_sighting(self, sighting, &pose.inverse_transform_point(&point)) {
                    let rotation = pose.rotation.to_rotation_matrix();
                    information += rotation.matrix() * linear.information * rotation.matrix().transpose();
                    descent += rotation * linear.descent;
                }
            }
            let damped = information + Matrix3::from_diagonal(&information.diagonal()) * damping;
            let Some(step) = damped.cholesky().map(|factor| factor.solve(&descent)) else { break };
            let moved = point + step;
            let moved_cost = self.cost(track, &moved);
            if moved_cost <= cost {
                let gain = cost - moved_cost;
                (point, cost) = (moved, moved_cost);
                damping *= 0.1;
                if gain <= 1e-9 * cost {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
        point
    }
}

/// No sensor reads less, m.
const NEAREST_M: f64 = 1e-3;

/// Residual, in sigmas, of what lies behind the camera.
pub(crate) const BEHIND: f64 = 1e3;

/// A sighting's weighted normal equations by the point's position in the camera.
pub(crate) struct SightingInformation {
    pub information: Matrix3<f64>,
    pub descent: Vector3<f64>,
}

/// `None` behind the camera.
pub(crate) fn linearize_sighting(
    view: &View<'_>,
    sighting: &Sighting,
    in_camera: &Point3,
) -> Option<SightingInformation> {
    let projection = view.camera.project_with_jacobian(in_camera)?;
    let residual = sighting.whiten(sighting.pixel - projection.pixel) / view.scales.pixel;
    let jacobian = sighting.whitener() * projection.by_point / view.scales.pixel;
    let weight = view.scales.loss.weight(residual.norm());
    let mut information = jacobian.transpose() * jacobian * weight;
    let mut descent = jacobian.transpose() * residual * weight;
    if sighting.depth_m > 0.0 {
        let (residual, slope) = view.depth_residual(sighting, in_camera.z);
        let weight = view.scales.loss.weight(residual);
        information[(2, 2)] += weight * slope * slope;
        descent.z += weight * residual * slope;
    }
    Some(SightingInformation { information, descent })
}

/// The point nearest to all rays.
fn meet(rays: &[(Point3, Vector3<f64>)]) -> Option<Point3> {
    let mut information = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (center, direction) in rays {
        let across = Matrix3::identity() - direction * direction.transpose();
        information += across;
        right += across * center.coords;
    }
    information.cholesky().map(|factor| Point3::from(factor.solve(&right)))
}
