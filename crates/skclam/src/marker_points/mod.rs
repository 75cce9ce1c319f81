//! A rig judged by positions of a marker on the flange that an external instrument (optical or laser tracker) measured.
//!
//! Begin with [`validate_points`]. Neither the marker's place on the flange nor the instrument's frame is known: both
//! are fitted to each rig, so that only what the kinematics explain counts. What remains is the rig's error of position
//! where the points lie, with the instrument's noise. Against the nominal rig the test is paired, point by point, with
//! a standard error over clusters of points: the errors of points at one arm position are alike, so that they count as
//! one.

mod comparison;
mod observability;
mod robust;
mod solve;
mod table;
#[cfg(test)]
mod tests;

use crate::dataset::DatasetError;
use crate::pipeline::Status;
use nalgebra::{DMatrix, Vector3};
use robust::RobustFit;
use serde::{Deserialize, Serialize};
use skclam_rig::{Posture, PostureState, Rig};
use solve::{FRAME_UNKNOWNS, Observation, Problem, State};
use std::path::{Path, PathBuf};

/// One measured position.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkerPoint {
    /// Line of the table, counted from 1 (the header).
    pub line: usize,
    /// The table's own number of the point.
    pub index: Option<u64>,
    /// Arm position or another name of points whose errors are alike.
    pub group: Option<String>,
    /// Which of [`MarkerPoints::markers`].
    pub marker: usize,
    /// Joint values as the encoders said, radians or metres.
    pub joints: Vec<f64>,
    /// The marker in the tracker's frame, metres.
    pub position_m: Vector3<f64>,
    /// The instrument's standard deviation a coordinate, metres.
    pub sigma_m: Option<Vector3<f64>>,
}

/// Measured positions of markers on a flange, the arm at rest.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkerPoints {
    /// Where they come from, for messages.
    pub path: PathBuf,
    /// The points, in the order of the table.
    pub points: Vec<MarkerPoint>,
    /// Names of the markers; each has an offset of its own.
    pub markers: Vec<String>,
    /// Whether the points name groups.
    pub grouped: bool,
}

impl MarkerPoints {
    /// Reads a table (CSV). Columns are found by name: joints as in `postures.csv` (`q1_deg`, `q1_rad`, `qk_mm`),
    /// `x_mm`, `y_mm`, `z_mm` (or `_m`), optional `index`, `group`, `marker`, `timestamp_s` (ignored: the arm is at
    /// rest) and `sigma_mm` or `sigma_x_mm` and so on.
    ///
    /// # Errors
    /// File, line and column of what is wrong, and what was expected.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, DatasetError> {
        table::read(path.as_ref())
    }

    /// The points with the flange's poses by a rig.
    fn observations(&self, rig: &Rig) -> Result<Vec<Observation>, DatasetError> {
        let observation = |point: &MarkerPoint| {
            let index = point.index.unwrap_or(point.line as u64);
            let posture = Posture::new(index, PostureState::Joints(point.joints.clone()));
            let base_from_flange = rig.base_from_flange(&posture).map_err(|source| DatasetError::Posture {
                path: self.path.clone(),
                line: point.line,
                source,
            })?;
            let &MarkerPoint { marker, position_m, sigma_m, .. } = point;
            Ok(Observation { base_from_flange, marker, position_m, sigma_m })
        };
        self.points.iter().map(observation).collect()
    }
}

/// How a rig fares on measured points, beside the nominal one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointsValidation {
    /// Points of the table.
    pub points: usize,
    /// Clusters of points whose errors are taken to be alike.
    pub clusters: usize,
    /// What makes a cluster.
    pub clustered_by: ClusteredBy,
    /// Points that every rig contradicts grossly; no metric counts them.
    pub outliers: Vec<OutlierPoint>,
    /// RMS of the instrument's standard deviations of a coordinate, millimetres, where the table has them.
    pub instrument_sigma_mm: Option<f64>,
    /// The rig under test.
    pub tested: PointsFit,
    /// The nominal rig.
    pub nominal: Option<PointsFit>,
    /// The one against the other.
    pub comparison: Option<PointsComparison>,
}

/// What makes points a cluster.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClusteredBy {
    /// The table's column `group`.
    Group,
    /// Equal joints before the wrist (the first three), to a tenth of a degree or millimetre.
    Joints,
}

/// A point of gross error.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutlierPoint {
    /// Line of the table, counted from 1 (the header).
    pub line: usize,
    /// The table's own number of the point.
    pub index: Option<u64>,
    /// Its group.
    pub group: Option<String>,
    /// How far it lies from where the rig puts it, millimetres; of several rigs, the least.
    pub distance_mm: f64,
}

/// A rig with its best frame and offsets on the points that are no outliers. Errors are lengths of vectors in space.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointsFit {
    /// Name of the rig.
    pub rig: String,
    /// Points that count.
    pub points: usize,
    /// RMS of the errors of position, millimetres.
    pub rms_mm: f64,
    /// Median, millimetres.
    pub median_mm: f64,
    /// Largest, millimetres.
    pub max_mm: f64,
    /// Standard deviation of a coordinate, corrected for the fitted numbers, millimetres.
    pub sigma_mm: f64,
    /// Degrees of freedom: coordinates less fitted numbers.
    pub dof: usize,
    /// Errors cluster by cluster, in the order of the table; empty where each point is its own.
    pub groups: Vec<GroupErrors>,
    /// The fitted frame: takes points from the rig's base to the tracker.
    pub tracker_from_base: FittedFrame,
    /// The fitted offsets.
    pub offsets: Vec<MarkerOffset>,
    /// What the points do not determine of the offsets; held at zero.
    pub unobservable: Vec<UnobservableOffset>,
    /// Points of gross error by this rig alone; they count, since another rig explains them.
    pub contradicted: Vec<OutlierPoint>,
}

/// Errors of one cluster.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GroupErrors {
    /// The group's name, or that of its first line.
    pub group: String,
    /// Points that count.
    pub points: usize,
    /// RMS of the errors of position, millimetres.
    pub rms_mm: f64,
}

/// A pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FittedFrame {
    /// Translation, millimetres.
    pub translation_mm: [f64; 3],
    /// Rotation as a unit quaternion.
    pub quaternion_xyzw: [f64; 4],
}

/// Where a marker is on the flange.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MarkerOffset {
    /// Its name.
    pub marker: String,
    /// In the flange's frame, millimetres.
    pub offset_mm: [f64; 3],
    /// Standard deviations if the errors of points were independent, millimetres; `null` where a part of it is not
    /// observable.
    pub sigma_mm: Option<[f64; 3]>,
}

/// A direction in which an offset is not observable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UnobservableOffset {
    /// The marker that it concerns most.
    pub marker: String,
    /// Unit vector in the flange's frame.
    pub direction: [f64; 3],
    /// Millimetres that the points move (RMS, after the frame has followed) a millimetre of the offset.
    pub sensitivity: f64,
}

/// The rig under test against the nominal one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PointsComparison {
    /// RMS of the nominal rig less that of the rig under test, millimetres.
    pub improvement_mm: f64,
    /// Its standard error by the jackknife over clusters, millimetres; `null` with fewer than three clusters.
    pub standard_error_mm: Option<f64>,
    /// Good: better by more than two standard errors. Bad: worse by as many. Caution: not distinguishable.
    pub status: Status,
}

/// Judges `tested`, and beside it `nominal`, by measured points.
///
/// A point is left out only where every rig contradicts it grossly (beyond six robust standard deviations), and both
/// rigs are then fitted by least squares to the same points.
///
/// # Errors
/// Too few points; joints that a rig does not have.
pub fn validate_points(
    points: &MarkerPoints,
    tested: &Rig,
    nominal: Option<&Rig>,
) -> Result<PointsValidation, DatasetError> {
    let clusters = comparison::clusters(points);
    let fitted = |rig: &Rig| fit_rig(points, rig);
    let tested = (tested, fitted(tested)?);
    let nominal = nominal.map(|rig| Ok::<_, DatasetError>((rig, fitted(rig)?))).transpose()?;
    let gross = |at: &usize| nominal.as_ref().is_none_or(|(_, (_, fit))| fit.outliers.binary_search(at).is_ok());
    let outliers: Vec<usize> = tested.1.1.outliers.iter().copied().filter(gross).collect();
    let used: Vec<usize> = (0..points.points.len()).filter(|at| outliers.binary_search(at).is_err()).collect();
    let least = |(_, (observations, fit)): &(&Rig, Fitted), at: usize| fit.state.residual(&observations[at]).norm();
    let named = outliers.iter().map(|&at| {
        let distance_m = nominal.as_ref().map_or(f64::INFINITY, |rig| least(rig, at)).min(least(&tested, at));
        outlier(points, at, distance_m)
    });
    let known: Vec<f64> = points.points.iter().filter_map(|p| Some(p.sigma_m?.norm_squared() / 3.0)).collect();
    let mean_square = known.iter().sum::<f64>() / known.len().max(1) as f64;
    let report = |(rig, (observations, fit)): &(&Rig, Fitted)| {
        Report { points, clusters: &clusters, observations, fit, used: &used }.of(&rig.name)
    };
    Ok(PointsValidation {
        points: points.points.len(),
        clusters: clusters.members.len(),
        clustered_by: clusters.by,
        outliers: named.collect(),
        instrument_sigma_mm: (!known.is_empty()).then(|| 1e3 * mean_square.sqrt()),
        comparison: nominal.as_ref().map(|(_, nominal)| comparison::compare(nominal, &tested.1, &used, &clusters)),
        nominal: nominal.as_ref().map(report),
        tested: report(&tested),
    })
}

/// The points with a rig's flange poses, and the robust fit to them.
type Fitted = (Vec<Observation>, RobustFit);

fn fit_rig(points: &MarkerPoints, rig: &Rig) -> Result<Fitted, DatasetError> {
    let markers = points.markers.len();
    // Twice as many coordinates as numbers that are fitted.
    let need = (2 * (FRAME_UNKNOWNS + 3 * markers)).div_ceil(3);
    let got = points.points.len();
    if got < need {
        return Err(DatasetError::TooFewPoints { path: points.path.clone(), got, need, markers });
    }
    let observations = points.observations(rig)?;
    let fit = robust::fit(&observations, markers);
    Ok((observations, fit))
}

fn outlier(points: &MarkerPoints, at: usize, distance_m: f64) -> OutlierPoint {
    let MarkerPoint { line, index, group, .. } = &points.points[at];
    OutlierPoint { line: *line, index: *index, group: group.clone(), distance_mm: 1e3 * distance_m }
}

/// RMS of the lengths of residuals, in their unit.
fn rms(lengths: &[f64]) -> f64 {
    (lengths.iter().map(|length| length * length).sum::<f64>() / lengths.len().max(1) as f64).sqrt()
}

/// What is reported of one rig.
struct Report<'a> {
    points: &'a MarkerPoints,
    clusters: &'a comparison::Clusters,
    observations: &'a [Observation],
    fit: &'a RobustFit,
    used: &'a [usize],
}

impl Report<'_> {
    fn of(&self, rig: &str) -> PointsFit {
        let state = robust::least_squares(self.observations, self.used, self.fit);
        let error_mm = |at: usize| 1e3 * state.residual(&self.observations[at]).norm();
        let errors_mm: Vec<f64> = self.used.iter().map(|&at| error_mm(at)).collect();
        let fitted = FRAME_UNKNOWNS + 3 * state.offsets_m.len() - self.fit.held.len();
        let dof = (3 * self.used.len()).saturating_sub(fitted);
        let sum: f64 = errors_mm.iter().map(|error| error * error).sum();
        let sigma_mm = (sum / dof.max(1) as f64).sqrt();
        let contradicted = self.fit.outliers.iter().filter(|at| self.used.binary_search(at).is_ok());
        let pose = state.tracker_from_base;
        PointsFit {
            rig: rig.to_owned(),
            points: self.used.len(),
            rms_mm: rms(&errors_mm),
            median_mm: robust::median(errors_mm.clone()),
            max_mm: errors_mm.iter().copied().fold(0.0, f64::max),
            sigma_mm,
            dof,
            groups: self.clusters.errors(self.points, self.used, error_mm),
            tracker_from_base: FittedFrame {
                translation_mm: (1e3 * pose.translation.vector).into(),
                quaternion_xyzw: pose.rotation.coords.into(),
            },
            offsets: self.offsets(&state, sigma_mm),
            unobservable: self.unobservable(&state),
            contradicted: contradicted.map(|&at| outlier(self.points, at, 1e-3 * error_mm(at))).collect(),
        }
    }

    fn offsets(&self, state: &State, sigma_mm: f64) -> Vec<MarkerOffset> {
        let ones = vec![Vector3::repeat(1.0); self.observations.len()];
        let (observations, used, held) = (self.observations, self.used, &self.fit.held[..]);
        let (normal, _) = Problem { observations, used, weights: &ones, width_m: None, held }.normal(state);
        let covariance: Option<DMatrix<f64>> = normal.cholesky().map(|factor| factor.inverse());
        let of = |(marker, offset): (usize, &Vector3<f64>)| {
            let rows = 3 * marker..3 * marker + 3;
            let observable = held.iter().all(|direction| rows.clone().all(|row| direction[row].abs() < 1e-3));
            let variance = |row: usize| covariance.as_ref().map(|c| c[(FRAME_UNKNOWNS + row, FRAME_UNKNOWNS + row)]);
            let sigmas: Option<Vec<f64>> = rows.map(|row| Some(sigma_mm * variance(row)?.sqrt())).collect();
            MarkerOffset {
                marker: self.points.markers[marker].clone(),
                offset_mm: (1e3 * offset).into(),
                sigma_mm: sigmas.filter(|_| observable).and_then(|sigmas| sigmas.try_into().ok()),
            }
        };
        state.offsets_m.iter().enumerate().map(of).collect()
    }

    fn unobservable(&self, state: &State) -> Vec<UnobservableOffset> {
        let found = observability::unobservable(self.observations, self.used, state);
        let of = |found: observability::OffsetDirection| {
            let part = |marker: usize| found.direction.fixed_rows::<3>(3 * marker).into_owned();
            let marker = (0..self.points.markers.len()).max_by(|&a, &b| part(a).norm().total_cmp(&part(b).norm()))?;
            Some(UnobservableOffset {
                marker: self.points.markers[marker].clone(),
                direction: part(marker).normalize().into(),
                sensitivity: found.sensitivity,
            })
        };
        found.into_iter().filter_map(of).collect()
    }
}
