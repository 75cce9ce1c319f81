//! The configuration, and how to repeat the run.

use crate::RunResult;
use crate::html::escaped;
use crate::page::Section;
use serde_json::Value;

pub(crate) fn section(run: &RunResult) -> Section {
    let configuration = run.summary.get("configuration").unwrap_or(&Value::Null);
    // Values made of numbers, strings and maps with string keys cannot fail.
    let json = serde_json::to_string_pretty(configuration).unwrap_or_default();
    let dataset = run.data.as_ref().map_or("DATASET", |data| data.dataset.as_str());
    let command = if run.summary.get("map").is_some_and(|map| !map.is_null()) { "run" } else { "calibrate" };
    let html = format!(
        "<p>The same data set, the same configuration and the same version of the program give the same rig.toml, byte for byte, on any number of threads \
         (RESULT is the folder of this report; the data set's path is as the run named it):</p>\n\
         <pre tabindex=\"0\"><code>skclam {command} {} --config <span id=\"result-folder\">RESULT</span>/summary.json --out again/</code></pre>\n\
         <p>The page itself is built again from the result folder by <code>skclam report DIR</code>.</p>\n\
         <details><summary>Configuration in force</summary><pre tabindex=\"0\"><code>{}</code></pre></details>\n",
        escaped(&shell_word(dataset)),
        escaped(&json)
    );
    Section { id: "reproduce", title: "Configuration and how to reproduce", html, charts: Vec::new() }
}

/// A word that a POSIX shell takes as it is.
fn shell_word(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./+:,=@%".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_folders_survive_the_shell() {
        assert_eq!(shell_word("data/cell-1"), "data/cell-1");
        assert_eq!(shell_word("my cell"), "'my cell'");
        assert_eq!(shell_word("it's; rm"), r"'it'\''s; rm'");
    }
}
