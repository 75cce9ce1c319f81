//! What the errors of single postures have in common: score tests of the usual causes.
//!
//! Errors of single postures are taken as independent normal numbers `e` with variances `D`. A cause adds a pattern to
//! them, `e = e' + B g` with few numbers `g`: a step in time of one joint, a camera that slipped, a clock that is late,
//! gears, compliance. With the posterior mean `e` and covariance `C` at `g = 0`, the score of the marginal likelihood
//! is `s = B^T D^-1 e`, its information `M = B^T (D^-1 - D^-1 C D^-1) B`, the estimate `M^-1 s`, and twice the gain of
//! the logarithm of the likelihood `s^T M^-1 s` (Rao's score test; Breslow and Clayton, "Approximate inference in
//! generalized linear mixed models", 1993). Nothing is refitted.
//!
//! Postures at one arm position share errors, so that they are no independent witnesses. The smaller counts of the test
//! above and of the one whose variance is that of the scores over arm positions (cluster-robust; Liang and Zeger,
//! "Longitudinal data analysis using generalized linear models", 1986).

use crate::camera_kinematics::CameraKinematics;
use crate::{CalibrationError, Model, MountComponent, Parameter, PostureErrorKnowledge};
use nalgebra::{DMatrix, DVector, Vector6};
use serde::{Deserialize, Serialize};
use skclam_rig::JointReading;

/// What posture errors may have in common.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum ErrorPattern {
    /// A joint's zero moved: from a posture on it is off by as much more. Radians (metres for a prismatic joint).
    JointStep {
        /// Counted from 0.
        joint: usize,
        /// Position of the first posture after it.
        from: usize,
    },
    /// The camera moved on the flange: from a posture on it sits elsewhere. Radians: the angle by which it turned.
    CameraSlip {
        /// Position of the first posture after it.
        from: usize,
        /// How far it moved, metres.
        translation_m: f64,
    },
    /// Joints were read too early or too late. Seconds.
    TimeOffset,
    /// A transmission error with the period of a joint's turn. Radians: its amplitude.
    Transmission {
        /// Counted from 0.
        joint: usize,
        /// 1 for the period of a turn, 2 for half of it.
        harmonic: u32,
    },
    /// A joint gives way under the arm's weight. Radians per metre of gravity torque arm.
    Compliance {
        /// Counted from 0.
        joint: usize,
    },
}

/// A pattern that the posture errors have.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PatternFinding {
    /// Which.
    pub pattern: ErrorPattern,
    /// Its size, in the unit of the pattern.
    pub size: f64,
    /// Sigma of that.
    pub sigma: f64,
    /// Twice the gain of the logarithm of the likelihood: chi squared with `dof` degrees of freedom where the pattern
    /// is not there.
    pub chi_squared: f64,
    /// Numbers of the pattern.
    pub dof: usize,
}

/// Arm positions before and after a step at least.
const MIN_AROUND_STEP: usize = 3;
/// Arm positions for each number of a pattern at least.
const MIN_POSITIONS_A_NUMBER: usize = 3;
/// Twice the gain of the log-likelihood from which a pattern of one number is accepted: one in a million by chance
/// alone, so that the number of patterns that are tried and errors that are not quite normal do not matter.
const ACCEPTED: f64 = 24.0;
/// The same for each further number.
const ACCEPTED_PER_NUMBER: f64 = 3.0;

/// The accepted patterns, the one that explains most first.
pub(crate) fn error_patterns(
    model: &Model,
    motion: &CameraKinematics,
    knowledge: &PostureErrorKnowledge,
    positions: &[usize],
) -> Result<Vec<PatternFinding>, CalibrationError> {
    let tests = ScoreTests::new(knowledge, positions);
    let postures = motion.len();
    let mut found = Vec::new();
    if motion.has_joints() {
        let column = |joint: usize, value: &dyn Fn(&JointReading) -> f64| {
            let mut column = DVector::zeros(knowledge.mean.len());
            (0..postures).for_each(|at| column[at * knowledge.components + joint] = value(&motion.readings(at)[joint]));
            column
        };
        let joints = 0..knowledge.components;
        found.extend(joints.clone().filter_map(|joint| tests.joint_step(joint, postures)));
        for harmonic in [1u32, 2] {
            let angle = |r: &JointReading| f64::from(harmonic) * r.value;
            let columns = joints
                .clone()
                .map(|joint| vec![column(joint, &|r| angle(r).sin()), column(joint, &|r| angle(r).cos())]);
            let pattern = |joint| ErrorPattern::Transmission { joint, harmonic };
            found.extend(tests.of_joints(&pattern, &columns.collect::<Vec<_>>()));
        }
        let columns: Vec<_> = joints.map(|joint| vec![column(joint, &|r| r.gravity_arm)]).collect();
        found.extend(tests.of_joints(&|joint| ErrorPattern::Compliance { joint }, &columns));
        let mut late = DVector::zeros(knowledge.mean.len());
        for at in 0..postures {
            let rates = motion.readings(at).iter().map(|reading| reading.rate).enumerate();
            rates.for_each(|(joint, rate)| late[at * knowledge.components + joint] = rate);
        }
        found.extend(tests.pattern(ErrorPattern::TimeOffset, &[late]));
    }
    found.extend(tests.camera_slip(model, motion)?);
    found.retain(|finding| finding.chi_squared > ACCEPTED + ACCEPTED_PER_NUMBER * (finding.dof - 1) as f64);
    found.sort_by(|a, b| (b.chi_squared - 2.0 * b.dof as f64).total_cmp(&(a.chi_squared - 2.0 * a.dof as f64)));
    Ok(found)
}

struct ScoreTests<'a> {
    /// The arm position of each posture.
    positions: &'a [usize],
    /// How many there are.
    position_count: usize,
    components: usize,
    /// `D^-1 e`.
    score: DVector<f64>,
    /// `D^-1 - D^-1 C D^-1`.
    information: DMatrix<f64>,
    /// Sigma of each error.
    sigmas: Vec<f64>,
}

/// The best numbers of a pattern.
struct Fit {
    numbers: DVector<f64>,
    covariance: DMatrix<f64>,
    chi_squared: f64,
}

impl<'a> ScoreTests<'a> {
    fn new(knowledge: &PostureErrorKnowledge, positions: &'a [usize]) -> Self {
        let count = knowledge.mean.len();
        let weight = |k: usize| knowledge.sigmas[k].powi(-2);
        let information = DMatrix::from_fn(count, count, |i, j| {
            let own = if i == j { weight(i) } else { 0.0 };
            own - weight(i) * knowledge.covariance[(i, j)] * weight(j)
        });
        ScoreTests {
            positions,
            position_count: positions.iter().max().map_or(0, |last| last + 1),
            components: knowledge.components,
            score: DVector::from_fn(count, |k, _| weight(k) * knowledge.mean[k]),
            information,
            sigmas: knowledge.sigmas.clone(),
        }
    }

    fn solve(score: &DVector<f64>, information: &DMatrix<f64>) -> Option<Fit> {
        let covariance = crate::bundle::adjust::inverse(information)?;
        let numbers = &covariance * score;
        let chi_squared = score.dot(&numbers);
        (chi_squared.is_finite() && chi_squared > 0.0).then_some(Fit { numbers, covariance, chi_squared })
    }

    fn pattern(&self, pattern: ErrorPattern, columns: &[DVector<f64>]) -> Option<PatternFinding> {
        let design = DMatrix::from_columns(columns);
        if columns.iter().any(|column| column.amax() == 0.0) {
            return None;
        }
        let information = design.transpose() * (&self.information * &design);
        let fit = Self::solve(&(design.transpose() * &self.score), &information)?;
        let (size, sigma) = amplitude(&fit, columns.len());
        let c = self.components;
        let chi_squared = self.robust(fit.chi_squared, columns.len(), &|posture| {
            design.rows(posture * c, c).transpose() * self.score.rows(posture * c, c)
        })?;
        Some(PatternFinding { pattern, size, sigma, chi_squared, dof: columns.len() })
    }

    /// A pattern that each joint may have: by single joints, and by all of them together under the name of the one that
    /// has most of it.
    fn of_joints(&self, pattern: &dyn Fn(usize) -> ErrorPattern, columns: &[Vec<DVector<f64>>]) -> Vec<PatternFinding> {
        let alone = columns.iter().enumerate().filter_map(|(joint, own)| self.pattern(pattern(joint), own));
        let mut found: Vec<PatternFinding> = alone.collect();
        let most = found.iter().copied().max_by(|a, b| a.chi_squared.total_cmp(&b.chi_squared));
        let all: Vec<DVector<f64>> = columns.concat().into_iter().filter(|column| column.amax() > 0.0).collect();
        if let (Some(most), true) = (most, found.len() > 1) {
            let together = self.pattern(most.pattern, &all);
            found.extend(together.map(|all| PatternFinding { chi_squared: all.chi_squared, dof: all.dof, ..most }));
        }
        found
    }

    /// The smaller of a model's chi squared and of the one whose variance is that of the scores over arm positions.
    /// `None` with too few of these.
    fn robust(&self, model: f64, numbers: usize, score_of: &dyn Fn(usize) -> DVector<f64>) -> Option<f64> {
        if self.position_count < MIN_POSITIONS_A_NUMBER * numbers {
            return None;
        }
        let mut of_position = vec![DVector::zeros(numbers); self.position_count];
        for (posture, &position) in self.positions.iter().enumerate() {
            of_position[position] += score_of(posture);
        }
        let count = self.position_count as f64;
        let total = of_position.iter().sum::<DVector<f64>>();
        let mean = &total / count;
        let mut variance = DMatrix::zeros(numbers, numbers);
        for score in &of_position {
            let away = score - &mean;
            variance += &away * away.transpose() * (count / (count - numbers as f64));
        }
        let robust = Self::solve(&total, &variance)?.chi_squared;
        Some(model.min(robust))
    }

    /// Whether a step at a posture leaves arm positions enough on both sides.
    fn is_step(&self, from: usize) -> bool {
        let distinct = |range: &[usize]| {
            let mut positions = range.to_vec();
            positions.sort_unstable();
            positions.dedup();
            positions.len() >= MIN_AROUND_STEP
        };
        distinct(&self.positions[..from]) && distinct(&self.positions[from..])
    }

    /// How much of a step a posture has, its mean taken out.
    fn step_fraction(&self, posture: usize, from: usize) -> f64 {
        let after = (self.positions.len() - from) as f64 / self.positions.len() as f64;
        if posture >= from { 1.0 - after } else { -after }
    }

    /// The step of a joint that explains most.
    fn joint_step(&self, joint: usize, postures: usize) -> Option<PatternFinding> {
        let at = |posture: usize| posture * self.components + joint;
        let mut best: Option<PatternFinding> = None;
        let (mut score, mut information) = (0.0, 0.0);
        for from in (0..postures).rev() {
            score += self.score[at(from)];
            let later: f64 = (from + 1..postures).map(|other| self.information[(at(from), at(other))]).sum();
            information += self.information[(at(from), at(from))] + 2.0 * later;
            if information <= 0.0 || !self.is_step(from) {
                continue;
            }
            let of =
                |posture: usize| DVector::from_element(1, self.step_fraction(posture, from) * self.score[at(posture)]);
            let Some(chi_squared) = self.robust(score * score / information, 1, &of) else { continue };
            if best.is_none_or(|best| chi_squared > best.chi_squared) {
                best = Some(PatternFinding {
                    pattern: ErrorPattern::JointStep { joint, from },
                    size: score / information,
                    sigma: information.sqrt().recip(),
                    chi_squared,
                    dof: 2,
                });
            }
        }
        best
    }

    /// The slip of the camera that explains most. A camera that sits elsewhere looks like joints (or a flange) that are
    /// off by what moves it as much.
    fn camera_slip(
        &self,
        model: &Model,
        motion: &CameraKinematics,
    ) -> Result<Option<PatternFinding>, CalibrationError> {
        let mount = MountComponent::ALL.map(Parameter::Mount);
        let postures = motion.len();
        let mut designs = Vec::with_capacity(postures);
        for posture in 0..postures {
            let linear = motion.linearize(model, &mount, posture, &[])?;
            designs.push(self.errors_like(posture, &linear.by_joint, &linear.by_parameter));
        }
        let block = |a: usize, b: usize| {
            let c = self.components;
            designs[a].transpose() * self.information.view((a * c, b * c), (c, c)) * &designs[b]
        };
        let mut best: Option<(usize, Fit)> = None;
        let mut score = DVector::zeros(6);
        let mut information = DMatrix::zeros(6, 6);
        for from in (0..postures).rev() {
            score += designs[from].transpose() * self.score.rows(from * self.components, self.components);
            information += block(from, from);
            for other in from + 1..postures {
                let cross = block(from, other);
                information += &cross + cross.transpose();
            }
            if !self.is_step(from) {
                continue;
            }
            let Some(mut fit) = Self::solve(&score, &information) else { continue };
            let c = self.components;
            let of = |posture: usize| {
                designs[posture].transpose() * self.score.rows(posture * c, c) * self.step_fraction(posture, from)
            };
            let Some(chi_squared) = self.robust(fit.chi_squared, 6, &of) else { continue };
            fit.chi_squared = chi_squared;
            if best.as_ref().is_none_or(|(_, best)| fit.chi_squared > best.chi_squared) {
                best = Some((from, fit));
            }
        }
        Ok(best.map(|(from, fit)| {
            let (size, sigma) = amplitude(&fit, 3);
            let translation_m = fit.numbers.rows(3, 3).norm();
            let pattern = ErrorPattern::CameraSlip { from, translation_m };
            PatternFinding { pattern, size, sigma, chi_squared: fit.chi_squared, dof: 7 }
        }))
    }

    /// The likeliest errors of a posture (6 columns) that move the camera as the mount's components do.
    fn errors_like(&self, posture: usize, by_error: &[Vector6<f64>], by_mount: &[Vector6<f64>]) -> DMatrix<f64> {
        let c = self.components;
        let jacobian = DMatrix::from_fn(6, c, |row, k| by_error[k][row]);
        let wanted = DMatrix::from_fn(6, 6, |row, k| by_mount[k][row]);
        let variances = DVector::from_fn(c, |k, _| self.sigmas[posture * c + k].powi(2));
        let spread = &jacobian * DMatrix::from_diagonal(&variances) * jacobian.transpose();
        // Directions that no joint moves well are left to the damping.
        let damping = 1e-4 * spread.trace() / 6.0;
        let damped = spread + DMatrix::identity(6, 6) * damping.max(f64::MIN_POSITIVE);
        let Some(factor) = damped.cholesky() else { return DMatrix::zeros(c, 6) };
        DMatrix::from_diagonal(&variances) * jacobian.transpose() * factor.solve(&wanted)
    }
}

/// Norm of the first `count` numbers (with its sign where it is one), and its sigma.
fn amplitude(fit: &Fit, count: usize) -> (f64, f64) {
    if count == 1 {
        return (fit.numbers[0], fit.covariance[(0, 0)].max(0.0).sqrt());
    }
    let part = fit.numbers.rows(0, count).into_owned();
    let norm = part.norm();
    let covariance = fit.covariance.view((0, 0), (count, count));
    let along = if norm > 0.0 { &part / norm } else { part.clone() };
    (norm, along.dot(&(covariance * &along)).max(0.0).sqrt())
}
