// SPDX-License-Identifier: MIT OR Apache-2.0
//! What verbs print with `--json` beside docs/schemas: a test that sees such output fails if it has a field that its schema does not list, lacks one, or
//! has a value of another type.
#![allow(dead_code, reason = "no test uses all of it")]

use serde_json::Value;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Where the schemas are, for tests of any crate.
pub fn folder() -> PathBuf {
    let mut folders =
        Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|folder| folder.join("docs/schemas"));
    folders.find(|folder| folder.is_dir()).unwrap()
}

/// A `taut` that is run to its end.
pub trait Checked {
    /// As `output`, which it checks.
    fn checked(&mut self) -> Output;
}

impl Checked for Command {
    #[track_caller]
    fn checked(&mut self) -> Output {
        let output = self.output().unwrap();
        check(self.get_args(), &output.stdout);
        output
    }
}

/// The exit code of a `taut`, what it printed, and its words.
pub fn ended(output: Output) -> (i32, String, String) {
    let [out, errors] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    (output.status.code().unwrap(), out, errors)
}

/// Checks what `taut` has printed, if these arguments ask for JSON.
#[track_caller]
pub fn check<'a>(args: impl Iterator<Item = &'a OsStr>, out: &[u8]) {
    let words: Vec<_> = args.map(OsStr::to_string_lossy).collect();
    if !words.iter().any(|word| word == "--json") {
        return;
    }
    let named = |count: usize| Some(folder().join(words.get(..count)?.join("-") + ".json"));
    let path = [2, 1].into_iter().filter_map(named).find(|path| path.is_file());
    let path = path.unwrap_or_else(|| panic!("no file of docs/schemas is for {words:?}"));
    check_as(&path.file_stem().unwrap().to_string_lossy(), out);
}

/// Checks what this verb has printed, such as `topic-list`.
#[track_caller]
pub fn check_as(verb: &str, out: &[u8]) {
    for value in serde_json::Deserializer::from_slice(out).into_iter::<Value>() {
        let value = value.unwrap_or_else(|error| panic!("{verb}: {error}"));
        compare(verb, &value).unwrap_or_else(|reason| panic!("{reason}"));
    }
}

/// What differs from the verb's schema, and in which value.
pub fn compare(verb: &str, value: &Value) -> Result<(), String> {
    let text = std::fs::read(folder().join(format!("{verb}.json"))).unwrap();
    let schema: Value = serde_json::from_slice(&text).unwrap();
    accepts(&schema, value).map_err(|reason| format!("{verb}: {reason}\n{value:#}"))
}

/// Whether a schema accepts a value; if not, the first reason.
pub fn accepts(schema: &Value, value: &Value) -> Result<(), String> {
    Schema { root: schema }.accepts(schema, value, "")
}

/// The part of JSON Schema (2020-12) that the files use.
struct Schema<'s> {
    root: &'s Value,
}

impl Schema<'_> {
    fn accepts(&self, schema: &Value, value: &Value, at: &str) -> Result<(), String> {
        let fields = || value.as_object().into_iter().flatten();
        let listed = |name: &str| schema["properties"].get(name);
        for (key, rule) in schema.as_object().into_iter().flatten() {
            let rules = || rule.as_array().into_iter().flatten();
            match &**key {
                "$schema" | "$id" | "$defs" | "title" | "description" => {}
                "$ref" => {
                    let pointer =
                        rule.as_str().and_then(|rule| rule.strip_prefix('#')).expect("within the file");
                    self.accepts(self.root.pointer(pointer).expect(pointer), value, at)?;
                }
                "type" if rules().chain(rule.is_string().then_some(rule)).any(|rule| is_of(value, rule)) => {}
                "enum" if rules().any(|one| one == value) => {}
                "anyOf" if rules().any(|one| self.accepts(one, value, at).is_ok()) => {}
                "required" => match rules().find(|name| value.get(name.as_str().unwrap()).is_none()) {
                    Some(name) if value.is_object() => return Err(format!("{at} lacks {name}")),
                    _ => {}
                },
                "properties" => {
                    for (name, value) in fields() {
                        match listed(name) {
                            Some(schema) => self.accepts(schema, value, &format!("{at}/{name}"))?,
                            None if schema.get("additionalProperties").is_some() => {}
                            None => return Err(format!("{at}/{name} is not in the schema")),
                        }
                    }
                }
                "additionalProperties" => {
                    for (name, value) in fields().filter(|(name, _)| listed(name).is_none()) {
                        self.accepts(rule, value, &format!("{at}/{name}"))?;
                    }
                }
                "items" => {
                    for (index, value) in value.as_array().into_iter().flatten().enumerate() {
                        self.accepts(rule, value, &format!("{at}/{index}"))?;
                    }
                }
                "type" | "enum" | "anyOf" => return Err(format!("{at} is not as `{key}` says: {value}")),
                other => panic!("{other} is not checked: write the schema without it"),
            }
        }
        Ok(())
    }
}

fn is_of(value: &Value, rule: &Value) -> bool {
    match rule.as_str().expect("the name of a type") {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("{other} is no type"),
    }
}
