//! Which of the maxima of the single levels are extrema over space and scale.
//!
//! Within a level, of two maxima closer than the level's step the stronger one stays (taken in descending order of
//! their responses, so that the result does not depend on where in the image they lie). Between neighbouring levels, a
//! maximum goes if a stronger one lies within the coarser level's step of it: first against the level above, then what
//! is left of a level acts on the level above. All distances are between pixel centres.

use super::evolve::Candidate;
use super::plan::Level;

/// Points of a level in rows from top to bottom, and where each row begins.
#[derive(Debug, Default)]
pub(crate) struct Rows {
    /// The points, row by row and from left to right.
    pub points: Vec<Candidate>,
    /// First point of each row, and the number of points at the end.
    row_start: Vec<u32>,
}

impl Rows {
    /// Takes points that are in order.
    pub(crate) fn fill(&mut self, points: impl IntoIterator<Item = Candidate>, height: usize) {
        self.points.clear();
        self.points.extend(points);
        self.row_start.clear();
        self.row_start.resize(height + 1, 0);
        for p in &self.points {
            self.row_start[p.y as usize + 1] += 1;
        }
        for y in 0..height {
            self.row_start[y + 1] += self.row_start[y];
        }
    }

    /// Indices of the points whose pixel lies within `reach` of a position, in order, with the squared distance.
    pub(crate) fn near(&self, [x, y]: [f32; 2], reach: f32) -> impl Iterator<Item = (usize, f32)> {
        let height = self.row_start.len().saturating_sub(1);
        let top = (y - reach).ceil().max(0.0) as usize;
        let bottom = ((y + reach).floor().max(-1.0) + 1.0) as usize;
        (top..bottom.min(height)).flat_map(move |row| {
            let (start, end) = (self.row_start[row] as usize, self.row_start[row + 1] as usize);
            let points = &self.points[start..end];
            let first = points.partition_point(|p| (p.x as f32) < x - reach);
            points[first..]
                .iter()
                .take_while(move |p| p.x as f32 <= x + reach)
                .map(move |p| (p.x as f32 - x).powi(2) + (p.y as f32 - y).powi(2))
                .enumerate()
                .map(move |(i, d2)| (start + first + i, d2))
                .filter(move |&(_, d2)| d2 <= reach * reach)
        })
    }
}

/// The maxima of one level that pass the threshold, and what has become of them.
#[derive(Debug, Default)]
pub(crate) struct LevelMaxima {
    /// Those that are the strongest of their level's neighbourhood.
    pub kept: Rows,
    /// Whether a stronger one in the level above lies near.
    pub beaten_from_above: Vec<bool>,
    /// Whether a stronger one in the level below lies near.
    pub beaten_from_below: Vec<bool>,
}

impl LevelMaxima {
    /// Keeps of the level's maxima the strongest within the level's step.
    pub(crate) fn fill(&mut self, all: &Rows, level: &Level) {
        let at = |i: u32| &all.points[i as usize];
        let mut order: Vec<u32> = (0..all.points.len() as u32).collect();
        order.sort_unstable_by(|&a, &b| at(b).response.total_cmp(&at(a).response).then(a.cmp(&b)));
        let mut keep = vec![false; all.points.len()];
        for &i in &order {
            let c = at(i);
            let taken = all.near([c.x as f32, c.y as f32], level.step as f32).any(|(j, _)| keep[j]);
            keep[i as usize] = !taken;
        }
        self.kept.fill(all.points.iter().zip(&keep).filter(|(_, k)| **k).map(|(p, _)| *p), level.height);
        for flags in [&mut self.beaten_from_above, &mut self.beaten_from_below] {
            flags.clear();
            flags.resize(self.kept.points.len(), false);
        }
    }

    /// Whether a point counts as an extremum once both of its neighbouring levels are known.
    pub(crate) fn is_extremum(&self, index: usize) -> bool {
        !self.beaten_from_above[index] && !self.beaten_from_below[index]
    }
}

/// Non-maximum suppression between two neighbouring levels.
pub(crate) fn suppress_between(lower: &mut LevelMaxima, low: &Level, upper: &mut LevelMaxima, up: &Level) {
    let reach = up.step as f32;
    for (p, beaten) in lower.kept.points.iter().zip(&mut lower.beaten_from_above) {
        let at = [p.x, p.y].map(|c| up.level_from_image(low.to_image(c as f32)));
        *beaten = upper.kept.near(at, reach).any(|(j, _)| upper.kept.points[j].response > p.response);
    }
    // A pixel of the coarser level in pixels of the finer one: 1 within an octave, 2 between octaves.
    let reach = reach * up.ratio() / low.ratio();
    for (p, beaten) in upper.kept.points.iter().zip(&mut upper.beaten_from_below) {
        let at = [p.x, p.y].map(|c| low.level_from_image(up.to_image(c as f32)));
        *beaten = lower
            .kept
            .near(at, reach)
            .any(|(i, _)| !lower.beaten_from_above[i] && lower.kept.points[i].response > p.response);
    }
}

#[cfg(test)]
mod tests {
    use super::super::options::AkazeOptions;
    use super::super::plan::levels;
    use super::*;

    fn candidate(x: u32, y: u32, response: f32) -> Candidate {
        Candidate { x, y, response, offset: Some([0.0; 2]) }
    }

    fn rows(points: &[Candidate], level: &Level) -> Rows {
        let mut rows = Rows::default();
        rows.fill(points.iter().copied(), level.height);
        rows
    }

    #[test]
    fn the_strongest_of_a_neighbourhood_stays() {
        let levels = levels(200, 200, &AkazeOptions::default());
        let mut maxima = LevelMaxima::default();
        // A chain: 3 beats 2, and 1 is far enough from 3.
        let chain = [candidate(50, 50, 1.0), candidate(52, 50, 2.0), candidate(54, 50, 3.0)];
        maxima.fill(&rows(&chain, &levels[0]), &levels[0]);
        assert_eq!(maxima.kept.points.iter().map(|p| p.response).collect::<Vec<_>>(), [1.0, 3.0]);
    }

    #[test]
    fn levels_suppress_each_other_across_an_octave_at_pixel_centres() {
        let levels = levels(400, 400, &AkazeOptions::default());
        let (low, up) = (&levels[3], &levels[4]);
        let (mut a, mut b) = (LevelMaxima::default(), LevelMaxima::default());
        // Pixel 50 of the upper level has its centre at 100.5 of the lower; the reach is 2 * 2 pixels.
        a.fill(&rows(&[candidate(97, 100, 1.0), candidate(105, 100, 1.0)], low), low);
        b.fill(&rows(&[candidate(50, 50, 2.0)], up), up);
        suppress_between(&mut a, low, &mut b, up);
        assert_eq!(a.beaten_from_above, [true, false]);
        assert!(b.is_extremum(0));
        // The other way round: a stronger one below.
        a.fill(&rows(&[candidate(104, 100, 3.0)], low), low);
        suppress_between(&mut a, low, &mut b, up);
        assert!(a.is_extremum(0) && !b.is_extremum(0));
    }

    #[test]
    fn the_search_finds_what_a_plain_one_finds() {
        let levels = levels(100, 100, &AkazeOptions::default());
        let points: Vec<Candidate> = (0..400u32).map(|i| candidate(i * 37 % 100, i / 4, 1.0)).collect::<Vec<_>>();
        let mut sorted = points.clone();
        sorted.sort_by_key(|p| (p.y, p.x));
        let rows = rows(&sorted, &levels[0]);
        for (x, y, reach) in [(0.0, 0.0, 5.0), (50.3, 49.5, 3.0), (99.0, 99.0, 8.0), (120.0, 50.0, 10.0)] {
            let found: Vec<usize> = rows.near([x, y], reach).map(|(i, _)| i).collect();
            let plain: Vec<usize> = (0..sorted.len())
                .filter(|&i| (sorted[i].x as f32 - x).hypot(sorted[i].y as f32 - y) <= reach)
                .collect();
            assert_eq!(found, plain);
        }
    }
}
