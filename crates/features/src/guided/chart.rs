//! Coordinates of image B in which the band around an epipolar line is an interval of the second one.
//!
//! Epipolar lines meet in the epipole. Counted by distance from it ("u") and direction (an angle modulo pi, "v"), a
//! band of half width `w` is, for all points at least `r` from the epipole, an interval of half width `asin(w / r)` of
//! the direction. Where the epipole is so far away that the lines are as good as parallel, and where there are no
//! lines, u and v run straight, along the lines and at a right angle to them. What is computed here only chooses whom
//! to look at: every interval may be too wide and none may be too narrow.

use crate::FeaturesError;
use nalgebra::{Point2, Vector2, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};

/// An epipole farther away than this many times the extent of the keypoints makes parallel lines.
const FAR: f64 = 1e5;
/// Slack of intervals, px, and relative to the coordinates: far more than rounding makes, far less than a threshold.
const SLACK_PX: f64 = 1e-6;
const SLACK_RELATIVE: f64 = 1e-13;

/// The smallest rectangle around the keypoints of an image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Extent {
    pub(super) middle: Point2<f64>,
    /// Half of its diagonal, px; at least one.
    pub(super) radius: f64,
}

impl Extent {
    /// Of at least one position.
    pub(super) fn of(positions: &[Point2<f64>]) -> Result<Self, FeaturesError> {
        let (mut low, mut high) = (positions[0], positions[0]);
        for position in positions {
            low = low.inf(position);
            high = high.sup(position);
        }
        let size = high - low;
        if !size.norm_squared().is_finite() {
            let what = "the extent of the positions of keypoints";
            return Err(FeaturesError::NotFinite { what, value: format!("{} x {}", size.x, size.y) });
        }
        Ok(Extent { middle: nalgebra::center(&low, &high), radius: (0.5 * size.norm()).max(1.0) })
    }

    fn slack_px(&self) -> f64 {
        SLACK_PX + SLACK_RELATIVE * (self.radius + self.middle.coords.norm())
    }
}

/// The coordinates.
#[derive(Debug, Clone, Copy)]
pub(super) enum Chart {
    /// About the epipole.
    Polar {
        epipole: Point2<f64>,
        /// How far lines pass by the epipole at most, px.
        off_px: f64,
        slack_px: f64,
    },
    /// Along this direction, of length one, from this point.
    Straight { origin: Point2<f64>, along: Vector2<f64>, slack_px: f64 },
}

/// A part of a line of numbers, or of a circle of length pi.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Interval {
    pub(super) centre: f64,
    pub(super) half: f64,
}

impl Interval {
    pub(super) const ALL: Interval = Interval { centre: 0.0, half: f64::INFINITY };

    /// One that contains what both contain.
    fn narrower(self, other: Interval) -> Interval {
        if self.half <= other.half { self } else { other }
    }
}

impl Chart {
    /// Suits lines with unit normals (zero ones do not matter).
    pub(super) fn of_lines(lines: &[Vector3<f64>], extent: &Extent) -> Chart {
        // In units of the extent about its middle, so that the cross product of two lines weighs well.
        let scaled = |line: &Vector3<f64>| {
            let at_middle = line.x * extent.middle.x + line.y * extent.middle.y + line.z;
            Vector3::new(line.x, line.y, at_middle / extent.radius)
        };
        let straight =
            |along: Vector2<f64>| Chart::Straight { origin: extent.middle, along, slack_px: extent.slack_px() };
        let some = lines.iter().filter(|line| line.x != 0.0 || line.y != 0.0);
        let few: Vec<Vector3<f64>> = some.clone().step_by((lines.len() / 64).max(1)).map(scaled).collect();
        let Some(first) = few.first() else { return straight(Vector2::x()) };
        // The line that differs most from the first, and the one that differs most from that.
        let farthest = |from: &Vector3<f64>| {
            let key = |line: &&Vector3<f64>| from.cross(line).norm_squared();
            few.iter().max_by(|a, b| key(a).total_cmp(&key(b))).copied().unwrap_or(*from)
        };
        let second = farthest(first);
        let meet = second.cross(&farthest(&second));
        let direction = Vector2::new(meet.x, meet.y);
        if meet == Vector3::zeros() {
            // All lines are one.
            return straight(Vector2::new(-first.y, first.x));
        }
        if direction.norm() > FAR * meet.z.abs() {
            return straight(direction.normalize());
        }
        let epipole = extent.middle + direction * (extent.radius / meet.z);
        let off_px = some.map(|line| (line.x * epipole.x + line.y * epipole.y + line.z).abs()).fold(0.0, f64::max);
        let slack_px = extent.slack_px() + SLACK_RELATIVE * (epipole - extent.middle).norm();
        Chart::Polar { epipole, off_px, slack_px }
    }

    /// For points without lines.
    pub(super) fn of_points(extent: &Extent) -> Chart {
        Chart::Straight { origin: extent.middle, along: Vector2::x(), slack_px: extent.slack_px() }
    }

    /// The coordinates u, v of a point; in the polar chart v is from -pi/2 to pi/2.
    pub(super) fn place(&self, point: &Point2<f64>) -> [f64; 2] {
        match self {
            Chart::Polar { epipole, .. } => {
                let from = point - epipole;
                [from.norm(), direction(from)]
            }
            Chart::Straight { origin, along, .. } => {
                let from = point - origin;
                [along.dot(&from), along.perp(&from)]
            }
        }
    }

    /// Whether v runs in a circle of length pi.
    pub(super) fn is_circular(&self) -> bool {
        matches!(self, Chart::Polar { .. })
    }

    /// Half of the interval of v that a band takes up at least this far from the epipole; nothing in the straight
    /// chart, where it depends on the line.
    pub(super) fn half_at(&self, u: f64, half_width_px: f64) -> f64 {
        match self {
            Chart::Polar { off_px, slack_px, .. } => {
                let width_px = half_width_px + off_px + slack_px;
                if u > width_px { (width_px / u).asin() * (1.0 + 1e-9) + 1e-12 } else { f64::INFINITY }
            }
            Chart::Straight { .. } => 0.0,
        }
    }

    /// The interval of v within which the band around a line lies for u from `from` to `to`; `half_at`
    /// is [`Chart::half_at`] of `from` or less.
    #[inline(always)]
    pub(super) fn of_band(&self, line: &ChartedLine, [from, to]: [f64; 2], half_at: f64) -> Interval {
        match *line {
            ChartedLine::Everywhere => Interval::ALL,
            ChartedLine::Polar { direction } => Interval { centre: direction, half: half_at },
            ChartedLine::Straight { start, slope, half } => {
                Interval { centre: start + slope * 0.5 * (from + to), half: half + 0.5 * slope.abs() * (to - from) }
            }
        }
    }

    /// A line with unit normal (or zero) prepared for [`Chart::of_band`].
    pub(super) fn charted(&self, line: &Vector3<f64>, half_width_px: f64) -> ChartedLine {
        if (line.x == 0.0 && line.y == 0.0) || half_width_px.is_infinite() {
            return ChartedLine::Everywhere;
        }
        match self {
            Chart::Polar { .. } => ChartedLine::Polar { direction: direction(Vector2::new(-line.y, line.x)) },
            Chart::Straight { origin, along, slack_px } => {
                // normal . (origin + u along + v across) + z = 0
                let at_origin = line.x * origin.x + line.y * origin.y + line.z;
                let by_u = line.x * along.x + line.y * along.y;
                let by_v = line.y * along.x - line.x * along.y;
                if by_v.abs() < 1e-3 {
                    return ChartedLine::Everywhere;
                }
                ChartedLine::Straight {
                    start: -at_origin / by_v,
                    slope: -by_u / by_v,
                    half: (half_width_px + slack_px + SLACK_RELATIVE * at_origin.abs()) / by_v.abs(),
                }
            }
        }
    }

    /// The intervals of u (as ends) and of v that hold a disc.
    pub(super) fn of_disc(&self, centre: &Point2<f64>, radius_px: f64) -> ([f64; 2], Interval) {
        let [u, v] = self.place(centre);
        let (Chart::Polar { slack_px, .. } | Chart::Straight { slack_px, .. }) = self;
        let radius = radius_px + slack_px + SLACK_RELATIVE * u.abs();
        let half = match self {
            Chart::Polar { .. } if radius < u => (radius / u).asin() + 1e-12,
            Chart::Polar { .. } => f64::INFINITY,
            Chart::Straight { .. } => radius,
        };
        ([u - radius, u + radius], Interval { centre: v, half })
    }

    /// An interval that contains each of a few.
    #[inline(always)]
    pub(super) fn union(&self, intervals: impl Iterator<Item = [Interval; 2]>) -> Interval {
        let (mut reference, mut low, mut high) = (None, f64::INFINITY, f64::NEG_INFINITY);
        for [band, disc] in intervals {
            let Interval { mut centre, half } = band.narrower(disc);
            let reference = *reference.get_or_insert(centre);
            if self.is_circular() {
                centre -= PI * ((centre - reference) / PI).round();
            }
            low = low.min(centre - half);
            high = high.max(centre + half);
        }
        if high - low < f64::INFINITY {
            return Interval { centre: 0.5 * (low + high), half: 0.5 * (high - low) * (1.0 + 1e-12) };
        }
        if reference.is_some() { Interval::ALL } else { Interval { centre: 0.0, half: -1.0 } }
    }
}

/// A line as the chart sees it.
#[derive(Debug, Clone, Copy)]
pub(super) enum ChartedLine {
    /// No line, or none that bounds v.
    Everywhere,
    /// Through the epipole.
    Polar { direction: f64 },
    /// `v = start + slope * u`, the band `half` to either side along v.
    Straight { start: f64, slope: f64, half: f64 },
}

/// The angle of a direction modulo pi, from -pi/2 to pi/2; 0 for none.
fn direction(of: Vector2<f64>) -> f64 {
    if of.x == 0.0 {
        return if of.y == 0.0 { 0.0 } else { FRAC_PI_2 };
    }
    (of.y / of.x).atan()
}
