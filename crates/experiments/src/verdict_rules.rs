//! The four rules by which a row of `misspecification` is judged.

use crate::causes::Cause;
use crate::measured::{Measured, Status};
use serde::{Deserialize, Serialize};

/// How one row fared. `None`: the rule does not apply to this row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Verdict {
    /// No green where the true error exceeds twice the claim, or the nominal error.
    pub green_is_true: Option<bool>,
    /// What is claimed is at least half of the true error, unless the row is red.
    pub claim_is_honest: Option<bool>,
    /// The right cause is named first; rows that are not harmless alone.
    pub cause_is_named: Option<bool>,
    /// No red where the answer is within its claim.
    pub no_false_alarm: Option<bool>,
}

/// A claim covers an error up to so many times its size.
const COVERED: f64 = 2.0;

/// Whether an answer may be used as it is: its error is covered by its claim, and answer and claim are better than
/// nominal.
pub fn within_claim(measured: &Measured) -> bool {
    covered(measured)
        && measured.recorded.is_some_and(|recorded| {
            let nominal = recorded.nominal.mm;
            recorded.truth.mm < nominal && recorded.claimed.is_some_and(|claimed| claimed.mm < nominal)
        })
}

/// Whether the true error is covered by the claims: position and orientation after the base's gauge by the covariance,
/// and the position with the base frame fitted by the first sentence, which is about that.
fn covered(measured: &Measured) -> bool {
    let by_covariance = measured.recorded.is_some_and(|recorded| {
        let truth = recorded.truth;
        recorded.claimed.is_some_and(|claimed| truth.mm <= COVERED * claimed.mm && truth.deg <= COVERED * claimed.deg)
    });
    let sigma = measured.shown.sentence_sigma_mm;
    by_covariance && sigma.is_none_or(|sigma| measured.recorded.is_some_and(|r| r.aligned_mm <= COVERED * sigma))
}

/// Judges a row in which one of `expected` is wrong (empty: nothing that needs a name).
pub fn judge(measured: &Measured, expected: &[Cause]) -> Verdict {
    let status = measured.shown.status;
    let exceeds_claim = !covered(measured);
    let exceeds_nominal = measured.recorded.is_some_and(|recorded| recorded.truth.mm > recorded.nominal.mm);
    let red = matches!(status, Status::Red | Status::Refused);
    let within = within_claim(measured);
    // A fault that neither harms the answer nor alarms anybody needs no name.
    let harmless = expected.is_empty() || (within && !red);
    Verdict {
        green_is_true: (status == Status::Green).then_some(!exceeds_claim && !exceeds_nominal),
        claim_is_honest: (!red).then_some(!exceeds_claim),
        cause_is_named: (!harmless)
            .then(|| measured.shown.causes.first().is_some_and(|first| expected.contains(first))),
        no_false_alarm: within.then_some(!red),
    }
}

impl Verdict {
    /// What it failed in, for the table; "ok" where nothing.
    pub fn text(&self) -> String {
        let rules = [
            (self.green_is_true, "FALSE GREEN"),
            (self.claim_is_honest, "claim below half"),
            (self.cause_is_named, "cause not first"),
            (self.no_false_alarm, "FALSE ALARM"),
        ];
        let failed: Vec<&str> = rules.iter().filter(|(held, _)| *held == Some(false)).map(|(_, name)| *name).collect();
        if failed.is_empty() { "ok".to_owned() } else { failed.join(", ") }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::{Compared, Shown};
    use crate::true_poses::CameraError;

    fn row(status: Status, truth: f64, claimed: f64, nominal: f64, causes: &[Cause]) -> Measured {
        let at = |mm: f64| CameraError { mm, deg: mm / 10.0 };
        let compared =
            Compared { truth: at(truth), nominal: at(nominal), aligned_mm: truth, claimed: Some(at(claimed)) };
        let shown = Shown {
            status,
            sentence: String::new(),
            sentence_sigma_mm: None,
            camera_sigma_mm: None,
            statements: vec![],
            causes: causes.to_vec(),
            held_out: None,
        };
        Measured { recorded: Some(compared), workspace: None, shown, scale_error_percent: None, seconds: 0.0 }
    }

    #[test]
    fn every_rule_can_be_broken_and_kept() {
        use Cause::{FocalLength, Gears};
        let text = |measured: &Measured, expected: &[Cause]| judge(measured, expected).text();
        assert_eq!(text(&row(Status::Green, 0.1, 0.1, 4.0, &[]), &[]), "ok");
        assert_eq!(text(&row(Status::Green, 0.3, 0.1, 4.0, &[]), &[]), "FALSE GREEN, claim below half");
        assert_eq!(text(&row(Status::Green, 5.0, 4.0, 4.1, &[]), &[]), "FALSE GREEN");
        assert_eq!(text(&row(Status::Amber, 0.3, 0.1, 4.0, &[FocalLength]), &[FocalLength]), "claim below half");
        assert_eq!(
            text(&row(Status::Amber, 0.3, 0.1, 4.0, &[Gears]), &[FocalLength]),
            "claim below half, cause not first"
        );
        assert_eq!(text(&row(Status::Red, 9.0, 0.1, 4.0, &[FocalLength, Gears]), &[FocalLength]), "ok");
        assert_eq!(text(&row(Status::Red, 9.0, 0.1, 4.0, &[Gears, FocalLength]), &[FocalLength]), "cause not first");
        assert_eq!(text(&row(Status::Red, 0.1, 0.1, 4.0, &[]), &[]), "FALSE ALARM");
        // Honest but useless: red is right.
        assert_eq!(text(&row(Status::Red, 9.0, 9.0, 4.0, &[]), &[]), "ok");
        // A harmless fault needs no name.
        assert_eq!(text(&row(Status::Amber, 0.1, 0.1, 4.0, &[]), &[FocalLength]), "ok");
    }
}
