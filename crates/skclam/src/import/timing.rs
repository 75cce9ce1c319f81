//! Joints and images of a recording by one clock.

use super::clocks::{Times, choose_clock};
use super::first_pass::FirstPass;
use super::{ImportError, ImportOptions, joints};
use skclam_recordings::{Clock, JointTrack, Recording};
use skclam_rig::Rig;
use std::collections::BTreeMap;

/// The joints and the clock that times them and the images.
pub(super) struct Timed {
    /// The topics of the joints, or the log or list that they come from.
    pub joint_topic: String,
    /// Rising in time.
    pub track: JointTrack,
    pub clock: Clock,
}

/// Finds the joints, and the clock by which they and the images are paired.
pub(super) fn timed(
    recording: &Recording,
    rig: &Rig,
    joint_log: Option<JointTrack>,
    found: &mut FirstPass,
    options: &ImportOptions,
) -> Result<Timed, ImportError> {
    let FirstPass { chosen, images, joints: collector, poses, warnings, .. } = found;
    let mut image_times = images.times(recording, chosen);
    let mut repaired = images.repair(&image_times);
    let strays = "some stamps are far off all others of their topic (0 as a rule): they were put where the times of recording say";
    if let Some((joint_topic, mut track)) = apart(recording, rig, joint_log, std::mem::take(poses)) {
        let times = track.times().iter().map(|&time| (time, time)).collect();
        let joints = Times { what: joint_topic.clone(), times, has_log: false };
        if repaired > 0 {
            warnings.push(strays.to_owned());
            image_times = images.times(recording, chosen);
        }
        let clock = choose_clock(&image_times, &[joints], options.clock, warnings)?;
        track.sort();
        return Ok(Timed { joint_topic, track, clock });
    }
    let joints = joints::choose(recording, rig, collector, options, warnings)?;
    repaired += joints.repair(collector);
    if repaired > 0 {
        warnings.push(strays.to_owned());
        image_times = images.times(recording, chosen);
    }
    let clock = choose_clock(&image_times, &joints.times(collector), options.clock, warnings)?;
    let robot = rig.robot.as_ref().ok_or_else(|| ImportError::NoJoints { problem: "the rig has no arm".to_owned() })?;
    let mut track = joints.track(collector, robot, clock, options, warnings)?;
    track.sort();
    Ok(Timed { joint_topic: joints.topic, track, clock })
}

/// Joints or poses that are not the messages of a robot.
fn apart(
    recording: &Recording,
    rig: &Rig,
    joint_log: Option<JointTrack>,
    poses: BTreeMap<usize, JointTrack>,
) -> Option<(String, JointTrack)> {
    match (joint_log, rig.robot.is_some()) {
        (Some(log), _) => Some(("the joint log".to_owned(), log)),
        (None, false) => {
            let (topic, track) = poses.into_iter().find(|(_, track)| !track.is_empty())?;
            Some((recording.topics()[topic].name.clone(), track))
        }
        (None, true) => None,
    }
}
