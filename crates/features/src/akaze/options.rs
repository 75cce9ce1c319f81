//! What a user may choose in AKAZE; the defaults are those of the reference implementation.

use crate::FeaturesError;
use serde::{Deserialize, Serialize};

/// How the conductivity falls with the gradient's magnitude `m`, in units of the contrast factor `k`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Diffusivity {
    /// Perona and Malik's first: `exp(-m^2 / k^2)`; favours high-contrast edges.
    PeronaMalikG1,
    /// Perona and Malik's second: `1 / (1 + m^2 / k^2)`; favours wide regions.
    #[default]
    PeronaMalikG2,
    /// Weickert's: `1 - exp(-3.315 / (m / k)^8)`; smooths inside of regions more than across.
    Weickert,
    /// Charbonnier's: `1 / sqrt(1 + m^2 / k^2)`.
    Charbonnier,
}

/// What the descriptor's grid is aligned with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Orientation {
    /// The main direction of the gradients around the keypoint: invariant to rotation of the image.
    #[default]
    Main,
    /// The image's axes: quicker and more distinctive where the camera does not roll; every angle is 0.
    Upright,
}

/// Who provides the threads. The result is the same either way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Threading {
    /// One image is cut into bands of rows, one for each thread of the current rayon pool.
    #[default]
    RowBands,
    /// Everything on the calling thread: for callers that work on one image a thread.
    Caller,
}

/// Settings of the detector and descriptor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AkazeOptions {
    /// Least response (determinant of the scale-normalised Hessian, grey levels in [0, 1]) of a keypoint.
    pub threshold: f32,
    /// Number of octaves at most; small images have fewer.
    pub octaves: usize,
    /// Number of scale levels an octave.
    pub sublevels: usize,
    /// Conductivity function of the nonlinear diffusion.
    pub diffusivity: Diffusivity,
    /// The contrast factor is this quantile of the gradient's magnitudes that are not nearly zero.
    pub contrast_percentile: f32,
    /// Standard deviation in pixels of the first level.
    pub base_sigma: f32,
    /// Ratio of the derivative filters' size to the level's standard deviation.
    pub derivative_factor: f32,
    /// What the descriptor's grid is aligned with.
    pub orientation: Orientation,
    /// Keep at most so many keypoints, the strongest but spread over the image; `None` keeps all.
    pub max_keypoints: Option<usize>,
    /// Who provides the threads.
    pub threading: Threading,
}

impl Default for AkazeOptions {
    fn default() -> Self {
        AkazeOptions {
            threshold: 0.001,
            octaves: 4,
            sublevels: 4,
            diffusivity: Diffusivity::PeronaMalikG2,
            contrast_percentile: 0.7,
            base_sigma: 1.6,
            derivative_factor: 1.5,
            orientation: Orientation::Main,
            max_keypoints: None,
            threading: Threading::RowBands,
        }
    }
}

impl AkazeOptions {
    /// Refuses what the method cannot work with.
    pub(crate) fn check(&self) -> Result<(), FeaturesError> {
        let wrong = |option, got: String, need| Err(FeaturesError::BadOption { option, got, need });
        if !(self.threshold > 0.0 && self.threshold.is_finite()) {
            return wrong("threshold", self.threshold.to_string(), "a positive finite number");
        }
        if !(1..=8).contains(&self.octaves) {
            return wrong("octaves", self.octaves.to_string(), "1 to 8");
        }
        if !(1..=16).contains(&self.sublevels) {
            return wrong("sublevels", self.sublevels.to_string(), "1 to 16");
        }
        if !(self.contrast_percentile > 0.0 && self.contrast_percentile < 1.0) {
            return wrong(
                "contrast_percentile",
                self.contrast_percentile.to_string(),
                "between 0 and 1, both excluded",
            );
        }
        if !(1.0..=3.0).contains(&self.base_sigma) {
            return wrong("base_sigma", self.base_sigma.to_string(), "1 to 3 pixels");
        }
        if !(0.5..=4.0).contains(&self.derivative_factor) {
            return wrong("derivative_factor", self.derivative_factor.to_string(), "0.5 to 4");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_accepted_and_nonsense_is_named() {
        assert_eq!(AkazeOptions::default().check(), Ok(()));
        let refused = |options: AkazeOptions, field: &str| match options.check() {
            Err(FeaturesError::BadOption { option, .. }) => assert_eq!(option, field),
            other => panic!("{field}: {other:?}"),
        };
        refused(AkazeOptions { threshold: f32::NAN, ..Default::default() }, "threshold");
        refused(AkazeOptions { threshold: 0.0, ..Default::default() }, "threshold");
        refused(AkazeOptions { octaves: 0, ..Default::default() }, "octaves");
        refused(AkazeOptions { sublevels: 17, ..Default::default() }, "sublevels");
        refused(AkazeOptions { contrast_percentile: 1.0, ..Default::default() }, "contrast_percentile");
        refused(AkazeOptions { base_sigma: 0.1, ..Default::default() }, "base_sigma");
        refused(AkazeOptions { derivative_factor: f32::INFINITY, ..Default::default() }, "derivative_factor");
    }
}
