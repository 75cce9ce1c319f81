//! From one level of the scale space to the next, and from a level to its candidate keypoints.
//!
//! For one level: the level before is smoothed by a Gaussian of 1 pixel to `L_s`; the conductivity `g(|grad L_s|)`
//! steers the FED steps of `dL/dt = div(g grad L)` that lead to this level's image; the first derivatives of `L_s` at
//! the level's step are kept for orientation and descriptor, their derivatives give the Hessian, and the maxima of its
//! determinant are the candidates.
//!
//! All of that is done in one sweep over the rows of a band: row `t` of `L_s` is made, and every later stage makes the
//! row that has just become possible. Only the two images that are needed afterwards are written to memory; everything
//! else lives in rings of a few rows. A band begins earlier and ends later than its own rows by what the stages reach,
//! so that its rows do not depend on how the image is cut.

use super::bands::{Ring, mirrored};
use super::options::Diffusivity;
use super::peak::PeakFit;
use super::plan::Level;
use super::rows::{self, DerivativeTaps, DiffusionRows};
use std::ops::Range;

/// A local maximum of the determinant in one level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Candidate {
    /// Column in the level.
    pub x: u32,
    /// Row in the level.
    pub y: u32,
    /// Determinant at the pixel.
    pub response: f32,
    /// Where the peak lies relative to the pixel, in pixels in x and y; none where that is not stable.
    pub offset: Option<[f32; 2]>,
}

/// What is done to one level.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LevelTask<'a> {
    /// The level.
    pub level: &'a Level,
    /// The level before, at this level's resolution; for the first level its own image.
    pub source: &'a [f32],
    /// Conductivity function.
    pub diffusivity: Diffusivity,
    /// One over the squared contrast factor.
    pub inverse_k2: f32,
    /// Weights of the Gaussian before derivatives; `None` for the first level, which is smooth already.
    pub blur: Option<&'a [f32]>,
    /// Least response.
    pub threshold: f32,
}

/// Buffers of one band.
#[derive(Debug, Default)]
pub(crate) struct BandScratch {
    smooth: Ring,
    flow: Ring,
    across: Ring,
    down: Ring,
    steps: Vec<Ring>,
    lx: Ring,
    ly: Ring,
    det: Ring,
    lines: [Vec<f32>; 3],
    found: Vec<u32>,
    /// Result: the candidates in the band's rows, row by row.
    pub candidates: Vec<Candidate>,
}

/// A level's rows that a band writes.
pub(crate) struct BandOutput<'a> {
    /// Rows of the band.
    pub range: Range<usize>,
    /// The level's image; not written for the first level, which is there already.
    pub image: Option<&'a mut [f32]>,
    /// First derivatives in x and y; `None` where no keypoint can be.
    pub gradient: Option<&'a mut [[f32; 2]]>,
}

/// Sweeps over one band of a level.
pub(crate) fn run_band(task: &LevelTask<'_>, scratch: &mut BandScratch, mut output: BandOutput<'_>) {
    let level = task.level;
    let (w, h) = (level.width, level.height);
    let (r0, r1) = (output.range.start, output.range.end);
    let n = level.half_steps.len();
    let step = level.step;
    let taps = DerivativeTaps::new(step);
    let scale = (step * step * step * step) as f32;
    let fit = PeakFit::new(step);
    let reach = fit.radius;
    let searched = output.gradient.is_some();

    let BandScratch { smooth, flow, across, down, steps, lx, ly, det, lines, found, candidates } = scratch;
    candidates.clear();
    smooth.reset(w, 2 * step + 3);
    flow.reset(w, 2);
    across.reset(w, n + 2);
    down.reset(w, n + 2);
    steps.resize_with(n.max(steps.len()), Ring::default);
    steps.iter_mut().for_each(|ring| ring.reset(w, 3));
    for ring in [&mut *lx, &mut *ly] {
        ring.reset(w, 2 * step + 1);
    }
    det.reset(w, 2 * reach + 1);
    for line in lines.iter_mut() {
        line.resize(line.len().max(w + 2 * step.max(2)), 0.0);
    }
    let [line_a, line_b, line_c] = lines;

    // Rows that each stage has to make: those of the band and what later stages read beyond them.
    let around = |reach: usize| r0.saturating_sub(reach)..(r1 + reach).min(h);
    let in_search =
        |range: Range<usize>| range.start.max(level.border - reach)..range.end.min(h - level.border + reach);
    let det_rows = if searched { in_search(around(reach)) } else { 0..0 };
    let gradient_rows = if searched { around(step + reach) } else { 0..0 };
    let smooth_rows = around((n + 1).max(if searched { 2 * step + reach } else { 0 }));
    let flow_rows = if n > 0 { around(n) } else { 0..0 };
    // Conductivities towards the next row.
    let pair_rows = if n > 0 { r0.saturating_sub(n)..(r1 + n - 1).min(h) } else { 0..0 };
    let end = r1 + n.max(2 * step + reach - 1) + 1;

    for t in smooth_rows.start..end {
        if smooth_rows.contains(&t) {
            let out = smooth.row_mut(t);
            match task.blur {
                Some(taps) => {
                    let around: [&[f32]; 5] = std::array::from_fn(|j| {
                        let y = (t + j).saturating_sub(2).min(h - 1);
                        &task.source[y * w..][..w]
                    });
                    rows::blur(&around, taps, line_a, out);
                }
                None => out.copy_from_slice(&task.source[t * w..][..w]),
            }
        }
        if t >= 1 && flow_rows.contains(&(t - 1)) {
            let y = t - 1;
            let around = [-1, 0, 1].map(|d| smooth.row(mirrored(y as isize + d, h)));
            conductivity(task, around, [line_a, line_b], flow.row_mut(y));
        }
        if t >= 2 && pair_rows.contains(&(t - 2)) {
            let y = t - 2;
            let next = (y + 1).min(h - 1);
            rows::pair_conductivities(flow.row(y), flow.row(next), across.row_mut(y), down.row_mut(y));
        }
        for s in 1..=n {
            let reach = n - s;
            if t < s + 1 || !around(reach).contains(&(t - s - 1)) {
                continue;
            }
            let y = t - s - 1;
            let (before, after) = steps.split_at_mut(s - 1);
            let read = |y: usize| match before.last() {
                Some(ring) => ring.row(y),
                None => &task.source[y * w..][..w],
            };
            let above = y.saturating_sub(1);
            let rows = DiffusionRows {
                above: read(above),
                row: read(y),
                below: read((y + 1).min(h - 1)),
                across: across.row(y),
                up: down.row(above),
                down: down.row(y),
            };
            let half_step = level.half_steps[s - 1];
            match (&mut output.image, s == n) {
                (Some(image), true) => rows::diffuse(rows, half_step, &mut image[(y - r0) * w..][..w]),
                _ => rows::diffuse(rows, half_step, after[0].row_mut(y)),
            }
        }
        let Some(gradient) = output.gradient.as_deref_mut() else { continue };
        if t >= step && gradient_rows.contains(&(t - step)) {
            let y = t - step;
            let around = [-(step as isize), 0, step as isize].map(|d| smooth.row(mirrored(y as isize + d, h)));
            rows::gradient(around, taps, [line_a, line_b], lx.row_mut(y), ly.row_mut(y));
            if (r0..r1).contains(&y) {
                rows::interleave(lx.row(y), ly.row(y), &mut gradient[(y - r0) * w..][..w]);
            }
        }
        if t >= 2 * step && det_rows.contains(&(t - 2 * step)) {
            let y = t - 2 * step;
            let lx3 = [lx.row(y - step), lx.row(y), lx.row(y + step)];
            let ly3 = [ly.row(y - step), ly.row(y), ly.row(y + step)];
            rows::determinant(lx3, ly3, taps, scale, [line_a, line_b, line_c], det.row_mut(y));
        }
        if t >= 2 * step + reach && (r0..r1).contains(&(t - 2 * step - reach)) {
            let y = t - 2 * step - reach;
            if y < level.border || y >= h - level.border {
                continue;
            }
            let three = [det.row(y - 1), det.row(y), det.row(y + 1)];
            found.clear();
            rows::maxima(three, level.border..w - level.border, task.threshold, found);
            candidates.extend(found.iter().map(|&x| Candidate {
                x,
                y: y as u32,
                response: three[1][x as usize],
                offset: fit.offset(|dy| det.row(y + dy - reach), x as usize),
            }));
        }
    }
}

/// Conductivity of one row from the smoothed rows around it.
fn conductivity(task: &LevelTask<'_>, around: [&[f32]; 3], scratch: [&mut [f32]; 2], out: &mut [f32]) {
    let k = task.inverse_k2;
    match task.diffusivity {
        Diffusivity::PeronaMalikG2 => rows::conductivity_g2(around, k, scratch, out),
        other => {
            rows::relative_gradient(around, k, scratch, out);
            for g in out {
                *g = match other {
                    Diffusivity::PeronaMalikG1 => (-*g).exp(),
                    Diffusivity::Charbonnier => 1.0 / (1.0 + *g).sqrt(),
                    _ => 1.0 - (-3.315 / g.powi(4)).exp(),
                };
            }
        }
    }
}
