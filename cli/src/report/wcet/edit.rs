// SPDX-License-Identifier: MIT OR Apache-2.0
//! Changes a value of the system file and leaves the rest unchanged.

use toml_edit::{Decor, DocumentMut, Item, TableLike, Value};

/// The beginning of the comment with a value's source; the comment is replaced together with the value.
pub const SOURCE: &str = "measured";

/// The text with this `wcet` of a callback, in quotes, and a comment with its source.
///
/// # Errors
/// The file has no such value; the error is a sentence.
pub fn with(text: &str, callback: &str, wcet: &str, source: &str) -> Result<String, String> {
    let mut document: DocumentMut = text.parse().map_err(|error| format!("{error}"))?;
    let missing = || format!("`callbacks.{callback}.wcet` is not found in it");
    let callbacks = document.get_mut("callbacks").ok_or_else(missing)?;
    let is_in_line = callbacks.is_value();
    let table = callbacks.as_table_like_mut().ok_or_else(missing)?;
    let of_callback = table.get_mut(callback).ok_or_else(missing)?;
    let holder = of_callback.is_value();
    let value = of_callback.as_table_like_mut().and_then(value).ok_or_else(missing)?;
    let before = std::mem::take(value.decor_mut());
    *value = wcet.parse::<Value>().map_err(|error| format!("{error}"))?;
    *value.decor_mut() = before;
    match (is_in_line, holder) {
        // A comment cannot stand within `{ }`.
        (true, _) => {}
        (false, true) => {
            of_callback.as_value_mut().into_iter().for_each(|table| comment(table.decor_mut(), source))
        }
        (false, false) => comment(value.decor_mut(), source),
    }
    Ok(document.to_string())
}

fn value(callback: &mut dyn TableLike) -> Option<&mut Value> {
    callback.get_mut("wcet").and_then(Item::as_value_mut)
}

/// Adds the source to the value's comment, or replaces it there; the user's own comment stays.
fn comment(decor: &mut Decor, source: &str) {
    let before = decor.suffix().and_then(|suffix| suffix.as_str()).unwrap_or_default();
    let theirs = before.split(SOURCE).next().unwrap_or_default().trim().trim_start_matches('#').trim();
    let theirs = theirs.trim_end_matches(';').trim_end();
    let separator = if theirs.is_empty() { "" } else { "; " };
    decor.set_suffix(format!(" # {theirs}{separator}{source}"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_but_the_value_and_its_source_changes() {
        let text = "# mine\n[callbacks.a]  # a\nwcet = \"1ms\"   # by hand\npriority = 5 # five\n\n[callbacks]\nb = { wcet = \"2ms\", topic = \"x\" }\n";
        let once = with(text, "a", "\"3ms\"", "measured 1: x").unwrap();
        let expected = text.replace("wcet = \"1ms\"   # by hand", "wcet = \"3ms\" # by hand; measured 1: x");
        assert_eq!(once, expected);
        let twice = with(&once, "a", "\"4ms\"", "measured 2: y").unwrap();
        assert_eq!(twice, expected.replace("3ms", "4ms").replace("measured 1: x", "measured 2: y"));
        let inline = with(text, "b", "\"3ms\"", "measured 1: x").unwrap();
        let expected = text
            .replace("wcet = \"2ms\", topic = \"x\" }", "wcet = \"3ms\", topic = \"x\" } # measured 1: x");
        assert_eq!(inline, expected);
        assert!(with(text, "c", "\"3ms\"", "").unwrap_err().contains("callbacks.c.wcet"));
    }
}
