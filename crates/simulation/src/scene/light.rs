//! Light that belongs to the surfaces: two lamps at the ceiling with soft shadows, and the sky's light where corners
//! and neighbours let it in. It is computed once and painted into the textures, so that it never depends on the view.

use super::raycast::RayCaster;
use nalgebra::Vector3;
use skclam_geometry::Point3;

/// A lamp: a rectangle that shines downward.
#[derive(Debug, Clone, Copy)]
struct Lamp {
    centre: [f64; 3],
    half: [f64; 2],
}

const LAMPS: [Lamp; 2] =
    [Lamp { centre: [0.5, -0.75, 1.78], half: [0.75, 0.12] }, Lamp { centre: [-0.4, 0.8, 1.78], half: [0.75, 0.12] }];
/// Squared distance at which a lamp lights as its strength says, square metres.
const REFERENCE_SQUARED: f64 = 3.0;
const LAMP_STRENGTH: f64 = 0.78;
const AMBIENT_STRENGTH: f64 = 0.66;
/// Surfaces farther away do not darken a corner, metres.
const AMBIENT_REACH_M: f64 = 0.7;

/// Light at a point of a surface: 1 is a well-lit bench. `None` where something lies on the surface: nobody sees that
/// place, and its darkness must not leak beyond the thing's edge.
pub(crate) fn light_at(caster: &RayCaster, point: &Point3, normal: &Vector3<f64>) -> Option<f32> {
    let start = point + 2e-3 * normal;
    let mut lamps = 0.0;
    for lamp in &LAMPS {
        for i in 0..4 {
            for j in 0..2 {
                let (u, v) = (f64::from(i) / 1.5 - 1.0, f64::from(j) * 2.0 - 1.0);
                let target = Point3::new(
                    lamp.centre[0] + 0.8 * u * lamp.half[0],
                    lamp.centre[1] + 0.6 * v * lamp.half[1],
                    lamp.centre[2],
                );
                let way = target - start;
                let cosine = way.dot(normal) / way.norm();
                // A lamp shines down, and evenly enough to the sides to reach the walls.
                let leaving = 0.35 + 0.65 * (way.z / way.norm()).max(0.0);
                if cosine > 0.0 && !caster.is_blocked(&start, &way, 0.98) {
                    lamps += cosine * leaving * (REFERENCE_SQUARED / (way.norm_squared() + 0.5)).min(2.0) / 8.0;
                }
            }
        }
    }
    let sideways =
        if normal.z.abs() < 0.9 { normal.cross(&Vector3::z()) } else { normal.cross(&Vector3::x()) }.normalize();
    let other = normal.cross(&sideways);
    let (mut open, mut total, mut touched) = (0.0, 0.0, 0);
    // Directions of equal weight in a cosine-weighted hemisphere, on a golden spiral.
    const RAYS: u32 = 16;
    for ray in 0..RAYS {
        let radius = ((f64::from(ray) + 0.5) / f64::from(RAYS)).sqrt();
        let angle = f64::from(ray) * 2.399_963_229_728_653;
        let height = (1.0 - radius * radius).sqrt();
        let way = (sideways * angle.cos() + other * angle.sin()) * radius + normal * height;
        // More light comes from above than from below.
        let weight = 0.75 + 0.25 * way.z;
        total += weight;
        let distance = caster.first_hit(&start, &way, AMBIENT_REACH_M).map_or(AMBIENT_REACH_M, |hit| hit.distance);
        touched += u32::from(distance < 0.35);
        let closeness = (distance / AMBIENT_REACH_M).sqrt();
        open += weight * (0.15 + 0.85 * closeness);
    }
    let above = 0.85 + 0.15 * normal.z;
    if touched == RAYS {
        return None;
    }
    Some(((lamps * LAMP_STRENGTH + AMBIENT_STRENGTH * above * open / total).min(1.25)) as f32)
}

/// Gives covered places of a grid the mean of their lit neighbours, from the rims inward.
pub(crate) fn fill_covered(grid: &mut [Option<f32>], columns: usize) -> Vec<f32> {
    let rows = grid.len() / columns;
    for _ in 0..columns.max(rows) {
        let before = grid.to_vec();
        let mut changed = false;
        for index in 0..grid.len() {
            if before[index].is_some() {
                continue;
            }
            let (column, row) = (index % columns, index / columns);
            let mut neighbours = Vec::with_capacity(4);
            if column > 0 {
                neighbours.extend(before[index - 1]);
            }
            if column + 1 < columns {
                neighbours.extend(before[index + 1]);
            }
            if row > 0 {
                neighbours.extend(before[index - columns]);
            }
            if row + 1 < rows {
                neighbours.extend(before[index + columns]);
            }
            if !neighbours.is_empty() {
                grid[index] = Some(neighbours.iter().sum::<f32>() / neighbours.len() as f32);
                changed = true;
            }
        }
        if !changed {
            break;
        }
    }
    // A sheet that is covered all over is seen by nobody.
    grid.iter().map(|value| value.unwrap_or(0.3)).collect()
}

/// Light on something that moves, by its normal alone: no shadows.
pub(crate) fn light_on_moving(normal: &Vector3<f64>) -> f32 {
    (0.78 + 0.22 * normal.z + 0.06 * normal.x) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covered_places_take_the_light_of_their_rim() {
        let mut grid = vec![Some(1.0); 15];
        (grid[6], grid[7], grid[8]) = (None, None, None);
        assert_eq!(fill_covered(&mut grid, 5), vec![1.0; 15]);
        assert_eq!(fill_covered(&mut [None, None], 2), vec![0.3; 2]);
        assert_eq!(fill_covered(&mut [Some(0.5), None, None], 3), vec![0.5; 3]);
    }
}
