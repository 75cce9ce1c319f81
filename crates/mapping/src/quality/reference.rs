//! A map against a reference surface: accuracy, completeness and F-score (Knapitsch et al. 2017, Tanks and Temples).
//!
//! Both surfaces are sampled evenly by area (clouds by their points) and every sample is measured exactly against the
//! other one's triangles. Completeness asks only for what was observed: samples of the reference that some view shows
//! at their depth and that the reference itself does not hide from it.

use super::quantile;
use crate::{DepthFilter, Error, Model, SurfaceIndex, View};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::Point3;

/// Distances at which fractions and F-scores are reported, metres.
pub const SCORE_THRESHOLDS_M: [f64; 3] = [0.005, 0.010, 0.020];

/// Most samples of a surface: more say nothing more.
const MAX_SAMPLES: usize = 5_000_000;

/// Closer before a sample than this, metres, its own triangle and its neighbours are met.
const HIDING_CLEARANCE_M: f32 = 0.003;

/// How a map is compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReferenceOptions {
    /// Which depth pixels count as an observation.
    pub filter: DepthFilter,
    /// Spacing of the samples on triangles, metres.
    pub spacing_m: f64,
    /// Distances beyond this count as this, metres.
    pub limit_m: f64,
    /// A sample is observed if a view's depth there agrees with it up to this plus four sigma of the depth noise,
    /// metres.
    pub observed_within_m: f64,
}

impl Default for ReferenceOptions {
    fn default() -> Self {
        ReferenceOptions { filter: DepthFilter::default(), spacing_m: 0.01, limit_m: 0.25, observed_within_m: 0.01 }
    }
}

/// A list of distances in few numbers; metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DistanceSummary {
    /// Number of samples.
    pub samples: usize,
    /// Mean (distances beyond the limit count as the limit).
    pub mean_m: f64,
    /// Median.
    pub median_m: f64,
    /// 90th percentile.
    pub p90_m: f64,
    /// Fraction of samples within each of [`SCORE_THRESHOLDS_M`].
    pub within: [f64; 3],
}

/// A map against a reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SurfaceScore {
    /// From the map to the reference: how true what is there is.
    pub accuracy: DistanceSummary,
    /// From the observed part of the reference to the map: how much of it is there.
    pub completeness: DistanceSummary,
    /// Harmonic mean of both fractions within each of [`SCORE_THRESHOLDS_M`].
    pub f_score: [f64; 3],
    /// Fraction of the reference's samples that some view observed.
    pub observed: f64,
}

/// Compares a map with a reference surface. `views` (at poses in the reference's frame) decide what was observed;
/// without any, all of the reference counts.
pub fn score_surface(
    map: &Model,
    reference: &Model,
    views: &[View<'_>],
    options: &ReferenceOptions,
) -> Result<SurfaceScore, Error> {
    options.filter.check()?;
    for (option, value) in [("spacing_m", options.spacing_m), ("limit_m", options.limit_m)] {
        if !(value.is_finite() && value > 0.0) {
            return Err(Error::Option { option, value: value.to_string(), need: "a positive length is needed" });
        }
    }
    views.iter().try_for_each(View::check)?;
    let to_reference = SurfaceIndex::new(reference)?;
    let to_map = SurfaceIndex::new(map)?;
    let accuracy = summary(&to_reference, &samples(map, options.spacing_m), options.limit_m)?;
    let all = samples(reference, options.spacing_m);
    let observed = if views.is_empty() { all.clone() } else { observed(&all, &to_reference, views, options) };
    let completeness = summary(&to_map, &observed, options.limit_m)?;
    let f_score = std::array::from_fn(|index| {
        let (precision, recall) = (accuracy.within[index], completeness.within[index]);
        if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 }
    });
    Ok(SurfaceScore { accuracy, completeness, f_score, observed: observed.len() as f64 / all.len() as f64 })
}

fn summary(index: &SurfaceIndex, samples: &[[f32; 3]], limit_m: f64) -> Result<DistanceSummary, Error> {
    let limit = limit_m as f32;
    let mut distances: Vec<f32> =
        samples.par_iter().map(|sample| index.distance(*sample, limit).unwrap_or(limit)).collect();
    let count = distances.len();
    let (Some(median_m), Some(p90_m)) = (quantile(&mut distances, 0.5), quantile(&mut distances, 0.9)) else {
        return Err(Error::Empty {
            what: "the observed part of the reference surface",
            advice: "check that the poses and the reference are in the same frame and unit (metres)",
        });
    };
    let within = SCORE_THRESHOLDS_M
        .map(|threshold| distances.iter().filter(|d| f64::from(**d) <= threshold).count() as f64 / count as f64);
    let mean_m = distances.iter().map(|d| f64::from(*d)).sum::<f64>() / count as f64;
    Ok(DistanceSummary { samples: count, mean_m, median_m, p90_m, within })
}

/// Points spread evenly over the triangles, or the points themselves; the same every time.
fn samples(model: &Model, spacing_m: f64) -> Vec<[f32; 3]> {
    let points = &model.points().points;
    if model.triangles().is_empty() {
        let stride = points.len().div_ceil(MAX_SAMPLES).max(1);
        return points.iter().step_by(stride).copied().collect();
    }
    let corners = |triangle: &[u32; 3]| triangle.map(|corner| Vector3::from(points[corner as usize]).cast::<f64>());
    let area = |triangle: &[u32; 3]| {
        let [a, b, c] = corners(triangle);
        0.5 * (b - a).cross(&(c - a)).norm()
    };
    let total: f64 = model.triangles().iter().map(area).sum();
    let per_sample = (spacing_m * spacing_m).max(total / MAX_SAMPLES as f64);
    let mut samples = Vec::with_capacity((total / per_sample) as usize + 1);
    let mut owed = 0.5;
    // Additive recurrence with the plastic number: even in two dimensions (Roberts 2018).
    let (mut u, mut v) = (0.5f64, 0.5f64);
    for triangle in model.triangles() {
        owed += area(triangle) / per_sample;
        let [a, b, c] = corners(triangle);
        while owed >= 1.0 {
            owed -= 1.0;
            u = (u + 0.754_877_666_246_692_8).fract();
            v = (v + 0.569_840_290_998_053_3).fract();
            let (s, t) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
            samples.push((a + (b - a) * s + (c - a) * t).cast::<f32>().into());
        }
    }
    samples
}

fn observed(
    samples: &[[f32; 3]],
    reference: &SurfaceIndex,
    views: &[View<'_>],
    options: &ReferenceOptions,
) -> Vec<[f32; 3]> {
    let mut seen = vec![false; samples.len()];
    for view in views {
        let depth = view.valid_depth(&options.filter);
        let camera = &view.depth_camera.camera;
        let depth_from_base = view.base_from_depth().inverse();
        let eye: [f32; 3] = view.base_from_depth().translation.vector.cast::<f32>().into();
        seen.par_iter_mut().zip(samples).for_each(|(seen, sample)| {
            if *seen {
                return;
            }
            let point = depth_from_base * Point3::from(sample.map(f64::from));
            let Some(pixel) = camera.project(&point).filter(|pixel| camera.contains(pixel)) else { return };
            let (x, y) = (pixel.x.round().max(0.0) as u32, pixel.y.round().max(0.0) as u32);
            let (x, y) = (x.min(camera.width - 1), y.min(camera.height - 1));
            let depth = f64::from(depth[(y * camera.width + x) as usize]);
            let tolerance = options.observed_within_m + 4.0 * options.filter.noise.sigma(depth);
            // Within the noise lie also the backs of thin things, which no view shows.
            *seen = depth > 0.0
                && (depth - point.z).abs() <= tolerance
                && !reference.hides(eye, *sample, HIDING_CLEARANCE_M);
        });
    }
    samples.iter().zip(seen).filter(|(_, seen)| *seen).map(|(sample, _)| *sample).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tsdf::tests::wall;
    use crate::view::tests::{plain_camera, view};
    use crate::{PointCloud, TriangleMesh};

    /// A square of 2 m at z, its edges along x and y.
    fn square(z: f32) -> Model {
        let points = vec![[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]];
        let vertices = PointCloud { points, ..Default::default() };
        TriangleMesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }.into()
    }

    #[test]
    fn a_shifted_square_is_as_far_away_as_it_was_shifted() {
        let score = score_surface(&square(0.007), &square(0.0), &[], &ReferenceOptions::default()).unwrap();
        assert!((score.accuracy.median_m - 0.007).abs() < 1e-6);
        assert!((score.completeness.p90_m - 0.007).abs() < 1e-6);
        assert_eq!(score.f_score, [0.0, 1.0, 1.0]);
        assert_eq!(score.observed, 1.0);
        assert!((39_000..41_000).contains(&score.accuracy.samples), "4 m2 at 1 cm: {}", score.accuracy.samples);
    }

    #[test]
    fn half_of_the_surface_is_half_complete_and_wholly_accurate() {
        let Model::Mesh(mut half) = square(0.0) else { panic!("a mesh") };
        half.triangles.pop();
        let score = score_surface(&half.into(), &square(0.0), &[], &ReferenceOptions::default()).unwrap();
        assert_eq!(score.accuracy.within, [1.0; 3]);
        assert!((score.completeness.within[0] - 0.5).abs() < 0.01);
        assert!((score.f_score[0] - 2.0 / 3.0).abs() < 0.01);
    }

    #[test]
    fn only_what_a_view_shows_is_asked_for() {
        let camera = plain_camera(100, 50);
        let depth = wall(100, 50, 1.0);
        let score = score_surface(&square(1.0), &square(1.0), &[view(&depth, &camera)], &Default::default()).unwrap();
        // At 1 m the camera sees 2 tan(0.5 rad) wide and half as high of 4 m2.
        let expected = (2.0 * 0.5f64.tan()).powi(2) / 2.0 / 4.0;
        assert!((score.observed - expected).abs() < 0.01, "{} {expected}", score.observed);
        let elsewhere = score_surface(&square(1.0), &square(3.0), &[view(&depth, &camera)], &Default::default());
        assert!(matches!(elsewhere, Err(Error::Empty { .. })));
    }
}
