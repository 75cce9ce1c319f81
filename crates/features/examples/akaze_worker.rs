//! Detection and description on request, for the benchmark against other implementations (`benchmarks/features`).
//!
//! Reads commands from its standard input and answers each with one line:
//!
//! - `threads N`: use N threads from now on;
//! - `options JSON`: options of the detector, as JSON; those that are left out have their defaults;
//! - `run IMAGE`: detect and describe; answers the time in nanoseconds and the number of keypoints. The image is
//!   read before the clock starts, and kept for the next run of the same path;
//! - `save IMAGE FILE`: the same, and writes the features: for each keypoint 6 little-endian `f32` (x, y, size, angle
//!   in radians, response, level) and 64 bytes of descriptor;
//! - `memory`: peak resident memory in kilobytes (Linux).

use skclam_features::{Akaze, AkazeOptions, Features};
use std::io::{BufRead, Write};
use std::time::Instant;

type AnyError = Box<dyn std::error::Error>;

fn main() -> Result<(), AnyError> {
    let mut pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let mut akaze = Akaze::new(AkazeOptions::default());
    let mut loaded = (String::new(), image::GrayImage::new(1, 1));
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let (command, argument) = line.split_once(' ').unwrap_or((&line, ""));
        match command {
            "threads" => {
                pool = rayon::ThreadPoolBuilder::new().num_threads(argument.parse()?).build()?;
                println!("ok");
            }
            "options" => {
                akaze = Akaze::new(serde_json::from_str(argument)?);
                println!("ok");
            }
            "run" | "save" => {
                let (path, output) = argument.split_once(' ').unwrap_or((argument, ""));
                if command == "save" || loaded.0 != path {
                    loaded = (path.to_owned(), image::open(path)?.into_luma8());
                }
                let begin = Instant::now();
                let features = pool.install(|| akaze.detect_and_describe(&loaded.1, None))?;
                let nanoseconds = begin.elapsed().as_nanos();
                if !output.is_empty() {
                    save(&features, output)?;
                }
                println!("{nanoseconds} {}", features.keypoints.len());
            }
            "memory" => println!("{}", peak_kilobytes()?),
            other => return Err(format!("unknown command {other}").into()),
        }
        std::io::stdout().flush()?;
    }
    Ok(())
}

fn save(features: &Features, path: &str) -> Result<(), AnyError> {
    let mut bytes = Vec::with_capacity(88 * features.keypoints.len());
    for (k, d) in features.keypoints.iter().zip(&features.descriptors) {
        for value in [k.x, k.y, k.size, k.angle, k.response, f32::from(k.level)] {
            bytes.extend(value.to_le_bytes());
        }
        d.0.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    }
    Ok(std::fs::write(path, bytes)?)
}

fn peak_kilobytes() -> Result<u64, AnyError> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|l| l.starts_with("VmHWM")).ok_or("no VmHWM in the process's status")?;
    Ok(line.split_whitespace().nth(1).ok_or("no value of VmHWM")?.parse()?)
}
