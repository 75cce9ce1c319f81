//! What people print, stick and write on things: photographs, charts, drawings, labels, lines of text.
//!
//! Letters are random strokes on a small grid: they look like writing, and no two words are the same.

use super::canvas::{Canvas, Colour};
use super::lattice::add_octaves;
use crate::scene_rng::SceneRng;
use std::f32::consts::{FRAC_PI_2, FRAC_PI_6};

/// A rectangle on a canvas, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patch {
    pub x: f32,
    pub y: f32,
    pub width: f32,
    pub height: f32,
}

impl Patch {
    pub fn whole(canvas: &Canvas) -> Self {
        let (width, height) = canvas.size_m();
        Patch { x: 0.0, y: 0.0, width, height }
    }

    pub fn inset(self, margin: f32) -> Self {
        let margin = margin.min(0.45 * self.width).min(0.45 * self.height);
        Patch {
            x: self.x + margin,
            y: self.y + margin,
            width: self.width - 2.0 * margin,
            height: self.height - 2.0 * margin,
        }
    }

    /// Splits at a fraction of the height.
    pub fn split_rows(self, fraction: f32) -> (Self, Self) {
        let upper = self.height * fraction;
        (Patch { height: upper, ..self }, Patch { y: self.y + upper, height: self.height - upper, ..self })
    }

    pub fn split_columns(self, fraction: f32) -> (Self, Self) {
        let left = self.width * fraction;
        (Patch { width: left, ..self }, Patch { x: self.x + left, width: self.width - left, ..self })
    }

    pub fn bounds(self) -> [f32; 4] {
        [self.x, self.y, self.x + self.width, self.y + self.height]
    }

    pub fn centre(self) -> (f32, f32) {
        (self.x + 0.5 * self.width, self.y + 0.5 * self.height)
    }

    pub fn fill(self, canvas: &mut Canvas, colour: Colour, opacity: f32) {
        canvas.rectangle(self.centre(), (0.5 * self.width, 0.5 * self.height), 0.0, colour, opacity);
    }

    fn point(self, rng: &mut SceneRng) -> (f32, f32) {
        (self.x + rng.range_f32(0.0, self.width), self.y + rng.range_f32(0.0, self.height))
    }
}

pub(crate) const INK: Colour = [28.0, 28.0, 32.0];

/// A colour of printed matter: mostly strong, sometimes pale.
pub(crate) fn ink(rng: &mut SceneRng) -> Colour {
    rng.pick(&[
        [196.0, 46.0, 40.0],
        [34.0, 84.0, 160.0],
        [30.0, 120.0, 72.0],
        [222.0, 166.0, 40.0],
        [52.0, 52.0, 60.0],
        [120.0, 60.0, 130.0],
        [226.0, 110.0, 40.0],
        [60.0, 150.0, 170.0],
        [150.0, 98.0, 62.0],
        [190.0, 190.0, 182.0],
    ])
}

/// One line of writing, letters `height` high, from (x, y) top left for about `length` metres.
pub(crate) fn text_line(
    canvas: &mut Canvas,
    rng: &mut SceneRng,
    at: (f32, f32),
    length: f32,
    height: f32,
    colour: Colour,
) {
    let (letter, gap) = (0.58 * height, 0.20 * height);
    let mut x = at.0;
    let mut left_in_word = 1 + rng.below(9);
    while x + letter <= at.0 + length {
        if left_in_word == 0 {
            left_in_word = 1 + rng.below(9);
            x += letter;
            continue;
        }
        left_in_word -= 1;
        let tall = rng.chance(0.45);
        let top = if tall { 0.0 } else { 0.3 * height };
        let node = |column: usize, row: usize| {
            (x + letter * column as f32 / 2.0, at.1 + top + (height - top) * row as f32 / 3.0)
        };
        let width = height * 0.07;
        for _ in 0..2 + rng.below(3) {
            let from = (rng.below(3), rng.below(4));
            let horizontal = rng.chance(0.4);
            let to = if horizontal { (2 - from.0, from.1) } else { (rng.below(3), 3 - from.1) };
            let (a, b) = (node(from.0, from.1), node(to.0, to.1));
            canvas.line(a, b, width, colour, 0.92);
        }
        if rng.chance(0.25) {
            let (cx, cy) = node(1, 2);
            canvas.ring((cx, cy), 0.26 * height, width, colour, 0.92);
        }
        x += letter + gap;
    }
}

/// Lines of writing that fill a patch, ragged on the right.
pub(crate) fn paragraph(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch, height: f32, colour: Colour) {
    let mut y = patch.y;
    while y + height <= patch.y + patch.height {
        if !rng.chance(0.08) {
            let length = patch.width * rng.range_f32(0.6, 1.0);
            text_line(canvas, rng, (patch.x, y), length, height, colour);
        }
        y += 1.65 * height;
    }
}

/// Something like a photograph or a map: noise of many scales, cut into a few tones.
pub(crate) fn print_image(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let tones: Vec<Colour> = (0..6)
        .map(|step| {
            let (colour, shade) = (ink(rng), 0.45 + 0.14 * step as f32);
            colour.map(|value| (value * shade + 18.0 * step as f32).min(240.0))
        })
        .collect();
    let coarsest = patch.width.max(patch.height) * rng.range_f32(0.25, 0.6);
    let (seed, soft) = (rng.bits(), rng.range_f32(0.02, 0.3));
    let (sky, gain) = (rng.range_f32(-1.0, 1.0), rng.range_f32(0.52, 0.74));
    let texel = canvas.texel_m;
    let columns = ((patch.x / texel) as usize, (((patch.x + patch.width) / texel) as usize).min(canvas.width));
    let rows = ((patch.y / texel) as usize, (((patch.y + patch.height) / texel) as usize).min(canvas.height));
    if columns.0 >= columns.1 {
        return;
    }
    let mut noise = vec![0.0f32; columns.1 - columns.0];
    for row in rows.0..rows.1 {
        noise.fill(0.0);
        let y_m = (row as f32 + 0.5) * texel;
        let place = super::lattice::RowPlace { x0_m: (columns.0 as f32 + 0.5) * texel, y_m, texel_m: texel };
        add_octaves(&mut noise, place, seed, coarsest, 0.0025, 1.7, gain);
        let slope = sky * 2.0 * ((y_m - patch.y) / patch.height - 0.5);
        for (texel, value) in canvas.texels[row * canvas.width + columns.0..].iter_mut().zip(&noise) {
            let level = ((value + slope) * 1.5 + 2.5).clamp(0.0, 4.999);
            let (low, fraction) = (level as usize, level.fract());
            // Sharp borders between tones with some soft shading.
            let blend = soft * fraction + (1.0 - soft) * ((fraction - 0.9) * 10.0).max(0.0);
            let (a, b) = (tones[low], tones[low + 1]);
            for channel in 0..3 {
                texel[channel] = (a[channel] + blend * (b[channel] - a[channel])) as u8;
            }
        }
    }
}

/// Overlapping shapes, as on a poster.
pub(crate) fn shapes(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let background = ink(rng).map(|value| 0.35 * value + 150.0);
    patch.fill(canvas, background, 1.0);
    let size = patch.width.min(patch.height);
    for _ in 0..14 + rng.below(22) {
        let scale = size * rng.range_f32(0.02, 0.16);
        let inner = patch.inset(scale * 1.1);
        let (at, colour, angle) = (inner.point(rng), ink(rng), rng.range_f32(0.0, 3.0));
        match rng.below(4) {
            0 => canvas.ellipse(at, (scale, scale * rng.range_f32(0.5, 1.0)), angle, colour, 0.9),
            1 => canvas.rectangle(at, (0.7 * scale, 0.7 * scale * rng.range_f32(0.3, 1.0)), angle, colour, 0.9),
            2 => {
                let corner = |turn: f32| (at.0 + scale * (angle + turn).cos(), at.1 + scale * (angle + turn).sin());
                canvas.triangle([corner(0.0), corner(rng.range_f32(1.5, 2.5)), corner(4.0)], colour, 0.9);
            }
            _ => canvas.ring(at, 0.8 * scale, scale * rng.range_f32(0.08, 0.25), colour, 0.9),
        }
    }
}

/// Axes with a few curves.
pub(crate) fn chart(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let inner = patch.inset(0.08 * patch.width.min(patch.height));
    let thin = 0.004 * patch.width.max(0.1);
    let [left, top, right, bottom] = inner.bounds();
    canvas.line((left, top), (left, bottom), thin, INK, 1.0);
    canvas.line((left, bottom), (right, bottom), thin, INK, 1.0);
    for _ in 0..2 + rng.below(3) {
        let (colour, count) = (ink(rng), 9 + rng.below(14));
        let mut level = rng.range_f32(0.2, 0.8);
        let mut last = None;
        for step in 0..count {
            level = (level + 0.16 * rng.normal() as f32).clamp(0.04, 0.96);
            let point = (left + inner.width * (step as f32 + 0.3) / count as f32, bottom - inner.height * level);
            if let Some(from) = last {
                canvas.line(from, point, 1.3 * thin, colour, 1.0);
            }
            if rng.chance(0.7) {
                canvas.ellipse(point, (2.4 * thin, 2.4 * thin), 0.0, colour, 1.0);
            }
            last = Some(point);
        }
    }
}

/// A technical drawing: outlines, circles, centre lines, dimensions.
pub(crate) fn drawing(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let (line, colour) = (0.003 * patch.width.max(0.15), rng.pick(&[INK, [30.0, 60.0, 130.0]]));
    for _ in 0..5 + rng.below(6) {
        let inner = patch.inset(0.1 * patch.width.min(patch.height));
        let (a, b) = (inner.point(rng), inner.point(rng));
        match rng.below(3) {
            0 => {
                for (from, to) in [(a, (b.0, a.1)), ((b.0, a.1), b), (b, (a.0, b.1)), ((a.0, b.1), a)] {
                    canvas.line(from, to, line, colour, 0.9);
                }
            }
            1 => {
                let radius = patch.width.min(patch.height) * rng.range_f32(0.03, 0.1);
                canvas.ring(a, radius, line, colour, 0.9);
                canvas.line((a.0 - 1.4 * radius, a.1), (a.0 + 1.4 * radius, a.1), 0.5 * line, colour, 0.8);
                canvas.line((a.0, a.1 - 1.4 * radius), (a.0, a.1 + 1.4 * radius), 0.5 * line, colour, 0.8);
            }
            _ => {
                canvas.line(a, (b.0, a.1), 0.5 * line, colour, 0.9);
                text_line(canvas, rng, (a.0.min(b.0), a.1), 0.2 * patch.width, 6.0 * line, colour);
            }
        }
    }
}

/// A bar code.
pub(crate) fn bar_code(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let (mut x, unit) = (patch.x, patch.width / 60.0);
    while x < patch.x + patch.width {
        let bar = unit * (1 + rng.below(4)) as f32;
        let strip = Patch { x, width: bar.min(patch.x + patch.width - x), ..patch };
        strip.fill(canvas, INK, 1.0);
        x += bar + unit * (1 + rng.below(4)) as f32;
    }
}

/// A sticker: border, headline, small print, perhaps a bar code or a warning sign.
pub(crate) fn label(canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch) {
    let paper = rng.pick(&[[232.0, 230.0, 222.0], [236.0, 220.0, 120.0], [214.0, 224.0, 232.0], [236.0, 232.0, 210.0]]);
    patch.fill(canvas, [70.0, 70.0, 70.0], 0.8);
    patch.inset(0.02 * patch.width.min(patch.height)).fill(canvas, paper, 1.0);
    let inner = patch.inset(0.08 * patch.width.min(patch.height));
    let (head, body) = inner.split_rows(rng.range_f32(0.2, 0.4));
    let colour = ink(rng);
    if rng.chance(0.5) {
        head.fill(canvas, colour, 1.0);
        text_line(
            canvas,
            rng,
            (head.x + 0.1 * head.height, head.y + 0.2 * head.height),
            head.width,
            0.6 * head.height,
            paper,
        );
    } else {
        text_line(canvas, rng, (head.x, head.y), head.width, 0.8 * head.height, colour);
    }
    let (left, right) = body.split_columns(rng.range_f32(0.4, 0.8));
    let small = (0.1 * body.height).max(0.005);
    paragraph(canvas, rng, Patch { y: left.y + 0.5 * small, width: 0.95 * left.width, ..left }, small, INK);
    let right = Patch { y: right.y + small, height: right.height - small, ..right };
    match rng.below(3) {
        0 => bar_code(canvas, rng, right.split_rows(0.7).0),
        1 => warning_sign(canvas, rng, right.centre(), 0.45 * right.width.min(right.height)),
        _ => print_image(canvas, rng, right),
    }
}

/// A yellow triangle with something alarming in it.
pub(crate) fn warning_sign(canvas: &mut Canvas, rng: &mut SceneRng, centre: (f32, f32), radius: f32) {
    let corners = |scale: f32| {
        [-FRAC_PI_2, FRAC_PI_6, 5.0 * FRAC_PI_6]
            .map(|angle: f32| (centre.0 + scale * radius * angle.cos(), centre.1 + scale * radius * angle.sin()))
    };
    canvas.triangle(corners(1.0), INK, 1.0);
    canvas.triangle(corners(0.82), [240.0, 196.0, 30.0], 1.0);
    for _ in 0..3 + rng.below(3) {
        let mut jitter =
            || (centre.0 + radius * rng.range_f32(-0.25, 0.25), centre.1 + radius * rng.range_f32(-0.3, 0.3));
        let (a, b) = (jitter(), jitter());
        canvas.line(a, b, 0.05 * radius, INK, 1.0);
    }
}

/// A poster on the wall: headline, a main part, captions.
pub(crate) fn poster(canvas: &mut Canvas, rng: &mut SceneRng) {
    let paper = rng.pick(&[[226.0, 224.0, 214.0], [206.0, 214.0, 220.0], [230.0, 214.0, 176.0], [58.0, 66.0, 84.0]]);
    let dark = paper[0] < 100.0;
    canvas.fill_rows(|_, row| row.fill(paper));
    let writing = if dark { [220.0, 220.0, 212.0] } else { INK };
    let whole = Patch::whole(canvas);
    let inner = whole.inset(0.05 * whole.width.min(whole.height));
    let (head, rest) = inner.split_rows(rng.range_f32(0.08, 0.16));
    text_line(canvas, rng, (head.x, head.y), head.width, 0.7 * head.height, writing);
    let (main, foot) = rest.split_rows(rng.range_f32(0.5, 0.8));
    let one = |canvas: &mut Canvas, rng: &mut SceneRng, patch: Patch| match rng.below(6) {
        0 | 1 => print_image(canvas, rng, patch),
        2 | 3 => shapes(canvas, rng, patch),
        4 if !dark => chart(canvas, rng, patch),
        5 if !dark => drawing(canvas, rng, patch),
        _ => print_image(canvas, rng, patch),
    };
    if rng.chance(0.4) {
        let (left, right) = main.split_columns(rng.range_f32(0.35, 0.65));
        one(canvas, rng, left.inset(0.01));
        one(canvas, rng, right.inset(0.01));
    } else {
        one(canvas, rng, main);
    }
    let height = rng.range_f32(0.010, 0.018);
    let foot = Patch { y: foot.y + height, height: (foot.height - height).max(0.0), ..foot };
    let (left, right) = foot.split_columns(rng.range_f32(0.5, 0.7));
    paragraph(canvas, rng, Patch { width: 0.94 * left.width, ..left }, height, writing);
    if rng.chance(0.6) {
        one(canvas, rng, right);
    } else {
        paragraph(canvas, rng, right, 0.8 * height, writing);
    }
}
