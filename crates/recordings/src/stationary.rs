//! When the arm stood still.

use crate::{JointTrack, SelectionOptions, Stamp};

/// An interval in which no joint moved, nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StationaryInterval {
    /// First moment at rest.
    pub begin: Stamp,
    /// Last moment at rest.
    pub end: Stamp,
}

/// Over what time a speed is measured: longer than the steps of an encoder read at 500 Hz matter.
const SPEED_WINDOW: Stamp = 100_000_000;

/// The intervals in which every joint was slower than `max_joint_speed` for at least `min_stationary_s`, in order.
///
/// A speed is the change over 0.1 s, or between the neighbouring samples where these are further apart. Where no sample
/// came for longer than `max_gap_s` nobody knows what the arm did, and the interval ends; two intervals at the same
/// joint values with such a gap between are one.
pub fn find_stationary_intervals(track: &JointTrack, options: &SelectionOptions) -> Vec<StationaryInterval> {
    let times = track.times();
    let max_gap = nanoseconds(options.max_gap_s);
    let mut intervals: Vec<(StationaryInterval, usize, usize)> = Vec::new();
    let mut open: Option<usize> = None;
    let mut close = |first: usize, last: usize| {
        let interval = StationaryInterval { begin: times[first], end: times[last] };
        if let Some((before, _, before_last)) = intervals.last_mut() {
            // Neighbouring samples: nothing but missing ones parts the two.
            if first == *before_last + 1 && track.largest_change(*before_last, first) <= SAME_POSTURE {
                (before.end, *before_last) = (interval.end, last);
                return;
            }
        }
        intervals.push((interval, first, last));
    };
    for index in 0..times.len() {
        let gap = index > 0 && times[index] - times[index - 1] > max_gap;
        let still = speed(track, index, max_gap) <= options.max_joint_speed;
        if let (Some(first), true) = (open, gap || !still) {
            close(first, index - 1);
            open = None;
        }
        if still && open.is_none() {
            open = Some(index);
        }
    }
    if let Some(first) = open {
        close(first, times.len() - 1);
    }
    let long_enough =
        |interval: &StationaryInterval| interval.end - interval.begin >= nanoseconds(options.min_stationary_s);
    intervals.into_iter().map(|(interval, ..)| interval).filter(long_enough).collect()
}

/// Joint values that are the same posture for an encoder, radians or metres.
const SAME_POSTURE: f64 = 2e-4;

/// The largest joint speed about a sample, rad/s or m/s; infinite where no sample is near enough.
fn speed(track: &JointTrack, index: usize, max_gap: Stamp) -> f64 {
    let times = track.times();
    let mut first = index;
    while first > 0 && times[index] - times[first - 1] <= SPEED_WINDOW / 2 {
        first -= 1;
    }
    let mut last = index;
    while last + 1 < times.len() && times[last + 1] - times[index] <= SPEED_WINDOW / 2 {
        last += 1;
    }
    if first == index && index > 0 && times[index] - times[index - 1] <= max_gap {
        first -= 1;
    }
    if last == index && index + 1 < times.len() && times[index + 1] - times[index] <= max_gap {
        last += 1;
    }
    match times[last] - times[first] {
        0 => f64::INFINITY,
        duration => track.largest_change(first, last) / (duration as f64 * 1e-9),
    }
}

pub(crate) fn nanoseconds(seconds: f64) -> Stamp {
    (seconds * 1e9).round() as Stamp
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rests at 0 rad for 1 s, moves to 1 rad in 1 s, rests for 1 s; 100 Hz with a step of the encoder.
    fn track(from_ms: i64) -> JointTrack {
        let mut track = JointTrack::new(vec![true, true]);
        for step in from_ms / 10..300 {
            let fraction = ((step - 100) as f64 / 100.0).clamp(0.0, 1.0);
            track.push(step * 10_000_000, &[fraction, 1e-4 * (step % 2) as f64]);
        }
        track
    }

    #[test]
    fn intervals_are_found_between_motions() {
        let intervals = find_stationary_intervals(&track(0), &SelectionOptions::default());
        assert_eq!(intervals.len(), 2);
        let seconds = |stamp: Stamp| stamp as f64 * 1e-9;
        assert!(seconds(intervals[0].begin) == 0.0 && (seconds(intervals[0].end) - 0.95).abs() < 0.02, "{intervals:?}");
        assert!(
            (seconds(intervals[1].begin) - 2.05).abs() < 0.02 && seconds(intervals[1].end) == 2.99,
            "{intervals:?}"
        );
        let short = find_stationary_intervals(&track(700), &SelectionOptions::default());
        assert_eq!(short.len(), 1, "0.25 s are no stationary interval: {short:?}");
    }

    #[test]
    fn a_gap_ends_an_interval_unless_the_arm_is_where_it_was() {
        let mut parted = JointTrack::new(vec![true]);
        for step in 0..100 {
            parted.push(step * 10_000_000, &[0.0]);
        }
        for step in 300..400 {
            parted.push(step * 10_000_000, &[0.0]);
        }
        assert_eq!(find_stationary_intervals(&parted, &SelectionOptions::default()).len(), 1);
        for step in 600..700 {
            parted.push(step * 10_000_000, &[0.5]);
        }
        let intervals = find_stationary_intervals(&parted, &SelectionOptions::default());
        assert_eq!(intervals.len(), 2);
        assert_eq!(intervals[1].begin, 6_000_000_000);
    }
}
