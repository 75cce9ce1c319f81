//! Robust loss functions and the scale of noise, estimated from residuals.
//!
//! Huber and Ronchetti, "Robust Statistics", 2nd ed., 2009: M-estimators of location and scale, and their asymptotic
//! variance.

use serde::{Deserialize, Serialize};

/// A loss `rho(u)` of a residual `u` in units of its sigma; `rho(u) ~ u^2 / 2` near zero. The constants are in sigmas.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Least squares.
    Squared,
    /// Linear beyond the constant.
    Huber(f64),
    /// `c^2/2 log(1 + u^2/c^2)`.
    Cauchy(f64),
    /// `u^2/2 / (1 + u^2/c^2)`: outliers lose all influence.
    GemanMcClure(f64),
    /// Tukey's biweight: constant beyond `c`, and 99 % efficient on Gaussian noise at `c = 7`.
    Tukey(f64),
}

impl Loss {
    /// `rho`.
    pub fn rho(self, u: f64) -> f64 {
        let u2 = u * u;
        match self {
            Loss::Squared => 0.5 * u2,
            Loss::Huber(c) if u.abs() <= c => 0.5 * u2,
            Loss::Huber(c) => c * (u.abs() - 0.5 * c),
            Loss::Cauchy(c) => 0.5 * c * c * (u2 / (c * c)).ln_1p(),
            Loss::GemanMcClure(c) => 0.5 * u2 / (1.0 + u2 / (c * c)),
            Loss::Tukey(c) => {
                let inside = (1.0 - u2 / (c * c)).max(0.0);
                c * c / 6.0 * (1.0 - inside * inside * inside)
            }
        }
    }

    /// `psi(u) / u`, the weight of iteratively reweighted least squares: 1 at zero.
    pub fn weight(self, u: f64) -> f64 {
        let u2 = u * u;
        match self {
            Loss::Squared => 1.0,
            Loss::Huber(c) if u.abs() <= c => 1.0,
            Loss::Huber(c) => c / u.abs(),
            Loss::Cauchy(c) => 1.0 / (1.0 + u2 / (c * c)),
            Loss::GemanMcClure(c) => (1.0 + u2 / (c * c)).powi(-2),
            Loss::Tukey(c) => (1.0 - u2 / (c * c)).max(0.0).powi(2),
        }
    }

    /// `psi'(u)`.
    pub fn curvature(self, u: f64) -> f64 {
        let u2 = u * u;
        match self {
            Loss::Squared => 1.0,
            Loss::Huber(c) => f64::from(u.abs() <= c),
            Loss::Cauchy(c) => (1.0 - u2 / (c * c)) / (1.0 + u2 / (c * c)).powi(2),
            Loss::GemanMcClure(c) => (1.0 - 3.0 * u2 / (c * c)) / (1.0 + u2 / (c * c)).powi(3),
            Loss::Tukey(c) => {
                let inside = (1.0 - u2 / (c * c)).max(0.0);
                inside * (1.0 - 5.0 * u2 / (c * c))
            }
        }
    }

    /// The same loss with a constant `factor` times as large.
    #[must_use]
    pub fn widened(self, factor: f64) -> Self {
        match self {
            Loss::Squared => Loss::Squared,
            Loss::Huber(c) => Loss::Huber(c * factor),
            Loss::Cauchy(c) => Loss::Cauchy(c * factor),
            Loss::GemanMcClure(c) => Loss::GemanMcClure(c * factor),
            Loss::Tukey(c) => Loss::Tukey(c * factor),
        }
    }
}

/// Median; 0 of nothing. Reorders its argument.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    let upper = *values.select_nth_unstable_by(middle, f64::total_cmp).1;
    if values.len() % 2 == 1 {
        return upper;
    }
    let lower = values[..middle].iter().copied().fold(f64::NEG_INFINITY, f64::max);
    0.5 * (lower + upper)
}

/// Value below which `fraction` of the values lie; 0 of nothing. Reorders its argument.
pub(crate) fn quantile(values: &mut [f64], fraction: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() as f64 * fraction) as usize).min(values.len() - 1);
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

/// Sigma by the third of the residuals that are smallest, so that up to six in ten may be anything; coarse.
pub(crate) fn coarse_scale(residuals: &[f64]) -> f64 {
    // A third of a standard normal lies within 0.4307.
    quantile(&mut residuals.iter().map(|r| r.abs()).collect::<Vec<_>>(), 1.0 / 3.0) / 0.430_727
}

/// Beyond so many sigmas a residual carries no information about the noise.
const TRUNCATION: f64 = 2.5;
/// Variance of a standard normal truncated there: `1 - 2 c phi(c) / (2 Phi(c) - 1)`.
const TRUNCATED_VARIANCE: f64 = 0.911_256;

/// Sigma of the noise under residuals of which up to nearly half may be anything: [`coarse_scale`], then the fixed
/// point of the standard deviation within 2.5 sigma, corrected for the truncation. 0 of nothing.
pub(crate) fn noise_scale(residuals: &[f64]) -> f64 {
    let sizes: Vec<f64> = residuals.iter().map(|r| r.abs()).collect();
    let mut sigma = coarse_scale(residuals);
    for _ in 0..50 {
        let (mut sum, mut count) = (0.0, 0usize);
        for r in sizes.iter().filter(|r| **r < TRUNCATION * sigma) {
            sum += r * r;
            count += 1;
        }
        if count == 0 {
            break;
        }
        let next = (sum / count as f64 / TRUNCATED_VARIANCE).sqrt();
        let settled = (next - sigma).abs() <= 1e-6 * sigma;
        sigma = next;
        if settled {
            break;
        }
    }
    sigma
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{normal, seeded};
    use rand::RngExt;

    const ALL: [Loss; 5] =
        [Loss::Squared, Loss::Huber(1.5), Loss::Cauchy(2.0), Loss::GemanMcClure(3.0), Loss::Tukey(4.7)];

    #[test]
    fn weights_are_derivatives_of_the_loss() {
        for loss in ALL {
            for k in 1..60 {
                let u = 0.1 * f64::from(k) + 0.013;
                let step = 1e-5;
                let slope = (loss.rho(u + step) - loss.rho(u - step)) / (2.0 * step);
                assert!((slope - loss.weight(u) * u).abs() < 1e-7, "{loss:?} at {u}");
                let psi = |u: f64| loss.weight(u) * u;
                let curvature = (psi(u + step) - psi(u - step)) / (2.0 * step);
                assert!((curvature - loss.curvature(u)).abs() < 1e-6, "{loss:?} at {u}");
            }
        }
    }

    #[test]
    fn the_median_of_even_and_odd() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), 2.5);
        assert_eq!(median(&mut []), 0.0);
    }

    #[test]
    fn the_scale_of_noise_is_found_with_and_without_outliers() {
        let mut rng = seeded(3);
        let clean: Vec<f64> = (0..20000).map(|_| 0.7 * normal(&mut rng)).collect();
        assert!((noise_scale(&clean) / 0.7 - 1.0).abs() < 0.02);
        let dirty: Vec<f64> = clean
            .iter()
            .enumerate()
            .map(|(k, r)| if k % 5 < 2 { rng.random_range(-200.0..200.0) } else { *r })
            .collect();
        assert!((noise_scale(&dirty) / 0.7 - 1.0).abs() < 0.1, "{}", noise_scale(&dirty));
    }
}
