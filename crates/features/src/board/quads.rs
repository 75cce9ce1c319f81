//! Dark quadrilaterals on bright ground, such as markers: thresholds at local means, connected pixels, four lines about
//! them.
//!
//! A marker nearly as large as its square is parted from the black squares by a white line of a pixel or two. A
//! threshold at the mean of a small neighbourhood keeps that line where any smoothing would close it; neighbourhoods of
//! several sizes serve small and large margins (Garrido-Jurado et al., "Automatic generation and detection of highly
//! reliable fiducial markers under occlusion", 2014).

use super::saddle::Plane;

/// Corners of a quadrilateral, clockwise in the image, px.
pub(super) type Quad = [(f64, f64); 4];

/// Half widths of the neighbourhoods, px; the smaller keep thin lines open, the larger see through blur and noise.
const HALF_WIDTHS: [usize; 5] = [2, 3, 5, 9, 16];
/// A dark pixel is below the local mean by so much, grey levels.
const BELOW_MEAN: f64 = 3.0;
/// Shortest side, px.
const MIN_SIDE_PX: f64 = 7.0;
/// Area of the quadrilateral over that of the convex hull; a disc has 0.64.
const MIN_FILL: f64 = 0.8;
/// Profiles across a side.
const PROFILES: usize = 16;
/// Half the length of a profile, px.
const PROFILE_PX: f64 = 2.5;
/// Step along a profile, px.
const PROFILE_STEP_PX: f64 = 0.25;

/// Sums over rectangles in constant time.
struct Integral {
    width: usize,
    height: usize,
    sums: Vec<f64>,
}

impl Integral {
    fn of(image: &Plane) -> Self {
        let stride = image.width + 1;
        let mut sums = vec![0.0; stride * (image.height + 1)];
        for y in 0..image.height {
            let mut row = 0.0;
            for x in 0..image.width {
                row += f64::from(image.at(x, y));
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        Integral { width: image.width, height: image.height, sums }
    }

    /// Mean over the pixels within `half` of one, as far as they are in the image.
    fn mean(&self, x: usize, y: usize, half: usize) -> f64 {
        let (left, right) = (x.saturating_sub(half), (x + half + 1).min(self.width));
        let (top, bottom) = (y.saturating_sub(half), (y + half + 1).min(self.height));
        let at = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        let sum = at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top);
        sum / ((right - left) * (bottom - top)) as f64
    }
}

/// Dark pixels of one row that touch each other.
#[derive(Debug, Clone, Copy)]
struct Run {
    y: usize,
    first: usize,
    last: usize,
}

/// Quadrilaterals of an image in a fixed order; the same one may come from several neighbourhoods.
pub(super) fn dark_quads(image: &Plane) -> Vec<Quad> {
    let integral = Integral::of(image);
    let mut quads = Vec::new();
    for half in HALF_WIDTHS {
        for outline in outlines(image, &integral, half) {
            quads.extend(quad_of(&outline).and_then(|quad| sharpened(image, &quad)));
        }
    }
    quads
}

/// The convex hulls of connected dark pixels that may be a marker's, by pixels' centres.
fn outlines(image: &Plane, integral: &Integral, half: usize) -> Vec<Vec<(f64, f64)>> {
    let mut runs: Vec<Run> = Vec::new();
    let mut parents: Vec<usize> = Vec::new();
    let mut above = 0..0;
    for y in 0..image.height {
        let begin = runs.len();
        let mut open: Option<usize> = None;
        for x in 0..=image.width {
            let dark = x < image.width && f64::from(image.at(x, y)) < integral.mean(x, y, half) - BELOW_MEAN;
            match open {
                None if dark => open = Some(x),
                Some(first) if !dark => {
                    parents.push(runs.len());
                    runs.push(Run { y, first, last: x - 1 });
                    open = None;
                }
                _ => {}
            }
        }
        let mut from = above.start;
        for at in begin..runs.len() {
            while from < above.end && runs[from].last < runs[at].first {
                from += 1;
            }
            let mut other = from;
            while other < above.end && runs[other].first <= runs[at].last {
                join(&mut parents, at, other);
                other += 1;
            }
        }
        above = begin..runs.len();
    }
    let mut members: Vec<(usize, usize)> = (0..runs.len()).map(|at| (root(&mut parents, at), at)).collect();
    members.sort_unstable();
    let whole = |runs: &[Run]| hull_of(runs, image.width, image.height);
    members
        .chunk_by(|a, b| a.0 == b.0)
        .filter_map(|group| whole(&group.iter().map(|&(_, at)| runs[at]).collect::<Vec<_>>()))
        .collect()
}

fn root(parents: &mut [usize], mut at: usize) -> usize {
    while parents[at] != at {
        parents[at] = parents[parents[at]];
        at = parents[at];
    }
    at
}

fn join(parents: &mut [usize], a: usize, b: usize) {
    let (a, b) = (root(parents, a), root(parents, b));
    // The first run names its component, so that the order is that of the image.
    parents[a.max(b)] = a.min(b);
}

/// The convex hull of runs (ordered by row), clockwise in the image; `None` for what is small or touches the image's
/// edge.
fn hull_of(runs: &[Run], width: usize, height: usize) -> Option<Vec<(f64, f64)>> {
    let (first, last) = (runs.first()?, runs.last()?);
    let left = runs.iter().map(|run| run.first).min()?;
    let right = runs.iter().map(|run| run.last).max()?;
    let inside = first.y > 0 && last.y + 1 < height && left > 0 && right + 1 < width;
    let large = (last.y - first.y) as f64 >= 0.7 * MIN_SIDE_PX && (right - left) as f64 >= 0.7 * MIN_SIDE_PX;
    if !inside || !large {
        return None;
    }
    let mut points: Vec<(f64, f64)> = Vec::new();
    for row in runs.chunk_by(|a, b| a.y == b.y) {
        points.push((row[0].first as f64, row[0].y as f64));
        points.push((row[row.len() - 1].last as f64, row[0].y as f64));
    }
    points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    points.dedup();
    // Andrew's monotone chain.
    let chain = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut hull: Vec<(f64, f64)> = Vec::new();
        for point in points {
            while let [.., a, b] = hull[..]
                && turn(a, b, point) <= 0.0
            {
                hull.pop();
            }
            hull.push(point);
        }
        hull.pop();
        hull
    };
    let mut hull = chain(&mut points.iter().copied());
    hull.extend(chain(&mut points.iter().rev().copied()));
    (hull.len() >= 4).then_some(hull)
}

/// Twice the area of a triangle, positive where it is clockwise in the image.
fn turn(a: (f64, f64), b: (f64, f64), c: (f64, f64)) -> f64 {
    (b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)
}

fn area(polygon: &[(f64, f64)]) -> f64 {
    (0..polygon.len()).map(|k| 0.5 * turn((0.0, 0.0), polygon[k], polygon[(k + 1) % polygon.len()])).sum()
}

/// The four corners of a hull that carry its area; `None` if it is not four-cornered.
fn quad_of(hull: &[(f64, f64)]) -> Option<Quad> {
    let mut left = hull.to_vec();
    while left.len() > 4 {
        let count = left.len();
        let cost = |k: usize| turn(left[(k + count - 1) % count], left[k], left[(k + 1) % count]);
        let least = (0..count).min_by(|&a, &b| cost(a).total_cmp(&cost(b)))?;
        left.remove(least);
    }
    let quad: Quad = left.try_into().ok()?;
    let long = (0..4).all(|k| {
        let (a, b) = (quad[k], quad[(k + 1) % 4]);
        (b.0 - a.0).hypot(b.1 - a.1) >= MIN_SIDE_PX - 1.0
    });
    (long && area(&quad) >= MIN_FILL * area(hull)).then_some(quad)
}

/// The quadrilateral of the four lines where the image brightens most, near the sides of the given one.
fn sharpened(image: &Plane, quad: &Quad) -> Option<Quad> {
    // A line as a point and its direction.
    let mut lines = [((0.0, 0.0), (0.0, 0.0)); 4];
    for (k, line) in lines.iter_mut().enumerate() {
        let (a, b) = (quad[k], quad[(k + 1) % 4]);
        let length = (b.0 - a.0).hypot(b.1 - a.1);
        let along = ((b.0 - a.0) / length, (b.1 - a.1) / length);
        // Clockwise in the image, outside is on the left; dark pixels end half a pixel beyond their centres.
        let out = (along.1, -along.0);
        let offsets: Vec<(f64, f64)> = (0..PROFILES)
            .filter_map(|at| {
                let s = length * (0.12 + 0.76 * (at as f64 + 0.5) / PROFILES as f64);
                let base = (a.0 + s * along.0 + 0.5 * out.0, a.1 + s * along.1 + 0.5 * out.1);
                Some((s, brightest_step(image, base, out)? + 0.5))
            })
            .collect();
        let (level, slope) = line_through(&offsets)?;
        let point = |s: f64| {
            let offset = level + slope * s;
            (a.0 + s * along.0 + offset * out.0, a.1 + s * along.1 + offset * out.1)
        };
        let (start, end) = (point(0.0), point(length));
        *line = (start, (end.0 - start.0, end.1 - start.1));
    }
    let mut corners = [(0.0, 0.0); 4];
    for (k, corner) in corners.iter_mut().enumerate() {
        let ((p, d), (q, e)) = (lines[(k + 3) % 4], lines[k]);
        let cross = d.0 * e.1 - d.1 * e.0;
        let s = ((q.0 - p.0) * e.1 - (q.1 - p.1) * e.0) / cross;
        *corner = (p.0 + s * d.0, p.1 + s * d.1);
        let moved = (corner.0 - quad[k].0).hypot(corner.1 - quad[k].1);
        if moved.is_nan() || moved > 2.0 * PROFILE_PX {
            return None;
        }
    }
    Some(corners)
}

/// Where the image brightens most on a line across a side, px from its middle.
fn brightest_step(image: &Plane, (x, y): (f64, f64), out: (f64, f64)) -> Option<f64> {
    let steps = (PROFILE_PX / PROFILE_STEP_PX) as i32;
    let sample = |t: f64| image.sample((x + t * out.0) as f32, (y + t * out.1) as f32).map(f64::from);
    let mut slopes = Vec::with_capacity(2 * steps as usize + 1);
    for k in -steps..=steps {
        let t = f64::from(k) * PROFILE_STEP_PX;
        slopes.push(sample(t + 0.5)? - sample(t - 0.5)?);
    }
    let best = (1..slopes.len() - 1).max_by(|&a, &b| slopes[a].total_cmp(&slopes[b]).then(b.cmp(&a)))?;
    let (before, here, after) = (slopes[best - 1], slopes[best], slopes[best + 1]);
    let bend = before - 2.0 * here + after;
    let shift = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    (here > 0.0).then_some((best as f64 - f64::from(steps) + shift) * PROFILE_STEP_PX)
}

/// Level and slope through most of the points: least squares, and again without what is far off.
fn line_through(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let mut kept: Vec<(f64, f64)> = points.to_vec();
    let mut offsets: Vec<f64> = points.iter().map(|point| point.1).collect();
    offsets.sort_by(f64::total_cmp);
    let (mut level, mut slope) = (*offsets.get(offsets.len() / 2)?, 0.0);
    for tolerance_px in [1.5, 0.8, 0.8] {
        kept.clear();
        kept.extend(points.iter().filter(|point| (point.1 - level - slope * point.0).abs() <= tolerance_px));
        if kept.len() < PROFILES / 2 {
            return None;
        }
        let count = kept.len() as f64;
        let (s, t) = kept.iter().fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        let (s, t) = (s / count, t / count);
        let (mut ss, mut st) = (0.0, 0.0);
        for point in &kept {
            ss += (point.0 - s).powi(2);
            st += (point.0 - s) * (point.1 - t);
        }
        slope = if ss > 0.0 { st / ss } else { 0.0 };
        level = t - slope * s;
    }
    Some((level, slope))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A dark quadrilateral, 4 x 4 samples a pixel, with a dark frame about it at a distance.
    fn image(quad: &Quad, gap_px: f64) -> Plane {
        let (width, height) = (80, 60);
        let outside = |x: f64, y: f64| {
            (0..4).map(move |k| {
                let (a, b) = (quad[k], quad[(k + 1) % 4]);
                -turn(a, b, (x, y)) / (b.0 - a.0).hypot(b.1 - a.1)
            })
        };
        let bright = |x: f64, y: f64| {
            let distance = outside(x, y).fold(f64::MIN, f64::max);
            f64::from(u8::from(distance > 0.0 && distance < gap_px))
        };
        let data = (0..width * height)
            .map(|at| {
                let (x, y) = ((at % width) as f64, (at / width) as f64);
                let offset = |k: usize| (k as f64 + 0.5) / 4.0 - 0.5;
                let sum: f64 = (0..16).map(|k| bright(x + offset(k % 4), y + offset(k / 4))).sum();
                (20.0 + 180.0 * sum / 16.0) as f32
            })
            .collect();
        Plane { width, height, data }
    }

    #[test]
    fn a_quadrilateral_is_found_through_a_gap_of_little_more_than_a_pixel() {
        let quad = [(22.3, 14.6), (55.1, 17.2), (52.4, 46.9), (18.7, 42.1)];
        for (gap_px, tolerance_px) in [(1.3, 0.6), (3.0, 0.15), (20.0, 0.15)] {
            let found = dark_quads(&image(&quad, gap_px).smoothed(0.6));
            let off = |other: &Quad| {
                let from = |turns: usize| {
                    let distance = |k: usize| {
                        let (a, b) = (other[(k + turns) % 4], quad[k]);
                        (a.0 - b.0).hypot(a.1 - b.1)
                    };
                    (0..4).map(distance).fold(0.0, f64::max)
                };
                (0..4).map(from).fold(f64::MAX, f64::min)
            };
            let nearest = found.iter().map(off).fold(f64::MAX, f64::min);
            assert!(nearest < tolerance_px, "gap of {gap_px} px: off by {nearest} px");
        }
    }

    #[test]
    fn discs_and_flat_images_hold_no_quadrilateral() {
        let disc = |x: usize, y: usize| (x as f64 - 40.0).hypot(y as f64 - 30.0) < 18.0;
        let data = (0..80 * 60).map(|at| if disc(at % 80, at / 80) { 20.0 } else { 200.0 }).collect();
        assert!(dark_quads(&Plane { width: 80, height: 60, data }).is_empty());
        assert!(dark_quads(&Plane { width: 80, height: 60, data: vec![7.0; 4800] }).is_empty());
    }
}
