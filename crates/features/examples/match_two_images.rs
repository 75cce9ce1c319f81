//! Detects, describes and matches, and nothing else: `cargo run --release -p skclam-features --example match_two_images
//! -- ONE.png OTHER.png`. Prints a line `x y x y`, in pixels, for each match.

use skclam_features::{Akaze, AkazeOptions, DescribedPoints, Features, FilterOptions, match_and_filter};
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let names: Vec<String> = std::env::args().skip(1).collect();
    let [one, other] = names.as_slice() else { return Err("two image files are needed".into()) };
    let mut akaze = Akaze::new(AkazeOptions::default());
    let mut features = |name: &str| -> Result<Features, Box<dyn Error>> {
        Ok(akaze.detect_and_describe(&image::open(name)?.into_luma8(), None)?)
    };
    let (in_one, in_other) = (features(one)?, features(other)?);
    let [at_one, at_other] = [&in_one, &in_other].map(|features| -> Vec<nalgebra::Point2<f64>> {
        features.keypoints.iter().map(|point| nalgebra::Point2::new(point.x.into(), point.y.into())).collect()
    });
    // Ratio test, cross-check and RANSAC; without a predicted geometry there is no gate.
    let found = match_and_filter(
        DescribedPoints { descriptors: &in_one.descriptors, positions: &at_one },
        DescribedPoints { descriptors: &in_other.descriptors, positions: &at_other },
        None,
        &FilterOptions::default(),
    )?;
    for m in &found.matches {
        let (a, b) = (at_one[m.a as usize], at_other[m.b as usize]);
        println!("{:.2} {:.2} {:.2} {:.2}", a.x, a.y, b.x, b.y);
    }
    eprintln!("{} of {} keypoints matched", found.matches.len(), in_one.keypoints.len());
    Ok(())
}
