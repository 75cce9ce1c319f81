//! Gradient noise on an infinite lattice, summed row by row into a texture.
//!
//! Ken Perlin, "Improving noise", SIGGRAPH 2002, with hashed gradients instead of a permutation table: a table of
//! 256 entries repeats, and repeated texture makes false matches. A row of texels crosses every lattice cell on a
//! straight line, so the four corners of a cell melt into two linear functions, and a texel costs one blend.

/// Mixes the bits of a lattice point and a seed (the finaliser of MurmurHash3).
pub(crate) fn hash(seed: u32, x: i32, y: i32) -> u32 {
    let mut h = seed ^ (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77).rotate_left(15);
    h ^= h >> 16;
    h = h.wrapping_mul(0x85EB_CA6B);
    h ^= h >> 13;
    h = h.wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// A hash as a number in `[0, 1)`.
pub(crate) fn unit(seed: u32, x: i32, y: i32) -> f32 {
    (hash(seed, x, y) >> 8) as f32 / (1u32 << 24) as f32
}

/// One octave: a seed, the cell's size along x and y in metres, and what to multiply by.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Octave {
    pub seed: u32,
    pub cell_m: (f32, f32),
    pub amplitude: f32,
}

/// Where a row of texel centres lies, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RowPlace {
    pub x0_m: f32,
    pub y_m: f32,
    pub texel_m: f32,
}

/// Adds one octave of noise in about [-1, 1] times the amplitude. Cells below two texels are left out: a texture
/// cannot carry them.
pub(crate) fn add_octave(row: &mut [f32], place: RowPlace, octave: Octave) {
    let Octave { seed, cell_m: (cell_x, cell_y), amplitude } = octave;
    if cell_x < 2.0 * place.texel_m || cell_y < 1.2 * place.texel_m {
        return;
    }
    let y = place.y_m / cell_y;
    let (row_index, fy) = (y.floor() as i32, y - y.floor());
    let blend_y = fade(fy);
    // 1.6 brings the standard deviation near 0.4, whatever the gradients.
    let scale = 1.6 * amplitude;
    // The two corners at one side of a cell as a linear function of the distance from that side.
    let side = |column: i32| {
        let upper = gradient(seed, column, row_index);
        let lower = gradient(seed, column, row_index + 1);
        let slope = upper.0 + blend_y * (lower.0 - upper.0);
        let (at_upper, at_lower) = (upper.1 * fy, lower.1 * (fy - 1.0));
        (scale * slope, scale * (at_upper + blend_y * (at_lower - at_upper)))
    };
    let step = place.texel_m / cell_x;
    let x0 = place.x0_m / cell_x;
    let mut column = x0.floor() as i32;
    let (mut left, mut right) = (side(column), side(column + 1));
    let mut index = 0;
    while index < row.len() {
        let position = x0 + step * index as f32;
        let here = floor(position);
        if here != column {
            left = if here == column + 1 { right } else { side(here) };
            right = side(here + 1);
            column = here;
        }
        // All texels of this cell at once.
        let count = ((((column + 1) as f32 - position) / step).ceil().max(1.0) as usize).min(row.len() - index);
        let start = position - column as f32;
        // A counter in i32: its conversion to f32 is one vector instruction, that of usize is not.
        for (offset, value) in (0i32..).zip(&mut row[index..index + count]) {
            let fx = start + step * offset as f32;
            let at_left = left.0 * fx + left.1;
            let at_right = right.0 * (fx - 1.0) + right.1;
            *value += at_left + fade(fx) * (at_right - at_left);
        }
        index += count;
    }
}

/// Adds octaves from `coarsest_m` down by halves to `finest_m`; each is `gain` times as strong as the one before.
pub(crate) fn add_octaves(
    row: &mut [f32],
    place: RowPlace,
    seed: u32,
    coarsest_m: f32,
    finest_m: f32,
    amplitude: f32,
    gain: f32,
) {
    let (mut cell, mut strength, mut index) = (coarsest_m, amplitude, 0u32);
    while cell >= finest_m {
        let seed = seed.wrapping_add(index.wrapping_mul(0x6C8E_9CF5));
        add_octave(row, place, Octave { seed, cell_m: (cell, cell), amplitude: strength });
        // Not exactly a half: lattice lines of different octaves must not fall together.
        cell *= 0.53;
        strength *= gain;
        index += 1;
    }
}

/// Rounds down; the library's floor is a call without SSE 4.1.
fn floor(x: f32) -> i32 {
    let truncated = x as i32;
    truncated - i32::from(truncated as f32 > x)
}

fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

fn gradient(seed: u32, x: i32, y: i32) -> (f32, f32) {
    // Components of a hashed point of the square [-1, 1]^2: no trigonometry, no preferred direction worth seeing.
    let h = hash(seed, x, y);
    let component = |bits: u32| bits as f32 * (2.0 / 65535.0) - 1.0;
    (component(h & 0xFFFF), component(h >> 16))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise_at(x_m: f32, y_m: f32) -> f32 {
        let mut value = [0.0];
        let octave = Octave { seed: 7, cell_m: (0.1, 0.1), amplitude: 1.0 };
        add_octave(&mut value, RowPlace { x0_m: x_m, y_m, texel_m: 0.001 }, octave);
        value[0]
    }

    #[test]
    fn a_row_equals_its_texels_one_by_one_and_noise_vanishes_on_the_lattice() {
        let mut row = vec![0.0; 700];
        let place = RowPlace { x0_m: -0.35, y_m: 0.123, texel_m: 0.001 };
        add_octave(&mut row, place, Octave { seed: 7, cell_m: (0.1, 0.1), amplitude: 1.0 });
        for (index, value) in row.iter().enumerate() {
            assert!((value - noise_at(-0.35 + 0.001 * index as f32, 0.123)).abs() < 1e-4, "texel {index}");
        }
        assert!(noise_at(0.2, 0.3).abs() < 1e-4);
        let spread = row.iter().map(|v| v * v).sum::<f32>() / row.len() as f32;
        assert!(spread > 0.02 && spread < 0.5, "variance {spread}");
    }
}
