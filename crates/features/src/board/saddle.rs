//! Candidates for corners: saddle points whose surroundings are two dark and two bright sectors.

use image::GrayImage;
use std::f32::consts::PI;

/// An image of floating point numbers, row by row.
#[derive(Debug, Clone)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl Plane {
    pub(super) fn of(image: &GrayImage) -> Self {
        let data = image.as_raw().iter().map(|&value| f32::from(value)).collect();
        Plane { width: image.width() as usize, height: image.height() as usize, data }
    }

    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// Bilinear; `None` outside of the pixels' centres.
    pub(super) fn sample(&self, x: f32, y: f32) -> Option<f32> {
        let (left, top) = (x.floor(), y.floor());
        // Comparisons that a NaN fails.
        let inside = left >= 0.0 && top >= 0.0 && left + 1.0 < self.width as f32 && top + 1.0 < self.height as f32;
        if !inside {
            return None;
        }
        let (fx, fy) = (x - left, y - top);
        let at = top as usize * self.width + left as usize;
        let row = |at: usize| self.data[at] + fx * (self.data[at + 1] - self.data[at]);
        let (upper, lower) = (row(at), row(at + self.width));
        Some(upper + fy * (lower - upper))
    }

    /// Convolved with a Gaussian, edges repeated.
    pub(super) fn smoothed(&self, sigma: f32) -> Plane {
        let radius = (3.0 * sigma).ceil() as usize;
        let mut kernel: Vec<f32> =
            (0..=2 * radius).map(|k| (-0.5 * ((k as f32 - radius as f32) / sigma).powi(2)).exp()).collect();
        let sum: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|weight| *weight /= sum);
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0; self.data.len()];
        let mut padded = vec![0.0; width + 2 * radius];
        for (row, out) in self.data.chunks_exact(width).zip(across.chunks_exact_mut(width)) {
            padded[..radius].fill(row[0]);
            padded[radius..radius + width].copy_from_slice(row);
            padded[radius + width..].fill(row[width - 1]);
            for (k, weight) in kernel.iter().enumerate() {
                out.iter_mut().zip(&padded[k..k + width]).for_each(|(out, value)| *out += weight * value);
            }
        }
        let mut data = vec![0.0; self.data.len()];
        for (y, out) in data.chunks_exact_mut(width).enumerate() {
            for (k, weight) in kernel.iter().enumerate() {
                let from = (y + k).saturating_sub(radius).min(height - 1) * width;
                out.iter_mut().zip(&across[from..from + width]).for_each(|(out, value)| *out += weight * value);
            }
        }
        Plane { width, height, data }
    }

    /// Standard deviation of the image's noise, grey levels: the median of what a plane in three by three pixels does
    /// not explain (Immerkaer, "Fast noise variance estimation", 1996). At least that of rounding to whole grey levels.
    pub(super) fn noise(&self) -> f64 {
        let mut left = Vec::new();
        for y in (1..self.height.saturating_sub(1)).step_by(2) {
            for x in (1..self.width.saturating_sub(1)).step_by(3) {
                let row = |y: usize| self.at(x - 1, y) - 2.0 * self.at(x, y) + self.at(x + 1, y);
                left.push((row(y - 1) - 2.0 * row(y) + row(y + 1)).abs());
            }
        }
        let middle = left.len() / 2;
        if left.is_empty() {
            return ROUNDING;
        }
        let (_, median, _) = left.select_nth_unstable_by(middle, f32::total_cmp);
        // The operator's weights have the norm 6; half of a normal distribution is within 0.6745 sigma.
        (f64::from(*median) / (6.0 * 0.6745)).max(ROUNDING)
    }

    /// Half the size: means of two by two pixels. Pixel (x, y) there is at (2x + 0.5, 2y + 0.5) here.
    pub(super) fn halved(&self) -> Plane {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let sum = self.at(2 * x, 2 * y)
                    + self.at(2 * x + 1, 2 * y)
                    + self.at(2 * x, 2 * y + 1)
                    + self.at(2 * x + 1, 2 * y + 1);
                data.push(0.25 * sum);
            }
        }
        Plane { width, height, data }
    }

    /// Minus the determinant of the Hessian, zero at the edges and where it is no saddle.
    pub(super) fn saddle_strength(&self) -> Plane {
        let (width, height) = (self.width, self.height);
        let mut data = vec![0.0; self.data.len()];
        for y in 1..height.saturating_sub(1) {
            let (up, here, down) = (
                &self.data[(y - 1) * width..y * width],
                &self.data[y * width..(y + 1) * width],
                &self.data[(y + 1) * width..(y + 2) * width],
            );
            let out = &mut data[y * width..(y + 1) * width];
            for x in 1..width.saturating_sub(1) {
                let xx = here[x - 1] - 2.0 * here[x] + here[x + 1];
                let yy = up[x] - 2.0 * here[x] + down[x];
                let xy = 0.25 * (down[x + 1] - down[x - 1] - up[x + 1] + up[x - 1]);
                out[x] = (xy * xy - xx * yy).max(0.0);
            }
        }
        Plane { width, height, data }
    }
}

/// Standard deviation of rounding to whole grey levels, 1 / sqrt 12.
const ROUNDING: f64 = 0.289;

/// A place that looks like a corner of a checkerboard.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    pub x: f32,
    pub y: f32,
    /// Directions of its four edges, rad, from x towards y; between the first and the second it is dark.
    pub edges: [f32; 4],
    /// Half the difference of dark and bright, grey levels.
    pub contrast: f32,
}

/// Samples on the circle about a candidate.
const CIRCLE: usize = 32;
/// Its radius, px.
pub(super) const RADIUS: f32 = 4.5;
/// A smaller one, where something else reaches into the first: the marker of a small square.
const SMALL_RADIUS: f32 = 3.2;
/// Two edges include at least so much (25 deg) ...
const MIN_SECTOR: f32 = 0.44;
/// ... and opposite ones are on one line within so much (35 deg).
const MAX_BEND: f32 = 0.6;
/// Less contrast than this is noise, grey levels.
const MIN_CONTRAST: f32 = 4.0;
/// Candidates that are looked at at most, the strongest first.
const MOST: usize = 6000;
/// Saddles weaker than this part of the strongest ones are no candidates.
const WEAKEST: f32 = 0.01;

/// Candidates of a smoothed image, the strongest first.
pub(super) fn candidates(smooth: &Plane, strength: &Plane) -> Vec<Candidate> {
    let (width, height) = (strength.width, strength.height);
    let margin = RADIUS.ceil() as usize + 1;
    if width <= 2 * margin || height <= 2 * margin {
        return Vec::new();
    }
    let mut peaks: Vec<(f32, usize, usize)> = Vec::new();
    for y in margin..height - margin {
        for x in margin..width - margin {
            let here = strength.at(x, y);
            if here > 0.5 && is_peak(strength, x, y, here) {
                peaks.push((here, x, y));
            }
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1))));
    // The strongest few may be glints: "strong" is what the twentieth has.
    let strong = peaks.get(20.min(peaks.len().saturating_sub(1))).map_or(0.0, |peak| peak.0);
    peaks
        .iter()
        .take(MOST)
        .take_while(|peak| peak.0 > WEAKEST * strong)
        .filter_map(|&(_, x, y)| candidate(smooth, strength, x, y))
        .collect()
}

fn is_peak(strength: &Plane, x: usize, y: usize, here: f32) -> bool {
    (y - 2..=y + 2).all(|v| {
        (x - 2..=x + 2).all(|u| {
            let other = strength.at(u, v);
            // Of equal ones the first is the peak.
            other < here || other == here && (v, u) >= (y, x)
        })
    })
}

/// The candidate at a peak, or none if the circle about it does not look like a corner.
pub(super) fn candidate(smooth: &Plane, strength: &Plane, x: usize, y: usize) -> Option<Candidate> {
    let vertex = |before: f32, here: f32, after: f32| {
        let bend = before - 2.0 * here + after;
        if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
    };
    let here = strength.at(x, y);
    let px = x as f32 + vertex(strength.at(x - 1, y), here, strength.at(x + 1, y));
    let py = y as f32 + vertex(strength.at(x, y - 1), here, strength.at(x, y + 1));
    [RADIUS, SMALL_RADIUS].into_iter().find_map(|radius| on_circle(smooth, px, py, radius))
}

/// What a circle about a point shows, if it is a corner.
fn on_circle(smooth: &Plane, x: f32, y: f32, radius: f32) -> Option<Candidate> {
    let mut circle = [0.0f32; CIRCLE];
    for (k, value) in circle.iter_mut().enumerate() {
        let angle = 2.0 * PI * k as f32 / CIRCLE as f32;
        *value = smooth.sample(x + radius * angle.cos(), y + radius * angle.sin())?;
    }
    let (low, high) = circle.iter().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(*v), high.max(*v)));
    let contrast = 0.5 * (high - low);
    if contrast < MIN_CONTRAST {
        return None;
    }
    let middle = 0.5 * (high + low);
    let mut crossings = [(0.0f32, false); 4];
    let mut count = 0;
    for k in 0..CIRCLE {
        let (now, next) = (circle[k] - middle, circle[(k + 1) % CIRCLE] - middle);
        if (now < 0.0) != (next < 0.0) {
            if count == 4 {
                return None;
            }
            let angle = 2.0 * PI * (k as f32 + now / (now - next)) / CIRCLE as f32;
            // Whether it gets dark here.
            crossings[count] = (angle, next < 0.0);
            count += 1;
        }
    }
    if count != 4 {
        return None;
    }
    let first = usize::from(!crossings[0].1);
    let edges: [f32; 4] = std::array::from_fn(|k| {
        let turns = if first + k >= 4 { 2.0 * PI } else { 0.0 };
        crossings[(first + k) % 4].0 + turns
    });
    let sector = |k: usize| if k == 3 { edges[0] + 2.0 * PI - edges[3] } else { edges[k + 1] - edges[k] };
    let fits = (0..4).all(|k| sector(k) > MIN_SECTOR)
        && (edges[2] - edges[0] - PI).abs() < MAX_BEND
        && (edges[3] - edges[1] - PI).abs() < MAX_BEND;
    // Both dark sectors are dark and both bright ones bright: the mean of each is on its side.
    let whole = || {
        (0..4).all(|k| {
            let middle_of = edges[k] + 0.5 * sector(k);
            let at = (middle_of / (2.0 * PI) * CIRCLE as f32).round() as usize % CIRCLE;
            (circle[at] - middle) * if k % 2 == 0 { -1.0 } else { 1.0 } > 0.25 * contrast
        })
    };
    (fits && whole()).then_some(Candidate { x, y, edges, contrast })
}
