//! How far a free parameter may be from its nominal value before the data are heard.

use crate::{Free, Intrinsic, Model, MountComponent, Parameter, Unit};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use skclam_rig::{Prior, Rig};

/// Which priors an estimator hears.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PriorPolicy {
    /// The rig's `[prior]` always; the tolerances of [`default_sigma`] where the selection is `auto` or `all`, none for a list.
    #[default]
    Auto,
    /// The rig's `[prior]`, and [`default_sigma`] where it is silent.
    Always,
    /// None at all.
    Never,
}

/// Tolerances in the parameter's unit where the rig gives none: what a small industrial arm is made to (0.3 deg and 1 mm are
/// generous), a mount measured with a ruler, a camera calibrated once, a depth camera's data sheet.
pub fn default_sigma(rig: &Rig, parameter: Parameter) -> f64 {
    match (parameter, parameter.unit()) {
        (Parameter::Mount(_), Unit::Radian) => 10f64.to_radians(),
        (Parameter::Mount(_), _) => 0.03,
        (Parameter::Chain(_), Unit::Radian) => 0.3f64.to_radians(),
        (Parameter::Chain(_), _) => 1e-3,
        (Parameter::Intrinsic(Intrinsic::Fx), _) => 0.005 * rig.color.fx,
        (Parameter::Intrinsic(Intrinsic::Fy), _) => 0.005 * rig.color.fy,
        (Parameter::Intrinsic(Intrinsic::Cx | Intrinsic::Cy), _) => 0.005 * f64::from(rig.color.width),
        (Parameter::Intrinsic(Intrinsic::P1 | Intrinsic::P2), _) => 2e-3,
        (Parameter::Intrinsic(_), _) => 0.05,
        (Parameter::DepthScale, _) => 2e-3,
        (Parameter::DepthOffset, _) => 3e-3,
        (Parameter::TimeOffset, _) => 0.05,
        (Parameter::GearSin(_) | Parameter::GearCos(_), _) => 0.03f64.to_radians(),
        (Parameter::Compliance(_), _) => 0.1f64.to_radians(),
    }
}

/// What the rig's `[prior]` says of a parameter, in its unit.
pub fn stated_sigma(rig: &Rig, parameter: Parameter) -> Option<f64> {
    let prior: &Prior = &rig.prior;
    let deg = |value: Option<f64>| value.map(f64::to_radians);
    let mm = |value: Option<f64>| value.map(|value| value * 1e-3);
    match (parameter, parameter.unit()) {
        (Parameter::Mount(_), Unit::Radian) => deg(prior.mount_rotation_deg),
        (Parameter::Mount(_), _) => mm(prior.mount_translation_mm),
        (Parameter::Chain(_), Unit::Radian) => deg(prior.angle_deg),
        (Parameter::Chain(_), _) => mm(prior.length_mm),
        (Parameter::Intrinsic(Intrinsic::Fx), _) => prior.focal_relative.map(|f| f * rig.color.fx),
        (Parameter::Intrinsic(Intrinsic::Fy), _) => prior.focal_relative.map(|f| f * rig.color.fy),
        (Parameter::Intrinsic(_), Unit::Pixel) => prior.principal_point_px,
        (Parameter::Intrinsic(_), _) => prior.distortion,
        (Parameter::DepthScale, _) => prior.depth_scale_relative,
        (Parameter::DepthOffset, _) => mm(prior.depth_offset_mm),
        (Parameter::TimeOffset, _) => prior.time_offset_s,
        (Parameter::GearSin(_) | Parameter::GearCos(_) | Parameter::Compliance(_), _) => None,
    }
}

/// The sigmas of a list of parameters under a policy; `None`: no prior.
pub(crate) fn sigmas(rig: &Rig, free: &Free, policy: PriorPolicy, parameters: &[Parameter]) -> Vec<Option<f64>> {
    let defaults = match policy {
        PriorPolicy::Never => return vec![None; parameters.len()],
        PriorPolicy::Always => true,
        PriorPolicy::Auto => free.is_open(),
    };
    let sigma = |&parameter: &Parameter| {
        stated_sigma(rig, parameter).or_else(|| defaults.then(|| default_sigma(rig, parameter)))
    };
    parameters.iter().map(sigma).collect()
}

/// Priors of a list of parameters, ready for normal equations.
#[derive(Debug, Clone)]
pub(crate) struct Priors {
    pub sigmas: Vec<Option<f64>>,
}

impl Priors {
    /// Differences from nominal, in each parameter's unit.
    fn offsets(nominal: &Rig, model: &Model, parameters: &[Parameter]) -> Vec<f64> {
        let start = Model::new(nominal.clone());
        let value = |model: &Model, p| model.value(nominal, p).unwrap_or_default();
        parameters.iter().map(|&p| value(model, p) - value(&start, p)).collect()
    }

    /// Half the sum of squares.
    pub(crate) fn cost(&self, nominal: &Rig, model: &Model, parameters: &[Parameter]) -> f64 {
        let offsets = Self::offsets(nominal, model, parameters);
        let term = |(offset, sigma): (&f64, &Option<f64>)| sigma.map_or(0.0, |sigma| (offset / sigma).powi(2));
        0.5 * offsets.iter().zip(&self.sigmas).map(term).sum::<f64>()
    }

    /// Adds the priors to `H delta = g` (g: the negative gradient) of the parameters, which are the first unknowns.
    ///
    /// A step turns the mount by `Exp(delta) R`, and the prior speaks of `log(R R_nominal^-1)`: the left Jacobian of SO(3) lies
    /// between them.
    pub(crate) fn add_to(
        &self,
        nominal: &Rig,
        model: &Model,
        parameters: &[Parameter],
        information: &mut DMatrix<f64>,
        descent: &mut DVector<f64>,
    ) {
        let offsets = Self::offsets(nominal, model, parameters);
        let turn = (model.rig.flange_from_color.rotation * nominal.flange_from_color.rotation.inverse()).scaled_axis();
        let left = inverse_left_jacobian(&turn);
        let rotation = |parameter: Parameter| match parameter {
            Parameter::Mount(component) if component.is_rotation() => Some(component),
            _ => None,
        };
        for (row, (&parameter, sigma)) in parameters.iter().zip(&self.sigmas).enumerate() {
            let Some(sigma) = sigma else { continue };
            let weight = 1.0 / (sigma * sigma);
            let Some(component) = rotation(parameter) else {
                information[(row, row)] += weight;
                descent[row] -= weight * offsets[row];
                continue;
            };
            // One residual, log(R R_nominal^-1)[axis], which every free mount rotation moves.
            let derivative = |other: MountComponent| left[(component.axis(), other.axis())];
            for (i, p) in parameters.iter().enumerate() {
                let Some(at_i) = rotation(*p) else { continue };
                descent[i] -= weight * derivative(at_i) * turn[component.axis()];
                for (j, q) in parameters.iter().enumerate() {
                    if let Some(at_j) = rotation(*q) {
                        information[(i, j)] += weight * derivative(at_i) * derivative(at_j);
                    }
                }
            }
        }
    }
}

/// `log(Exp(d) Exp(w)) = w + J d` to first order in `d`.
fn inverse_left_jacobian(w: &Vector3<f64>) -> Matrix3<f64> {
    let angle = w.norm();
    let hat = w.cross_matrix();
    let factor = if angle < 1e-4 {
        1.0 / 12.0
    } else {
        1.0 / (angle * angle) - (1.0 + angle.cos()) / (2.0 * angle * angle.sin())
    };
    Matrix3::identity() - hat * 0.5 + hat * hat * factor
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Free;
    use crate::synthetic::{Errors, hp3j, perturbed, seeded};

    #[test]
    fn the_gradient_of_the_priors_agrees_with_differences() {
        let nominal = hp3j();
        let errors = Errors { angle: 0.02, length: 1e-3, mount_angle: 0.3, mount_length: 0.02, fixed_size: true };
        let model = Model::new(perturbed(&nominal, &Free::Auto, errors, &mut seeded(2)));
        let parameters = Free::All.candidates(&nominal, true, true).unwrap();
        let priors = Priors { sigmas: sigmas(&nominal, &Free::All, PriorPolicy::Auto, &parameters) };
        let mut information = DMatrix::zeros(parameters.len(), parameters.len());
        let mut descent = DVector::zeros(parameters.len());
        priors.add_to(&nominal, &model, &parameters, &mut information, &mut descent);
        for (k, &parameter) in parameters.iter().enumerate() {
            let step = 1e-6 * priors.sigmas[k].unwrap();
            let at = |change| priors.cost(&nominal, &model.stepped(&[parameter], &[change]).unwrap(), &parameters);
            let slope = (at(step) - at(-step)) / (2.0 * step);
            let scale = 1.0 / priors.sigmas[k].unwrap();
            assert!((slope + descent[k]).abs() < 1e-4 * scale.max(slope.abs()), "{parameter}: {slope} {}", descent[k]);
        }
        assert!((&information - information.transpose()).amax() < 1e-9 * information.amax());
    }

    #[test]
    fn the_rig_overrides_the_defaults_and_a_list_has_none() {
        let mut rig = hp3j();
        rig.prior.angle_deg = Some(1.0);
        let parameters = Free::Angles.candidates(&rig, true, false).unwrap();
        let of = |rig: &Rig, free: &Free, policy| sigmas(rig, free, policy, &parameters)[0];
        assert_eq!(of(&rig, &Free::Angles, PriorPolicy::Auto), Some(1f64.to_radians()));
        rig.prior.angle_deg = None;
        assert_eq!(of(&rig, &Free::Angles, PriorPolicy::Auto), None);
        assert_eq!(of(&rig, &Free::Auto, PriorPolicy::Auto), Some(0.3f64.to_radians()));
        assert_eq!(of(&rig, &Free::Auto, PriorPolicy::Never), None);
    }
}
