//! Ground and weathering that all materials have: noise of many scales, patches, specks, scratches, cracks.

use super::canvas::{Canvas, Colour};
use super::lattice::add_octaves;
use super::print::Patch;
use crate::scene_rng::SceneRng;
use std::f32::consts::{PI, TAU};

#[derive(Debug, Clone, Copy)]
pub(crate) struct Mottle {
    pub coarsest_m: f32,
    pub amplitude: f32,
    pub gain: f32,
    /// How strongly patches of another tone differ, grey levels.
    pub patches: f32,
}

/// Ground colour with noise of many scales in brightness, of coarse scales in hue, and sharp-edged patches.
pub(crate) fn base(canvas: &mut Canvas, rng: &mut SceneRng, colour: Colour, mottle: Mottle) {
    let (seed, hue_seed, patch_seed) = (rng.bits(), rng.bits(), rng.bits());
    let count = canvas.width;
    let (mut light, mut hue, mut patch) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
    canvas.fill_rows(|place, row| {
        light.fill(0.0);
        hue.fill(0.0);
        add_octaves(&mut light, place, seed, mottle.coarsest_m, 0.002, mottle.amplitude, mottle.gain);
        add_octaves(&mut hue, place, hue_seed, mottle.coarsest_m, 0.05, 0.5 * mottle.amplitude, 0.7);
        if mottle.patches != 0.0 {
            patch.fill(0.0);
            add_octaves(&mut patch, place, patch_seed, 0.5 * mottle.coarsest_m, 0.003, 1.0, 0.8);
        }
        for index in 0..count {
            // The border of a patch is a few per cent of the noise's range wide: sharp, not jagged.
            let dark = ((patch[index] - 0.42) * 14.0).clamp(0.0, 1.0);
            let pale = ((-0.5 - patch[index]) * 14.0).clamp(0.0, 1.0);
            let patched = mottle.patches * (dark - 0.7 * pale);
            let value = light[index] - patched;
            row[index] = [
                (colour[0] + value + hue[index]).max(0.0),
                (colour[1] + value).max(0.0),
                (colour[2] + value - hue[index]).max(0.0),
            ];
        }
    });
}

/// How many of something a surface of this area has; at least none, jittered.
pub(crate) fn count(canvas: &Canvas, per_square_metre: f32, rng: &mut SceneRng) -> usize {
    let (width, height) = canvas.size_m();
    let expected = per_square_metre * width * height;
    (expected.floor() as usize) + usize::from(rng.chance(f64::from(expected.fract())))
}

pub(crate) fn anywhere(canvas: &Canvas, rng: &mut SceneRng) -> (f32, f32) {
    let (width, height) = canvas.size_m();
    (rng.range_f32(0.0, width), rng.range_f32(0.0, height))
}

/// A size with many small and few large ones: density falls with the square of the size.
pub(crate) fn power_size(rng: &mut SceneRng, smallest: f32, largest: f32) -> f32 {
    let u = rng.range_f32(0.0, 1.0);
    1.0 / (u / largest + (1.0 - u) / smallest)
}

/// Specks of dirt, chips, drops: ellipses of all sizes, lighter or darker by `contrast`.
pub(crate) fn specks(
    canvas: &mut Canvas,
    rng: &mut SceneRng,
    per_square_metre: f32,
    sizes_m: (f32, f32),
    contrast: f32,
) {
    for _ in 0..count(canvas, per_square_metre, rng) {
        let (at, radius) = (anywhere(canvas, rng), power_size(rng, sizes_m.0, sizes_m.1));
        let strength = contrast * rng.range_f32(0.4, 1.0);
        let colour = if rng.chance(0.65) { [30.0, 27.0, 24.0] } else { [226.0, 222.0, 214.0] };
        let radii = (radius, radius * rng.range_f32(0.45, 1.0));
        canvas.ellipse(at, radii, rng.range_f32(0.0, PI), colour, strength);
    }
}

/// Scratches: thin, mostly straight, in bundles.
pub(crate) fn scratches(canvas: &mut Canvas, rng: &mut SceneRng, per_square_metre: f32, opacity: f32) {
    for _ in 0..count(canvas, per_square_metre, rng) {
        let (mut at, mut direction) = (anywhere(canvas, rng), rng.range_f32(0.0, TAU));
        let light = rng.chance(0.5);
        let colour = if light { [222.0, 220.0, 214.0] } else { [42.0, 38.0, 36.0] };
        let (width, step) = (rng.range_f32(0.0004, 0.0016), rng.range_f32(0.008, 0.035));
        for _ in 0..1 + rng.below(4) {
            direction += 0.25 * rng.normal() as f32;
            let next = (at.0 + step * direction.cos(), at.1 + step * direction.sin());
            canvas.line(at, next, width, colour, opacity * rng.range_f32(0.5, 1.0));
            at = next;
        }
    }
}

/// Cracks: long dark walks that branch.
pub(crate) fn cracks(canvas: &mut Canvas, rng: &mut SceneRng, per_square_metre: f32) {
    for _ in 0..count(canvas, per_square_metre, rng) {
        let mut tips = vec![(anywhere(canvas, rng), rng.range_f32(0.0, TAU), 14 + rng.below(26))];
        while let Some((mut at, mut direction, steps)) = tips.pop() {
            for step in 0..steps {
                direction += 0.45 * rng.normal() as f32;
                let length = rng.range_f32(0.008, 0.03);
                let next = (at.0 + length * direction.cos(), at.1 + length * direction.sin());
                canvas.line(at, next, rng.range_f32(0.0006, 0.0018), [46.0, 42.0, 40.0], 0.75);
                at = next;
                if tips.len() < 6 && steps - step > 6 && rng.chance(0.06) {
                    tips.push((at, direction + rng.range_f32(-1.2, 1.2), (steps - step) / 2));
                }
            }
        }
    }
}

/// What use leaves on everything: soft shading, specks, scratches.
pub(crate) fn worn(canvas: &mut Canvas, rng: &mut SceneRng, amplitude: f32, scratches_per_square_metre: f32) {
    let bounds = Patch::whole(canvas).bounds();
    canvas.mottle(bounds, rng.bits(), 0.3, amplitude, 0.72);
    scratches(canvas, rng, scratches_per_square_metre, 0.5);
}
