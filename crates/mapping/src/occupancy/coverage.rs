//! How much of a space was observed, and whether what was found free is closed by surfaces.

use super::{Occupancy, OccupancyGrid, state};
use crate::Error;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Cells between free space and the surface that closes it: those that the surface's noise leaves undecided.
const CLOSING_CELLS: i32 = 3;
/// Cells that a question may be about.
const MAX_CELLS: f64 = 1e8;
const SIDES: [[i32; 3]; 6] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];

/// The border of the free space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeBoundary {
    /// Where a surface closes it, square metres.
    pub closed_m2: f64,
    /// Where it ends in space that nobody has seen: holes in the surface, and the ends of the views. Square metres.
    pub open_m2: f64,
}

impl FreeBoundary {
    /// Open part of the whole; `None` without free space.
    pub fn open_fraction(&self) -> Option<f64> {
        let whole = self.closed_m2 + self.open_m2;
        (whole > 0.0).then(|| self.open_m2 / whole)
    }
}

impl OccupancyGrid {
    /// Fraction of a ball's cells (those whose centres it holds) that was seen to be free or occupied; base frame,
    /// metres.
    ///
    /// An error for a ball without size, or of more than 100 million cells.
    pub fn observed_fraction_of_ball(&self, centre_in_base: Point3<f64>, radius_m: f64) -> Result<f64, Error> {
        let cell_m = self.options.resolution_m;
        if !(radius_m > 0.0 && (2.0 * radius_m / cell_m).powi(3) <= MAX_CELLS) {
            return Err(Error::Option {
                option: "radius_m",
                value: radius_m.to_string(),
                need: "a positive radius of at most 230 cells is needed",
            });
        }
        if !centre_in_base.coords.iter().all(|value| value.is_finite()) {
            let value = centre_in_base.to_string();
            return Err(Error::BadNumber { what: "the centre of a ball", value, need: "a finite number" });
        }
        let reach = (radius_m / cell_m).ceil() as i32 + 1;
        let first = centre_in_base.coords.map(|value| (value / cell_m).floor());
        let (cells, observed) = (-reach..=reach)
            .into_par_iter()
            .map(|z| {
                let (mut cells, mut observed) = (0u64, 0u64);
                for (y, x) in (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| (y, x))) {
                    let index = first + Vector3::new(x, y, z).map(f64::from);
                    let point = index.map(|value| (value + 0.5) * cell_m);
                    if (point - centre_in_base.coords).norm_squared() <= radius_m * radius_m {
                        cells += 1;
                        observed += u64::from(self.at(point.into()) != Occupancy::Unknown);
                    }
                }
                (cells, observed)
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        Ok(if cells > 0 { observed as f64 / cells as f64 } else { 0.0 })
    }

    /// The border of the free space, by the faces of its cells.
    pub fn free_boundary(&self) -> FreeBoundary {
        let free: Vec<[i32; 3]> =
            self.cells().into_iter().filter(|(_, value)| is_free(*value)).map(|(at, _)| at).collect();
        let (closed, open) = free
            .par_iter()
            .map(|cell| {
                let (mut closed, mut open) = (0u64, 0u64);
                for side in SIDES {
                    let ahead = |step: i32| self.at_cell(std::array::from_fn(|axis| cell[axis] + step * side[axis]));
                    if ahead(1) == Occupancy::Free {
                        continue;
                    }
                    match (1..=CLOSING_CELLS).map(ahead).find(|found| *found != Occupancy::Unknown) {
                        Some(Occupancy::Occupied) => closed += 1,
                        // Free space beyond a few unknown cells: an edge that no view decided, and no border.
                        Some(_) => {}
                        None => open += 1,
                    }
                }
                (closed, open)
            })
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        let face_m2 = self.options.resolution_m * self.options.resolution_m;
        FreeBoundary { closed_m2: closed as f64 * face_m2, open_m2: open as f64 * face_m2 }
    }
}

fn is_free(value: f32) -> bool {
    state(value) == Occupancy::Free
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::OccupancyOptions;
    use crate::tsdf::tests::wall;
    use crate::view::tests::{plain_camera, view};

    #[test]
    fn half_a_ball_before_a_wall_is_seen_and_the_wall_closes_the_view() {
        let camera = plain_camera(120, 90);
        let depth = wall(120, 90, 1.01);
        let options = OccupancyOptions { resolution_m: 0.02, ..Default::default() };
        let mut grid = OccupancyGrid::new(options).unwrap();
        assert_eq!(grid.free_boundary().open_fraction(), None);
        assert_eq!(grid.observed_fraction_of_ball(Point3::origin(), 0.2).unwrap(), 0.0);
        grid.add(&view(&depth, &camera)).unwrap();
        let before = grid.observed_fraction_of_ball(Point3::new(0.0, 0.0, 0.7), 0.15).unwrap();
        let across = grid.observed_fraction_of_ball(Point3::new(0.0, 0.0, 1.01), 0.15).unwrap();
        assert!(before > 0.99, "{before}");
        assert!((0.3..0.6).contains(&across), "{across}");
        // The wall is 1.1 by 0.83 m; the rest of the border are the sides of the camera's cone.
        let boundary = grid.free_boundary();
        assert!((0.8..1.0).contains(&boundary.closed_m2), "{boundary:?}");
        assert!((0.5..0.9).contains(&boundary.open_fraction().unwrap()), "{boundary:?}");
        assert!(grid.observed_fraction_of_ball(Point3::origin(), f64::NAN).is_err());
        assert!(grid.observed_fraction_of_ball(Point3::origin(), 1e9).is_err());
        assert!(grid.observed_fraction_of_ball(Point3::new(f64::NAN, 0.0, 0.0), 1.0).is_err());
    }
}
