//! A calibration's parameters beside the truth, up to the gauge.
//!
//! The true arm of a virtual cell is wrong in more numbers than are free: what the base's gauge and the last link carry
//! is taken over by others. The truth in the estimator's parameters is the set of free values whose camera poses are
//! the true ones, up to a turn about and a shift along the first axis. It is found by Gauss-Newton from the estimate
//! on; of combinations that move no camera the one nearest to the estimate is taken, and they are left out of what is
//! judged.

use crate::true_poses::TruePoses;
use anyhow::{Context, Result, ensure};
use nalgebra::{DMatrix, DVector, Isometry3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam::calibration::{Calibration, Model, Parameter};
use skclam::rig::{PostureState, Rig};

/// A free parameter beside its truth, in the units of files (deg, mm, px ...).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterScore {
    /// "alpha_2".
    pub name: String,
    /// Estimate less truth.
    pub error: f64,
    /// Claimed standard deviation.
    pub sigma: f64,
    /// Whether the parameter by itself moves cameras in a way that no other does; z is counted for such alone.
    pub identifiable: bool,
    /// Whether it moves the camera: a parameter of arm or mount.
    pub moves_camera: bool,
}

impl ParameterScore {
    /// Error over claimed standard deviation.
    pub fn z(&self) -> f64 {
        self.error / self.sigma
    }
}

/// Normalised estimation error squared, and over how many combinations of parameters.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Nees {
    /// `e^T C^-1 e`; its mean is `degrees` where the covariance is right.
    pub sum: f64,
    /// Combinations.
    pub degrees: usize,
}

/// The parameters of a calibration judged together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// One a free parameter.
    pub parameters: Vec<ParameterScore>,
    /// Over the combinations that move cameras, whatever the instruments are off.
    pub camera: Nees,
    /// The same and every other free parameter.
    pub all: Nees,
}

/// Singular values below this part of the largest belong to combinations that move no camera. Parameters are in their
/// natural scales, and derivatives are differences, good to about 1e-9.
const UNOBSERVABLE: f64 = 1e-6;
/// Radians weigh as this many metres.
const METRES_PER_RADIAN: f64 = 0.3;
/// A parameter is identifiable by itself when no more than this part of it (squared) lies in unobservable combinations.
const UNOBSERVABLE_FRACTION: f64 = 0.01;

/// Judges a calibration from `nominal` by the true rig, whose cameras at some postures are `truth_at`.
///
/// # Errors
/// No covariance, or a truth that the free parameters cannot express.
pub fn score(nominal: &Rig, truth: &Rig, calibration: &Calibration, truth_at: &TruePoses) -> Result<Score> {
    let covariance = calibration.covariance.as_ref().context("the estimator gives no covariance")?;
    let parameters: Vec<Parameter> = calibration.parameters.iter().map(|estimate| estimate.parameter).collect();
    let moving: Vec<usize> = (0..parameters.len()).filter(|&k| parameters[k].moves_camera()).collect();
    let (arm_truth, seen) = expressed(&calibration.model, &pick(&parameters, &moving), truth_at)?;
    let mut other_truth = Model::new(truth.clone());
    if let (Some(is), Some(was)) = (&truth.depth, &nominal.depth) {
        other_truth.depth.scale = is.unit_m / was.unit_m;
        other_truth.depth.offset_m = is.offset_m - other_truth.depth.scale * was.offset_m;
        let off = is.color_from_depth * was.color_from_depth.inverse();
        let (shift, turn) = (off.translation.vector, off.rotation.scaled_axis());
        other_truth.depth.extrinsics = [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z];
    }
    let scale = DVector::from_iterator(parameters.len(), parameters.iter().map(|parameter| parameter.scale()));
    let mut error = DVector::zeros(parameters.len());
    let turned = calibration.model.rig.flange_from_color.rotation * arm_truth.rig.flange_from_color.rotation.inverse();
    for (k, &parameter) in parameters.iter().enumerate() {
        let from = if parameter.moves_camera() { &arm_truth } else { &other_truth };
        let value =
            |model: &Model| model.value(nominal, parameter).with_context(|| format!("{parameter} has no value"));
        let difference = match parameter {
            // A small turn from the truth to the estimate in the flange's axes: what the covariance is about.
            Parameter::Mount(component) if component.is_rotation() => turned.scaled_axis()[component.axis()],
            _ => value(&calibration.model)? - value(from)?,
        };
        error[k] = difference / scale[k];
    }
    // Columns: seen combinations of what moves cameras, then everything else by itself.
    let others: Vec<usize> = (0..parameters.len()).filter(|k| !moving.contains(k)).collect();
    let mut basis = DMatrix::zeros(parameters.len(), seen.ncols() + others.len());
    for (row, &k) in moving.iter().enumerate() {
        basis.view_mut((k, 0), (1, seen.ncols())).copy_from(&seen.row(row));
    }
    others.iter().enumerate().for_each(|(column, &k)| basis[(k, seen.ncols() + column)] = 1.0);
    let scaled =
        DMatrix::from_fn(parameters.len(), parameters.len(), |i, j| covariance[(i, j)] / (scale[i] * scale[j]));
    let reduced = basis.transpose() * &scaled * &basis;
    let projected = basis.transpose() * &error;
    let scores = parameters.iter().enumerate().map(|(k, parameter)| {
        let unit = skclam::summary::file_unit(parameter.unit()).0 * scale[k];
        ParameterScore {
            name: parameter.to_string(),
            error: error[k] * unit,
            sigma: scaled[(k, k)].max(0.0).sqrt() * unit,
            identifiable: 1.0 - basis.row(k).norm_squared() < UNOBSERVABLE_FRACTION,
            moves_camera: parameter.moves_camera(),
        }
    });
    let nees = |count: usize| -> Result<Nees> {
        let covariance = reduced.view((0, 0), (count, count)).into_owned();
        Ok(Nees { sum: quadratic(&covariance, &projected.rows(0, count).into_owned())?, degrees: count })
    };
    Ok(Score { parameters: scores.collect(), camera: nees(seen.ncols())?, all: nees(projected.len())? })
}

/// `x^T C^-1 x`, with `C` brought to a unit diagonal first.
///
/// # Errors
/// A matrix that is no covariance.
pub fn quadratic(covariance: &DMatrix<f64>, x: &DVector<f64>) -> Result<f64> {
    let sigma = covariance.diagonal().map(|variance| variance.max(0.0).sqrt());
    ensure!(sigma.iter().all(|&sigma| sigma > 0.0), "a covariance with a variance of zero");
    let unit = DMatrix::from_fn(x.len(), x.len(), |i, j| covariance[(i, j)] / (sigma[i] * sigma[j]));
    let z = x.component_div(&sigma);
    let solved = unit.cholesky().context("the covariance is not positive definite")?.solve(&z);
    Ok(z.dot(&solved))
}

fn pick(parameters: &[Parameter], at: &[usize]) -> Vec<Parameter> {
    at.iter().map(|&k| parameters[k]).collect()
}

/// The model nearest to `estimate` whose cameras are the true ones up to the base's gauge, and an orthonormal basis (in
/// the parameters' natural scales) of the combinations that move cameras otherwise than that gauge.
fn expressed(estimate: &Model, parameters: &[Parameter], truth: &TruePoses) -> Result<(Model, DMatrix<f64>)> {
    const ROUNDS: usize = 12;
    let mut model = estimate.clone();
    let mut gauge = [0.0; 2];
    for round in 0.. {
        let system = System::at(&model, gauge, parameters, truth)?;
        let svd = system.jacobian.clone().svd(true, true);
        let step = svd
            .solve(&system.residual, UNOBSERVABLE * svd.singular_values.max())
            .map_err(|problem| anyhow::anyhow!("the truth cannot be expressed: {problem}"))?;
        if step.amax() < 1e-7 || round == ROUNDS {
            let left = system.residual.amax();
            ensure!(left < 1e-5, "the free parameters cannot express the truth: {:.3} mm are left", 1e3 * left);
            return Ok((model, seen_combinations(&system.jacobian)));
        }
        let delta: Vec<f64> = parameters.iter().zip(step.iter()).map(|(p, step)| p.scale() * step).collect();
        model = model.stepped(parameters, &delta)?;
        gauge[0] += step[parameters.len()];
        gauge[1] += step[parameters.len() + 1];
    }
    unreachable!("the loop ends by itself")
}

/// Right singular vectors of the columns of the parameters once the last two, the gauge's, are projected out of them.
fn seen_combinations(jacobian: &DMatrix<f64>) -> DMatrix<f64> {
    let count = jacobian.ncols() - 2;
    let gauge = jacobian.columns(count, 2).into_owned().qr().q();
    let own = jacobian.columns(0, count).into_owned();
    let own = &own - &gauge * (gauge.transpose() * &own);
    let svd = own.svd(false, true);
    let limit = UNOBSERVABLE * svd.singular_values.max();
    let v_t = svd.v_t.unwrap_or_else(|| DMatrix::zeros(0, count));
    let rows: Vec<_> =
        (0..v_t.nrows()).filter(|&k| svd.singular_values[k] > limit).map(|k| v_t.row(k).transpose()).collect();
    DMatrix::from_columns(&rows)
}

/// Differences between a model's cameras and the true ones, and their derivatives by parameters (in natural scales) and
/// gauge.
struct System {
    residual: DVector<f64>,
    jacobian: DMatrix<f64>,
}

impl System {
    fn at(model: &Model, gauge: [f64; 2], parameters: &[Parameter], truth: &TruePoses) -> Result<Self> {
        const STEP: f64 = 1e-4;
        let residual = differences(model, gauge, truth)?;
        let count = parameters.len();
        let mut jacobian = DMatrix::zeros(residual.len(), count + 2);
        for column in 0..count + 2 {
            let moved = |sign: f64| {
                if column < count {
                    let parameter = parameters[column];
                    differences(&model.stepped(&[parameter], &[sign * STEP * parameter.scale()])?, gauge, truth)
                } else {
                    let mut gauge = gauge;
                    gauge[column - count] += sign * STEP;
                    differences(model, gauge, truth)
                }
            };
            // The residual is true less found: its derivative has the other sign.
            jacobian.set_column(column, &((moved(-1.0)? - moved(1.0)?) / (2.0 * STEP)));
        }
        Ok(System { residual, jacobian })
    }
}

/// True less found camera poses in the found cameras' frames, metres and weighted radians, six a posture. `gauge`: the
/// turn about and the shift along the first axis.
fn differences(model: &Model, gauge: [f64; 2], truth: &TruePoses) -> Result<DVector<f64>> {
    let robot = model.rig.robot.as_ref().context("no arm")?;
    let Some(PostureState::Joints(joints)) = truth.postures.first().map(|posture| &posture.state) else {
        anyhow::bail!("no joint values");
    };
    let twist = *robot.jacobian(joints)?.by_joint.first().context("an arm without joints")?;
    let (velocity, axis) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
    // The axis runs through omega x v; along it the base may be shifted, about it turned.
    let on_axis = axis.cross(&velocity);
    let turn = UnitQuaternion::from_scaled_axis(axis * gauge[0]);
    let shift = on_axis - turn * on_axis + axis * gauge[1];
    let gauge = Isometry3::from_parts(shift.into(), turn);
    let mut all = DVector::zeros(6 * truth.postures.len());
    for (at, (posture, true_pose)) in truth.postures.iter().zip(&truth.cameras).enumerate() {
        let off = (gauge * model.rig.base_from_color(posture)?).inverse() * true_pose;
        all.fixed_rows_mut::<3>(6 * at).copy_from(&off.translation.vector);
        all.fixed_rows_mut::<3>(6 * at + 3).copy_from(&(off.rotation.scaled_axis() * METRES_PER_RADIAN));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::true_poses::workspace_postures;
    use skclam::calibration::Free;
    use skclam::rig::builtin_rig;
    use skclam::simulation::{PerturbationSigmas, perturb_random};

    /// A true arm wrong in everything, and the free parameters of a default run.
    fn setting() -> (Rig, Rig, Vec<Parameter>, TruePoses) {
        let nominal = builtin_rig("hp3j").unwrap().unwrap();
        let truth = perturb_random(&nominal, 5, &PerturbationSigmas::default()).unwrap();
        let parameters = Free::Auto.candidates(&nominal, true, false).unwrap();
        let parameters = parameters.into_iter().filter(|parameter| parameter.moves_camera()).collect();
        let postures = workspace_postures(nominal.robot.as_ref().unwrap(), 30, 2);
        let poses = TruePoses::of_rig(&truth, &postures).unwrap();
        (nominal, truth, parameters, poses)
    }

    #[test]
    fn a_truth_wrong_in_everything_is_expressed_by_what_is_free() {
        let (nominal, _, parameters, poses) = setting();
        let (model, seen) = expressed(&Model::new(nominal.clone()), &parameters, &poses).unwrap();
        let error = poses.error_of(&model.rig).unwrap();
        assert!(error.mm < 1e-4 && error.deg < 1e-5, "{error:?}");
        assert_eq!(seen.shape(), (parameters.len(), parameters.len()), "auto leaves no gauge");
        assert!(poses.error_of(&nominal).unwrap().mm > 1.0);
    }

    #[test]
    fn what_moves_no_camera_is_left_out() {
        let (nominal, _, mut parameters, poses) = setting();
        let count = parameters.len();
        let all = Free::All.candidates(&nominal, true, false).unwrap();
        parameters.extend(all.into_iter().filter(|p| p.moves_camera() && !parameters.contains(p)).collect::<Vec<_>>());
        let (_, seen) = expressed(&Model::new(nominal), &parameters, &poses).unwrap();
        // alpha_1 and a_1 move the base otherwise than about and along its first axis: poses see that, whatever images
        // do.
        assert!(parameters.len() > count + 2, "theta_offset_1, d_1 and the last joint's are among them");
        assert_eq!((seen.nrows(), seen.ncols()), (parameters.len(), count + 2));
    }

    #[test]
    fn quadratic_forms_are_those_of_the_inverse() {
        let covariance = DMatrix::from_row_slice(2, 2, &[4.0, 1e-6, 1e-6, 1e-10]);
        let x = DVector::from_vec(vec![2.0, 1e-5]);
        let expected = (x.transpose() * covariance.clone().try_inverse().unwrap() * &x)[0];
        assert!((quadratic(&covariance, &x).unwrap() - expected).abs() < 1e-9 * expected);
    }
}
