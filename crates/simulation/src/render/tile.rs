//! Visibility in one tile of the image: a depth and a face a sample.

use super::lens::{IdealPixel, Lens};
use super::samples::{Pattern, Samples};
use super::setup::{LocalFace, LocalLinear, NEAR_M, ViewedFace, ViewedTriangle};

/// Side of a tile, pixels: its buffers stay in the second-level cache.
pub(crate) const TILE: u32 = 32;
const PIXELS: usize = (TILE * TILE) as usize;
/// No face at this sample.
pub(crate) const NO_FACE: u32 = u32::MAX;

/// Which pixels a tile has.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TileArea {
    pub origin: (u32, u32),
    pub width: u32,
    pub height: u32,
}

/// Buffers of a tile, reused from tile to tile.
pub(crate) struct Tile<const N: usize> {
    pub area: TileArea,
    pub pixels: Vec<IdealPixel>,
    inverse_depths: Vec<[f32; N]>,
    /// The smallest of each pixel's inverse depths: what is farther all over cannot be seen there.
    farthest: Vec<f32>,
    faces: Vec<[u32; N]>,
}

struct LocalTriangle {
    edges: [LocalLinear; 3],
    inverse_depth: LocalLinear,
    face: u32,
}

impl<const N: usize> Tile<N>
where
    Samples: Pattern<N>,
{
    pub fn new() -> Self {
        let nowhere = IdealPixel { x: 0.0, y: 0.0, by_x: (1.0, 0.0), by_y: (0.0, 1.0) };
        Tile {
            area: TileArea { origin: (0, 0), width: 0, height: 0 },
            pixels: vec![nowhere; PIXELS],
            inverse_depths: vec![[0.0; N]; PIXELS],
            farthest: vec![0.0; PIXELS],
            faces: vec![[NO_FACE; N]; PIXELS],
        }
    }

    /// Finds the nearest face of every sample.
    pub fn resolve(&mut self, area: TileArea, lens: &Lens, faces: &[ViewedFace<'_>], triangles: &[ViewedTriangle]) {
        self.area = area;
        self.inverse_depths.fill([0.0; N]);
        self.farthest.fill(0.0);
        self.faces.fill([NO_FACE; N]);
        // Bounds of the tile in the undistorted image, with the reach of a pixel's samples.
        let (mut left, mut top, mut right, mut bottom) = (f32::MAX, f32::MAX, f32::MIN, f32::MIN);
        let mut reach = 0.5f32;
        for row in 0..area.height {
            for column in 0..area.width {
                let ideal = lens.ideal(area.origin.0 + column, area.origin.1 + row, area.origin);
                (left, right) = (left.min(ideal.x), right.max(ideal.x));
                (top, bottom) = (top.min(ideal.y), bottom.max(ideal.y));
                reach = reach.max(0.5 * (ideal.by_x.0.abs() + ideal.by_y.0.abs()));
                reach = reach.max(0.5 * (ideal.by_x.1.abs() + ideal.by_y.1.abs()));
                self.pixels[(row * TILE + column) as usize] = ideal;
            }
        }
        (left, top, right, bottom) = (left - reach, top - reach, right + reach, bottom + reach);
        let (x0, y0) = (area.origin.0 as f32, area.origin.1 as f32);
        for triangle in triangles {
            let [t_left, t_top, t_right, t_bottom] = triangle.bounds;
            if t_left - x0 > right || t_right - x0 < left || t_top - y0 > bottom || t_bottom - y0 < top {
                continue;
            }
            let edges = triangle.edges.map(|edge| edge.local(area.origin));
            // Outside an edge with the corner that lies deepest inside: the triangle misses the tile.
            let best = |edge: &LocalLinear| {
                edge.at(if edge.x > 0.0 { right } else { left }, if edge.y > 0.0 { bottom } else { top })
            };
            if edges.iter().any(|edge| best(edge) < 0.0) {
                continue;
            }
            let inverse_depth = faces[triangle.face as usize].inverse_depth.local(area.origin);
            let local = LocalTriangle { edges, inverse_depth, face: triangle.face };
            // Columns and rows that the bounds leave; only without distortion are they those of the image.
            let (columns, rows) = if reach > 0.5 {
                ((0, area.width), (0, area.height))
            } else {
                let range = |low: f32, high: f32, size: u32| {
                    let first = (low - 0.5).floor().clamp(0.0, size as f32) as u32;
                    let end = ((high + 0.5).ceil().clamp(-1.0, size as f32 - 1.0) + 1.0) as u32;
                    (first, end)
                };
                (range(t_left - x0, t_right - x0, area.width), range(t_top - y0, t_bottom - y0, area.height))
            };
            self.draw(&local, columns, rows, reach);
        }
    }

    fn draw(&mut self, triangle: &LocalTriangle, columns: (u32, u32), rows: (u32, u32), reach: f32) {
        let edges = &triangle.edges;
        let margins = edges.map(|edge| reach * (edge.x.abs() + edge.y.abs()));
        let nearest = 1.0 / NEAR_M as f32;
        let w = triangle.inverse_depth;
        let spread = reach * (w.x.abs() + w.y.abs());
        for row in rows.0..rows.1 {
            for column in columns.0..columns.1 {
                let index = (row * TILE + column) as usize;
                let pixel = &self.pixels[index];
                let w_centre = w.at(pixel.x, pixel.y);
                if w_centre + spread <= self.farthest[index] {
                    continue;
                }
                let at = edges.map(|edge| edge.at(pixel.x, pixel.y));
                if (0..3).any(|edge| at[edge] + margins[edge] < 0.0) {
                    continue;
                }
                let inside = (0..3).all(|edge| at[edge] - margins[edge] >= 0.0);
                let (depths, faces) = (&mut self.inverse_depths[index], &mut self.faces[index]);
                // Offsets of the samples in the undistorted image.
                let offset = |sample: usize| {
                    let (dx, dy) = <Samples as Pattern<N>>::OFFSETS[sample];
                    (pixel.by_x.0 * dx + pixel.by_y.0 * dy, pixel.by_x.1 * dx + pixel.by_y.1 * dy)
                };
                if inside {
                    for sample in 0..N {
                        let (dx, dy) = offset(sample);
                        let inverse_depth = w_centre + w.x * dx + w.y * dy;
                        let nearer = inverse_depth > depths[sample] && inverse_depth <= nearest;
                        depths[sample] = if nearer { inverse_depth } else { depths[sample] };
                        faces[sample] = if nearer { triangle.face } else { faces[sample] };
                    }
                } else {
                    for sample in 0..N {
                        let (dx, dy) = offset(sample);
                        let inverse_depth = w_centre + w.x * dx + w.y * dy;
                        let covered = (0..3).all(|edge| at[edge] + edges[edge].x * dx + edges[edge].y * dy >= 0.0);
                        let nearer = covered & (inverse_depth > depths[sample]) & (inverse_depth <= nearest);
                        depths[sample] = if nearer { inverse_depth } else { depths[sample] };
                        faces[sample] = if nearer { triangle.face } else { faces[sample] };
                    }
                }
                self.farthest[index] = depths.iter().fold(f32::INFINITY, |least, value| least.min(*value));
            }
        }
    }

    /// z-depth of a pixel's first sample, metres; 0 where nothing is seen.
    pub fn depth(&self, column: u32, row: u32) -> f32 {
        let inverse = self.inverse_depths[(row * TILE + column) as usize][0];
        if inverse > 0.0 { 1.0 / inverse } else { 0.0 }
    }

    /// The mean colour of a pixel: each face under it is shaded once, where the middle of its samples lies.
    #[inline]
    pub fn colour(&self, column: u32, row: u32, local: &mut LocalFaces<'_, '_>) -> [f32; 3] {
        let index = (row * TILE + column) as usize;
        let (pixel, faces) = (&self.pixels[index], &self.faces[index]);
        if faces.iter().all(|face| *face == faces[0]) {
            return local.shade(faces[0], pixel, (0.0, 0.0), self.area.origin);
        }
        let mut sum = [0.0f32; 3];
        let mut done = [false; N];
        for first in 0..N {
            if done[first] {
                continue;
            }
            let (mut count, mut middle) = (0.0f32, (0.0f32, 0.0f32));
            for sample in first..N {
                if faces[sample] == faces[first] {
                    done[sample] = true;
                    count += 1.0;
                    middle.0 += <Samples as Pattern<N>>::OFFSETS[sample].0;
                    middle.1 += <Samples as Pattern<N>>::OFFSETS[sample].1;
                }
            }
            let colour = local.shade(faces[first], pixel, (middle.0 / count, middle.1 / count), self.area.origin);
            for channel in 0..3 {
                sum[channel] += colour[channel] * count;
            }
        }
        sum.map(|value| value / N as f32)
    }
}

/// Faces about a tile's origin, the last one used kept at hand: neighbours mostly see the same face.
pub(crate) struct LocalFaces<'f, 'a> {
    faces: &'f [ViewedFace<'a>],
    last: Option<(u32, (u32, u32), LocalFace<'a>)>,
}

impl<'f, 'a> LocalFaces<'f, 'a> {
    pub fn new(faces: &'f [ViewedFace<'a>]) -> Self {
        LocalFaces { faces, last: None }
    }

    #[inline]
    fn shade(&mut self, face: u32, pixel: &IdealPixel, offset: (f32, f32), origin: (u32, u32)) -> [f32; 3] {
        if face == NO_FACE {
            return [0.0; 3];
        }
        let local = match &self.last {
            Some((known, at, local)) if *known == face && *at == origin => *local,
            _ => {
                let local = self.faces[face as usize].local(origin);
                self.last = Some((face, origin, local));
                local
            }
        };
        let x = pixel.x + pixel.by_x.0 * offset.0 + pixel.by_y.0 * offset.1;
        let y = pixel.y + pixel.by_x.1 * offset.0 + pixel.by_y.1 * offset.1;
        let [r, g, b, _] = local.texture.sample(&local.footprint(x, y, pixel.by_x, pixel.by_y));
        [r * local.brightness, g * local.brightness, b * local.brightness]
    }
}
