//! Which parameters the data determine and which they do not, in numbers and in words.
//!
//! The singular values are those of the Jacobian of all residuals (in units of their sigma, scene points and joint
//! errors eliminated) with each parameter scaled by [`Parameter::scale`]: equal weight for 0.01 rad and 1 cm. They are
//! computed as roots of the eigenvalues of its normal matrix, so that ratios below about 1e-7 are rounding; below
//! [`RANK_THRESHOLD`] a direction counts as unobservable.
//!
//! Observability indices over the directions that are seen: O1 Borm and Menq 1991; O2 Driels and Pathre 1990; O3 Nahvi,
//! Hollerbach and Hayward 1994; O4 (noise amplification) Nahvi and Hollerbach 1996; O5 Sun and Hollerbach 2008.

use crate::{Model, Parameter, Unit, free};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use skclam_kinematics::{ParameterId, ParameterKind};
use skclam_rig::{Posture, PostureState, Rig};

/// A direction whose singular value is below this fraction of the greatest is unobservable.
pub const RANK_THRESHOLD: f64 = 3e-6;
/// Components below this fraction of the greatest are left out of a combination.
const SHOWN: f64 = 0.05;

/// What the data determine of the free parameters, without priors.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Identifiability {
    /// Of the scaled Jacobian, greatest first; one a free parameter.
    pub singular_values: Vec<f64>,
    /// Directions that are seen.
    pub rank: usize,
    /// Greatest over smallest seen singular value.
    pub condition_number: f64,
    /// O1 to O5 over the directions that are seen.
    pub observability: [f64; 5],
    /// Directions that are not seen.
    pub unobservable: Vec<UnobservableDirection>,
    /// The direction that is seen worst, scaled components, greatest first.
    pub weakest: Vec<(Parameter, f64)>,
}

/// A combination of parameters that is not identifiable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnobservableDirection {
    /// Parameters and how far each moves (scaled by [`Parameter::scale`], the greatest 1): such a change alters no
    /// residual.
    pub combination: Vec<(Parameter, f64)>,
    /// Which kind.
    pub cause: UnobservableCause,
    /// The same in plain words.
    pub reason: String,
}

/// Why a direction is not seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum UnobservableCause {
    /// It moves the base and the whole world with it.
    BaseGauge,
    /// It is the mount's by another name.
    ToolGauge,
    /// All lengths scale together.
    Scale,
    /// Neighbouring axes are parallel.
    ParallelAxes,
    /// A joint hardly moved.
    InsufficientExcitation,
    /// The postures do not separate the parameters.
    Postures,
}

/// Rank, indices and names from the normal matrix of the data (natural units, no priors).
pub(crate) fn identify(
    model: &Model,
    postures: &[Posture],
    parameters: &[Parameter],
    normal_matrix: &DMatrix<f64>,
) -> Identifiability {
    let count = parameters.len();
    let scales = DVector::from_iterator(count, parameters.iter().map(|p| p.scale()));
    let scaled = DMatrix::from_fn(count, count, |i, j| {
        0.5 * (normal_matrix[(i, j)] + normal_matrix[(j, i)]) * scales[i] * scales[j]
    });
    let eigen = scaled.symmetric_eigen();
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let singular_values: Vec<f64> = order.iter().map(|&i| eigen.eigenvalues[i].max(0.0).sqrt()).collect();
    let greatest = singular_values.first().copied().unwrap_or_default();
    let rank = singular_values.iter().filter(|&&s| s > RANK_THRESHOLD * greatest).count();
    let seen = &singular_values[..rank];
    let smallest = seen.last().copied().unwrap_or_default();
    let observability = if rank == 0 {
        [0.0; 5]
    } else {
        let mean_log = seen.iter().map(|s| s.ln()).sum::<f64>() / rank as f64;
        [
            mean_log.exp() / (postures.len().max(1) as f64).sqrt(),
            smallest / greatest,
            smallest,
            smallest * smallest / greatest,
            1.0 / seen.iter().map(|s| 1.0 / s).sum::<f64>(),
        ]
    };
    let basis: Vec<DVector<f64>> = order[rank..].iter().map(|&i| eigen.eigenvectors.column(i).into_owned()).collect();
    let unobservable = sparse_basis(basis, &model.rig, parameters)
        .into_iter()
        .map(|direction| name_direction(&direction, model, postures, parameters))
        .collect();
    let weakest = match rank {
        0 => Vec::new(),
        rank => combination(&eigen.eigenvectors.column(order[rank - 1]).into_owned(), parameters),
    };
    Identifiability {
        condition_number: if rank == 0 { f64::INFINITY } else { greatest / smallest },
        singular_values,
        rank,
        observability,
        unobservable,
        weakest,
    }
}

/// Turns any basis of the unobservable space into one with few components a direction: Gauss-Jordan elimination whose
/// pivots are the parameters of the known gauge first, then the greatest components.
fn sparse_basis(mut rows: Vec<DVector<f64>>, rig: &Rig, parameters: &[Parameter]) -> Vec<DVector<f64>> {
    let gauge = free::gauge(rig);
    let mut columns: Vec<usize> = (0..parameters.len()).filter(|&k| gauge.contains(&parameters[k])).collect();
    let mut done = 0;
    while done < rows.len() {
        let greatest = |column: usize| {
            (done..rows.len())
                .map(|row| (row, rows[row][column].abs()))
                .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
        };
        let pivot = if let Some(column) = columns.first().copied() {
            columns.remove(0);
            greatest(column).filter(|(_, size)| *size > SHOWN).map(|(row, _)| (row, column))
        } else {
            (0..parameters.len())
                .filter_map(|column| greatest(column).map(|(row, size)| (row, column, size)))
                .max_by(|a, b| a.2.total_cmp(&b.2).then(b.1.cmp(&a.1)))
                .map(|(row, column, _)| (row, column))
        };
        let Some((row, column)) = pivot else { continue };
        rows.swap(done, row);
        let size = rows[done][column];
        rows[done] /= size;
        let pivot_row = rows[done].clone();
        for (other, row) in rows.iter_mut().enumerate() {
            if other != done {
                *row -= &pivot_row * row[column];
            }
        }
        done += 1;
    }
    rows
}

fn combination(direction: &DVector<f64>, parameters: &[Parameter]) -> Vec<(Parameter, f64)> {
    let greatest = direction.amax();
    let mut shown: Vec<(Parameter, f64)> = parameters
        .iter()
        .zip(direction.iter())
        .filter(|(_, size)| size.abs() > SHOWN * greatest)
        .map(|(&parameter, size)| (parameter, size / greatest))
        .collect();
    shown.sort_by(|a, b| b.1.abs().total_cmp(&a.1.abs()).then(a.0.cmp(&b.0)));
    shown
}

fn name_direction(
    direction: &DVector<f64>,
    model: &Model,
    postures: &[Posture],
    parameters: &[Parameter],
) -> UnobservableDirection {
    let combination = combination(direction, parameters);
    let names: Vec<String> = combination.iter().map(|(parameter, _)| parameter.to_string()).collect();
    let gauge = free::gauge(&model.rig);
    let last = model.rig.robot.as_ref().map_or(0, |robot| robot.joint_count().saturating_sub(1));
    let of_gauge = |joint: usize| {
        combination.iter().find(|(p, _)| matches!(p, Parameter::Chain(id) if id.joint == joint && gauge.contains(p)))
    };
    let mounted = combination.iter().any(|(p, _)| matches!(p, Parameter::Mount(_)));
    let (cause, reason) = if let ([(parameter, _)], Some(_)) = (&combination[..], of_gauge(0)) {
        (
            UnobservableCause::BaseGauge,
            format!("{parameter} moves the base and the whole world with it: not identifiable from images"),
        )
    } else if let (Some((parameter, _)), true) = (of_gauge(last), mounted) {
        let what = if parameter.unit() == Unit::Radian { "angle" } else { "length" };
        (
            UnobservableCause::ToolGauge,
            format!("{parameter} and the mount ({}) are one {what}", others(&names, parameter)),
        )
    } else if is_scale(direction, model, parameters) {
        let held = if names.iter().any(|name| name == "depth_scale") {
            "the depth's own scale is free and no board or fixed length is there"
        } else {
            "no depth, no board, no fixed length"
        };
        (
            UnobservableCause::Scale,
            format!("the scale is not observable: {held}; every length may grow by the same factor"),
        )
    } else if let Some((a, b)) = parallel_pair(&combination, model) {
        (UnobservableCause::ParallelAxes, format!("{a} and {b} lie along parallel axes: they are one length"))
    } else if let Some((joint, range)) = insufficient_excitation(&combination, postures) {
        (
            UnobservableCause::InsufficientExcitation,
            format!("joint {} moved by only {range:.1} deg: {} cannot be separated", joint + 1, names.join(", ")),
        )
    } else {
        (UnobservableCause::Postures, format!("the postures do not separate {}", names.join(", ")))
    };
    UnobservableDirection { combination, cause, reason }
}

fn others(names: &[String], parameter: &Parameter) -> String {
    let own = parameter.to_string();
    names.iter().filter(|name| **name != own).cloned().collect::<Vec<_>>().join(", ")
}

/// Whether the direction makes every length grow by the same factor and turns nothing.
fn is_scale(direction: &DVector<f64>, model: &Model, parameters: &[Parameter]) -> bool {
    let scaling = DVector::from_iterator(
        parameters.len(),
        parameters.iter().map(|&parameter| {
            let value = match parameter {
                Parameter::Chain(_) | Parameter::Mount(_) if parameter.unit() == Unit::Metre => {
                    model.value(&model.rig, parameter).unwrap_or_default()
                }
                Parameter::DepthScale => model.depth.scale,
                Parameter::DepthOffset => model.depth.offset_m,
                _ => 0.0,
            };
            value / parameter.scale()
        }),
    );
    // Lengths of the base and tool gauges may have been eliminated from the direction, so compare where it is not zero.
    let masked = scaling.zip_map(direction, |g, d| if d == 0.0 { 0.0 } else { g });
    let (a, b) = (masked.norm(), direction.norm());
    a > 0.0 && b > 0.0 && (masked.dot(direction) / (a * b)).abs() > 0.98
}

fn parallel_pair(combination: &[(Parameter, f64)], model: &Model) -> Option<(Parameter, Parameter)> {
    let robot = model.rig.robot.as_ref()?;
    let [(Parameter::Chain(a), x), (Parameter::Chain(b), y)] = combination[..] else { return None };
    if a.kind != ParameterKind::D || b.kind != ParameterKind::D || (x.abs() - y.abs()).abs() > 0.1 {
        return None;
    }
    let between = |id: ParameterId| robot.parameter(ParameterId { kind: ParameterKind::Alpha, ..id });
    let parallel = [a, b].into_iter().filter_map(between).any(|alpha| alpha.sin().abs() < 0.1);
    parallel.then_some((Parameter::Chain(a), Parameter::Chain(b)))
}

/// The joint that moved least among those next to the combination, if it moved by less than 10 deg.
fn insufficient_excitation(combination: &[(Parameter, f64)], postures: &[Posture]) -> Option<(usize, f64)> {
    let joint_of = |parameter: &Parameter| match *parameter {
        Parameter::Chain(id) => Some(id.joint),
        Parameter::TransmissionSin(joint) | Parameter::TransmissionCos(joint) | Parameter::Compliance(joint) => {
            Some(joint)
        }
        _ => None,
    };
    combination
        .iter()
        .filter_map(|(parameter, _)| joint_of(parameter))
        .flat_map(|joint| [joint.checked_sub(1), Some(joint)].into_iter().flatten())
        .filter_map(|joint| Some((joint, range_deg(joint, postures)?)))
        .filter(|(_, range)| *range < 10.0)
        .min_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)))
}

fn range_deg(joint: usize, postures: &[Posture]) -> Option<f64> {
    let values = postures.iter().filter_map(|posture| match &posture.state {
        PostureState::Joints(values) => values.get(joint).copied(),
        PostureState::FlangePose(_) => None,
    });
    let (low, high) =
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    (high >= low).then(|| (high - low).to_degrees())
}
