//! The few things that text needs on its way into HTML.

/// Text as HTML, also inside quoted attributes.
pub(crate) fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // What HTML has no place for, and what would make a line read as another.
            harmful if skclam_files::is_harmful(harmful) && harmful != '\n' && harmful != '\t' => {
                out.extend(harmful.escape_unicode())
            }
            other => out.push(other),
        }
    }
    out
}

/// JSON inside `<script>`: no `<`, so that nothing in a string can end the element or begin a comment.
pub(crate) fn script_json(value: &impl serde::Serialize) -> String {
    // Values made of numbers, strings and maps with string keys cannot fail.
    let json = serde_json::to_string(value).unwrap_or_else(|_| "null".to_owned());
    skclam_files::json_text(&json).replace('<', "\\u003c")
}

/// A table that scrolls by itself where the screen is narrow. `caption`, `head` and `rows` are HTML.
pub(crate) fn table(class: &str, caption: &str, head: &[&str], rows: &[Vec<String>]) -> String {
    // On a narrow screen each row of words becomes a block, and its cells say what they are.
    let labels: Vec<String> = match class {
        "words" => head.iter().map(|cell| format!(" data-label=\"{}\"", escaped(&without_tags(cell)))).collect(),
        _ => vec![String::new(); head.len()],
    };
    let head: String = head.iter().map(|cell| format!("<th scope=\"col\">{cell}</th>")).collect();
    let row = |cells: &Vec<String>| {
        let cells = cells.iter().enumerate().map(|(column, cell)| match column {
            0 => format!("<th scope=\"row\">{cell}</th>"),
            _ => format!("<td{}>{cell}</td>", labels.get(column).map_or("", String::as_str)),
        });
        format!("<tr>{}</tr>\n", cells.collect::<String>())
    };
    let body: String = rows.iter().map(row).collect();
    let label = escaped(&without_tags(caption));
    format!(
        "<div class=\"scroll\" role=\"region\" tabindex=\"0\" aria-label=\"Table: {label}\"><table class=\"{class}\">\n\
         <caption>{caption}</caption>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n"
    )
}

/// The text of a piece of our own HTML.
fn without_tags(html: &str) -> String {
    let mut out = String::new();
    let mut inside = false;
    for character in html.chars() {
        match character {
            '<' => inside = true,
            '>' => inside = false,
            _ if !inside => out.push(character),
            _ => {}
        }
    }
    out.replace("&nbsp;", " ").replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"").replace("&amp;", "&")
}

/// A bar in a table cell; `fraction` of its width, 0 to 1.
pub(crate) fn bar(fraction: f64, class: &str) -> String {
    let percent = 100.0 * fraction.clamp(0.0, 1.0);
    format!("<span class=\"bar {class}\" aria-hidden=\"true\"><span style=\"width:{percent:.1}%\"></span></span>")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_from_outside_becomes_markup() {
        assert_eq!(escaped("<b a=\"'&\u{1}"), "&lt;b a=&quot;&#39;&amp;\\u{1}");
        assert_eq!(escaped("\u{202e}a\u{2069}"), "\\u{202e}a\\u{2069}");
        let json = script_json(&"</script><!-- <script>");
        assert!(!json.contains('<'), "{json}");
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), "</script><!-- <script>");
    }

    #[test]
    fn labels_are_plain_text() {
        assert_eq!(without_tags("a <b>bold</b> &lt;name&gt;"), "a bold <name>");
    }
}
