//! Which depth pixels are valid, and how noisy they are.

use crate::Error;
use serde::{Deserialize, Serialize};

/// How the standard deviation of a depth camera grows with the depth: `sigma = floor_m + depth_sigma_per_m2 z^2`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthNoise {
    /// The part that grows with the square of the depth, 1/m; triangulating cameras have about 0.001 to 0.004.
    pub depth_sigma_per_m2: f64,
    /// The part that is always there, metres.
    pub floor_m: f64,
}

impl Default for DepthNoise {
    fn default() -> Self {
        DepthNoise { depth_sigma_per_m2: 0.003, floor_m: 0.0003 }
    }
}

impl DepthNoise {
    /// Standard deviation at a depth, both in metres.
    pub fn sigma(&self, depth_m: f64) -> f64 {
        self.floor_m + self.depth_sigma_per_m2 * depth_m * depth_m
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        for (option, value) in [("noise.depth_sigma_per_m2", self.depth_sigma_per_m2), ("noise.floor_m", self.floor_m)]
        {
            if !(value.is_finite() && (0.0..=1.0).contains(&value)) {
                return Err(Error::Option { option, value: value.to_string(), need: "between 0 and 1 is needed" });
            }
        }
        if self.sigma(1.0) <= 0.0 {
            return Err(Error::Option {
                option: "noise",
                value: "0".into(),
                need: "at least one of depth_sigma_per_m2 and floor_m must be positive",
            });
        }
        Ok(())
    }
}

/// Which depth pixels are valid.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthFilter {
    /// Nearest depth, metres.
    pub min_depth_m: f64,
    /// Farthest depth, metres; beyond it the noise of usual cameras exceeds what a map can use.
    pub max_depth_m: f64,
    /// Pixels this close to a depth discontinuity are dropped, since cameras blend both sides there ("flying pixels");
    /// 0 keeps them.
    pub edge_margin_px: u32,
    /// Neighbours whose depths differ by more than this fraction of the depth, and four sigma of their noise on top,
    /// lie on different surfaces.
    pub edge_step: f64,
    /// The noise of the depth camera.
    pub noise: DepthNoise,
}

impl Default for DepthFilter {
    fn default() -> Self {
        DepthFilter {
            min_depth_m: 0.05,
            max_depth_m: 4.0,
            edge_margin_px: 1,
            edge_step: 0.02,
            noise: DepthNoise::default(),
        }
    }
}

impl DepthFilter {
    pub(crate) fn check(&self) -> Result<(), Error> {
        self.noise.check()?;
        if !(self.min_depth_m >= 0.0 && self.max_depth_m > self.min_depth_m && self.max_depth_m.is_finite()) {
            return Err(Error::Option {
                option: "min_depth_m, max_depth_m",
                value: format!("{}, {}", self.min_depth_m, self.max_depth_m),
                need: "0 <= min_depth_m < max_depth_m is needed",
            });
        }
        if !(self.edge_step > 0.0 && self.edge_step.is_finite()) {
            return Err(Error::Option {
                option: "edge_step",
                value: self.edge_step.to_string(),
                need: "a positive fraction of the depth is needed",
            });
        }
        if self.edge_margin_px > 64 {
            return Err(Error::Option {
                option: "edge_margin_px",
                value: self.edge_margin_px.to_string(),
                need: "at most 64 pixels make sense",
            });
        }
        Ok(())
    }

    /// Coefficients of depth, 1 and squared depth in the largest difference between neighbours on one surface.
    pub(crate) fn step_coefficients(&self) -> (f32, f32, f32) {
        let sigmas = 4.0 * std::f64::consts::SQRT_2;
        let DepthNoise { depth_sigma_per_m2, floor_m } = self.noise;
        (self.edge_step as f32, (sigmas * floor_m) as f32, (sigmas * depth_sigma_per_m2) as f32)
    }
}
