//! Discs and triangles into a depth buffer and a colour buffer.
//!
//! The image is cut into bands of rows, each filled by one thread in the order of the points or triangles; what is
//! nearer wins and the earlier one wins a tie, so the result does not depend on the number of threads.

use super::{BackFaces, Projection, RenderCamera, RenderOptions};
use crate::{PointCloud, TriangleMesh};
use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;

/// Rows a band.
const BAND: usize = 64;
/// Nearest depth that is drawn, metres.
const NEAR: f32 = 1e-3;
/// A disc is never larger than this, pixels: a point at the tip of the viewer's nose shall not cover the image.
const LARGEST_DISC: f32 = 64.0;

/// An image before lighting.
pub(super) struct Canvas {
    pub(super) width: usize,
    /// Depth along the viewer's axis, metres; infinite where nothing is.
    pub(super) depth: Vec<f32>,
    /// Red, green, blue, 0 to 255.
    pub(super) color: Vec<[f32; 3]>,
}

/// Where a point appears: pixel, depth, how it is lit (cosine to the viewer).
#[derive(Clone, Copy)]
struct Seen {
    x: f32,
    y: f32,
    z: f32,
    facing: f32,
}

/// Takes points of the base frame to the screen.
struct Stage {
    eye_from_base: Isometry3<f32>,
    projection: Projection,
    scale: f32,
    centre: (f32, f32),
    headlight: f32,
}

impl Stage {
    fn new(camera: &RenderCamera, options: &RenderOptions) -> Self {
        Stage {
            eye_from_base: camera.base_from_eye.inverse().cast(),
            projection: camera.projection,
            scale: camera.pixels_per_metre() as f32,
            centre: (0.5 * (camera.width as f32 - 1.0), 0.5 * (camera.height as f32 - 1.0)),
            headlight: options.headlight as f32,
        }
    }

    fn in_eye(&self, point: [f32; 3]) -> Vector3<f32> {
        self.eye_from_base.rotation * Vector3::from(point) + self.eye_from_base.translation.vector
    }

    /// Pixels a metre at a depth.
    fn scale_at(&self, z: f32) -> f32 {
        match self.projection {
            Projection::Perspective { .. } => self.scale / z,
            Projection::Orthographic { .. } => self.scale,
        }
    }

    fn project(&self, in_eye: &Vector3<f32>, facing: f32) -> Seen {
        let scale = self.scale_at(in_eye.z);
        Seen { x: in_eye.x * scale + self.centre.0, y: in_eye.y * scale + self.centre.1, z: in_eye.z, facing }
    }

    /// Cosine between a normal and the direction to the viewer.
    fn facing(&self, in_eye: &Vector3<f32>, normal_in_eye: &Vector3<f32>) -> f32 {
        match self.projection {
            Projection::Perspective { .. } => -normal_in_eye.dot(in_eye) / in_eye.norm().max(1e-9),
            Projection::Orthographic { .. } => -normal_in_eye.z,
        }
    }

    fn lit(&self, color: [f32; 3], facing: f32) -> [f32; 3] {
        let light = 1.0 - self.headlight * (1.0 - facing.abs().min(1.0));
        color.map(|value| value * light)
    }
}

impl Canvas {
    fn empty(camera: &RenderCamera, options: &RenderOptions) -> Self {
        let pixels = camera.width as usize * camera.height as usize;
        Canvas {
            width: camera.width as usize,
            depth: vec![f32::INFINITY; pixels],
            color: vec![options.background.map(f32::from); pixels],
        }
    }

    /// Calls `fill(first row, rows, depth, colour)` for every band, in parallel.
    fn bands(&mut self, fill: impl Fn(usize, usize, &mut [f32], &mut [[f32; 3]]) + Sync) {
        let width = self.width;
        self.depth.par_chunks_mut(BAND * width).zip(self.color.par_chunks_mut(BAND * width)).enumerate().for_each(
            |(band, (depth, color))| {
                let rows = depth.len() / width;
                fill(band * BAND, rows, depth, color);
            },
        );
    }

    pub(super) fn of_points(cloud: &PointCloud, camera: &RenderCamera, options: &RenderOptions) -> Self {
        let stage = Stage::new(camera, options);
        let mut canvas = Self::empty(camera, options);
        let width = canvas.width;
        let hide_backs = options.back_faces == BackFaces::Hidden;
        let seen: Vec<Option<Seen>> = (0..cloud.len())
            .into_par_iter()
            .map(|index| {
                let in_eye = stage.in_eye(cloud.points[index]);
                let facing = cloud.normals.get(index).map_or(1.0, |normal| {
                    stage.facing(&in_eye, &(stage.eye_from_base.rotation * Vector3::from(*normal)))
                });
                (in_eye.z > NEAR && !(hide_backs && facing <= 0.0)).then(|| stage.project(&in_eye, facing))
            })
            .collect();
        let radius_m = options.point_radius_m as f32;
        let reach = |point: &Seen| (radius_m * stage.scale_at(point.z)).clamp(0.5, LARGEST_DISC);
        let by_band = deal(
            seen.iter().enumerate().filter_map(|(index, point)| {
                let point = point.as_ref()?;
                let reach = reach(point);
                let on_screen = point.x + reach >= 0.0 && point.x - reach <= width as f32;
                on_screen.then_some((index as u32, point.y - reach, point.y + reach))
            }),
            camera.height as usize,
        );
        canvas.bands(|first_row, rows, depth, color| {
            for &index in &by_band[first_row / BAND] {
                let index = index as usize;
                let Some(point) = seen[index] else { continue };
                let reach = reach(&point);
                let own = cloud.colors.get(index).copied().unwrap_or(options.material);
                let own = stage.lit(own.map(f32::from), point.facing);
                let (top, bottom) = range(point.y - reach, point.y + reach, first_row, rows);
                let (left, right) = range(point.x - reach, point.x + reach, 0, width);
                for y in top..bottom {
                    for x in left..right {
                        let (dx, dy) = (x as f32 - point.x, y as f32 - point.y);
                        let distance = (dx * dx + dy * dy) / (reach * reach);
                        // The half pixel makes sure that a point between pixels is drawn.
                        if distance > 1.0 && dx.abs().max(dy.abs()) > 0.5 {
                            continue;
                        }
                        // A bowl towards the viewer: where discs overlap, the nearest centre wins.
                        let z = point.z + 0.5 * radius_m * distance;
                        let pixel = (y - first_row) * width + x;
                        if z < depth[pixel] {
                            depth[pixel] = z;
                            color[pixel] = own;
                        }
                    }
                }
            }
        });
        canvas
    }

    pub(super) fn of_triangles(mesh: &TriangleMesh, camera: &RenderCamera, options: &RenderOptions) -> Self {
        let stage = Stage::new(camera, options);
        let mut canvas = Self::empty(camera, options);
        let width = canvas.width;
        let hide_backs = options.back_faces == BackFaces::Hidden;
        let vertices = &mesh.vertices;
        let pieces: Vec<[Corner; 3]> = mesh
            .triangles
            .par_iter()
            .flat_map_iter(|triangle| {
                let in_eye = triangle.map(|index| stage.in_eye(vertices.points[index as usize]));
                let normal = (in_eye[1] - in_eye[0]).cross(&(in_eye[2] - in_eye[0]));
                let norm = normal.norm();
                let flat = stage.facing(&((in_eye[0] + in_eye[1] + in_eye[2]) / 3.0), &(normal / norm.max(1e-20)));
                if norm <= 0.0 || (hide_backs && flat <= 0.0) {
                    return Vec::new();
                }
                let corners: [Corner; 3] = std::array::from_fn(|corner| {
                    let index = triangle[corner] as usize;
                    let facing = vertices.normals.get(index).map_or(flat, |normal| {
                        stage.facing(&in_eye[corner], &(stage.eye_from_base.rotation * Vector3::from(*normal)))
                    });
                    let own = vertices.colors.get(index).copied().unwrap_or(options.material).map(f32::from);
                    Corner { in_eye: in_eye[corner], color: stage.lit(own, facing) }
                });
                clipped(corners)
            })
            .collect();
        let seen: Vec<[Seen; 3]> =
            pieces.par_iter().map(|piece| [0, 1, 2].map(|c| stage.project(&piece[c].in_eye, 1.0))).collect();
        let by_band = deal(
            seen.iter().enumerate().map(|(index, corners)| {
                let y = corners.map(|corner| corner.y);
                (index as u32, y[0].min(y[1]).min(y[2]), y[0].max(y[1]).max(y[2]))
            }),
            camera.height as usize,
        );
        let perspective = matches!(camera.projection, Projection::Perspective { .. });
        canvas.bands(|first_row, rows, depth, color| {
            for &index in &by_band[first_row / BAND] {
                let index = index as usize;
                fill_triangle(&seen[index], &pieces[index], perspective, first_row, rows, width, depth, color);
            }
        });
        canvas
    }
}

/// For each band, what touches it, in order.
fn deal(items: impl Iterator<Item = (u32, f32, f32)>, height: usize) -> Vec<Vec<u32>> {
    let mut bands = vec![Vec::new(); height.div_ceil(BAND)];
    for (index, top, bottom) in items {
        let (top, bottom) = range(top, bottom, 0, height);
        if top < bottom {
            for band in &mut bands[top / BAND..=(bottom - 1) / BAND] {
                band.push(index);
            }
        }
    }
    bands
}

/// Pixels between two positions, with half a pixel of margin, cut to a span of pixels.
fn range(low: f32, high: f32, first: usize, count: usize) -> (usize, usize) {
    let clamp = |value: f32| (value.max(0.0) as usize).clamp(first, first + count);
    (clamp((low - 0.5).ceil()), clamp((high + 0.5).floor() + 1.0))
}

/// A corner of a triangle with its lit colour.
#[derive(Clone, Copy)]
struct Corner {
    in_eye: Vector3<f32>,
    color: [f32; 3],
}

/// Cuts off what lies before the near plane: none, one or two triangles remain.
fn clipped(corners: [Corner; 3]) -> Vec<[Corner; 3]> {
    if corners.iter().all(|corner| corner.in_eye.z >= NEAR) {
        return vec![corners];
    }
    let mut polygon: Vec<Corner> = Vec::with_capacity(4);
    for index in 0..3 {
        let (from, to) = (corners[index], corners[(index + 1) % 3]);
        if from.in_eye.z >= NEAR {
            polygon.push(from);
        }
        if (from.in_eye.z >= NEAR) != (to.in_eye.z >= NEAR) {
            let fraction = (NEAR - from.in_eye.z) / (to.in_eye.z - from.in_eye.z);
            polygon.push(Corner {
                in_eye: from.in_eye.lerp(&to.in_eye, fraction),
                color: std::array::from_fn(|c| from.color[c] + fraction * (to.color[c] - from.color[c])),
            });
        }
    }
    (2..polygon.len()).map(|last| [polygon[0], polygon[last - 1], polygon[last]]).collect()
}

#[allow(clippy::too_many_arguments)]
fn fill_triangle(
    seen: &[Seen; 3],
    piece: &[Corner; 3],
    perspective: bool,
    first_row: usize,
    rows: usize,
    width: usize,
    depth: &mut [f32],
    color: &mut [[f32; 3]],
) {
    let [a, b, c] = seen;
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if !(area.abs() > 1e-12 && area.is_finite()) {
        return;
    }
    let (top, bottom) = range(a.y.min(b.y).min(c.y), a.y.max(b.y).max(c.y), first_row, rows);
    let (left, right) = range(a.x.min(b.x).min(c.x), a.x.max(b.x).max(c.x), 0, width);
    for y in top..bottom {
        for x in left..right {
            let (px, py) = (x as f32, y as f32);
            let fraction_b = ((px - a.x) * (c.y - a.y) - (py - a.y) * (c.x - a.x)) / area;
            let fraction_c = ((b.x - a.x) * (py - a.y) - (b.y - a.y) * (px - a.x)) / area;
            let fraction_a = 1.0 - fraction_b - fraction_c;
            if fraction_a < 0.0 || fraction_b < 0.0 || fraction_c < 0.0 {
                continue;
            }
            // In perspective the inverse depth is linear on the screen, and colours go with it.
            let fractions = [fraction_a, fraction_b, fraction_c];
            let (z, fractions) = if perspective {
                let weighted = [fraction_a / a.z, fraction_b / b.z, fraction_c / c.z];
                let z = 1.0 / (weighted[0] + weighted[1] + weighted[2]);
                (z, weighted.map(|weight| weight * z))
            } else {
                (fraction_a * a.z + fraction_b * b.z + fraction_c * c.z, fractions)
            };
            let pixel = (y - first_row) * width + x;
            if z < depth[pixel] {
                depth[pixel] = z;
                color[pixel] = std::array::from_fn(|channel| {
                    (0..3).map(|corner| fractions[corner] * piece[corner].color[channel]).sum()
                });
            }
        }
    }
}
