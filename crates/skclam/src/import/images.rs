//! The images of a recording by topic: when they were taken, what they are, and from which camera.

use super::clocks::Times;
use super::{Chosen, ImportError};
use skclam_recordings::{Clock, ImageHead, ImageStamp, Place, Recording, RecordingError, Stamp, Topic};
use std::collections::BTreeMap;

/// Size, encoding and frame of images. For compressed ones the size is 0 x 0: it is in the file.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct ImageKind {
    pub encoding: String,
    pub frame_id: String,
    pub size: (u32, u32),
}

/// One image.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenImage {
    pub stamp: Stamp,
    pub log: Stamp,
    pub place: Place,
    kind: u16,
}

/// The images of a topic.
#[derive(Debug, Clone, Default)]
pub(super) struct ImageTopic {
    kinds: Vec<(ImageKind, usize)>,
    pub images: Vec<SeenImage>,
}

/// Images of a recording at the most, over all topics.
const MAX_IMAGES: usize = 1 << 22;
/// Kinds of images of a topic that are distinguished.
const MAX_KINDS: usize = 64;
/// More than this fraction of the images is no accident.
const ACCIDENT: f64 = 0.05;

/// The images of all topics.
#[derive(Debug, Default)]
pub(super) struct Images {
    pub topics: BTreeMap<usize, ImageTopic>,
    count: usize,
}

impl Images {
    pub fn add(
        &mut self,
        topic: &Topic,
        head: Option<&ImageHead<'_>>,
        (stamp, log, place): (Stamp, Stamp, Place),
    ) -> Result<(), RecordingError> {
        self.count += 1;
        if self.count > MAX_IMAGES {
            let problem = format!("there are more than {MAX_IMAGES} images; name the topics, or cut the recording");
            return Err(RecordingError::Message { topic: topic.name.clone(), problem });
        }
        let entry = self.topics.entry(topic.id).or_default();
        let is_same = |kind: &ImageKind| match head {
            Some(head) => {
                kind.encoding == head.encoding
                    && kind.frame_id == head.header.frame_id
                    && kind.size == (head.width, head.height)
            }
            None => true,
        };
        let known = entry.kinds.iter().position(|(kind, _)| is_same(kind));
        let kind = known.unwrap_or_else(|| {
            if entry.kinds.len() < MAX_KINDS {
                let kind = head.map_or_else(ImageKind::default, |head| ImageKind {
                    encoding: head.encoding.to_owned(),
                    frame_id: head.header.frame_id.to_owned(),
                    size: (head.width, head.height),
                });
                entry.kinds.push((kind, 0));
            }
            entry.kinds.len() - 1
        });
        entry.kinds[kind].1 += 1;
        entry.images.push(SeenImage { stamp, log, place, kind: kind as u16 });
        Ok(())
    }
}

impl Images {
    /// The images of a topic by one of the two clocks.
    pub fn stamps(&self, topic: usize, clock: Clock) -> Vec<ImageStamp> {
        let stamp = |image: &SeenImage| ImageStamp {
            stamp: if clock == Clock::Header { image.stamp } else { image.log },
            place: image.place,
        };
        self.topics.get(&topic).map(|topic| topic.images.iter().map(stamp).collect()).unwrap_or_default()
    }

    /// The times of the chosen images, in the order of the topics.
    pub fn times(&self, recording: &Recording, chosen: &Chosen) -> Vec<Times> {
        let times = |(&id, topic): (&usize, &ImageTopic)| {
            let what = if id == chosen.color { "the colour images" } else { "the depth images" };
            let named = &recording.topics()[id];
            Times {
                what: format!("{what} on {}", named.name),
                times: topic.images.iter().map(|image| (image.stamp, image.log)).collect(),
                // The images of a folder have one time.
                has_log: named.wire.is_some(),
            }
        };
        self.topics.iter().map(times).collect()
    }

    /// Stamps that are far off all others are put where they were recorded; how many topics had some.
    pub fn repair(&mut self, times: &[Times]) -> usize {
        let mut repaired = 0;
        for (topic, times) in self.topics.values_mut().zip(times) {
            if let Some(repair) = times.repair() {
                topic.images.iter_mut().for_each(|image| image.stamp = repair(image.stamp, image.log));
                repaired += 1;
            }
        }
        repaired
    }
}

impl ImageTopic {
    /// What most of the images are: the first may be an accident of the camera's start.
    pub fn kind(&self) -> &ImageKind {
        &self.kinds[self.main()].0
    }

    fn main(&self) -> usize {
        (0..self.kinds.len()).rev().max_by_key(|&index| self.kinds[index].1).unwrap_or(0)
    }

    /// Keeps the images that are what most are; how many were dropped.
    ///
    /// # Errors
    /// Where that is no accident: two cameras on one topic, a size that changes.
    pub fn keep_main(&mut self, topic: &Topic) -> Result<usize, ImportError> {
        let main = self.main();
        let others = self.images.iter().filter(|image| usize::from(image.kind) != main).count();
        let second = (0..self.kinds.len()).filter(|&index| index != main).max_by_key(|&index| self.kinds[index].1);
        if let Some(second) = second
            && (others as f64 > ACCIDENT * self.images.len() as f64 && others > 1)
        {
            let [(a, count_a), (b, count_b)] = [&self.kinds[main], &self.kinds[second]];
            let problem = if a.frame_id != b.frame_id {
                format!(
                    "two cameras write into it: {count_a} images are of the frame \"{}\", {count_b} of \"{}\"; give each camera a topic of its own and record anew",
                    a.frame_id, b.frame_id
                )
            } else {
                let shown = |kind: &ImageKind| format!("{} x {} in {}", kind.size.0, kind.size.1, kind.encoding);
                format!(
                    "the images change: {count_a} are {}, {count_b} {}; import a recording for each setting of the camera",
                    shown(a),
                    shown(b)
                )
            };
            return Err(RecordingError::Message { topic: topic.name.clone(), problem }.into());
        }
        self.images.retain(|image| usize::from(image.kind) == main);
        Ok(others)
    }
}
