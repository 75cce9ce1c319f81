//! Observation by observation, where a scene point should appear and where it was seen: what a plot of systematic
//! patterns over the image needs.

use crate::bundle::{Observations, compare};
use crate::camera_kinematics::CameraKinematics;
use crate::{CalibrationError, Correspondences, Model};
use nalgebra::Vector2;
use skclam_geometry::Pixel;

/// One observation under two models.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReprojectionResidual {
    /// Position of the posture in [`Correspondences::postures`].
    pub posture: usize,
    /// Where the point was seen, px, distortion included.
    pub pixel: Pixel,
    /// From where the point should appear under the nominal model to where it was seen, px.
    pub nominal: Vector2<f64>,
    /// The same under the calibrated model.
    pub calibrated: Vector2<f64>,
}

/// Residuals of all observations of tracks and board corners, in their order. Scene points and the board's pose are
/// fitted to each model's cameras, nothing else moves; observations whose point cannot be triangulated, or lies behind
/// a camera, are left out. Empty where there are pairs alone.
///
/// `sigma_px`: the noise of a pixel coordinate, which sets how the loss weights outliers.
///
/// # Errors
/// Correspondences that contradict themselves, and what the models' kinematics refuse.
pub fn reprojection_residuals(
    nominal: &Model,
    calibrated: &Model,
    data: &Correspondences,
    sigma_px: f64,
) -> Result<Vec<ReprojectionResidual>, CalibrationError> {
    data.check()?;
    let motion = CameraKinematics::new(&nominal.rig, &data.postures)?;
    let observations = Observations::new(&nominal.rig, data, &|_| true, &mut Vec::new())?;
    if observations.observations.is_empty() && observations.corners.is_empty() {
        return Ok(Vec::new());
    }
    let (before, after) = compare(nominal, calibrated, &motion, &observations, sigma_px)?;
    let seen = &after.observations;
    let pixels = seen.observations.iter().map(|observation| observation.pixel);
    let pixels = pixels.chain(seen.corners.iter().map(|corner| corner.observation.pixel));
    let residuals =
        pixels.zip(before.sizes.iter().zip(&after.sizes)).map(|(pixel, (before, after))| ReprojectionResidual {
            posture: before.posture as usize,
            pixel,
            nominal: before.residual_px,
            calibrated: after.residual_px,
        });
    let finite = |way: &Vector2<f64>| way.x.is_finite() && way.y.is_finite();
    Ok(residuals.filter(|residual| finite(&residual.nominal) && finite(&residual.calibrated)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{box_points, diverse_postures, half_pixel, hp3j, record, seeded};

    #[test]
    fn a_camera_whose_center_is_taken_wrong_shows_it_as_one_way_everywhere() {
        let truth = hp3j();
        let mut rng = seeded(5);
        let postures = diverse_postures(&truth, 16, &mut rng);
        let points = box_points(1500, &mut rng);
        let data = record(&truth, &postures, &points, half_pixel(), &mut rng);
        let mut wrong = truth.clone();
        wrong.color.cx -= 3.0;
        let found = reprojection_residuals(&Model::new(wrong), &Model::new(truth), &data, 0.5).unwrap();
        assert!(found.len() > 300, "{}", found.len());
        let mean = |way: &dyn Fn(&ReprojectionResidual) -> Vector2<f64>| {
            found.iter().map(way).sum::<Vector2<f64>>() / found.len() as f64
        };
        // Points give way to part of the error; what all images share remains.
        let (nominal, calibrated) = (mean(&|r| r.nominal), mean(&|r| r.calibrated));
        assert!(nominal.x > 0.5 && nominal.y.abs() < 0.2 * nominal.x, "{nominal}");
        assert!(calibrated.norm() < 0.05, "{calibrated}");
        let no_tracks = Correspondences { postures: data.postures.clone(), ..Default::default() };
        assert!(reprojection_residuals(&Model::new(hp3j()), &Model::new(hp3j()), &no_tracks, 0.5).unwrap().is_empty());
    }
}
