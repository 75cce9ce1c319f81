//! AKAZE as its users see it: independence of threads, invariance under turns, odd sizes, masks and limits.

use image::{GrayImage, Luma, imageops};
use proptest::prelude::*;
use skclam_features::akaze::{Orientation, Threading};
use skclam_features::{Akaze, AkazeOptions, Features, FeaturesError};
use std::f32::consts::{PI, TAU};

/// Discs and rectangles of many sizes and greys with smooth edges.
fn scene(width: u32, height: u32) -> GrayImage {
    let mut state = 12_345u32;
    let mut random = move |n: u32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) % n
    };
    let mut image = vec![100.0f32; (width * height) as usize];
    for i in 0..width * height / 400 {
        let (cx, cy) = (random(width) as f32 + 0.3, random(height) as f32 + 0.4);
        let zoom = if i % 16 < 2 { 3.0 } else { 1.0 };
        let (a, b) = (zoom * (2.0 + random(12) as f32), zoom * (2.0 + random(12) as f32));
        let grey = random(256) as f32;
        let reach = a.max(b) + 2.0;
        let (x0, x1) = ((cx - reach).max(0.0) as u32, ((cx + reach) as u32 + 1).min(width));
        let (y0, y1) = ((cy - reach).max(0.0) as u32, ((cy + reach) as u32 + 1).min(height));
        for y in y0..y1 {
            for x in x0..x1 {
                let (dx, dy) = ((x as f32 - cx).abs(), (y as f32 - cy).abs());
                let inside = if i % 2 == 0 { a - dx.hypot(dy) } else { (a - dx).min(b - dy) };
                let cover = (inside + 0.5).clamp(0.0, 1.0);
                let pixel = &mut image[(y * width + x) as usize];
                *pixel += cover * (grey - *pixel);
            }
        }
    }
    GrayImage::from_fn(width, height, |x, y| Luma([image[(y * width + x) as usize].round() as u8]))
}

fn detect(image: &GrayImage, options: AkazeOptions) -> Features {
    Akaze::new(options).detect_and_describe(image, None).expect("good options")
}

fn assert_same(a: &Features, b: &Features) {
    assert_eq!(a.keypoints, b.keypoints);
    assert_eq!(a.descriptors, b.descriptors);
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let image = scene(400, 333);
    let alone = detect(&image, AkazeOptions { threading: Threading::Caller, ..Default::default() });
    assert!(alone.keypoints.len() > 300, "{}", alone.keypoints.len());
    for threads in [1, 2, 5] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        assert_same(&alone, &pool.install(|| detect(&image, AkazeOptions::default())));
    }
}

#[test]
fn buffers_of_a_larger_image_change_nothing() {
    let small = scene(240, 160);
    let mut akaze = Akaze::new(AkazeOptions::default());
    akaze.detect_and_describe(&scene(400, 333), None).expect("good options");
    let reused = akaze.detect_and_describe(&small, None).expect("good options");
    assert_same(&reused, &detect(&small, AkazeOptions::default()));
}

/// Of the first image's keypoints those that the second has at the place to which `turn` moves them, in the same
/// level: the number, the mean offset, the largest difference of the direction, and the mean Hamming distance.
fn compare(a: &Features, b: &Features, turn: impl Fn(f32, f32) -> (f32, f32), by: f32) -> (usize, [f32; 2], f32, f32) {
    let (mut count, mut mean, mut turned_by, mut hamming) = (0, [0.0; 2], Vec::new(), 0);
    for (i, k) in a.keypoints.iter().enumerate() {
        let (x, y) = turn(k.x, k.y);
        let neighbor = b.keypoints.iter().position(|o| o.level == k.level && (o.x - x).hypot(o.y - y) < 0.05 * k.size);
        if let Some(j) = neighbor {
            let o = &b.keypoints[j];
            count += 1;
            mean = [mean[0] + o.x - x, mean[1] + o.y - y];
            turned_by.push(((o.angle - k.angle - by + PI).rem_euclid(TAU) - PI).abs());
            hamming += a.descriptors[i].hamming(&b.descriptors[j]);
        }
    }
    turned_by.sort_by(f32::total_cmp);
    let n = count.max(1) as f32;
    (count, mean.map(|m| m / n), turned_by[count * 98 / 100], hamming as f32 / n)
}

#[test]
fn a_turn_by_90_or_180_degrees_turns_the_keypoints() {
    let image = scene(400, 336);
    let straight = detect(&image, AkazeOptions::default());
    let total = straight.keypoints.len();
    assert!(straight.keypoints.iter().any(|k| k.octave >= 1), "coarse octaves are tested too");

    let quarter = detect(&imageops::rotate90(&image), AkazeOptions::default());
    let (count, mean, angle, hamming) = compare(&straight, &quarter, |x, y| (335.0 - y, x), PI / 2.0);
    assert!(count * 100 >= total * 98 && quarter.keypoints.len().abs_diff(total) * 50 <= total, "{count} of {total}");
    // A quarter turn is ten and a half slices of the direction's histogram.
    assert!(mean.iter().all(|m| m.abs() < 0.01) && angle < 0.1 && hamming < 20.0, "{mean:?} {angle} {hamming}");

    let half = detect(&imageops::rotate180(&image), AkazeOptions::default());
    let (count, mean, angle, hamming) = compare(&straight, &half, |x, y| (399.0 - x, 335.0 - y), PI);
    assert!(count * 100 >= total * 98, "{count} of {total}");
    assert!(mean.iter().all(|m| m.abs() < 0.02) && angle < 0.02 && hamming < 12.0, "{mean:?} {angle} {hamming}");
}

#[test]
fn upright_descriptors_have_no_angle() {
    let image = scene(240, 200);
    let upright = detect(&image, AkazeOptions { orientation: Orientation::Upright, ..Default::default() });
    let main = detect(&image, AkazeOptions::default());
    assert_eq!(upright.keypoints.len(), main.keypoints.len());
    assert!(upright.keypoints.iter().all(|k| k.angle == 0.0));
    assert_ne!(upright.descriptors, main.descriptors);
}

#[test]
fn a_mask_leaves_out_and_must_have_the_size_of_the_image() {
    let image = scene(300, 200);
    let all = detect(&image, AkazeOptions::default());
    let mask = GrayImage::from_fn(300, 200, |x, _| Luma([u8::from(x >= 150) * 255]));
    let right = Akaze::new(AkazeOptions::default()).detect_and_describe(&image, Some(&mask)).expect("good options");
    let expected: Vec<_> = all.keypoints.iter().filter(|k| k.x.round() >= 150.0).copied().collect();
    assert!(!expected.is_empty() && expected.len() < all.keypoints.len());
    assert_eq!(right.keypoints, expected);
    assert_eq!(right.descriptors.len(), expected.len());

    let wrong = Akaze::new(AkazeOptions::default()).detect_and_describe(&image, Some(&GrayImage::new(200, 300)));
    assert!(matches!(wrong, Err(FeaturesError::MaskSize { width: 300, mask_width: 200, .. })), "{wrong:?}");
}

#[test]
fn a_limit_keeps_strong_keypoints_everywhere() {
    let image = scene(400, 400);
    let all = detect(&image, AkazeOptions::default());
    let limit = all.keypoints.len() / 3;
    let few = detect(&image, AkazeOptions { max_keypoints: Some(limit), ..Default::default() });
    assert_eq!(few.keypoints.len(), limit);
    let quadrants = |f: &Features| {
        let mut n = [0usize; 4];
        f.keypoints.iter().for_each(|k| n[usize::from(k.x > 200.0) + 2 * usize::from(k.y > 200.0)] += 1);
        n
    };
    for (few, all) in quadrants(&few).into_iter().zip(quadrants(&all)) {
        assert!(few * 5 >= all, "{few} of {all}");
    }
    let mean = |f: &Features| f.keypoints.iter().map(|k| k.response).sum::<f32>() / f.keypoints.len() as f32;
    assert!(mean(&few) > mean(&all));
}

#[test]
fn images_without_structure_or_room_have_no_keypoints() {
    for (width, height) in [(1, 1), (1, 500), (500, 1), (2, 2), (58, 58), (640, 57)] {
        let noise = GrayImage::from_fn(width, height, |x, y| Luma([(x * 37 + y * 91) as u8]));
        assert!(detect(&noise, AkazeOptions::default()).keypoints.is_empty(), "{width}x{height}");
    }
    for grey in [0, 128, 255] {
        let flat = GrayImage::from_pixel(200, 150, Luma([grey]));
        assert!(detect(&flat, AkazeOptions::default()).keypoints.is_empty(), "{grey}");
    }
}

#[test]
fn saturated_images_are_survived() {
    let checks = GrayImage::from_fn(300, 220, |x, y| Luma([u8::from((x / 9 + y / 9) % 2 == 0) * 255]));
    let features = detect(&checks, AkazeOptions::default());
    assert!(features.keypoints.iter().all(|k| k.x.is_finite() && k.y.is_finite() && k.angle.is_finite()));
    let noise = GrayImage::from_fn(300, 220, |x, y| {
        Luma([u8::from((x.wrapping_mul(747_796_405) ^ y.wrapping_mul(2_891_336_453)) >> 15 & 1 == 0) * 255])
    });
    assert!(detect(&noise, AkazeOptions::default()).keypoints.iter().all(|k| k.response.is_finite()));
}

#[test]
#[ignore = "1.6 GB of memory; run with --ignored"]
fn a_very_large_image_is_survived() {
    let image = GrayImage::from_fn(8192, 8192, |x, y| Luma([if x % 512 < 24 && y % 512 < 24 { 220 } else { 60 }]));
    let features = detect(&image, AkazeOptions::default());
    assert!(features.keypoints.len() >= 15 * 15, "{}", features.keypoints.len());
}

#[test]
fn bad_options_are_named() {
    let options = AkazeOptions { octaves: 0, ..Default::default() };
    let error = Akaze::new(options).detect_and_describe(&scene(100, 100), None).expect_err("no octaves");
    assert_eq!(error.to_string(), "option `octaves` is 0, expected 1 to 8");
    let json = serde_json::from_str::<AkazeOptions>(r#"{"treshold": 0.1}"#);
    assert!(json.is_err_and(|e| e.to_string().contains("treshold")));
}

/// OpenCV 4.14 finds 4460 and 1485 keypoints in these images at the default threshold.
#[test]
fn as_many_keypoints_as_the_peer() {
    let data = std::env::var_os("SKCLAM_DATA").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
        std::path::PathBuf::from,
    );
    for (name, peer) in [("boat", 4460usize), ("iguazu", 1485)] {
        let path = data.join("homographies").join(name).join("img1.pgm");
        let Ok(image) = image::open(&path) else {
            println!("skipped: no image {name} in the shared data; set SKCLAM_DATA");
            return;
        };
        let count = detect(&image.into_luma8(), AkazeOptions::default()).keypoints.len();
        assert!(count.abs_diff(peer) * 20 <= peer, "{name}: {count}, the peer has {peer}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn any_size_and_content(
        width in 1u32..260,
        height in 1u32..200,
        seed in any::<u32>(),
        coarse in 1u32..24,
        octaves in 1usize..6,
        sublevels in 1usize..6,
        derivative_factor in 0.5f32..4.0,
    ) {
        let image = GrayImage::from_fn(width, height, |x, y| {
            let (x, y) = (x / coarse, y / coarse);
            let mixed = (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(2_246_822_519) ^ seed).wrapping_mul(3_266_489_917);
            Luma([(mixed >> 24) as u8])
        });
        let options = AkazeOptions { octaves, sublevels, derivative_factor, ..Default::default() };
        let features = detect(&image, options);
        prop_assert_eq!(features.keypoints.len(), features.descriptors.len());
        for k in &features.keypoints {
            prop_assert!(k.x >= 0.0 && k.x <= (width - 1) as f32 && k.y >= 0.0 && k.y <= (height - 1) as f32);
            prop_assert!((0.0..TAU).contains(&k.angle) && k.response > 0.001 && k.size > 0.0);
        }
        for d in &features.descriptors {
            prop_assert_eq!(d.0[7] >> 38, 0);
        }
    }
}
