//! The paper's error function: Eq. (7) over the distances of Eq. (8), and plain metrics beside it.

use crate::camera_kinematics::CameraKinematics;
use crate::{CalibrationError, Correspondences, Model, Warning};
use serde::{Deserialize, Serialize};
use skclam_geometry::{FundamentalMatrix, Isometry3, Pixel};
use skclam_rig::Rig;

/// Camera centres closer than this have no epipolar geometry, metres.
pub(crate) const SMALLEST_BASELINE_M: f64 = 1e-3;

/// How far matches lie from their epipolar lines under some rig. All in px, over both images of every match.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EpipolarStatistics {
    /// `F(Phi)` of Eq. (7): the root of the mean of the *unsquared* distances, as the paper prints it.
    pub error_function: f64,
    /// Root of the mean of the squared point-line distances.
    pub rms_px: f64,
    /// Median of the point-line distances.
    pub median_px: f64,
    /// Median of the Sampson distances.
    pub median_sampson_px: f64,
    /// Number of matches; each has two point-line distances.
    pub matches: usize,
}

/// Two postures and the pixels of their matches.
type UndistortedPair = (usize, usize, Vec<(Pixel, Pixel)>);

/// Pairs with a baseline, their pixels freed of distortion once and for all.
#[derive(Debug, Clone)]
pub(crate) struct UndistortedPairs {
    pairs: Vec<UndistortedPair>,
    pub matches: usize,
}

impl UndistortedPairs {
    /// Pairs without a baseline under `poses` are left out and named.
    pub(crate) fn new(
        rig: &Rig,
        data: &Correspondences,
        poses: &[Isometry3],
        warnings: &mut Vec<Warning>,
    ) -> UndistortedPairs {
        let mut pairs = Vec::new();
        let mut matches = 0;
        for pair in &data.pairs {
            let baseline_m = (poses[pair.a].translation.vector - poses[pair.b].translation.vector).norm();
            if baseline_m < SMALLEST_BASELINE_M {
                warnings.push(Warning::NoBaseline { a: pair.a, b: pair.b, baseline_m });
                continue;
            }
            let undistorted = pair.matches.iter().map(|m| (rig.color.undistort(&m.in_a), rig.color.undistort(&m.in_b)));
            pairs.push((pair.a, pair.b, undistorted.collect()));
            matches += pair.matches.len();
        }
        UndistortedPairs { pairs, matches }
    }

    fn each_distance(&self, rig: &Rig, poses: &[Isometry3], mut visit: impl FnMut(&FundamentalMatrix, &Pixel, &Pixel)) {
        for (a, b, matches) in &self.pairs {
            let a_from_b = poses[*a].inverse() * poses[*b];
            let fundamental = FundamentalMatrix::from_pose(&rig.color, &rig.color, &a_from_b);
            for (in_a, in_b) in matches {
                visit(&fundamental, in_a, in_b);
            }
        }
    }

    /// `F(Phi)`, Eq. (7). The sums of Eq. (8) run over all pairs (the paper's bounds, N and N - 1, differ by one
    /// between the equations; with 73 postures there are 72 pairs either way).
    pub(crate) fn error_function(&self, rig: &Rig, poses: &[Isometry3]) -> f64 {
        let mut sum = 0.0; // E_e(Phi), Eq. (8)
        self.each_distance(rig, poses, |fundamental, in_a, in_b| {
            let (distance_in_a, distance_in_b) = fundamental.point_line_distances(in_a, in_b);
            sum += distance_in_a + distance_in_b;
        });
        (sum / (2.0 * self.matches as f64)).sqrt()
    }

    pub(crate) fn statistics(&self, rig: &Rig, poses: &[Isometry3]) -> EpipolarStatistics {
        if self.matches == 0 {
            return EpipolarStatistics::default();
        }
        let mut distances = Vec::with_capacity(2 * self.matches);
        let mut sampson = Vec::with_capacity(self.matches);
        self.each_distance(rig, poses, |fundamental, in_a, in_b| {
            let (distance_in_a, distance_in_b) = fundamental.point_line_distances(in_a, in_b);
            distances.extend([distance_in_a, distance_in_b]);
            sampson.push(fundamental.sampson_distance(in_a, in_b).abs());
        });
        let (sum, squares) = distances.iter().fold((0.0, 0.0), |(sum, squares), d| (sum + d, squares + d * d));
        EpipolarStatistics {
            error_function: (sum / distances.len() as f64).sqrt(),
            rms_px: (squares / distances.len() as f64).sqrt(),
            median_px: crate::robust::median(&mut distances),
            median_sampson_px: crate::robust::median(&mut sampson),
            matches: self.matches,
        }
    }
}

/// Eq. (7) and plain metrics for all pair matches under a model. Pairs without a baseline are left out.
pub fn epipolar_statistics(model: &Model, data: &Correspondences) -> Result<EpipolarStatistics, CalibrationError> {
    data.check()?;
    let poses = CameraKinematics::new(&model.rig, &data.postures)?.poses(model, &[])?;
    Ok(UndistortedPairs::new(&model.rig, data, &poses, &mut Vec::new()).statistics(&model.rig, &poses))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Free;
    use crate::synthetic::{
        diverse_postures, fresh_pairs, half_pixel, hp3j, joints, manufacture, neighbours, perturbed, seeded,
    };
    use skclam_kinematics::{ParameterId, ParameterKind};
    use skclam_rig::PostureState;

    #[test]
    fn eq_7_takes_the_root_of_a_mean_of_unsquared_distances() {
        // Two cameras side by side: lines are rows, so that a match 4 rows apart has the distances 4 and 4.
        let mut rig = hp3j();
        rig.robot = None;
        rig.flange_from_color = Isometry3::identity();
        let at =
            |index, x| skclam_rig::Posture::new(index, PostureState::FlangePose(Isometry3::translation(x, 0.0, 0.0)));
        let m = |row| crate::PairMatch {
            in_a: Pixel::new(100.0, 200.0),
            in_b: Pixel::new(80.0, row),
            sigma_px: 1.0,
            distance: 0,
        };
        let data = Correspondences {
            postures: vec![at(0, 0.0), at(1, 0.2)],
            pairs: vec![crate::PairMatches { a: 0, b: 1, matches: vec![m(204.0), m(200.0)] }],
            ..Default::default()
        };
        let statistics = epipolar_statistics(&Model::new(rig), &data).unwrap();
        assert!((statistics.error_function - 2f64.sqrt()).abs() < 1e-9, "mean of 4, 4, 0, 0 is 2");
        assert!((statistics.rms_px - 8f64.sqrt()).abs() < 1e-9);
        assert!((statistics.median_sampson_px - 0.5 * 4.0 / 2f64.sqrt()).abs() < 1e-9, "median of 0 and 2.83");
    }

    #[test]
    fn the_gauge_changes_no_distance() {
        let mut rng = seeded(5);
        let truth = hp3j();
        let postures = diverse_postures(&truth, 12, &mut rng);
        let pairs = fresh_pairs(&truth, &postures, &neighbours(12), 20, half_pixel(), &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let rig = perturbed(&truth, &Free::Auto, manufacture(), &mut rng);
        let before = epipolar_statistics(&Model::new(rig.clone()), &data).unwrap();
        // Shifting joint 1's offset turns the world.
        let mut turned = rig.clone();
        let id = ParameterId { joint: 0, kind: ParameterKind::ThetaOffset };
        turned.robot.as_mut().unwrap().set_parameter(id, 0.7).unwrap();
        let after = epipolar_statistics(&Model::new(turned), &data).unwrap();
        assert!((before.rms_px - after.rms_px).abs() < 1e-9 * before.rms_px);
        // Scaling every length scales the world.
        let mut scaled = rig;
        let robot = scaled.robot.as_mut().unwrap();
        for id in robot.parameter_ids().into_iter().filter(|id| !id.kind.is_angle()) {
            let value = robot.parameter(id).unwrap();
            robot.set_parameter(id, 1.3 * value).unwrap();
        }
        scaled.flange_from_color.translation.vector *= 1.3;
        let after = epipolar_statistics(&Model::new(scaled), &data).unwrap();
        assert!((before.rms_px - after.rms_px).abs() < 1e-9 * before.rms_px);
    }

    #[test]
    fn identical_postures_are_named_and_skipped() {
        let rig = hp3j();
        let postures = vec![joints(0, &[0.1; 6]), joints(1, &[0.1; 6])];
        let m = crate::PairMatch { in_a: Pixel::new(1.0, 1.0), in_b: Pixel::new(1.0, 1.0), sigma_px: 1.0, distance: 0 };
        let data = Correspondences {
            postures,
            pairs: vec![crate::PairMatches { a: 0, b: 1, matches: vec![m] }],
            ..Default::default()
        };
        let poses = CameraKinematics::new(&rig, &data.postures).unwrap().poses(&Model::new(rig.clone()), &[]).unwrap();
        let mut warnings = Vec::new();
        let pairs = UndistortedPairs::new(&rig, &data, &poses, &mut warnings);
        assert_eq!(pairs.matches, 0);
        assert!(matches!(warnings[..], [Warning::NoBaseline { a: 0, b: 1, .. }]));
    }
}
