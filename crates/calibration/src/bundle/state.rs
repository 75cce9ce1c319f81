//! What the bundle adjustment moves, and what it measures with.

use crate::bundle::view::{Frame, Scales, View};
use crate::motion::Motion;
use crate::{CalibrationError, Loss, Model};
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Point3};

/// Everything that moves.
#[derive(Debug, Clone)]
pub(crate) struct State {
    pub model: Model,
    /// Joint by joint, posture by posture; empty where deviations are off.
    pub deviations: Vec<f64>,
    /// One a track.
    pub points: Vec<Point3>,
    pub base_from_board: Option<Isometry3>,
    /// The cameras of the above.
    pub frames: Vec<Frame>,
}

impl State {
    pub(crate) fn refresh_frames(&mut self, motion: &Motion) -> Result<(), CalibrationError> {
        self.frames = motion.poses(&self.model, &self.deviations)?.iter().map(Frame::new).collect();
        Ok(())
    }

    pub(crate) fn view<'a>(&'a self, noise: &NoiseScales, loss: Loss) -> View<'a> {
        View {
            camera: &self.model.rig.color,
            frames: &self.frames,
            depth: self.model.depth,
            scales: Scales { loss, pixel: noise.pixel, depth: noise.depth },
        }
    }
}

/// Sigmas of the three kinds of residual.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct NoiseScales {
    /// Of a whitened pixel coordinate, px.
    pub pixel: f64,
    /// `s` of `sigma = s z^2`, 1/m.
    pub depth: f64,
    /// Of a joint's deviation, rad (or m for a prismatic joint).
    pub deviation: f64,
}
