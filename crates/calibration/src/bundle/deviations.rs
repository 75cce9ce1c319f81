//! What joints stand off their values, posture by posture: how many unknowns they are, and what the data tell of their sigma.

use crate::bundle::adjust::{Adjustment, inverse};
use crate::bundle::solve::Solve;
use crate::bundle::state::State;
use crate::motion::Motion;
use crate::robust::median;
use crate::{BundleOptions, CalibrationError, DeviationPolicy, Warning};
use nalgebra::DVector;
use skclam_rig::Rig;

/// Sigma of the deviations before the data are heard, rad (0.003 deg).
const FIRST_DEVIATION: f64 = 5.2e-5;
/// A posture whose deviations are so many times as large as those of the median posture says nothing about the encoders.
const FAR_OFF: f64 = 5.0;

/// What the data tell of the joint deviations.
pub(super) struct DeviationsTold {
    /// `None` where they tell too little.
    pub sigma: Option<f64>,
    /// How many of them are determined by the data rather than by their prior.
    pub determined: f64,
    /// Degrees of freedom of the sigma's estimate.
    pub freedom: f64,
    /// Postures whose deviations are far larger than the others' and than the sigma held until now.
    pub far_off: Vec<usize>,
}

impl Solve<'_> {
    /// What the data tell of the joint deviations; `None` where their covariance cannot be had.
    ///
    /// The sigma is the one under which the data are most likely (MacKay, "Bayesian interpolation", 1992): squared deviations over the number of them that the
    /// data determine.
    pub(super) fn deviations_told(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
    ) -> Result<Option<DeviationsTold>, CalibrationError> {
        let prior = adjustment.noise.deviation;
        let mut information = adjustment.information(state, prior)?;
        let mut ignored = DVector::zeros(information.nrows());
        self.priors.add_to(self.nominal, &state.model, self.parameters, &mut information, &mut ignored);
        let Some(covariance) = inverse(&information) else { return Ok(None) };
        let count = state.deviations.len();
        let first = information.nrows() - count;
        let joints = count / self.motion.len();
        let share = |k: usize| (1.0 - covariance[(first + k, first + k)] / (prior * prior)).clamp(0.0, 1.0);
        // Squares and determined numbers, posture by posture: one that stands far off (a bumped camera, wrong joints) is no encoder noise.
        let of_posture: Vec<(f64, f64)> = (0..self.motion.len())
            .map(|posture| {
                let range = posture * joints..(posture + 1) * joints;
                let determined = range.clone().map(share).sum();
                (state.deviations[range].iter().map(|d| d * d).sum(), determined)
            })
            .collect();
        let ratio = |(squares, determined): &(f64, f64)| squares / determined.max(1e-3);
        let usual = median(&mut of_posture.iter().map(ratio).collect::<Vec<_>>());
        let limit = FAR_OFF * FAR_OFF * usual;
        let kept = of_posture.iter().filter(|posture| ratio(posture) <= limit);
        let (squares, determined) = kept.fold((0.0, 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
        let limit = limit.max((FAR_OFF * prior).powi(2));
        let far_off = (0..of_posture.len()).filter(|&posture| ratio(&of_posture[posture]) > limit).collect();
        // Twice the information about the logarithm of the variance: the squared norm of `1 - covariance / prior`.
        let spread = covariance.view((first, first), (count, count)) / (prior * prior);
        let freedom = (0..count).map(|k| 1.0 - 2.0 * spread[(k, k)]).sum::<f64>() + spread.norm_squared();
        let sigma = (determined >= 0.5).then(|| (squares / determined).sqrt());
        Ok(Some(DeviationsTold { sigma, determined: (0..count).map(share).sum(), freedom, far_off }))
    }
}

/// How many joints deviate, and with which sigma at first.
pub(super) fn deviation_unknowns(
    nominal: &Rig,
    motion: &Motion,
    options: &BundleOptions,
    warnings: &mut Vec<Warning>,
) -> (usize, f64) {
    let stated = nominal.prior.joint_deviation_deg;
    let sigma = match options.deviations {
        DeviationPolicy::Off => return (0, FIRST_DEVIATION),
        DeviationPolicy::SigmaDeg(deg) => deg.to_radians(),
        DeviationPolicy::Estimated => stated.map_or(FIRST_DEVIATION, f64::to_radians),
    };
    let joints = if motion.has_joints() { nominal.robot.as_ref().map_or(0, |robot| robot.joint_count()) } else { 0 };
    let unknowns = joints * motion.len();
    if sigma <= 0.0 || joints == 0 {
        return (0, FIRST_DEVIATION);
    }
    if unknowns > options.max_deviations {
        warnings.push(Warning::DeviationsOff { unknowns, limit: options.max_deviations });
        return (0, FIRST_DEVIATION);
    }
    (joints, sigma)
}
