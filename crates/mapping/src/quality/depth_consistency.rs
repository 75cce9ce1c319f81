//! How far apart the surfaces of overlapping depth images are, for given poses. Needs no truth.
//!
//! Points of one image are projected into the other; where they fall onto a surface there, their distance to the plane
//! through that pixel's surroundings counts. What is farther away than the gate is another surface (or hides behind
//! one) and does not count. Every pair is measured both ways.

use super::quantile;
use crate::normals::{NormalWindow, SurfacePatch, surface_patches};
use crate::rays::Rays;
use crate::{DepthFilter, Error, View};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::Point3;

/// How pairs of depth images are compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthConsistencyOptions {
    /// Which depth pixels are valid.
    pub filter: DepthFilter,
    /// Farther apart than this along the depth axis, metres, are two different surfaces.
    pub gate_m: f64,
    /// Every how many pixels along each axis a point is taken.
    pub stride: usize,
    /// Pairs with fewer points in common do not overlap.
    pub min_points: usize,
    /// Of the points taken, every how many along each axis is listed one by one in [`DepthConsistency::samples`]; 0 for
    /// none.
    pub sample_every: usize,
}

impl Default for DepthConsistencyOptions {
    fn default() -> Self {
        DepthConsistencyOptions {
            filter: DepthFilter::default(),
            gate_m: 0.1,
            stride: 6,
            min_points: 200,
            sample_every: 0,
        }
    }
}

/// How far apart two views' surfaces are.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairConsistency {
    /// Index of the first view.
    pub first: usize,
    /// Index of the second view.
    pub second: usize,
    /// Points that were compared, both ways together.
    pub points: usize,
    /// Median distance, metres.
    pub median_m: f64,
    /// 90th percentile, metres.
    pub p90_m: f64,
}

/// All pairs that overlap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DepthConsistency {
    /// By first, then second view.
    pub pairs: Vec<PairConsistency>,
    /// Median of all distances of all pairs, metres; none without pairs.
    pub median_m: Option<f64>,
    /// 90th percentile of all distances of all pairs, metres; none without pairs.
    pub p90_m: Option<f64>,
    /// Points one by one, by view, then pixel; see [`DepthConsistencyOptions::sample_every`].
    pub samples: Vec<PointToPlaneSample>,
}

/// One point of a view, and how far the others' surfaces are from it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointToPlaneSample {
    /// Index of the view.
    pub view: usize,
    /// Place of the pixel in the depth image, row by row.
    pub pixel: usize,
    /// Where the view's pose puts it, metres.
    pub point_in_base: [f32; 3],
    /// Median distance to the surfaces of the other views that show it, metres; none where no other does.
    pub median_m: Option<f32>,
}

/// Compares all pairs of views. Memory: a few bytes a strided pixel of a view and of a pair.
pub fn depth_consistency(views: &[View<'_>], options: &DepthConsistencyOptions) -> Result<DepthConsistency, Error> {
    options.filter.check()?;
    if !(options.gate_m.is_finite() && options.gate_m > 0.0) {
        let value = options.gate_m.to_string();
        return Err(Error::Option { option: "gate_m", value, need: "a positive length is needed" });
    }
    if options.stride == 0 {
        return Err(Error::Option { option: "stride", value: "0".into(), need: "at least 1 is needed" });
    }
    views.iter().try_for_each(View::check)?;
    let mut rays: Option<Rays> = None;
    let mut taken = Vec::with_capacity(views.len());
    for view in views {
        let rays = rays_of(&mut rays, view);
        taken.push(points_in_base(view, rays, options));
    }
    let mut samples = Samples::new(views, &taken, options);
    // Distances by pair; the pair (i, j) with i < j is at i * n + j.
    let mut distances: Vec<Vec<f32>> = vec![Vec::new(); views.len() * views.len()];
    for (target, view) in views.iter().enumerate() {
        let surface = Target::new(view, rays_of(&mut rays, view), options);
        let found: Vec<Vec<f32>> = taken
            .par_iter()
            .enumerate()
            .map(|(source, points)| if source == target { Vec::new() } else { surface.distances(points) })
            .collect();
        for (source, list) in found.into_iter().enumerate() {
            samples.add(source, &list);
            let seen = list.into_iter().filter(|distance| !distance.is_nan());
            distances[source.min(target) * views.len() + source.max(target)].extend(seen);
        }
    }
    let mut pairs = Vec::new();
    let mut all = Vec::new();
    for (place, list) in distances.iter_mut().enumerate() {
        if list.len() < options.min_points.max(1) {
            continue;
        }
        let (first, second) = (place / views.len(), place % views.len());
        let (Some(median_m), Some(p90_m)) = (quantile(list, 0.5), quantile(list, 0.9)) else { continue };
        pairs.push(PairConsistency { first, second, points: list.len(), median_m, p90_m });
        all.extend_from_slice(list);
    }
    let samples = samples.finish(&taken);
    Ok(DepthConsistency { pairs, median_m: quantile(&mut all, 0.5), p90_m: quantile(&mut all, 0.9), samples })
}

/// The points that are listed one by one, and the distances found for them so far.
struct Samples {
    /// View by view, places in the list of its points.
    places: Vec<Vec<usize>>,
    distances: Vec<Vec<Vec<f32>>>,
}

impl Samples {
    fn new(views: &[View<'_>], taken: &[Vec<(usize, Point3)>], options: &DepthConsistencyOptions) -> Self {
        let step = options.stride * options.sample_every;
        let on_grid = |view: &View<'_>, pixel: usize| {
            let width = view.depth_camera.camera.width as usize;
            step > 0 && (pixel % width).is_multiple_of(step) && (pixel / width).is_multiple_of(step)
        };
        let places: Vec<Vec<usize>> = views
            .iter()
            .zip(taken)
            .map(|(view, points)| (0..points.len()).filter(|&place| on_grid(view, points[place].0)).collect())
            .collect();
        let distances = places.iter().map(|places| vec![Vec::new(); places.len()]).collect();
        Samples { places, distances }
    }

    /// Distances of all points of a view to the surface of another; NaN where there is none.
    fn add(&mut self, view: usize, found: &[f32]) {
        for (&place, list) in self.places[view].iter().zip(&mut self.distances[view]) {
            list.extend(found.get(place).filter(|distance| !distance.is_nan()));
        }
    }

    fn finish(mut self, taken: &[Vec<(usize, Point3)>]) -> Vec<PointToPlaneSample> {
        let mut samples = Vec::new();
        for (view, places) in self.places.iter().enumerate() {
            for (&place, list) in places.iter().zip(&mut self.distances[view]) {
                let (pixel, point) = taken[view][place];
                let median_m = quantile(list, 0.5).map(|median_m| median_m as f32);
                samples.push(PointToPlaneSample {
                    view,
                    pixel,
                    point_in_base: point.coords.cast::<f32>().into(),
                    median_m,
                });
            }
        }
        samples
    }
}

fn rays_of<'a>(kept: &'a mut Option<Rays>, view: &View<'_>) -> &'a Rays {
    let camera = &view.depth_camera.camera;
    if !kept.as_ref().is_some_and(|rays| rays.are_of(camera)) {
        *kept = None;
    }
    kept.get_or_insert_with(|| Rays::new(camera))
}

/// Pixels on the grid that are valid, and where the pose puts them.
fn points_in_base(view: &View<'_>, rays: &Rays, options: &DepthConsistencyOptions) -> Vec<(usize, Point3)> {
    let depth = view.valid_depth_along(&options.filter, rays);
    let width = rays.width();
    let base_from_depth = view.base_from_depth();
    (0..depth.len() / width.max(1))
        .step_by(options.stride)
        .flat_map(|y| (0..width).step_by(options.stride).map(move |x| y * width + x))
        .filter(|&index| depth[index] > 0.0)
        .map(|index| (index, base_from_depth * rays.point(index, depth[index])))
        .collect()
}

/// A view that points are projected into.
struct Target<'a> {
    view: &'a View<'a>,
    patches: Vec<SurfacePatch>,
    rays: &'a Rays,
    gate_m: f64,
}

impl<'a> Target<'a> {
    fn new(view: &'a View<'a>, rays: &'a Rays, options: &DepthConsistencyOptions) -> Self {
        let depth = view.valid_depth_along(&options.filter, rays);
        let window = NormalWindow::of_maps(1);
        let patches = surface_patches(&depth, rays, &options.filter, window);
        Target { view, patches, rays, gate_m: options.gate_m }
    }

    /// One a point; NaN where the view shows no surface near it.
    fn distances(&self, points_in_base: &[(usize, Point3)]) -> Vec<f32> {
        let camera = &self.view.depth_camera.camera;
        let depth_from_base = self.view.base_from_depth().inverse();
        let distance = |point: &Point3| {
            let point = depth_from_base * point;
            let pixel = camera.project(&point)?;
            let (x, y) = (pixel.x.round(), pixel.y.round());
            if !(x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height)) {
                return None;
            }
            let index = y as usize * camera.width as usize + x as usize;
            let SurfacePatch { normal, depth } = self.patches[index];
            let normal = normal.cast::<f64>();
            if depth <= 0.0 || normal.norm_squared() == 0.0 || (f64::from(depth) - point.z).abs() > self.gate_m {
                return None;
            }
            let on_surface = self.rays.point(index, depth);
            Some(normal.dot(&(point - on_surface)).abs() as f32)
        };
        points_in_base.iter().map(|(_, point)| distance(point).unwrap_or(f32::NAN)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tsdf::tests::wall;
    use crate::view::tests::{plain_camera, view};
    use skclam_geometry::Isometry3;

    #[test]
    fn a_wall_seen_twice_is_as_far_apart_as_the_pose_is_wrong() {
        let camera = plain_camera(120, 90);
        let depth = wall(120, 90, 1.0);
        let first = view(&depth, &camera);
        // It moved 5 cm sideways, and says it came 7 mm nearer, which it did not.
        let second = View { base_from_color: Isometry3::translation(0.05, 0.0, 0.007), ..first };
        let away = View { base_from_color: Isometry3::translation(50.0, 0.0, 0.0), ..first };
        let found = depth_consistency(&[first, second, away], &DepthConsistencyOptions::default()).unwrap();
        assert_eq!(found.pairs.len(), 1, "the third one sees another wall");
        let pair = found.pairs[0];
        assert_eq!((pair.first, pair.second), (0, 1));
        assert!((pair.median_m - 0.007).abs() < 1e-4 && (pair.p90_m - 0.007).abs() < 1e-4);
        assert_eq!(found.median_m, Some(pair.median_m));
        assert!(found.samples.is_empty());
        let options = DepthConsistencyOptions { sample_every: 2, ..Default::default() };
        let samples = depth_consistency(&[first, second, away], &options).unwrap().samples;
        assert_eq!(samples.len(), 3 * 10 * 8, "every twelfth pixel along each axis");
        for sample in &samples {
            assert!(sample.median_m.is_none_or(|median_m| (median_m - 0.007).abs() < 1e-4), "{sample:?}");
        }
        assert!(samples.iter().filter(|sample| sample.view < 2 && sample.median_m.is_some()).count() > 100);
        assert!(samples.iter().filter(|sample| sample.view == 2).all(|sample| sample.median_m.is_none()));
        assert!((samples[13].point_in_base[2] - 1.0).abs() < 1e-6);
    }

    #[test]
    fn without_overlap_there_is_no_distance_and_bad_options_are_errors() {
        let camera = plain_camera(24, 18);
        let holes = wall(24, 18, 0.0);
        let views = [view(&holes, &camera); 2];
        let found = depth_consistency(&views, &DepthConsistencyOptions::default()).unwrap();
        assert_eq!((found.pairs.len(), found.median_m), (0, None));
        assert!(depth_consistency(&views, &DepthConsistencyOptions { stride: 0, ..Default::default() }).is_err());
        assert!(
            depth_consistency(&views, &DepthConsistencyOptions { gate_m: f64::NAN, ..Default::default() }).is_err()
        );
        let mut bad = views;
        bad[1].base_from_color.translation.x = f64::NAN;
        assert!(depth_consistency(&bad, &DepthConsistencyOptions::default()).is_err());
    }
}
