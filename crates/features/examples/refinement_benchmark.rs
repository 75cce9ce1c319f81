//! Localization error of correct matches before and after refinement, under homographies made from natural images.
//!
//! `cargo run --release -p skclam-features --example refinement_benchmark [../shared/data]`
//!
//! Each image is turned (0 to 180 deg), zoomed (0.7 to 1.4) and seen from the side (10 to 40 deg) by a homography,
//! interpolated by a cubic with nine samples a pixel; AKAZE features of both are matched (ratio 0.8, cross-check);
//! a match within 3 px of the truth is correct.

use cpu_time::ProcessTime;
use image::{GrayImage, Luma};
use nalgebra::{Matrix3, Point2};
use skclam_features::{Akaze, AkazeOptions, MatchOptions, Pyramid, RefineOptions, Refined, Seed};
use skclam_features::{match_descriptors, refine_matches};

const IMAGES: [&str; 6] = [
    "homographies/boat/img1.pgm",
    "homographies/iguazu/img1.pgm",
    "apc-shelf/color/000.png",
    "wheel-d405/color/000",
    "virtual-cell/color/000",
    "nachi-mz25/color/000.jpg",
];

fn cubic(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

fn sample(image: &GrayImage, x: f64, y: f64) -> Option<f64> {
    let (fx, fy) = (x.floor(), y.floor());
    if fx < 1.0 || fy < 1.0 || fx + 2.0 >= f64::from(image.width()) || fy + 2.0 >= f64::from(image.height()) {
        return None;
    }
    let (wx, wy) = (cubic(x - fx), cubic(y - fy));
    let mut sum = 0.0;
    for (j, wy) in wy.into_iter().enumerate() {
        for (i, wx) in wx.into_iter().enumerate() {
            let Luma([value]) = image.get_pixel(fx as u32 + i as u32 - 1, fy as u32 + j as u32 - 1);
            sum += wy * wx * f64::from(*value);
        }
    }
    Some(sum)
}

fn warped(image: &GrayImage, a_from_b: &Matrix3<f64>) -> GrayImage {
    GrayImage::from_fn(image.width(), image.height(), |x, y| {
        let mut sum = 0.0;
        for at in 0..9 {
            let (dx, dy) = (f64::from(at % 3 - 1) / 3.0, f64::from(at / 3 - 1) / 3.0);
            let p = a_from_b * Point2::new(f64::from(x) + dx, f64::from(y) + dy).to_homogeneous();
            sum += sample(image, p.x / p.z, p.y / p.z).unwrap_or(0.0);
        }
        Luma([(sum / 9.0).round().clamp(0.0, 255.0) as u8])
    })
}

/// The view of the image's plane by a camera that was turned about its axis, zoomed and moved to the side.
fn homography(image: &GrayImage, turn_deg: f64, zoom: f64, side_deg: f64) -> Matrix3<f64> {
    let (cx, cy) = (f64::from(image.width() - 1) / 2.0, f64::from(image.height() - 1) / 2.0);
    let focal = 1.2 * f64::from(image.width());
    let camera = Matrix3::new(focal, 0.0, cx, 0.0, focal, cy, 0.0, 0.0, 1.0);
    let side = nalgebra::Rotation3::from_euler_angles(0.2 * side_deg.to_radians(), side_deg.to_radians(), 0.0);
    let turn = nalgebra::Rotation3::from_euler_angles(0.0, 0.0, turn_deg.to_radians());
    // The plane is at one focal length, turned about the point that the axis meets.
    let mut seen = turn.matrix() * side.matrix() * Matrix3::new(1.0, 0.0, -cx, 0.0, 1.0, -cy, 0.0, 0.0, 0.0);
    seen[(2, 2)] += focal / zoom;
    camera * seen
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let data = std::env::args().nth(1).unwrap_or_else(|| "../shared/data".into());
    let mut akaze = Akaze::new(AkazeOptions::default());
    let groups: [(&str, Vec<[f64; 3]>); 3] = [
        ("turn 0 to 180 deg", [0.0, 15.0, 45.0, 90.0, 135.0, 180.0].map(|turn| [turn, 1.0, 0.0]).to_vec()),
        ("zoom 0.7 to 1.4", [0.7, 0.85, 1.2, 1.4].map(|zoom| [5.0, zoom, 0.0]).to_vec()),
        ("view 10 to 40 deg", [10.0, 20.0, 30.0, 40.0].map(|side| [10.0, 1.0, side]).to_vec()),
    ];
    println!(
        "image, group: correct matches; refined; median error before, after (px); 95 % after; off by > 0.5 px; nees; us of the processor a match"
    );
    let mut all: Vec<(Vec<f64>, Vec<f64>)> = vec![Default::default(); groups.len()];
    for name in IMAGES {
        let paths = ["", ".png", ".jpg"].map(|end| format!("{data}/{name}{end}"));
        let Some(path) = paths.iter().find(|path| std::path::Path::new(path).is_file()) else {
            println!("{name}: not there");
            continue;
        };
        let image = image::open(path)?.to_luma8();
        let (features_a, pyramid_a) = (akaze.detect_and_describe(&image, None)?, Pyramid::new(&image));
        for ((group, views), all) in groups.iter().zip(&mut all) {
            let (mut before, mut after, mut seconds, mut count, mut nees) =
                (Vec::new(), Vec::new(), 0.0, 0, Vec::new());
            for [turn, zoom, side] in views {
                let b_from_a = homography(&image, *turn, *zoom, *side);
                let other = warped(&image, &b_from_a.try_inverse().ok_or("singular")?);
                let features_b = akaze.detect_and_describe(&other, None)?;
                let pyramid_b = Pyramid::new(&other);
                let options = MatchOptions { ratio: 0.8, ..MatchOptions::default() };
                let matching = match_descriptors(&features_a.descriptors, &features_b.descriptors, &options)?;
                let (mut seeds, mut truths) = (Vec::new(), Vec::new());
                for m in &matching.matches {
                    let seed =
                        Seed::from_keypoints(&features_a.keypoints[m.a as usize], &features_b.keypoints[m.b as usize]);
                    let p = b_from_a * seed.in_a.to_homogeneous();
                    let truth = Point2::new(p.x / p.z, p.y / p.z);
                    if (seed.in_b - truth).norm() <= 3.0 {
                        before.push((seed.in_b - truth).norm());
                        seeds.push(seed);
                        truths.push(truth);
                    }
                }
                let start = ProcessTime::now();
                let refined = refine_matches(&pyramid_a, &pyramid_b, &seeds, &RefineOptions::default())?;
                seconds += start.elapsed().as_secs_f64();
                count += seeds.len();
                for (refined, truth) in refined.iter().zip(&truths) {
                    if let Ok(Refined { in_b, covariance, .. }) = refined {
                        let error = in_b - truth;
                        after.push(error.norm());
                        nees.push((covariance.try_inverse().ok_or("singular")? * error).dot(&error));
                    }
                }
            }
            for list in [&mut before, &mut after, &mut nees] {
                list.sort_by(f64::total_cmp);
            }
            let at = |list: &[f64], fraction: f64| {
                list.get((list.len() as f64 * fraction) as usize).copied().unwrap_or(f64::NAN)
            };
            println!(
                "{name}, {group}: {count}; {}; {:.3}, {:.4}; {:.3}; {}; {:.2}; {:.1}",
                after.len(),
                at(&before, 0.5),
                at(&after, 0.5),
                at(&after, 0.95),
                after.iter().filter(|&&error| error > 0.5).count(),
                at(&nees, 0.5),
                seconds * 1e6 / count as f64
            );
            all.0.extend(before);
            all.1.extend(after);
        }
    }
    for ((group, _), (before, after)) in groups.iter().zip(&mut all) {
        before.sort_by(f64::total_cmp);
        after.sort_by(f64::total_cmp);
        println!(
            "all, {group}: {} correct, {} refined, median error before {:.3}, after {:.4} px",
            before.len(),
            after.len(),
            before[before.len() / 2],
            after[after.len() / 2]
        );
    }
    Ok(())
}
