//! The plane fit where every pixel of the window lies on one surface, which is so for most of an image: sums over the
//! window's columns and rows are all it takes, since its moments are constants, and a run of pixels is one loop.

use super::{InverseDepths, MOST_BENT, PatchFitter, PatchRow};
use multiversion::multiversion;

/// Pixels that are fitted together.
pub(super) const RUN: usize = 64;

/// Fits a run of pixels and tells for which the window is not complete: what is written there is to be replaced.
#[multiversion(targets("x86_64+avx2"))]
pub(super) fn fit_run(fitter: &PatchFitter<'_>, y: usize, at: usize, out: &mut PatchRow) -> [bool; RUN] {
    let unit = fitter.unit;
    let InverseDepths { values, stride, margin } = &*fitter.inverse;
    let centre = (y + margin) * stride + margin + at;
    let row = |right: isize, down: isize| -> &[f32; RUN] {
        let from = centre.wrapping_add_signed((down * *stride as isize + right) * unit as isize);
        values[from..from + RUN].try_into().expect("a run")
    };
    // The black fields of a chess board of five by five, by their distance from the white centre.
    let here = row(0, 0);
    let [upper_left, upper_right, lower_left, lower_right] = [row(-1, -1), row(1, -1), row(-1, 1), row(1, 1)];
    let [far_upper_left, far_up, far_upper_right] = [row(-2, -2), row(0, -2), row(2, -2)];
    let [far_left, far_right] = [row(-2, 0), row(2, 0)];
    let [far_lower_left, far_down, far_lower_right] = [row(-2, 2), row(0, 2), row(2, 2)];
    let (ray_x, ray_y) = fitter.rays.row(y);
    let (ray_x, ray_y) = (run(ray_x, at), run(ray_y, at));
    let (share, floor, quadratic) = fitter.filter.step_coefficients();
    let reach = (unit * fitter.thinning) as f32;
    let (pitch_x, pitch_y) = fitter.rays.pixel_pitch();
    // The sum of squares over the window, in each direction.
    let moment = (28 * unit * unit) as f32;
    let (per_x, per_y) = (unit as f32 / (moment * pitch_x), unit as f32 / (moment * pitch_y));
    let unit_over_moment = unit as f32 / moment;
    let unit = unit as f32;
    let noise = &fitter.filter.noise;
    let (sigma_floor, sigma_quadratic) = (noise.floor_m as f32, noise.quadratic_per_m as f32);

    let PatchRow { normal: [nx, ny, nz], depth } = out;
    let [nx, ny, nz, depth] =
        [nx, ny, nz, depth].map(|plane| -> &mut [f32; RUN] { (&mut plane[at..at + RUN]).try_into().expect("a run") });
    let mut incomplete = [false; RUN];
    for x in 0..RUN {
        let z = depth[x];
        let middle = here[x];
        let (a, b, c, d) =
            (upper_left[x] - middle, upper_right[x] - middle, lower_left[x] - middle, lower_right[x] - middle);
        let (e, f, g) = (far_upper_left[x] - middle, far_up[x] - middle, far_upper_right[x] - middle);
        let (h, i) = (far_left[x] - middle, far_right[x] - middle);
        let (j, k, l) = (far_lower_left[x] - middle, far_down[x] - middle, far_lower_right[x] - middle);
        let tolerance = (z * share + floor + z * z * quadratic) * middle * middle * reach;
        let near = |difference: f32| difference.abs() <= tolerance;
        let far = |difference: f32| difference.abs() <= 2.0 * tolerance;
        // Where there is no depth the inverse is infinite, and the difference infinite or not a number.
        let complete = near(a) & near(b) & near(c) & near(d) & far(e) & far(f) & far(g) & far(h);
        let complete = complete & far(i) & far(j) & far(k) & far(l);
        let (left, right) = (a + c, b + d);
        let (far_left, far_right) = (e + h + j, g + i + l);
        let sum = left + right + far_left + far_right + (f + k);
        let along_x = (right - left) + 2.0 * (far_right - far_left);
        let along_y = (c + d) - (a + b) + 2.0 * ((j + k + l) - (e + f + g));
        let near_squares = a * a + b * b + c * c + d * d;
        let squares = near_squares + (e * e + f * f + g * g + h * h) + (i * i + j * j + k * k + l * l);
        let at_centre = sum * (1.0 / 13.0);
        let across = (along_x * along_x + along_y * along_y) * (unit_over_moment * unit);
        let rest = (squares - sum * at_centre - across).max(0.0) * 0.1;
        let (slope_x, slope_y) = (along_x * per_x, along_y * per_y);
        let fitted = middle + at_centre;
        let level = fitted - slope_x * ray_x[x] - slope_y * ray_y[x];
        let squared = slope_x * slope_x + slope_y * slope_y + level * level;
        // n . X = c with c > 0 points away from the camera.
        let scale = -1.0 / squared.sqrt();
        let known = z > 0.0;
        let good = known & complete & (squared > 0.0) & (squared < f32::MAX);
        nx[x] = if good { slope_x * scale } else { 0.0 };
        ny[x] = if good { slope_y * scale } else { 0.0 };
        nz[x] = if good { level * scale } else { 0.0 };
        let sigma = (z * z * sigma_quadratic + sigma_floor) * middle * middle;
        let flat = good & (rest <= sigma * sigma * MOST_BENT) & (fitted > 0.0);
        depth[x] = if flat { 1.0 / fitted } else { z };
        incomplete[x] = known & !complete;
    }
    incomplete
}

/// A run of a row of rays; zeros beyond its end.
#[inline(always)]
fn run(row: &[f32], at: usize) -> [f32; RUN] {
    let mut values = [0.0; RUN];
    let length = RUN.min(row.len() - at);
    values[..length].copy_from_slice(&row[at..at + length]);
    values
}
