//! Times exhaustive and guided matching; for `benchmarks/features/matching.py`, which holds the former against OpenCV's.
//!
//! Reads two files of raw descriptors (64 bytes each) and prints the time of each repetition in milliseconds: of
//! exhaustive matching, and of guided matching along the epipolar lines of a camera that moves to the side and turns,
//! keypoints spread over 1920 x 1080, half widths of the band 2, 5, 10 and 50 px. Threads: `RAYON_NUM_THREADS`.

use nalgebra::{Matrix3, Point2, Rotation3, Vector3};
use rand::{RngExt, SeedableRng};
use skclam_features::{DescribedPoints, Descriptor, FilterOptions, MatchOptions, Prediction};
use skclam_features::{match_descriptors, match_guided};
use std::time::Instant;

fn read(path: &str) -> std::io::Result<Vec<Descriptor>> {
    let word = |bytes: &[u8], word: usize| u64::from_le_bytes(std::array::from_fn(|byte| bytes[word * 8 + byte]));
    let bytes = std::fs::read(path)?;
    Ok(bytes.chunks_exact(64).map(|bytes| Descriptor(std::array::from_fn(|index| word(bytes, index)))).collect())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [a, b, repetitions] = arguments.as_slice() else {
        return Err("arguments: <descriptors of A> <descriptors of B> <repetitions>".into());
    };
    let (a, b) = (read(a)?, read(b)?);
    let matching = MatchOptions { ratio: 0.8, ..MatchOptions::default() };
    let repetitions: usize = repetitions.parse()?;
    for _ in 0..repetitions {
        let start = Instant::now();
        let found = match_descriptors(&a, &b, &matching)?;
        println!("exhaustive {:.3} ms, {} matches", start.elapsed().as_secs_f64() * 1e3, found.matches.len());
    }

    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let mut spread = |count: usize| -> Vec<Point2<f64>> {
        (0..count).map(|_| Point2::new(random.random::<f64>() * 1920.0, random.random::<f64>() * 1080.0)).collect()
    };
    let (positions_a, positions_b) = (spread(a.len()), spread(b.len()));
    let inverse = Matrix3::new(1e-3, 0.0, -0.96, 0.0, 1e-3, -0.54, 0.0, 0.0, 1.0);
    let turn = Rotation3::new(Vector3::new(0.02, -0.1, 0.15));
    let fundamental = inverse.transpose() * Vector3::new(0.2, 0.05, 0.03).cross_matrix() * turn.matrix() * inverse;
    for half_width in [2.0, 5.0, 10.0, 50.0] {
        let options = FilterOptions {
            matching: matching.clone(),
            gate_px: Some(half_width),
            ransac: None,
            ..FilterOptions::default()
        };
        let prediction = Prediction { fundamental: Some(&fundamental), points: None };
        for _ in 0..repetitions {
            let start = Instant::now();
            let found = match_guided(
                DescribedPoints { descriptors: &a, positions: &positions_a },
                DescribedPoints { descriptors: &b, positions: &positions_b },
                &prediction,
                &options,
            )?;
            let elapsed = start.elapsed().as_secs_f64() * 1e3;
            println!("guided_{half_width} {elapsed:.3} ms, {} matches", found.matches.len());
        }
    }
    Ok(())
}
