//! ChArUco boards whose markers leave their corners a pixel or two, and small ones: they must be found, and as exactly
//! as others.
//!
//! The larger set with OpenCV beside it is `benchmarks/features/boards.py`.

use super::*;

/// Images of a board at a size of squares: turned, tilted, blurred, noisy; the last is hidden in part.
fn shots(layout: &BoardLayout, square_px: f64) -> [Shot; 3] {
    let fills = square_px * f64::from(layout.columns + 1) / f64::from(SIZE.0);
    let half = square_px as u32;
    let hidden = Some([SIZE.0 / 2, SIZE.1 / 2, SIZE.0 / 2 + half, SIZE.1 / 2 + half]);
    [
        Shot { turn: [0.3, 0.35, -0.2], fills, blur: 0.6, noise: 2.0, ..PLAIN },
        Shot { turn: [2.0, -0.5, 0.3], fills, blur: 0.8, noise: 3.0, ..PLAIN },
        Shot { turn: [4.0, 0.2, 0.5], fills, blur: 0.7, noise: 2.0, hidden, ..PLAIN },
    ]
}

#[test]
fn boards_with_large_markers_are_found() {
    let (mut boards, mut corners, mut found, mut all) = (0, 0, 0, Vec::new());
    for (dictionary, marker, square_px) in [
        ("DICT_4X4_50", 0.6, 24.0),
        ("DICT_4X4_50", 0.8, 24.0),
        ("DICT_5X5_100", 0.875, 24.0),
        ("DICT_4X4_50", 0.875, 36.0),
        ("DICT_4X4_50", 0.9, 24.0),
        ("DICT_5X5_100", 0.9, 30.0),
        ("DICT_6X6_250", 0.9, 44.0),
    ] {
        let layout = charuco(7, 5, dictionary, marker);
        for shot in shots(&layout, square_px) {
            boards += 1;
            let Some(board) = detect(&layout, &shot) else { continue };
            assert_eq!(board.labellings.len(), 1, "{dictionary} {marker} {square_px}: {:?}", board.labellings);
            let errors = errors(&layout, &shot, &board, &board.labellings[0]);
            let most = errors[errors.len() - 1];
            assert!(most < 0.08 * square_px, "{dictionary} {marker} {square_px}: a corner is off by {most} px");
            found += usize::from(errors.len() >= 18);
            corners += errors.len();
            all.extend(errors);
        }
    }
    all.sort_by(f64::total_cmp);
    let (median, most) = (all[all.len() / 2], all[all.len() - 1]);
    assert!(found == boards, "{found} of {boards} boards, {corners} corners");
    assert!(corners >= 31 * boards, "{corners} corners on {boards} boards of 35, a third of them hidden in part");
    assert!(median < 0.06 && most < 1.0, "{median} {most}");
}

/// What the detector says of its corners' scatter is what they scatter.
#[test]
fn sigmas_are_what_corners_scatter() {
    let layout = charuco(7, 5, "DICT_4X4_50", 0.875);
    for (noise, square_px) in [(2.0, 30.0), (8.0, 40.0)] {
        let (mut squares, mut count) = (0.0, 0.0);
        for seed in 0..4 {
            let fills = square_px * 8.0 / 640.0;
            let shot = Shot { turn: [0.7 * seed as f64, 0.3, -0.2], fills, blur: 0.8, noise, ..PLAIN };
            let board =
                detect_board(&render(&layout, &shot, seed), &layout, &BoardOptions::default()).unwrap().unwrap();
            let h = homography(&layout, &shot);
            for corner in board.labelled(&board.labellings[0], &layout) {
                let p = h * Vector3::new(f64::from(corner.column), f64::from(corner.row), 1.0);
                let off = (corner.x - p.x / p.z).powi(2) + (corner.y - p.y / p.z).powi(2);
                squares += 0.5 * off / corner.sigma_px.powi(2);
                count += 1.0;
            }
        }
        let ratio = f64::sqrt(squares / count);
        assert!((0.7..1.4).contains(&ratio), "noise {noise}: RMS of error over sigma is {ratio}");
    }
}

/// Boards of OpenCV before 4.6 with an even number of rows of squares begin with a white one; they are known by their
/// markers.
#[test]
fn the_pattern_of_old_boards_is_known_by_its_markers() {
    for (columns, marker) in [(6, 0.7), (6, 0.875), (7, 0.875)] {
        let layout = charuco(columns, 5, "DICT_5X5_100", marker);
        let shot = Shot { fills: 0.6, old: true, ..PLAIN };
        let found = detect(&layout, &shot).expect("a board");
        assert_eq!(found.labellings.len(), 1, "{columns} {marker}");
        let errors = errors(&layout, &shot, &found, &found.labellings[0]);
        assert!(errors.len() >= columns as usize * 5 - 2, "{columns} {marker}: {} corners", errors.len());
        assert!(errors[errors.len() - 1] < 0.4, "{columns} {marker}: {errors:?}");
    }
}
