//! How far a free parameter may be from its nominal value before the data are used.
//!
//! What an arm is made to is not known beforehand: one has its axes within 0.02 deg, another its zeros off by a degree.
//! So the sigmas of the arm's angles and lengths are two unknowns of their own ([`PriorGroup`]), estimated by the
//! evidence (MacKay, "Bayesian interpolation", 1992) and integrated over in the covariance. What cameras and boards are
//! known to is: their sigmas are those of [`default_sigma`].

use crate::{Free, Intrinsic, Model, MountComponent, Parameter, Unit};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use serde::{Deserialize, Serialize};
use skclam_rig::{Prior, Rig};

/// Which priors an estimator uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PriorPolicy {
    /// The rig's `[prior]` always; the tolerances of [`default_sigma`] where the selection is `auto` or `all`, none for
    /// a list.
    #[default]
    Auto,
    /// The rig's `[prior]`, and [`default_sigma`] where it is silent.
    Always,
    /// None at all.
    Never,
}

/// Parameters of the arm whose prior sigma is one unknown of the estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PriorGroup {
    /// Angles of the arm, radians.
    Angles,
    /// Lengths of the arm, metres.
    Lengths,
}

impl PriorGroup {
    /// Both.
    pub const ALL: [PriorGroup; 2] = [PriorGroup::Angles, PriorGroup::Lengths];

    /// The group of a parameter; `None` outside the geometry of the arm.
    pub fn of(parameter: Parameter) -> Option<Self> {
        match (parameter, parameter.unit()) {
            (Parameter::Chain(_), Unit::Radian) => Some(PriorGroup::Angles),
            (Parameter::Chain(_), _) => Some(PriorGroup::Lengths),
            _ => None,
        }
    }

    /// What the group's sigma is about before the data are used, in its unit: its median. Identified arms of the
    /// literature lie between 0.02 and 1 deg and between 0.1 and 2 mm (Nubiola and Bonev, "Absolute calibration of an
    /// ABB IRB 1600 robot using a laser tracker", 2013, and its references).
    pub fn median(self) -> f64 {
        match self {
            PriorGroup::Angles => 0.15f64.to_radians(),
            PriorGroup::Lengths => 0.5e-3,
        }
    }
}

/// Standard deviation of the logarithm of a variance component's sigma before the data are used: 95 % within a factor
/// of 20.
pub(crate) const LOG_SPREAD: f64 = 1.5;

/// The sigma of normal numbers of which `determined` are known, with the sum of their squares, under a log-normal prior
/// of its own: the root of `determined + ln(sigma / median) / LOG_SPREAD^2 = squares / sigma^2`.
pub(crate) fn likeliest_sigma(squares: f64, determined: f64, median: f64) -> f64 {
    let slope = |log: f64| determined + (log - median.ln()) / (LOG_SPREAD * LOG_SPREAD) - squares * (-2.0 * log).exp();
    // The left side grows with the logarithm everywhere, so that bisection ends at the only root.
    let (mut low, mut high) = (median.ln() - 12.0, median.ln() + 12.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if slope(middle) < 0.0 { low = middle } else { high = middle }
    }
    (0.5 * (low + high)).exp()
}

/// Sigmas in the parameter's unit where the rig gives none.
///
/// Of the arm: the medians of [`PriorGroup::median`], from where the data move them. A mount measured with a ruler. A
/// camera that was calibrated once: focal length to 0.2 %, centre to 3 px of a megapixel image, distortion to what
/// shifts its corner by about a pixel (Zhang, "A flexible new technique for camera calibration", 2000, table 1, and the
/// scatter between repeated calibrations that it reports). A depth camera by its data sheet: scale to 0.5 % (a stereo
/// or structured-light camera is specified to 1 or 2 %), offset 1 mm; its place beside the colour camera to 1 mm and
/// 0.2 deg. A printed board: 0.1 %.
pub fn default_sigma(rig: &Rig, parameter: Parameter) -> f64 {
    let width = f64::from(rig.color.width);
    match (parameter, parameter.unit()) {
        (Parameter::Mount(_), Unit::Radian) => 10f64.to_radians(),
        (Parameter::Mount(_), _) => 0.03,
        (Parameter::Chain(_), Unit::Radian) => PriorGroup::Angles.median(),
        (Parameter::Chain(_), _) => PriorGroup::Lengths.median(),
        (Parameter::Intrinsic(Intrinsic::Fx), _) => 2e-3 * rig.color.fx,
        (Parameter::Intrinsic(Intrinsic::Fy), _) => 2e-3 * rig.color.fy,
        (Parameter::Intrinsic(Intrinsic::Cx | Intrinsic::Cy), _) => 2e-3 * width,
        (Parameter::Intrinsic(Intrinsic::P1 | Intrinsic::P2), _) => 1e-3,
        (Parameter::Intrinsic(Intrinsic::K1), _) => 0.02,
        (Parameter::Intrinsic(_), _) => 0.05,
        (Parameter::DepthScale, _) => 5e-3,
        (Parameter::DepthOffset, _) => 1e-3,
        (Parameter::DepthExtrinsic(_), Unit::Radian) => 0.2f64.to_radians(),
        (Parameter::DepthExtrinsic(_), _) => 1e-3,
        (Parameter::BoardScale, _) => 1e-3,
        (Parameter::TimeOffset, _) => 0.05,
        (Parameter::TransmissionSin(_) | Parameter::TransmissionCos(_), _) => 0.03f64.to_radians(),
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
        (Parameter::DepthExtrinsic(_), Unit::Radian) => deg(prior.color_from_depth_rotation_deg),
        (Parameter::DepthExtrinsic(_), _) => mm(prior.color_from_depth_translation_mm),
        (Parameter::BoardScale, _) => prior.board_scale_relative,
        (Parameter::TimeOffset, _) => prior.time_offset_s,
        (Parameter::TransmissionSin(_) | Parameter::TransmissionCos(_) | Parameter::Compliance(_), _) => None,
    }
}

/// Priors of a list of parameters, ready for normal equations.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Priors {
    /// `None`: no prior.
    pub sigmas: Vec<Option<f64>>,
    /// The groups whose sigma is estimated.
    groups: Vec<Option<PriorGroup>>,
}

impl Priors {
    /// Those of a policy. Sigmas that the rig states stay; those of the arm that it does not state are estimated.
    pub(crate) fn new(rig: &Rig, free: &Free, policy: PriorPolicy, parameters: &[Parameter]) -> Self {
        let defaults = match policy {
            PriorPolicy::Never => return Priors::none(parameters.len()),
            PriorPolicy::Always => true,
            PriorPolicy::Auto => free.is_open(),
        };
        let stated = |&parameter: &Parameter| stated_sigma(rig, parameter);
        let sigma =
            |parameter: &Parameter| stated(parameter).or_else(|| defaults.then(|| default_sigma(rig, *parameter)));
        let group = |parameter: &Parameter| match (defaults, stated(parameter)) {
            (true, None) => PriorGroup::of(*parameter),
            _ => None,
        };
        Priors { sigmas: parameters.iter().map(sigma).collect(), groups: parameters.iter().map(group).collect() }
    }

    pub(crate) fn none(parameters: usize) -> Self {
        Priors { sigmas: vec![None; parameters], groups: vec![None; parameters] }
    }

    /// The sigma of a group that is estimated; `None` where there is no such group.
    pub(crate) fn group_sigma(&self, group: PriorGroup) -> Option<f64> {
        let at = self.groups.iter().position(|of| *of == Some(group))?;
        self.sigmas[at]
    }

    pub(crate) fn set_group_sigma(&mut self, group: PriorGroup, sigma: f64) {
        for (value, of) in self.sigmas.iter_mut().zip(&self.groups) {
            if *of == Some(group) {
                *value = Some(sigma);
            }
        }
    }

    /// Positions of the parameters of a group.
    pub(crate) fn members(&self, group: PriorGroup) -> Vec<usize> {
        (0..self.groups.len()).filter(|&at| self.groups[at] == Some(group)).collect()
    }

    /// Differences from nominal, in each parameter's unit.
    pub(crate) fn offsets(nominal: &Rig, model: &Model, parameters: &[Parameter]) -> Vec<f64> {
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
    /// A step turns the mount by `Exp(delta) R`, and the prior is on `log(R R_nominal^-1)`: the left Jacobian of SO(3)
    /// lies between them.
    pub(crate) fn add_to(
        &self,
        nominal: &Rig,
        model: &Model,
        parameters: &[Parameter],
        normal_matrix: &mut DMatrix<f64>,
        rhs: &mut DVector<f64>,
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
                normal_matrix[(row, row)] += weight;
                rhs[row] -= weight * offsets[row];
                continue;
            };
            // One residual, log(R R_nominal^-1)[axis], which every free mount rotation moves.
            let derivative = |other: MountComponent| left[(component.axis(), other.axis())];
            for (i, p) in parameters.iter().enumerate() {
                let Some(at_i) = rotation(*p) else { continue };
                rhs[i] -= weight * derivative(at_i) * turn[component.axis()];
                for (j, q) in parameters.iter().enumerate() {
                    if let Some(at_j) = rotation(*q) {
                        normal_matrix[(i, j)] += weight * derivative(at_i) * derivative(at_j);
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
    use crate::synthetic::{Errors, hp3j, normal, perturbed, seeded};

    #[test]
    fn the_gradient_of_the_priors_agrees_with_differences() {
        let nominal = hp3j();
        let errors = Errors { angle: 0.02, length: 1e-3, mount_angle: 0.3, mount_length: 0.02, fixed_size: true };
        let model = Model::new(perturbed(&nominal, &Free::Auto, errors, &mut seeded(2)));
        let parameters = Free::All.candidates(&nominal, true, true).unwrap();
        let priors = Priors::new(&nominal, &Free::All, PriorPolicy::Auto, &parameters);
        let mut normal_matrix = DMatrix::zeros(parameters.len(), parameters.len());
        let mut rhs = DVector::zeros(parameters.len());
        priors.add_to(&nominal, &model, &parameters, &mut normal_matrix, &mut rhs);
        for (k, &parameter) in parameters.iter().enumerate() {
            let step = 1e-6 * priors.sigmas[k].unwrap();
            let at = |change| priors.cost(&nominal, &model.stepped(&[parameter], &[change]).unwrap(), &parameters);
            let slope = (at(step) - at(-step)) / (2.0 * step);
            let scale = 1.0 / priors.sigmas[k].unwrap();
            assert!((slope + rhs[k]).abs() < 1e-4 * scale.max(slope.abs()), "{parameter}: {slope} {}", rhs[k]);
        }
        assert!((&normal_matrix - normal_matrix.transpose()).amax() < 1e-9 * normal_matrix.amax());
    }

    #[test]
    fn the_rig_overrides_the_defaults_and_a_list_has_none() {
        let mut rig = hp3j();
        rig.prior.angle_deg = Some(1.0);
        let parameters = Free::Angles.candidates(&rig, true, false).unwrap();
        let of = |rig: &Rig, free: &Free, policy| Priors::new(rig, free, policy, &parameters).sigmas[0];
        assert_eq!(of(&rig, &Free::Angles, PriorPolicy::Auto), Some(1f64.to_radians()));
        rig.prior.angle_deg = None;
        assert_eq!(of(&rig, &Free::Angles, PriorPolicy::Auto), None);
        assert_eq!(of(&rig, &Free::Auto, PriorPolicy::Auto), Some(PriorGroup::Angles.median()));
        assert_eq!(of(&rig, &Free::Auto, PriorPolicy::Never), None);
    }

    #[test]
    fn a_known_sigma_is_recovered_and_silence_leaves_the_median() {
        let mut rng = seeded(3);
        for truth in [1e-4, 3e-3] {
            let squares: f64 = (0..4000).map(|_| (truth * normal(&mut rng)).powi(2)).sum();
            let found = likeliest_sigma(squares, 4000.0, 1e-3);
            assert!((found / truth - 1.0).abs() < 0.04, "{found} for {truth}");
        }
        assert!((likeliest_sigma(0.0, 0.0, 2e-3) / 2e-3 - 1.0).abs() < 1e-9);
        // Few numbers: the greatest density of the sigma's logarithm, searched for.
        let (squares, median) = (2e-5, 1e-3f64);
        let cost = |log: f64| {
            3.0 * log + 0.5 * squares * (-2.0 * log).exp() + 0.5 * ((log - median.ln()) / LOG_SPREAD).powi(2)
        };
        let grid = (0..20_000).map(|k| median.ln() - 5.0 + 5e-4 * f64::from(k));
        let best = grid.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap().exp();
        let found = likeliest_sigma(squares, 3.0, median);
        assert!((found / best - 1.0).abs() < 1e-3, "{found} {best}");
    }
}
