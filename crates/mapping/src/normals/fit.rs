//! The least-squares planes of a run of pixels: one loop over the pixels, the window written out in its body.
//!
//! The window is the black fields of a chess board of five by five: half the work of all, the same reach. Inverse depth
//! is fitted over it as `d = d0 + a k + b l`, with `k` and `l` the columns and rows from the centre in units of the
//! window and `d` the difference to the pixel's own. Where all of the window lies on one surface, which is so for most
//! of an image, its moments are constants; elsewhere each pixel brings its own.

use super::{MAX_BENT, PatchFitter, PatchRow};
use multiversion::multiversion;

/// Pixels that are fitted together as long as their windows are complete, and where they are not.
pub(super) const RUN: usize = 64;
pub(super) const PARTIAL_RUN: usize = 16;

/// The window without its centre: column and row. The four near ones come first.
const WINDOW: [(i32, i32); 12] =
    [(-1, -1), (1, -1), (-1, 1), (1, 1), (-2, -2), (0, -2), (2, -2), (-2, 0), (2, 0), (-2, 2), (0, 2), (2, 2)];
const NEAR: usize = 4;
/// Pixels of the whole window, and the sum of `k^2` over it, which is that of `l^2`.
const COUNT: f32 = 13.0;
const MOMENT: f32 = 28.0;
/// A plane needs this many pixels, and so much of an area between them: the least determinant of their moments
/// relative to what it is if columns and rows are independent.
const FEWEST: f32 = 5.0;
const NARROWEST: f32 = 1e-3;

/// A run of pixels with what the loops need of them.
struct Run<'a, const N: usize> {
    here: &'a [f32; N],
    around: [&'a [f32; N]; 12],
    ray: [[f32; N]; 2],
    scales: Scales,
}

/// What all pixels share.
#[derive(Clone, Copy)]
struct Scales {
    /// How far a neighbour one unit away may differ in depth: coefficients of depth, 1 and squared depth.
    step: (f32, f32, f32),
    /// From units of the window to those of the normalised image.
    per_unit: [f32; 2],
    /// Of the depth's noise.
    sigma: (f32, f32),
}

/// A fit in units of the window.
struct Fit {
    slope: [f32; 2],
    at_centre: f32,
    /// Mean square of the residuals.
    variance: f32,
    /// Whether there is any.
    good: bool,
}

impl<'a, const N: usize> Run<'a, N> {
    #[inline(always)]
    fn new(fitter: &'a PatchFitter<'_>, y: usize, at: usize) -> Self {
        let (inverse, unit) = (&*fitter.inverse, fitter.window.unit);
        let centre = (y + inverse.margin) * inverse.stride + inverse.margin + at;
        let row = |column: i32, line: i32| -> &'a [f32; N] {
            let away = (line as isize * inverse.stride as isize + column as isize) * unit as isize;
            let from = centre.wrapping_add_signed(away);
            inverse.values[from..from + N].try_into().expect("a run")
        };
        let (ray_x, ray_y) = fitter.rays.row(y);
        let (pitch_x, pitch_y) = fitter.rays.pixel_pitch();
        let (fraction, floor, quadratic) = fitter.filter.step_coefficients();
        let reach = (unit * fitter.window.thinning) as f32;
        let noise = &fitter.filter.noise;
        // The distortion's local scale, within a few percent of 1 in usual cameras, is left out.
        let scales = Scales {
            step: (fraction * reach, floor * reach, quadratic * reach),
            per_unit: [1.0 / (unit as f32 * pitch_x), 1.0 / (unit as f32 * pitch_y)],
            sigma: (noise.floor_m as f32, noise.depth_sigma_per_m2 as f32),
        };
        let around = WINDOW.map(|(column, line)| row(column, line));
        Run { here: row(0, 0), around, ray: [part(ray_x, at), part(ray_y, at)], scales }
    }
}

impl Scales {
    /// Difference in inverse depth up to which a neighbour one unit away lies on the same surface.
    #[inline(always)]
    fn tolerance(&self, z: f32, inverse: f32) -> f32 {
        let (fraction, floor, quadratic) = self.step;
        (z * fraction + floor + z * z * quadratic) * inverse * inverse
    }

    /// Normal and depth of a pixel from its fit.
    #[inline(always)]
    fn patch(&self, z: f32, inverse: f32, ray: [f32; 2], fit: &Fit) -> ([f32; 3], f32) {
        let [a, b] = [fit.slope[0] * self.per_unit[0], fit.slope[1] * self.per_unit[1]];
        let fitted = inverse + fit.at_centre;
        let c = fitted - a * ray[0] - b * ray[1];
        let squared = a * a + b * b + c * c;
        let good = fit.good & (squared > 0.0) & (squared < f32::MAX);
        // n . X = c with c > 0 points away from the camera.
        let scale = -1.0 / squared.sqrt();
        let normal = [a, b, c].map(|value| if good { value * scale } else { 0.0 });
        let sigma = (z * z * self.sigma.1 + self.sigma.0) * inverse * inverse;
        let flat = good & (fit.variance <= sigma * sigma * MAX_BENT) & (fitted > 0.0);
        (normal, if flat { 1.0 / fitted } else { z })
    }
}

/// Fits a run of pixels and returns for which the window is not complete: what is written there is to be replaced.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn fit_complete(fitter: &PatchFitter<'_>, y: usize, at: usize, out: &mut PatchRow) -> [bool; RUN] {
    let Run { here, around, ray: [ray_x, ray_y], scales } = Run::<RUN>::new(fitter, y, at);
    let [upper_left, upper_right, lower_left, lower_right, far_around @ ..] = around;
    let [far_upper_left, far_up, far_upper_right, far_left, far_right, far_below @ ..] = far_around;
    let [far_lower_left, far_down, far_lower_right] = far_below;
    let [nx, ny, nz, depth] = planes::<RUN>(out, at);
    let mut incomplete = [false; RUN];
    for x in 0..RUN {
        let (z, inverse) = (depth[x], here[x]);
        // Written out: an array of twelve is more than compilers keep in registers.
        let [a, b] = [upper_left[x] - inverse, upper_right[x] - inverse];
        let [c, d] = [lower_left[x] - inverse, lower_right[x] - inverse];
        let [e, f, g] = [far_upper_left[x] - inverse, far_up[x] - inverse, far_upper_right[x] - inverse];
        let [h, i] = [far_left[x] - inverse, far_right[x] - inverse];
        let [j, k, l] = [far_lower_left[x] - inverse, far_down[x] - inverse, far_lower_right[x] - inverse];
        let tolerance = scales.tolerance(z, inverse);
        let far_tolerance = 2.0 * tolerance;
        // Where there is no depth the inverse is infinite, and the difference infinite or not a number.
        let near = (a.abs() <= tolerance) & (b.abs() <= tolerance) & (c.abs() <= tolerance) & (d.abs() <= tolerance);
        let above = (e.abs() <= far_tolerance) & (f.abs() <= far_tolerance) & (g.abs() <= far_tolerance);
        let beside = (h.abs() <= far_tolerance) & (i.abs() <= far_tolerance);
        let below = (j.abs() <= far_tolerance) & (k.abs() <= far_tolerance) & (l.abs() <= far_tolerance);
        let complete = near & above & beside & below;
        let (left, right, farther_left, farther_right) = (a + c, b + d, e + h + j, g + i + l);
        let sum = left + right + farther_left + farther_right + (f + k);
        let along_k = (right - left) + 2.0 * (farther_right - farther_left);
        let along_l = (c + d) - (a + b) + 2.0 * ((j + k + l) - (e + f + g));
        let squares = (a * a + b * b) + (c * c + d * d) + (e * e + f * f) + (g * g + h * h);
        let squares = squares + (i * i + j * j) + (k * k + l * l);
        let slope = [along_k * (1.0 / MOMENT), along_l * (1.0 / MOMENT)];
        let at_centre = sum * (1.0 / COUNT);
        let rest = squares - sum * at_centre - slope[0] * along_k - slope[1] * along_l;
        let variance = rest.max(0.0) * (1.0 / (COUNT - 3.0));
        let fit = Fit { slope, at_centre, variance, good: complete & (z > 0.0) };
        ([nx[x], ny[x], nz[x]], depth[x]) = scales.patch(z, inverse, [ray_x[x], ray_y[x]], &fit);
        incomplete[x] = (z > 0.0) & !complete;
    }
    incomplete
}

/// Fits a run of pixels, each to what of its window lies on its surface.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn fit_partial(fitter: &PatchFitter<'_>, y: usize, at: usize, out: &mut PatchRow) {
    let Run { here, around, ray: [ray_x, ray_y], scales } = Run::<PARTIAL_RUN>::new(fitter, y, at);
    let [nx, ny, nz, depth] = planes::<PARTIAL_RUN>(out, at);
    for x in 0..PARTIAL_RUN {
        let (z, inverse) = (depth[x], here[x]);
        let tolerance = scales.tolerance(z, inverse);
        let (mut count, mut sk, mut sl, mut sd) = (1.0, 0.0, 0.0, 0.0);
        let (mut skk, mut skl, mut sll) = (0.0, 0.0, 0.0);
        let (mut skd, mut sld, mut sdd) = (0.0, 0.0, 0.0);
        for n in 0..WINDOW.len() {
            let (k, l) = (WINDOW[n].0 as f32, WINDOW[n].1 as f32);
            let difference = around[n][x] - inverse;
            let counts = difference.abs() <= if n < NEAR { tolerance } else { 2.0 * tolerance };
            let one = if counts { 1.0 } else { 0.0 };
            let d = if counts { difference } else { 0.0 };
            count += one;
            sk += one * k;
            sl += one * l;
            skk += one * (k * k);
            skl += one * (k * l);
            sll += one * (l * l);
            sd += d;
            skd += d * k;
            sld += d * l;
            sdd += d * d;
        }
        let fraction = 1.0 / count;
        let (ckk, ckl, cll) = (skk - sk * sk * fraction, skl - sk * sl * fraction, sll - sl * sl * fraction);
        let (ckd, cld) = (skd - sk * sd * fraction, sld - sl * sd * fraction);
        let determinant = ckk * cll - ckl * ckl;
        let spans = (count >= FEWEST) & (ckk > 0.0) & (cll > 0.0) & (determinant > ckk * cll * NARROWEST);
        let inverse_determinant = 1.0 / determinant;
        let slope = [(ckd * cll - cld * ckl) * inverse_determinant, (cld * ckk - ckd * ckl) * inverse_determinant];
        let at_centre = (sd - slope[0] * sk - slope[1] * sl) * fraction;
        let rest = sdd - sd * sd * fraction - slope[0] * ckd - slope[1] * cld;
        let variance = rest.max(0.0) / (count - 3.0);
        let fit = Fit { slope, at_centre, variance, good: spans & (z > 0.0) };
        ([nx[x], ny[x], nz[x]], depth[x]) = scales.patch(z, inverse, [ray_x[x], ray_y[x]], &fit);
    }
}

/// A part of a row of rays; zeros beyond its end.
#[inline(always)]
fn part<const N: usize>(row: &[f32], at: usize) -> [f32; N] {
    let mut values = [0.0; N];
    let rest = row.get(at..).unwrap_or_default();
    let length = N.min(rest.len());
    values[..length].copy_from_slice(&rest[..length]);
    values
}

/// The part of the patches that a run writes: normals and depths.
#[inline(always)]
fn planes<const N: usize>(out: &mut PatchRow, at: usize) -> [&mut [f32; N]; 4] {
    let PatchRow { normal: [nx, ny, nz], depth } = out;
    [nx, ny, nz, depth].map(|plane| (&mut plane[at..at + N]).try_into().expect("a run"))
}
