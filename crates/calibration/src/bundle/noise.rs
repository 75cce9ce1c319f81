//! The noise of pixels, depths and joints, estimated from what is left of the residuals.
//!
//! Simplified estimation of variance components (Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und
//! Kovarianzkomponenten", 1979): the squared residuals of a kind, divided by the degrees of freedom that the fit leaves
//! them. Residuals beyond a gate are left out and the truncation is corrected.

use crate::bundle::residuals::ResidualSize;
use crate::bundle::state::NoiseScales;
use crate::robust::{median, quantile};
use crate::{Loss, PostureFit, ReprojectionStatistics};

/// Pixel residuals (two coordinates) beyond so many sigmas carry no information about the noise.
const PIXEL_GATE: f64 = 4.5;
/// Mean square over 2 of a two-dimensional normal within that radius: `1 - (g^2/2) e / (1 - e)`, `e = exp(-g^2/2)`.
const PIXEL_TRUNCATION: f64 = 0.999_59;
/// The same for one dimension: `1 - 2 g phi(g) / (2 Phi(g) - 1)`. The gates are wide because the residuals of a point
/// that two images show have fewer dimensions than two.
const DEPTH_GATE: f64 = 4.0;
const DEPTH_TRUNCATION: f64 = 0.998_93;
/// Beyond so many sigmas an observation is called an outlier.
pub(crate) const OUTLIER_SIGMAS: f64 = 4.5;
/// Noise below this is taken for rounding.
const EXACT_PX: f64 = 1e-6;
const EXACT_DEPTH: f64 = 1e-8;

/// New scales from residuals measured with the old ones. `dof`: fraction of all degrees of freedom that the global
/// unknowns leave.
pub(crate) fn rescaled(sizes: &[ResidualSize], old: &NoiseScales, dof: f64) -> NoiseScales {
    let pixels: Vec<(f64, f64)> =
        sizes.iter().filter(|s| s.pixel.is_finite()).map(|s| (s.pixel, 0.5 * s.pixel_dof)).collect();
    // A third of a two-dimensional normal lies within 0.9005 sigma, a third of a one-dimensional one within 0.4307.
    let pixel = component(&pixels, 0.9005, PIXEL_GATE, 2.0 * PIXEL_TRUNCATION);
    let depths: Vec<(f64, f64)> = sizes.iter().filter_map(|s| s.depth).map(|(u, f)| (u.abs(), f)).collect();
    let depth = component(&depths, 0.4307, DEPTH_GATE, DEPTH_TRUNCATION);
    let fraction = dof.max(1e-3).sqrt();
    NoiseScales {
        pixel: (old.pixel * pixel / fraction).max(EXACT_PX),
        depth: if depths.is_empty() { old.depth } else { (old.depth * depth / fraction).max(EXACT_DEPTH) },
        posture: old.posture,
    }
}

/// Scale of residuals `(size, fraction of its degrees of freedom)`: the smallest third first, then the fixed point
/// within the gate.
fn component(residuals: &[(f64, f64)], third_of_one: f64, gate: f64, mean_square: f64) -> f64 {
    // An observation that its own point absorbs carries no information.
    let used: Vec<(f64, f64)> = residuals.iter().copied().filter(|(_, dof)| *dof > 0.02).collect();
    let mut sizes: Vec<f64> = used.iter().map(|(size, dof)| size / dof.sqrt()).collect();
    if sizes.is_empty() {
        return 1.0;
    }
    let mut scale = quantile(&mut sizes, 1.0 / 3.0) / third_of_one;
    for _ in 0..30 {
        let (mut sum, mut dof) = (0.0, 0.0);
        for (size, fraction) in &used {
            if *size < gate * scale * fraction.sqrt() {
                sum += size * size;
                dof += fraction;
            }
        }
        if dof == 0.0 {
            break;
        }
        let next = (sum / (dof * mean_square)).sqrt();
        let settled = (next - scale).abs() <= 1e-5 * scale;
        scale = next;
        if settled {
            break;
        }
    }
    scale
}

/// How a robust loss is weighted against a quadratic prior.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LossCorrection {
    /// By how much the covariance of the M-estimator exceeds the inverse of its weighted normal matrix (Huber and
    /// Ronchetti, "Robust Statistics", 2009, section 7.6): `mean(psi^2) mean(w) / mean(psi')^2`.
    pub efficiency_factor: f64,
    /// `mean(psi^2) / mean(psi')`. A likelihood's score varies as much as it bends; that of a loss which bends more
    /// than its score varies would outshout a prior, so that the prior is weighted with the same ratio. The variance of
    /// joint errors would else come out too small.
    pub prior_weight: f64,
}

impl LossCorrection {
    /// Before residuals are known, and for least squares: a likelihood.
    pub(crate) const EVEN: LossCorrection = LossCorrection { efficiency_factor: 1.0, prior_weight: 1.0 };

    /// Residuals of two dimensions bend with the mean of `psi'` and `psi / u`.
    pub(crate) fn of(sizes: &[ResidualSize], loss: Loss) -> LossCorrection {
        let (mut psi2, mut weight, mut curvature) = (0.0, 0.0, 0.0);
        let (mut dof, mut count) = (0.0, 0.0);
        let mut add = |u: f64, dimensions: f64, fraction: f64| {
            let (w, c) = (loss.weight(u), loss.curvature(u));
            psi2 += (w * u).powi(2);
            weight += dimensions * w;
            curvature += if dimensions > 1.0 { w + c } else { c };
            dof += fraction;
            count += dimensions;
        };
        for size in sizes.iter().filter(|s| s.pixel < OUTLIER_SIGMAS) {
            add(size.pixel, 2.0, size.pixel_dof);
            if let Some((u, fraction)) = size.depth.filter(|(u, _)| u.abs() < OUTLIER_SIGMAS) {
                add(u, 1.0, fraction);
            }
        }
        if dof <= 0.0 || curvature <= 0.0 {
            return LossCorrection::EVEN;
        }
        let (psi2, weight, curvature) = (psi2 / dof, weight / count, curvature / count);
        LossCorrection {
            efficiency_factor: (psi2 * weight / (curvature * curvature)).max(0.5),
            prior_weight: (psi2 / curvature).clamp(0.5, 2.0),
        }
    }
}

/// Distances in px over all observations.
pub(crate) fn statistics(sizes: &[ResidualSize]) -> ReprojectionStatistics {
    let mut distances: Vec<f64> = sizes.iter().map(ResidualSize::distance_px).collect();
    let (mut sum, mut inliers) = (0.0, 0usize);
    for size in sizes.iter().filter(|s| s.pixel < OUTLIER_SIGMAS) {
        sum += size.residual_px.norm_squared();
        inliers += 1;
    }
    ReprojectionStatistics {
        rms_px: if inliers == 0 { 0.0 } else { (sum / inliers as f64).sqrt() },
        median_px: median(&mut distances),
        observations: sizes.len(),
        inliers,
    }
}

/// How well each posture fits.
pub(crate) fn posture_fits(sizes: &[ResidualSize], postures: usize) -> Vec<PostureFit> {
    let mut of_posture: Vec<Vec<f64>> = vec![Vec::new(); postures];
    sizes.iter().for_each(|s| of_posture[s.posture as usize].push(s.pixel));
    of_posture
        .iter_mut()
        .map(|sizes| PostureFit {
            observations: sizes.len(),
            outliers: sizes.iter().filter(|u| **u >= OUTLIER_SIGMAS).count(),
            median_sigmas: median(sizes),
        })
        .collect()
}
