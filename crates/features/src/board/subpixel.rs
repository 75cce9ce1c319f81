//! A corner to a few hundredths of a pixel: the point that the gradients about it are square to.
//!
//! On an edge through the corner `c` the gradient `g` at `p` obeys `g . (p - c) = 0`; the least squares over a window solve
//! `(sum w g g^T) c = sum w g g^T p` (Foerstner and Guelch, 1987). The weights `w` fall off smoothly about `c`, so the
//! solution is repeated until it stands still.

use super::saddle::Plane;
use nalgebra::{Matrix2, Vector2};

/// Repetitions at most.
const ROUNDS: usize = 30;
/// The solution stands still below this, px.
const STILL: f64 = 1e-4;

/// The corner near `start`, by the pixels within `radius` of it (3 to some 15 px); `None` where there is none within half of the radius.
pub(super) fn refine(image: &Plane, start: (f64, f64), radius: f64) -> Option<(f64, f64)> {
    let reach = radius.ceil() as isize + 1;
    let (mut x, mut y) = start;
    let (width, height) = (image.width as isize, image.height as isize);
    let inverse_variance = 1.0 / (0.5 * radius * 0.5 * radius);
    for _ in 0..ROUNDS {
        let (cx, cy) = (x.round() as isize, y.round() as isize);
        let (left, right) = ((cx - reach).max(1), (cx + reach).min(width - 2));
        let (top, bottom) = ((cy - reach).max(1), (cy + reach).min(height - 2));
        let (mut xx, mut xy, mut yy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for v in top..=bottom {
            for u in left..=right {
                let (dx, dy) = (u as f64 - x, v as f64 - y);
                let squared = dx * dx + dy * dy;
                if squared > radius * radius {
                    continue;
                }
                let (gx, gy) = gradient(image, u as usize, v as usize);
                // Smooth, and zero at the rim.
                let rim = 1.0 - squared / (radius * radius);
                let weight = (-0.5 * squared * inverse_variance).exp() * rim;
                let (a, b, c) = (weight * gx * gx, weight * gx * gy, weight * gy * gy);
                xx += a;
                xy += b;
                yy += c;
                bx += a * dx + b * dy;
                by += b * dx + c * dy;
            }
        }
        let determinant = xx * yy - xy * xy;
        // Edges of one direction alone make no corner.
        if determinant <= 1e-3 * (xx + yy) * (xx + yy) {
            return None;
        }
        let (step_x, step_y) = ((yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant);
        (x, y) = (x + step_x, y + step_y);
        let moved = (x - start.0).hypot(y - start.1);
        if moved.is_nan() || moved > 0.5 * radius {
            return None;
        }
        if step_x.hypot(step_y) < STILL {
            break;
        }
    }
    Some((x, y))
}

/// Scatter along an axis of a corner that was refined with the same `radius`, px for each grey level of white noise.
///
/// To first order noise `e` moves the corner by `N^-1 sum w (dg (g . d) + g (dg . d))` with `d = p - c`, `N = sum w g g^T` and `dg` the
/// gradient of `e`; neighbouring gradients share pixels, so the sum is ordered by pixels.
pub(super) fn noise_gain(image: &Plane, (x, y): (f64, f64), radius: f64) -> Option<f64> {
    let reach = radius.ceil() as isize + 1;
    let (width, height) = (image.width as isize, image.height as isize);
    let (cx, cy) = (x.round() as isize, y.round() as isize);
    let (left, right) = ((cx - reach).max(1), (cx + reach).min(width - 2));
    let (top, bottom) = ((cy - reach).max(1), (cy + reach).min(height - 2));
    if left > right || top > bottom {
        return None;
    }
    let across = (right - left + 3) as usize;
    let mut shifts = vec![Vector2::<f64>::zeros(); across * (bottom - top + 3) as usize];
    let mut normal = Matrix2::<f64>::zeros();
    for v in top..=bottom {
        for u in left..=right {
            let d = Vector2::new(u as f64 - x, v as f64 - y);
            let squared = d.norm_squared();
            if squared > radius * radius {
                continue;
            }
            let weight = (-2.0 * squared / (radius * radius)).exp() * (1.0 - squared / (radius * radius));
            let (gx, gy) = gradient(image, u as usize, v as usize);
            let g = Vector2::new(gx, gy);
            normal += weight * g * g.transpose();
            let offset = g.dot(&d);
            for (k, tap) in TAPS.iter().enumerate() {
                let tap = Vector2::new(tap.0, tap.1) / 32.0;
                let at = ((v - top) as usize + k / 3) * across + (u - left) as usize + k % 3;
                shifts[at] += weight * (tap * offset + g * tap.dot(&d));
            }
        }
    }
    let inverse = normal.try_inverse()?;
    let spread = shifts.iter().map(|shift| shift * shift.transpose()).sum::<Matrix2<f64>>();
    let covariance = inverse * spread * inverse;
    Some((0.5 * covariance.trace()).sqrt()).filter(|gain| gain.is_finite())
}

/// Scharr's derivatives along x and y of the nine pixels about one, times 32.
const TAPS: [(f64, f64); 9] = [
    (-3.0, -3.0),
    (0.0, -10.0),
    (3.0, -3.0),
    (-10.0, 0.0),
    (0.0, 0.0),
    (10.0, 0.0),
    (-3.0, 3.0),
    (0.0, 10.0),
    (3.0, 3.0),
];

/// Scharr's derivative, grey levels a pixel.
fn gradient(image: &Plane, x: usize, y: usize) -> (f64, f64) {
    let at = |dx: usize, dy: usize| f64::from(image.at(x + dx - 1, y + dy - 1));
    let gx = 3.0 * (at(2, 0) - at(0, 0) + at(2, 2) - at(0, 2)) + 10.0 * (at(2, 1) - at(0, 1));
    let gy = 3.0 * (at(0, 2) - at(0, 0) + at(2, 2) - at(2, 0)) + 10.0 * (at(1, 2) - at(1, 0));
    (gx / 32.0, gy / 32.0)
}
