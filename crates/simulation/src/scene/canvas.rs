//! A sheet of texels in metres, and the few shapes that all patterns are made of.

use super::lattice::{Octave, RowPlace, add_octave, add_octaves};
use crate::Texture;

/// Red, green, blue, 0 to 255.
pub(crate) type Colour = [f32; 3];

/// The texture of one surface while it is painted. x to the right, y down, metres from the top left corner.
#[derive(Debug)]
pub(crate) struct Canvas {
    pub width: usize,
    pub height: usize,
    pub texel_m: f32,
    pub texels: Vec<[u8; 4]>,
}

/// A texture may not have more texels along one side; coarser texels are taken instead.
const MAX_TEXELS: f32 = 8192.0;

impl Canvas {
    /// A sheet of `size_m` with texels of about `texel_m`.
    pub fn new(size_m: (f32, f32), texel_m: f32) -> Self {
        let texel_m = texel_m.max(size_m.0 / MAX_TEXELS).max(size_m.1 / MAX_TEXELS);
        let count = |length: f32| ((length / texel_m).ceil() as usize).max(2);
        let (width, height) = (count(size_m.0), count(size_m.1));
        Canvas { width, height, texel_m, texels: vec![[0; 4]; width * height] }
    }

    pub fn into_texture(self) -> Texture {
        Texture::new(self.width, self.height, self.texels)
    }

    /// Width and height in metres.
    pub fn size_m(&self) -> (f32, f32) {
        (self.width as f32 * self.texel_m, self.height as f32 * self.texel_m)
    }

    /// Sets every texel, row by row: `paint(place, colours)` fills a row.
    pub fn fill_rows(&mut self, mut paint: impl FnMut(RowPlace, &mut [Colour])) {
        let mut colours = vec![[0.0; 3]; self.width];
        for (row, texels) in self.texels.chunks_exact_mut(self.width).enumerate() {
            let place =
                RowPlace { x0_m: 0.5 * self.texel_m, y_m: (row as f32 + 0.5) * self.texel_m, texel_m: self.texel_m };
            paint(place, &mut colours);
            for (texel, colour) in texels.iter_mut().zip(&colours) {
                *texel = [colour[0] as u8, colour[1] as u8, colour[2] as u8, 0];
            }
        }
    }

    /// Blends a colour in where `distance` (metres, negative inside) says, within the bounds `x0 y0 x1 y1` in metres.
    pub fn stamp(&mut self, bounds: [f32; 4], colour: Colour, opacity: f32, distance: impl Fn(f32, f32) -> f32) {
        let inverse = 1.0 / self.texel_m;
        let first = |low: f32| ((low * inverse - 1.0).floor().max(0.0)) as usize;
        let end = |high: f32, count: usize| ((high * inverse + 1.0).ceil().max(0.0) as usize).min(count);
        let (x0, x1) = (first(bounds[0]), end(bounds[2], self.width));
        let (y0, y1) = (first(bounds[1]), end(bounds[3], self.height));
        for row in y0..y1 {
            let y = (row as f32 + 0.5) * self.texel_m;
            for column in x0..x1 {
                let x = (column as f32 + 0.5) * self.texel_m;
                let cover = (0.5 - distance(x, y) * inverse).clamp(0.0, 1.0) * opacity;
                if cover > 0.0 {
                    let texel = &mut self.texels[row * self.width + column];
                    for channel in 0..3 {
                        let old = f32::from(texel[channel]);
                        texel[channel] = (old + cover * (colour[channel] - old) + 0.5) as u8;
                    }
                }
            }
        }
    }

    /// An ellipse.
    pub fn ellipse(&mut self, centre: (f32, f32), radii: (f32, f32), angle: f32, colour: Colour, opacity: f32) {
        let reach = radii.0.max(radii.1);
        let (sin, cos) = angle.sin_cos();
        let smaller = radii.0.min(radii.1);
        self.stamp(around(centre, reach), colour, opacity, |x, y| {
            let (dx, dy) = (x - centre.0, y - centre.1);
            let (u, v) = ((cos * dx + sin * dy) / radii.0, (cos * dy - sin * dx) / radii.1);
            ((u * u + v * v).sqrt() - 1.0) * smaller
        });
    }

    /// A circle's line.
    pub fn ring(&mut self, centre: (f32, f32), radius: f32, half_width: f32, colour: Colour, opacity: f32) {
        self.stamp(around(centre, radius + half_width), colour, opacity, |x, y| {
            let (dx, dy) = (x - centre.0, y - centre.1);
            ((dx * dx + dy * dy).sqrt() - radius).abs() - half_width
        });
    }

    /// A rectangle about its centre, turned.
    pub fn rectangle(&mut self, centre: (f32, f32), half: (f32, f32), angle: f32, colour: Colour, opacity: f32) {
        let (sin, cos) = angle.sin_cos();
        let reach = (half.0 * cos.abs() + half.1 * sin.abs(), half.0 * sin.abs() + half.1 * cos.abs());
        let bounds = [centre.0 - reach.0, centre.1 - reach.1, centre.0 + reach.0, centre.1 + reach.1];
        self.stamp(bounds, colour, opacity, |x, y| {
            let (dx, dy) = (x - centre.0, y - centre.1);
            ((cos * dx + sin * dy).abs() - half.0).max((cos * dy - sin * dx).abs() - half.1)
        });
    }

    /// A line with round ends.
    pub fn line(&mut self, from: (f32, f32), to: (f32, f32), half_width: f32, colour: Colour, opacity: f32) {
        let (ex, ey) = (to.0 - from.0, to.1 - from.1);
        let inverse_length = 1.0 / (ex * ex + ey * ey).max(1e-12);
        // A line thinner than a texel fades instead of vanishing between texels.
        let (half_width, opacity) =
            (half_width.max(0.5 * self.texel_m), opacity * (half_width / (0.5 * self.texel_m)).min(1.0));
        let bounds = [
            from.0.min(to.0) - half_width,
            from.1.min(to.1) - half_width,
            from.0.max(to.0) + half_width,
            from.1.max(to.1) + half_width,
        ];
        self.stamp(bounds, colour, opacity, |x, y| {
            let (dx, dy) = (x - from.0, y - from.1);
            let along = ((dx * ex + dy * ey) * inverse_length).clamp(0.0, 1.0);
            let (rx, ry) = (dx - along * ex, dy - along * ey);
            (rx * rx + ry * ry).sqrt() - half_width
        });
    }

    /// A triangle.
    pub fn triangle(&mut self, corners: [(f32, f32); 3], colour: Colour, opacity: f32) {
        let [a, b, c] = corners;
        let orientation = ((b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)).signum();
        let side = |from: (f32, f32), to: (f32, f32)| {
            let (ex, ey) = (to.0 - from.0, to.1 - from.1);
            let inverse = orientation / (ex * ex + ey * ey).sqrt().max(1e-9);
            move |x: f32, y: f32| (ey * (x - from.0) - ex * (y - from.1)) * inverse
        };
        let (ab, bc, ca) = (side(a, b), side(b, c), side(c, a));
        let bounds = [a.0.min(b.0).min(c.0), a.1.min(b.1).min(c.1), a.0.max(b.0).max(c.0), a.1.max(b.1).max(c.1)];
        self.stamp(bounds, colour, opacity, |x, y| ab(x, y).max(bc(x, y)).max(ca(x, y)));
    }

    /// Adds noise of many scales to the brightness of a part, `x0 y0 x1 y1` in metres. Amplitude in grey levels.
    pub fn mottle(&mut self, bounds: [f32; 4], seed: u32, coarsest_m: f32, amplitude: f32, gain: f32) {
        let column = |x: f32| ((x / self.texel_m).max(0.0) as usize).min(self.width);
        let row = |y: f32| ((y / self.texel_m).max(0.0) as usize).min(self.height);
        let (x0, x1, y0, y1) = (column(bounds[0]), column(bounds[2]), row(bounds[1]), row(bounds[3]));
        if x0 >= x1 {
            return;
        }
        let mut noise = vec![0.0; x1 - x0];
        for line in y0..y1 {
            noise.fill(0.0);
            let place = RowPlace {
                x0_m: (x0 as f32 + 0.5) * self.texel_m,
                y_m: (line as f32 + 0.5) * self.texel_m,
                texel_m: self.texel_m,
            };
            add_octaves(&mut noise, place, seed, coarsest_m, 0.002, amplitude, gain);
            for (texel, noise) in self.texels[line * self.width + x0..line * self.width + x1].iter_mut().zip(&noise) {
                for value in &mut texel[..3] {
                    *value = (f32::from(*value) + noise + 0.5) as u8;
                }
            }
        }
    }

    /// One octave over the whole sheet, for patterns that need the values themselves.
    pub fn octave_row(place: RowPlace, count: usize, octaves: &[Octave]) -> Vec<f32> {
        let mut row = vec![0.0; count];
        for octave in octaves {
            add_octave(&mut row, place, *octave);
        }
        row
    }

    /// Multiplies by light, a grid of `columns` x `rows` values at the centres of equal cells, bilinear between.
    pub fn shine(&mut self, light: &[f32], columns: usize, rows: usize) {
        let at = |position: f32, count: usize| {
            let place = (position * count as f32 - 0.5).clamp(0.0, count as f32 - 1.0);
            let low = (place as usize).min(count - 1);
            (low, (low + 1).min(count - 1), place - low as f32)
        };
        let across: Vec<_> = (0..self.width).map(|x| at((x as f32 + 0.5) / self.width as f32, columns)).collect();
        for (row, texels) in self.texels.chunks_exact_mut(self.width).enumerate() {
            let (upper, lower, v) = at((row as f32 + 0.5) / self.height as f32, rows);
            let line: Vec<f32> = (0..columns)
                .map(|c| light[upper * columns + c] + v * (light[lower * columns + c] - light[upper * columns + c]))
                .collect();
            for (texel, &(left, right, u)) in texels.iter_mut().zip(&across) {
                let factor = line[left] + u * (line[right] - line[left]);
                for value in &mut texel[..3] {
                    *value = (f32::from(*value) * factor + 0.5) as u8;
                }
            }
        }
    }
}

fn around(centre: (f32, f32), reach: f32) -> [f32; 4] {
    [centre.0 - reach, centre.1 - reach, centre.0 + reach, centre.1 + reach]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(canvas: &Canvas) -> f64 {
        canvas.texels.iter().map(|texel| f64::from(texel[0])).sum::<f64>() / canvas.texels.len() as f64
    }

    #[test]
    fn shapes_cover_their_area() {
        let fresh = || Canvas::new((0.4, 0.3), 0.001);
        let area = f64::from(0.4f32 * 0.3);
        let check = |canvas: Canvas, expected: f64| {
            let covered = mean(&canvas) / 200.0 * area;
            assert!((covered - expected).abs() < 0.02 * expected, "{covered} of {expected}");
        };
        let colour = [200.0; 3];
        let mut canvas = fresh();
        canvas.ellipse((0.2, 0.15), (0.1, 0.04), 0.5, colour, 1.0);
        check(canvas, std::f64::consts::PI * 0.004);
        let mut canvas = fresh();
        canvas.rectangle((0.2, 0.15), (0.1, 0.04), 0.5, colour, 1.0);
        check(canvas, 0.016);
        let mut canvas = fresh();
        canvas.triangle([(0.05, 0.05), (0.3, 0.1), (0.1, 0.25)], colour, 1.0);
        check(canvas, 0.5 * (0.25 * 0.2 - 0.05 * 0.05));
        let mut canvas = fresh();
        canvas.line((0.1, 0.1), (0.3, 0.1), 0.01, colour, 1.0);
        check(canvas, 0.2 * 0.02 + std::f64::consts::PI * 1e-4);
    }

    #[test]
    fn light_dims_texels() {
        let mut canvas = Canvas::new((0.1, 0.1), 0.01);
        canvas.fill_rows(|_, row| row.fill([100.0; 3]));
        canvas.shine(&[1.0, 0.5], 2, 1);
        assert_eq!(canvas.texels[0][0], 100);
        assert_eq!(canvas.texels[9][0], 50);
    }
}
