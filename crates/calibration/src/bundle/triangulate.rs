//! Scene points from known camera poses: rays, robustly chosen, then refined.

use crate::bundle::observations::Observation;
use crate::bundle::projection_model::ProjectionModel;
use nalgebra::{Matrix3, Vector3};
use skclam_geometry::Point3;

/// Rays that meet at less than this angle carry no information about depth, rad (0.15 deg).
const SMALLEST_PARALLAX: f64 = 2.6e-3;
/// Pairs of rays from which a point is guessed where all rays together do not fit.
const MAX_GUESSES: usize = 21;
/// A point fits a track when every observation's cost is at most that of so many sigmas.
const FITS_SIGMAS: f64 = 4.5;

/// Centre and direction.
type Ray = (Point3, Vector3<f64>);

impl ProjectionModel<'_> {
    /// A point for a track; `None` where the rays do not meet in front of the cameras, or at too small an angle.
    /// `known` is one more guess, and a good one.
    pub(crate) fn triangulate(&self, track: &[Observation], known: Option<&Point3>) -> Option<Point3> {
        let rays: Vec<Ray> = track
            .iter()
            .map(|observation| {
                let frame = self.frame(observation);
                let direction = frame.camera_from_base.tr_mul(&self.camera.unproject(&observation.pixel)).normalize();
                (frame.center_in_base, direction)
            })
            .collect();
        let wide = |a: &Ray, b: &Ray| a.1.cross(&b.1).norm_squared() >= SMALLEST_PARALLAX * SMALLEST_PARALLAX;
        let has_parallax = rays.iter().enumerate().any(|(k, a)| rays[k + 1..].iter().any(|b| wide(a, b)));
        let measured = || track.iter().filter(|observation| observation.depth_m > 0.0).take(4);
        if !has_parallax && measured().next().is_none() {
            return None;
        }
        let mut guesses: Vec<Point3> = known.copied().into_iter().collect();
        if has_parallax {
            guesses.extend(meet(&rays));
        }
        let first = self.best(track, guesses).map(|(_, point)| self.refine(track, point));
        if let Some((_, point)) = first.filter(|(_, point)| known.is_some() || self.fits(track, point)) {
            return Some(point);
        }
        let mut guesses = Vec::new();
        if has_parallax && rays.len() > 2 {
            let pairs = (0..rays.len()).flat_map(|a| (a + 1..rays.len()).map(move |b| (a, b)));
            let all: Vec<_> = pairs.filter(|(a, b)| wide(&rays[*a], &rays[*b])).collect();
            // Evenly spread over all pairs, so that a few wrong observations do not spoil every guess.
            let chosen = all.iter().step_by(all.len().div_ceil(MAX_GUESSES).max(1));
            guesses.extend(chosen.filter_map(|(a, b)| meet(&[rays[*a], rays[*b]])));
        }
        guesses.extend(measured().map(|observation| {
            let z = self.depth.offset_m + self.depth.scale * observation.depth_m;
            self.frame(observation).in_base(&Point3::from(self.camera.unproject(&observation.pixel) * z))
        }));
        let second = self.best(track, guesses).map(|(_, point)| self.refine(track, point));
        first.into_iter().chain(second).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, point)| point)
    }

    /// The cheapest of the guesses that two cameras have before them.
    fn best(&self, track: &[Observation], guesses: Vec<Point3>) -> Option<(f64, Point3)> {
        let in_front = |point: &Point3| track.iter().filter(|s| self.frame(s).in_camera(point).z > 1e-3).count();
        guesses
            .into_iter()
            .filter(|point| point.coords.iter().all(|x| x.is_finite()) && in_front(point) >= 2)
            .map(|point| (self.cost(track, &point), point))
            .min_by(|a, b| a.0.total_cmp(&b.0))
    }

    fn fits(&self, track: &[Observation], point: &Point3) -> bool {
        let most = self.scales.loss.rho(FITS_SIGMAS);
        let alone = |observation: &Observation| Observation { pixel_weight: 1.0, depth_weight: 1.0, ..*observation };
        track.iter().all(|observation| self.cost_of(&alone(observation), point) <= most)
    }

    /// Damped Gauss-Newton on one point, cameras fixed; its cost and the point.
    pub(crate) fn refine(&self, track: &[Observation], start: Point3) -> (f64, Point3) {
        let (mut point, mut cost, mut damping) = (start, self.cost(track, &start), 1e-4);
        for _ in 0..12 {
            let mut normal = Matrix3::zeros();
            let mut rhs = Vector3::zeros();
            for linear in track.iter().filter_map(|observation| self.linearize(observation, &point)) {
                normal += linear.normal;
                rhs += linear.rhs;
            }
            let damped = normal + Matrix3::from_diagonal(&normal.diagonal()) * damping;
            let Some(step) = damped.cholesky().map(|factor| factor.solve(&rhs)) else { break };
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
        (cost, point)
    }
}

/// The point nearest to all rays.
fn meet(rays: &[Ray]) -> Option<Point3> {
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (center, direction) in rays {
        let across = Matrix3::identity() - direction * direction.transpose();
        normal += across;
        right += across * center.coords;
    }
    normal.cholesky().map(|factor| Point3::from(factor.solve(&right)))
}
