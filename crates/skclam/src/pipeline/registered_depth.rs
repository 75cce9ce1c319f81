//! The depth of a pixel of the *colour* image, looked up in a depth image that another camera took.
//!
//! A colour pixel is a ray. Around the place where it meets the measured surface, a plane is fitted to the readings: in
//! *inverse* depth, which is linear in the pixel on a plane and has the same noise at any range where depth comes from
//! triangulation. The ray meets that plane in a point, whose place in the depth image says whether it was the right
//! window; else the fit is repeated there.
//!
//! Where the readings leave their plane by more than the image's own noise, two surfaces meet or one is bent: what the
//! colour pixel shows may lie on either, and a mean of both on none. Such pixels have no depth.

use nalgebra::{Matrix3, Vector2, Vector3};
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera, Pixel, Point3};

/// The window reaches so many pixels from its centre. A larger one averages more, but what neighbours have in common it
/// cannot, and steps too small to be distinguished from noise bend its plane at more of the features.
const HALF_WINDOW: i64 = 1;
/// The window that a slope is read from: nine readings would give it only to `0.4 s f z^2` (noise `s z^2`, focal length
/// `f` of the depth camera), 81 give it nine times better.
const SLOPE_HALF_WINDOW: i64 = 4;
/// Least part of a window's pixels with a value.
const MIN_READINGS: f64 = 0.75;
/// Largest sum of squares of what the plane leaves, in sigmas of a reading's own noise and a degree of freedom: a
/// window of one surface passes it in 97 of 100 cases (chi squared with six degrees of freedom).
const MAX_SQUARES: f64 = 2.3;
/// No sensor is better, relative to the inverse depth: what remains of exact images is the curvature of surfaces.
const MIN_RELATIVE_SIGMA: f64 = 1e-3;
/// Iterations at most; with a baseline of centimetres two or three do.
const MAX_ITERATIONS: usize = 12;
/// Pixels apart at which the noise of the sensor is no longer common: windows of stereo matching are narrower.
const FAR_PX: usize = 8;

/// The depth at a pixel and what is known of the surface there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthSample {
    /// z-depth in the colour camera's frame, m.
    pub depth_m: f64,
    /// The plane's slant: how the inverse depth grows with the normalised coordinates x and y of the colour image, 1/m.
    pub inverse_depth_gradient: [f64; 2],
    /// Standard deviation relative to that of a single reading of the image: the fit averages what neighbours do not
    /// have in common.
    pub relative_sigma: f64,
    /// How z-depth changes with the normalised coordinates x and y of the colour image, m; `None` where a window that
    /// is wide enough to determine it well meets more than one plane.
    pub slope_m: Option<[f64; 2]>,
}

/// A depth image that answers for pixels of the colour image.
#[derive(Debug)]
pub struct RegisteredDepth<'a> {
    depth: &'a DepthImage,
    depth_camera: &'a DepthCamera,
    color_camera: &'a PinholeCamera,
    depth_from_color: Isometry3,
    median_m: f64,
    noise: Noise,
}

/// The noise of a depth image's inverse depths, 1/m.
#[derive(Debug, Clone, Copy)]
struct Noise {
    /// What a single reading has of its own.
    own_sigma: f64,
    /// The part of its variance that neighbours do not share.
    own_fraction: f64,
}

/// A plane in the depth camera: `1/z = inverse_depth + by_pixel . (pixel - centre)`.
#[derive(Debug, Clone, Copy)]
struct Window {
    centre: [i64; 2],
    half: i64,
    inverse_depth: f64,
    by_pixel: Vector2<f64>,
    /// Inverse of the normal matrix for (1, x, y).
    cofactors: Matrix3<f64>,
}

impl<'a> RegisteredDepth<'a> {
    /// `None` for a depth image without any value.
    pub fn new(depth: &'a DepthImage, depth_camera: &'a DepthCamera, color_camera: &'a PinholeCamera) -> Option<Self> {
        let mut values: Vec<f32> = depth.as_slice().iter().copied().step_by(7).filter(|&z| z > 0.0).collect();
        if values.is_empty() {
            return None;
        }
        let middle = values.len() / 2;
        let (_, median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
        let median_m = f64::from(*median);
        Some(RegisteredDepth {
            depth,
            depth_camera,
            color_camera,
            depth_from_color: depth_camera.color_from_depth.inverse(),
            median_m,
            noise: Noise::of(depth),
        })
    }

    /// z-depth in the colour camera's frame, metres, of what a colour pixel (distortion included) shows; `None` at
    /// holes, at depth edges and outside the depth image.
    pub fn at(&self, pixel: &Pixel) -> Option<f64> {
        self.sample_at(pixel).map(|sample| sample.depth_m)
    }

    /// The same, with the slant of the surface and how sure the depth is.
    pub fn sample_at(&self, pixel: &Pixel) -> Option<DepthSample> {
        let ray = self.color_camera.unproject(pixel);
        self.along(&ray)
    }

    fn along(&self, ray: &Vector3<f64>) -> Option<DepthSample> {
        let mut at = self.seen_at(ray, self.median_m)?;
        let mut tried = None;
        for _ in 0..MAX_ITERATIONS {
            let centre = [at.x.round() as i64, at.y.round() as i64];
            let window = self.fit(centre, HALF_WINDOW)?;
            let plane = self.plane_in_color(&window)?;
            let inverse_depth = plane.dot(ray);
            if inverse_depth <= 0.0 {
                return None;
            }
            at = self.seen_at(ray, 1.0 / inverse_depth)?;
            // A place on the border of two windows may lie in each by the fit of the other: either is right.
            let next = [at.x.round() as i64, at.y.round() as i64];
            if next == centre || tried == Some(next) {
                if !self.is_whole(&window) {
                    return None;
                }
                let place = Vector3::new(1.0, at.x - centre[0] as f64, at.y - centre[1] as f64);
                let own = place.dot(&(window.cofactors * place)) * self.noise.own_fraction;
                return Some(DepthSample {
                    depth_m: 1.0 / inverse_depth,
                    inverse_depth_gradient: [plane.x, plane.y],
                    relative_sigma: (1.0 - self.noise.own_fraction + own).sqrt(),
                    slope_m: self.slope(centre, 1.0 / inverse_depth),
                });
            }
            tried = Some(centre);
        }
        // Between two surfaces the iteration swings from one to the other; neither is the answer.
        None
    }

    fn slope(&self, centre: [i64; 2], depth_m: f64) -> Option<[f64; 2]> {
        let window = self.fit(centre, SLOPE_HALF_WINDOW).filter(|window| self.is_whole(window))?;
        let plane = self.plane_in_color(&window)?;
        Some([plane.x, plane.y].map(|gradient| -gradient * depth_m * depth_m))
    }

    fn seen_at(&self, ray: &Vector3<f64>, z_m: f64) -> Option<Pixel> {
        self.depth_camera.camera.project(&(self.depth_from_color * Point3::from(ray * z_m)))
    }

    /// The readings of a window: offset from its centre and inverse depth.
    fn readings(&self, [column, row]: [i64; 2], half: i64) -> impl Iterator<Item = (Vector2<f64>, f64)> + '_ {
        let offsets = (-half..=half).flat_map(move |dy| (-half..=half).map(move |dx| (dx, dy)));
        offsets.filter_map(move |(dx, dy)| {
            let z = self.depth.at(u32::try_from(column + dx).ok()?, u32::try_from(row + dy).ok()?)?;
            Some((Vector2::new(dx as f64, dy as f64), 1.0 / f64::from(z)))
        })
    }

    /// The plane through a window; `None` where too few pixels have a value.
    fn fit(&self, centre: [i64; 2], half: i64) -> Option<Window> {
        let (mut normal, mut right, mut count) = (Matrix3::zeros(), Vector3::zeros(), 0u32);
        for (offset, inverse) in self.readings(centre, half) {
            let basis = Vector3::new(1.0, offset.x, offset.y);
            normal += basis * basis.transpose();
            right += basis * inverse;
            count += 1;
        }
        if f64::from(count) < MIN_READINGS * ((2 * half + 1) * (2 * half + 1)) as f64 {
            return None;
        }
        let cofactors = normal.try_inverse()?;
        let plane = cofactors * right;
        Some(Window { centre, half, inverse_depth: plane.x, by_pixel: plane.yz(), cofactors })
    }

    /// Whether the readings lie on their plane as far as the noise allows to say.
    fn is_whole(&self, window: &Window) -> bool {
        // A count of the image is one step of depth, whose inverse is coarser the nearer.
        let rounding = self.depth_camera.unit_m * window.inverse_depth.powi(2) / 12f64.sqrt();
        let least = MIN_RELATIVE_SIGMA * window.inverse_depth;
        let sigma = self.noise.own_sigma.hypot(rounding).max(least);
        let (mut sum, mut count) = (0.0, 0u32);
        for (offset, inverse) in self.readings(window.centre, window.half) {
            let off = (inverse - window.inverse_depth - window.by_pixel.dot(&offset)) / sigma;
            sum += off * off;
            count += 1;
        }
        sum <= MAX_SQUARES * f64::from(count - 3)
    }

    /// The plane `n . P = 1` of a window in the colour camera's frame: `n . ray` is the inverse depth on a ray with z =
    /// 1. `None` where it passes through the colour camera.
    fn plane_in_color(&self, window: &Window) -> Option<Vector3<f64>> {
        let camera = &self.depth_camera.camera;
        let pixel = Pixel::new(window.centre[0] as f64, window.centre[1] as f64);
        let ray = camera.unproject(&pixel);
        let [by_x, by_y] = [Vector2::x(), Vector2::y()].map(|axis| (camera.unproject(&(pixel + axis)) - ray).xy());
        let pixel_by_ray = nalgebra::Matrix2::from_columns(&[by_x, by_y]).try_inverse()?;
        let slant = pixel_by_ray.tr_mul(&window.by_pixel);
        let normal = Vector3::new(slant.x, slant.y, window.inverse_depth - slant.dot(&ray.xy()));
        let to_color = &self.depth_camera.color_from_depth;
        let turned = to_color.rotation * normal;
        let offset = 1.0 + turned.dot(&to_color.translation.vector);
        (offset > 0.0).then(|| turned / offset)
    }
}

impl Noise {
    /// From second differences along rows, which vanish on planes: between neighbours they show what each reading has
    /// of its own, far apart all of its noise. Their medians do not mind edges.
    fn of(depth: &DepthImage) -> Self {
        let width = depth.width() as usize;
        let sigma = |apart: usize| {
            let mut sizes = Vec::new();
            for row in depth.as_slice().chunks_exact(width.max(1)).step_by(2) {
                for at in (apart..width.saturating_sub(apart)).step_by(2) {
                    let [before, here, after] = [at - apart, at, at + apart].map(|column| f64::from(row[column]));
                    if before > 0.0 && here > 0.0 && after > 0.0 {
                        sizes.push((1.0 / before - 2.0 / here + 1.0 / after).abs());
                    }
                }
            }
            if sizes.is_empty() {
                return 0.0;
            }
            let middle = sizes.len() / 2;
            let (_, median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
            // The median of |normal| is 0.6745 sigma, and the variances of the three add up to six.
            *median / (0.6745 * 6f64.sqrt())
        };
        let [near, far] = [1, FAR_PX].map(sigma);
        let own_fraction = if far > near { (near / far).powi(2) } else { 1.0 };
        Noise { own_sigma: near, own_fraction }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane `n . p = c` in the colour frame, seen by a depth camera beside it.
    #[test]
    fn depth_of_a_slanted_plane_is_found_through_the_baseline() {
        let color = PinholeCamera::from_hfov(1280, 720, 1.2);
        let depth_camera = DepthCamera {
            camera: PinholeCamera::from_hfov(480, 360, 1.0),
            unit_m: 1e-3,
            offset_m: 0.0,
            color_from_depth: Isometry3::new(Vector3::new(0.03, -0.01, 0.005), Vector3::new(0.01, -0.02, 0.03)),
        };
        let (normal, offset) = (Vector3::new(0.3, -0.2, 1.0), 1.1);
        let mut values = Vec::new();
        for y in 0..360 {
            for x in 0..480 {
                let ray = depth_camera.camera.unproject(&Pixel::new(f64::from(x), f64::from(y)));
                let color_from_depth = &depth_camera.color_from_depth;
                let direction = color_from_depth.rotation * ray;
                let depth = (offset - normal.dot(&color_from_depth.translation.vector)) / normal.dot(&direction);
                values.push(depth as f32);
            }
        }
        let image = DepthImage::new(480, 360, values).unwrap();
        let registered = RegisteredDepth::new(&image, &depth_camera, &color).unwrap();
        for pixel in [Pixel::new(640.0, 360.0), Pixel::new(400.2, 500.7), Pixel::new(800.0, 200.0)] {
            let expected = offset / normal.dot(&color.unproject(&pixel));
            let sample = registered.sample_at(&pixel).unwrap();
            assert!((sample.depth_m - expected).abs() < 1e-6);
            assert_eq!(registered.at(&pixel), Some(sample.depth_m));
            let [x, y] = sample.inverse_depth_gradient;
            assert!((x - normal.x / offset).abs() < 1e-4 && (y - normal.y / offset).abs() < 1e-4);
            let beside = slope_along_x(&color, &normal, offset, &pixel);
            assert!((sample.slope_m.unwrap()[0] - beside).abs() < 1e-3);
            assert!(sample.relative_sigma < 0.7, "nine readings of their own noise: {}", sample.relative_sigma);
        }
        assert_eq!(registered.at(&Pixel::new(-5000.0, 0.0)), None);
        let empty = DepthImage::new(2, 2, vec![0.0; 4]).unwrap();
        assert!(RegisteredDepth::new(&empty, &depth_camera, &color).is_none());
    }

    /// How the depth of the plane `n . p = c` changes with x, by differences.
    fn slope_along_x(camera: &PinholeCamera, normal: &Vector3<f64>, offset: f64, pixel: &Pixel) -> f64 {
        let ray = camera.unproject(pixel);
        let at = |dx: f64| offset / normal.dot(&(ray + Vector3::x() * dx));
        (at(1e-6) - at(-1e-6)) / 2e-6
    }

    const SIDE: u32 = 120;
    const NOISE_PER_M: f64 = 0.003;

    /// A wall at 1 m with a step to another depth in the middle, with the noise of a stereo camera.
    fn step(behind_m: f64) -> DepthImage {
        let mut state = 9u64;
        let mut uniform = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let mut reading = |z: f64| {
            let noise: f64 = (0..12).map(|_| uniform()).sum();
            (z + NOISE_PER_M * z * z * noise) as f32
        };
        let values = (0..SIDE * SIDE).map(|at| reading(if at % SIDE < SIDE / 2 { 1.0 } else { behind_m })).collect();
        DepthImage::new(SIDE, SIDE, values).unwrap()
    }

    fn camera() -> DepthCamera {
        let camera = PinholeCamera::from_hfov(SIDE, SIDE, 1.0);
        DepthCamera { camera, unit_m: 1e-4, offset_m: 0.0, color_from_depth: Isometry3::identity() }
    }

    #[test]
    fn noise_is_averaged_without_bias_and_its_fraction_is_known() {
        let (camera, image) = (camera(), step(1.0));
        let registered = RegisteredDepth::new(&image, &camera, &camera.camera).unwrap();
        assert!((registered.noise.own_sigma / NOISE_PER_M - 1.0).abs() < 0.1, "{:?}", registered.noise);
        assert!(registered.noise.own_fraction > 0.85, "{:?}", registered.noise);
        let places = (4..SIDE - 4).step_by(5);
        let pixels = places.clone().flat_map(|y| places.clone().map(move |x| Pixel::new(f64::from(x), f64::from(y))));
        let samples: Vec<DepthSample> = pixels.filter_map(|pixel| registered.sample_at(&pixel)).collect();
        assert!(samples.len() > 500, "{}", samples.len());
        let count = samples.len() as f64;
        let mean = samples.iter().map(|s| 1.0 / s.depth_m - 1.0).sum::<f64>() / count;
        let sigma = (samples.iter().map(|s| (1.0 / s.depth_m - 1.0).powi(2)).sum::<f64>() / count).sqrt();
        assert!(mean.abs() < 1e-4, "a tenth of a millimetre at 1 m: {mean}");
        assert!((sigma / (samples[0].relative_sigma * NOISE_PER_M) - 1.0).abs() < 0.1, "{sigma}");
    }

    #[test]
    fn steps_far_below_the_old_limit_have_no_depth() {
        // 3 cm are seven sigmas of this camera.
        let (camera, image) = (camera(), step(1.03));
        let registered = RegisteredDepth::new(&image, &camera, &camera.camera).unwrap();
        let edge = f64::from(SIDE / 2) - 0.5;
        let found = |x: f64| {
            let depths: Vec<f64> =
                (5..SIDE - 5).filter_map(|y| registered.at(&Pixel::new(edge + x, f64::from(y)))).collect();
            (depths.len(), depths.iter().sum::<f64>() / depths.len() as f64)
        };
        assert!(found(0.0).0 < 10, "{:?}", found(0.0));
        for (x, expected_m) in [(-4.0, 1.0), (4.0, 1.03)] {
            let (count, mean_m) = found(x);
            assert!(count > 95 && (mean_m - expected_m).abs() < 1e-3, "{count} {mean_m}");
        }
    }
}
