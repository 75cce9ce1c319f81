//! Values of a joint that jump: lone wrong ones, and those of two publishers on one topic.

use crate::Stamp;

/// What was found in the values of a joint.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Jumps {
    /// They are continuous.
    None,
    /// These (rising positions) jump out and back, each by itself.
    Lone(Vec<usize>),
    /// They jump to and fro between two sequences that are each continuous.
    TwoSources {
        /// How often.
        count: usize,
        /// Two neighbouring values of the two.
        values: [f64; 2],
    },
}

/// A jump is larger than this, radians: far more than encoders flicker. Metres: four tenths.
const MIN_JUMP: f64 = 0.01;
/// ... and faster than this, rad/s: arms turn back slower within one sample.
const MIN_SPEED: f64 = 0.5;
/// So many jumps are no accident.
const MIN_JUMPS: usize = 4;
/// No arm turns faster, rad/s.
const MAX_SPEED: f64 = 10.0;
/// What a sequence may change from one value to the next beside its speed, radians: messages come in bursts.
const SLACK: f64 = 0.05;
/// Sliding joints: metres for a radian.
const METRES: f64 = 0.4;

/// Looks for jumps. `values` in the order of time.
pub(crate) fn find_jumps(values: &[(Stamp, f64)], wrap: bool) -> Jumps {
    let scale = if wrap { 1.0 } else { METRES };
    let lone = lone_values(values, wrap, scale);
    let size = |&index: &usize| difference(values[index - 1].1, values[index].1, wrap).abs();
    if lone.len() >= MIN_JUMPS {
        let mut apart: Vec<f64> =
            lone.windows(2).map(|pair| difference(values[pair[0]].1, values[pair[1]].1, wrap).abs()).collect();
        let mut sizes: Vec<f64> = lone.iter().map(size).collect();
        let median = |list: &mut Vec<f64>| {
            list.sort_by(f64::total_cmp);
            list[list.len() / 2]
        };
        // Values of a second source are like each other; accidents are not.
        if 5 * lone.len() > values.len() || median(&mut apart) < 0.5 * median(&mut sizes) {
            let at = lone[0];
            return Jumps::TwoSources { count: lone.len(), values: [values[at - 1].1, values[at].1] };
        }
    }
    if let Some((count, values)) = interleaved(values, wrap, scale) {
        return Jumps::TwoSources { count, values };
    }
    if lone.is_empty() { Jumps::None } else { Jumps::Lone(lone) }
}

fn difference(from: f64, to: f64, wrap: bool) -> f64 {
    let change = to - from;
    match wrap {
        true => change - std::f64::consts::TAU * (change / std::f64::consts::TAU).round(),
        false => change,
    }
}

fn seconds(from: Stamp, to: Stamp) -> f64 {
    // Messages that came in one moment were not taken in one.
    ((to - from) as f64 * 1e-9).max(1e-3)
}

/// Positions of values that are far from both neighbours, which are near each other.
fn lone_values(values: &[(Stamp, f64)], wrap: bool, scale: f64) -> Vec<usize> {
    let mut found = Vec::new();
    for index in 1..values.len().saturating_sub(1) {
        let [(t0, a), (t1, b), (t2, c)] = [values[index - 1], values[index], values[index + 1]];
        let (out, rest) = (difference(a, b, wrap).abs(), difference(a, c, wrap).abs());
        let speed = out / seconds(t0, t1).max(seconds(t1, t2));
        if out > MIN_JUMP * scale && rest < 0.2 * out && speed > MIN_SPEED * scale {
            found.push(index);
        }
    }
    found
}

/// How often the values change between two continuous sequences, and two values of such a change.
fn interleaved(values: &[(Stamp, f64)], wrap: bool, scale: f64) -> Option<(usize, [f64; 2])> {
    /// A sequence that is not met for long may be anywhere; a second one is only known where it was left.
    const MOST: f64 = 0.5;
    let mut chains: [Option<(Stamp, f64)>; 2] = [values.first().copied(), None];
    let (mut current, mut changes, mut sample) = (0, 0, None);
    for &(time, value) in values.get(1..).unwrap_or_default() {
        // How far the value is off what a sequence allows; below 1 it belongs to it.
        let ratio = |chain: usize, most: f64| {
            let (last, at) = chains[chain]?;
            let allowed = scale * (SLACK + MAX_SPEED * seconds(last, time)).min(most);
            Some(difference(at, value, wrap).abs() / allowed)
        };
        let other = 1 - current;
        let here = ratio(current, f64::INFINITY).unwrap_or(f64::INFINITY);
        let there = ratio(other, MOST).unwrap_or(f64::INFINITY);
        if here <= 1.0 && here <= there.max(0.1) {
            chains[current] = Some((time, value));
        } else if there <= 1.0 {
            changes += 1;
            sample = sample.or(chains[current].map(|(_, from)| [from, value]));
            chains[other] = Some((time, value));
            current = other;
        } else {
            // A new sequence in the place of the one that is not followed.
            chains[other] = Some((time, value));
            current = other;
        }
    }
    sample.filter(|_| changes >= MIN_JUMPS).map(|values| (changes, values))
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Stamp = 1_000_000;

    /// A joint that moves and stops, 50 Hz, with what a second source adds at each step.
    fn series(more: impl Fn(i64) -> Vec<(i64, f64)>) -> Vec<(Stamp, f64)> {
        let mut values = vec![];
        for step in 0..600i64 {
            let (turn, at) = (step / 100, (step % 100) as f64 / 100.0);
            let value = 0.4 * (turn as f64 + (2.0 * at - 1.0).max(0.0));
            values.push((20 * step * MS, value + 1e-4 * (step % 2) as f64));
            values.extend(more(step).into_iter().map(|(later, value)| ((20 * step + later) * MS, value)));
        }
        values
    }

    #[test]
    fn one_source_is_continuous() {
        assert_eq!(find_jumps(&series(|_| vec![]), true), Jumps::None);
        // Jitter of a network: messages in bursts of five.
        let bursts: Vec<(Stamp, f64)> =
            series(|_| vec![]).iter().map(|&(time, value)| (time / (100 * MS) * 100 * MS, value)).collect();
        assert_eq!(find_jumps(&bursts, true), Jumps::None);
        // Full turns are none.
        let turned: Vec<(Stamp, f64)> = series(|_| vec![])
            .iter()
            .map(|&(time, v)| (time, v + if v > 1.0 { std::f64::consts::TAU } else { 0.0 }))
            .collect();
        assert_eq!(find_jumps(&turned, true), Jumps::None);
        // From posture to posture and home again, one value each.
        let snapshots: Vec<(Stamp, f64)> =
            (0..40).map(|k| (5000 * MS * k, if k % 2 == 0 { 0.3 } else { 1.0 })).collect();
        assert_eq!(find_jumps(&snapshots, true), Jumps::None);
    }

    #[test]
    fn two_sources_are_noticed_at_any_rate() {
        let two =
            |more: &dyn Fn(i64) -> Vec<(i64, f64)>| matches!(find_jumps(&series(more), true), Jumps::TwoSources { .. });
        assert!(two(&|_| vec![(10, 0.0)]), "zeros as often");
        assert!(two(&|step| if step % 50 == 0 { vec![(3, 0.0)] } else { vec![] }), "zeros once a second");
        assert!(two(&|step| vec![(2, -1.0 + 0.001 * step as f64), (4, -1.0 + 0.001 * step as f64)]), "twice as often");
        assert!(two(&|_| vec![(0, 0.5)]), "at the same times");
        let bursts = |step: i64| if step % 10 == 0 { (1..9).map(|k| (k, 3.0)).collect() } else { vec![] };
        assert!(two(&bursts), "eight at once");
    }

    #[test]
    fn lone_wrong_values_are_named_by_their_places() {
        let values =
            series(|step| if [100, 300].contains(&step) { vec![(10, 2.9 - 0.01 * step as f64)] } else { vec![] });
        assert_eq!(find_jumps(&values, true), Jumps::Lone(vec![101, 302]));
    }
}
