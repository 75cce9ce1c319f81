//! Joint values over time, in the order of the arm.

use crate::{RecordingError, Stamp};

/// Which of a message's joints are the arm's.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JointNames {
    /// The recording's name of each joint of the arm, base to flange.
    pub recorded: Vec<String>,
    /// Set where the names are not the arm's own, for a person to check.
    pub remark: Option<String>,
}

impl JointNames {
    /// Finds the arm's joints among the names of a recording: by their names; else, where upper and lower case or a
    /// common prefix (`left_`) make the only difference, by those; else by the number at the end of both names
    /// (`joint_3`, `J3`). Never by the order of the message, which ROS leaves open.
    ///
    /// # Errors
    /// [`RecordingError::Joints`] with the names on both sides.
    pub fn resolve(arm: &[String], recorded: &[&str]) -> Result<Self, RecordingError> {
        type Key = fn(&str) -> String;
        let lower: Key = |name| name.to_lowercase();
        let rules: [(Key, bool); 2] = [(str::to_owned, true), (lower, false)];
        for (key, exact) in rules {
            let matches = |arm: &str, name: &str| {
                let (arm, name) = (key(arm), key(name));
                arm == name
                    || (!exact
                        && !arm.is_empty()
                        && name.strip_suffix(&arm).is_some_and(|prefix| prefix.ends_with(['_', '/', '-'])))
            };
            if let Some(found) = unique(arm, recorded, &matches) {
                let remark = (!exact).then(|| pairs(arm, &found));
                return Ok(JointNames { recorded: found, remark });
            }
        }
        if let Some(found) = unique(arm, recorded, &numbered) {
            let remark = Some(pairs(arm, &found));
            return Ok(JointNames { recorded: found, remark });
        }
        let (arms, names) = (arm.join(", "), listed(recorded));
        let problem = match recorded.len() < arm.len() {
            true => format!(
                "the arm has {} joints ({arms}), the recording has {} ({names}): the others are not in it. \
                 Record all, or give all of them as a CSV with --joints",
                arm.len(),
                recorded.len()
            ),
            false => format!(
                "the arm has {arms}, the recording {names}; name the recording's joints from base to flange (--joint-names)"
            ),
        };
        Err(RecordingError::Joints { problem })
    }

    /// The joints that a person named, base to flange. Names for positions of no interest, "-", are left out.
    ///
    /// # Errors
    /// [`RecordingError::Joints`]: another number of names than the arm has joints, a name twice, a name that the
    /// recording does not have.
    pub fn given(names: &[String], joint_count: usize, recorded: &[&str]) -> Result<Self, RecordingError> {
        let wrong = |problem: String| Err(RecordingError::Joints { problem });
        let names: Vec<String> = names.iter().filter(|name| *name != "-").cloned().collect();
        if names.len() != joint_count {
            return wrong(format!("--joint-names has {} names, but the arm has {joint_count} joints", names.len()));
        }
        if let Some(twice) = names.iter().enumerate().find(|(index, name)| names[..*index].contains(name)) {
            return wrong(format!("--joint-names has {:?} twice", twice.1));
        }
        if let Some(name) = names.iter().find(|name| !recorded.contains(&name.as_str())) {
            let recorded = listed(recorded);
            return wrong(format!(
                "--joint-names has {name:?}, which is not among the joints of the recording: {recorded}"
            ));
        }
        Ok(JointNames { recorded: names, remark: None })
    }

    /// Whether a recorded joint may be one of the arm's by any of the rules of [`resolve`](Self::resolve).
    pub fn may_match(arm: &[String], name: &str) -> bool {
        let lower = name.to_lowercase();
        arm.iter().any(|joint| lower.ends_with(&joint.to_lowercase()) || numbered(joint, name))
    }

    /// The arm's joint values of a message; `None` where it lacks one (a gripper's message).
    pub fn values(&self, names: &[&str], positions: &[f64]) -> Option<Vec<f64>> {
        let value = |wanted: &String| positions.get(names.iter().position(|name| name == wanted)?).copied();
        self.recorded.iter().map(value).collect()
    }
}

/// Names for a message; a humanoid has many.
fn listed(names: &[&str]) -> String {
    const SHOWN: usize = 40;
    let more = names.len().saturating_sub(SHOWN);
    let shown = names[..names.len() - more].join(", ");
    match (names.is_empty(), more) {
        (true, _) => "none".to_owned(),
        (false, 0) => shown,
        (false, more) => format!("{shown} and {more} more"),
    }
}

fn numbered(a: &str, b: &str) -> bool {
    number(a).is_some() && number(a) == number(b)
}

fn pairs(arm: &[String], recorded: &[String]) -> String {
    let pairs: Vec<String> = arm.iter().zip(recorded).map(|(arm, name)| format!("{arm} = {name}")).collect();
    format!("joints were matched by similar names: {}", pairs.join(", "))
}

/// The number at the end of a name, or before a final "_joint".
fn number(name: &str) -> Option<u32> {
    let name = name.trim_end_matches("_joint");
    let digits = name.len() - name.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    name[name.len() - digits..].parse().ok()
}

/// One recorded name for each of the arm's, all different; `None` if some has none, or more than one.
fn unique(arm: &[String], recorded: &[&str], matches: &dyn Fn(&str, &str) -> bool) -> Option<Vec<String>> {
    let mut found: Vec<String> = Vec::new();
    for joint in arm {
        let mut candidates = recorded.iter().filter(|name| matches(joint, name));
        let name = (*candidates.next()?).to_owned();
        if candidates.next().is_some() || found.contains(&name) {
            return None;
        }
        found.push(name);
    }
    Some(found)
}

/// Values over time in bounded memory: past the bound every second sample is dropped.
#[derive(Debug, Clone, Default)]
pub struct JointTrack {
    times: Vec<Stamp>,
    values: Vec<f64>,
    width: usize,
    wraps: Vec<bool>,
    stride: usize,
    offered: usize,
}

/// Numbers that a track holds at most: 64 MiB.
const MAX_VALUES: usize = 1 << 23;

impl JointTrack {
    /// An empty track. `wraps`: for each value, whether it is an angle that may jump by 2 pi.
    pub fn new(wraps: Vec<bool>) -> Self {
        JointTrack { width: wraps.len(), wraps, stride: 1, ..JointTrack::default() }
    }

    /// Adds a sample; `values` one a joint.
    pub fn push(&mut self, time: Stamp, values: &[f64]) {
        debug_assert_eq!(values.len(), self.width);
        self.offered += 1;
        if !(self.offered - 1).is_multiple_of(self.stride) {
            return;
        }
        self.times.push(time);
        self.values.extend_from_slice(values);
        if self.values.len() >= MAX_VALUES {
            self.stride *= 2;
            let (old_times, old_values) = (std::mem::take(&mut self.times), std::mem::take(&mut self.values));
            self.times = old_times.iter().step_by(2).copied().collect();
            self.values = old_values.chunks(self.width.max(1)).step_by(2).flatten().copied().collect();
        }
    }

    /// Puts the samples in the order of time; of two at the same time the first stays.
    pub fn sort(&mut self) {
        if self.times.is_sorted_by(|a, b| a < b) {
            return;
        }
        let mut order: Vec<usize> = (0..self.times.len()).collect();
        order.sort_by_key(|&index| (self.times[index], index));
        order.dedup_by_key(|&mut index| self.times[index]);
        self.values = order.iter().flat_map(|&index| self.at(index).to_vec()).collect();
        self.times = order.iter().map(|&index| self.times[index]).collect();
    }

    /// Number of samples held.
    pub fn len(&self) -> usize {
        self.times.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.times.is_empty()
    }

    /// Every how many-th sample is held.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// The times, rising after [`sort`](Self::sort).
    pub fn times(&self) -> &[Stamp] {
        &self.times
    }

    /// The values of a sample.
    pub fn at(&self, index: usize) -> &[f64] {
        &self.values[index * self.width..(index + 1) * self.width]
    }

    /// The largest change of a joint between two samples, radians or metres; after wrapping.
    pub fn largest_change(&self, a: usize, b: usize) -> f64 {
        self.largest_difference(self.at(a), self.at(b))
    }

    /// The largest distance between two sets of values, as [`largest_change`](Self::largest_change).
    pub(crate) fn largest_difference(&self, from: &[f64], to: &[f64]) -> f64 {
        (0..self.width).map(|joint| self.difference(joint, from[joint], to[joint]).abs()).fold(0.0, f64::max)
    }

    /// The mean of samples from `begin` to before `end`, at least one.
    pub(crate) fn mean_of(&self, begin: usize, end: usize) -> Vec<f64> {
        let first = self.at(begin);
        // Deviations from the first are small, and their mean loses no digits.
        let mean = |joint: usize| {
            let sum: f64 = (begin..end).map(|index| self.difference(joint, first[joint], self.at(index)[joint])).sum();
            first[joint] + sum / (end - begin) as f64
        };
        (0..self.width).map(mean).collect()
    }

    fn difference(&self, joint: usize, from: f64, to: f64) -> f64 {
        let change = to - from;
        match self.wraps[joint] {
            true => change - std::f64::consts::TAU * (change / std::f64::consts::TAU).round(),
            false => change,
        }
    }

    /// The sample nearest in time.
    pub fn nearest(&self, time: Stamp) -> Option<usize> {
        let after = self.times.partition_point(|&t| t < time);
        let candidates = [after.checked_sub(1), (after < self.times.len()).then_some(after)];
        candidates.into_iter().flatten().min_by_key(|&index| (self.times[index] - time).abs())
    }

    /// The mean of the samples within `half_window` nanoseconds of a time; `None` without any.
    pub fn mean_near(&self, time: Stamp, half_window: Stamp) -> Option<Vec<f64>> {
        let begin = self.times.partition_point(|&t| t < time - half_window);
        let end = self.times.partition_point(|&t| t <= time + half_window);
        if begin == end {
            return None;
        }
        Some(self.mean_of(begin, end))
    }
}

/// Values at a time between two samples, linearly, angles the short way; `None` outside the track or in a gap longer
/// than `max_gap` nanoseconds.
pub fn interpolated(track: &JointTrack, time: Stamp, max_gap: Stamp) -> Option<Vec<f64>> {
    let after = track.times.partition_point(|&t| t < time);
    if track.times.get(after) == Some(&time) {
        return Some(track.at(after).to_vec());
    }
    let before = after.checked_sub(1)?;
    let (begin, end) = (track.times[before], *track.times.get(after)?);
    if end - begin > max_gap {
        return None;
    }
    let fraction = (time - begin) as f64 / (end - begin) as f64;
    let (a, b) = (track.at(before), track.at(after));
    Some((0..track.width).map(|joint| a[joint] + fraction * track.difference(joint, a[joint], b[joint])).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(names: &[&str]) -> Vec<String> {
        names.iter().map(|&name| name.to_owned()).collect()
    }

    #[test]
    fn names_decide_and_never_the_order() {
        let exact = JointNames::resolve(&names(&["a", "b"]), &["b", "gripper", "a"]).unwrap();
        assert_eq!((exact.recorded.clone(), exact.remark.clone()), (names(&["a", "b"]), None));
        assert_eq!(exact.values(&["b", "gripper", "a"], &[2.0, 9.0, 1.0]), Some(vec![1.0, 2.0]));
        assert_eq!(exact.values(&["b", "gripper"], &[2.0, 9.0]), None);
        let numbered = JointNames::resolve(&names(&["J1", "J2"]), &["joint_2", "joint_1"]).unwrap();
        assert_eq!(numbered.recorded, names(&["joint_1", "joint_2"]));
        assert!(numbered.remark.unwrap().contains("J1 = joint_1"));
        let prefixed = JointNames::resolve(&names(&["elbow_joint"]), &["left_elbow_joint"]).unwrap();
        assert_eq!(prefixed.recorded, names(&["left_elbow_joint"]));
        for recorded in [&["x", "y"][..], &["left_a", "right_a", "left_b", "right_b"]] {
            let message = JointNames::resolve(&names(&["a", "b"]), recorded).unwrap_err().to_string();
            assert!(message.contains("--joint-names"), "{message}");
        }
        // Names would not help.
        let message = JointNames::resolve(&names(&["a", "b"]), &["a"]).unwrap_err().to_string();
        assert!(message.contains("--joints") && !message.contains("--joint-names"), "{message}");
    }

    #[test]
    fn given_names_are_taken_or_refused_by_name() {
        let recorded = ["p", "q", "r"];
        let given = |list: &[&str]| JointNames::given(&names(list), 2, &recorded);
        assert_eq!(given(&["r", "-", "p"]).unwrap().recorded, names(&["r", "p"]));
        for (list, expected) in
            [(&["r"][..], "1 names"), (&["r", "r"], "\"r\" twice"), (&["r", "s"], "\"s\", which is not")]
        {
            let message = given(list).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn interpolation_takes_the_short_way() {
        let mut track = JointTrack::new(vec![true, false]);
        track.push(100, &[-3.0, -3.0]);
        track.push(0, &[3.0, 3.0]);
        track.sort();
        let middle = interpolated(&track, 50, 1000).unwrap();
        assert!((middle[0] - std::f64::consts::PI).abs() < 1e-12 && middle[1].abs() < 1e-12);
        assert_eq!(interpolated(&track, 50, 99), None);
        assert_eq!(interpolated(&track, 101, 1000), None);
        assert_eq!(track.nearest(60), Some(1));
    }

    #[test]
    fn memory_is_bounded() {
        let mut track = JointTrack::new(vec![false; 64]);
        for time in 0..200_000 {
            track.push(time, &[time as f64; 64]);
        }
        assert!(track.len() * 64 <= MAX_VALUES && track.stride() == 2);
        assert!(track.times().windows(2).all(|pair| pair[1] - pair[0] == 2));
        assert_eq!(track.at(track.len() - 1)[63], track.times()[track.len() - 1] as f64);
    }
}
