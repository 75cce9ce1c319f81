use super::*;
use nalgebra::{Rotation2, Vector2};
use rand::RngExt;

/// Pairs of images of 640 x 480: positions in both, and matches.
struct Sequence(Vec<Pair>);

type Pair = (Vec<Point2<f64>>, Vec<Point2<f64>>, Vec<Match>);

/// A scene that turns and shifts, and, if wanted, something fixed in the lower left corner.
fn sequence(motions: &[(f64, f64, f64)], fixed: bool) -> Sequence {
    let mut random = ChaCha8Rng::seed_from_u64(9);
    let mut uniform = move |from: f64, to: f64| from + (to - from) * random.random::<f64>();
    let centre = Vector2::new(320.0, 240.0);
    let mut pairs = Vec::new();
    for &(angle, dx, dy) in motions {
        let (mut a, mut b) = (Vec::new(), Vec::new());
        while a.len() < 200 {
            let at = Vector2::new(uniform(0.0, 640.0), uniform(0.0, 480.0));
            // Depth: points move differently by a few pixels.
            let depth = uniform(0.9, 1.1);
            let to = centre + Rotation2::new(angle) * (at - centre) + Vector2::new(dx, dy) * depth;
            let hidden = |p: Vector2<f64>| fixed && p.x < 150.0 && p.y > 330.0;
            if !hidden(at) && !hidden(to) && (0.0..640.0).contains(&to.x) && (0.0..480.0).contains(&to.y) {
                a.push(at.into());
                b.push((to + Vector2::new(uniform(-0.3, 0.3), uniform(-0.3, 0.3))).into());
            }
        }
        for _ in 0..if fixed { 40 } else { 0 } {
            let at = Point2::new(uniform(0.0, 140.0), uniform(340.0, 480.0));
            a.push(at);
            b.push(at + Vector2::new(uniform(-0.4, 0.4), uniform(-0.4, 0.4)));
        }
        // Wrong matches.
        for _ in 0..30 {
            a.push(Point2::new(uniform(0.0, 640.0), uniform(0.0, 480.0)));
            b.push(Point2::new(uniform(0.0, 640.0), uniform(0.0, 480.0)));
        }
        let matches = (0..a.len() as u32).map(|i| Match { a: i, b: i, distance: 9, second_distance: 90 }).collect();
        pairs.push((a, b, matches));
    }
    Sequence(pairs)
}

impl Sequence {
    fn search(&self) -> EgoMask {
        let pairs: Vec<_> =
            self.0.iter().map(|(a, b, matches)| MatchedPair { positions_a: a, positions_b: b, matches }).collect();
        find_ego_mask(640, 480, &pairs, &MaskOptions::default()).unwrap()
    }
}

/// Fraction of the pixels of an area that the mask covers.
fn covered(mask: &GrayImage, x: std::ops::Range<u32>, y: std::ops::Range<u32>) -> f64 {
    let area = f64::from((x.end - x.start) * (y.end - y.start));
    let pixels = x.flat_map(|x| y.clone().map(move |y| (x, y)));
    pixels.filter(|&(x, y)| mask.get_pixel(x, y).0[0] == 0).count() as f64 / area
}

/// Turn in radians and shift in px.
const MOTIONS: [(f64, f64, f64); 6] = [
    (0.1, 40.0, 5.0),
    (-0.2, -30.0, 30.0),
    (0.05, 5.0, -60.0),
    (0.3, 50.0, 20.0),
    (0.0, -70.0, 0.0),
    (0.2, 20.0, 45.0),
];

#[test]
fn what_is_static_is_masked_and_the_scene_is_not() {
    let found = sequence(&MOTIONS, true).search();
    assert_eq!((found.outcome, found.moving_pairs), (MaskOutcome::Found, 6));
    assert!(covered(&found.mask, 0..130, 350..480) > 0.97, "{}", covered(&found.mask, 0..130, 350..480));
    assert_eq!(covered(&found.mask, 200..640, 0..480), 0.0);
    assert_eq!(covered(&found.mask, 0..640, 0..280), 0.0);
    assert!(found.masked_fraction < 0.12, "{}", found.masked_fraction);
}

#[test]
fn a_scene_with_nothing_fixed_is_not_masked() {
    let found = sequence(&MOTIONS, false).search();
    assert_eq!((found.outcome, found.masked_fraction), (MaskOutcome::NothingFixed, 0.0));
    assert!(found.mask.pixels().all(|pixel| pixel.0 == [255]));
}

#[test]
fn a_camera_that_hardly_moves_masks_nothing() {
    for motions in [[(0.0, 0.3, 0.2); 8], [(0.0, 3.0, 2.0); 8], [(0.0, 0.0, 0.0); 8]] {
        let found = sequence(&motions, true).search();
        assert_eq!((found.outcome, found.moving_pairs), (MaskOutcome::CameraHardlyMoved, 0));
    }
    let none = find_ego_mask(640, 480, &[], &MaskOptions::default()).unwrap();
    assert_eq!(none.outcome, MaskOutcome::CameraHardlyMoved);
}

#[test]
fn the_pivot_of_a_turn_is_no_gripper() {
    // Always the same turn about the middle: there the scene is static in every pair.
    let found = sequence(&[(0.5, 0.0, 0.0); 10], false).search();
    assert_eq!((found.outcome, found.moving_pairs), (MaskOutcome::NothingFixed, 10));
}

#[test]
fn masks_are_applied_by_the_nearest_pixel() {
    let mut mask = GrayImage::from_pixel(4, 3, Luma([255]));
    mask.put_pixel(2, 1, Luma([0]));
    for (x, y, kept) in [(2.4, 1.4, false), (2.6, 1.0, true), (1.6, 0.6, false), (9.0, 1.0, true), (-3.0, 0.0, true)] {
        assert_eq!(is_kept(&mask, x, y), kept, "{x} {y}");
    }
    let keypoint = |x| crate::KeyPoint { x, y: 1.0, size: 5.0, angle: 0.0, response: 1.0, octave: 0, level: 0 };
    let features = Features {
        keypoints: vec![keypoint(0.0), keypoint(2.0), keypoint(3.0)],
        descriptors: [1, 2, 3].map(|bits| crate::Descriptor([bits; 8])).to_vec(),
    };
    let kept = keep_unmasked(&features, &mask);
    assert_eq!(kept.keypoints.iter().map(|k| k.x).collect::<Vec<_>>(), [0.0, 3.0]);
    assert_eq!(kept.descriptors[1].0[0], 3);
}

#[test]
fn wrong_options_are_refused() {
    let options = MaskOptions { scene_moves_px: 1.5, ..MaskOptions::default() };
    assert!(matches!(find_ego_mask(10, 10, &[], &options), Err(FeaturesError::BadOption { .. })));
    assert!(find_ego_mask(0, 10, &[], &MaskOptions::default()).is_err());
}

#[test]
fn the_gripper_of_the_shelf_is_found() {
    let data = std::env::var("SKCLAM_DATA").unwrap_or_else(|_| "../../../shared/data".into());
    let folder = std::path::Path::new(&data).join("apc-shelf/color");
    if !folder.is_dir() {
        println!("skipped: {} is missing (set SKCLAM_DATA)", folder.display());
        return;
    }
    let mut akaze = crate::Akaze::new(crate::AkazeOptions::default());
    let features: Vec<Features> = (0..15)
        .map(|number| {
            let image = image::open(folder.join(format!("{number:03}.png"))).unwrap().to_luma8();
            akaze.detect_and_describe(&image, None).unwrap()
        })
        .collect();
    let found = search_images(&features);
    println!(
        "{:?}: {} of {} pairs moved, {} still, {} scene matches, {:.1} % masked",
        found.outcome,
        found.moving_pairs,
        found.pairs,
        found.static_matches,
        found.scene_matches,
        100.0 * found.masked_fraction
    );
    if let Ok(path) = std::env::var("SKCLAM_MASK_OUT") {
        found.mask.save(path).unwrap();
    }
    assert_eq!(found.outcome, MaskOutcome::Found);
    // The foam pads are upper left and upper right; the shelf between and below them is not masked. Where the left pad
    // shows nothing that is found again, it is not covered.
    let [left, right, shelf] =
        [(0..120, 5..150), (520..640, 5..150), (170..470, 60..480)].map(|(x, y)| covered(&found.mask, x, y));
    assert!(left > 0.5 && right > 0.8 && shelf == 0.0, "left pad {left}, right pad {right}, shelf {shelf}");
    // With the mask, hardly anything static is left, and nearly all of the scene.
    let kept: Vec<Features> = features.iter().map(|features| keep_unmasked(features, &found.mask)).collect();
    let again = search_images(&kept);
    println!("with the mask: {} still, {} scene matches", again.static_matches, again.scene_matches);
    assert!(again.static_matches * 10 < found.static_matches, "{} still", again.static_matches);
    assert!(again.scene_matches * 10 > found.scene_matches * 9, "{} of the scene", again.scene_matches);
}

/// All pairs of images of 640 x 480.
fn search_images(features: &[Features]) -> EgoMask {
    let positions: Vec<Vec<Point2<f64>>> = features
        .iter()
        .map(|f| f.keypoints.iter().map(|k| Point2::new(f64::from(k.x), f64::from(k.y))).collect())
        .collect();
    let options = crate::MatchOptions { ratio: 0.8, ..Default::default() };
    let mut matchings = Vec::new();
    for a in 0..features.len() {
        for b in a + 1..features.len() {
            let [of_a, of_b] = [a, b].map(|image: usize| &features[image].descriptors);
            matchings.push((a, b, crate::match_descriptors(of_a, of_b, &options).unwrap().matches));
        }
    }
    let pairs: Vec<_> = matchings
        .iter()
        .map(|(a, b, matches)| MatchedPair { positions_a: &positions[*a], positions_b: &positions[*b], matches })
        .collect();
    find_ego_mask(640, 480, &pairs, &MaskOptions::default()).unwrap()
}
