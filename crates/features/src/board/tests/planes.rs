//! Grids that are no board: what looks like a grid corner by corner, but lies on no plane.

use super::*;

/// The print on waves of a few squares: each corner is moved by up to a fifth of a square.
fn crumpled(x: f64, y: f64) -> (f64, f64) {
    (x + 0.2 * (2.1 * y + 1.3 * x).sin(), y + 0.2 * (2.3 * x - 0.9 * y).sin())
}

#[test]
fn a_grid_on_no_plane_is_refused() {
    let options = BoardOptions::default();
    for layout in [checkerboard(11, 8), charuco(7, 5, "DICT_4X4_50", 0.6), charuco(7, 5, "DICT_4X4_50", 0.875)] {
        let image = render_bent(&layout, &PLAIN, 1, crumpled);
        assert_eq!(detect_board(&image, &layout, &options).unwrap(), None, "{:?}", layout.markers);
        assert!(detect_board(&render(&layout, &PLAIN, 1), &layout, &options).unwrap().is_some());
    }
}

/// A lens bends the whole of a board smoothly by more than a corner may be off it, and the board is still one.
#[test]
fn a_lens_makes_no_false_grid() {
    for layout in [checkerboard(11, 8), charuco(7, 5, "DICT_4X4_50", 0.875)] {
        let (columns, rows) = (f64::from(layout.columns), f64::from(layout.rows));
        let bent = |x: f64, y: f64| {
            let (u, v) = (x - 0.5 * (columns - 1.0), y - 0.5 * (rows - 1.0));
            let scale = 1.0 + 0.12 * (u * u + v * v) / (columns * columns);
            (x + u * (scale - 1.0), y + v * (scale - 1.0))
        };
        let found = detect_board(&render_bent(&layout, &PLAIN, 1, bent), &layout, &BoardOptions::default()).unwrap();
        let found = found.expect("a board");
        assert_eq!(found.corners.len(), (columns * rows) as usize);
        assert!(found.sigma_px < 0.15, "{}", found.sigma_px);
    }
}
