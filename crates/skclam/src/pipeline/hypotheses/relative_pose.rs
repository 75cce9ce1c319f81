//! How a camera turned between two images, by its intrinsics and verified matches alone.
//!
//! The five unknowns of `camera_a_from_camera_b` (rotation, and the direction of the translation) minimise robust
//! Sampson distances (Hartley and Zisserman, section 11.4.3) from several starts: both rotations of the essential
//! matrix `K^T F K`, and rotations in the image plane, as a plane in view leaves `F` undetermined but not the pose. A
//! plane leaves two poses: rotations that fit as well are kept as alternatives.

use nalgebra::{Matrix3, SMatrix, SVector, Translation3, Unit, UnitQuaternion, Vector2, Vector3};
use skclam_geometry::{FundamentalMatrix, Isometry3, PinholeCamera, Pixel};

/// Matches that take part at most.
const MATCHES: usize = 120;
/// Steps of one minimisation at most.
const STEPS: usize = 15;
/// Two fits are equally good when their robust costs differ by less than this factor.
const AS_GOOD: f64 = 1.1;
/// Rotations closer than this are one (2 deg).
const SAME_RAD: f64 = 0.035;
/// Points before both cameras: a smaller part of all means the twisted pair or the reflected translation.
const MIN_IN_FRONT: f64 = 0.7;

/// The rotation between two views, with its rival where a plane leaves two.
#[derive(Debug, Clone)]
pub(super) struct RelativeRotation {
    /// `camera_a_from_camera_b`, the best first.
    pub candidates: Vec<UnitQuaternion<f64>>,
    /// Median Sampson distance with the unchanged intrinsics, px.
    pub calibrated_px: f64,
    /// Median Sampson distance of the fundamental matrix, which needs no intrinsics, px.
    pub uncalibrated_px: f64,
}

/// `ends`: undistorted pixels in A and B; `fundamental`: of RANSAC, `in_a^T F in_b = 0`.
pub(super) fn relative_rotation(
    camera: &PinholeCamera,
    ends: &[(Pixel, Pixel)],
    fundamental: &Matrix3<f64>,
) -> RelativeRotation {
    let ideal = PinholeCamera { distortion: Default::default(), ..*camera };
    let stride = ends.len().div_ceil(MATCHES).max(1);
    let sample: Vec<(Pixel, Pixel)> = ends.iter().copied().step_by(stride).collect();
    let view = TwoViews { camera: ideal, ends: &sample };
    let mut fits: Vec<(f64, Isometry3)> = view
        .starts(fundamental)
        .into_iter()
        .map(|start| {
            let pose = view.minimize(start);
            (view.cost(&pose), pose)
        })
        .filter(|(cost, _)| cost.is_finite())
        .collect();
    fits.sort_by(|x, y| x.0.total_cmp(&y.0));
    let in_front: Vec<_> = fits.iter().filter(|(_, pose)| view.part_in_front(pose) >= MIN_IN_FRONT).copied().collect();
    // Without a baseline nothing has a depth, and the rotation is right all the same.
    let fits = if in_front.is_empty() { fits } else { in_front };
    let mut candidates: Vec<UnitQuaternion<f64>> = Vec::new();
    let least = fits.first().map_or(f64::INFINITY, |(cost, _)| *cost);
    for (_, pose) in fits.iter().filter(|(cost, _)| *cost <= least * AS_GOOD) {
        if candidates.iter().all(|known| known.angle_to(&pose.rotation) > SAME_RAD) {
            candidates.push(pose.rotation);
        }
    }
    let uncalibrated = FundamentalMatrix(*fundamental);
    let calibrated_px = fits.first().map_or(f64::INFINITY, |(_, pose)| median(view.residuals(pose)));
    let uncalibrated_px = median(sample.iter().map(|(a, b)| uncalibrated.sampson_distance(a, b)).collect());
    RelativeRotation { candidates, calibrated_px, uncalibrated_px }
}

struct TwoViews<'a> {
    camera: PinholeCamera,
    ends: &'a [(Pixel, Pixel)],
}

impl TwoViews<'_> {
    fn starts(&self, fundamental: &Matrix3<f64>) -> Vec<Isometry3> {
        let mut starts = self.of_essential(fundamental);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.roll());
        let shift = self.shift(&turn);
        for rotation in [turn, shift * turn] {
            for direction in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.7, 0.7, 0.0], [0.7, -0.7, 0.0]] {
                starts.push(Isometry3::from_parts(Translation3::from(Vector3::from(direction).normalize()), rotation));
            }
        }
        starts
    }

    /// Both rotations of the essential matrix (Hartley and Zisserman, section 9.6.2); the translation's sign is no
    /// matter here.
    fn of_essential(&self, fundamental: &Matrix3<f64>) -> Vec<Isometry3> {
        let k = self.camera.matrix();
        let svd = (k.transpose() * fundamental * k).svd(true, true);
        let (Some(mut u), Some(mut v_t)) = (svd.u, svd.v_t) else { return Vec::new() };
        let least = svd.singular_values.imin();
        // The null vectors belong last.
        u.swap_columns(least, 2);
        v_t.swap_rows(least, 2);
        if u.determinant() < 0.0 {
            u.neg_mut();
        }
        if v_t.determinant() < 0.0 {
            v_t.neg_mut();
        }
        let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        let translation = Translation3::from(u.column(2).into_owned());
        [w, w.transpose()]
            .map(|w| {
                let rotation = nalgebra::Rotation3::from_matrix_unchecked(u * w * v_t);
                Isometry3::from_parts(translation, UnitQuaternion::from_rotation_matrix(&rotation))
            })
            .to_vec()
    }

    /// The turn in the image plane that takes B's pixels to A's, least squares.
    fn roll(&self) -> f64 {
        let count = self.ends.len().max(1) as f64;
        let sum =
            self.ends.iter().fold([Vector2::zeros(); 2], |[a, b], (in_a, in_b)| [a + in_a.coords, b + in_b.coords]);
        let [mean_a, mean_b] = sum.map(|sum| sum / count);
        let (mut sine, mut cosine) = (0.0, 0.0);
        for (in_a, in_b) in self.ends {
            let (a, b) = (in_a.coords - mean_a, in_b.coords - mean_b);
            sine += b.perp(&a);
            cosine += b.dot(&a);
        }
        f64::atan2(sine, cosine)
    }

    /// What turns the mean direction of B, turned already, to that of A.
    fn shift(&self, turn: &UnitQuaternion<f64>) -> UnitQuaternion<f64> {
        let mean = |directions: &mut dyn Iterator<Item = Vector3<f64>>| {
            directions.fold(Vector3::zeros(), |sum, direction| sum + direction.normalize())
        };
        let a = mean(&mut self.ends.iter().map(|(in_a, _)| self.camera.unproject(in_a)));
        let b = mean(&mut self.ends.iter().map(|(_, in_b)| turn * self.camera.unproject(in_b)));
        UnitQuaternion::rotation_between(&b, &a).unwrap_or_else(UnitQuaternion::identity)
    }

    fn residuals(&self, pose: &Isometry3) -> Vec<f64> {
        let fundamental = FundamentalMatrix::from_pose(&self.camera, &self.camera, pose);
        self.ends.iter().map(|(in_a, in_b)| fundamental.sampson_distance(in_a, in_b)).collect()
    }

    /// The sum of Cauchy's losses at one pixel: comparable between starts, as its scale is fixed.
    fn cost(&self, pose: &Isometry3) -> f64 {
        self.residuals(pose).iter().map(|r| (1.0 + r * r).ln()).sum()
    }

    /// Levenberg-Marquardt with Cauchy weights over rotation and direction.
    fn minimize(&self, start: Isometry3) -> Isometry3 {
        const STEP: f64 = 1e-6;
        let (mut pose, mut cost, mut damping) = (start, self.cost(&start), 1e-3);
        for _ in 0..STEPS {
            let residuals = self.residuals(&pose);
            let columns: [Vec<f64>; 5] = std::array::from_fn(|k| {
                let mut delta = SVector::<f64, 5>::zeros();
                delta[k] = STEP;
                self.residuals(&moved(&pose, &delta))
            });
            let (mut normal, mut gradient) = (SMatrix::<f64, 5, 5>::zeros(), SVector::<f64, 5>::zeros());
            for (at, r) in residuals.iter().enumerate() {
                let row = SVector::<f64, 5>::from_fn(|k, _| (columns[k][at] - r) / STEP);
                let weight = 1.0 / (1.0 + r * r);
                normal += row * row.transpose() * weight;
                gradient -= row * (r * weight);
            }
            let damped = normal + SMatrix::<f64, 5, 5>::from_diagonal(&normal.diagonal()) * damping;
            let Some(step) = damped.cholesky().map(|factor| factor.solve(&gradient)) else { break };
            let next = moved(&pose, &step);
            let next_cost = self.cost(&next);
            if next_cost < cost {
                let settled = cost - next_cost < 1e-4 * cost;
                (pose, cost, damping) = (next, next_cost, damping * 0.2);
                if settled {
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
        pose
    }

    /// The part of the points that lie before both cameras, for the better sign of the translation.
    fn part_in_front(&self, pose: &Isometry3) -> f64 {
        let (mut plus, mut minus) = (0usize, 0usize);
        for (in_a, in_b) in self.ends {
            let (a, b) = (self.camera.unproject(in_a), pose.rotation * self.camera.unproject(in_b));
            // depth_a a = depth_b b + t, least squares.
            let t = pose.translation.vector;
            let (aa, bb, ab) = (a.norm_squared(), b.norm_squared(), a.dot(&b));
            let determinant = aa * bb - ab * ab;
            let depth_a = (a.dot(&t) * bb - b.dot(&t) * ab) / determinant;
            let depth_b = (a.dot(&t) * ab - b.dot(&t) * aa) / determinant;
            plus += usize::from(depth_a > 0.0 && depth_b > 0.0);
            minus += usize::from(depth_a < 0.0 && depth_b < 0.0);
        }
        plus.max(minus) as f64 / self.ends.len().max(1) as f64
    }
}

/// A left rotation by the first three, and the direction of the translation moved along its tangents by the others.
fn moved(pose: &Isometry3, delta: &SVector<f64, 5>) -> Isometry3 {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(delta[0], delta[1], delta[2])) * pose.rotation;
    let direction = Unit::new_normalize(pose.translation.vector);
    let other = if direction.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let u = direction.cross(&other).normalize();
    let v = direction.cross(&u);
    let turned = (direction.into_inner() + u * delta[3] + v * delta[4]).normalize();
    Isometry3::from_parts(Translation3::from(turned), rotation)
}

/// Median of the sizes; infinite for none, and where half are no numbers.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.iter_mut().for_each(|value| *value = if value.is_nan() { f64::INFINITY } else { value.abs() });
    let middle = values.len() / 2;
    if values.is_empty() {
        return f64::INFINITY;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_geometry::Point3;

    /// Matches of points before two cameras; all on one plane or not.
    fn seen(pose: &Isometry3, plane: bool) -> (PinholeCamera, Vec<(Pixel, Pixel)>) {
        let camera = PinholeCamera::from_hfov(480, 270, 70f64.to_radians());
        let ends = (0..80).filter_map(|k| {
            let (x, y) = (f64::from(k % 10) * 0.1 - 0.45, f64::from(k / 10) * 0.07 - 0.25);
            let z = if plane { 1.0 + 0.2 * x } else { 0.9 + 0.31 * f64::from(k * 7 % 11) / 11.0 };
            let point = Point3::new(x * z, y * z, z);
            Some((camera.project(&(pose * point))?, camera.project(&point)?))
        });
        (camera, ends.collect())
    }

    #[test]
    fn the_rotation_is_found_with_and_without_a_plane() {
        let pose = Isometry3::new(Vector3::new(0.3, -0.1, 0.05), Vector3::new(0.1, -0.25, 1.9));
        for plane in [false, true] {
            let (camera, ends) = seen(&pose, plane);
            // A matrix that says nothing: the other starts have to find it.
            for fundamental in [FundamentalMatrix::from_pose(&camera, &camera, &pose).0, Matrix3::identity()] {
                let found = relative_rotation(&camera, &ends, &fundamental);
                let error = found.candidates.iter().map(|r| r.angle_to(&pose.rotation)).fold(f64::INFINITY, f64::min);
                assert!(error < 2e-3, "plane {plane}: {error} rad of {} candidates", found.candidates.len());
                assert!(found.calibrated_px < 0.01, "{}", found.calibrated_px);
                assert!(plane || found.candidates.len() == 1, "{} candidates", found.candidates.len());
            }
        }
    }

    #[test]
    fn wrong_intrinsics_show_in_the_pair_alone() {
        let pose = Isometry3::new(Vector3::new(0.3, -0.1, 0.05), Vector3::new(0.3, -0.4, 1.9));
        let (camera, ends) = seen(&pose, false);
        let fundamental = FundamentalMatrix::from_pose(&camera, &camera, &pose).0;
        let wrong = PinholeCamera { fx: camera.fx * 2.0, ..camera };
        let found = relative_rotation(&wrong, &ends, &fundamental);
        assert!(found.uncalibrated_px < 1e-6, "{}", found.uncalibrated_px);
        assert!(found.calibrated_px > 1.0, "{}", found.calibrated_px);
    }
}
