//! What the bundle adjustment moves, and what it measures with.

use crate::bundle::observations::CornerObservation;
use crate::bundle::projection_model::{Frame, ProjectionModel, Scales};
use crate::bundle::random_effects::ErrorKind;
use crate::camera_kinematics::CameraKinematics;
use crate::{CalibrationError, Loss, Model};
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Point3};

/// Everything that moves.
#[derive(Debug, Clone)]
pub(crate) struct State {
    pub model: Model,
    /// Component by component, posture by posture ([`CameraKinematics::error_components`]); empty where posture errors
    /// are off.
    pub posture_errors: Vec<f64>,
    /// One a track.
    pub points: Vec<Point3>,
    pub base_from_board: Option<Isometry3>,
    /// The cameras of the above.
    pub frames: Vec<Frame>,
}

impl State {
    pub(crate) fn refresh_frames(&mut self, motion: &CameraKinematics) -> Result<(), CalibrationError> {
        self.frames = motion.poses(&self.model, &self.posture_errors)?.iter().map(Frame::new).collect();
        Ok(())
    }

    pub(crate) fn placed_board(&self) -> Option<PlacedBoard> {
        self.base_from_board.map(|base_from_board| PlacedBoard { base_from_board, scale: self.model.board_scale })
    }

    pub(crate) fn view<'a>(&'a self, noise: &NoiseScales, loss: Loss) -> ProjectionModel<'a> {
        ProjectionModel {
            camera: &self.model.rig.color,
            frames: &self.frames,
            depth: self.model.depth,
            scales: Scales { loss, pixel: noise.pixel, depth: noise.depth },
        }
    }
}

/// A board where it lies, with the size that its squares have.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlacedBoard {
    pub base_from_board: Isometry3,
    /// A multiple of what the rig says.
    pub scale: f64,
}

impl PlacedBoard {
    pub(crate) fn point_in_base(&self, corner: &CornerObservation) -> Point3 {
        self.base_from_board * (corner.point_in_board * self.scale)
    }
}

/// Sigmas of the three kinds of residual.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct NoiseScales {
    /// Of a whitened pixel coordinate, px.
    pub pixel: f64,
    /// `s` of `sigma = s z^2`, 1/m.
    pub depth: f64,
    /// Of the errors of single postures.
    pub posture: PostureErrorSigmas,
}

/// Sigmas of the errors of single postures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct PostureErrorSigmas {
    /// Of a revolute joint, or of a component of a flange's rotation, rad.
    pub angular: f64,
    /// Of a prismatic joint, or of a component of a flange's translation, m.
    pub linear: f64,
}

impl PostureErrorSigmas {
    pub(crate) fn of(&self, kind: ErrorKind) -> f64 {
        match kind {
            ErrorKind::Angular => self.angular,
            ErrorKind::Linear => self.linear,
        }
    }
}
