use super::*;
use image::{GrayImage, Luma};
use nalgebra::Matrix3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A smooth image that is known at every point: waves of many directions and lengths.
struct Waves(Vec<[f64; 4]>);

impl Waves {
    fn new(seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut uniform = || random.random::<f64>();
        let wave = |_| {
            let (length, direction) = (4.0 * 10f64.powf(uniform()), std::f64::consts::TAU * uniform());
            let (s, c) = direction.sin_cos();
            let number = std::f64::consts::TAU / length;
            [number * c, number * s, std::f64::consts::TAU * uniform(), 3.0 * length.powf(0.5)]
        };
        Waves((0..40).map(wave).collect())
    }

    fn at(&self, p: Point2<f64>) -> f64 {
        127.0 + self.0.iter().map(|[a, b, phase, height]| height * (a * p.x + b * p.y + phase).sin()).sum::<f64>() / 2.0
    }

    /// The image whose pixel `q` shows the point `source_from_image * q`.
    fn image(&self, source_from_image: &Matrix3<f64>, gain: f64, noise: f64, seed: u64) -> GrayImage {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        GrayImage::from_fn(320, 240, |x, y| {
            let p = source_from_image * nalgebra::Vector3::new(f64::from(x), f64::from(y), 1.0);
            let disturbance: f64 = (0..12).map(|_| random.random::<f64>() - 0.5).sum();
            let value = gain * self.at(Point2::new(p.x / p.z, p.y / p.z)) + noise * disturbance;
            Luma([value.round().clamp(0.0, 255.0) as u8])
        })
    }
}

fn map(h: &Matrix3<f64>, p: Point2<f64>) -> Point2<f64> {
    let q = h * p.to_homogeneous();
    Point2::new(q.x / q.z, q.y / q.z)
}

/// The derivative of a homography.
fn derivative(h: &Matrix3<f64>, p: Point2<f64>) -> Matrix2<f64> {
    let (q, z) = (map(h, p), (h * p.to_homogeneous()).z);
    Matrix2::new(h.m11 - q.x * h.m31, h.m12 - q.x * h.m32, h.m21 - q.y * h.m31, h.m22 - q.y * h.m32) / z
}

/// Turns about the middle of the image, zooms and slants.
fn homography(angle_deg: f64, zoom: f64, slant: f64) -> Matrix3<f64> {
    let (s, c) = angle_deg.to_radians().sin_cos();
    let centre = Matrix3::new(1.0, 0.0, 160.0, 0.0, 1.0, 120.0, 0.0, 0.0, 1.0);
    let back = Matrix3::new(1.0, 0.0, -160.0, 0.0, 1.0, -120.0, 0.0, 0.0, 1.0);
    let turn = Matrix3::new(zoom * c, -zoom * s, 3.3, zoom * s, zoom * c, -2.6, slant * 1e-3, 0.0, 1.0);
    centre * turn * back
}

struct Outcome {
    errors: Vec<f64>,
    rejected: usize,
    /// Mean squared error in units of the covariance; two if that is right.
    normalised: f64,
}

/// Refines points on a grid from rough positions and rough warps (a similarity 4 degrees and 8 % off).
fn run(b_from_a: &Matrix3<f64>, options: &RefineOptions, noise: f64, size_px: f64, exact_warp: bool) -> Outcome {
    let waves = Waves::new(3);
    let a = Pyramid::new(&waves.image(&Matrix3::identity(), 0.9, noise, 1));
    let b = Pyramid::new(&waves.image(&b_from_a.try_inverse().unwrap(), 0.7, noise, 2));
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let mut uniform = |half: f64| (random.random::<f64>() * 2.0 - 1.0) * half;
    let (mut seeds, mut truth) = (Vec::new(), Vec::new());
    for _ in 0..400 {
        let in_a = Point2::new(160.0 + uniform(120.0), 120.0 + uniform(80.0));
        let true_in_b = map(b_from_a, in_a);
        if !(25.0..295.0).contains(&true_in_b.x) || !(25.0..215.0).contains(&true_in_b.y) {
            continue;
        }
        let linear = derivative(b_from_a, in_a);
        // The similarity nearest to the derivative.
        let (c, s) = (linear.m11 + linear.m22, linear.m21 - linear.m12);
        let zoom = linear.determinant().sqrt() * (1.0 + uniform(0.08));
        let turn = Rotation2::new(s.atan2(c) + uniform(0.07));
        let in_b = true_in_b + Vector2::new(uniform(0.9), uniform(0.9));
        let b_from_a = if exact_warp { linear } else { turn.matrix() * zoom };
        seeds.push(Seed { in_a, in_b, b_from_a, size_px });
        truth.push(true_in_b);
    }
    let refined = refine_matches(&a, &b, &seeds, options).unwrap();
    let mut outcome = Outcome { errors: Vec::new(), rejected: 0, normalised: 0.0 };
    for (refined, truth) in refined.iter().zip(&truth) {
        match refined {
            Ok(refined) => {
                let error = refined.in_b - truth;
                outcome.errors.push(error.norm());
                outcome.normalised += (refined.covariance.try_inverse().unwrap() * error).dot(&error);
            }
            Err(_) => outcome.rejected += 1,
        }
    }
    outcome.errors.sort_by(f64::total_cmp);
    outcome.normalised /= outcome.errors.len() as f64;
    outcome
}

fn median(sorted: &[f64]) -> f64 {
    sorted[sorted.len() / 2]
}

#[test]
fn a_few_hundredths_of_a_pixel_under_turns_zooms_and_slants() {
    for (angle, zoom, slant) in [
        (0.0, 1.0, 0.0),
        (10.0, 1.0, 0.0),
        (90.0, 1.0, 0.0),
        (180.0, 1.0, 0.0),
        (25.0, 0.7, 0.0),
        (-40.0, 1.4, 0.0),
        (5.0, 1.0, 1.0),
    ] {
        let outcome = run(&homography(angle, zoom, slant), &RefineOptions::default(), 1.0, 4.8, false);
        let (median, count) = (median(&outcome.errors), outcome.errors.len());
        assert!(median < 0.03, "turn {angle} deg, zoom {zoom}, slant {slant}: {median} px");
        assert!(outcome.rejected * 20 <= count, "{} rejected, {count} kept", outcome.rejected);
    }
}

#[test]
fn covariances_are_of_the_right_size() {
    for noise in [1.0, 4.0, 8.0] {
        for (model, exact) in [(WarpModel::Affine, false), (WarpModel::Translation, true)] {
            let options = RefineOptions { model, ..RefineOptions::default() };
            let outcome = run(&homography(20.0, 1.1, 0.3), &options, noise, 4.8, exact);
            assert!((1.3..3.0).contains(&outcome.normalised), "noise {noise}, {model:?}: {}", outcome.normalised);
        }
    }
}

#[test]
fn large_keypoints_are_refined_from_coarse_to_fine() {
    for size_px in [10.0, 20.0] {
        let outcome = run(&homography(15.0, 1.1, 0.0), &RefineOptions::default(), 1.0, size_px, false);
        assert!(median(&outcome.errors) < 0.05, "{size_px}: {}", median(&outcome.errors));
    }
}

#[test]
fn what_cannot_be_refined_says_why() {
    let flat = Pyramid::new(&GrayImage::from_pixel(100, 100, Luma([90])));
    let waves = Waves::new(5).image(&Matrix3::identity(), 1.0, 0.0, 0);
    let other = Pyramid::new(&Waves::new(6).image(&Matrix3::identity(), 1.0, 0.0, 0));
    let waves = Pyramid::new(&waves);
    let seed = Seed {
        in_a: Point2::new(50.0, 50.0),
        in_b: Point2::new(50.0, 50.0),
        b_from_a: Matrix2::identity(),
        size_px: 5.0,
    };
    let one =
        |a: &Pyramid, b: &Pyramid, seed: Seed| refine_matches(a, b, &[seed], &RefineOptions::default()).unwrap()[0];
    assert_eq!(one(&flat, &flat, seed), Err(Rejection::NoTexture));
    assert!(one(&waves, &flat, seed).is_err());
    assert!(one(&waves, &other, seed).is_err());
    assert!(one(&waves, &waves, seed).is_ok());
    let outside = Seed { in_a: Point2::new(3.0, 50.0), ..seed };
    assert_eq!(one(&waves, &waves, outside), Err(Rejection::OutsideImage));
    let far = Seed { in_b: Point2::new(1e300, -1e300), ..seed };
    assert_eq!(one(&waves, &waves, far), Err(Rejection::OutsideImage));
    for b_from_a in [Matrix2::new(1.0, 0.0, 0.0, -1.0), Matrix2::zeros(), Matrix2::identity() * f64::NAN] {
        assert_eq!(one(&waves, &waves, Seed { b_from_a, ..seed }), Err(Rejection::BadPrediction));
    }
    let options = RefineOptions { patch: 14, ..RefineOptions::default() };
    assert!(matches!(refine_matches(&flat, &flat, &[], &options), Err(FeaturesError::BadOption { .. })));
}

#[test]
fn the_same_image_gives_the_same_point() {
    let waves = Pyramid::new(&Waves::new(7).image(&Matrix3::identity(), 1.0, 0.0, 0));
    let at = Point2::new(101.25, 87.75);
    let seed = Seed { in_a: at, in_b: at + Vector2::new(0.4, -0.6), b_from_a: Matrix2::identity(), size_px: 5.0 };
    let refined = refine_matches(&waves, &waves, &[seed], &RefineOptions::default()).unwrap()[0].unwrap();
    assert!((refined.in_b - at).norm() < 1e-3);
    assert!(refined.correlation > 0.9999);
}

/// The second-order part of a homography.
fn bend_of(h: &Matrix3<f64>, p: Point2<f64>) -> Bend {
    let at = |u: f64, v: f64| map(h, p + Vector2::new(u, v)).coords;
    let twice = at(0.0, 0.0) * 2.0;
    let uu = (at(1.0, 0.0) + at(-1.0, 0.0) - twice) / 2.0;
    let vv = (at(0.0, 1.0) + at(0.0, -1.0) - twice) / 2.0;
    let uv = (at(1.0, 1.0) + at(-1.0, -1.0) - at(1.0, -1.0) - at(-1.0, 1.0)) / 4.0;
    Bend([0, 1].map(|axis| [uu[axis], uv[axis], vv[axis]]))
}

#[test]
fn a_slanted_plane_shifts_no_point_whose_bend_is_known() {
    let b_from_a = homography(0.0, 1.0, 1.5);
    let waves = Waves::new(3);
    let a = Pyramid::new(&waves.image(&Matrix3::identity(), 0.9, 0.3, 1));
    let b = Pyramid::new(&waves.image(&b_from_a.try_inverse().unwrap(), 0.9, 0.3, 2));
    let mut refiner = Refiner::new(&RefineOptions::default()).unwrap();
    let [mut affine, mut bent, mut count] = [0.0; 3];
    for at in 0..300 {
        let in_a = Point2::new(60.0 + 10.0 * f64::from(at % 20), 50.0 + 9.0 * f64::from(at / 20));
        let truth = map(&b_from_a, in_a);
        let seed = Seed { in_a, in_b: truth, b_from_a: derivative(&b_from_a, in_a), size_px: 5.0 };
        let known = |_: &Matrix2<f64>, _: &Point2<f64>| Some(bend_of(&b_from_a, in_a));
        let [without, with] = [refiner.refine(&a, &b, &seed), refiner.refine_bent(&a, &b, &seed, &known)];
        if let (Ok(without), Ok(with)) = (without, with) {
            affine += without.in_b.x - truth.x;
            bent += with.in_b.x - truth.x;
            count += 1.0;
        }
    }
    let [affine, bent] = [affine / count, bent / count];
    assert!(count > 150.0, "{count}");
    assert!(affine < -0.01, "the plane's bend shifts to one side: {affine} px");
    assert!(bent.abs() < 0.2 * affine.abs(), "{bent} px, affine {affine} px");
}

#[test]
fn windows_that_disagree_widen_the_covariance() {
    // Two halves of the patch move apart by a pixel, as at a step in depth.
    let waves = Waves::new(5);
    let a = Pyramid::new(&waves.image(&Matrix3::identity(), 0.9, 0.5, 1));
    let straight = waves.image(&Matrix3::identity(), 0.9, 0.5, 2);
    let torn = GrayImage::from_fn(320, 240, |x, y| {
        let moved = if (y / 6) % 2 == 0 { x } else { (x + 1).min(319) };
        *straight.get_pixel(moved, y)
    });
    let mut refiner = Refiner::new(&RefineOptions::default()).unwrap();
    let mut mean_variance = |b: &Pyramid| {
        let places = (0..300).map(|at| Point2::new(40.0 + 12.0 * f64::from(at % 20), 40.0 + 10.0 * f64::from(at / 20)));
        let seeds = places.map(|p| Seed { in_a: p, in_b: p, b_from_a: Matrix2::identity(), size_px: 5.0 });
        let found: Vec<Refined> = seeds.filter_map(|seed| refiner.refine(&a, b, &seed).ok()).collect();
        let error = found.iter().map(|r| r.covariance.trace()).sum::<f64>() / found.len() as f64;
        (found.len(), error)
    };
    let (all, noise) = mean_variance(&Pyramid::new(&straight));
    let (some, apart) = mean_variance(&Pyramid::new(&torn));
    assert!(all > 200 && some > 50, "{all} {some}");
    assert!(apart > 4.0 * noise, "{apart} px^2 beside {noise} px^2");
}
