//! Text that came from a file, made harmless for what shows it.
//!
//! Terminals obey control characters, marks of writing direction make a line read as another, and spreadsheets run
//! cells that begin like a formula.

use std::borrow::Cow;

/// Whether a character does more than to be seen: control characters, marks of writing direction (Unicode Annex 9),
/// separators of lines and paragraphs, tags, and what is no character (XML has no place for it).
pub fn is_harmful(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
        || matches!(c, '\u{feff}' | '\u{fffe}' | '\u{ffff}' | '\u{e0000}'..='\u{e007f}')
}

fn escaped(text: &str, is_escaped: impl Fn(char) -> bool, form: impl Fn(char, &mut String)) -> Cow<'_, str> {
    if !text.chars().any(&is_escaped) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_escaped(c) { form(c, &mut out) } else { out.push(c) }
    }
    Cow::Owned(out)
}

/// A name or a value as one harmless line: what is harmful appears as `\u{1b}`, ends of lines as `\n`.
pub fn shown(text: &str) -> Cow<'_, str> {
    escaped(text, is_harmful, |c, out| match c {
        '\n' | '\r' | '\t' => out.extend(c.escape_default()),
        c => out.extend(c.escape_unicode()),
    })
}

/// Whole lines for a terminal: as [`shown`], but ends of lines and tabs stay.
pub fn on_screen(text: &str) -> Cow<'_, str> {
    escaped(text, |c| is_harmful(c) && c != '\n' && c != '\t', |c, out| out.extend(c.escape_unicode()))
}

/// JSON that holds no harmful characters and means the same: within its strings they appear as `\u001b`.
pub fn json_text(json: &str) -> Cow<'_, str> {
    // Outside of strings JSON has no other controls than these.
    escaped(
        json,
        |c| is_harmful(c) && !matches!(c, '\n' | '\r' | '\t'),
        |c, out| {
            for unit in c.encode_utf16(&mut [0; 2]) {
                out.push_str(&format!("\\u{unit:04x}"));
            }
        },
    )
}

/// A cell of text in a CSV file: harmless on a screen, and no formula to a spreadsheet. Numbers stay what they are.
pub fn csv_cell(text: &str) -> Cow<'_, str> {
    match shown(text) {
        number if number.parse::<f64>().is_ok_and(f64::is_finite) => number,
        cell if cell.starts_with(['=', '+', '-', '@']) => Cow::Owned(format!("'{cell}")),
        cell => cell,
    }
}

/// At most so many characters, the middle left out where there are more.
pub fn shortened(text: &str, max_chars: usize) -> Cow<'_, str> {
    // No text has more characters than bytes, so that most need no counting.
    if text.len() <= max_chars || text.chars().count() <= max_chars {
        return Cow::Borrowed(text);
    }
    let (head, tail) = (max_chars * 2 / 3, max_chars / 3);
    let begin: String = text.chars().take(head).collect();
    let mut end: Vec<char> = text.chars().rev().take(tail).collect();
    end.reverse();
    Cow::Owned(format!("{begin} ... {}", end.into_iter().collect::<String>()))
}

#[cfg(test)]
mod tests {
    use super::*;

    const EVIL: &str = "\u{1b}[31m\u{9b}2J\u{202e}a\u{2066}\r\n\u{7f}\u{e0041}\u{e9}";

    #[test]
    fn nothing_harmful_is_left() {
        assert!(!shown(EVIL).chars().any(is_harmful), "{}", shown(EVIL));
        assert!(
            shown(EVIL).contains("\\u{1b}[31m") && shown(EVIL).contains("\\r\\n") && shown(EVIL).ends_with('\u{e9}')
        );
        assert_eq!(on_screen("a\tb\n\u{1b}"), "a\tb\n\\u{1b}");
        assert!(matches!(shown("plain \u{4e2d}"), Cow::Borrowed(_)));
    }

    #[test]
    fn json_means_the_same() {
        let json = serde_json::to_string_pretty(&serde_json::json!({ EVIL: [EVIL] })).unwrap();
        let harmless = json_text(&json);
        assert!(!harmless.chars().any(|c| is_harmful(c) && c != '\n'), "{harmless}");
        let back: serde_json::Value = serde_json::from_str(&harmless).unwrap();
        assert_eq!(back, serde_json::json!({ EVIL: [EVIL] }));
    }

    #[test]
    fn formulas_are_text() {
        assert_eq!(csv_cell("=1+1"), "'=1+1");
        assert_eq!(csv_cell("@SUM"), "'@SUM");
        assert_eq!(csv_cell("-2+3+cmd"), "'-2+3+cmd");
        for stays in ["theta_2", "-1.5e3", "+7", ""] {
            assert_eq!(csv_cell(stays), stays);
        }
        assert_eq!(csv_cell("\t=1"), "\\t=1");
    }

    #[test]
    fn long_text_keeps_both_ends() {
        let long = format!("a{}z", "\u{e9}".repeat(1000));
        let short = shortened(&long, 30);
        assert!(short.starts_with('a') && short.ends_with('z') && short.chars().count() < 40, "{short}");
        assert_eq!(shortened("abc", 3), "abc");
    }
}
