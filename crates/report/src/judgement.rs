//! The traffic light: whether the calibration can be trusted, and why.

use crate::RunResult;
use serde_json::Value;

/// Three answers; each has a word and a shape beside its colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Light {
    /// Use it.
    Green,
    /// Look at the reasons first.
    Amber,
    /// Do not use it.
    Red,
}

/// The light and what speaks for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Judgement {
    /// The worst that any reason calls for.
    pub light: Light,
    /// What was looked at, with what each calls for; worst first.
    pub reasons: Vec<(Light, String)>,
}

impl Light {
    /// What it says.
    pub fn word(self) -> &'static str {
        match self {
            Light::Green => "Use it",
            Light::Amber => "Check first",
            Light::Red => "Do not use it",
        }
    }

    /// Name of its style and of its picture.
    pub(crate) fn class(self) -> &'static str {
        match self {
            Light::Green => "green",
            Light::Amber => "amber",
            Light::Red => "red",
        }
    }
}

/// The judgement of a run, as its summary holds it.
pub fn judge(run: &RunResult) -> Judgement {
    let light = |grade: &str| match grade {
        "good" => Light::Green,
        "bad" => Light::Red,
        _ => Light::Amber,
    };
    let text = |reason: &Value, field: &str| reason[field].as_str().unwrap_or_default().to_owned();
    let reasons = run.list("/reasons").iter();
    let reasons = reasons.map(|reason| (light(&text(reason, "grade")), text(reason, "text"))).collect();
    Judgement { light: light(run.text("/grade")), reasons }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_light_is_the_summarys() {
        let of = |grade: &str| {
            let reasons = json!([{"grade": "caution", "text": "look"}, {"grade": "good", "text": "fine"}]);
            let summary = json!({ "grade": grade, "reasons": reasons });
            judge(&RunResult { name: "run".to_owned(), summary, data: None })
        };
        assert_eq!(of("caution").light, Light::Amber);
        assert_eq!((of("good").light, of("bad").light), (Light::Green, Light::Red));
        assert_eq!(of("bad").reasons, [(Light::Amber, "look".to_owned()), (Light::Green, "fine".to_owned())]);
    }
}
