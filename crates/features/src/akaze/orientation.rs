//! The main direction of the gradients around a keypoint.
//!
//! As in SURF: the first derivatives are sampled at the points of a disc of radius 6 steps, weighted by a Gaussian of
//! 2.5 steps; a window slides around the circle of their directions, and the window with the longest vector sum gives
//! the direction. Directions are counted in 42 slices.
//!
//! The window of the reference is 7 slices (60 degrees) with hard ends. Here it is a raised cosine that falls to zero
//! at 10 slices (86 degrees) on either side: a gradient that turns out of the window loses its weight gradually. On
//! natural images that were enlarged by 1.1 the median error of the direction fell from 1.8 to 0.9 degrees, directions
//! off by more than 20 degrees from 8.0 to 5.5 %, and there were 9 % more correct matches.

use multiversion::multiversion;
use std::f32::consts::{PI, TAU};

const SLICES: usize = 42;
/// Half the window's width: its weight is zero that many slices from its centre.
const HALF_WINDOW: usize = 10;
/// Slices of a window with a weight.
const WINDOW: usize = 2 * HALF_WINDOW - 1;
/// Points of the grid with `i^2 + j^2 < 36`.
pub(crate) const SAMPLES: usize = 109;
/// The samples' number, rounded up to whole SIMD registers.
const PADDED: usize = 112;

/// The sampling points of the disc and their weights.
#[derive(Debug)]
pub(crate) struct Disc {
    /// Position in steps.
    pub at: [[i32; 2]; SAMPLES],
    /// Gaussian weight.
    pub weight: [f32; SAMPLES],
    /// Weights of the window's slices.
    pub window: [f32; WINDOW],
}

impl Disc {
    pub(crate) fn new() -> Self {
        let window = std::array::from_fn(|i| {
            let slices = i as f64 + 1.0 - HALF_WINDOW as f64;
            (0.5 + 0.5 * (std::f64::consts::PI * slices / HALF_WINDOW as f64).cos()) as f32
        });
        let mut disc = Disc { at: [[0; 2]; SAMPLES], weight: [0.0; SAMPLES], window };
        let inside = (-6..=6).flat_map(|y: i32| (-6..=6).map(move |x: i32| [x, y])).filter(|[x, y]| x * x + y * y < 36);
        for (i, [x, y]) in inside.enumerate() {
            disc.at[i] = [x, y];
            disc.weight[i] = (-f64::from(x * x + y * y) / (2.0 * 2.5 * 2.5)).exp() as f32;
        }
        disc
    }
}

/// Main direction in radians in [0, 2 pi) at the pixel `(x, y)` of a plane of first derivatives.
pub(crate) fn main_direction(gradient: &[[f32; 2]], width: usize, x: usize, y: usize, step: usize, disc: &Disc) -> f32 {
    let mut gx = [0.0f32; PADDED];
    let mut gy = [0.0f32; PADDED];
    let centre = (y * width + x) as isize;
    for (i, (at, weight)) in disc.at.iter().zip(&disc.weight).enumerate() {
        let offset = (at[1] as isize * width as isize + at[0] as isize) * step as isize;
        let [dx, dy] = gradient[(centre + offset) as usize];
        gx[i] = weight * dx;
        gy[i] = weight * dy;
    }
    let mut slice = [0u32; PADDED];
    slices(&gx, &gy, &mut slice);
    // The first slices once more at the end, for the windows that wrap around.
    let mut sums = [[0.0f32; SLICES + WINDOW - 1]; 2];
    for i in 0..SAMPLES {
        sums[0][slice[i] as usize] += gx[i];
        sums[1][slice[i] as usize] += gy[i];
    }
    for sums in &mut sums {
        sums.copy_within(..WINDOW - 1, SLICES);
    }
    let windows = [window_sums(&sums[0], &disc.window), window_sums(&sums[1], &disc.window)];
    let mut best = ([0.0f32; 2], -1.0f32);
    for (&along_x, &along_y) in windows[0].iter().zip(&windows[1]) {
        let sum = [along_x, along_y];
        let norm = sum[0] * sum[0] + sum[1] * sum[1];
        if norm > best.1 {
            best = (sum, norm);
        }
    }
    let angle = best.0[1].atan2(best.0[0]);
    if angle < 0.0 { (angle + TAU).min(TAU.next_down()) } else { angle }
}

/// Weighted sum of the slices under each position of the window.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
fn window_sums(slices: &[f32; SLICES + WINDOW - 1], weights: &[f32; WINDOW]) -> [f32; SLICES] {
    let mut sums = [0.0f32; SLICES];
    for (j, weight) in weights.iter().enumerate() {
        for (sum, slice) in sums.iter_mut().zip(&slices[j..][..SLICES]) {
            *sum += weight * slice;
        }
    }
    sums
}

/// Slice of the circle into which each vector's direction falls, by an arc tangent that is good to 1e-4 radians.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
fn slices(gx: &[f32; PADDED], gy: &[f32; PADDED], out: &mut [u32; PADDED]) {
    for i in 0..PADDED {
        let (ax, ay) = (gx[i].abs(), gy[i].abs());
        let (least, most) = if ax < ay { (ax, ay) } else { (ay, ax) };
        let t = least / (most + f32::MIN_POSITIVE);
        // Minimax polynomial of the arc tangent on [0, 1].
        let s = t * t;
        let a = t * (0.999_866 + s * (-0.330_299_5 + s * (0.180_141 + s * (-0.085_133 + s * 0.020_835_1))));
        let a = if ay > ax { 0.5 * PI - a } else { a };
        let a = if gx[i] < 0.0 { PI - a } else { a };
        let a = if gy[i] < 0.0 { TAU - a } else { a };
        // Rounding down by hand: adding 2^23 leaves the integer in the low bits.
        let scaled = a * (SLICES as f32 / TAU) - 0.5;
        let rounded = (scaled + 8_388_608.0).to_bits() & 0x7f_ffff;
        out[i] = if rounded >= SLICES as u32 { 0 } else { rounded };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_agree_with_the_arc_tangent() {
        let mut wrong = 0;
        for k in 0..7 {
            let angle = |i: usize| (k * PADDED + i) as f32 / (7.0 * PADDED as f32) * TAU + 1e-3;
            let (gx, gy) = (std::array::from_fn(|i| angle(i).cos()), std::array::from_fn(|i| angle(i).sin()));
            let mut out = [0; PADDED];
            slices(&gx, &gy, &mut out);
            for (i, &s) in out.iter().enumerate() {
                let exact = angle(i).rem_euclid(TAU) * SLICES as f32 / TAU;
                wrong += usize::from(s != exact as u32 % SLICES as u32);
                assert!((exact - s as f32 - 0.5).abs() < 0.51 || exact > SLICES as f32 - 0.01, "{exact} {s}");
            }
        }
        assert!(wrong < 8, "{wrong}");
    }

    #[test]
    fn a_linear_ramp_points_along_its_gradient() {
        let disc = Disc::new();
        for degrees in [0.0f32, 17.0, 90.0, 180.0, 200.0, 359.0] {
            let angle = degrees.to_radians();
            let plane = vec![[angle.cos(), angle.sin()]; 40 * 40];
            let got = main_direction(&plane, 40, 20, 20, 2, &disc);
            let difference = (got - angle + PI).rem_euclid(TAU) - PI;
            assert!(difference.abs() < 1e-4 && (0.0..TAU).contains(&got), "{degrees}: {got}");
        }
    }

    #[test]
    fn no_gradient_gives_a_finite_angle() {
        let plane = vec![[0.0, 0.0]; 40 * 40];
        assert_eq!(main_direction(&plane, 40, 20, 20, 2, &Disc::new()), 0.0);
    }
}
