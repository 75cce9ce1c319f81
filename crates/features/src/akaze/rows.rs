//! Loops over one row of pixels: the only code that has to be fast for every pixel.
//!
//! Each function is compiled several times, for the instruction sets named in its attribute, and the best is chosen at
//! run time. They are plain loops that the compiler turns into SIMD; there is no fused multiply-add and no reordering,
//! so that all versions give the same bits.

use multiversion::multiversion;
use std::array::from_fn;

/// Reads beyond the ends are taken from the end pixel.
#[inline(always)]
fn replicate(padded: &mut [f32], pad: usize) {
    let n = padded.len();
    let (first, last) = (padded[pad], padded[n - 1 - pad]);
    padded[..pad].fill(first);
    padded[n - pad..].fill(last);
}

/// Reads beyond the ends are mirrored at the end pixel's centre (`dcb|abcd|cba` without repeating a pixel); rows that
/// are shorter than that use the farthest pixel there is.
#[inline(always)]
fn mirror(padded: &mut [f32], pad: usize) {
    let n = padded.len() - 2 * pad;
    for i in 1..=pad {
        let inner = i.min(n - 1);
        padded[pad - i] = padded[pad + inner];
        padded[pad + n - 1 + i] = padded[pad + n - 1 - inner];
    }
}

/// `out = grey / 255`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn to_float(grey: &[u8], out: &mut [f32]) {
    for (o, &g) in out.iter_mut().zip(grey) {
        *o = f32::from(g) * (1.0 / 255.0);
    }
}

#[inline(always)]
fn blur_fixed<const R: usize>(rows: &[&[f32]], taps: &[f32], scratch: &mut [f32], out: &mut [f32]) {
    let w = out.len();
    let taps: [f32; 16] = from_fn(|i| if i <= R { taps[i] } else { 0.0 });
    let padded = &mut scratch[..w + 2 * R];
    {
        let above: [&[f32]; R] = from_fn(|j| &rows[R - 1 - j][..w]);
        let below: [&[f32]; R] = from_fn(|j| &rows[R + 1 + j][..w]);
        let centre = &rows[R][..w];
        let middle = &mut padded[R..][..w];
        for x in 0..w {
            let mut sum = taps[0] * centre[x];
            for j in 0..R {
                sum += taps[j + 1] * (above[j][x] + below[j][x]);
            }
            middle[x] = sum;
        }
    }
    replicate(padded, R);
    let left: [&[f32]; R] = from_fn(|j| &padded[R - 1 - j..][..w]);
    let right: [&[f32]; R] = from_fn(|j| &padded[R + 1 + j..][..w]);
    let centre = &padded[R..][..w];
    for x in 0..w {
        let mut sum = taps[0] * centre[x];
        for j in 0..R {
            sum += taps[j + 1] * (left[j][x] + right[j][x]);
        }
        out[x] = sum;
    }
}

/// Largest radius of [`blur`].
pub(crate) const MAX_BLUR_RADIUS: usize = 8;

/// One row of a separable symmetric blur. `rows` are the `2 R + 1` rows around it, `taps` the `R + 1` weights from the
/// centre outwards; beyond its ends the row is continued by its end pixels. `scratch` has at least `2 R` more elements
/// than a row.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn blur(rows: &[&[f32]], taps: &[f32], scratch: &mut [f32], out: &mut [f32]) {
    match taps.len() - 1 {
        2 => blur_fixed::<2>(rows, taps, scratch, out),
        3 => blur_fixed::<3>(rows, taps, scratch, out),
        4 => blur_fixed::<4>(rows, taps, scratch, out),
        5 => blur_fixed::<5>(rows, taps, scratch, out),
        6 => blur_fixed::<6>(rows, taps, scratch, out),
        7 => blur_fixed::<7>(rows, taps, scratch, out),
        8 => blur_fixed::<8>(rows, taps, scratch, out),
        radius => unreachable!("no blur of radius {radius}"),
    }
}

/// Squared magnitude of Scharr's gradient (weights 3, 10, 3, not normalised) of one row into `out`.
#[inline(always)]
fn scharr_squared(rows: [&[f32]; 3], scratch: [&mut [f32]; 2], out: &mut [f32]) {
    let w = out.len();
    let [smooth, difference] = scratch;
    let (smooth, difference) = (&mut smooth[..w + 2], &mut difference[..w + 2]);
    {
        let [a, b, c] = rows.map(|r| &r[..w]);
        let (s, d) = (&mut smooth[1..][..w], &mut difference[1..][..w]);
        for x in 0..w {
            s[x] = 3.0 * (a[x] + c[x]) + 10.0 * b[x];
            d[x] = c[x] - a[x];
        }
    }
    mirror(smooth, 1);
    mirror(difference, 1);
    let (sl, sr) = (&smooth[..w], &smooth[2..][..w]);
    let (dl, dc, dr) = (&difference[..w], &difference[1..][..w], &difference[2..][..w]);
    for x in 0..w {
        let lx = sr[x] - sl[x];
        let ly = 3.0 * (dl[x] + dr[x]) + 10.0 * dc[x];
        out[x] = lx * lx + ly * ly;
    }
}

/// Magnitude of Scharr's gradient of one row.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn gradient_magnitude(rows: [&[f32]; 3], scratch: [&mut [f32]; 2], out: &mut [f32]) {
    scharr_squared(rows, scratch, out);
    for o in out.iter_mut() {
        *o = o.sqrt();
    }
}

/// The largest of the values and zero.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn maximum(values: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 32];
    let chunks = values.chunks_exact(32);
    let rest = chunks.remainder().iter().fold(0.0f32, |m, &v| if v > m { v } else { m });
    for chunk in chunks {
        for (l, &v) in lanes.iter_mut().zip(chunk) {
            *l = if v > *l { v } else { *l };
        }
    }
    lanes.iter().fold(rest, |m, &v| if v > m { v } else { m })
}

/// Squared gradient of one row in units of the squared contrast factor: `m^2 / k^2`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn relative_gradient(rows: [&[f32]; 3], inverse_k2: f32, scratch: [&mut [f32]; 2], out: &mut [f32]) {
    scharr_squared(rows, scratch, out);
    for o in out.iter_mut() {
        *o *= inverse_k2;
    }
}

/// Perona and Malik's second conductivity of one row, `1 / (1 + m^2 / k^2)`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn conductivity_g2(rows: [&[f32]; 3], inverse_k2: f32, scratch: [&mut [f32]; 2], out: &mut [f32]) {
    scharr_squared(rows, scratch, out);
    for o in out.iter_mut() {
        *o = 1.0 / (1.0 + *o * inverse_k2);
    }
}

/// Sums of neighbouring conductivities: `across[x]` between pixels `x` and `x + 1` of this row (0 for the last),
/// `down[x]` between this row and the next.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn pair_conductivities(row: &[f32], next: &[f32], across: &mut [f32], down: &mut [f32]) {
    let w = row.len();
    let (next, across, down) = (&next[..w], &mut across[..w], &mut down[..w]);
    for x in 0..w {
        down[x] = row[x] + next[x];
    }
    let (left, right, out) = (&row[..w - 1], &row[1..][..w - 1], &mut across[..w - 1]);
    for x in 0..w - 1 {
        out[x] = left[x] + right[x];
    }
    across[w - 1] = 0.0;
}

/// Rows that one explicit step of diffusion reads.
pub(crate) struct DiffusionRows<'a> {
    /// The image, row above; the row itself at the top of the image.
    pub above: &'a [f32],
    /// The image, this row.
    pub row: &'a [f32],
    /// The image, row below; the row itself at the bottom.
    pub below: &'a [f32],
    /// Conductivities between the pixels of this row, see [`pair_conductivities`].
    pub across: &'a [f32],
    /// Conductivities between the row above and this one.
    pub up: &'a [f32],
    /// Conductivities between this row and the one below.
    pub down: &'a [f32],
}

/// One explicit step of `dL/dt = div(g grad L)` on one row; nothing flows over the image's border.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn diffuse(rows: DiffusionRows<'_>, half_step: f32, out: &mut [f32]) {
    let w = out.len();
    let (above, row, below) = (&rows.above[..w], &rows.row[..w], &rows.below[..w]);
    let (across, up, down) = (&rows.across[..w], &rows.up[..w], &rows.down[..w]);
    let end = |x: usize| {
        let c = row[x];
        let vertical = down[x] * (below[x] - c) + up[x] * (above[x] - c);
        let right = if x + 1 < w { across[x] * (row[x + 1] - c) } else { 0.0 };
        let left = if x > 0 { across[x - 1] * (row[x - 1] - c) } else { 0.0 };
        c + half_step * ((right + left) + vertical)
    };
    out[0] = end(0);
    out[w - 1] = end(w - 1);
    if w < 3 {
        return;
    }
    let n = w - 2;
    let (left, centre, right) = (&row[..n], &row[1..][..n], &row[2..][..n]);
    let (to_left, to_right) = (&across[..n], &across[1..][..n]);
    let (above, below, up, down) = (&above[1..][..n], &below[1..][..n], &up[1..][..n], &down[1..][..n]);
    let out = &mut out[1..][..n];
    for x in 0..n {
        let c = centre[x];
        let vertical = down[x] * (below[x] - c) + up[x] * (above[x] - c);
        let horizontal = to_right[x] * (right[x] - c) + to_left[x] * (left[x] - c);
        out[x] = c + half_step * (horizontal + vertical);
    }
}

/// Half the resolution: each pixel is the mean of two by two.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn halve(upper: &[f32], lower: &[f32], out: &mut [f32]) {
    for ((o, u), l) in out.iter_mut().zip(upper.chunks_exact(2)).zip(lower.chunks_exact(2)) {
        *o = 0.25 * ((u[0] + l[1]) + (u[1] + l[0]));
    }
}

/// Weights of the derivative filters at taps `-step`, 0 and `step`: the smoothing direction has `(side, middle, side)`
/// and the deriving direction `(-1, 0, 1)`; the product is a first derivative per pixel, times the step's scale
/// (Scharr's 3 : 10 : 3 stretched to the level's scale).
#[derive(Debug, Clone, Copy)]
pub(crate) struct DerivativeTaps {
    /// Distance of the outer taps.
    pub step: usize,
    /// Weight of the outer taps.
    pub side: f32,
    /// Weight of the middle tap.
    pub middle: f32,
}

impl DerivativeTaps {
    pub(crate) fn new(step: usize) -> Self {
        let side = 1.0 / (2.0 * step as f32 * (10.0 / 3.0 + 2.0));
        DerivativeTaps { step, side, middle: side * (10.0 / 3.0) }
    }
}

/// First derivatives of one row. `rows` are the rows `-step`, 0 and `step` away.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn gradient(
    rows: [&[f32]; 3],
    taps: DerivativeTaps,
    scratch: [&mut [f32]; 2],
    lx: &mut [f32],
    ly: &mut [f32],
) {
    let w = lx.len();
    let DerivativeTaps { step, side, middle } = taps;
    let [smooth, difference] = scratch;
    let (smooth, difference) = (&mut smooth[..w + 2 * step], &mut difference[..w + 2 * step]);
    {
        let [a, b, c] = rows.map(|r| &r[..w]);
        let (s, d) = (&mut smooth[step..][..w], &mut difference[step..][..w]);
        for x in 0..w {
            s[x] = side * (a[x] + c[x]) + middle * b[x];
            d[x] = c[x] - a[x];
        }
    }
    mirror(smooth, step);
    mirror(difference, step);
    let (sl, sr) = (&smooth[..w], &smooth[2 * step..][..w]);
    let (dl, dc, dr) = (&difference[..w], &difference[step..][..w], &difference[2 * step..][..w]);
    let ly = &mut ly[..w];
    for x in 0..w {
        lx[x] = sr[x] - sl[x];
        ly[x] = side * (dl[x] + dr[x]) + middle * dc[x];
    }
}

/// Both derivatives of one row side by side, for the descriptor's sampling.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn interleave(lx: &[f32], ly: &[f32], out: &mut [[f32; 2]]) {
    for ((o, &x), &y) in out.iter_mut().zip(lx).zip(ly) {
        *o = [x, y];
    }
}

/// Determinant of the Hessian, `scale (Lxx Lyy - Lxy^2)`, of one row from the first derivatives at the rows `-step`, 0
/// and `step` away. The `step` pixels at each end are left at 0: no keypoint lies there.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn determinant(
    lx: [&[f32]; 3],
    ly: [&[f32]; 3],
    taps: DerivativeTaps,
    scale: f32,
    scratch: [&mut [f32]; 3],
    out: &mut [f32],
) {
    let w = out.len();
    let DerivativeTaps { step, side, middle } = taps;
    if w <= 2 * step {
        out.fill(0.0);
        return;
    }
    let [smooth, dx, dy] = scratch;
    let (smooth, dx, dy) = (&mut smooth[..w], &mut dx[..w], &mut dy[..w]);
    {
        let [xa, xb, xc] = lx.map(|r| &r[..w]);
        let [ya, _, yc] = ly.map(|r| &r[..w]);
        for x in 0..w {
            smooth[x] = side * (xa[x] + xc[x]) + middle * xb[x];
            dx[x] = xc[x] - xa[x];
            dy[x] = yc[x] - ya[x];
        }
    }
    out[..step].fill(0.0);
    out[w - step..].fill(0.0);
    let n = w - 2 * step;
    let out = &mut out[step..][..n];
    let (sl, sr) = (&smooth[..n], &smooth[2 * step..][..n]);
    let (xl, xc, xr) = (&dx[..n], &dx[step..][..n], &dx[2 * step..][..n]);
    let (yl, yc, yr) = (&dy[..n], &dy[step..][..n], &dy[2 * step..][..n]);
    for x in 0..n {
        let lxx = sr[x] - sl[x];
        let lxy = side * (xl[x] + xr[x]) + middle * xc[x];
        let lyy = side * (yl[x] + yr[x]) + middle * yc[x];
        out[x] = scale * (lxx * lyy - lxy * lxy);
    }
}

/// Columns in `columns` of the row's pixels that exceed the threshold and all eight neighbours, in order.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
pub(crate) fn maxima(rows: [&[f32]; 3], columns: std::ops::Range<usize>, threshold: f32, found: &mut Vec<u32>) {
    const LANES: usize = 32;
    let n = columns.len();
    let first = columns.start;
    // Nine rows, each shifted so that index 0 is the first column asked for.
    let [a, b, c] = rows;
    let shifted = [
        &a[first - 1..][..n],
        &a[first..][..n],
        &a[first + 1..][..n],
        &b[first - 1..][..n],
        &b[first + 1..][..n],
        &c[first - 1..][..n],
        &c[first..][..n],
        &c[first + 1..][..n],
    ];
    let centre = &b[first..][..n];
    let mut start = 0;
    while start < n {
        let len = LANES.min(n - start);
        let values = &centre[start..][..len];
        let above = values.iter().fold(0u32, |any, &v| any | u32::from(v > threshold));
        if above != 0 {
            for (i, &v) in values.iter().enumerate() {
                let x = start + i;
                if v > threshold && shifted.iter().all(|s| v > s[x]) {
                    found.push((first + x) as u32);
                }
            }
        }
        start += len;
    }
}
