//! Covariances, and which sigmas may be reported.

use crate::identifiability::identify;
use crate::prior::Priors;
use crate::{Identifiability, Model, Parameter, ParameterEstimate};
use nalgebra::{DMatrix, DVector};
use skclam_rig::{Posture, Rig};

/// A posterior sigma above this fraction of the prior's says that the data were silent.
const SILENT: f64 = 0.9;
/// A parameter whose fraction in an unobservable direction is above this gets no sigma.
const TIED: f64 = 0.02;

/// Inverse of an normal matrix in the units of its parameters. Directions without information are left out (zero
/// variance): their parameters get no sigma.
pub(crate) fn covariance(normal_matrix: &DMatrix<f64>, parameters: &[Parameter]) -> DMatrix<f64> {
    let count = parameters.len();
    let scaled = DMatrix::from_fn(count, count, |i, j| {
        0.5 * (normal_matrix[(i, j)] + normal_matrix[(j, i)]) * parameters[i].scale() * parameters[j].scale()
    });
    // Eigenvalues are lost below the rounding of the greatest, so equalise the diagonal first.
    let level = DVector::from_fn(count, |k, _| if scaled[(k, k)] > 0.0 { 1.0 / scaled[(k, k)].sqrt() } else { 0.0 });
    let equal = DMatrix::from_fn(count, count, |i, j| scaled[(i, j)] * level[i] * level[j]);
    let eigen = equal.symmetric_eigen();
    let greatest = eigen.eigenvalues.amax();
    let inverse = DVector::from_fn(count, |k, _| {
        let value = eigen.eigenvalues[k];
        if value > 1e-13 * greatest { 1.0 / value } else { 0.0 }
    });
    let covariance = &eigen.eigenvectors * DMatrix::from_diagonal(&inverse) * eigen.eigenvectors.transpose();
    DMatrix::from_fn(count, count, |i, j| {
        0.5 * (covariance[(i, j)] + covariance[(j, i)])
            * level[i]
            * level[j]
            * parameters[i].scale()
            * parameters[j].scale()
    })
}

/// The free parameters with their sigmas, or with the reason why there is none.
pub(crate) fn estimates(
    nominal: &Rig,
    model: &Model,
    parameters: &[Parameter],
    priors: &[Option<f64>],
    covariance: &DMatrix<f64>,
    identifiability: &Identifiability,
) -> Vec<ParameterEstimate> {
    let start = Model::new(nominal.clone());
    let estimate = |(k, &parameter): (usize, &Parameter)| {
        let sigma = covariance[(k, k)].max(0.0).sqrt();
        let unobservable = identifiability.unobservable.iter().find(|direction| {
            direction.combination.iter().any(|(p, fraction)| *p == parameter && fraction.abs() > TIED)
        });
        let note = match (priors[k], unobservable) {
            (None, Some(direction)) => Some(format!("not observable: {}", direction.reason)),
            (Some(prior), direction) if sigma > SILENT * prior => Some(match direction {
                Some(direction) => format!("held by its prior: {}", direction.reason),
                None => "held by its prior: the data say next to nothing".to_owned(),
            }),
            (_, None) if sigma <= 0.0 || !sigma.is_finite() => {
                Some("not observable: no residual depends on it".to_owned())
            }
            _ => None,
        };
        ParameterEstimate {
            parameter,
            nominal: start.value(nominal, parameter).unwrap_or_default(),
            value: model.value(nominal, parameter).unwrap_or_default(),
            sigma: note.is_none().then_some(sigma),
            note,
        }
    };
    parameters.iter().enumerate().map(estimate).collect()
}

/// From the normal matrix of the data by the parameters (natural units, no priors) and the covariance of the
/// parameters: what is not identifiable, and the parameters with their sigmas.
pub(crate) fn describe(
    nominal: &Rig,
    model: &Model,
    postures: &[Posture],
    parameters: &[Parameter],
    priors: &Priors,
    normal: &DMatrix<f64>,
    covariance: &DMatrix<f64>,
) -> (Identifiability, Vec<ParameterEstimate>) {
    let identifiability = identify(model, postures, parameters, normal);
    let estimates = estimates(nominal, model, parameters, &priors.sigmas, covariance, &identifiability);
    (identifiability, estimates)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Intrinsic, MountComponent};

    #[test]
    fn information_is_inverted_across_units() {
        let parameters = [
            Parameter::Mount(MountComponent::RotationX),
            Parameter::Mount(MountComponent::TranslationX),
            Parameter::Intrinsic(Intrinsic::Fx),
        ];
        let normal_matrix = DMatrix::from_row_slice(3, 3, &[1e12, 2e9, 1e3, 2e9, 1e8, 1e2, 1e3, 1e2, 1e-2]);
        let inverse = covariance(&normal_matrix, &parameters);
        assert!((&normal_matrix * &inverse - DMatrix::identity(3, 3)).amax() < 1e-6);
    }
}
