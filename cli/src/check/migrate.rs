// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut check --migrate`: a system file of an earlier version becomes one of the current version. Comments and order stay.
use std::path::Path;

use tautline_analysis::file::version::{CURRENT, refusal};
use toml_edit::{DocumentMut, Item, Value};

/// Changes a file from one version to the next. Returns a sentence for each change.
type Step = fn(&mut DocumentMut) -> Vec<String>;

/// The steps in order; the first one leads from version 1 to 2.
const STEPS: [Step; CURRENT as usize - 1] = [];

/// The result of a migration.
pub struct Migration {
    /// The version that the file stated; `None` if it stated none.
    from: Option<i64>,
    text: String,
    changes: Vec<String>,
}

impl Migration {
    /// Migrates the file at `path`, which is replaced if its text changes.
    ///
    /// # Errors
    /// A sentence without the path.
    pub fn of_file(path: &Path) -> Result<Self, String> {
        let text = std::fs::read_to_string(path).map_err(|error| format!("it cannot be read: {error}"))?;
        let migration = Self::new(&text, &STEPS)?;
        if migration.text != text {
            let replaced = crate::replace::replace(path, &migration.text);
            replaced.map_err(|error| format!("it cannot be written: {error}"))?;
        }
        Ok(migration)
    }

    /// Migrates a text to the version that these steps lead to.
    fn new(text: &str, steps: &[Step]) -> Result<Self, String> {
        let mut document: DocumentMut = text.parse().map_err(|error| format!("it is not TOML: {error}"))?;
        let from = match document.get("version").map(Item::as_integer) {
            Some(None) => return Err("its `version` is not a whole number".to_owned()),
            from => from.flatten(),
        };
        let (first, current) = (from.unwrap_or(1), steps.len() as i64 + 1);
        if let Some(refusal) = refusal(first, current).filter(|_| !(1..current).contains(&first)) {
            return Err(refusal);
        }
        let steps = &steps[first as usize - 1..];
        let mut changes: Vec<_> = steps.iter().flat_map(|step| step(&mut document)).collect();
        let text = match document.get_mut("version").and_then(Item::as_value_mut) {
            Some(_) if from == Some(current) => {
                return Ok(Migration { from, text: text.to_owned(), changes });
            }
            Some(value) => {
                let decor = value.decor().clone();
                *value = Value::from(current);
                *value.decor_mut() = decor;
                document.to_string()
            }
            None => stated(&document.to_string(), current),
        };
        changes.push(format!("`version = {current}` is stated"));
        Ok(Migration { from, text, changes })
    }

    /// The result as JSON.
    pub fn to_json(&self, path: &Path) -> serde_json::Value {
        let Migration { from, changes, .. } = self;
        serde_json::json!({ "file": path.display().to_string(), "from": from, "to": CURRENT, "changes": changes })
    }

    /// The result for people.
    pub fn to_text(&self, path: &Path) -> String {
        let path = path.display();
        if self.changes.is_empty() {
            return format!("{path} is of version {CURRENT} already: nothing is changed");
        }
        let from =
            self.from.map_or_else(|| "a file without a version".to_owned(), |from| format!("version {from}"));
        let changes = self.changes.iter().map(|change| format!("\n  {change}"));
        format!("{path}: from {from} to version {CURRENT}{}", changes.collect::<String>())
    }
}

/// The text with a `version` below its leading comment. No table begins before this place, so the key belongs to the whole file.
fn stated(text: &str, version: i64) -> String {
    let lines = text.split_inclusive('\n').take_while(|line| line.starts_with('#'));
    let head = lines.map(str::len).sum();
    let (head, rest) = text.split_at(head);
    let (before, after) =
        (if head.is_empty() { "" } else { "\n" }, if rest.starts_with('\n') { "" } else { "\n" });
    format!("{head}{before}version = {version}\n{after}{rest}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As if version 2 called `wcet` otherwise.
    fn rename(document: &mut DocumentMut) -> Vec<String> {
        let callbacks = document["callbacks"].as_table_mut().unwrap();
        let mut changes = Vec::new();
        for (name, callback) in callbacks.iter_mut() {
            let table = callback.as_table_like_mut().unwrap();
            if let Some(value) = table.remove("wcet") {
                table.insert("execution_time", value);
                changes.push(format!("`callbacks.{name}.wcet` is now `execution_time`"));
            }
        }
        changes
    }

    const OLD: &str = "#:schema x\n# The robot.\n\n[hosts.robot]  # one\ncores = 2\n\n[callbacks.a]\nwcet = \"1ms\" # measured\n";

    #[test]
    fn each_step_says_what_it_changes_and_the_rest_stays() {
        let migration = Migration::new(OLD, &[rename]).unwrap();
        let expected = OLD.replace("wcet", "execution_time").replace("robot.\n", "robot.\n\nversion = 2\n");
        assert_eq!(migration.text, expected);
        let changes = ["`callbacks.a.wcet` is now `execution_time`", "`version = 2` is stated"];
        assert_eq!((migration.from, &*migration.changes), (None, &changes.map(str::to_owned)[..]));

        let stated = OLD.replace("robot.\n", "robot.\n\nversion = 1 # ours\n");
        let migration = Migration::new(&stated, &[rename]).unwrap();
        assert_eq!(migration.text, expected.replace("version = 2\n", "version = 2 # ours\n"));
        assert_eq!(migration.from, Some(1));
        // Again there is nothing to do.
        let again = Migration::new(&migration.text, &[rename]).unwrap();
        assert_eq!((again.text, again.changes.len()), (migration.text, 0));
    }

    #[test]
    fn the_version_is_stated_where_it_is_the_files() {
        assert_eq!(stated("[hosts.h]\n", 1), "version = 1\n\n[hosts.h]\n");
        assert_eq!(stated("# a\n[hosts.h]\n", 1), "# a\n\nversion = 1\n\n[hosts.h]\n");
        assert_eq!(stated("# a\n\n# b\n[hosts.h]\n", 1), "# a\n\nversion = 1\n\n# b\n[hosts.h]\n");
        assert_eq!(stated("", 1), "version = 1\n\n");
    }
}
