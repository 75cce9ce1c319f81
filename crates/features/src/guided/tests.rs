use super::*;
use crate::{Descriptor, MatchOptions};
use nalgebra::Vector3;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Keypoints at random in an image of 1280 x 720, those of B near to those of A in place and descriptor.
struct Scene {
    descriptors: [Vec<Descriptor>; 2],
    positions: [Vec<Point2<f64>>; 2],
}

fn scene(count_a: usize, count_b: usize, seed: u64) -> Scene {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut scene = Scene { descriptors: [Vec::new(), Vec::new()], positions: [Vec::new(), Vec::new()] };
    for index in 0..count_a.max(count_b) {
        let descriptor = Descriptor(std::array::from_fn(|_| random.random()));
        let mut other = descriptor;
        for _ in 0..random.random_range(0..200u32) {
            other.0[random.random_range(0..8usize)] ^= 1 << random.random_range(0..64u32);
        }
        let at = Point2::new(random.random::<f64>() * 1280.0, random.random::<f64>() * 720.0);
        let near = at + nalgebra::Vector2::new(random.random::<f64>(), random.random::<f64>()) * 20.0;
        if index < count_a {
            scene.descriptors[0].push(descriptor);
            scene.positions[0].push(at);
        }
        if index < count_b {
            scene.descriptors[1].push(other);
            scene.positions[1].push(near);
        }
    }
    scene
}

impl Scene {
    fn points(&self) -> [DescribedPoints<'_>; 2] {
        [0, 1].map(|i| DescribedPoints { descriptors: &self.descriptors[i], positions: &self.positions[i] })
    }
}

/// A fundamental matrix of some motion.
fn fundamental(at: [f64; 3], turn: f64) -> Matrix3<f64> {
    let rotation = nalgebra::Rotation3::new(Vector3::new(0.02, -0.03, turn));
    let inverse = Matrix3::new(1e-3, 0.0, -0.64, 0.0, 1e-3, -0.36, 0.0, 0.0, 1.0);
    inverse.transpose() * Vector3::from(at).cross_matrix() * rotation.matrix() * inverse
}

/// What the module computes, over the whole matrix of distances.
fn plain(
    [a, b]: [DescribedPoints<'_>; 2],
    admitted: impl Fn(usize, usize) -> bool,
    options: &MatchOptions,
) -> Vec<Match> {
    let mut matches = Vec::new();
    for i in 0..a.positions.len() {
        let distance = |j: usize| a.descriptors[i].hamming(&b.descriptors[j]);
        let mut order: Vec<_> = (0..b.positions.len()).filter(|&j| admitted(i, j)).map(|j| (distance(j), j)).collect();
        order.sort_unstable();
        let Some(&(distance, j)) = order.first() else { continue };
        let second_distance = order.get(1).map_or(u32::MAX, |next| next.0);
        let back = (0..a.positions.len())
            .filter(|&i| admitted(i, j))
            .map(|i| (a.descriptors[i].hamming(&b.descriptors[j]), i))
            .min();
        if options.passes_ratio(distance, second_distance) && (!options.cross_check || back.unwrap().1 == i) {
            matches.push(Match { a: i as u32, b: j as u32, distance, second_distance });
        }
    }
    matches
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]
    #[test]
    fn it_is_the_masked_distance_matrix(
        seed: u64, count_a in 0..120usize, count_b in 0..120usize, ratio in 0.5..1.2f64, cross_check: bool,
        // Directions of motion that put the epipole inside, outside and at infinity.
        x in -1.0..1.0f64, y in -1.0..1.0f64, z in prop_oneof![Just(0.0), -2.0..2.0f64],
        turn in -3.1..3.1f64, half_width in 0.5..200.0f64,
        radius in prop::option::of(1.0..300.0f64), with_lines: bool,
    ) {
        let scene = scene(count_a, count_b, seed);
        let [a, b] = scene.points();
        let matrix = fundamental([x, y, z], turn);
        let gate = Gate::new(&matrix, half_width).unwrap().unwrap();
        let expected: Vec<Option<Point2<f64>>> =
            a.positions.iter().enumerate().map(|(i, p)| (i % 3 != 0).then(|| Point2::new(p.y, p.x + 3.0))).collect();
        let points = radius.map(|radius_px| PredictedPoints { in_b: &expected, radius_px });
        prop_assume!(with_lines || points.is_some());
        let prediction = Prediction { fundamental: with_lines.then_some(&matrix), points };
        let options = FilterOptions {
            matching: MatchOptions { ratio, cross_check, max_distance: None },
            gate_px: Some(half_width),
            best: None,
            ransac: None,
        };
        let found = match_guided(a, b, &prediction, &options).unwrap();
        let admitted = |i: usize, j: usize| {
            let near = match (radius, expected[i]) {
                (Some(radius), Some(point)) => (b.positions[j] - point).norm_squared() <= radius * radius,
                _ => with_lines,
            };
            near && (!with_lines || gate.passes(&a.positions[i], &b.positions[j]))
        };
        prop_assert_eq!(&found.matches, &plain([a, b], admitted, &options.matching));
        let gate = with_lines.then_some(&gate);
        let on = |kernel| search::nearest_admitted(a, b, gate, points, kernel).unwrap();
        let portable = on(kernel::Kernel::Portable);
        prop_assert!(kernel::available().into_iter().all(|kernel| on(kernel) == portable));
        if with_lines && radius.is_none() {
            // Nothing that matching everything and gating finds is missed.
            let after = match_and_filter(a, b, Some(&matrix), &options).unwrap();
            let found: Vec<_> = found.matches.iter().map(|m| (m.a, m.b)).collect();
            for m in after.matches {
                // But for a true second beyond the substitute for a missing one.
                prop_assert!(m.second_distance > 243 || found.contains(&(m.a, m.b)), "{:?}", m);
            }
        }
    }
}

#[test]
fn more_keypoints_than_a_block_holds_and_the_motions_of_an_arm() {
    // To the side, ahead (epipole in the image), about the axis; large enough for many strips, blocks and bands.
    let scene = scene(1300, 1500, 4);
    let [a, b] = scene.points();
    for (at, turn) in
        [([0.3, 0.0, 0.0], 0.0), ([0.0, 0.3, 1e-7], 0.4), ([0.02, -0.01, 0.3], -0.2), ([0.1, 0.2, 0.1], 1.5)]
    {
        let matrix = fundamental(at, turn);
        for (half_width, radius_px) in
            [(1.0, None), (12.0, None), (90.0, None), (12.0, Some(60.0)), (150.0, Some(50.0))]
        {
            let gate = Gate::new(&matrix, half_width).unwrap().unwrap();
            let expected: Vec<Option<Point2<f64>>> = a
                .positions
                .iter()
                .enumerate()
                .map(|(i, p)| (i % 5 != 0).then(|| p + nalgebra::Vector2::new(9.0, 9.0)))
                .collect();
            let points = radius_px.map(|radius_px| PredictedPoints { in_b: &expected, radius_px });
            let options = FilterOptions { gate_px: Some(half_width), best: None, ransac: None, ..Default::default() };
            let prediction = Prediction { fundamental: Some(&matrix), points };
            let found = match_guided(a, b, &prediction, &options).unwrap();
            let admitted = |i: usize, j: usize| {
                let near = radius_px
                    .zip(expected[i])
                    .is_none_or(|(radius, p)| (b.positions[j] - p).norm_squared() <= radius * radius);
                near && gate.passes(&a.positions[i], &b.positions[j])
            };
            assert_eq!(found.matches, plain([a, b], admitted, &options.matching), "{at:?} {half_width} {radius_px:?}");
        }
    }
}

#[test]
fn lines_that_do_not_meet_in_a_point_are_searched_too() {
    let scene = scene(300, 300, 9);
    let [a, b] = scene.points();
    // Of full rank: no epipole.
    let matrix = fundamental([0.1, 0.2, 0.3], 0.3) + Matrix3::new(1e-7, 0.0, 0.0, 0.0, -2e-7, 0.0, 0.0, 0.0, 0.01);
    let options = FilterOptions { gate_px: Some(30.0), best: None, ransac: None, ..Default::default() };
    let gate = Gate::new(&matrix, 30.0).unwrap().unwrap();
    let found = match_guided(a, b, &Prediction { fundamental: Some(&matrix), points: None }, &options).unwrap();
    let admitted = |i: usize, j: usize| gate.passes(&a.positions[i], &b.positions[j]);
    assert_eq!(found.matches, plain([a, b], admitted, &options.matching));
}

#[test]
fn threads_do_not_matter() {
    let scene = scene(1800, 1500, 5);
    let [a, b] = scene.points();
    let matrix = fundamental([0.3, 0.1, 0.2], 0.1);
    let prediction = Prediction { fundamental: Some(&matrix), points: None };
    let options = FilterOptions { gate_px: Some(20.0), ransac: None, ..Default::default() };
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| match_guided(a, b, &prediction, &options).unwrap())
    };
    let one = on(1);
    assert!(one.matches.len() > 100);
    assert!((2..5).all(|threads| on(threads) == one));
}

#[test]
fn no_prediction_compares_everything() {
    let scene = scene(50, 50, 6);
    let [a, b] = scene.points();
    let options = FilterOptions { ransac: None, ..Default::default() };
    let everything = match_and_filter(a, b, None, &options).unwrap();
    assert_eq!(match_guided(a, b, &Prediction::default(), &options).unwrap(), everything);
    let zero = Matrix3::zeros();
    let no_baseline = match_guided(a, b, &Prediction { fundamental: Some(&zero), points: None }, &options).unwrap();
    assert_eq!((no_baseline.gate, no_baseline.matches), (GateOutcome::NoBaseline, everything.matches));
}

#[test]
fn wrong_predictions_are_refused() {
    let scene = scene(5, 5, 7);
    let [a, b] = scene.points();
    let with = |in_b: &[Option<Point2<f64>>], radius_px| {
        let points = Some(PredictedPoints { in_b, radius_px });
        match_guided(a, b, &Prediction { fundamental: None, points }, &FilterOptions::default())
    };
    assert!(matches!(with(&[None; 4], 5.0), Err(FeaturesError::CountMismatch { got: 4, need: 5, .. })));
    assert!(matches!(with(&[None; 5], 0.0), Err(FeaturesError::BadOption { .. })));
    let nowhere = [Some(Point2::new(f64::NAN, 0.0)); 5];
    assert!(matches!(with(&nowhere, 5.0), Err(FeaturesError::NotFinite { .. })));
}

#[test]
fn a_keypoint_far_outside_costs_no_memory() {
    let mut scene = scene(20, 20, 8);
    scene.positions[1][3] = Point2::new(1e12, -1e12);
    let [a, b] = scene.points();
    let matrix = fundamental([0.3, 0.1, 0.2], 0.1);
    let prediction = Prediction { fundamental: Some(&matrix), points: None };
    assert!(match_guided(a, b, &prediction, &FilterOptions::default()).is_ok());
    scene.positions[1][3] = Point2::new(1e308, -1e308);
    scene.positions[1][4] = Point2::new(-1e308, 1e308);
    let [a, b] = scene.points();
    assert!(match_guided(a, b, &prediction, &FilterOptions::default()).is_err());
}
