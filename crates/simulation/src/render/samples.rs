//! Where within a pixel visibility is tested.

use serde::{Deserialize, Serialize};

/// Visibility samples a pixel. Every pattern is symmetric about the pixel's centre and has one sample in each of its
/// rows and columns, so that edges are where they should be to a fraction of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Antialiasing {
    /// The pixel's centre only.
    None,
    /// Four samples.
    Four,
    /// Eight samples.
    #[default]
    Eight,
    /// Sixteen samples.
    Sixteen,
}

/// Offsets from the pixel's centre, pixels.
pub(crate) trait Pattern<const N: usize> {
    const OFFSETS: [(f32, f32); N];
}

pub(crate) struct Samples;

const fn scaled<const N: usize>(half: [(i32, i32); N], unit: f32) -> [(f32, f32); N] {
    let mut offsets = [(0.0, 0.0); N];
    let mut index = 0;
    while index < N {
        offsets[index] = (half[index].0 as f32 * unit, half[index].1 as f32 * unit);
        index += 1;
    }
    offsets
}

impl Pattern<1> for Samples {
    const OFFSETS: [(f32, f32); 1] = [(0.0, 0.0)];
}

impl Pattern<4> for Samples {
    const OFFSETS: [(f32, f32); 4] = scaled([(1, 3), (3, -1), (-1, -3), (-3, 1)], 1.0 / 8.0);
}

impl Pattern<8> for Samples {
    const OFFSETS: [(f32, f32); 8] =
        scaled([(1, -3), (3, 7), (5, 1), (7, -5), (-1, 3), (-3, -7), (-5, -1), (-7, 5)], 1.0 / 16.0);
}

impl Pattern<16> for Samples {
    const OFFSETS: [(f32, f32); 16] = scaled(
        [
            (1, 15),
            (3, 7),
            (5, -9),
            (7, 1),
            (9, 11),
            (11, -13),
            (13, 5),
            (15, -3),
            (-1, -15),
            (-3, -7),
            (-5, 9),
            (-7, -1),
            (-9, -11),
            (-11, 13),
            (-13, -5),
            (-15, 3),
        ],
        1.0 / 32.0,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<const N: usize>()
    where
        Samples: Pattern<N>,
    {
        let offsets = <Samples as Pattern<N>>::OFFSETS;
        for &(x, y) in &offsets {
            assert!(offsets.contains(&(-x, -y)), "{N}: ({x}, {y}) has no mirror image");
        }
        for take in [|p: &(f32, f32)| p.0, |p: &(f32, f32)| p.1] {
            let mut values: Vec<f32> = offsets.iter().map(take).collect();
            values.sort_by(f32::total_cmp);
            for (index, value) in values.iter().enumerate() {
                assert!((value - ((index as f32 + 0.5) / N as f32 - 0.5)).abs() < 1e-6, "{N}: {values:?}");
            }
        }
    }

    #[test]
    fn patterns_are_symmetric_and_fill_rows_and_columns() {
        check::<1>();
        check::<4>();
        check::<8>();
        check::<16>();
    }
}
