//! The words of verdict, checks and causes: the one place where typed results become sentences.

use super::{Cause, Check, Instrument, RegisteredError, VerdictCase};
use skclam_calibration::{ErrorPattern, Rigs};

/// The verdict in one or two sentences that a person who is no expert understands.
pub fn verdict_sentence(case: &VerdictCase) -> String {
    match case {
        VerdictCase::Unexplained { cause, epipolar_px, reprojection_px, contradiction } => {
            let fits = match (contradiction, epipolar_px, reprojection_px) {
                (Some(factor), ..) => {
                    format!(
                        "even the observations that fit scatter {factor:.1} times more than features and corners do"
                    )
                }
                (None, Some([_, after]), _) if *after > super::verdict::UNEXPLAINED_PX => {
                    format!("matches keep {after:.1} px from their epipolar lines in the median")
                }
                (_, _, Some(px)) => format!("observations are {px:.1} px (RMS) from where the rig expects them"),
                (_, Some([_, after]), None) => format!("matches keep {after:.1} px from their epipolar lines"),
                _ => "the rig does not explain the images".to_owned(),
            };
            match cause {
                Some(cause) => {
                    format!("DO NOT TRUST this calibration: {fits}. The likeliest cause: {}.", cause_text(cause))
                }
                None => format!(
                    "DO NOT TRUST this calibration: {fits}. None of the usual causes explains it: see the list of them in the book (troubleshooting)."
                ),
            }
        }
        VerdictCase::NotBetter { held_out_px } => format!(
            "This calibration does NOT beat the nominal rig on held-out postures ({}). Keep the nominal rig.",
            held_out_text(held_out_px)
        ),
        VerdictCase::FitsNoBetter { epipolar_px: [before, after] } => format!(
            "The calibrated rig explains the images NO better than the nominal one: the median distance of a match to its epipolar line went from {before:.2} to \
             {after:.2} px. Keep the nominal rig."
        ),
        VerdictCase::NotHeldOut { epipolar_px } => {
            let fits = match epipolar_px {
                Some([before, after]) => format!(
                    "The calibrated rig explains the images better: the median distance of a match to its epipolar line went from {before:.2} to {after:.2} px."
                ),
                None => "The rig was fitted.".to_owned(),
            };
            format!("{fits} It was NOT checked on held-out postures.")
        }
        VerdictCase::MountSuffices { held_out_px } => format!(
            "The nominal arm with a corrected mount predicts held-out postures as well as the calibrated arm does ({}): what was found out about the arm is not worth using. The mount \
             alone was fitted in the same held-out test; `--free mount` gives it.",
            held_out_text(held_out_px)
        ),
        VerdictCase::NoSigma { held_out_px } => format!(
            "The calibrated rig is better on held-out postures ({}), but how far off the camera still is was not estimated.",
            held_out_text(held_out_px)
        ),
        VerdictCase::SigmaAboveChange { error, undetermined } if !undetermined.is_empty() => format!(
            "The camera's position stays uncertain by {} mm, no less than before (one sigma, over your postures{}): {}. What these images determine was corrected by {} mm. \
             Record postures that differ there, if the arm can take them, or measure it by other means.",
            short(error.sigma_mm),
            base_text(error),
            undetermined.join("; "),
            short(error.change_mm)
        ),
        VerdictCase::SigmaAboveChange { error, .. } => format!(
            "Do not use this calibration yet: it moves the camera by {} mm, and is itself uncertain by {} mm (one sigma, over your postures{}). More, \
             or more diverse, postures are needed.",
            short(error.change_mm),
            short(error.sigma_mm),
            base_text(error)
        ),
        VerdictCase::BetterWithCause { cause, error } => {
            format!("{} But something does not fit: {}.", improvement(error), cause_text(cause))
        }
        VerdictCase::BetterUnchecked { error, held_out_px } => format!(
            "{} On held-out postures: {}. There are too few arm positions to check that sigma on them.",
            improvement(error),
            held_out_text(held_out_px)
        ),
        VerdictCase::Better { error, held_out_px } => {
            format!("{} On held-out postures: {}.", improvement(error), held_out_text(held_out_px))
        }
    }
}

fn base_text(error: &RegisteredError) -> &'static str {
    if error.base_fitted { ", with the base frame fitted" } else { "" }
}

fn improvement(error: &RegisteredError) -> String {
    let ruler = match error.ruler_sigma_mm / error.sigma_mm {
        fraction if fraction > 0.7 => {
            format!(", most of it ({} mm) the tolerance of the scale", short(error.ruler_sigma_mm))
        }
        fraction if fraction > 0.2 => format!(", {} mm of it the tolerance of the scale", short(error.ruler_sigma_mm)),
        _ => String::new(),
    };
    format!(
        "The camera's position error over your postures fell from about {} to about {} mm (one sigma{}{ruler}).",
        short(error.nominal_mm),
        short(error.sigma_mm),
        base_text(error)
    )
}

fn held_out_text(px: &Rigs<f64>) -> String {
    let mount = px.mount_only.map(|px| format!(", mount alone {px:.2} px")).unwrap_or_default();
    format!("nominal {:.2} px{mount}, calibrated {:.2} px", px.nominal, px.calibrated)
}

/// A cause with its value, and where the rig or the recording says otherwise.
pub fn cause_text(cause: &Cause) -> String {
    match cause {
        Cause::Beyond { what, change, tolerance, unit, .. } => {
            let space = if unit.is_empty() || unit == "%" { "" } else { " " };
            format!(
                "{} is off by {}{space}{unit}, where {}{space}{unit} is usual",
                instrument_text(*what),
                signed(*change),
                plain(*tolerance)
            )
        }
        Cause::Ruler { what, scale_error_percent, sigma_percent, certain } => format!(
            "{} {} {} % (+- {} %) too {}, by the arm's nominal lengths",
            instrument_text(*what),
            if *certain { "is" } else { "seems" },
            plain(scale_error_percent.abs()),
            plain(*sigma_percent),
            if *scale_error_percent > 0.0 {
                "small: true lengths are larger"
            } else {
                "large: true lengths are smaller"
            }
        ),
        Cause::Pattern { pattern, posture, size, sigma, unit, .. } => {
            let from = posture.map(|index| format!(" from posture {index} on")).unwrap_or_default();
            let value = format!("{} {unit} (+- {})", signed(*size), plain(*sigma));
            match pattern {
                ErrorPattern::JointStep { joint, .. } => {
                    format!("joint {} is off by {value} more{from}: its encoder or its zero moved", joint + 1)
                }
                ErrorPattern::CameraSlip { translation_m, .. } => format!(
                    "the camera sits elsewhere on the flange{from}: turned by {} deg (+- {}), moved by {} mm",
                    plain(*size),
                    plain(*sigma),
                    plain(translation_m * 1e3)
                ),
                ErrorPattern::TimeOffset => {
                    format!("joints and images were taken {value} apart while the arm moved (time_offset)")
                }
                ErrorPattern::Transmission { joint, harmonic } => format!(
                    "joint {} has a transmission error of {} deg (+- {}) with {} a turn",
                    joint + 1,
                    plain(*size),
                    plain(*sigma),
                    if *harmonic == 1 { "one period" } else { "two periods" }
                ),
                ErrorPattern::Compliance { joint } => {
                    format!(
                        "joint {} gives way under the arm's weight by {value} of gravity torque arm (compliance)",
                        joint + 1
                    )
                }
            }
        }
        Cause::DepthNoise { depth_sigma_per_m2, tolerance_per_m } => format!(
            "depth readings scatter by {} mm at 1 m, where {} mm is much; look whether depth images and colour images belong together (same posture, color_from_depth)",
            plain(depth_sigma_per_m2 * 1e3),
            plain(tolerance_per_m * 1e3)
        ),
        Cause::Gross { finding } => super::describe(finding).trim_end_matches('.').to_owned(),
        Cause::DepthShift { shift } => super::describe_depth_shift(shift).trim_end_matches('.').to_owned(),
        Cause::FewPostures { positions, needed } => format!(
            "there are too few postures: {positions} arm positions, where {needed} or more are needed for what was freed"
        ),
        Cause::PostureNoise { sigma_deg, tolerance_deg } => format!(
            "joints are off by {} deg in every posture anew, where {} deg is much: were joints and images taken while the arm stood still?",
            plain(*sigma_deg),
            plain(*tolerance_deg)
        ),
    }
}

fn instrument_text(what: Instrument) -> &'static str {
    match what {
        Instrument::FocalLength => "the colour camera's focal length ([color] fx, fy)",
        Instrument::PrincipalPoint => "the colour camera's principal point ([color] cx, cy)",
        Instrument::Distortion => "the colour camera's distortion ([color] distortion)",
        Instrument::DepthScale => "the depth camera's scale ([depth] unit_mm)",
        Instrument::DepthOffset => {
            "the depth's offset, or the depth camera's place along its axis ([depth] color_from_depth, z)"
        }
        Instrument::Extrinsics => "the depth camera's place beside the colour camera ([depth] color_from_depth)",
        Instrument::BoardSquares => "the board's squares ([board] square_mm)",
        Instrument::Mount => "the mount ([mount])",
        Instrument::Arm => "the arm",
        Instrument::Clock => "the clock of the joints (time_offset)",
    }
}

/// A check of the result in words.
pub fn check_text(check: &Check) -> String {
    match check {
        Check::Verdict { case } => verdict_sentence(case),
        Check::Cause { cause } => {
            let mut text = cause_text(cause);
            if let Some(first) = text.get(..1).map(str::to_uppercase) {
                text.replace_range(..1, &first);
            }
            format!("{text}.")
        }
        Check::HeldOutBetter { .. } => "It holds on postures that it was not fitted to (held out).".to_owned(),
        Check::Systematic { held_out_px, fitted_px } => format!(
            "Held-out postures stay {held_out_px:.1} px off, fitted ones {fitted_px:.1} px: errors of single postures, or something that is not among the free parameters."
        ),
        Check::Outliers { fraction } => format!("{:.0} % of the observations do not fit.", fraction * 100.0),
        Check::DepthConsistency { nominal_mm, calibrated_mm } => {
            if calibrated_mm > nominal_mm {
                format!(
                    "The depth images are less consistent than before ({nominal_mm:.1} mm to {calibrated_mm:.1} mm, point to plane): matches and depth contradict each other."
                )
            } else {
                format!(
                    "The depth images are as consistent as before, or more ({nominal_mm:.1} mm to {calibrated_mm:.1} mm, point to plane)."
                )
            }
        }
        Check::SigmaWidened { claimed_mm, scattered_mm } => format!(
            "Fits without one group of arm positions scatter by {} mm where the noise alone would make {} mm; every sigma was widened to that.",
            short(*scattered_mm),
            short(*claimed_mm)
        ),
        Check::NotConverged => "The solver stopped at its limit of iterations before it converged.".to_owned(),
        Check::NotIdentifiable { combinations } => {
            let what =
                if *combinations == 1 { "combination of parameters is" } else { "combinations of parameters are" };
            format!("{combinations} {what} not identifiable from the data; see \u{201c}Identifiability\u{201d}.")
        }
        Check::FlangePosesOnly => "Only flange poses are known: the mount is calibrated, the arm is not.".to_owned(),
        Check::OutlierPostures { indices } => format!(
            "{} not fit the others and {} left out: {}.",
            if indices.len() == 1 { "One posture does" } else { "Some postures do" },
            if indices.len() == 1 { "was" } else { "were" },
            list(indices)
        ),
        Check::UnobservedPostures { indices } => format!(
            "{} no usable observation in common with the others: {}.",
            if indices.len() == 1 { "One posture has" } else { "Some postures have" },
            list(indices)
        ),
    }
}

fn list(indices: &[u64]) -> String {
    let shown: Vec<String> = indices.iter().take(12).map(u64::to_string).collect();
    let more = if indices.len() > shown.len() { " ..." } else { "" };
    format!("{}{more}", shown.join(", "))
}

/// Two digits that mean something.
pub(super) fn short(mm: f64) -> String {
    let decimals = if mm >= 10.0 {
        0
    } else if mm >= 1.0 {
        1
    } else if mm >= 0.1 {
        2
    } else {
        3
    };
    format!("{mm:.decimals$}")
}

/// Two significant digits, without an exponent.
fn plain(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return format!("{value}");
    }
    let decimals = (1 - value.abs().log10().floor() as i32).clamp(0, 9) as usize;
    format!("{value:.decimals$}")
}

fn signed(value: f64) -> String {
    format!("{}{}", if value < 0.0 { "-" } else { "+" }, plain(value.abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_as_short_as_they_are_known() {
        assert_eq!([12.34, 4.77, 0.456, 0.0468].map(short), ["12", "4.8", "0.46", "0.047"]);
        assert_eq!([0.00123, -4.56, 123.0].map(signed), ["+0.0012", "-4.6", "+123"]);
    }
}
