//! What a recording holds: topics, counts, rates, gaps, jumps of the clock.

use crate::{
    CameraInfo, ImageHead, JointState, MessageKind, Recording, RecordingError, RecordingFormat, Stamp, Topic, Wanted,
};
use serde::Serialize;

/// What a recording holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Survey {
    /// Its kind.
    pub format: RecordingFormat,
    /// Messages of all topics.
    pub messages: u64,
    /// From the first message to the last by the time of recording, seconds.
    pub duration_s: f64,
    /// One entry a topic, by name.
    pub topics: Vec<TopicSurvey>,
    /// Files that end early, one line each.
    pub cuts: Vec<String>,
}

/// What a topic holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicSurvey {
    /// Its name.
    pub topic: String,
    /// The type of its messages.
    pub type_name: String,
    /// Whether messages of this type are read by an import.
    pub read: bool,
    /// Number of messages.
    pub messages: u64,
    /// Bytes of all messages.
    pub bytes: u64,
    /// Messages a second by the median distance of stamps; 0 with fewer than two.
    pub rate_hz: f64,
    /// Largest distance of two stamps, seconds.
    pub largest_gap_s: f64,
    /// When the largest gap begins, seconds after the first stamp.
    pub largest_gap_at_s: f64,
    /// Stamps that do not go on as the recorder's clock does.
    pub clock_jumps: u64,
    /// The first of them.
    pub first_jumps: Vec<ClockJump>,
    /// Stamp of the header minus time of recording, first message, seconds.
    pub stamp_minus_log_s: f64,
    /// Size and encoding of the first image, names of the joints, ...
    pub detail: String,
    /// Messages that cannot be read.
    pub bad_messages: u64,
    /// What is wrong with the first of them.
    pub first_problem: Option<String>,
}

/// A stamp that does not go on as the recorder's clock does.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ClockJump {
    /// Seconds after the topic's first message by the time of recording.
    pub at_s: f64,
    /// By how much the stamp went further than the recorder's clock, seconds; negative: back.
    pub jump_s: f64,
}

/// Distances of stamps that the median is made of, at most.
const MAX_GAPS: usize = 1 << 16;
/// Jumps that are listed.
const MAX_JUMPS: usize = 10;
/// A stamp may be off by so much more or less than before, seconds.
const JUMP_S: f64 = 0.5;

struct Running {
    entry: TopicSurvey,
    first_log: Stamp,
    first: Stamp,
    last: Stamp,
    last_log: Stamp,
    gaps: Vec<Stamp>,
}

/// Reads a recording once and reports what is in it. Checksums are verified.
///
/// # Errors
/// As [`Recording::scan`]. A message that cannot be parsed is counted.
pub fn survey(recording: &mut Recording) -> Result<Survey, RecordingError> {
    let mut topics: Vec<Option<Running>> = Vec::new();
    let mut range: Option<(Stamp, Stamp)> = None;
    let mut want = |topic: &Topic, _| match topic.kind {
        MessageKind::CameraInfo | MessageKind::JointState => Wanted::Whole,
        kind if kind.has_header() => Wanted::Beginning(1024),
        _ => Wanted::Beginning(0),
    };
    recording.scan(true, &mut want, &mut |topic, message| {
        let stamp = message.stamp(topic);
        let (first, last) = range.get_or_insert((message.log_time, message.log_time));
        (*first, *last) = ((*first).min(message.log_time), (*last).max(message.log_time));
        if topics.len() <= topic.id {
            topics.resize_with(topic.id + 1, || None);
        }
        let slot = &mut topics[topic.id];
        let known = *stamp.as_ref().unwrap_or(&message.log_time);
        let is_new = slot.is_none();
        let running = slot.get_or_insert_with(|| Running::begin(topic, known, message.log_time));
        if !is_new && stamp.is_ok() {
            running.go_on(known, message.log_time);
        }
        running.entry.messages += 1;
        running.entry.bytes += message.length;
        // The first message that can be read says what the topic holds.
        match stamp
            .and_then(|_| if running.entry.detail.is_empty() { detail(topic, message.data) } else { Ok(String::new()) })
        {
            Ok(detail) if running.entry.detail.is_empty() => running.entry.detail = detail,
            Ok(_) => {}
            Err(error) => {
                running.entry.bad_messages += 1;
                running.entry.first_problem.get_or_insert_with(|| error.to_string());
            }
        }
        Ok(())
    })?;
    let mut topics: Vec<TopicSurvey> = topics.into_iter().flatten().map(Running::finish).collect();
    for topic in recording.topics() {
        if topics.iter().all(|entry| entry.topic != topic.name) {
            topics.push(empty(topic));
        }
    }
    topics.sort_by(|a, b| a.topic.cmp(&b.topic));
    let (first, last) = range.unwrap_or_default();
    Ok(Survey {
        format: recording.format(),
        messages: topics.iter().map(|topic| topic.messages).sum(),
        duration_s: seconds(last - first),
        topics,
        cuts: recording.cuts().to_vec(),
    })
}

fn empty(topic: &Topic) -> TopicSurvey {
    TopicSurvey {
        topic: topic.name.clone(),
        type_name: topic.type_name.clone(),
        read: topic.kind != MessageKind::Other
            && (topic.wire.is_some() || matches!(topic.kind, MessageKind::ImageFile | MessageKind::PoseLine)),
        messages: 0,
        bytes: 0,
        rate_hz: 0.0,
        largest_gap_s: 0.0,
        largest_gap_at_s: 0.0,
        clock_jumps: 0,
        first_jumps: vec![],
        stamp_minus_log_s: 0.0,
        detail: String::new(),
        bad_messages: 0,
        first_problem: None,
    }
}

fn seconds(duration: Stamp) -> f64 {
    duration as f64 * 1e-9
}

impl Running {
    fn begin(topic: &Topic, stamp: Stamp, log_time: Stamp) -> Self {
        let mut entry = empty(topic);
        entry.stamp_minus_log_s = seconds(stamp - log_time);
        Running { entry, first_log: log_time, first: stamp, last: stamp, last_log: log_time, gaps: vec![] }
    }

    fn go_on(&mut self, stamp: Stamp, log_time: Stamp) {
        let gap = stamp - self.last;
        let jump_s = seconds(gap - (log_time - self.last_log));
        if gap < 0 || jump_s.abs() > JUMP_S {
            self.entry.clock_jumps += 1;
            if self.entry.first_jumps.len() < MAX_JUMPS {
                self.entry.first_jumps.push(ClockJump { at_s: seconds(log_time - self.first_log), jump_s });
            }
        }
        if seconds(gap) > self.entry.largest_gap_s {
            self.entry.largest_gap_s = seconds(gap);
            self.entry.largest_gap_at_s = seconds(self.last - self.first);
        }
        if self.gaps.len() < MAX_GAPS {
            self.gaps.push(gap);
        }
        (self.last, self.last_log) = (stamp, log_time);
    }

    fn finish(mut self) -> TopicSurvey {
        self.gaps.sort_unstable();
        let median = self.gaps.get(self.gaps.len() / 2).copied().unwrap_or(0);
        self.entry.rate_hz = if median > 0 { 1.0 / seconds(median) } else { 0.0 };
        self.entry
    }
}

fn detail(topic: &Topic, data: &[u8]) -> Result<String, RecordingError> {
    let Some(wire) = topic.wire else { return Ok(String::new()) };
    Ok(match topic.kind {
        MessageKind::Image => {
            let head = ImageHead::parse(topic.kind, &topic.name, wire, data)?;
            format!("{} {} x {}", head.encoding, head.width, head.height)
        }
        MessageKind::CompressedImage => ImageHead::parse(topic.kind, &topic.name, wire, data)?.encoding.to_owned(),
        MessageKind::CameraInfo => {
            let info = CameraInfo::parse(&topic.name, wire, data)?;
            format!("{} x {}, fx {:.1}, {}", info.width, info.height, info.matrix[0], info.distortion_model)
        }
        MessageKind::JointState => JointState::parse(&topic.name, wire, data)?.names.join(" "),
        _ => String::new(),
    })
}
