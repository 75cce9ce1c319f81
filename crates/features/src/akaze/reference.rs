//! The scale space, orientation and descriptor once more, written for reading: whole images, one pixel at a time, no
//! bands, no rings, no SIMD. The tests at the foot hold the fast version against it, level by level and bit for bit;
//! as this file is compiled for the baseline instruction set, they also show that all instruction sets agree.

use super::evolve::LevelTask;
use super::mldb::Square;
use super::plan::Level;
use crate::Descriptor;
use std::f64::consts::TAU;

/// A whole image.
#[derive(Debug, Clone, PartialEq)]
struct Plane {
    width: usize,
    height: usize,
    data: Vec<f32>,
}

impl Plane {
    fn new(width: usize, height: usize, value: impl Fn(isize, isize) -> f32) -> Self {
        let at = |i: usize| value((i % width) as isize, (i / width) as isize);
        Plane { width, height, data: (0..width * height).map(at).collect() }
    }

    /// Beyond the border: the nearest pixel.
    fn clamped(&self, x: isize, y: isize) -> f32 {
        let x = x.clamp(0, self.width as isize - 1) as usize;
        let y = y.clamp(0, self.height as isize - 1) as usize;
        self.data[y * self.width + x]
    }

    /// Beyond the border: mirrored at the centre of the last pixel.
    fn mirrored(&self, x: isize, y: isize) -> f32 {
        let mirror = |i: isize, n: usize| {
            let last = n as isize - 1;
            (if i < 0 {
                -i
            } else if i > last {
                2 * last - i
            } else {
                i
            })
            .clamp(0, last)
        };
        self.clamped(mirror(x, self.width), mirror(y, self.height))
    }

    fn map(&self, value: impl Fn(isize, isize) -> f32) -> Plane {
        Plane::new(self.width, self.height, value)
    }
}

fn blur(image: &Plane, taps: &[f32]) -> Plane {
    let along = |image: &Plane, (dx, dy): (isize, isize)| {
        image.map(|x, y| {
            let mut sum = taps[0] * image.clamped(x, y);
            for (j, tap) in taps.iter().enumerate().skip(1) {
                let j = j as isize;
                sum += tap * (image.clamped(x - j * dx, y - j * dy) + image.clamped(x + j * dx, y + j * dy));
            }
            sum
        })
    };
    along(&along(image, (0, 1)), (1, 0))
}

/// Squared magnitude of Scharr's gradient.
fn scharr_squared(image: &Plane) -> Plane {
    let smooth =
        image.map(|x, y| 3.0 * (image.mirrored(x, y - 1) + image.mirrored(x, y + 1)) + 10.0 * image.mirrored(x, y));
    let difference = image.map(|x, y| image.mirrored(x, y + 1) - image.mirrored(x, y - 1));
    image.map(|x, y| {
        let lx = smooth.mirrored(x + 1, y) - smooth.mirrored(x - 1, y);
        let ly =
            3.0 * (difference.mirrored(x - 1, y) + difference.mirrored(x + 1, y)) + 10.0 * difference.mirrored(x, y);
        lx * lx + ly * ly
    })
}

/// One explicit step of diffusion; without a neighbour nothing flows.
fn diffuse(image: &Plane, g: &Plane, half_step: f32) -> Plane {
    let inside = |x: isize, y: isize| x >= 0 && y >= 0 && x < image.width as isize && y < image.height as isize;
    image.map(|x, y| {
        let flow = |nx: isize, ny: isize| match inside(nx, ny) {
            true => (g.clamped(x, y) + g.clamped(nx, ny)) * (image.clamped(nx, ny) - image.clamped(x, y)),
            false => 0.0,
        };
        let vertical = flow(x, y + 1) + flow(x, y - 1);
        let horizontal = flow(x + 1, y) + flow(x - 1, y);
        image.clamped(x, y) + half_step * (horizontal + vertical)
    })
}

/// First derivative in x or in y with taps `step` apart.
fn derivative(image: &Plane, step: usize, in_x: bool) -> Plane {
    let s = step as isize;
    let side = 1.0 / (2.0 * step as f32 * (10.0 / 3.0 + 2.0));
    let middle = side * (10.0 / 3.0);
    if in_x {
        let smooth = image
            .map(|x, y| side * (image.mirrored(x, y - s) + image.mirrored(x, y + s)) + middle * image.mirrored(x, y));
        image.map(|x, y| smooth.mirrored(x + s, y) - smooth.mirrored(x - s, y))
    } else {
        let difference = image.map(|x, y| image.mirrored(x, y + s) - image.mirrored(x, y - s));
        image.map(|x, y| {
            side * (difference.mirrored(x - s, y) + difference.mirrored(x + s, y)) + middle * difference.mirrored(x, y)
        })
    }
}

/// What the sweep of a level should give.
struct LevelResult {
    image: Plane,
    gradient: [Plane; 2],
    determinant: Plane,
}

fn level(task: &LevelTask<'_>) -> LevelResult {
    let Level { width, height, step, .. } = *task.level;
    let source = Plane { width, height, data: task.source.to_vec() };
    let smooth = task.blur.map_or(source.clone(), |taps| blur(&source, taps));
    let m2 = scharr_squared(&smooth);
    let g = m2.map(|x, y| 1.0 / (1.0 + m2.clamped(x, y) * task.inverse_k2));
    let image = task.level.half_steps.iter().fold(source, |image, &h| diffuse(&image, &g, h));
    let gradient = [derivative(&smooth, step, true), derivative(&smooth, step, false)];
    let lxx = derivative(&gradient[0], step, true);
    let lxy = derivative(&gradient[0], step, false);
    let lyy = derivative(&gradient[1], step, false);
    let scale = (step * step * step * step) as f32;
    let determinant = lxx.map(|x, y| {
        let (xx, xy, yy) = (lxx.clamped(x, y), lxy.clamped(x, y), lyy.clamped(x, y));
        scale * (xx * yy - xy * xy)
    });
    LevelResult { image, gradient, determinant }
}

/// Pixels inside of the level's border that exceed the threshold and their eight neighbours.
fn maxima(det: &Plane, level: &Level, threshold: f32) -> Vec<(u32, u32)> {
    let b = level.border;
    let mut found = Vec::new();
    for y in b..level.height - b {
        for x in b..level.width - b {
            let (x, y) = (x as isize, y as isize);
            let v = det.clamped(x, y);
            let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))).filter(|d| *d != (0, 0));
            if v > threshold && around.into_iter().all(|(dx, dy)| v > det.clamped(x + dx, y + dy)) {
                found.push((x as u32, y as u32));
            }
        }
    }
    found
}

/// Main direction with exact arc tangents, over all positions of the window of 42 slices.
fn main_direction(gradient: &[[f32; 2]], width: usize, x: usize, y: usize, step: usize) -> f64 {
    let mut vectors = Vec::new();
    for j in -6i32..=6 {
        for i in -6i32..=6 {
            if i * i + j * j < 36 {
                let at = (y as i32 + j * step as i32) as usize * width + (x as i32 + i * step as i32) as usize;
                let weight = (-f64::from(i * i + j * j) / 12.5).exp();
                let v = gradient[at].map(|g| weight * f64::from(g));
                vectors.push((v, (v[1].atan2(v[0]).rem_euclid(TAU) / TAU * 42.0) as i32));
            }
        }
    }
    let sums = (0..42).map(|centre| {
        vectors.iter().fold([0.0; 2], |sum, (v, slice)| {
            let distance = f64::from((slice - centre + 21).rem_euclid(42) - 21).abs();
            let weight = if distance < 10.0 { 0.5 + 0.5 * (TAU / 20.0 * distance).cos() } else { 0.0 };
            [sum[0] + weight * v[0], sum[1] + weight * v[1]]
        })
    });
    let best = sums.max_by(|a, b| a[0].hypot(a[1]).total_cmp(&b[0].hypot(b[1]))).expect("42 windows");
    best[1].atan2(best[0]).rem_euclid(TAU)
}

/// The descriptor, each cell by itself.
fn describe(image: &[f32], gradient: &[[f32; 2]], width: usize, square: Square) -> Descriptor {
    let [co, si] = square.direction.map(f64::from);
    let mut words = [0u64; 8];
    let mut bit = 0;
    for borders in [&[0, 10, 20][..], &[0, 7, 13, 20], &[0, 5, 10, 15, 20]] {
        let mut cells: Vec<[f64; 3]> = Vec::new();
        for along in borders.windows(2) {
            for across in borders.windows(2) {
                let mut sum = [0.0; 3];
                for u in along[0]..along[1] {
                    for v in across[0]..across[1] {
                        let (u, v) = (f64::from(u) - 9.5, f64::from(v) - 9.5);
                        let step = f64::from(square.step);
                        let x = (f64::from(square.centre[0]) + step * (u * co - v * si)).round() as usize;
                        let y = (f64::from(square.centre[1]) + step * (u * si + v * co)).round() as usize;
                        let [gx, gy] = gradient[y * width + x].map(f64::from);
                        sum[0] += f64::from(image[y * width + x]);
                        sum[1] += gy * co - gx * si;
                        sum[2] += gx * co + gy * si;
                    }
                }
                cells.push(sum.map(|s| s / f64::from((along[1] - along[0]) * (across[1] - across[0]))));
            }
        }
        for channel in 0..3 {
            for i in 0..cells.len() {
                for j in i + 1..cells.len() {
                    words[bit / 64] |= u64::from(cells[i][channel] > cells[j][channel]) << (bit % 64);
                    bit += 1;
                }
            }
        }
    }
    assert_eq!(bit, 486);
    Descriptor(words)
}

#[cfg(test)]
mod tests {
    use super::super::orientation;
    use super::super::{Akaze, AkazeOptions, initial, mldb, plan};
    use super::*;
    use image::GrayImage;

    /// Blocks, ramps and noise.
    fn image(width: u32, height: u32) -> GrayImage {
        GrayImage::from_fn(width, height, |x, y| {
            let block = (x / 13 * 7 + y / 17 * 5) % 8 * 20;
            let noise =
                (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(2_246_822_519)).wrapping_mul(3_266_489_917) >> 27;
            image::Luma([(block + noise + (x + y) / 16 % 32) as u8])
        })
    }

    #[test]
    fn every_level_agrees_bit_for_bit_however_the_image_is_cut() {
        for (width, height, threads) in [(161, 123, 1), (250, 201, 3), (192, 300, 7)] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| check_levels(&image(width, height)));
        }
    }

    /// The same bits, as far as there are expected ones.
    fn same(got: &[f32], expected: &[f32], what: &str) {
        let different = got.iter().zip(expected).position(|(a, b)| a != b);
        assert_eq!(different.map(|i| (i, got[i], expected[i])), None, "{what}: first different value");
    }

    fn check_levels(image: &GrayImage) {
        let options = AkazeOptions::default();
        let (width, height) = (image.width() as usize, image.height() as usize);
        let levels = plan::levels(width, height, &options);
        let mut akaze = Akaze::new(options.clone());
        let mut contrast = akaze.prepare(image, &levels[0]);

        let float = Plane { width, height, data: image.iter().map(|&g| f32::from(g) * (1.0 / 255.0)).collect() };
        let first = blur(&float, &initial::gaussian_taps(f64::from(options.base_sigma), 4));
        same(&akaze.planes[0].image, &first.data, "first level");
        let small = initial::small_blur();
        let magnitude = scharr_squared(&blur(&float, &small));
        check_contrast(&magnitude, contrast);

        let mut before = first;
        let mut points = 0;
        for (i, l) in levels.iter().enumerate() {
            if i > 0 && l.octave > levels[i - 1].octave {
                akaze.halve((i + 1) % 2, &levels[i - 1], l);
                let fine = before;
                before = Plane::new(l.width, l.height, |x, y| {
                    let v = |dx, dy| fine.clamped(2 * x + dx, 2 * y + dy);
                    0.25 * ((v(0, 0) + v(1, 1)) + (v(1, 0) + v(0, 1)))
                });
                contrast *= 0.75;
            }
            akaze.evolve(i, &levels, contrast, &small);
            let task = LevelTask {
                level: l,
                source: &before.data,
                diffusivity: options.diffusivity,
                inverse_k2: 1.0 / (contrast * contrast),
                blur: (i > 0).then_some(&small),
                threshold: options.threshold,
            };
            let expected = level(&task);
            let plane = &akaze.planes[i % 2];
            same(&plane.image, &expected.image.data, &format!("level {i}"));
            if l.searchable() {
                for (j, g) in plane.gradient[..l.width * l.height].iter().enumerate() {
                    assert_eq!(
                        *g,
                        [expected.gradient[0].data[j], expected.gradient[1].data[j]],
                        "level {i}, pixel {j}"
                    );
                }
                let found: Vec<(u32, u32)> = akaze.maxima.points.iter().map(|p| (p.x, p.y)).collect();
                assert_eq!(found, maxima(&expected.determinant, l, options.threshold), "level {i}");
                for p in &akaze.maxima.points {
                    assert_eq!(p.response, expected.determinant.clamped(p.x as isize, p.y as isize));
                }
                points += found.len();
            }
            before = expected.image;
        }
        assert!(points > 20, "{points}");
    }

    /// The contrast factor lies within one of its 300 bins of the exact quantile.
    fn check_contrast(squared: &Plane, contrast: f32) {
        let mut inner: Vec<f32> = (1..squared.height - 1)
            .flat_map(|y| squared.data[y * squared.width..][1..squared.width - 1].iter().map(|v| v.sqrt()))
            .collect();
        inner.sort_by(f32::total_cmp);
        let maximum = inner[inner.len() - 1];
        let background = inner.partition_point(|&m| m < maximum / 299.0);
        let quantile = inner[background + ((inner.len() - background) as f32 * 0.7) as usize];
        assert!((contrast - quantile).abs() < maximum / 100.0, "{contrast} {quantile}");
    }

    #[test]
    fn directions_and_descriptors_agree() {
        let options = AkazeOptions::default();
        let image = image(200, 180);
        let levels = plan::levels(200, 180, &options);
        let mut akaze = Akaze::new(options);
        let contrast = akaze.prepare(&image, &levels[0]);
        akaze.evolve(0, &levels, contrast, &initial::small_blur());
        let plane = &akaze.planes[0];
        let (mut directions, mut bits, mut count) = (0, 0, 0);
        for y in (40..140).step_by(9) {
            for x in (40..160).step_by(7) {
                let fast = orientation::main_direction(&plane.gradient, 200, x, y, 2, &akaze.disc);
                let exact = main_direction(&plane.gradient, 200, x, y, 2);
                let difference = (f64::from(fast) - exact + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
                directions += u32::from(difference.abs() > 1e-3);
                let centre = [x as f32 + 0.23, y as f32 - 0.41];
                let square = Square { centre, step: 2.0, direction: [fast.cos(), fast.sin()] };
                let descriptor = mldb::describe(&plane.image, &plane.gradient, 200, square);
                bits += descriptor.hamming(&describe(&plane.image, &plane.gradient, 200, square));
                count += 1;
            }
        }
        // A gradient on the border of two slices may fall into the other one; samples halfway between two pixels and
        // cells of equal value may be rounded differently.
        assert!(directions * 50 <= count, "{directions} of {count}");
        assert!(bits <= count, "{bits} bits in {count} descriptors");
    }
}
