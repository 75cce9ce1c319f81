//! Times exhaustive matching; for `benchmarks/features/matching.py`, which holds it against OpenCV's.
//!
//! Reads two files of raw descriptors (64 bytes each), prints the time of each repetition in milliseconds.
//! Threads: `RAYON_NUM_THREADS`.

use skclam_features::{Descriptor, MatchOptions, match_descriptors};
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
    let options = MatchOptions { ratio: 0.8, ..MatchOptions::default() };
    for _ in 0..repetitions.parse()? {
        let start = Instant::now();
        let matching = match_descriptors(&a, &b, &options)?;
        println!("{:.3} ms, {} matches", start.elapsed().as_secs_f64() * 1e3, matching.matches.len());
    }
    Ok(())
}
