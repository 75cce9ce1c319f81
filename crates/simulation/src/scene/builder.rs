//! Things made of sheets: cuboids, cylinders, panels, each sheet with a material, then painted and lit all at once.

use super::light::{fill_covered, light_at};
use super::material::Material;
use super::model::{Face, Model};
use super::raycast::RayCaster;
use crate::Texture;
use crate::scene_rng::SceneRng;
use nalgebra::Vector3;
use rayon::prelude::*;
use skclam_geometry::{Isometry3, Point3};
use std::sync::Arc;

/// A sheet of texture: where it lies, how large it is and what is on it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sheet {
    pub material: Material,
    pub size_m: (f64, f64),
    pub texel_m: f64,
    shape: Shape,
}

#[derive(Debug, Clone, Copy)]
enum Shape {
    /// Top left corner, directions to the right and down (unit), outward normal.
    Flat { corner: Point3, right: Vector3<f64>, down: Vector3<f64>, normal: Vector3<f64> },
    /// Top end of the axis, unit axis upward, a unit vector across, radius.
    Tube { top: Point3, axis: Vector3<f64>, across: Vector3<f64>, radius: f64 },
}

impl Sheet {
    /// Point and outward normal at a place given in fractions of width and height.
    fn at(&self, u: f64, v: f64) -> (Point3, Vector3<f64>) {
        match self.shape {
            Shape::Flat { corner, right, down, normal } => {
                (corner + right * (u * self.size_m.0) + down * (v * self.size_m.1), normal)
            }
            Shape::Tube { top, axis, across, radius } => {
                let angle = std::f64::consts::TAU * u;
                let normal = across * angle.cos() + axis.cross(&across) * angle.sin();
                (top - axis * (v * self.size_m.1) + normal * radius, normal)
            }
        }
    }
}

/// Which faces of a cuboid are drawn, and with what.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CuboidMaterials {
    pub top: Option<Material>,
    pub bottom: Option<Material>,
    pub sides: [Option<Material>; 4],
}

impl CuboidMaterials {
    /// All sides and the top alike, nothing below.
    pub fn freestanding(material: Material) -> Self {
        CuboidMaterials { top: Some(material), bottom: None, sides: [Some(material); 4] }
    }

    pub fn all(material: Material) -> Self {
        CuboidMaterials { top: Some(material), bottom: Some(material), sides: [Some(material); 4] }
    }
}

/// Light is computed on a grid of about this, metres; it changes slowly.
const LIGHT_CELL_M: f64 = 0.09;

/// Collects sheets and faces; texture indices are sheet indices.
#[derive(Debug)]
pub(crate) struct Builder {
    pub model: Model,
    pub sheets: Vec<Sheet>,
    texels: TexelRule,
}

/// How large texels are.
#[derive(Debug, Clone, Copy)]
pub(crate) enum TexelRule {
    /// The same everywhere, metres.
    Even(f64),
    /// `texel_at_1m` at one metre from the ball of radius `reach_m` in which cameras move, in proportion elsewhere.
    FromReach { texel_at_1m: f64, reach_m: f64 },
}

impl Builder {
    pub fn new(texels: TexelRule) -> Self {
        Builder { model: Model::default(), sheets: Vec::new(), texels }
    }

    fn texel_for(&self, points: &[Point3], normal: Option<Vector3<f64>>) -> f64 {
        let (texel_at_1m, reach_m) = match self.texels {
            TexelRule::Even(texel_m) => return texel_m,
            TexelRule::FromReach { texel_at_1m, reach_m } => (texel_at_1m, reach_m),
        };
        let middle = Point3::new(0.0, 0.0, 0.45);
        // What shows its back to every place that a camera can reach needs no detail.
        if normal.is_some_and(|normal| normal.dot(&(middle - points[0])) < -(reach_m + 0.25)) {
            return 5.0 * texel_at_1m;
        }
        // The nearest point of a large face is not a corner: sample it coarsely.
        let mut nearest = f64::INFINITY;
        for i in 0..=8 {
            for j in 0..=8 {
                let (u, v) = (f64::from(i) / 8.0, f64::from(j) / 8.0);
                let point = points[0] + (points[1] - points[0]) * u + (points[2] - points[0]) * v;
                nearest = nearest.min((point - middle).norm());
            }
        }
        texel_at_1m * (nearest - reach_m).clamp(0.45, 2.5)
    }

    /// A flat sheet: `right` and `down` as seen from outside, metres.
    pub fn sheet(&mut self, corner: Point3, right: Vector3<f64>, down: Vector3<f64>, material: Material) {
        let corners = [corner, corner + down, corner + down + right, corner + right];
        self.flat(corner, right, down, material, &corners);
    }

    fn flat(
        &mut self,
        corner: Point3,
        right: Vector3<f64>,
        down: Vector3<f64>,
        material: Material,
        polygon: &[Point3],
    ) {
        let size_m = (right.norm(), down.norm());
        let (across, along) = (right / size_m.0, down / size_m.1);
        let normal = along.cross(&across);
        let texel_m = self.texel_for(&[corner, corner + right, corner + down], Some(normal));
        let (right, down) = (across, along);
        let texture = self.sheets.len() as u32;
        self.sheets.push(Sheet { material, size_m, texel_m, shape: Shape::Flat { corner, right, down, normal } });
        // Axes are directions for now; they are scaled to texels when the sheet is painted.
        let face = Face {
            origin: corner,
            normal,
            s_axis: right,
            t_axis: down,
            origin_texel: [0.0; 2],
            texture,
            brightness: 1.0,
        };
        self.model.add_polygon(face, polygon);
    }

    /// A cuboid whose frame has its origin in the middle of the bottom, z up; `size`: x, y, z.
    pub fn cuboid(&mut self, frame: &Isometry3, size: [f64; 3], materials: &CuboidMaterials) {
        let [x, y, z] = size;
        let point = |px: f64, py: f64, pz: f64| frame * Point3::new(px * x / 2.0, py * y / 2.0, pz * z);
        let direction = |dx: f64, dy: f64, dz: f64| frame * Vector3::new(dx * x, dy * y, dz * z);
        let down = direction(0.0, 0.0, -1.0);
        let sides = [
            (point(1.0, -1.0, 1.0), direction(0.0, 1.0, 0.0)),
            (point(1.0, 1.0, 1.0), direction(-1.0, 0.0, 0.0)),
            (point(-1.0, 1.0, 1.0), direction(0.0, -1.0, 0.0)),
            (point(-1.0, -1.0, 1.0), direction(1.0, 0.0, 0.0)),
        ];
        for ((corner, right), material) in sides.into_iter().zip(materials.sides) {
            if let Some(material) = material {
                self.sheet(corner, right, down, material);
            }
        }
        if let Some(material) = materials.top {
            self.sheet(point(-1.0, 1.0, 1.0), direction(1.0, 0.0, 0.0), direction(0.0, -1.0, 0.0), material);
        }
        if let Some(material) = materials.bottom {
            self.sheet(point(-1.0, -1.0, 0.0), direction(1.0, 0.0, 0.0), direction(0.0, 1.0, 0.0), material);
        }
    }

    /// A cylinder from `bottom` to `top` with flat facets, and discs at its ends where they have a material.
    pub fn cylinder(&mut self, bottom: Point3, top: Point3, radius: f64, side: Material, caps: [Option<Material>; 2]) {
        let height = (top - bottom).norm();
        let axis = (top - bottom) / height;
        let helper = if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        let across = axis.cross(&helper).normalize();
        let facets = if radius > 0.08 { 40 } else { 24 };
        let rim = |end: Point3, facet: usize| {
            let angle = std::f64::consts::TAU * facet as f64 / facets as f64;
            end + (across * angle.cos() + axis.cross(&across) * angle.sin()) * radius
        };
        let facet_width = 2.0 * radius * (std::f64::consts::PI / facets as f64).sin();
        let texture = self.sheets.len() as u32;
        let texel_m = self.texel_for(&[bottom, top, bottom], None);
        let size_m = (facet_width * facets as f64, height);
        self.sheets.push(Sheet { material: side, size_m, texel_m, shape: Shape::Tube { top, axis, across, radius } });
        for facet in 0..facets {
            let corners = [rim(top, facet), rim(bottom, facet), rim(bottom, facet + 1), rim(top, facet + 1)];
            let right = (corners[3] - corners[0]) / facet_width;
            let face = Face {
                origin: corners[0],
                normal: (-axis).cross(&right),
                s_axis: right,
                t_axis: -axis,
                origin_texel: [facet as f64 * facet_width, 0.0],
                texture,
                brightness: 1.0,
            };
            self.model.add_polygon(face, &corners);
        }
        for (end, sign, material) in [(bottom, -1.0, caps[0]), (top, 1.0, caps[1])] {
            let Some(material) = material else { continue };
            let normal = axis * sign;
            let right = across;
            // down x right = normal, as for every flat sheet.
            let down = right.cross(&normal);
            let polygon: Vec<Point3> =
                (0..facets).map(|facet| if sign > 0.0 { rim(end, facet) } else { rim(end, facets - facet) }).collect();
            self.flat(end - (right + down) * radius, right * (2.0 * radius), down * (2.0 * radius), material, &polygon);
        }
    }

    /// Paints every sheet, lights it where `lit`, and scales the faces' axes to texels.
    pub fn finish(self, seed: u64, stream: u64, lit: bool) -> (Model, Vec<Sheet>) {
        let Builder { mut model, sheets, .. } = self;
        let caster = lit.then(|| RayCaster::new(&model));
        let painted: Vec<(Texture, f64)> = sheets
            .par_iter()
            .enumerate()
            .map(|(index, sheet)| {
                let mut rng = SceneRng::new(seed, stream + index as u64);
                let size_m = (sheet.size_m.0 as f32, sheet.size_m.1 as f32);
                let mut canvas = sheet.material.paint(size_m, sheet.texel_m as f32, &mut rng);
                if let Some(caster) = &caster {
                    let cells = |length: f64| ((length / LIGHT_CELL_M).ceil() as usize).clamp(2, 64);
                    let (columns, rows) = (cells(sheet.size_m.0), cells(sheet.size_m.1));
                    let mut light = Vec::with_capacity(columns * rows);
                    for row in 0..rows {
                        for column in 0..columns {
                            let (u, v) = ((column as f64 + 0.5) / columns as f64, (row as f64 + 0.5) / rows as f64);
                            let (point, normal) = sheet.at(u, v);
                            light.push(light_at(caster, &point, &normal));
                        }
                    }
                    canvas.shine(&fill_covered(&mut light, columns), columns, rows);
                }
                let texel_m = f64::from(canvas.texel_m);
                (canvas.into_texture(), texel_m)
            })
            .collect();
        for face in &mut model.faces {
            let texels_per_m = 1.0 / painted[face.texture as usize].1;
            face.s_axis *= texels_per_m;
            face.t_axis *= texels_per_m;
            face.origin_texel = face.origin_texel.map(|metres| metres * texels_per_m);
        }
        model.textures = Arc::new(painted.into_iter().map(|(texture, _)| texture).collect());
        (model, sheets)
    }
}
