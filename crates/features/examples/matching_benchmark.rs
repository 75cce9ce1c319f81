//! Times exhaustive and guided matching; for `benchmarks/features/matching.py`, which holds the former against
//! OpenCV's.
//!
//! Reads two files of raw descriptors (64 bytes each) and prints the time of each repetition in milliseconds, by the
//! wall clock and of the processor: of exhaustive matching, and of guided matching, keypoints spread over 1920 x 1080,
//! for half widths of the band from 2 to 200 px. `side`: along the epipolar lines of a camera that moves to the side
//! and turns; `ahead`: the epipole in the image; `depth`: to the side, and within 200 px of a predicted point, as in
//! the pipeline; and of refining 2,000 matches (`refinement`). A fourth argument names the one kind to run, once, for
//! counting instructions. Threads: `RAYON_NUM_THREADS`.

use cpu_time::ProcessTime;
use image::GrayImage;
use nalgebra::{Matrix2, Matrix3, Point2, Rotation3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use skclam_features::{DescribedPoints, Descriptor, FeaturesError, FilterOptions, MatchOptions};
use skclam_features::{PredictedPoints, Prediction, Pyramid, RefineOptions, Seed};
use skclam_features::{match_descriptors, match_guided, refine_matches};
use std::time::Instant;

fn read(path: &str) -> std::io::Result<Vec<Descriptor>> {
    let word = |bytes: &[u8], word: usize| u64::from_le_bytes(std::array::from_fn(|byte| bytes[word * 8 + byte]));
    let bytes = std::fs::read(path)?;
    Ok(bytes.chunks_exact(64).map(|bytes| Descriptor(std::array::from_fn(|index| word(bytes, index)))).collect())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (a, b, repetitions, only) = match arguments.as_slice() {
        [a, b, repetitions] => (a, b, repetitions, None),
        [a, b, repetitions, only] => (a, b, repetitions, Some(only)),
        _ => return Err("arguments: <descriptors of A> <descriptors of B> <repetitions> [kind]".into()),
    };
    let (a, b) = (read(a)?, read(b)?);
    let repetitions: usize = repetitions.parse()?;
    let run = |kind: &str, run: &dyn Fn() -> Result<usize, FeaturesError>| -> Result<(), FeaturesError> {
        if only.is_some_and(|only| only != kind) {
            return Ok(());
        }
        for _ in 0..repetitions {
            let (start, cpu) = (Instant::now(), ProcessTime::now());
            let matches = run()?;
            let [wall, cpu] = [start.elapsed(), cpu.elapsed()].map(|time| time.as_secs_f64() * 1e3);
            println!("{kind} {wall:.3} ms {cpu:.3} ms of the processor, {matches} matches");
        }
        Ok(())
    };
    let matching = MatchOptions { ratio: 0.8, ..MatchOptions::default() };
    run("exhaustive", &|| Ok(match_descriptors(&a, &b, &matching)?.matches.len()))?;

    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let mut spread = |count: usize| -> Vec<Point2<f64>> {
        (0..count).map(|_| Point2::new(random.random::<f64>() * 1920.0, random.random::<f64>() * 1080.0)).collect()
    };
    let (positions_a, positions_b) = (spread(a.len()), spread(b.len()));
    let predicted: Vec<Option<Point2<f64>>> =
        positions_a.iter().map(|at| Some(at + Vector2::new(60.0, 25.0))).collect();
    let inverse = Matrix3::new(1e-3, 0.0, -0.96, 0.0, 1e-3, -0.54, 0.0, 0.0, 1.0);
    let turn = Rotation3::new(Vector3::new(0.02, -0.1, 0.15));
    let fundamental = |moved: Vector3<f64>| inverse.transpose() * moved.cross_matrix() * turn.matrix() * inverse;
    let (side, ahead) = (fundamental(Vector3::new(0.2, 0.05, 0.03)), fundamental(Vector3::new(0.03, 0.02, 0.2)));
    for (motion, fundamental, radius_px) in
        [("side", &side, None), ("ahead", &ahead, None), ("depth", &side, Some(200.0))]
    {
        for half_width in [2.0, 5.0, 10.0, 25.0, 50.0, 100.0, 200.0] {
            let options = FilterOptions {
                matching: matching.clone(),
                gate_px: Some(half_width),
                ransac: None,
                ..FilterOptions::default()
            };
            let points = radius_px.map(|radius_px| PredictedPoints { in_b: &predicted, radius_px });
            let prediction = Prediction { fundamental: Some(fundamental), points };
            let a = DescribedPoints { descriptors: &a, positions: &positions_a };
            let b = DescribedPoints { descriptors: &b, positions: &positions_b };
            run(&format!("{motion}_{half_width}"), &|| Ok(match_guided(a, b, &prediction, &options)?.matches.len()))?;
        }
    }

    // A smooth pattern without repetition, and the same moved by fractions of a pixel, slightly turned and larger.
    let pattern = |x: f64, y: f64| {
        let waves = (0.31 * x + 0.17 * y).sin() + (0.22 * x - 0.41 * y).sin() + (0.0013 * x * y).sin();
        image::Luma([(127.0 + 35.0 * waves) as u8])
    };
    let b_from_a = Matrix2::new(1.08, -0.06, 0.06, 1.08);
    let a_from_b = b_from_a.try_inverse().ok_or("singular")?;
    let seen = |x: u32, y: u32| a_from_b * Vector2::new(f64::from(x) - 3.3, f64::from(y) + 2.7);
    let image_a = GrayImage::from_fn(640, 480, |x, y| pattern(f64::from(x), f64::from(y)));
    let image_b = GrayImage::from_fn(640, 480, |x, y| pattern(seen(x, y).x, seen(x, y).y));
    let seeds: Vec<Seed> = (0..2000)
        .map(|index| {
            let in_a = Point2::new(60.0 + f64::from(index % 50) * 9.3, 60.0 + f64::from(index / 50) * 8.1);
            let truth = b_from_a * in_a.coords + Vector2::new(3.3, -2.7);
            Seed { in_a, in_b: (truth + Vector2::new(0.5, -0.3)).into(), b_from_a: Matrix2::identity(), size_px: 5.0 }
        })
        .collect();
    let (a, b) = (Pyramid::new(&image_a), Pyramid::new(&image_b));
    run("refinement", &|| {
        let refined = refine_matches(&a, &b, &seeds, &RefineOptions::default())?;
        Ok(refined.iter().filter(|refined| refined.is_ok()).count())
    })?;
    Ok(())
}
