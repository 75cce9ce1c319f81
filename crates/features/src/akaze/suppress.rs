//! Which of the maxima of the single levels are extrema over space and scale.
//!
//! Within a level, of two maxima closer than the level's step the stronger one stays (taken in descending order of
//! their responses, so that the result does not depend on where in the image they lie). Between neighbouring levels, a
//! maximum goes if a stronger one lies within the coarser level's step of it: first against the level above, then what
//! is left of a level acts on the level above. All distances are between pixel centres.

use super::evolve::Candidate;
use super::plan::Level;

/// The maxima of one level, in rows from top to bottom, and what has become of them.
#[derive(Debug, Default)]
pub(crate) struct LevelMaxima {
    /// Those that are the strongest of their level's neighbourhood.
    pub points: Vec<Candidate>,
    /// Whether a stronger one in the level above lies near.
    pub beaten_from_above: Vec<bool>,
    /// Whether a stronger one in the level below lies near.
    pub beaten_from_below: Vec<bool>,
    /// First point of each row, and the number of points at the end.
    row_start: Vec<u32>,
}

impl LevelMaxima {
    /// Keeps of `candidates` (row by row) the strongest within the level's step.
    pub(crate) fn fill(&mut self, candidates: &[Candidate], level: &Level) {
        self.points.clear();
        self.points.extend_from_slice(candidates);
        self.index_rows(level.height);

        let mut order: Vec<u32> = (0..candidates.len() as u32).collect();
        order.sort_unstable_by(|&a, &b| {
            let (ca, cb) = (&candidates[a as usize], &candidates[b as usize]);
            cb.response.total_cmp(&ca.response).then(a.cmp(&b))
        });
        let mut kept = vec![false; candidates.len()];
        let reach = level.step as f32;
        for &i in &order {
            let c = &candidates[i as usize];
            kept[i as usize] = !self.any_near(c.x as f32, c.y as f32, reach, |j| kept[j]);
        }
        let mut keep = kept.iter();
        self.points.retain(|_| *keep.next().expect("one flag a candidate"));
        self.index_rows(level.height);
        for flags in [&mut self.beaten_from_above, &mut self.beaten_from_below] {
            flags.clear();
            flags.resize(self.points.len(), false);
        }
    }

    fn index_rows(&mut self, height: usize) {
        self.row_start.clear();
        self.row_start.resize(height + 1, 0);
        for p in &self.points {
            self.row_start[p.y as usize + 1] += 1;
        }
        for y in 0..height {
            self.row_start[y + 1] += self.row_start[y];
        }
    }

    /// Whether a point that passes the test lies within `reach` of a position in this level's pixels.
    fn any_near(&self, x: f32, y: f32, reach: f32, test: impl Fn(usize) -> bool) -> bool {
        let height = self.row_start.len() - 1;
        let top = (y - reach).ceil().max(0.0) as usize;
        let bottom = ((y + reach).floor().max(-1.0) + 1.0) as usize;
        for row in top..bottom.min(height) {
            let (start, end) = (self.row_start[row] as usize, self.row_start[row + 1] as usize);
            let points = &self.points[start..end];
            let first = points.partition_point(|p| (p.x as f32) < x - reach);
            for (i, p) in points.iter().enumerate().skip(first) {
                let (dx, dy) = (p.x as f32 - x, p.y as f32 - y);
                if dx > reach {
                    break;
                }
                if dx * dx + dy * dy <= reach * reach && test(start + i) {
                    return true;
                }
            }
        }
        false
    }

    /// Whether a point counts as an extremum once both of its neighbouring levels are known.
    pub(crate) fn is_extremum(&self, index: usize) -> bool {
        !self.beaten_from_above[index] && !self.beaten_from_below[index]
    }
}

/// Lets the maxima of two neighbouring levels compete.
pub(crate) fn compete(lower: &mut LevelMaxima, low: &Level, upper: &mut LevelMaxima, up: &Level) {
    // A pixel of the coarser level in pixels of the finer one: 1 within an octave, 2 between octaves.
    let ratio = up.ratio() / low.ratio();
    let shift = 0.5 * (ratio - 1.0);
    let reach = up.step as f32;
    for i in 0..lower.points.len() {
        let p = lower.points[i];
        let (x, y) = ((p.x as f32 - shift) / ratio, (p.y as f32 - shift) / ratio);
        lower.beaten_from_above[i] = upper.any_near(x, y, reach, |j| upper.points[j].response > p.response);
    }
    for j in 0..upper.points.len() {
        let p = upper.points[j];
        let (x, y) = (p.x as f32 * ratio + shift, p.y as f32 * ratio + shift);
        upper.beaten_from_below[j] = lower
            .any_near(x, y, reach * ratio, |i| !lower.beaten_from_above[i] && lower.points[i].response > p.response);
    }
}

#[cfg(test)]
mod tests {
    use super::super::options::AkazeOptions;
    use super::super::plan::levels;
    use super::*;

    fn candidate(x: u32, y: u32, response: f32) -> Candidate {
        Candidate { x, y, response, offset: [0.0; 2] }
    }

    #[test]
    fn the_strongest_of_a_neighbourhood_stays() {
        let levels = levels(200, 200, &AkazeOptions::default());
        let mut maxima = LevelMaxima::default();
        // A chain: 3 beats 2, and 1 stands far enough from 3.
        let chain = [candidate(50, 50, 1.0), candidate(52, 50, 2.0), candidate(54, 50, 3.0)];
        maxima.fill(&chain, &levels[0]);
        assert_eq!(maxima.points.iter().map(|p| p.response).collect::<Vec<_>>(), [1.0, 3.0]);
    }

    #[test]
    fn levels_compete_across_an_octave_at_pixel_centres() {
        let levels = levels(400, 400, &AkazeOptions::default());
        let (low, up) = (&levels[3], &levels[4]);
        let (mut a, mut b) = (LevelMaxima::default(), LevelMaxima::default());
        // Pixel 50 of the upper level has its centre at 100.5 of the lower; the reach is 2 * 2 pixels.
        a.fill(&[candidate(97, 100, 1.0), candidate(105, 100, 1.0)], low);
        b.fill(&[candidate(50, 50, 2.0)], up);
        compete(&mut a, low, &mut b, up);
        assert_eq!(a.beaten_from_above, [true, false]);
        assert!(b.is_extremum(0));
        // The other way round: a stronger one below.
        a.fill(&[candidate(104, 100, 3.0)], low);
        compete(&mut a, low, &mut b, up);
        assert!(a.is_extremum(0) && !b.is_extremum(0));
    }
}
