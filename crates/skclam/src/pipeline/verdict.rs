//! The verdict of a run as a table of cases: numbers in, a status and one case out. Its words are made in
//! [`super::sentences`].

use super::{Cause, HeldOutSummary, RegisteredError};
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Rigs, UnobservableCause, UnobservableDirection};

/// What a result is good for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// Better than the nominal rig on postures that the fit did not see.
    Good,
    /// It may be better, but something was not measured, does not fit, or only a part of it helps.
    Caution,
    /// Keep the nominal rig.
    Bad,
}

/// The numbers that a verdict follows from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Median distance of a match to its epipolar line under the nominal rig and the calibrated one, px; `null` without
    /// matches.
    pub epipolar_px: Option<[f64; 2]>,
    /// RMS reprojection of the observations that fit, calibrated, px; `null` where the estimator has none.
    pub reprojection_px: Option<f64>,
    /// By how much residuals scatter more than their observations say, where that is more than features and corners
    /// ever do.
    pub contradiction: Option<f64>,
    /// RMS (or median) over held-out postures, px; `null` where nothing could be held out.
    pub held_out_px: Option<Rigs<f64>>,
    /// Position error of the camera over the recorded postures; `null` where the estimator gives no covariance.
    pub error: Option<RegisteredError>,
    /// Whether the folds of the held-out test could check the covariance.
    pub sigma_checked: bool,
    /// Whether the arm could be calibrated; with flange poses alone it cannot.
    pub arm: bool,
    /// Combinations of parameters that move the camera and that the postures do not determine, in words. The gauges of
    /// base and tool are not among them.
    pub undetermined: Vec<String>,
}

/// What was found, as one of few cases.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "case", rename_all = "snake_case")]
pub enum VerdictCase {
    /// The rig does not explain the images that it was fitted to.
    Unexplained {
        /// The likeliest cause, where one was found.
        cause: Option<Cause>,
        /// See [`Evidence::epipolar_px`].
        epipolar_px: Option<[f64; 2]>,
        /// See [`Evidence::reprojection_px`].
        reprojection_px: Option<f64>,
        /// See [`Evidence::contradiction`].
        contradiction: Option<f64>,
    },
    /// It is no better than the nominal rig where it was not fitted.
    NotBetter {
        /// Over held-out postures, px.
        held_out_px: Rigs<f64>,
    },
    /// Nothing was held out, and it is no better where it was fitted either.
    FitsNoBetter {
        /// See [`Evidence::epipolar_px`].
        epipolar_px: [f64; 2],
    },
    /// Nothing was held out.
    NotHeldOut {
        /// See [`Evidence::epipolar_px`].
        epipolar_px: Option<[f64; 2]>,
    },
    /// The nominal arm with a fitted mount predicts held-out postures as well.
    MountSuffices {
        /// Over held-out postures, px.
        held_out_px: Rigs<f64>,
    },
    /// Better where it was not fitted, but how far off it still is was not estimated.
    NoSigma {
        /// Over held-out postures, px.
        held_out_px: Rigs<f64>,
    },
    /// What is not known is larger than what was corrected.
    SigmaAboveChange {
        /// Position error of the camera.
        error: RegisteredError,
        /// See [`Evidence::undetermined`].
        undetermined: Vec<String>,
    },
    /// Better, with something that does not fit and has a name.
    BetterWithCause {
        /// What explains most.
        cause: Cause,
        /// Position error of the camera.
        error: RegisteredError,
    },
    /// Better, with too few arm positions to check the sigma.
    BetterUnchecked {
        /// Position error of the camera.
        error: RegisteredError,
        /// Over held-out postures, px.
        held_out_px: Rigs<f64>,
    },
    /// Better.
    Better {
        /// Position error of the camera.
        error: RegisteredError,
        /// Over held-out postures, px.
        held_out_px: Rigs<f64>,
    },
}

/// Observations that keep farther than this from where they should be are not explained by the rig, px: keypoints and
/// corners are found to a fraction of a pixel, and poor intrinsics add a pixel or so.
pub(super) const UNEXPLAINED_PX: f64 = 2.0;

impl Evidence {
    /// Of a calibration and of how it fares on held-out postures.
    pub fn of(
        calibration: &Calibration,
        held_out: Option<&HeldOutSummary>,
        error: Option<RegisteredError>,
        arm: bool,
    ) -> Self {
        let (before, after) = (&calibration.epipolar_before, &calibration.epipolar_after);
        let contradiction = calibration.warnings.iter().find_map(|warning| match warning {
            skclam_calibration::Warning::LargeResiduals { sigma } => Some(*sigma),
            _ => None,
        });
        Evidence {
            epipolar_px: (after.matches > 0).then_some([before.median_px, after.median_px]),
            reprojection_px: calibration.reprojection_after.map(|statistics| statistics.rms_px),
            contradiction,
            held_out_px: held_out.map(|held_out| held_out.metric_px),
            error,
            sigma_checked: held_out.is_some_and(|held_out| held_out.jackknife.is_some()),
            arm,
            undetermined: undetermined(calibration),
        }
    }

    /// Whether the rig does not even explain the postures that it was fitted to.
    pub fn is_unexplained(&self) -> bool {
        self.contradiction.is_some()
            || self.epipolar_px.is_some_and(|[_, after]| after > UNEXPLAINED_PX)
            || self.reprojection_px.is_some_and(|px| px > UNEXPLAINED_PX)
    }

    /// The first case of the table that applies. `cause`: what explains most of what does not fit.
    pub fn case(&self, cause: Option<&Cause>) -> VerdictCase {
        let gross = cause.is_some_and(|cause| cause.status() == Status::Bad);
        if self.is_unexplained() || gross {
            return VerdictCase::Unexplained {
                cause: cause.cloned(),
                epipolar_px: self.epipolar_px,
                reprojection_px: self.reprojection_px,
                contradiction: self.contradiction,
            };
        }
        let Some(held_out_px) = self.held_out_px else {
            return match self.epipolar_px {
                Some(epipolar_px) if epipolar_px[1] >= epipolar_px[0] => VerdictCase::FitsNoBetter { epipolar_px },
                epipolar_px => VerdictCase::NotHeldOut { epipolar_px },
            };
        };
        if held_out_px.calibrated >= held_out_px.nominal {
            return VerdictCase::NotBetter { held_out_px };
        }
        if self.arm && held_out_px.mount_only.is_some_and(|mount_only| mount_only <= held_out_px.calibrated) {
            return VerdictCase::MountSuffices { held_out_px };
        }
        let Some(error) = self.error else { return VerdictCase::NoSigma { held_out_px } };
        if error.sigma_mm > error.change_mm {
            return VerdictCase::SigmaAboveChange { error, undetermined: self.undetermined.clone() };
        }
        match cause {
            Some(cause) if cause.status() != Status::Good => {
                VerdictCase::BetterWithCause { cause: cause.clone(), error }
            }
            _ if !self.sigma_checked => VerdictCase::BetterUnchecked { error, held_out_px },
            _ => VerdictCase::Better { error, held_out_px },
        }
    }
}

fn undetermined(calibration: &Calibration) -> Vec<String> {
    let gauge = |cause| matches!(cause, UnobservableCause::BaseGauge | UnobservableCause::ToolGauge);
    let moves = |direction: &UnobservableDirection| direction.combination.iter().any(|(p, _)| p.moves_camera());
    let found = calibration.identifiability.iter().flat_map(|identifiability| &identifiability.unobservable);
    found.filter(|one| !gauge(one.cause) && moves(one)).map(|one| one.reason.clone()).collect()
}

impl VerdictCase {
    /// What it calls for.
    pub fn status(&self) -> Status {
        match self {
            VerdictCase::Unexplained { .. } | VerdictCase::NotBetter { .. } | VerdictCase::FitsNoBetter { .. } => {
                Status::Bad
            }
            // No alarm: it may well be right, but nobody can rely on it.
            VerdictCase::SigmaAboveChange { .. }
            | VerdictCase::NotHeldOut { .. }
            | VerdictCase::MountSuffices { .. }
            | VerdictCase::NoSigma { .. }
            | VerdictCase::BetterWithCause { .. }
            | VerdictCase::BetterUnchecked { .. } => Status::Caution,
            VerdictCase::Better { .. } => Status::Good,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::sentences::verdict_sentence;

    fn rigs(nominal: f64, mount_only: f64, calibrated: f64) -> Rigs<f64> {
        Rigs { nominal, mount_only: Some(mount_only), calibrated }
    }

    fn good() -> Evidence {
        let error =
            RegisteredError { change_mm: 4.0, sigma_mm: 0.3, ruler_sigma_mm: 0.1, nominal_mm: 4.01, base_fitted: true };
        Evidence {
            epipolar_px: Some([8.0, 0.2]),
            reprojection_px: Some(0.3),
            contradiction: None,
            held_out_px: Some(rigs(9.0, 5.0, 0.6)),
            error: Some(error),
            sigma_checked: true,
            undetermined: Vec::new(),
            arm: true,
        }
    }

    /// One row of the table: the numbers, what they call for, and what the sentence must and must not say.
    #[test]
    fn every_row_of_the_table() {
        use Status::{Bad, Caution, Good};
        let error = |change_mm: f64, sigma_mm: f64| {
            let nominal_mm = change_mm.hypot(sigma_mm);
            Some(RegisteredError { change_mm, sigma_mm, ruler_sigma_mm: 0.0, nominal_mm, base_fitted: true })
        };
        let cause = Cause::Beyond {
            what: crate::pipeline::Instrument::FocalLength,
            change: 9.0,
            tolerance: 2.0,
            unit: "px".to_owned(),
            chi_squared: 1e4,
        };
        type Row<'a> = (&'a str, Evidence, Option<&'a Cause>, Status, &'a str, &'a str);
        let rows: Vec<Row<'_>> = vec![
            ("clean", good(), None, Good, "fell from about 4.0 to about 0.30 mm", "NOT"),
            ("lines", Evidence { epipolar_px: Some([9.0, 2.5]), ..good() }, None, Bad, "DO NOT TRUST", "fell"),
            ("pixels", Evidence { reprojection_px: Some(6.0), ..good() }, None, Bad, "6.0 px", "fell"),
            ("contradiction", Evidence { contradiction: Some(7.0), ..good() }, None, Bad, "7.0 times", "fell"),
            ("named", Evidence { contradiction: Some(7.0), ..good() }, Some(&cause), Bad, "focal length", "fell"),
            (
                "not better",
                Evidence { held_out_px: Some(rigs(1.0, 1.0, 1.2)), ..good() },
                None,
                Bad,
                "NOT beat",
                "fell",
            ),
            ("as good", Evidence { held_out_px: Some(rigs(1.0, 2.0, 1.0)), ..good() }, None, Bad, "NOT beat", "fell"),
            ("mount", Evidence { held_out_px: Some(rigs(9.0, 0.5, 0.6)), ..good() }, None, Caution, "mount", "fell"),
            ("nothing held out", Evidence { held_out_px: None, ..good() }, None, Caution, "NOT checked", "fell"),
            (
                "fits no better",
                Evidence { held_out_px: None, epipolar_px: Some([0.2, 0.2]), ..good() },
                None,
                Bad,
                "NO better",
                "fell",
            ),
            (
                "board alone, nothing held out",
                Evidence { held_out_px: None, epipolar_px: None, ..good() },
                None,
                Caution,
                "NOT checked",
                "fell",
            ),
            ("no sigma", Evidence { error: None, ..good() }, None, Caution, "not estimated", "fell"),
            ("sigma above change", Evidence { error: error(0.3, 0.5), ..good() }, None, Caution, "Do not use", "fell"),
            (
                "not determined",
                Evidence { error: error(0.3, 0.5), undetermined: vec!["mount_z".to_owned()], ..good() },
                None,
                Caution,
                "no less than before",
                "fell",
            ),
            ("unchecked", Evidence { sigma_checked: false, ..good() }, None, Caution, "too few", "NOT"),
            ("cause", good(), Some(&cause), Caution, "focal length", "DO NOT"),
            (
                "no arm",
                Evidence { arm: false, held_out_px: Some(Rigs { mount_only: None, ..rigs(9.0, 0.0, 0.6) }), ..good() },
                None,
                Good,
                "fell",
                "mount suffices",
            ),
        ];
        for (name, evidence, cause, status, says, says_not) in rows {
            let case = evidence.case(cause);
            let sentence = verdict_sentence(&case);
            assert_eq!(case.status(), status, "{name}: {sentence}");
            assert!(sentence.contains(says), "{name}: {sentence}");
            assert!(!sentence.contains(says_not), "{name}: {sentence}");
        }
    }

    /// "fell" is said only where the error that remains is below the one that was there.
    #[test]
    fn a_rise_is_never_called_a_fall() {
        for (change_mm, sigma_mm) in [(1.0, 0.2), (0.4, 0.4001), (4.6, 40.0), (0.38, 0.71), (5.0, 4.99)] {
            let nominal_mm = f64::hypot(change_mm, sigma_mm);
            let error =
                Some(RegisteredError { change_mm, sigma_mm, ruler_sigma_mm: 0.0, nominal_mm, base_fitted: true });
            let sentence = verdict_sentence(&Evidence { error, ..good() }.case(None));
            assert_eq!(sentence.contains("fell"), sigma_mm < change_mm, "{sentence}");
        }
    }
}
