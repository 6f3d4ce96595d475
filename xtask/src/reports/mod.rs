// SPDX-License-Identifier: MIT OR Apache-2.0
//! The JSON that scripts rely on: every promised field is there, with its type. No time is judged.

mod alks;
mod bridge;
mod compare;
mod demo;
mod domain;
mod paper;
mod reference;

use crate::steps::Outcome;
use serde_json::Value;
use std::path::Path;

pub use alks::check_lane;
pub use bridge::check_bridge;
pub use compare::check_compare;
pub use demo::{check_ablation, check_demo};
pub use domain::check_domain;
pub use paper::check_paper;
pub use reference::{check_reference, check_reference_beside};

/// A field's type.
enum Kind {
    Bool,
    Count,
    Number,
    Text,
    List,
}
use Kind::{Bool, Count, List, Number, Text};

/// Promised fields, by their type.
type Fields = &'static [(Kind, &'static str)];

const MESSAGES_ROW: Fields =
    &[(Text, "case implementation"), (Count, "bytes n"), (Number, "p50_us p99_us ratio_to_plain_buffer")];

/// The messages bench's rows.
pub fn check_messages(path: &Path) -> Outcome {
    check_rows(path, MESSAGES_ROW)
}

fn check_rows(path: &Path, fields: Fields) -> Outcome {
    judge(path, |report| {
        let rows = report.as_array().ok_or("it is not a list")?;
        if rows.is_empty() {
            return Err("it has no rows".to_owned());
        }
        rows.iter().try_for_each(|row| check_row(row, fields))
    })
}

fn judge(path: &Path, check: impl FnOnce(&Value) -> Result<(), String>) -> Outcome {
    let text = std::fs::read_to_string(path).map_err(|error| error.to_string());
    let report = text.and_then(|text| serde_json::from_str(&text).map_err(|error| error.to_string()));
    let checked = report.and_then(|report| check(&report));
    checked.map_err(|reason| format!("{}: {reason}", path.display())).into()
}

fn check_row(row: &Value, fields: Fields) -> Result<(), String> {
    check_fields(row, &row.to_string(), fields)?;
    if row["n"] == 0 { Err(format!("nothing was measured in {row}")) } else { Ok(()) }
}

fn check_fields(value: &Value, what: &str, fields: Fields) -> Result<(), String> {
    let all = fields.iter().flat_map(|(kind, names)| names.split(' ').map(move |name| (name, kind)));
    for (name, kind) in all {
        let field = value.get(name).ok_or_else(|| format!("{what} has no field '{name}'"))?;
        let (fits, wanted) = match kind {
            Bool => (field.is_boolean(), "true or false"),
            Count => (field.is_u64(), "a whole number"),
            Number => (field.is_number(), "a number"),
            Text => (field.is_string(), "a string"),
            List => (field.is_array(), "a list"),
        };
        if !fits {
            return Err(format!("'{name}' of {what} should be {wanted}, not {field}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// Why a report is refused; empty if it is not.
    pub fn refusal(check: impl FnOnce(&Path) -> Outcome, report: &Value) -> String {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(&file, report.to_string()).unwrap();
        check(file.path()).result().err().unwrap_or_default()
    }

    fn row() -> Value {
        json!({"case": "Image", "implementation": "plain buffer", "bytes": 64, "n": 9, "p50_us": 1.0, "p99_us": 2,
               "ratio_to_plain_buffer": 1.0})
    }

    #[test]
    fn what_is_missing_or_of_another_type_is_named() {
        assert_eq!(check_row(&row(), MESSAGES_ROW), Ok(()));
        let refused = |name: &str, value: Value| {
            let mut row = row();
            row[name] = value;
            check_row(&row, MESSAGES_ROW).unwrap_err()
        };
        assert!(refused("bytes", json!(-1)).starts_with("'bytes' of"));
        assert!(refused("p50_us", Value::Null).contains("should be a number, not null"));
        assert!(refused("n", json!(0)).starts_with("nothing was measured"));
        let mut row = row();
        row.as_object_mut().unwrap().remove("case");
        assert!(check_row(&row, MESSAGES_ROW).unwrap_err().ends_with("has no field 'case'"));
    }
}
