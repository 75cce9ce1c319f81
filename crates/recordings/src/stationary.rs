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
/// A speed is the change over 0.1 s, from the mean of the first half to that of the second, or between the neighbouring
/// samples where these are further apart. Where no sample came for longer than `max_gap_s` nobody knows what the arm did,
/// and an interval ends; two intervals at the same joint values with such a gap between are one. So are two between which the
/// joints flickered and went nowhere; and an encoder that flickers all the time is watched for longer.
pub fn find_stationary_intervals(track: &JointTrack, options: &SelectionOptions) -> Vec<StationaryInterval> {
    let times = track.times();
    let max_gap = nanoseconds(options.max_gap_s);
    // First and last sample of each, and where its joints were at first.
    let mut intervals: Vec<(usize, usize, Vec<f64>)> = Vec::new();
    let mut open: Option<usize> = None;
    let mut close = |first: usize, last: usize| {
        let begins_at = track.mean_of(first, last.min(first + MEAN_OF) + 1);
        if let Some((begin, before, anchor)) = intervals.last_mut() {
            let flickers = || is_flicker(track, (*begin, *before, anchor.as_slice()), (first, &begins_at), max_gap);
            if is_same_interval(track, *before, first) || flickers() {
                *before = last;
                return;
            }
        }
        intervals.push((first, last, begins_at));
    };
    for index in 0..times.len() {
        let gap = index > 0 && times[index] - times[index - 1] > max_gap;
        let still = speed(track, index, max_gap) <= options.max_joint_speed
            || flickers_at_rest(track, index, options.max_joint_speed);
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
    let intervals =
        intervals.into_iter().map(|(first, last, _)| StationaryInterval { begin: times[first], end: times[last] });
    intervals.filter(|interval| interval.end - interval.begin >= nanoseconds(options.min_stationary_s)).collect()
}

/// Neighbouring samples at the same values: nothing but missing ones parts the two intervals.
fn is_same_interval(track: &JointTrack, last: usize, first: usize) -> bool {
    first == last + 1 && track.largest_change(last, first) <= SAME_POSTURE
}

/// Whether all that lies between two parts of an interval is the flicker of an encoder: no sample is far from either part,
/// and the second is the same posture as the first was at its beginning, up to the flicker.
fn is_flicker(track: &JointTrack, before: (usize, usize, &[f64]), after: (usize, &[f64]), max_gap: Stamp) -> bool {
    let ((begin, last, anchor), (first, begins_at)) = (before, after);
    if track.times()[first] - track.times()[last] > max_gap.min(FLICKER_TIME) {
        return false;
    }
    let ends_at = track.mean_of(begin.max(last.saturating_sub(MEAN_OF)), last + 1);
    let near = |index: usize| {
        [&ends_at[..], begins_at].iter().all(|mean| track.largest_difference(mean, track.at(index)) <= FLICKER)
    };
    let moved = track.largest_difference(&ends_at, begins_at);
    moved <= FLICKER / 2.0 && track.largest_difference(anchor, begins_at) <= FLICKER && (last..=first).all(near)
}

/// Samples at the ends of a part whose mean is taken, at the most.
const MEAN_OF: usize = 64;
/// Over what time a joint that flickers is watched, nanoseconds.
const FLICKER_WINDOW: Stamp = 400_000_000;

/// Whether no joint is far from its mean in a time that is longer than that of a speed, and the means of the two halves of
/// this time are as near each other as those of an arm at rest: an encoder that flickers from sample to sample.
fn flickers_at_rest(track: &JointTrack, index: usize, max_speed: f64) -> bool {
    let times = track.times();
    let (from, to) = (times[index] - FLICKER_WINDOW / 2, times[index] + FLICKER_WINDOW / 2);
    let (begin, end) = (times.partition_point(|&t| t < from), times.partition_point(|&t| t <= to));
    // An arm in motion is known by the ends alone, as a rule.
    if end < begin + 3 || track.largest_change(begin, end - 1) > 2.0 * FLICKER {
        return false;
    }
    let middle = begin + (end - begin) / 2;
    let duration = (times[end - 1] - times[begin]) as f64 * 0.5e-9;
    let [first, second] = [track.mean_of(begin, middle), track.mean_of(middle, end)];
    if duration <= 0.0 || track.largest_difference(&first, &second) / duration > max_speed {
        return false;
    }
    let mean = track.mean_of(begin, end);
    (begin..end).all(|index| track.largest_difference(&mean, track.at(index)) <= FLICKER)
}

/// How far a flickering encoder is from its mean at the most, radians or metres: a tenth of a degree.
const FLICKER: f64 = 2e-3;
/// Flicker hides a stationary interval for less than this.
const FLICKER_TIME: Stamp = 400_000_000;

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
    // Two halves, which share the sample in the middle of an odd number.
    let half = (last - first) / 2 + 1;
    let halves = [(first, first + half), (last + 1 - half, last + 1)];
    let middle = |(begin, end): (usize, usize)| {
        let sum: f64 = (begin..end).map(|index| (times[index] - times[first]) as f64).sum();
        sum / (end - begin) as f64
    };
    let duration = middle(halves[1]) - middle(halves[0]);
    if duration <= 0.0 {
        return f64::INFINITY;
    }
    let [from, to] = halves.map(|(begin, end)| track.mean_of(begin, end));
    track.largest_difference(&from, &to) / (duration * 1e-9)
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
    fn flicker_of_an_encoder_hides_no_stationary_interval() {
        // The track's second joint flickers by 1e-3 rad in all ways that encoders do, at several rates.
        type Flicker = (&'static str, fn(i64) -> f64);
        let flickers: [Flicker; 6] = [
            ("two at rest, one up", |step| f64::from(step % 3 == 0)),
            ("every sample", |step| (step % 2) as f64),
            ("blocks of three", |step| (step / 3 % 2) as f64),
            ("blocks of seven", |step| (step / 7 % 2) as f64),
            ("like noise", |step| (step * 7919 % 101) as f64 / 101.0),
            ("now and then", |step| f64::from(step % 23 == 0)),
        ];
        for (name, flicker) in flickers {
            for rate in [20, 50, 100, 250] {
                let mut track = JointTrack::new(vec![true, true]);
                for step in 0..5 * rate {
                    let fraction = (step as f64 / rate as f64 - 2.0).clamp(0.0, 1.0);
                    track.push(step * (1_000_000_000 / rate), &[fraction, 1e-3 * flicker(step)]);
                }
                let intervals = find_stationary_intervals(&track, &SelectionOptions::default());
                assert_eq!(intervals.len(), 2, "{name}, {rate} Hz: {intervals:?}");
                let length = (intervals[0].end - intervals[0].begin) as f64 * 1e-9;
                assert!(length > 1.6, "{name}, {rate} Hz: {intervals:?}");
            }
        }
    }

    #[test]
    fn creeping_is_not_stationary() {
        for speed in [0.02, 0.05] {
            let mut track = JointTrack::new(vec![true]);
            for step in 0..500 {
                track.push(step * 10_000_000, &[speed * 0.01 * step as f64 + 5e-4 * (step % 2) as f64]);
            }
            let intervals = find_stationary_intervals(&track, &SelectionOptions::default());
            assert!(intervals.is_empty(), "{speed}: {intervals:?}");
        }
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
