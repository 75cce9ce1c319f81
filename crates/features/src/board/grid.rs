//! From candidates to grids: who is whose neighbour, and which column and row that makes.

use super::saddle::{Candidate, Plane, RADIUS, candidate};
use std::collections::{BTreeMap, VecDeque};
use std::f32::consts::{PI, TAU};

/// A neighbour lies along an edge within so much (17 deg), and looks back as straight.
const ASIDE: f32 = 0.3;
/// Contrasts of neighbours differ by at most this factor.
const CONTRAST_RATIO: f32 = 4.0;
/// So do the distances to opposite neighbours.
const STEP_RATIO: f32 = 1.7;
/// A corner lies on the middle between its opposite neighbours within this part of their distance.
const OFF_MIDDLE: f32 = 0.12;
/// A missing corner is looked for within this part of a square of where its neighbours point.
const SEARCH: f32 = 0.2;

/// Corners with columns and rows, counted from anywhere.
#[derive(Debug, Clone, Default)]
pub(super) struct Grid {
    /// By row and column.
    pub corners: BTreeMap<(i32, i32), (f32, f32)>,
    /// Whether the square at larger column and row of the corner with even `column + row` is dark.
    pub even_is_dark: bool,
}

/// The four directions of a grid: +column, +row, -column, -row.
const STEPS: [(i32, i32); 4] = [(0, 1), (1, 0), (0, -1), (-1, 0)];

fn apart(a: f32, b: f32) -> f32 {
    let turn = (a - b).rem_euclid(TAU);
    turn.min(TAU - turn)
}

/// For each candidate and each of its edges, the neighbour and the edge by which that looks back.
fn links(candidates: &[Candidate]) -> Vec<[Option<(usize, usize)>; 4]> {
    let towards = |from: usize, edge: usize| -> Option<(usize, usize)> {
        let p = &candidates[from];
        let mut best: Option<(f32, usize, usize)> = None;
        for (at, q) in candidates.iter().enumerate() {
            let (dx, dy) = (q.x - p.x, q.y - p.y);
            let length = dx.hypot(dy);
            if at == from || best.is_some_and(|(cost, ..)| length >= cost) || length < 4.0 {
                continue;
            }
            let angle = dy.atan2(dx);
            let aside = apart(angle, p.edges[edge]);
            let ratio = q.contrast / p.contrast;
            if aside > ASIDE || !(1.0 / CONTRAST_RATIO..=CONTRAST_RATIO).contains(&ratio) {
                continue;
            }
            // Dark and bright swap sides: an edge at which it gets dark answers one at which it gets bright.
            let back = [0, 2].map(|k| k + 1 - edge % 2).into_iter().find(|&k| apart(angle + PI, q.edges[k]) < ASIDE);
            if let Some(back) = back {
                let cost = length * (1.0 + 2.0 * (aside + apart(angle + PI, q.edges[back])));
                if best.is_none_or(|(least, ..)| cost < least) {
                    best = Some((cost, at, back));
                }
            }
        }
        best.map(|(_, at, back)| (at, back))
    };
    let wished: Vec<[Option<(usize, usize)>; 4]> =
        (0..candidates.len()).map(|from| std::array::from_fn(|edge| towards(from, edge))).collect();
    // Only what is mutual holds.
    let mut links: Vec<[Option<(usize, usize)>; 4]> = (0..candidates.len())
        .map(|from| {
            std::array::from_fn(|edge| wished[from][edge].filter(|&(to, back)| wished[to][back] == Some((from, edge))))
        })
        .collect();
    drop_uneven(candidates, &mut links);
    links
}

/// Steps to opposite sides are of like length; where they are not, the longer one leaps over something.
fn drop_uneven(candidates: &[Candidate], links: &mut [[Option<(usize, usize)>; 4]]) {
    let length = |a: usize, b: usize| {
        let (a, b) = (&candidates[a], &candidates[b]);
        (a.x - b.x).hypot(a.y - b.y)
    };
    let mut dropped = Vec::new();
    for (from, of) in links.iter().enumerate() {
        for edge in 0..2 {
            if let (Some((a, _)), Some((b, _))) = (of[edge], of[edge + 2]) {
                let (to_a, to_b) = (length(from, a), length(from, b));
                if to_a > STEP_RATIO * to_b {
                    dropped.push((from, edge));
                } else if to_b > STEP_RATIO * to_a {
                    dropped.push((from, edge + 2));
                }
            }
        }
    }
    for (from, edge) in dropped {
        if let Some((to, back)) = links[from][edge].take() {
            links[to][back] = None;
        }
    }
}

/// Grids over the candidates, the largest first.
pub(super) fn grids(candidates: &[Candidate]) -> Vec<Grid> {
    let links = links(candidates);
    let mut placed = vec![false; candidates.len()];
    let mut grids = Vec::new();
    for seed in 0..candidates.len() {
        if placed[seed] || links[seed].iter().flatten().count() < 2 {
            continue;
        }
        // Where each corner is, and which of its edges points along +column.
        let mut members: BTreeMap<(i32, i32), usize> = BTreeMap::new();
        let mut queue = VecDeque::from([(seed, 0usize, (0i32, 0i32))]);
        placed[seed] = true;
        members.insert((0, 0), seed);
        while let Some((at, turn, (row, column))) = queue.pop_front() {
            for (direction, step) in STEPS.iter().enumerate() {
                let Some((to, back)) = links[at][(direction + turn) % 4] else { continue };
                let place = (row + step.0, column + step.1);
                if placed[to] || members.contains_key(&place) {
                    continue;
                }
                placed[to] = true;
                members.insert(place, to);
                // Its edge `back` points along the opposite direction.
                queue.push_back((to, (back + 4 - (direction + 2) % 4) % 4, place));
            }
        }
        if members.len() >= 4 {
            let corners =
                members.into_iter().map(|(place, at)| (place, (candidates[at].x, candidates[at].y))).collect();
            // The seed's first edge points along +column, and what follows an even edge is dark.
            let mut grid = Grid { corners, even_is_dark: true };
            grid.drop_bent();
            grids.push(grid);
        }
    }
    grids.sort_by_key(|grid| std::cmp::Reverse(grid.corners.len()));
    grids
}

impl Grid {
    /// Whether the square at larger column and row of a corner is dark.
    pub(super) fn is_dark(&self, row: i32, column: i32) -> bool {
        ((row + column).rem_euclid(2) == 0) == self.even_is_dark
    }

    pub(super) fn at(&self, row: i32, column: i32) -> Option<(f32, f32)> {
        self.corners.get(&(row, column)).copied()
    }

    /// Least and greatest row and column.
    pub(super) fn bounds(&self) -> ((i32, i32), (i32, i32)) {
        let rows = self.corners.keys().map(|place| place.0);
        let columns = self.corners.keys().map(|place| place.1);
        let range = |mut values: Box<dyn Iterator<Item = i32> + '_>| {
            let first = values.next().unwrap_or(0);
            values.fold((first, first), |(low, high), v| (low.min(v), high.max(v)))
        };
        (range(Box::new(rows)), range(Box::new(columns)))
    }

    /// Shortest step to a neighbour, px.
    pub(super) fn step(&self, row: i32, column: i32) -> Option<f32> {
        let (x, y) = self.at(row, column)?;
        STEPS
            .iter()
            .filter_map(|(dr, dc)| self.at(row + dr, column + dc))
            .map(|(u, v)| (u - x).hypot(v - y))
            .min_by(f32::total_cmp)
    }

    /// Corners that are not between their neighbours go.
    pub(super) fn drop_bent(&mut self) {
        let bent = |&(row, column): &(i32, i32)| {
            let Some((x, y)) = self.at(row, column) else { return false };
            STEPS[..2].iter().any(|(dr, dc)| {
                let ends = (self.at(row - dr, column - dc), self.at(row + dr, column + dc));
                let (Some(a), Some(b)) = ends else { return false };
                let off = (x - 0.5 * (a.0 + b.0)).hypot(y - 0.5 * (a.1 + b.1));
                off > OFF_MIDDLE * (a.0 - b.0).hypot(a.1 - b.1)
            })
        };
        let gone: Vec<(i32, i32)> = self.corners.keys().filter(|place| bent(place)).copied().collect();
        // A bad corner makes its good neighbours look bent; those are found again when the grid is completed.
        for place in gone {
            self.corners.remove(&place);
        }
    }

    /// What the neighbours say of a missing corner.
    fn expected(&self, row: i32, column: i32) -> Option<Expected> {
        let mut guesses: Vec<Expected> = Vec::new();
        for (direction, (dr, dc)) in STEPS.iter().enumerate() {
            let (one, two) = (self.at(row - dr, column - dc), self.at(row - 2 * dr, column - 2 * dc));
            let (Some(one), Some(two)) = (one, two) else { continue };
            let (dx, dy) = (one.0 - two.0, one.1 - two.1);
            let guess = Expected { x: one.0 + dx, y: one.1 + dy, step: dx.hypot(dy), direction, angle: dy.atan2(dx) };
            if let Some(other) = self.at(row + dr, column + dc) {
                // The middle is better than an extrapolation: it has no neighbours.
                let (dx, dy) = (0.5 * (other.0 - one.0), 0.5 * (other.1 - one.1));
                return Some(Expected { x: one.0 + dx, y: one.1 + dy, step: dx.hypot(dy), ..guess });
            }
            guesses.push(guess);
        }
        let count = guesses.len() as f32;
        let mean = |pick: fn(&Expected) -> f32| guesses.iter().map(pick).sum::<f32>() / count;
        let step = guesses.iter().map(|guess| guess.step).fold(f32::MAX, f32::min);
        guesses.first().map(|first| Expected { x: mean(|g| g.x), y: mean(|g| g.y), step, ..*first })
    }

    /// Looks for missing corners where the grid says they should be, up to `most` columns and rows (either way round).
    pub(super) fn complete(&mut self, smooth: &Plane, strength: &Plane, most: (i32, i32)) {
        let (short, long) = (most.0.min(most.1), most.0.max(most.1));
        loop {
            let ((top, bottom), (left, right)) = self.bounds();
            let mut added = false;
            for row in top - 1..=bottom + 1 {
                for column in left - 1..=right + 1 {
                    let rows = bottom.max(row) - top.min(row) + 1;
                    let columns = right.max(column) - left.min(column) + 1;
                    if self.at(row, column).is_some() || rows.min(columns) > short || rows.max(columns) > long {
                        continue;
                    }
                    let Some(expected) = self.expected(row, column) else { continue };
                    // At the end of an edge along an even direction it gets dark where the square beyond is dark.
                    let gets_dark = self.is_dark(row, column) == (expected.direction % 2 == 0);
                    if let Some(found) = search(smooth, strength, &expected, gets_dark) {
                        self.corners.insert((row, column), found);
                        added = true;
                    }
                }
                if added {
                    break;
                }
            }
            if !added {
                return;
            }
        }
    }
}

/// Where a corner should be: how long a square is there, and a direction of the grid (an index of `STEPS`) with its
/// angle in the image, rad.
#[derive(Debug, Clone, Copy)]
struct Expected {
    x: f32,
    y: f32,
    step: f32,
    direction: usize,
    angle: f32,
}

/// The strongest corner where one is expected, if its dark squares are where the grid has them.
fn search(smooth: &Plane, strength: &Plane, expected: &Expected, gets_dark: bool) -> Option<(f32, f32)> {
    let reach = (SEARCH * expected.step).max(1.5);
    let margin = RADIUS.ceil() + 2.0;
    let range = |center: f32, size: usize| {
        let (low, high) = ((center - reach).max(margin), (center + reach).min(size as f32 - 1.0 - margin));
        (low.ceil() <= high.floor()).then(|| (low.ceil() as usize, high.floor() as usize))
    };
    let ((left, right), (top, bottom)) = (range(expected.x, strength.width)?, range(expected.y, strength.height)?);
    let mut best = (0.0, 0, 0);
    for y in top..=bottom {
        for x in left..=right {
            if strength.at(x, y) > best.0 {
                best = (strength.at(x, y), x, y);
            }
        }
    }
    let found = if best.0 > 0.0 { candidate(smooth, strength, best.1, best.2)? } else { return None };
    let along = |edge: usize| apart(found.edges[edge], expected.angle) < ASIDE;
    let first = usize::from(!gets_dark);
    (along(first) || along(first + 2)).then_some((found.x, found.y))
}
