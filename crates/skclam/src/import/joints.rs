//! The arm's joints out of all that a recording has: by name, on one topic or over several, by the time of one clock.

use super::clocks::Times;
use super::topics::list;
use super::{ImportError, ImportOptions};
use skclam_kinematics::{JointKind, SerialChain};
use skclam_recordings::{
    Clock, JointCollector, JointNames, JointPlace, JointTrack, MessageKind, Recording, RecordingError, Topic,
};
use skclam_rig::Rig;

/// Where each joint of the arm comes from.
#[derive(Debug)]
pub(super) struct ChosenJoints {
    pub places: Vec<JointPlace>,
    /// The topics, for a person.
    pub topic: String,
    joints: Vec<String>,
}

/// Finds the arm's joints: on the only topic that has all of them, else spread over several.
pub(super) fn choose(
    recording: &Recording,
    rig: &Rig,
    collector: &JointCollector,
    options: &ImportOptions,
    warnings: &mut Vec<String>,
) -> Result<ChosenJoints, ImportError> {
    let topics = recording.topics();
    let Some(robot) = &rig.robot else { return Err(no_joints(topics, rig, options)) };
    let arm: Vec<String> = robot.joints().iter().map(|joint| joint.name.clone()).collect();
    let has_nameless = collector.topics().values().any(|topic| topic.nameless.is_some());
    let resolve = |names: &[&str]| match &options.joint_names {
        // For positions without names these are in the order of the positions; the arm's own names say which is which.
        Some(given) if has_nameless && is_permutation(given, &arm) => JointNames::given(&arm, arm.len(), names),
        Some(given) => JointNames::given(given, arm.len(), names),
        None => JointNames::resolve(&arm, names),
    };
    let spoken: Vec<usize> =
        collector.topics().iter().filter(|(_, topic)| !topic.names().is_empty()).map(|(id, _)| *id).collect();
    if spoken.is_empty() {
        return Err(nameless(topics, collector, &arm, options).unwrap_or_else(|| no_joints(topics, rig, options)));
    }
    let complete: Vec<(usize, JointNames)> = spoken
        .iter()
        .filter_map(|id| resolve(&collector.topics()[id].names()).ok().map(|names| (*id, names)))
        .filter(|(id, names)| {
            names.recorded.iter().all(|name| collector.series(&(*id, name.clone())).is_some_and(|s| !s.is_empty()))
        })
        .collect();
    let (places, remark): (Vec<JointPlace>, _) = match complete.as_slice() {
        [(id, names)] => (names.recorded.iter().map(|name| (*id, name.clone())).collect(), names.remark.clone()),
        [] => over_topics(topics, collector, &spoken, resolve).map_err(|error| {
            // Names of a gripper beside nameless positions of the arm.
            nameless(topics, collector, &arm, options).unwrap_or(error)
        })?,
        several => {
            let names = list(several.iter().map(|(id, _)| &topics[*id]));
            let problem = format!("the arm's joints are on {names}; choose one with --joint-topic");
            return Err(RecordingError::Topic { wanted: "joint states", problem }.into());
        }
    };
    warnings.extend(remark);
    let mut used: Vec<usize> = places.iter().map(|(id, _)| *id).collect();
    used.sort_unstable();
    used.dedup();
    let topic = used.iter().map(|id| topics[*id].name.as_str()).collect::<Vec<_>>().join(", ");
    check_series(collector, &places, &topic, warnings)?;
    Ok(ChosenJoints { places, topic, joints: arm })
}

/// Whether the names that are given are the arm's, in any order.
fn is_permutation(given: &[String], arm: &[String]) -> bool {
    let mut given: Vec<&String> = given.iter().filter(|name| *name != "-").collect();
    let mut arm: Vec<&String> = arm.iter().collect();
    given.sort_unstable();
    arm.sort_unstable();
    given == arm
}

/// Joints that no topic has all of.
fn over_topics(
    topics: &[Topic],
    collector: &JointCollector,
    spoken: &[usize],
    resolve: impl Fn(&[&str]) -> Result<JointNames, RecordingError>,
) -> Result<(Vec<JointPlace>, Option<String>), ImportError> {
    let mut names: Vec<&str> = spoken.iter().flat_map(|id| collector.topics()[id].names()).collect();
    names.sort_unstable();
    names.dedup();
    let resolved = resolve(&names)?;
    let mut places = Vec::new();
    for name in &resolved.recorded {
        let having: Vec<usize> = spoken
            .iter()
            .copied()
            .filter(|id| collector.series(&(*id, name.clone())).is_some_and(|series| !series.is_empty()))
            .collect();
        match having.as_slice() {
            [] => {
                let problem = format!(
                    "joint \"{name}\" is named, but no position of it is a number; give its values in a CSV with --joints"
                );
                return Err(RecordingError::Joints { problem }.into());
            }
            [id] => places.push((*id, name.clone())),
            several => {
                let names = list(several.iter().map(|id| &topics[*id]));
                let problem = format!(
                    "no topic has all joints of the arm, and joint \"{name}\" is on {names}: nothing says which of them is right; \
                     give all joints in a CSV with --joints"
                );
                return Err(RecordingError::Topic { wanted: "joint states", problem }.into());
            }
        }
    }
    Ok((places, resolved.remark))
}

/// Positions came, but no names.
fn nameless(
    topics: &[Topic],
    collector: &JointCollector,
    arm: &[String],
    options: &ImportOptions,
) -> Option<ImportError> {
    let (id, count) = collector.topics().iter().find_map(|(id, topic)| topic.nameless.map(|count| (*id, count)))?;
    let topic = &topics[id].name;
    let problem = match &options.joint_names {
        Some(names) => format!(
            "the messages on {topic} have {count} positions without names, but --joint-names has {} names; name all {count} in their order, with \"-\" for one that is no joint of the arm",
            names.len()
        ),
        None => {
            let mut example = arm.to_vec();
            example.resize(count.min(64).max(arm.len()), "-".to_owned());
            format!(
                "the messages on {topic} have {count} positions without names; name them in their order, with \"-\" for one that is no joint of the arm (--joint-names {})",
                example.join(",")
            )
        }
    };
    Some(RecordingError::Joints { problem }.into())
}

fn no_joints(topics: &[Topic], rig: &Rig, options: &ImportOptions) -> ImportError {
    let joint_topics: Vec<&Topic> = topics.iter().filter(|topic| topic.kind == MessageKind::JointState).collect();
    let problem = match (&options.joint_topic, joint_topics.is_empty(), &rig.robot) {
        (Some(name), false, _) => {
            format!("there are no joint values on {name}; joint states are on {}", list(joint_topics))
        }
        (None, false, None) => {
            "the recording has joint states, but the rig has no arm; name one with --robot or --rig".to_owned()
        }
        (None, false, Some(_)) => {
            format!("the joint states on {} hold no position; give joints in a CSV with --joints", list(joint_topics))
        }
        _ => format!(
            "the recording has no joint states (sensor_msgs/JointState); give them as a CSV with --joints. Its topics are {}",
            list(topics)
        ),
    };
    ImportError::NoJoints { problem }
}

/// What is wrong with values that are used; what is not used may be anything.
fn check_series(
    collector: &JointCollector,
    places: &[JointPlace],
    topic: &str,
    warnings: &mut Vec<String>,
) -> Result<(), ImportError> {
    let series = || places.iter().filter_map(|place| Some((&place.1, collector.series(place)?)));
    if let Some((name, [a, b])) = series().find_map(|(name, series)| Some((name, series.contradiction?))) {
        let problem = format!(
            "a message on {topic} has joint \"{name}\" twice, at {a} and at {b}: nothing says which is right; \
             give joints in a CSV with --joints, or mend the node that publishes them"
        );
        return Err(RecordingError::Joints { problem }.into());
    }
    let twice: Vec<&str> =
        series().filter(|(_, series)| series.duplicates > 0).map(|(name, _)| name.as_str()).collect();
    if !twice.is_empty() {
        warnings.push(format!(
            "messages on {topic} have {} twice, with the same value; it is taken once",
            twice.join(", ")
        ));
    }
    let not_finite = series().map(|(_, series)| series.not_finite).max().unwrap_or(0);
    if not_finite > 0 {
        warnings.push(format!(
            "{not_finite} joint states on {topic} have a position that is NaN or infinite; it was passed over"
        ));
    }
    if let Some(stride) = series().map(|(_, series)| series.stride()).max().filter(|&stride| stride > 1) {
        warnings.push(format!("every {stride}th joint state was used, to bound memory"));
    }
    Ok(())
}

impl ChosenJoints {
    /// The times of each topic's joints; those of one message are the same, so that one joint represents all beside it.
    pub fn times(&self, collector: &JointCollector) -> Vec<Times> {
        let mut found: Vec<Times> = Vec::new();
        for place in &self.places {
            let Some(series) = collector.series(place) else { continue };
            let times: Vec<_> = series.times().collect();
            if found.iter().all(|known| known.times != times) {
                found.push(Times { what: format!("joint \"{}\" on {}", place.1, self.topic), times, has_log: true });
            }
        }
        if let [only] = found.as_mut_slice() {
            only.what = format!("the joints on {}", self.topic);
        }
        found
    }

    /// Stamps that are far off all others are put where they were recorded; how many series had some.
    pub fn repair(&self, collector: &mut JointCollector) -> usize {
        let mut repaired = 0;
        for place in &self.places {
            let times = collector.series(place).map(|series| series.times().collect()).unwrap_or_default();
            let times = Times { what: String::new(), times, has_log: true };
            if let Some(repair) = times.repair() {
                collector.restamp(place, repair);
                repaired += 1;
            }
        }
        repaired
    }

    /// All joints as one track.
    pub fn track(
        &self,
        collector: &JointCollector,
        robot: &SerialChain,
        clock: Clock,
        options: &ImportOptions,
        warnings: &mut Vec<String>,
    ) -> Result<JointTrack, ImportError> {
        let wraps: Vec<bool> = robot.joints().iter().map(|joint| joint.kind == JointKind::Revolute).collect();
        let max_gap = (options.selection.max_gap_s.clamp(0.0, 1e6) * 1e9) as i64;
        let merged = collector.merged(&self.places, &wraps, clock, max_gap);
        let topic = &self.topic;
        if let Some(jumps) = merged.jumps {
            let (joint, [a, b]) = (&self.joints[jumps.joint], jumps.values);
            let problem = format!(
                "two sources write joint values to {topic}: those of joint \"{joint}\" jump to and fro between two, {} times, for instance from {a:.4} to {b:.4}. \
                 Often a joint_state_publisher runs beside the driver of the robot; stop one of them and record anew, or give the joints in a CSV with --joints",
                jumps.count
            );
            return Err(RecordingError::Joints { problem }.into());
        }
        if merged.lone > 0 {
            warnings.push(format!(
                "{} joint value(s) on {topic} jump away from their neighbours and back at once; they were passed over",
                merged.lone
            ));
        }
        let (worst, unknown) = (0..merged.unknown.len())
            .map(|joint| (joint, merged.unknown[joint]))
            .fold((0, 0), |best, now| if now.1 > best.1 { now } else { best });
        if merged.track.is_empty() {
            let problem = format!(
                "the joints on {topic} have no time in common: joint \"{}\" is unknown at the times of the others (samples further apart than {} s say nothing of the time between them)",
                self.joints[worst], options.selection.max_gap_s
            );
            return Err(RecordingError::Joints { problem }.into());
        }
        if unknown > 0 {
            warnings.push(format!(
                "joint \"{}\" is unknown at {unknown} times of the others; they were passed over",
                self.joints[worst]
            ));
        }
        Ok(merged.track)
    }
}
