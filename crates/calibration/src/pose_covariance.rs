//! What the covariance of the parameters says of the flange's and the camera's pose: `J C J^T`, posture by posture.
//!
//! The gauge of the base (and whatever else is not free) is taken as true, so that these are the uncertainties of a
//! pose in the base frame that the calibrated arm defines. What a joint is off its encoder is not in them: it differs
//! from posture to posture.

use crate::camera_kinematics::CameraKinematics;
use crate::{Calibration, CalibrationError, Model, Parameter};
use nalgebra::{DMatrix, Matrix3, Matrix6, Vector3, Vector6};
use skclam_geometry::Isometry3;
use skclam_rig::{Posture, Rig};

/// Covariances of two poses at one posture. Order: translation of the frame's origin (m), then rotation (rad), both
/// along the axes of the moving frame itself.
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

/// Covariances of flange and camera at postures, those of the recording or any others. `None` where the estimator gives
/// no covariance (Nelder-Mead). Fails where a posture does not belong to the rig.
pub fn pose_covariances(
    nominal: &Rig,
    calibration: &Calibration,
    postures: &[Posture],
) -> Result<Option<Vec<PoseCovariance>>, CalibrationError> {
    let Some(covariance) = &calibration.covariance else { return Ok(None) };
    let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
    propagate_to_poses(nominal, &calibration.model, &parameters, covariance, postures).map(Some)
}

/// The same of a model and the covariance of its parameters.
pub(crate) fn propagate_to_poses(
    nominal: &Rig,
    model: &Model,
    parameters: &[Parameter],
    covariance: &DMatrix<f64>,
    postures: &[Posture],
) -> Result<Vec<PoseCovariance>, CalibrationError> {
    let motion = CameraKinematics::new(nominal, postures)?;
    let mut flange_model: Model = model.clone();
    flange_model.rig.flange_from_color = Isometry3::identity();
    let covariance_of = |model: &Model, moves: &dyn Fn(&Parameter) -> bool, posture: usize| {
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
                flange: covariance_of(&flange_model, &|parameter| !matches!(parameter, Parameter::Mount(_)), posture)?,
                camera: covariance_of(model, &|_| true, posture)?,
            })
        })
        .collect()
}

/// Camera positions over some postures, once the base frame has been fitted to them (where there are joints): a rigid
/// motion of the whole arm is not noticed by whoever registers its base with the arm itself, and is taken out as
/// standards of absolute accuracy do (ISO 9283). To first order.
struct AlignedCameras {
    /// Of the stacked positions by the parameters, base frame, rigid motions taken out.
    jacobian: DMatrix<f64>,
    /// Orthonormal basis of the rigid motions.
    rigid: DMatrix<f64>,
}

impl AlignedCameras {
    fn new(
        nominal: &Rig,
        model: &Model,
        parameters: &[Parameter],
        postures: &[Posture],
    ) -> Result<Self, CalibrationError> {
        let motion = CameraKinematics::new(nominal, postures)?;
        let count = postures.len();
        let mut jacobian = DMatrix::zeros(3 * count, parameters.len());
        let mut rigid = DMatrix::zeros(3 * count, 6);
        for posture in 0..count {
            let linear = motion.linearize(model, parameters, posture, &[])?;
            let base_from_camera = linear.base_from_camera;
            for (column, twist) in linear.by_parameter.iter().enumerate() {
                let moved = base_from_camera.rotation * Vector3::new(twist[0], twist[1], twist[2]);
                jacobian.fixed_view_mut::<3, 1>(3 * posture, column).copy_from(&moved);
            }
            rigid.fixed_view_mut::<3, 3>(3 * posture, 0).copy_from(&Matrix3::identity());
            let turned = -base_from_camera.translation.vector.cross_matrix();
            rigid.fixed_view_mut::<3, 3>(3 * posture, 3).copy_from(&turned);
        }
        // Where the controller's poses are the standard, there is no base to be fitted.
        if !motion.has_joints() {
            return Ok(AlignedCameras { jacobian, rigid: DMatrix::zeros(3 * count, 0) });
        }
        // Few or coinciding positions leave fewer than six rigid motions.
        let svd = rigid.svd(true, false);
        let largest = svd.singular_values.amax();
        let kept: Vec<usize> =
            (0..svd.singular_values.len()).filter(|&k| svd.singular_values[k] > 1e-9 * largest).collect();
        let rigid = svd.u.map_or_else(|| DMatrix::zeros(3 * count, 0), |u| u.select_columns(&kept));
        let jacobian = &jacobian - &rigid * (rigid.transpose() * &jacobian);
        Ok(AlignedCameras { jacobian, rigid })
    }

    /// Mean variance of a position, m^2.
    fn variance(&self, covariance: &DMatrix<f64>) -> f64 {
        let count = (self.jacobian.nrows() / 3).max(1) as f64;
        (&self.jacobian * covariance).component_mul(&self.jacobian).sum() / count
    }
}

/// The mean variance (m^2) of the camera's position over some postures under covariances of the parameters, the base
/// frame fitted to them.
pub(crate) struct AlignedVariance {
    cameras: AlignedCameras,
}

impl AlignedVariance {
    pub(crate) fn new(
        nominal: &Rig,
        model: &Model,
        parameters: &[Parameter],
        postures: &[Posture],
    ) -> Result<Self, CalibrationError> {
        Ok(AlignedVariance { cameras: AlignedCameras::new(nominal, model, parameters, postures)? })
    }

    pub(crate) fn of(&self, covariance: &DMatrix<f64>) -> f64 {
        self.cameras.variance(covariance)
    }

    /// How many independent numbers of equal variance would have a sum of squares as uncertain as that of all positions
    /// (Satterthwaite 1946).
    pub(crate) fn degrees_of_freedom(&self, covariance: &DMatrix<f64>) -> f64 {
        let product = self.cameras.jacobian.tr_mul(&self.cameras.jacobian) * covariance;
        product.trace().powi(2) / (&product * &product).trace().max(f64::MIN_POSITIVE)
    }
}

/// What a calibration does to the camera's position over some postures, and what is left of its error, the base frame
/// fitted to them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedPositions {
    /// Root of the mean square of how far the calibration moves the camera, m.
    pub change_m: f64,
    /// Root of the mean variance of its position in space, m; `None` where the estimator gives no covariance.
    pub sigma_m: Option<f64>,
    /// The part of that which comes from the standard of length, m; `None` where there is none.
    pub ruler_sigma_m: Option<f64>,
}

/// See [`AlignedPositions`].
pub fn aligned_positions(
    nominal: &Rig,
    calibration: &Calibration,
    postures: &[Posture],
) -> Result<AlignedPositions, CalibrationError> {
    let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
    let aligned = AlignedCameras::new(nominal, &calibration.model, &parameters, postures)?;
    let motion = CameraKinematics::new(nominal, postures)?;
    let before = motion.poses(&Model::new(nominal.clone()), &[])?;
    let after = motion.poses(&calibration.model, &[])?;
    let moved = before.iter().zip(&after).flat_map(|(before, after)| {
        let way = after.translation.vector - before.translation.vector;
        [way.x, way.y, way.z]
    });
    let moved = nalgebra::DVector::from_iterator(3 * postures.len(), moved);
    let left = &moved - &aligned.rigid * (aligned.rigid.transpose() * &moved);
    let sigma = |covariance: &DMatrix<f64>| aligned.variance(covariance).max(0.0).sqrt();
    Ok(AlignedPositions {
        change_m: (left.norm_squared() / postures.len().max(1) as f64).sqrt(),
        sigma_m: calibration.covariance.as_ref().map(sigma),
        ruler_sigma_m: calibration.ruler.as_ref().map(|ruler| sigma(&ruler.covariance)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        box_points, diverse_postures, half_pixel, hp3j, manufacture, normal, perturbed, record, seeded,
    };
    use crate::{BundleOptions, Free, PostureErrorPolicy, calibrate_bundle};
    use nalgebra::DVector;

    #[test]
    fn the_covariance_of_a_pose_is_the_scatter_of_poses_of_scattered_parameters() {
        let mut rng = seeded(31);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 20, &mut rng);
        let data = record(&truth, &postures, &box_points(500, &mut rng), half_pixel(), &mut rng);
        let options = BundleOptions { posture_errors: PostureErrorPolicy::Off, ..Default::default() };
        let calibration = calibrate_bundle(&hp3j(), &data, &options).unwrap();
        let claimed = pose_covariances(&hp3j(), &calibration, &postures[..2]).unwrap().unwrap();

        let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
        let root = calibration.covariance.clone().unwrap().cholesky().expect("auto leaves no gauge").l();
        let rigs: Vec<Rig> = (0..2000)
            .map(|_| {
                let delta = &root * DVector::from_fn(parameters.len(), |_, _| normal(&mut rng));
                calibration.model.stepped(&parameters, delta.as_slice()).unwrap().rig
            })
            .collect();
        for (posture, claimed) in postures[..2].iter().zip(&claimed) {
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
                (position_sigma_m(&claimed.camera), camera[0]),
                (orientation_sigma_rad(&claimed.camera), camera[1]),
                (position_sigma_m(&claimed.flange), flange[0]),
                (orientation_sigma_rad(&claimed.flange), flange[1]),
            ] {
                assert!((found / expected - 1.0).abs() < 0.08, "{found} claimed, {expected} scattered");
            }
        }
    }

    #[test]
    fn a_rigid_motion_of_the_base_changes_no_aligned_position() {
        let mut rng = seeded(32);
        let nominal = hp3j();
        let postures = diverse_postures(&nominal, 20, &mut rng);
        let data = record(&nominal, &postures, &box_points(400, &mut rng), half_pixel(), &mut rng);
        // All of the arm; its base gauge is a rigid motion.
        let options = BundleOptions {
            free: Free::parse("alpha_1,a_1,theta_offset_1,d_1,theta_offset_3", &nominal).unwrap(),
            posture_errors: PostureErrorPolicy::Off,
            ..Default::default()
        };
        let mut calibration = calibrate_bundle(&nominal, &data, &options).unwrap();
        let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
        let set = |calibration: &mut Calibration, delta: [f64; 5]| {
            calibration.model = Model::new(nominal.clone()).stepped(&parameters, &delta).unwrap();
            let squares = DVector::from_iterator(5, delta.iter().map(|x| x * x));
            calibration.covariance = Some(DMatrix::from_diagonal(&squares));
            aligned_positions(&nominal, calibration, &postures).unwrap()
        };
        let base = set(&mut calibration, [1e-4, 1e-3, 2e-4, -1e-3, 0.0]);
        // To first order: 0.1 mrad of a metre, squared.
        assert!(base.change_m < 1e-7 && base.sigma_m.unwrap() < 1e-9, "{base:?}");
        let elbow = set(&mut calibration, [0.0, 0.0, 0.0, 0.0, 1e-4]);
        assert!(elbow.change_m > 5e-6, "{elbow:?}");
        assert!((elbow.sigma_m.unwrap() / elbow.change_m - 1.0).abs() < 1e-2, "{elbow:?}");
        let both = set(&mut calibration, [1e-4, 1e-3, 2e-4, -1e-3, 1e-4]);
        assert!((both.change_m / elbow.change_m - 1.0).abs() < 1e-2, "{both:?} {elbow:?}");
        assert_eq!(both.ruler_sigma_m, None);
    }
}
