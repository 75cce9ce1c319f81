//! The gross mistakes that are tried, and what the postures and the arm are if one was made.

use super::GrossCause;
use crate::dataset::Dataset;
use nalgebra::{Quaternion, UnitQuaternion};
use skclam_geometry::Isometry3;
use skclam_kinematics::{Joint, JointKind, LinkForm, SerialChain};
use skclam_rig::{Posture, PostureState, Rig};

/// Rows by which postures are shifted at most.
const MAX_SHIFT: i64 = 5;

/// A data set as it would be without the mistake.
#[derive(Debug, Clone)]
pub(super) struct Candidate {
    /// `None`: unchanged.
    pub cause: Option<GrossCause>,
    /// The rig; the mount is ignored.
    pub rig: Rig,
    /// One a row of images; `None` where the shift leaves an image without a posture.
    pub postures: Vec<Option<Posture>>,
}

impl Candidate {
    /// The unchanged data set.
    pub fn nominal(dataset: &Dataset) -> Self {
        let postures = dataset.records.iter().map(|record| Some(record.posture.clone())).collect();
        Candidate { cause: None, rig: dataset.rig.clone(), postures }
    }

    /// Flange poses, row by row; `None` where the arm refuses the values.
    pub fn flange_poses(&self) -> Vec<Option<Isometry3>> {
        self.postures.iter().map(|posture| self.rig.base_from_flange(posture.as_ref()?).ok()).collect()
    }

    fn changed(&self, cause: GrossCause, change: impl Fn(&mut PostureState, &mut Vec<f64>)) -> Self {
        let postures = self.postures.iter().cloned().map(|posture| {
            posture.map(|mut posture| {
                change(&mut posture.state, &mut posture.joint_rates);
                posture
            })
        });
        Candidate { cause: Some(cause), rig: self.rig.clone(), postures: postures.collect() }
    }
}

/// Every mistake that this data set may have made, in a fixed order.
pub(super) fn candidates(dataset: &Dataset) -> Vec<Candidate> {
    let nominal = Candidate::nominal(dataset);
    let mut list = Vec::new();
    match &dataset.rig.robot {
        Some(robot) if dataset.has_joints() => {
            list.extend(of_joints(&nominal, robot));
            list.extend(other_convention(&nominal, robot));
        }
        _ => list.extend(of_flange_poses(&nominal)),
    }
    let most = MAX_SHIFT.min(dataset.len() as i64 / 3);
    list.extend((1..=most).flat_map(|by| [by, -by]).map(|by| shifted(&nominal, by)));
    list
}

fn of_joints(nominal: &Candidate, robot: &SerialChain) -> Vec<Candidate> {
    let kinds: Vec<JointKind> = robot.joints().iter().map(|joint| joint.kind).collect();
    let scaled = |factors: Vec<f64>| {
        move |state: &mut PostureState, rates: &mut Vec<f64>| {
            if let PostureState::Joints(values) = state {
                values.iter_mut().zip(&factors).for_each(|(value, factor)| *value *= factor);
            }
            rates.iter_mut().zip(&factors).for_each(|(rate, factor)| *rate *= factor);
        }
    };
    let mut list = Vec::new();
    for joint in 0..kinds.len() {
        let factors = (0..kinds.len()).map(|k| if k == joint { -1.0 } else { 1.0 }).collect();
        list.push(nominal.changed(GrossCause::JointSign { joint }, scaled(factors)));
    }
    for a in 0..kinds.len() {
        for b in (a + 1..kinds.len()).filter(|&b| kinds[a] == kinds[b]) {
            list.push(nominal.changed(GrossCause::JointsSwapped { a, b }, move |state, rates| {
                if let PostureState::Joints(values) = state {
                    values.swap(a, b);
                }
                if rates.len() > b {
                    rates.swap(a, b);
                }
            }));
        }
    }
    let turning =
        |factor: f64| kinds.iter().map(|kind| if *kind == JointKind::Revolute { factor } else { 1.0 }).collect();
    list.push(nominal.changed(GrossCause::DegreesForRadians, scaled(turning(1f64.to_radians()))));
    list.push(nominal.changed(GrossCause::RadiansForDegrees, scaled(turning(1f64.to_degrees()))));
    list
}

/// The same numbers in the other order of elementary motions; `None` where the arm mixes forms.
fn other_convention(nominal: &Candidate, robot: &SerialChain) -> Option<Candidate> {
    let other = |form: LinkForm| match form {
        LinkForm::ModifiedDh => LinkForm::StandardDh,
        LinkForm::StandardDh => LinkForm::ModifiedDh,
        LinkForm::Hayati => LinkForm::StandardHayati,
        LinkForm::StandardHayati => LinkForm::Hayati,
    };
    let joints = robot.joints().iter().map(|joint| {
        let mut joint: Joint = joint.clone();
        joint.link.form = other(joint.link.form);
        joint
    });
    let chain = SerialChain::with_ends(*robot.base_from_first(), joints.collect(), *robot.last_from_flange()).ok()?;
    let rig = Rig { robot: Some(chain), ..nominal.rig.clone() };
    Some(Candidate { cause: Some(GrossCause::LinkConvention), rig, postures: nominal.postures.clone() })
}

fn of_flange_poses(nominal: &Candidate) -> Vec<Candidate> {
    let of_pose = |cause, change: fn(&Isometry3) -> Isometry3| {
        nominal.changed(cause, move |state, _| {
            if let PostureState::FlangePose(pose) = state {
                *pose = change(pose);
            }
        })
    };
    vec![
        of_pose(GrossCause::PoseInverted, Isometry3::inverse),
        of_pose(GrossCause::QuaternionOrder, |pose| {
            // What was read as x, y, z, w is w, x, y, z.
            let read = pose.rotation.coords;
            let quaternion = Quaternion::new(read.x, read.y, read.z, read.w);
            Isometry3::from_parts(pose.translation, UnitQuaternion::from_quaternion(quaternion))
        }),
    ]
}

/// The image of row `k` belongs to the posture of row `k + by`.
fn shifted(nominal: &Candidate, by: i64) -> Candidate {
    let of_row = |row: usize| {
        let from = usize::try_from(row as i64 + by).ok()?;
        nominal.postures.get(from).cloned().flatten()
    };
    let postures = (0..nominal.postures.len()).map(of_row).collect();
    Candidate { cause: Some(GrossCause::PosturesShifted { by }), rig: nominal.rig.clone(), postures }
}
