//! Two rigs on the same points: the difference of their RMS, and its standard error by the jackknife over clusters of
//! points.

use super::solve::{Observation, State};
use super::{ClusteredBy, Fitted, GroupErrors, MarkerPoint, MarkerPoints, PointsComparison, RobustFit, rms, robust};
use crate::pipeline::Status;
use std::collections::HashMap;

/// Standard errors by which a rig has to differ.
const STANDARD_ERRORS: f64 = 2.0;
/// A standard error over fewer clusters says nothing.
const MIN_CLUSTERS: usize = 3;
/// More clusters are joined into so many blocks: each needs a fit.
const MAX_BLOCKS: usize = 60;
/// Joints that differ by less are equal, radians or metres: a tenth of a degree.
const EQUAL_JOINTS: f64 = 1.75e-3;

/// Points whose errors are alike.
pub(super) struct Clusters {
    pub by: ClusteredBy,
    /// Positions of points, each in the order of the table.
    pub members: Vec<Vec<usize>>,
}

impl Clusters {
    /// Errors cluster by cluster; none where each point is its own.
    pub fn errors(&self, points: &MarkerPoints, used: &[usize], error_mm: impl Fn(usize) -> f64) -> Vec<GroupErrors> {
        if self.members.len() == points.points.len() {
            return Vec::new();
        }
        let of = |members: &Vec<usize>| {
            let counted = members.iter().filter(|at| used.binary_search(at).is_ok());
            let errors: Vec<f64> = counted.map(|&at| error_mm(at)).collect();
            let first = &points.points[*members.first()?];
            let group = first.group.clone().unwrap_or_else(|| format!("line {}", first.line));
            Some(GroupErrors { group, points: errors.len(), rms_mm: rms(&errors) })
        };
        self.members.iter().filter_map(of).collect()
    }
}

/// By the column `group`, or else by the joints before the wrist.
pub(super) fn clusters(points: &MarkerPoints) -> Clusters {
    let mut members: Vec<Vec<usize>> = Vec::new();
    if points.grouped {
        let mut of_group: HashMap<Option<&str>, usize> = HashMap::new();
        for (at, point) in points.points.iter().enumerate() {
            let cluster = *of_group.entry(point.group.as_deref()).or_insert_with(|| {
                members.push(Vec::new());
                members.len() - 1
            });
            members[cluster].push(at);
        }
        return Clusters { by: ClusteredBy::Group, members };
    }
    // Clusters by the cell of their first point; what is near lies in this cell or a neighbour.
    let mut in_cell: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    for (at, point) in points.points.iter().enumerate() {
        let joints = before_wrist(point);
        let cell = joints.map(|value| (value / EQUAL_JOINTS).floor() as i64);
        let near = neighbours(cell).filter_map(|cell| in_cell.get(&cell)).flatten().copied().filter(|&cluster| {
            let first = before_wrist(&points.points[members[cluster][0]]);
            joints.iter().zip(first).all(|(a, b)| (a - b).abs() < EQUAL_JOINTS)
        });
        match near.min() {
            Some(cluster) => members[cluster].push(at),
            None => {
                in_cell.entry(cell).or_default().push(members.len());
                members.push(vec![at]);
            }
        }
    }
    Clusters { by: ClusteredBy::Joints, members }
}

/// The first three joints; zero for what an arm does not have.
fn before_wrist(point: &MarkerPoint) -> [f64; 3] {
    std::array::from_fn(|joint| point.joints.get(joint).copied().unwrap_or(0.0))
}

fn neighbours([x, y, z]: [i64; 3]) -> impl Iterator<Item = [i64; 3]> {
    (0..27).map(move |k| [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1])
}

/// The rig under test against the nominal one, both fitted to the used points.
pub(super) fn compare(nominal: &Fitted, tested: &Fitted, used: &[usize], clusters: &Clusters) -> PointsComparison {
    let improvement = |used: &[usize]| rms_mm(nominal, used) - rms_mm(tested, used);
    let improvement_mm = improvement(used);
    let blocks = blocks(clusters, used);
    let standard_error_mm = (blocks.len() >= MIN_CLUSTERS).then(|| {
        let without = |block: &Vec<usize>| {
            let rest: Vec<usize> = used.iter().copied().filter(|at| block.binary_search(at).is_err()).collect();
            improvement(&rest)
        };
        let left_out: Vec<f64> = blocks.iter().map(without).collect();
        jackknife(&left_out)
    });
    PointsComparison { improvement_mm, standard_error_mm, status: status(improvement_mm, standard_error_mm) }
}

/// Better or worse by more than two standard errors, or not distinguishable.
fn status(improvement_mm: f64, standard_error_mm: Option<f64>) -> Status {
    match standard_error_mm.map(|error| STANDARD_ERRORS * error) {
        Some(margin) if improvement_mm > margin => Status::Good,
        Some(margin) if improvement_mm < -margin => Status::Bad,
        _ => Status::Caution,
    }
}

fn rms_mm((observations, fit): &(Vec<Observation>, RobustFit), used: &[usize]) -> f64 {
    let state: State = robust::least_squares(observations, used, fit);
    let errors: Vec<f64> = used.iter().map(|&at| 1e3 * state.residual(&observations[at]).norm()).collect();
    rms(&errors)
}

/// Used points cluster by cluster, sorted; neighbouring clusters joined where there are too many.
fn blocks(clusters: &Clusters, used: &[usize]) -> Vec<Vec<usize>> {
    let counted = clusters
        .members
        .iter()
        .map(|members| members.iter().copied().filter(|at| used.binary_search(at).is_ok()).collect::<Vec<usize>>());
    let counted: Vec<Vec<usize>> = counted.filter(|members| !members.is_empty()).collect();
    let joined = counted.len().div_ceil(MAX_BLOCKS).max(1);
    let join = |clusters: &[Vec<usize>]| {
        let mut block = clusters.concat();
        block.sort_unstable();
        block
    };
    counted.chunks(joined).map(join).collect()
}

/// Standard error of an estimate from its values with one block left out.
fn jackknife(left_out: &[f64]) -> f64 {
    let count = left_out.len() as f64;
    let mean = left_out.iter().sum::<f64>() / count;
    let sum: f64 = left_out.iter().map(|value| (value - mean).powi(2)).sum();
    ((count - 1.0) / count * sum).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use std::path::PathBuf;

    #[test]
    fn the_status_follows_two_standard_errors() {
        for (improvement_mm, standard_error_mm, expected) in [
            (0.3, Some(0.1), Status::Good),
            (0.19, Some(0.1), Status::Caution),
            (0.0, Some(0.0), Status::Caution),
            (-0.19, Some(0.1), Status::Caution),
            (-0.21, Some(0.1), Status::Bad),
            (5.0, None, Status::Caution),
        ] {
            assert_eq!(status(improvement_mm, standard_error_mm), expected, "{improvement_mm} {standard_error_mm:?}");
        }
    }

    #[test]
    fn the_jackknife_of_a_mean_is_its_standard_error() {
        let values = [1.0, 4.0, 2.0, 7.0, 3.0];
        let sum: f64 = values.iter().sum();
        let left_out: Vec<f64> = values.iter().map(|value| (sum - value) / 4.0).collect();
        let variance = values.iter().map(|value| (value - sum / 5.0).powi(2)).sum::<f64>() / 4.0;
        assert!((jackknife(&left_out) - (variance / 5.0).sqrt()).abs() < 1e-12);
    }

    fn points(joints: &[[f64; 4]], groups: &[&str]) -> MarkerPoints {
        let point = |(at, joints): (usize, &[f64; 4])| MarkerPoint {
            line: at + 2,
            index: None,
            group: groups.get(at).map(|&group| group.to_owned()),
            marker: 0,
            joints: joints.to_vec(),
            position_m: Vector3::zeros(),
            sigma_m: None,
        };
        let points = joints.iter().enumerate().map(point).collect();
        MarkerPoints { path: PathBuf::new(), points, markers: vec!["marker".to_owned()], grouped: !groups.is_empty() }
    }

    #[test]
    fn clusters_are_groups_or_equal_joints_before_the_wrist() {
        let joints = [[0.1, 0.2, 0.3, 1.0], [0.5, 0.2, 0.3, 1.0], [0.1001, 0.1999, 0.3, 2.0], [0.103, 0.2, 0.3, 1.0]];
        assert_eq!(clusters(&points(&joints, &[])).members, [vec![0, 2], vec![1], vec![3]]);
        assert_eq!(clusters(&points(&joints, &["a", "b", "b", "a"])).members, [vec![0, 3], vec![1, 2]]);
    }

    #[test]
    fn many_clusters_are_joined_into_blocks() {
        let members = (0..200).map(|at| vec![at]).collect();
        let clusters = Clusters { by: ClusteredBy::Joints, members };
        let used: Vec<usize> = (0..200).filter(|at| at % 7 != 0).collect();
        let blocks = blocks(&clusters, &used);
        assert!(blocks.len() <= MAX_BLOCKS && blocks.len() > MAX_BLOCKS / 2);
        assert_eq!(blocks.concat(), used);
    }
}
