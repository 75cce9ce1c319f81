//! The joints of an arm as one track, wherever they came from.

use crate::jumps::{Jumps, find_jumps};
use crate::{Clock, JointCollector, JointPlace, JointTrack, Stamp};

impl JointCollector {
    /// The joints of the arm as one track, at the times of the joint that comes most often; the others are interpolated,
    /// angles the short way, where they come in other messages. Lone values that jump out and back are left out.
    ///
    /// `wraps`: for each joint, whether it is an angle. Between two samples further apart than `max_gap` nanoseconds a
    /// joint is unknown, unless both have the same value. The times rise, but may be equal.
    pub fn merged(&self, places: &[JointPlace], wraps: &[bool], clock: Clock, max_gap: Stamp) -> Merged {
        let mut lone = 0;
        let mut jumps = None;
        let mut columns = Vec::with_capacity(places.len());
        for (joint, (place, &wrap)) in places.iter().zip(wraps).enumerate() {
            let mut values = self.series(place).map(|series| series.sorted(clock)).unwrap_or_default();
            match find_jumps(&values, wrap) {
                Jumps::None => {}
                Jumps::Lone(indices) => {
                    lone += indices.len();
                    let mut index = 0;
                    values.retain(|_| {
                        index += 1;
                        indices.binary_search(&(index - 1)).is_err()
                    });
                }
                Jumps::TwoSources { count, values: [a, b], .. } => {
                    jumps.get_or_insert(FoundJumps { joint, count, values: [a, b] });
                }
            }
            columns.push(Column { values, wrap, max_gap });
        }
        let base = (0..columns.len()).rev().max_by_key(|&index| columns[index].values.len());
        let mut track = JointTrack::new(wraps.to_vec());
        let mut unknown = vec![0; columns.len()];
        let Some(base) = base else { return Merged { track, unknown, lone, jumps } };
        let (mut before, mut ordinal) = (None, 0);
        for &(time, _) in &columns[base].values {
            ordinal = if before == Some(time) { ordinal + 1 } else { 0 };
            before = Some(time);
            let row: Vec<Option<f64>> = columns.iter().map(|column| column.at(time, ordinal)).collect();
            row.iter().zip(&mut unknown).for_each(|(value, unknown)| *unknown += usize::from(value.is_none()));
            if let Some(row) = row.into_iter().collect::<Option<Vec<f64>>>() {
                track.push(time, &row);
            }
        }
        Merged { track, unknown, lone, jumps }
    }
}

/// The joints of an arm, put together.
#[derive(Debug, Clone)]
pub struct Merged {
    /// All joints.
    pub track: JointTrack,
    /// For each joint, at how many times it was unknown.
    pub unknown: Vec<usize>,
    /// Lone values that were left out.
    pub lone: usize,
    /// Where values jump between two sources.
    pub jumps: Option<FoundJumps>,
}

/// Values of a joint that jump to and fro, as those of two publishers on a topic do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundJumps {
    /// Which joint of the arm.
    pub joint: usize,
    /// How often.
    pub count: usize,
    /// Between what values once.
    pub values: [f64; 2],
}

struct Column {
    values: Vec<(Stamp, f64)>,
    wrap: bool,
    max_gap: Stamp,
}

impl Column {
    /// The value at a time; of several at the same time the `ordinal`-th, so that those of one message stay together.
    fn at(&self, time: Stamp, ordinal: usize) -> Option<f64> {
        const SAME_VALUE: f64 = 2e-4;
        let after = self.values.partition_point(|&(t, _)| t < time);
        if self.values.get(after).is_some_and(|&(t, _)| t == time) {
            let wanted = self.values.get(after + ordinal).filter(|&&(t, _)| t == time);
            return Some(wanted.unwrap_or(&self.values[after]).1);
        }
        let before = after.checked_sub(1).map(|index| self.values[index]);
        match (before, self.values.get(after)) {
            (Some((t0, a)), Some(&(t1, b))) => {
                let mut change = b - a;
                if self.wrap {
                    change -= std::f64::consts::TAU * (change / std::f64::consts::TAU).round();
                }
                let known = t1 - t0 <= self.max_gap || change.abs() <= SAME_VALUE;
                known.then(|| a + change * ((time - t0) as f64 / (t1 - t0) as f64))
            }
            // At the ends the nearest value holds for a moment.
            (Some((t, value)), None) | (None, Some(&(t, value))) => {
                ((t - time).abs() <= self.max_gap / 2).then_some(value)
            }
            (None, None) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Header, JointState};

    const MS: Stamp = 1_000_000;

    fn state<'a>(time_ms: i64, names: &[&'a str], positions: &[f64]) -> JointState<'a> {
        let header = Header { stamp: time_ms * MS, frame_id: "" };
        JointState { header, names: names.to_vec(), positions: positions.to_vec() }
    }

    #[test]
    fn joints_of_two_messages_are_merged_by_time() {
        let mut states = vec![];
        for step in 0..50 {
            states.push(state(20 * step, &["a"], &[0.001 * step as f64]));
            states.push(state(20 * step + 7, &["b", "wheel"], &[0.002 * step as f64, f64::NAN]));
        }
        let mut collector = JointCollector::default();
        states.iter().for_each(|state| collector.add(0, state.header.stamp, state, None, &|_| true));
        let places = ["b", "a"].map(|name| (0, name.to_owned()));
        let merged = collector.merged(&places, &[true, true], Clock::Header, 500 * MS);
        assert!(merged.jumps.is_none() && merged.track.len() == 50, "{merged:?}");
        for index in 2..48 {
            let [b, a] = *merged.track.at(index) else { panic!() };
            let at_ms = merged.track.times()[index] as f64 / MS as f64;
            assert!((a - 0.001 * at_ms / 20.0).abs() < 1e-9 && (b - 0.002 * (at_ms - 7.0) / 20.0).abs() < 1e-9);
        }
    }
}
