//! The status: whether the calibration can be trusted, and why.

use crate::RunResult;
use serde_json::Value;

/// Three answers; each has a word and a shape beside its colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Status {
    /// Use it.
    Green,
    /// Look at the checks first.
    Amber,
    /// Do not use it.
    Red,
}

/// The status and its checks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Judgement {
    /// The worst that any check calls for.
    pub status: Status,
    /// What was looked at, with what each calls for; worst first.
    pub checks: Vec<(Status, String)>,
}

impl Status {
    /// What it says.
    pub fn word(self) -> &'static str {
        match self {
            Status::Green => "Use it",
            Status::Amber => "Check first",
            Status::Red => "Do not use it",
        }
    }

    /// Name of its style and of its icon.
    pub(crate) fn class(self) -> &'static str {
        match self {
            Status::Green => "green",
            Status::Amber => "amber",
            Status::Red => "red",
        }
    }
}

/// The judgement of a run, as its summary holds it.
pub fn judge(run: &RunResult) -> Judgement {
    let status = |status: &str| match status {
        "good" => Status::Green,
        "bad" => Status::Red,
        _ => Status::Amber,
    };
    let text = |check: &Value, field: &str| check[field].as_str().unwrap_or_default().to_owned();
    let checks = run.list("/checks").iter();
    let checks = checks.map(|check| (status(&text(check, "status")), text(check, "text"))).collect();
    Judgement { status: status(run.text("/status")), checks }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_light_is_the_summarys() {
        let of = |status: &str| {
            let checks = json!([{"status": "caution", "text": "look"}, {"status": "good", "text": "fine"}]);
            let summary = json!({ "status": status, "checks": checks });
            judge(&RunResult { name: "run".to_owned(), summary, data: None })
        };
        assert_eq!(of("caution").status, Status::Amber);
        assert_eq!((of("good").status, of("bad").status), (Status::Green, Status::Red));
        assert_eq!(of("bad").checks, [(Status::Amber, "look".to_owned()), (Status::Green, "fine".to_owned())]);
    }
}
