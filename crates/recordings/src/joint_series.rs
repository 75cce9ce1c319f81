//! The joints of a recording by name: each has a series of its own, so that joints may come in one message, in several,
//! or on several topics, and the first message decides nothing.

use crate::{JointState, Stamp};
use std::collections::{BTreeMap, HashMap};

/// Which of a message's two times is meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The stamp in its header: when the data were taken.
    Header,
    /// When the message was recorded.
    Log,
}

/// A value of a joint and when it was so.
#[derive(Debug, Clone, Copy)]
struct Sample {
    stamp: Stamp,
    log: Stamp,
    value: f64,
}

impl Sample {
    fn time(&self, clock: Clock) -> Stamp {
        match clock {
            Clock::Header => self.stamp,
            Clock::Log => self.log,
        }
    }
}

/// The values of one joint on one topic.
#[derive(Debug, Clone, Default)]
pub struct JointSeries {
    samples: Vec<Sample>,
    offered: u64,
    stride: u64,
    /// The last message that had the joint, to notice a name that is twice in a message.
    last_message: u64,
    /// Positions that were NaN or infinite.
    pub not_finite: u64,
    /// Messages in which the name is a duplicate.
    pub duplicates: u64,
    /// Two different values under the same name in one message.
    pub contradiction: Option<[f64; 2]>,
}

impl JointSeries {
    fn add(&mut self, message: u64, sample: Sample) -> usize {
        if self.last_message == message && self.offered > 0 {
            return self.duplicate(sample);
        }
        self.last_message = message;
        self.offered += 1;
        if !sample.value.is_finite() {
            self.not_finite += 1;
            return 0;
        }
        if !(self.offered - 1).is_multiple_of(self.stride.max(1)) {
            return 0;
        }
        self.samples.push(sample);
        1
    }

    /// The same name again in the same message: its value counts where the first was none.
    fn duplicate(&mut self, sample: Sample) -> usize {
        const SAME: f64 = 1e-6;
        self.duplicates += 1;
        if !sample.value.is_finite() {
            return 0;
        }
        let same_message = |last: &&Sample| (last.stamp, last.log) == (sample.stamp, sample.log);
        match self.samples.last().filter(same_message) {
            Some(last) if (last.value - sample.value).abs() > SAME => {
                self.contradiction.get_or_insert([last.value, sample.value]);
                0
            }
            Some(_) => 0,
            None if self.stride <= 1 => {
                self.not_finite = self.not_finite.saturating_sub(1);
                self.samples.push(sample);
                1
            }
            None => 0,
        }
    }

    /// Drops every second sample.
    fn thin(&mut self) {
        self.stride = 2 * self.stride.max(1);
        self.samples = self.samples.iter().step_by(2).copied().collect();
    }

    /// Number of values held.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Every how many-th value is held.
    pub fn stride(&self) -> u64 {
        self.stride.max(1)
    }

    /// Stamp and time of recording of each value, in the order of the recording.
    pub fn times(&self) -> impl Iterator<Item = (Stamp, Stamp)> + '_ {
        self.samples.iter().map(|sample| (sample.stamp, sample.log))
    }

    /// Changes the stamps, each by its stamp and its time of recording.
    pub fn restamp(&mut self, stamp: impl Fn(Stamp, Stamp) -> Stamp) {
        self.samples.iter_mut().for_each(|sample| sample.stamp = stamp(sample.stamp, sample.log));
    }

    /// Times and values in the order of time, as they came where times are equal.
    pub(crate) fn sorted(&self, clock: Clock) -> Vec<(Stamp, f64)> {
        let mut values: Vec<(Stamp, f64)> =
            self.samples.iter().map(|sample| (sample.time(clock), sample.value)).collect();
        values.sort_by_key(|&(time, _)| time);
        values
    }
}

/// The joints of one topic.
#[derive(Debug, Clone, Default)]
pub struct TopicJoints {
    names: HashMap<String, usize>,
    series: Vec<JointSeries>,
    /// In the order in which they appeared.
    listed: Vec<String>,
    messages: u64,
    /// Positions of messages that have no names.
    pub nameless: Option<usize>,
}

/// Names of a topic that are kept for messages, at the most.
const MAX_LISTED: usize = 256;
/// Joints of a topic with a series, at the most.
const MAX_SERIES: usize = 1024;
/// Values of all series at the most: 96 MiB.
const MAX_VALUES: usize = 4 << 20;
/// In a list of names: a position of no interest.
const NO_JOINT: &str = "-";

impl TopicJoints {
    /// All names that the topic has, in the order in which they appeared, up to a bound.
    pub fn names(&self) -> Vec<&str> {
        self.listed.iter().map(String::as_str).collect()
    }

    /// The values of a joint.
    pub fn series(&self, name: &str) -> Option<&JointSeries> {
        self.names.get(name).and_then(|&index| self.series.get(index))
    }

    fn series_mut(&mut self, name: &str, keep: &dyn Fn(&str) -> bool) -> Option<&mut JointSeries> {
        let index = match self.names.get(name) {
            Some(&index) => index,
            None => {
                if self.listed.len() < MAX_LISTED && !self.listed.iter().any(|listed| listed == name) {
                    self.listed.push(name.to_owned());
                }
                if self.series.len() == MAX_SERIES || !keep(name) {
                    return None;
                }
                self.series.push(JointSeries::default());
                self.names.insert(name.to_owned(), self.series.len() - 1);
                self.series.len() - 1
            }
        };
        self.series.get_mut(index)
    }
}

/// Joint states of all topics, in bounded memory: past the bound every second value of the longest series is dropped.
#[derive(Debug, Clone, Default)]
pub struct JointCollector {
    topics: BTreeMap<usize, TopicJoints>,
    held: usize,
}

/// A joint of the arm: the topic that has it, and its name there.
pub type JointPlace = (usize, String);

impl JointCollector {
    /// Adds a message. `given`: names for positions that come without, in their order, "-" for one of no interest;
    /// `keep`: whether a joint of this name can be of interest.
    pub fn add(
        &mut self,
        topic: usize,
        log: Stamp,
        state: &JointState<'_>,
        given: Option<&[String]>,
        keep: &dyn Fn(&str) -> bool,
    ) {
        let joints = self.topics.entry(topic).or_default();
        if state.positions.is_empty() {
            return;
        }
        joints.messages += 1;
        let message = joints.messages;
        let stamp = state.header.stamp;
        let nameless = state.names.iter().all(|name| name.is_empty());
        if nameless {
            joints.nameless = Some(state.positions.len());
        }
        let given: Vec<&str> = match given {
            Some(given) if nameless && given.len() == state.positions.len() => {
                given.iter().map(String::as_str).collect()
            }
            _ => vec![],
        };
        let names = if nameless { &given } else { &state.names };
        for (&name, &value) in names.iter().zip(&state.positions).filter(|(name, _)| **name != NO_JOINT) {
            if let Some(series) = joints.series_mut(name, keep) {
                self.held += series.add(message, Sample { stamp, log, value });
            }
        }
        if self.held > MAX_VALUES {
            self.thin();
        }
    }

    fn thin(&mut self) {
        let all = || self.topics.values().flat_map(|topic| &topic.series);
        // A series of its own stays as it is where others take the memory.
        let longest = all().map(JointSeries::len).max().unwrap_or(0);
        for series in self.topics.values_mut().flat_map(|topic| &mut topic.series) {
            if 2 * series.len() > longest {
                series.thin();
            }
        }
        self.held = self.topics.values().flat_map(|topic| &topic.series).map(JointSeries::len).sum();
    }

    /// The topics with joint states.
    pub fn topics(&self) -> &BTreeMap<usize, TopicJoints> {
        &self.topics
    }

    /// The series of a joint.
    pub fn series(&self, (topic, name): &JointPlace) -> Option<&JointSeries> {
        self.topics.get(topic)?.series(name)
    }

    /// The same, to change its stamps.
    pub fn restamp(&mut self, (topic, name): &JointPlace, stamp: impl Fn(Stamp, Stamp) -> Stamp) {
        if let Some(topic) = self.topics.get_mut(topic)
            && let Some(series) = topic.names.get(name).and_then(|&index| topic.series.get_mut(index))
        {
            series.restamp(stamp);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Header;

    const MS: Stamp = 1_000_000;

    fn state<'a>(time_ms: i64, names: &[&'a str], positions: &[f64]) -> JointState<'a> {
        let header = Header { stamp: time_ms * MS, frame_id: "" };
        JointState { header, names: names.to_vec(), positions: positions.to_vec() }
    }

    fn collected(states: &[JointState<'_>], given: Option<&[String]>) -> JointCollector {
        let mut collector = JointCollector::default();
        states.iter().for_each(|state| collector.add(0, state.header.stamp, state, given, &|_| true));
        collector
    }

    fn place(name: &str) -> JointPlace {
        (0, name.to_owned())
    }

    #[test]
    fn what_is_not_a_number_is_passed_over_and_duplicates_are_noticed() {
        let states = [
            state(0, &["a", "a"], &[f64::NAN, 1.0]),
            state(10, &["a", "a"], &[1.0, 1.0]),
            state(20, &["a"], &[f64::INFINITY]),
            state(30, &["a", "a"], &[1.0, 1.5]),
        ];
        let collector = collected(&states, None);
        let series = collector.series(&place("a")).unwrap();
        assert_eq!((series.len(), series.not_finite, series.duplicates), (3, 1, 3));
        assert_eq!(series.contradiction, Some([1.0, 1.5]));
    }

    #[test]
    fn names_that_are_given_name_positions() {
        let given = ["x", "-", "y"].map(str::to_owned);
        let collector = collected(&[state(0, &[], &[1.0, 2.0, 3.0]), state(1, &["", "", ""], &[1.0; 3])], Some(&given));
        let topic = &collector.topics()[&0];
        assert_eq!((topic.names(), topic.nameless), (vec!["x", "y"], Some(3)));
        assert_eq!(collected(&[state(0, &[], &[1.0])], Some(&given)).topics()[&0].nameless, Some(1));
    }
}
