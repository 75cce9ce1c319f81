//! The detector on rendered boards: the truth is the homography.

use super::*;
use crate::FeaturesError;
use image::GrayImage;
use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

mod large_markers;
mod planes;

const SIZE: (u32, u32) = (640, 480);
const FOCAL: f64 = 700.0;

/// How an image is taken.
#[derive(Clone, Copy)]
struct Shot {
    /// Turn of the board about its normal, then about the image's x and y, rad.
    turn: [f64; 3],
    /// Width of the board over the width of the image.
    fills: f64,
    /// Shift of the board's middle in the image, px.
    shift: (f64, f64),
    /// Blur, px.
    blur: f64,
    /// Noise, grey levels.
    noise: f64,
    /// What hides a part of the image: left, top, right, bottom.
    hidden: Option<[u32; 4]>,
    /// Whether the print begins with a white square, as OpenCV's before 4.6 with an even number of rows.
    old: bool,
}

const PLAIN: Shot =
    Shot { turn: [0.1, 0.3, -0.2], fills: 0.7, shift: (0.0, 0.0), blur: 0.7, noise: 1.0, hidden: None, old: false };

/// Pixel from square coordinates: (0, 0) is the first inner corner, a square has side 1.
fn homography(layout: &BoardLayout, shot: &Shot) -> Matrix3<f64> {
    let (columns, rows) = (f64::from(layout.columns), f64::from(layout.rows));
    let distance = FOCAL * (columns + 1.0) / (shot.fills * f64::from(SIZE.0));
    let [about, tilt, pan] = shot.turn;
    let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), pan)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), tilt)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), about);
    let middle = Vector3::new(0.5 * (columns - 1.0), 0.5 * (rows - 1.0), 0.0);
    let translation = Vector3::new(0.0, 0.0, distance) - rotation * middle;
    let r = rotation.matrix();
    let camera = Matrix3::new(
        FOCAL,
        0.0,
        0.5 * f64::from(SIZE.0) - 0.5 + shot.shift.0,
        0.0,
        FOCAL,
        0.5 * f64::from(SIZE.1) - 0.5 + shot.shift.1,
        0.0,
        0.0,
        1.0,
    );
    camera * Matrix3::from_columns(&[r.column(0).into_owned(), r.column(1).into_owned(), translation])
}

/// What is printed at a place, by squares: 1 white, 0 black.
fn printed(layout: &BoardLayout, old: bool, x: f64, y: f64) -> f64 {
    let (columns, rows) = (f64::from(layout.columns), f64::from(layout.rows));
    let outside = |v: f64, count: f64, rim: f64| v < -1.0 - rim || v >= count + rim;
    if outside(x, columns, 0.6) || outside(y, rows, 0.6) {
        return 0.45;
    }
    if outside(x, columns, 0.0) || outside(y, rows, 0.0) {
        return 1.0;
    }
    let (column, row) = (x.floor() as i32 + 1, y.floor() as i32 + 1);
    let white = i32::from(!old);
    if (column + row) % 2 != white {
        return 0.0;
    }
    let Some(markers) = &layout.markers else { return 1.0 };
    // White squares among the first `count` of a row.
    let among = |count: i32, row: i32| if row % 2 == white { (count + 1) / 2 } else { count / 2 };
    let id = (0..row).map(|above| among(layout.columns as i32 + 1, above)).sum::<i32>() + among(column, row);
    let id = id as usize;
    let side = markers.dictionary.side() as f64 + 2.0;
    let into = |v: f64| ((v - v.floor() - 0.5) / markers.marker_in_square + 0.5) * side;
    let (bx, by) = (into(x), into(y));
    if bx < 0.0 || by < 0.0 || bx >= side || by >= side {
        return 1.0;
    }
    let bit = |v: f64| (v.floor() as usize).checked_sub(1);
    let white = bit(bx).zip(bit(by)).and_then(|(c, r)| markers.dictionary.bit(id, r, c)).unwrap_or(false);
    if white { 1.0 } else { 0.0 }
}

fn render(layout: &BoardLayout, shot: &Shot, seed: u64) -> GrayImage {
    render_bent(layout, shot, seed, |x, y| (x, y))
}

/// The same of a print that is not flat: `bent` takes a place on the plane to the place of the print that is seen
/// there, in squares.
fn render_bent(layout: &BoardLayout, shot: &Shot, seed: u64, bent: impl Fn(f64, f64) -> (f64, f64)) -> GrayImage {
    const FINE: usize = 4;
    let inverse = homography(layout, shot).try_inverse().unwrap();
    let mut sharp = saddle::Plane { width: SIZE.0 as usize, height: SIZE.1 as usize, data: Vec::new() };
    for y in 0..sharp.height {
        for x in 0..sharp.width {
            let hidden = shot.hidden.is_some_and(|[left, top, right, bottom]| {
                (left..right).contains(&(x as u32)) && (top..bottom).contains(&(y as u32))
            });
            let mut sum = 0.0;
            for k in 0..FINE * FINE {
                let offset = |k: usize| (k as f64 + 0.5) / FINE as f64 - 0.5;
                let p = inverse * Vector3::new(x as f64 + offset(k % FINE), y as f64 + offset(k / FINE), 1.0);
                let (x, y) = bent(p.x / p.z, p.y / p.z);
                sum += printed(layout, shot.old, x, y);
            }
            // Light falls off to the right.
            let light = 1.0 - 0.4 * x as f64 / f64::from(SIZE.0);
            let value = if hidden { 70.0 } else { 25.0 + 190.0 * light * sum / (FINE * FINE) as f64 };
            sharp.data.push(value as f32);
        }
    }
    let blurred = sharp.smoothed(shot.blur as f32);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut noise = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
    let pixels = blurred.data.iter().map(|&v| (f64::from(v) + shot.noise * noise()).round().clamp(0.0, 255.0) as u8);
    GrayImage::from_raw(SIZE.0, SIZE.1, pixels.collect()).unwrap()
}

fn checkerboard(columns: u32, rows: u32) -> BoardLayout {
    BoardLayout { columns, rows, markers: None }
}

fn charuco(columns: u32, rows: u32, dictionary: &str, marker_in_square: f64) -> BoardLayout {
    let dictionary = Dictionary::named(dictionary).unwrap();
    BoardLayout { columns, rows, markers: Some(MarkerLayout { dictionary, marker_in_square }) }
}

/// Distances of the labelled corners to where they are, sorted.
fn errors(layout: &BoardLayout, shot: &Shot, found: &FoundBoard, labelling: &Labelling) -> Vec<f64> {
    let h = homography(layout, shot);
    let error = |corner: &BoardCorner| {
        let p = h * Vector3::new(f64::from(corner.column), f64::from(corner.row), 1.0);
        (corner.x - p.x / p.z).hypot(corner.y - p.y / p.z)
    };
    let mut errors: Vec<f64> = found.labelled(labelling, layout).iter().map(error).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

fn detect(layout: &BoardLayout, shot: &Shot) -> Option<FoundBoard> {
    detect_board(&render(layout, shot, 1), layout, &BoardOptions::default()).unwrap()
}

/// Median and greatest error where the labelling is unique.
fn accuracy(layout: &BoardLayout, shot: &Shot, least: usize) -> (f64, f64) {
    let found = detect(layout, shot).expect("a board");
    assert_eq!(found.labellings.len(), 1, "{:?}", found.labellings);
    let errors = errors(layout, shot, &found, &found.labellings[0]);
    assert!(errors.len() >= least, "{} corners, {} wanted", errors.len(), least);
    (errors[errors.len() / 2], errors[errors.len() - 1])
}

#[test]
fn a_checkerboard_is_found_whole_and_exactly_however_it_lies() {
    let layout = checkerboard(11, 8);
    for about in [0.0, 0.4, 0.8, 1.6, 2.4, 3.1, 4.0, 5.0] {
        let shot = Shot { turn: [about, 0.35, -0.25], fills: 0.6, ..PLAIN };
        let (median, most) = accuracy(&layout, &shot, 88);
        assert!(median < 0.04 && most < 0.2, "{about}: {median} {most}");
    }
}

#[test]
fn blur_and_steep_views_cost_little() {
    let layout = checkerboard(11, 8);
    for blur in [0.5, 1.5, 2.5] {
        let (median, most) = accuracy(&layout, &Shot { blur, ..PLAIN }, 88);
        assert!(median < 0.06 && most < 0.25, "{blur}: {median} {most}");
    }
    let (median, _) = accuracy(&layout, &Shot { turn: [0.2, 0.9, 0.2], fills: 0.75, ..PLAIN }, 86);
    assert!(median < 0.08, "{median}");
    let (median, _) = accuracy(&layout, &Shot { noise: 8.0, ..PLAIN }, 86);
    assert!(median < 0.15, "{median}");
}

#[test]
fn a_board_of_even_counts_has_two_ways_and_one_is_right() {
    let layout = checkerboard(9, 7);
    let found = detect(&layout, &PLAIN).unwrap();
    assert_eq!(found.labellings.len(), 2);
    let right = found.labellings.iter().filter(|l| errors(&layout, &PLAIN, &found, l)[31] < 0.05).count();
    assert_eq!(right, 1);
}

#[test]
fn a_part_of_a_checkerboard_is_returned_with_all_labellings() {
    let layout = checkerboard(11, 8);
    let shot = Shot { fills: 1.1, shift: (150.0, 20.0), ..PLAIN };
    let found = detect(&layout, &shot).unwrap();
    assert!((30..88).contains(&found.corners.len()), "{}", found.corners.len());
    let right = found.labellings.iter().filter(|l| {
        let errors = errors(&layout, &shot, &found, l);
        errors[errors.len() / 2] < 0.05
    });
    assert_eq!(right.count(), 1, "{:?}", found.labellings);
}

#[test]
fn charuco_corners_are_named_by_their_markers() {
    for (name, columns, rows, marker) in [
        ("DICT_4X4_50", 6, 4, 0.75),
        ("DICT_5X5_100", 7, 5, 0.7),
        ("DICT_6X6_250", 6, 5, 0.8),
        ("DICT_APRILTAG_36h11", 5, 4, 0.7),
    ] {
        let layout = charuco(columns, rows, name, marker);
        let all = (columns * rows) as usize;
        for about in [0.1, 1.7, 3.3, 4.9] {
            let fills = if (about as i32) % 2 == 0 { 0.8 } else { 0.55 };
            let shot = Shot { turn: [about, 0.3, -0.25], fills, ..PLAIN };
            let (median, most) = accuracy(&layout, &shot, all);
            assert!(median < 0.08 && most < 0.4, "{name} {about}: {median} {most}");
        }
    }
}

/// Seven squares wide and six high: inner markers fit a board that begins with a white square as well, a column apart.
#[test]
fn a_part_of_a_charuco_board_with_two_labellings_is_returned_with_both() {
    let layout = charuco(6, 5, "DICT_6X6_250", 0.7);
    let shot = Shot { fills: 1.3, shift: (-170.0, 20.0), ..PLAIN };
    let found = detect(&layout, &shot).unwrap();
    assert!((9..30).contains(&found.corners.len()), "{}", found.corners.len());
    assert!(found.labellings.len() <= 2, "{:?}", found.labellings);
    let right = found.labellings.iter().filter(|labelling| {
        let errors = errors(&layout, &shot, &found, labelling);
        errors[errors.len() / 2] < 0.08
    });
    assert_eq!(right.count(), 1, "{:?}", found.labellings);
}

#[test]
fn a_charuco_board_may_be_hidden_in_part_or_leave_the_image() {
    let layout = charuco(7, 5, "DICT_4X4_50", 0.7);
    let hidden = Shot { hidden: Some([180, 100, 330, 210]), ..PLAIN };
    let (median, most) = accuracy(&layout, &hidden, 18);
    assert!(median < 0.08 && most < 0.5, "{median} {most}");
    let (median, most) = accuracy(&layout, &Shot { fills: 1.2, shift: (-130.0, 60.0), ..PLAIN }, 15);
    assert!(median < 0.08 && most < 0.4, "{median} {most}");
    let (median, _) = accuracy(&layout, &Shot { blur: 2.0, noise: 4.0, ..PLAIN }, 30);
    assert!(median < 0.12, "{median}");
}

#[test]
fn no_board_no_corners() {
    let layout = charuco(7, 5, "DICT_4X4_50", 0.7);
    let options = BoardOptions::default();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let noise = GrayImage::from_fn(320, 240, |_, _| image::Luma([rng.random::<u8>()]));
    for image in [GrayImage::new(1, 1), GrayImage::new(3000, 1), GrayImage::new(0, 0), GrayImage::new(64, 64), noise] {
        assert_eq!(detect_board(&image, &layout, &options).unwrap(), None);
        assert_eq!(detect_board(&image, &checkerboard(11, 8), &options).unwrap(), None);
    }
    // Another board's markers.
    let other = charuco(7, 5, "DICT_5X5_50", 0.7);
    assert_eq!(detect_board(&render(&other, &PLAIN, 1), &layout, &options).unwrap(), None);
    // A larger board is not this one.
    assert_eq!(detect_board(&render(&checkerboard(11, 8), &PLAIN, 1), &checkerboard(5, 4), &options).unwrap(), None);
}

#[test]
fn impossible_boards_and_options_are_errors() {
    let image = GrayImage::new(64, 64);
    let error = |layout: &BoardLayout, options: &BoardOptions| detect_board(&image, layout, options).unwrap_err();
    let default = BoardOptions::default();
    assert!(matches!(error(&checkerboard(1, 8), &default), FeaturesError::BadOption { .. }));
    assert!(matches!(error(&charuco(7, 5, "DICT_4X4_50", 1.5), &default), FeaturesError::BadOption { .. }));
    let message = error(&charuco(12, 9, "DICT_4X4_50", 0.7), &default).to_string();
    assert!(message.contains("50") && message.contains("65"), "{message}");
    let options = BoardOptions { window: f64::NAN, ..default };
    assert!(error(&checkerboard(7, 5), &options).to_string().contains("window"));
}

#[test]
fn two_detections_are_the_same() {
    let layout = charuco(7, 5, "DICT_4X4_50", 0.7);
    assert_eq!(detect(&layout, &PLAIN), detect(&layout, &PLAIN));
}
