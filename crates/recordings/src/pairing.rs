//! Which images become postures: colour, depth and joints paired by their stamps.

use crate::stationary::nanoseconds;
use crate::{JointTrack, Place, RecordingError, Stamp, StationaryInterval, find_stationary_intervals, interpolated};
use serde::{Deserialize, Serialize};

/// Which images are postures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Selection {
    /// [`Still`](Selection::Still), or [`Snapshots`](Selection::Snapshots) where joints come so seldom that no speed
    /// can be derived from them.
    #[default]
    Automatic,
    /// One image each time that the arm stands still.
    Still,
    /// Every image with joints beside it: the recording was made posture by posture.
    Snapshots,
    /// Every n-th image, with interpolated joints.
    Moving {
        /// The n.
        every: u32,
    },
}

/// Options of the choice of postures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelectionOptions {
    /// Which images are postures.
    pub selection: Selection,
    /// The arm stands still while every joint is slower than this, rad/s or m/s.
    pub max_joint_speed: f64,
    /// ... for at least this long, seconds.
    pub min_stationary_s: f64,
    /// After the arm has stopped it swings for so long, seconds; images of that time are not used.
    pub settle_s: f64,
    /// Joints are unknown between samples further apart than this, seconds.
    pub max_gap_s: f64,
    /// A snapshot's joints are at most so far from its image, seconds.
    pub joint_tolerance_s: f64,
    /// A depth image is at most so far from its colour image, seconds.
    pub depth_tolerance_s: f64,
    /// Images of a stationary interval that are compared for sharpness, at most.
    pub candidates: usize,
}

impl Default for SelectionOptions {
    fn default() -> Self {
        SelectionOptions {
            selection: Selection::Automatic,
            max_joint_speed: 0.3f64.to_radians(),
            min_stationary_s: 0.5,
            settle_s: 0.25,
            max_gap_s: 0.5,
            joint_tolerance_s: 0.05,
            depth_tolerance_s: 0.035,
            candidates: 8,
        }
    }
}

impl SelectionOptions {
    fn check(&self) -> Result<(), RecordingError> {
        let need = "a number from 0 to 1e6 is needed";
        for (option, value) in [
            ("max_joint_speed", self.max_joint_speed),
            ("min_stationary_s", self.min_stationary_s),
            ("settle_s", self.settle_s),
            ("max_gap_s", self.max_gap_s),
            ("joint_tolerance_s", self.joint_tolerance_s),
            ("depth_tolerance_s", self.depth_tolerance_s),
        ] {
            if !(0.0..=1e6).contains(&value) {
                return Err(RecordingError::Option { option, value: value.to_string(), need });
            }
        }
        if self.candidates == 0 || matches!(self.selection, Selection::Moving { every: 0 }) {
            let option = if self.candidates == 0 { "candidates" } else { "every" };
            return Err(RecordingError::Option { option, value: "0".to_owned(), need: "1 or more is needed" });
        }
        Ok(())
    }
}

/// When an image was taken and where it lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageStamp {
    /// Stamp of its header.
    pub stamp: Stamp,
    /// Where the message lies.
    pub place: Place,
}

/// One colour image that may represent a posture.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// The colour image.
    pub color: ImageStamp,
    /// The depth image that belongs to it.
    pub depth: Option<ImageStamp>,
    /// Joint values (or the values of another track) at that moment.
    pub joints: Vec<f64>,
}

/// A posture and the images that may represent it, at least one.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedPosture {
    /// In the order of time; the sharpest is to be taken.
    pub candidates: Vec<Candidate>,
}

/// What is worth decoding.
#[derive(Debug, Clone, PartialEq)]
pub struct PosturePlan {
    /// In the order of time.
    pub postures: Vec<PlannedPosture>,
    /// What was selected: never [`Selection::Automatic`].
    pub selection: Selection,
    /// Times at which the arm stood still; without images among them.
    pub intervals: usize,
    /// Images (or intervals) left out because no joints were known.
    pub without_joints: usize,
    /// Postures without a depth image although the recording has depth.
    pub without_depth: usize,
    /// Images of a moving arm, left out.
    pub moving: usize,
}

/// Chooses the images that are worth decoding. `color` and `depth` may come in any order; `track` must be sorted.
///
/// # Errors
/// [`RecordingError::Option`].
pub fn plan_postures(
    track: &JointTrack,
    color: &[ImageStamp],
    depth: &[ImageStamp],
    options: &SelectionOptions,
) -> Result<PosturePlan, RecordingError> {
    options.check()?;
    let sorted = |images: &[ImageStamp]| {
        let mut images = images.to_vec();
        images.sort_by_key(|image| (image.stamp, image.place));
        images
    };
    let (color, depth) = (sorted(color), sorted(depth));
    let selection = match options.selection {
        Selection::Automatic if median_gap(track).is_none_or(|gap| gap > nanoseconds(options.max_gap_s)) => {
            Selection::Snapshots
        }
        Selection::Automatic => Selection::Still,
        chosen => chosen,
    };
    let planner = Planner { track, depth: &depth, options };
    let mut plan =
        PosturePlan { postures: vec![], selection, intervals: 0, without_joints: 0, without_depth: 0, moving: 0 };
    match selection {
        Selection::Still | Selection::Automatic => planner.intervals(&color, &mut plan),
        Selection::Snapshots => planner.each(&color, &mut plan, |planner, time| {
            let nearest = planner.track.nearest(time)?;
            let distance = (planner.track.times()[nearest] - time).abs();
            (distance <= nanoseconds(options.joint_tolerance_s)).then(|| planner.track.at(nearest).to_vec())
        }),
        Selection::Moving { every } => {
            let some: Vec<ImageStamp> = color.iter().step_by(every as usize).copied().collect();
            planner.each(&some, &mut plan, |planner, time| {
                interpolated(planner.track, time, nanoseconds(options.max_gap_s))
            });
        }
    }
    let lacks_depth = |posture: &&PlannedPosture| posture.candidates.iter().all(|image| image.depth.is_none());
    plan.without_depth = if depth.is_empty() { 0 } else { plan.postures.iter().filter(lacks_depth).count() };
    Ok(plan)
}

fn median_gap(track: &JointTrack) -> Option<Stamp> {
    let mut gaps: Vec<Stamp> = track.times().windows(2).map(|pair| pair[1] - pair[0]).collect();
    gaps.sort_unstable();
    gaps.get(gaps.len() / 2).copied()
}

struct Planner<'a> {
    track: &'a JointTrack,
    depth: &'a [ImageStamp],
    options: &'a SelectionOptions,
}

impl Planner<'_> {
    /// Every image is a posture of its own.
    fn each(&self, color: &[ImageStamp], plan: &mut PosturePlan, joints_at: impl Fn(&Self, Stamp) -> Option<Vec<f64>>) {
        for &image in color {
            match joints_at(self, image.stamp) {
                Some(joints) => {
                    let candidate = Candidate { color: image, depth: self.depth_of(image.stamp), joints };
                    plan.postures.push(PlannedPosture { candidates: vec![candidate] });
                }
                None => plan.without_joints += 1,
            }
        }
    }

    fn intervals(&self, color: &[ImageStamp], plan: &mut PosturePlan) {
        let intervals = find_stationary_intervals(self.track, self.options);
        plan.intervals = intervals.len();
        let settle = nanoseconds(self.options.settle_s);
        let mut used = 0;
        for StationaryInterval { begin, end } in intervals {
            let first = color.partition_point(|image| image.stamp < begin + settle);
            let last = color.partition_point(|image| image.stamp <= end);
            let images = &color[first..last.max(first)];
            used += images.len();
            if let Some(posture) = self.posture(images) {
                plan.postures.push(posture);
            }
        }
        plan.moving = color.len() - used;
    }

    fn posture(&self, images: &[ImageStamp]) -> Option<PlannedPosture> {
        const AROUND: Stamp = 50_000_000;
        let mut candidates: Vec<Candidate> = images
            .iter()
            .filter_map(|&color| {
                let joints = self.track.mean_near(color.stamp, AROUND)?;
                Some(Candidate { color, depth: self.depth_of(color.stamp), joints })
            })
            .collect();
        if candidates.iter().any(|candidate| candidate.depth.is_some()) {
            candidates.retain(|candidate| candidate.depth.is_some());
        }
        // Spread over the interval; the later ones are the calmer ones, so the last is always among them.
        let (count, most) = (candidates.len(), self.options.candidates);
        if count > most {
            let chosen: Vec<usize> = (1..=most).map(|step| step * count / most - 1).collect();
            let mut index = 0;
            candidates.retain(|_| {
                index += 1;
                chosen.binary_search(&(index - 1)).is_ok()
            });
        }
        (!candidates.is_empty()).then_some(PlannedPosture { candidates })
    }

    fn depth_of(&self, stamp: Stamp) -> Option<ImageStamp> {
        let after = self.depth.partition_point(|image| image.stamp < stamp);
        let candidates = [after.checked_sub(1).map(|index| self.depth[index]), self.depth.get(after).copied()];
        let nearest = candidates.into_iter().flatten().min_by_key(|image| (image.stamp - stamp).abs())?;
        ((nearest.stamp - stamp).abs() <= nanoseconds(self.options.depth_tolerance_s)).then_some(nearest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Stamp = 1_000_000;

    fn images(times_ms: impl IntoIterator<Item = i64>) -> Vec<ImageStamp> {
        let place = |ordinal| Place { file: 0, offset: 0, ordinal };
        times_ms
            .into_iter()
            .enumerate()
            .map(|(index, time)| ImageStamp { stamp: time * MS, place: place(index as u32) })
            .collect()
    }

    /// 2 s at rest, 1 s of motion, 2 s at rest; 100 Hz.
    fn track() -> JointTrack {
        let mut track = JointTrack::new(vec![true]);
        for step in 0..500 {
            track.push(step * 10 * MS, &[((step - 200) as f64 / 100.0).clamp(0.0, 1.0)]);
        }
        track
    }

    #[test]
    fn a_posture_per_stationary_interval_with_settled_images_and_their_depth() {
        let color = images((0..150).map(|index| index * 33));
        let depth = images((0..150).map(|index| index * 33 + 8));
        let plan = plan_postures(&track(), &color, &depth, &SelectionOptions::default()).unwrap();
        assert_eq!((plan.postures.len(), plan.intervals, plan.selection), (2, 2, Selection::Still));
        for (posture, (begin, value)) in plan.postures.iter().zip([(250, 0.0), (3250, 1.0)]) {
            assert_eq!(posture.candidates.len(), 8);
            for candidate in &posture.candidates {
                assert!(candidate.color.stamp >= begin * MS);
                assert_eq!(candidate.depth.unwrap().stamp - candidate.color.stamp, 8 * MS);
                assert!((candidate.joints[0] - value).abs() < 1e-12);
            }
        }
        assert!(plan.moving > 30);
    }

    #[test]
    fn moving_interpolates_and_snapshots_take_the_nearest() {
        let color = images([1000, 2505, 9000]);
        let options = |selection| SelectionOptions { selection, ..SelectionOptions::default() };
        let moving = plan_postures(&track(), &color, &[], &options(Selection::Moving { every: 1 })).unwrap();
        assert_eq!((moving.postures.len(), moving.without_joints), (2, 1));
        assert!((moving.postures[1].candidates[0].joints[0] - 0.505).abs() < 1e-12);
        let mut sparse = JointTrack::new(vec![true]);
        for (time, value) in [(1005, 0.25), (3005, 0.5), (5005, 0.75)] {
            sparse.push(time * MS, &[value]);
        }
        let plan =
            plan_postures(&sparse, &images([1000, 3000, 4000, 5000]), &[], &SelectionOptions::default()).unwrap();
        assert_eq!((plan.selection, plan.postures.len(), plan.without_joints), (Selection::Snapshots, 3, 1));
        assert_eq!(plan.postures[1].candidates[0].joints, [0.5]);
        let bad = plan_postures(&sparse, &color, &[], &options(Selection::Moving { every: 0 })).unwrap_err();
        assert_eq!(bad.to_string(), "option every is 0; 1 or more is needed");
    }
}
