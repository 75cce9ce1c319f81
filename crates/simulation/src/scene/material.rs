//! What surfaces are made of: concrete, plaster, boards, cardboard, lacquer, metal, paper.
//!
//! Every material has structure of many scales, from a hand's breadth to a millimetre, and none repeats: each surface
//! has a seed of its own. Plain materials have almost none: a cell has areas where nothing can be matched.

use super::canvas::{Canvas, Colour};
use super::lattice::{Octave, add_octave};
use super::print::{self, Patch};
use super::weathering::{Mottle, anywhere, base, count, cracks, power_size, scratches, specks, worn};
use crate::scene_rng::SceneRng;
use std::f32::consts::{PI, TAU};

/// The material and finish of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Material {
    /// Nearly even: lacquer, plastic, a ceiling.
    Plain(Colour),
    /// A painted wall that has seen years of work.
    Plaster(Colour),
    /// A floor: cast, cut, stained.
    Concrete(Colour),
    /// Oriented strand board.
    StrandBoard,
    /// Sawn boards with grain and knots.
    Wood(Colour),
    /// Stone chips in cement.
    Terrazzo(Colour),
    /// A carton with its print.
    Cardboard,
    /// Lacquered sheet with scratches, stickers and screws.
    Lacquer(Colour),
    /// Brushed sheet.
    Steel,
    /// A poster.
    Poster,
    /// Notes pinned to cork.
    NoticeBoard,
    /// The back of a binder or a book.
    Spine,
    /// A printed circuit, a control panel: small parts in rows that are never the same.
    Panel,
}

impl Material {
    /// Whether there is nothing to match on it.
    pub fn is_plain(&self) -> bool {
        matches!(self, Material::Plain(_))
    }

    /// Paints a sheet of `size_m` metres.
    pub fn paint(&self, size_m: (f32, f32), texel_m: f32, rng: &mut SceneRng) -> Canvas {
        let mut canvas = Canvas::new(size_m, texel_m);
        let canvas_ref = &mut canvas;
        match *self {
            Material::Plain(colour) => {
                base(canvas_ref, rng, colour, Mottle { coarsest_m: 0.6, amplitude: 4.0, gain: 0.6, patches: 0.0 });
            }
            Material::Plaster(colour) => plaster(canvas_ref, rng, colour),
            Material::Concrete(colour) => concrete(canvas_ref, rng, colour),
            Material::StrandBoard => strand_board(canvas_ref, rng),
            Material::Wood(colour) => wood(canvas_ref, rng, colour),
            Material::Terrazzo(colour) => terrazzo(canvas_ref, rng, colour),
            Material::Cardboard => cardboard(canvas_ref, rng),
            Material::Lacquer(colour) => lacquer(canvas_ref, rng, colour),
            Material::Steel => steel(canvas_ref, rng),
            Material::Poster => {
                print::poster(canvas_ref, rng);
                worn(canvas_ref, rng, 10.0, 3.0);
            }
            Material::NoticeBoard => notice_board(canvas_ref, rng),
            Material::Spine => spine(canvas_ref, rng),
            Material::Panel => panel(canvas_ref, rng),
        }
        canvas
    }
}

fn plaster(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour) {
    base(canvas, rng, colour, Mottle { coarsest_m: 0.7, amplitude: 14.0, gain: 0.9, patches: 44.0 });
    specks(canvas, rng, 1100.0, (0.0022, 0.009), 0.6);
    scratches(canvas, rng, 40.0, 0.45);
    cracks(canvas, rng, 1.6);
}

fn concrete(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour) {
    base(canvas, rng, colour, Mottle { coarsest_m: 0.9, amplitude: 16.0, gain: 0.92, patches: 44.0 });
    specks(canvas, rng, 1700.0, (0.0024, 0.011), 0.62);
    scratches(canvas, rng, 60.0, 0.5);
    cracks(canvas, rng, 1.2);
    // Marking tape, much walked upon, and drops of paint.
    let (width, height) = canvas.size_m();
    if width > 2.0 && height > 2.0 {
        let inset = 0.16 * width.min(height);
        let frame = [
            ((inset, inset), (width - inset, inset)),
            ((inset, height - inset), (width - inset, height - inset)),
            ((inset, inset), (inset, height - inset)),
            ((width - inset, inset), (width - inset, height - inset)),
        ];
        for (from, to) in frame {
            canvas.line(from, to, 0.035, [216.0, 172.0, 36.0], 0.85);
        }
        for _ in 0..2600 {
            let (from, to) = rng.pick(&frame);
            let fraction = rng.range_f32(0.0, 1.0);
            let at = (
                from.0 + fraction * (to.0 - from.0) + rng.range_f32(-0.04, 0.04),
                from.1 + fraction * (to.1 - from.1) + rng.range_f32(-0.04, 0.04),
            );
            let radius = power_size(rng, 0.002, 0.02);
            canvas.ellipse(at, (radius, radius * rng.range_f32(0.3, 0.9)), rng.range_f32(0.0, PI), colour, 0.8);
        }
    }
    for _ in 0..count(canvas, 5.0, rng) {
        let (at, tone) = (anywhere(canvas, rng), print::ink(rng));
        for _ in 0..3 + rng.below(9) {
            let radius = power_size(rng, 0.002, 0.02);
            let drop = (at.0 + 0.05 * rng.normal() as f32, at.1 + 0.05 * rng.normal() as f32);
            canvas.ellipse(drop, (radius, radius * rng.range_f32(0.7, 1.0)), rng.range_f32(0.0, PI), tone, 0.85);
        }
    }
}

fn strand_board(canvas: &mut Canvas, rng: &mut SceneRng) {
    let ground = [176.0, 136.0, 88.0];
    base(canvas, rng, ground, Mottle { coarsest_m: 0.5, amplitude: 10.0, gain: 0.7, patches: 0.0 });
    for _ in 0..count(canvas, 3600.0, rng) {
        let at = anywhere(canvas, rng);
        let half = (rng.range_f32(0.008, 0.042), rng.range_f32(0.002, 0.009));
        let tone = rng.range_f32(-70.0, 52.0);
        let warm = rng.range_f32(-8.0, 8.0);
        let colour = [ground[0] + tone + warm, ground[1] + 0.95 * tone, ground[2] + 0.8 * tone - warm];
        let angle = 0.55 * rng.normal() as f32 + if rng.chance(0.2) { 1.4 } else { 0.0 };
        canvas.rectangle(at, half, angle, colour, rng.range_f32(0.55, 0.95));
    }
    let bounds = Patch::whole(canvas).bounds();
    canvas.mottle(bounds, rng.bits(), 0.03, 7.0, 0.8);
}

fn wood(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour) {
    let (grain_seed, fine_seed, wave_seed, tone_seed) = (rng.bits(), rng.bits(), rng.bits(), rng.bits());
    let (width, _) = canvas.size_m();
    let board = rng.range_f32(0.09, 0.16);
    let texels = canvas.width;
    canvas.fill_rows(|place, row| {
        let index = (place.y_m / board).floor();
        let within = place.y_m - index * board;
        // Each board is cut from another place of the trunk.
        let shift = 37.0 * index;
        let moved = super::lattice::RowPlace { x0_m: place.x0_m + shift, ..place };
        let octave = |seed, cell_m, amplitude| Octave { seed, cell_m, amplitude };
        let grain = Canvas::octave_row(
            moved,
            texels,
            &[
                octave(grain_seed, (0.5, 0.022), 18.0),
                octave(fine_seed, (0.16, 0.0085), 20.0),
                octave(fine_seed ^ 77, (0.05, 0.0045), 22.0),
                octave(fine_seed ^ 991, (0.014, 0.003), 18.0),
            ],
        );
        let wave = Canvas::octave_row(moved, texels, &[octave(wave_seed, (0.35, 0.06), 1.0)]);
        let tone = 34.0 * (super::lattice::unit(tone_seed, index as i32, 0) - 0.5);
        let gap = if within < 0.0015 || board - within < 0.0015 { -48.0 } else { 0.0 };
        for (column, colour_out) in row.iter_mut().enumerate() {
            let rings = 9.0 * (wave[column] * 26.0 + within * 130.0).sin();
            let value = tone + gap + grain[column] + rings;
            *colour_out =
                [(colour[0] + value).max(0.0), (colour[1] + 0.9 * value).max(0.0), (colour[2] + 0.7 * value).max(0.0)];
        }
    });
    let knots = count(canvas, 9.0, rng);
    for _ in 0..knots {
        let (at, radius) = (anywhere(canvas, rng), rng.range_f32(0.006, 0.02));
        for ring in (1..=4).rev() {
            let reach = radius * ring as f32 / 4.0;
            let shade = if ring % 2 == 0 { 0.45 } else { 0.66 };
            canvas.ellipse(at, (1.35 * reach, reach), 0.1, colour.map(|value| value * shade), 0.75);
        }
    }
    specks(canvas, rng, 700.0, (0.0018, 0.007), 0.6);
    scratches(canvas, rng, 50.0 * width.clamp(0.3, 1.0), 0.5);
}

fn terrazzo(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour) {
    base(canvas, rng, colour, Mottle { coarsest_m: 0.4, amplitude: 9.0, gain: 0.75, patches: 0.0 });
    for _ in 0..count(canvas, 5200.0, rng) {
        let (at, radius) = (anywhere(canvas, rng), power_size(rng, 0.0018, 0.016));
        let tone = rng.pick(&[
            [70.0, 66.0, 62.0],
            [206.0, 200.0, 188.0],
            [150.0, 110.0, 84.0],
            [116.0, 120.0, 118.0],
            [180.0, 160.0, 130.0],
        ]);
        let turn = rng.range_f32(0.0, TAU);
        let corner = |angle: f32, scale: f32| {
            (at.0 + scale * radius * (turn + angle).cos(), at.1 + scale * radius * (turn + angle).sin())
        };
        let scales = [rng.range_f32(0.6, 1.2), rng.range_f32(0.6, 1.2), rng.range_f32(0.6, 1.2)];
        let [a, b, c] = [corner(0.0, scales[0]), corner(2.0, scales[1]), corner(4.1, scales[2])];
        canvas.triangle([a, b, c], tone, 0.85);
        canvas.ellipse(at, (0.6 * radius, 0.5 * radius), turn, tone, 0.85);
    }
    scratches(canvas, rng, 30.0, 0.35);
}

fn cardboard(canvas: &mut Canvas, rng: &mut SceneRng) {
    let shade = rng.range_f32(0.8, 1.06);
    let ground = [188.0 * shade, 148.0 * shade, 104.0 * shade];
    base(canvas, rng, ground, Mottle { coarsest_m: 0.25, amplitude: 9.0, gain: 0.88, patches: 22.0 });
    specks(canvas, rng, 1300.0, (0.0016, 0.005), 0.5);
    let whole = Patch::whole(canvas);
    let size = whole.width.min(whole.height);
    let print_colour = rng.pick(&[print::INK, [120.0, 40.0, 34.0], [34.0, 66.0, 120.0], [74.0, 56.0, 40.0]]);
    if rng.chance(0.55) {
        let y = whole.height * rng.range_f32(0.4, 0.6);
        canvas.rectangle((0.5 * whole.width, y), (0.5 * whole.width, 0.024), 0.0, [204.0, 176.0, 130.0], 0.55);
    }
    let inner = whole.inset(0.07 * size);
    let (upper, lower) = inner.split_rows(rng.range_f32(0.35, 0.6));
    let letters = (0.18 * upper.height).clamp(0.008, 0.05);
    match rng.below(4) {
        0 => print::text_line(canvas, rng, (upper.x, upper.y), upper.width, 1.7 * letters, print_colour),
        1 => print::paragraph(canvas, rng, upper, letters, print_colour),
        2 => print::drawing(canvas, rng, upper),
        _ => print::shapes(canvas, rng, Patch { width: upper.width * 0.6, ..upper }),
    }
    for _ in 0..1 + rng.below(2) {
        let width = (0.55 * lower.width).min(0.16) * rng.range_f32(0.7, 1.0);
        let height = (0.8 * lower.height).min(0.7 * width);
        let at = (
            lower.x + rng.range_f32(0.0, (lower.width - width).max(0.001)),
            lower.y + rng.range_f32(0.0, (lower.height - height).max(0.001)),
        );
        print::label(canvas, rng, Patch { x: at.0, y: at.1, width, height });
    }
    worn(canvas, rng, 5.0, 25.0);
}

fn lacquer(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour) {
    base(canvas, rng, colour, Mottle { coarsest_m: 0.5, amplitude: 7.0, gain: 0.8, patches: 7.0 });
    let whole = Patch::whole(canvas);
    let area = whole.width * whole.height;
    for _ in 0..((area * 5.0).ceil() as usize).min(7) {
        let width = (0.5 * whole.width).min(0.2) * rng.range_f32(0.4, 1.0);
        let height = (0.5 * whole.height).min(0.14) * rng.range_f32(0.4, 1.0);
        let inner = Patch { width: whole.width - width, height: whole.height - height, ..whole };
        let patch = Patch {
            x: rng.range_f32(0.0, inner.width.max(0.001)),
            y: rng.range_f32(0.0, inner.height.max(0.001)),
            width,
            height,
        };
        match rng.below(4) {
            0 => print::warning_sign(canvas, rng, patch.centre(), 0.5 * width.min(height)),
            // Ventilation slots.
            1 => {
                for slot in 0..5 + rng.below(4) {
                    let y = patch.y + height * (slot as f32 + 0.5) / 8.0;
                    let half = 0.5 * width * rng.range_f32(0.75, 1.0);
                    let (from, to) = ((patch.centre().0 - half, y), (patch.centre().0 + half, y));
                    canvas.line(from, to, 0.025 * height, [34.0, 34.0, 36.0], 0.9);
                }
            }
            _ => print::label(canvas, rng, patch),
        }
    }
    // Chips show the primer, scratches the metal.
    specks(canvas, rng, 900.0, (0.0015, 0.007), 0.8);
    scratches(canvas, rng, 45.0, 0.6);
}

fn steel(canvas: &mut Canvas, rng: &mut SceneRng) {
    let (seed, second, broad) = (rng.bits(), rng.bits(), rng.bits());
    let count = canvas.width;
    let mut row_noise = vec![0.0; count];
    canvas.fill_rows(|place, row| {
        row_noise.fill(0.0);
        for (seed, cell_m, amplitude) in
            [(seed, (0.2, 0.004), 15.0), (second, (0.06, 0.009), 15.0), (broad, (0.3, 0.2), 18.0)]
        {
            add_octave(&mut row_noise, place, Octave { seed, cell_m, amplitude });
        }
        for (colour, noise) in row.iter_mut().zip(&row_noise) {
            *colour = [148.0 + noise, 151.0 + noise, 155.0 + noise];
        }
    });
    specks(canvas, rng, 1600.0, (0.0016, 0.009), 0.62);
    scratches(canvas, rng, 120.0, 0.7);
}

fn notice_board(canvas: &mut Canvas, rng: &mut SceneRng) {
    base(canvas, rng, [164.0, 122.0, 80.0], Mottle { coarsest_m: 0.05, amplitude: 14.0, gain: 0.85, patches: 24.0 });
    specks(canvas, rng, 5000.0, (0.0012, 0.005), 0.6);
    let whole = Patch::whole(canvas);
    for _ in 0..count(canvas, 13.0, rng).max(3) {
        let (width, height) = (rng.range_f32(0.07, 0.24), rng.range_f32(0.07, 0.2));
        let patch = Patch {
            x: rng.range_f32(0.0, (whole.width - width).max(0.001)),
            y: rng.range_f32(0.0, (whole.height - height).max(0.001)),
            width: width.min(whole.width),
            height: height.min(whole.height),
        };
        let paper =
            rng.pick(&[[236.0, 234.0, 226.0], [240.0, 228.0, 140.0], [206.0, 226.0, 236.0], [238.0, 200.0, 196.0]]);
        let shadow = Patch { x: patch.x + 0.003, y: patch.y + 0.004, ..patch };
        shadow.fill(canvas, [50.0, 38.0, 28.0], 0.5);
        patch.fill(canvas, paper, 1.0);
        let inner = patch.inset(0.012);
        match rng.below(5) {
            0 => print::print_image(canvas, rng, inner),
            1 => print::chart(canvas, rng, inner),
            2 => print::drawing(canvas, rng, inner),
            _ => {
                let height = rng.range_f32(0.006, 0.016);
                let pen = rng.pick(&[print::INK, [30.0, 50.0, 140.0], [150.0, 30.0, 30.0]]);
                print::paragraph(canvas, rng, inner, height, pen);
            }
        }
        let pin = (patch.centre().0 + rng.range_f32(-0.02, 0.02), patch.y + 0.008);
        canvas.ellipse(pin, (0.005, 0.005), 0.0, print::ink(rng), 1.0);
    }
}

fn spine(canvas: &mut Canvas, rng: &mut SceneRng) {
    let colour = print::ink(rng);
    base(canvas, rng, colour, Mottle { coarsest_m: 0.1, amplitude: 7.0, gain: 0.75, patches: 0.0 });
    let whole = Patch::whole(canvas);
    if rng.chance(0.7) {
        let height = whole.height * rng.range_f32(0.25, 0.45);
        let patch = Patch {
            x: 0.12 * whole.width,
            y: whole.height * rng.range_f32(0.08, 0.3),
            width: 0.76 * whole.width,
            height,
        };
        patch.fill(canvas, [230.0, 228.0, 220.0], 1.0);
        let letters = (0.35 * patch.width).clamp(0.005, 0.016);
        print::paragraph(canvas, rng, patch.inset(0.1 * patch.width), letters, print::INK);
    }
    for _ in 0..rng.below(3) {
        let y = whole.height * rng.range_f32(0.05, 0.95);
        let band = print::ink(rng);
        canvas.line((0.0, y), (whole.width, y), whole.height * rng.range_f32(0.006, 0.03), band, 0.9);
    }
    if rng.chance(0.6) {
        let at = (whole.centre().0, whole.height * rng.range_f32(0.78, 0.9));
        canvas.ring(at, 0.3 * whole.width, 0.05 * whole.width, [40.0, 40.0, 42.0], 1.0);
    }
    specks(canvas, rng, 700.0, (0.001, 0.005), 0.5);
    scratches(canvas, rng, 60.0, 0.6);
}

fn panel(canvas: &mut Canvas, rng: &mut SceneRng) {
    let ground = rng.pick(&[[74.0, 80.0, 84.0], [176.0, 178.0, 172.0], [44.0, 92.0, 70.0], [60.0, 64.0, 92.0]]);
    base(canvas, rng, ground, Mottle { coarsest_m: 0.2, amplitude: 6.0, gain: 0.75, patches: 0.0 });
    let whole = Patch::whole(canvas).inset(0.02);
    let pitch = rng.range_f32(0.035, 0.055);
    let mut y = whole.y;
    while y + pitch <= whole.y + whole.height {
        let mut x = whole.x;
        while x + pitch <= whole.x + whole.width {
            let span = 1.0 + rng.below(3) as f32;
            let cell = Patch { x, y, width: (span * pitch).min(whole.x + whole.width - x), height: pitch };
            let inner = cell.inset(pitch * rng.range_f32(0.08, 0.2));
            let (colour, radius) = (print::ink(rng), 0.3 * pitch * rng.range_f32(0.5, 1.0));
            match rng.below(7) {
                0 => {
                    canvas.ellipse(inner.centre(), (1.25 * radius, 1.25 * radius), 0.0, [30.0, 30.0, 30.0], 1.0);
                    canvas.ellipse(inner.centre(), (radius, radius), 0.0, colour, 1.0);
                }
                1 => {
                    inner.fill(canvas, [24.0, 28.0, 30.0], 1.0);
                    let height = 0.5 * inner.height;
                    let at = (inner.x + 0.1 * height, inner.y + 0.25 * inner.height);
                    print::text_line(canvas, rng, at, inner.width, height, [120.0, 220.0, 140.0]);
                }
                2 => inner.fill(canvas, colour, 1.0),
                3 => print::label(canvas, rng, inner),
                4 => {
                    canvas.ring(inner.centre(), radius, 0.2 * radius, [210.0, 210.0, 206.0], 1.0);
                    let angle = rng.range_f32(0.0, TAU);
                    let centre = inner.centre();
                    let tip = (centre.0 + radius * angle.cos(), centre.1 + radius * angle.sin());
                    canvas.line(centre, tip, 0.12 * radius, [230.0, 230.0, 226.0], 1.0);
                }
                5 => print::text_line(
                    canvas,
                    rng,
                    (inner.x, inner.y),
                    inner.width,
                    0.35 * inner.height,
                    [224.0, 224.0, 218.0],
                ),
                _ => {}
            }
            x += span * pitch;
        }
        y += pitch;
    }
    scratches(canvas, rng, 60.0, 0.6);
    specks(canvas, rng, 200.0, (0.001, 0.006), 0.5);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn materials_are_deterministic_and_have_structure_except_the_plain_ones() {
        for material in [
            Material::Plain([200.0; 3]),
            Material::Plaster([190.0; 3]),
            Material::Concrete([130.0; 3]),
            Material::StrandBoard,
            Material::Wood([150.0, 110.0, 70.0]),
            Material::Terrazzo([170.0; 3]),
            Material::Cardboard,
            Material::Lacquer([60.0, 90.0, 130.0]),
            Material::Steel,
            Material::Poster,
            Material::NoticeBoard,
            Material::Spine,
            Material::Panel,
        ] {
            let paint = |seed| material.paint((0.3, 0.2), 0.001, &mut SceneRng::new(seed, 0));
            let (first, again, other) = (paint(5), paint(5), paint(6));
            assert_eq!(first.texels, again.texels);
            assert_ne!(first.texels, other.texels, "{material:?}");
            let values = || first.texels.iter().map(|texel| f64::from(texel[1]));
            let mean = values().sum::<f64>() / first.texels.len() as f64;
            let spread = (values().map(|v| (v - mean).powi(2)).sum::<f64>() / first.texels.len() as f64).sqrt();
            assert_eq!(spread < 4.0, material.is_plain(), "{material:?}: standard deviation {spread}");
        }
    }
}
