//! The valid pixels of a depth image as coloured points with normals, in the colour camera's frame: all of a cloud that
//! does not depend on the pose.

use crate::View;
use crate::cloud_builder::{CloudOptions, PointDepths, PointNormals, UncoloredPoints};
use crate::color_lookup::{ColorLookup, ColorPlaces};
use crate::normals::{NormalWindow, PatchFitter, PatchRow};
use crate::rays::Rays;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Rows that are worked on together.
const ROWS: usize = 16;

/// One valid pixel: where it is and what it weighs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewPoint {
    pub(crate) point_in_color: [f32; 3],
    /// Inverse variance of the depth noise, relative to that at 1 m.
    pub(crate) weight: f32,
    /// Zero without normals.
    pub(crate) normal_in_color: [f32; 3],
    /// 0 to 255.
    pub(crate) color: Option<[f32; 3]>,
}

/// The points of one view, to be put into clouds at one or several poses.
#[derive(Debug, Clone, Default)]
pub struct ViewPoints {
    /// By bands of rows, each in the order of its pixels.
    pub(crate) bands: Vec<Vec<ViewPoint>>,
}

impl ViewPoints {
    /// Of a view that was checked.
    pub(crate) fn new(view: &View<'_>, rays: &Rays, options: &CloudOptions) -> Self {
        let filter = &options.filter;
        let depth = view.valid_depth_along(filter, rays);
        let width = rays.width().max(1);
        let wants_fit = options.normals == PointNormals::Fitted || options.depths == PointDepths::Fitted;
        let fitter = wants_fit.then(|| PatchFitter::new(&depth, rays, filter, NormalWindow::of_maps(1)));
        let lookup = view.color.map(|image| (image, ColorLookup::new(view)));
        let color_from_depth = view.depth_camera.color_from_depth.cast::<f32>();
        let rotation = *color_from_depth.rotation.to_rotation_matrix().matrix();
        let translation = color_from_depth.translation.vector;
        let noise = &filter.noise;
        let (floor, quadratic) = (noise.floor_m as f32, noise.depth_sigma_per_m2 as f32);
        let bands = depth.par_chunks(width * ROWS).enumerate().map_init(
            <(PatchRow, ColorPlaces)>::default,
            |(patches, places), (band, rows)| {
                let mut points = Vec::with_capacity(rows.len());
                for (y, row) in rows.chunks(width).enumerate() {
                    let y = band * ROWS + y;
                    if let Some(fitter) = &fitter {
                        fitter.row(y, patches);
                    }
                    let depths = match options.depths {
                        PointDepths::Fitted => &patches.depth[..width],
                        PointDepths::Measured => row,
                    };
                    if let Some((_, lookup)) = &lookup {
                        lookup.find(rays, y, depths, places);
                    }
                    for (x, &z) in depths.iter().enumerate().filter(|(_, z)| **z > 0.0) {
                        let color = lookup.as_ref().and_then(|(image, _)| places.color(x, image));
                        if color.is_none() && options.uncolored == UncoloredPoints::Drop {
                            continue;
                        }
                        let ray = rays.direction(y * width + x);
                        let normal_in_color = if options.normals == PointNormals::Fitted {
                            let fitted = patches.at(x).normal;
                            let normal = if fitted == Vector3::zeros() { -ray.normalize() } else { fitted };
                            (rotation * normal).into()
                        } else {
                            [0.0; 3]
                        };
                        let relative_sigma = (floor + quadratic) / (floor + quadratic * z * z);
                        points.push(ViewPoint {
                            point_in_color: (rotation * (ray * z) + translation).into(),
                            weight: relative_sigma * relative_sigma,
                            normal_in_color,
                            color,
                        });
                    }
                }
                points
            },
        );
        ViewPoints { bands: bands.collect() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.bands.iter().map(Vec::len).sum()
    }

    /// Whether no pixel is valid.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
