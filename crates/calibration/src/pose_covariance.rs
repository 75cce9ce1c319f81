//! What the covariance of the parameters says of the flange's and the camera's pose: `J C J^T`, posture by posture.
//!
//! The gauge of the base (and whatever else is not free) is taken as true, so that these are the uncertainties of a pose in the base
//! frame that the calibrated arm defines. What a joint stands off its encoder is not in them: it differs from posture to posture.

use crate::motion::Motion;
use crate::{Calibration, CalibrationError, Model, Parameter};
use nalgebra::{DMatrix, Matrix3, Matrix6, Vector6};
use skclam_geometry::Isometry3;
use skclam_rig::{Posture, Rig};

/// Covariances of two poses at one posture. Order: translation of the frame's origin (m), then rotation (rad), both along the axes of
/// the moving frame itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseCovariance {
    /// Of `base_from_flange`.
    pub flange: Matrix6<f64>,
    /// Of `base_from_camera` (the colour camera).
    pub camera: Matrix6<f64>,
}

/// Root of the trace of a pose covariance's upper left block: the standard deviation of the position in space, metres.
pub fn position_sigma_m(covariance: &Matrix6<f64>) -> f64 {
    let block: Matrix3<f64> = covariance.fixed_view::<3, 3>(0, 0).into_owned();
    block.trace().max(0.0).sqrt()
}

/// The same of the lower right block: the standard deviation of the orientation, radians.
pub fn orientation_sigma_rad(covariance: &Matrix6<f64>) -> f64 {
    let block: Matrix3<f64> = covariance.fixed_view::<3, 3>(3, 3).into_owned();
    block.trace().max(0.0).sqrt()
}

/// Covariances of flange and camera at postures, those of the recording or any others. `None` where the estimator gives no covariance
/// (Nelder-Mead). Fails where a posture does not belong to the rig.
pub fn pose_covariances(
    nominal: &Rig,
    calibration: &Calibration,
    postures: &[Posture],
) -> Result<Option<Vec<PoseCovariance>>, CalibrationError> {
    let Some(covariance) = &calibration.covariance else { return Ok(None) };
    let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
    spread_to_poses(nominal, &calibration.model, &parameters, covariance, postures).map(Some)
}

/// The same of a model and the covariance of its parameters.
pub(crate) fn spread_to_poses(
    nominal: &Rig,
    model: &Model,
    parameters: &[Parameter],
    covariance: &DMatrix<f64>,
    postures: &[Posture],
) -> Result<Vec<PoseCovariance>, CalibrationError> {
    let motion = Motion::new(nominal, postures)?;
    let mut flange_model: Model = model.clone();
    flange_model.rig.flange_from_color = Isometry3::identity();
    let spread = |model: &Model, moves: &dyn Fn(&Parameter) -> bool, posture: usize| {
        let mut columns = motion.linearize(model, parameters, posture, &[])?.by_parameter;
        for (column, parameter) in columns.iter_mut().zip(parameters) {
            if !moves(parameter) {
                *column = Vector6::zeros();
            }
        }
        let jacobian = DMatrix::from_fn(6, columns.len(), |row, column| columns[column][row]);
        let product = &jacobian * covariance * jacobian.transpose();
        Ok::<_, CalibrationError>(Matrix6::from_fn(|i, j| 0.5 * (product[(i, j)] + product[(j, i)])))
    };
    (0..postures.len())
        .map(|posture| {
            Ok(PoseCovariance {
                flange: spread(&flange_model, &|parameter| !matches!(parameter, Parameter::Mount(_)), posture)?,
                camera: spread(model, &|_| true, posture)?,
            })
        })
        .collect()
}

/// What is left of a covariance of camera positions over some postures, as the mean of their variances (m^2), once the base frame has been fitted to them: a rigid motion of the whole
/// arm, which whoever registers the base with the arm itself does not notice.
pub(crate) fn aligned_position_variance(
    nominal: &Rig,
    model: &Model,
    parameters: &[Parameter],
    covariance: &DMatrix<f64>,
    postures: &[Posture],
) -> Result<f64, CalibrationError> {
    let motion = Motion::new(nominal, postures)?;
    let count = postures.len();
    let mut jacobian = DMatrix::zeros(3 * count, parameters.len());
    let mut rigid = DMatrix::zeros(3 * count, 6);
    for posture in 0..count {
        let linear = motion.linearize(model, parameters, posture, &[])?;
        let base_from_camera = linear.base_from_camera;
        for (column, twist) in linear.by_parameter.iter().enumerate() {
            let moved = base_from_camera.rotation * nalgebra::Vector3::new(twist[0], twist[1], twist[2]);
            jacobian.fixed_view_mut::<3, 1>(3 * posture, column).copy_from(&moved);
        }
        rigid.fixed_view_mut::<3, 3>(3 * posture, 0).copy_from(&Matrix3::identity());
        let turned = -base_from_camera.translation.vector.cross_matrix();
        rigid.fixed_view_mut::<3, 3>(3 * posture, 3).copy_from(&turned);
    }
    let basis = rigid.qr().q();
    let left = &jacobian - &basis * (basis.transpose() * &jacobian);
    Ok((&left * covariance).component_mul(&left).sum() / count.max(1) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{diverse_postures, half_pixel, hp3j, manufacture, normal, perturbed, record, room, seeded};
    use crate::{BundleOptions, Free, PostureErrorPolicy, calibrate_bundle};
    use nalgebra::DVector;

    #[test]
    fn the_covariance_of_a_pose_is_the_scatter_of_poses_of_scattered_parameters() {
        let mut rng = seeded(31);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 20, &mut rng);
        let data = record(&truth, &postures, &room(500, &mut rng), half_pixel(), &mut rng);
        let options = BundleOptions { posture_errors: PostureErrorPolicy::Off, ..Default::default() };
        let calibration = calibrate_bundle(&hp3j(), &data, &options).unwrap();
        let told = pose_covariances(&hp3j(), &calibration, &postures[..2]).unwrap().unwrap();

        let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
        let root = calibration.covariance.clone().unwrap().cholesky().expect("auto leaves no gauge").l();
        let rigs: Vec<Rig> = (0..2000)
            .map(|_| {
                let delta = &root * DVector::from_fn(parameters.len(), |_, _| normal(&mut rng));
                calibration.model.stepped(&parameters, delta.as_slice()).unwrap().rig
            })
            .collect();
        for (posture, told) in postures[..2].iter().zip(&told) {
            let scatter = |pose: &dyn Fn(&Rig) -> Isometry3| {
                let center = pose(&calibration.model.rig);
                let squares = rigs.iter().map(|rig| {
                    let off = center.inverse() * pose(rig);
                    [off.translation.vector.norm_squared(), off.rotation.angle().powi(2)]
                });
                let sum = squares.fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]]);
                sum.map(|sum| (sum / rigs.len() as f64).sqrt())
            };
            let camera = scatter(&|rig| rig.base_from_color(posture).unwrap());
            let flange = scatter(&|rig| rig.base_from_flange(posture).unwrap());
            for (found, expected) in [
                (position_sigma_m(&told.camera), camera[0]),
                (orientation_sigma_rad(&told.camera), camera[1]),
                (position_sigma_m(&told.flange), flange[0]),
                (orientation_sigma_rad(&told.flange), flange[1]),
            ] {
                assert!((found / expected - 1.0).abs() < 0.08, "{found} told, {expected} scattered");
            }
        }
    }
}
