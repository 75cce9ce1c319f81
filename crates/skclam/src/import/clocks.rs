//! Which of a message's two times are used: the stamps in the headers, or the times of recording where the stamps say
//! nothing. Stamps of two clocks are noticed, and the gap between them is named.

use super::ImportError;
use serde::{Deserialize, Serialize};
use skclam_recordings::{Clock, Stamp};

/// Which times pair images and joints.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClockChoice {
    /// The stamps in the headers; the times of recording where the stamps do not go on.
    #[default]
    Automatic,
    /// The stamps in the headers, whatever the recorder's clock said.
    Header,
    /// The times of recording.
    Log,
}

/// The times of one topic, or of one joint.
#[derive(Debug, Clone)]
pub(super) struct Times {
    /// "the colour images on /camera/image", ...
    pub what: String,
    /// Stamp and time of recording; the same where there is but one.
    pub times: Vec<(Stamp, Stamp)>,
    /// Whether the two come from different clocks at all.
    pub has_log: bool,
}

/// Seconds by which two clocks may differ; networks and drivers delay messages by less.
const SAME_CLOCK_S: f64 = 1.0;
/// A fraction of the time of recording that stamps must cover at least; those of slow simulations do.
const MIN_PROGRESS: f64 = 0.01;

fn seconds(stamp: Stamp) -> f64 {
    stamp as f64 * 1e-9
}

fn quantile(values: &mut [Stamp], fraction: f64) -> Stamp {
    let index = ((values.len() - 1) as f64 * fraction).round() as usize;
    *values.select_nth_unstable(index).1
}

impl Times {
    fn spread(&self, of: impl Fn(&(Stamp, Stamp)) -> Stamp) -> f64 {
        let mut values: Vec<Stamp> = self.times.iter().map(of).collect();
        let (low, high) = (quantile(&mut values, 0.1), quantile(&mut values, 0.9));
        seconds(high.saturating_sub(low))
    }

    /// Whether the stamps stand still while the recorder's clock goes on: all zero, all the same.
    fn is_frozen(&self) -> bool {
        self.has_log && self.times.len() > 1 && self.spread(|time| time.0) <= MIN_PROGRESS * self.spread(|time| time.1)
    }

    /// Stamp minus time of recording: the middle and the spread, seconds.
    fn offset(&self) -> (f64, f64) {
        let mut offsets: Vec<Stamp> = self.times.iter().map(|(stamp, log)| stamp.saturating_sub(*log)).collect();
        (seconds(quantile(&mut offsets, 0.5)), self.spread(|(stamp, log)| stamp.saturating_sub(*log)))
    }

    /// First and last time.
    fn range(&self, clock: Clock) -> (Stamp, Stamp) {
        let times = self.times.iter().map(|time| if clock == Clock::Header { time.0 } else { time.1 });
        times.fold((Stamp::MAX, Stamp::MIN), |(first, last), time| (first.min(time), last.max(time)))
    }

    /// A stamp that is far off all others, zero as a rule, is put where its time of recording says. `None`: it is right.
    pub fn repair(&self) -> Option<impl Fn(Stamp, Stamp) -> Stamp + use<>> {
        if !self.has_log || self.times.len() < 3 || self.is_frozen() {
            return None;
        }
        let (middle, spread) = self.offset();
        let tolerance = SAME_CLOCK_S.max(3.0 * spread);
        let offset = (middle * 1e9).round() as Stamp;
        let is_stray = move |stamp: Stamp, log: Stamp| {
            (seconds(stamp.saturating_sub(log).saturating_sub(offset))).abs() > tolerance
        };
        let stray = self.times.iter().filter(|&&(stamp, log)| is_stray(stamp, log)).count();
        (stray > 0).then_some(move |stamp: Stamp, log: Stamp| match is_stray(stamp, log) {
            true => log.saturating_add(offset),
            false => stamp,
        })
    }
}

/// Decides for all topics together: images and joints must be timed by one clock.
///
/// # Errors
/// [`ImportError::Clocks`]: neither stamps nor times of recording go on, or images and joints have clocks of their own.
pub(super) fn choose_clock(
    images: &[Times],
    joints: &[Times],
    choice: ClockChoice,
    warnings: &mut Vec<String>,
) -> Result<Clock, ImportError> {
    let all = || images.iter().chain(joints).filter(|times| !times.times.is_empty());
    let frozen: Vec<&str> = all().filter(|times| times.is_frozen()).map(|times| times.what.as_str()).collect();
    let clock = match choice {
        ClockChoice::Header => Clock::Header,
        ClockChoice::Log => Clock::Log,
        ClockChoice::Automatic if frozen.is_empty() => Clock::Header,
        ClockChoice::Automatic => {
            warnings.push(format!(
                "the stamps of {} are all the same (or nearly so), so the times of recording are used for all topics; they lag by what the network and the drivers took",
                frozen.join(" and of ")
            ));
            Clock::Log
        }
    };
    if let Some(times) = all().find(|times| {
        let (first, last) = times.range(clock);
        times.times.len() > 1 && first == last
    }) {
        let (stamp, log) = times.times[0];
        return Err(ImportError::Clocks {
            problem: format!(
                "all {} messages of {} have one time ({:.3} s; their other time is {:.3} s), so nothing shows which joints belong to which image; give joints with times in a CSV with --joints",
                times.times.len(),
                times.what,
                seconds(if clock == Clock::Header { stamp } else { log }),
                seconds(if clock == Clock::Header { log } else { stamp })
            ),
        });
    }
    for image in images.iter().filter(|times| !times.times.is_empty()) {
        for joint in joints.iter().filter(|times| !times.times.is_empty()) {
            if choice == ClockChoice::Automatic && clock == Clock::Header {
                same_clock(image, joint)?;
            }
            overlap(image, joint, clock)?;
        }
    }
    Ok(clock)
}

/// Against the recorder's clock, which saw both.
fn same_clock(image: &Times, joint: &Times) -> Result<(), ImportError> {
    if !image.has_log || !joint.has_log || image.times.len() < 3 || joint.times.len() < 3 {
        return Ok(());
    }
    let ((of_image, image_spread), (of_joint, joint_spread)) = (image.offset(), joint.offset());
    let gap_s = of_image - of_joint;
    if gap_s.abs() <= SAME_CLOCK_S || image_spread.max(joint_spread) > 0.5 * gap_s.abs() {
        return Ok(());
    }
    Err(ImportError::Clocks {
        problem: format!(
            "the stamps of {} are {:.3} s {} those of {} when both are compared with the times of recording: camera and robot stamp with different clocks. {CLOCK_ADVICE}",
            image.what,
            gap_s.abs(),
            if gap_s < 0.0 { "behind" } else { "ahead of" },
            joint.what
        ),
    })
}

const CLOCK_ADVICE: &str = "Import with the times of recording (--clock log), or set both to one clock (NTP, use_sim_time) and record anew; --clock header insists on the stamps";

fn overlap(image: &Times, joint: &Times, clock: Clock) -> Result<(), ImportError> {
    let ((a, b), (c, d)) = (image.range(clock), joint.range(clock));
    let gap = if b < c { c - b } else { a - d };
    if gap <= (SAME_CLOCK_S * 1e9) as Stamp {
        return Ok(());
    }
    let logs_meet = {
        let ((a, b), (c, d)) = (image.range(Clock::Log), joint.range(Clock::Log));
        a <= d && c <= b
    };
    let advice = match (joint.has_log, image.has_log && clock == Clock::Header && logs_meet) {
        (false, _) => "say what is to be added to the times of the joints with --joint-offset-s".to_owned(),
        (true, true) => CLOCK_ADVICE.to_owned(),
        (true, false) => "the two were not recorded together".to_owned(),
    };
    let problem = format!(
        "{} (from {:.3} to {:.3} s) and {} (from {:.3} to {:.3} s) have no time in common: between them is a gap of {:.3} s, and the first image is {:.3} s {} the first joint values. {advice}",
        image.what,
        seconds(a),
        seconds(b),
        joint.what,
        seconds(c),
        seconds(d),
        seconds(gap),
        seconds((a - c).abs()),
        if a < c { "before" } else { "after" }
    );
    Err(ImportError::Clocks { problem })
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Stamp = 1_000_000_000;

    fn times(stamp: impl Fn(Stamp) -> Stamp) -> Times {
        let times = (0..100).map(|k| (stamp(k * S / 10 + 50 * S), k * S / 10 + 50 * S)).collect();
        Times { what: "the images".to_owned(), times, has_log: true }
    }

    fn chosen(image: &Times, joint: &Times) -> Result<Clock, String> {
        let (image, joint) = (std::slice::from_ref(image), std::slice::from_ref(joint));
        choose_clock(image, joint, ClockChoice::Automatic, &mut vec![]).map_err(|error| error.to_string())
    }

    #[test]
    fn stamps_that_do_not_change_are_noticed() {
        let good = times(|t| t - S / 100);
        assert_eq!(chosen(&good, &good), Ok(Clock::Header));
        for frozen in
            [times(|_| 0), times(|_| 77 * S), times(|t| if t == 50 * S { 3 * S } else { 7 }), times(|t| t / 1000)]
        {
            assert_eq!(chosen(&good, &frozen), Ok(Clock::Log));
            assert_eq!(chosen(&frozen, &good), Ok(Clock::Log));
        }
        let dead = Times { times: vec![(0, 5); 20], ..good.clone() };
        assert!(chosen(&dead, &good).unwrap_err().contains("all 20 messages"));
        // A simulation at a tenth of real time.
        let slow = times(|t| t / 10);
        assert_eq!(chosen(&slow, &slow), Ok(Clock::Header));
    }

    #[test]
    fn clocks_that_differ_are_named_with_their_gap() {
        let good = times(|t| t);
        for (offset_s, word) in
            [(-700.0, "behind"), (3.0, "ahead"), (-1.5, "behind"), (1.7e9, "ahead"), (-9.0, "behind")]
        {
            let other = times(|t| t + (offset_s * 1e9) as Stamp);
            let message = chosen(&other, &good).unwrap_err();
            assert!(message.contains(&format!("{:.3} s", f64::abs(offset_s))) && message.contains(word), "{message}");
        }
        assert_eq!(chosen(&times(|t| t - S / 2), &good), Ok(Clock::Header), "half a second is a slow network");
    }

    #[test]
    fn a_stamp_that_is_far_off_is_put_where_it_was_recorded() {
        let stray = times(|t| if t % S == 0 { 0 } else { t - S / 4 });
        let repair = stray.repair().unwrap();
        assert_eq!((repair(0, 60 * S), repair(70 * S, 70 * S)), (60 * S - S / 4, 70 * S));
        assert!(times(|t| t).repair().is_none());
    }
}
