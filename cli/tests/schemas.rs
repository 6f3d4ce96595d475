// SPDX-License-Identifier: MIT OR Apache-2.0
//! docs/schemas: a file for each verb that prints JSON, and what finds the difference between one and an output.

#[path = "support/schemas.rs"]
mod schemas;

use schemas::{accepts, folder};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

fn names(folder: &Path, ending: &str) -> BTreeSet<String> {
    let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter_map(|name| name.strip_suffix(ending).map(str::to_owned)).collect()
}

/// It has the option from the verbs beside it, and refuses it.
const REFUSES: &str = "taut-component-run";

/// Programs of their own, whose tests check what they print.
const PROGRAMS: [&str; 2] = ["bridge-ros", "gateway"];

#[test]
fn every_verb_that_prints_json_has_a_schema() {
    let pages = tempfile::tempdir().unwrap();
    let written = Command::new(env!("CARGO_BIN_EXE_taut")).arg("man").arg(pages.path()).output().unwrap();
    assert!(written.status.success(), "{written:?}");
    let verbs = names(pages.path(), ".1");
    // The page of several verbs has the options that they have in common.
    let is_one = |verb: &String| !verbs.iter().any(|other| other.starts_with(&format!("{verb}-")));
    let prints = |verb: &String| {
        let page = fs::read_to_string(pages.path().join(format!("{verb}.1"))).unwrap();
        page.contains("\\-\\-json")
    };
    let found = names(&folder(), ".json");
    let named = |verb: &&String| verb.strip_prefix("taut-").is_some_and(|name| found.contains(name));
    let expected = verbs.iter().filter(|verb| is_one(verb) && prints(verb) && *verb != REFUSES);
    assert_eq!(expected.filter(|verb| !named(verb)).collect::<Vec<_>>(), Vec::<&String>::new());
    let is_program = |verb: &&String| PROGRAMS.iter().any(|program| **verb == format!("taut-{program}"));
    let of_verbs = verbs.iter().filter(|verb| named(verb) && prints(verb) && !is_program(verb)).count();
    assert_eq!(of_verbs + PROGRAMS.len(), found.len(), "{found:?}");
    assert!(PROGRAMS.iter().all(|program| found.contains(*program)), "{found:?}");
    for name in &found {
        let path = folder().join(format!("{name}.json"));
        let schema: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        let verb = if PROGRAMS.contains(&&**name) { name.clone() } else { name.replace('-', " ") };
        let title = format!("taut {verb} --json");
        assert_eq!(schema["title"], title, "{}", path.display());
        assert_eq!(schema["$schema"], "https://json-schema.org/draft/2020-12/schema", "{}", path.display());
    }
}

#[test]
fn what_differs_from_a_schema_is_named() {
    let schema = json!({
        "type": "array",
        "items": {
            "type": "object", "required": ["a"],
            "properties": { "a": { "type": ["integer", "null"] }, "b": { "$ref": "#/$defs/b" } },
        },
        "$defs": { "b": { "additionalProperties": { "enum": ["x", "y"] } } },
    });
    assert_eq!(accepts(&schema, &json!([{ "a": 1 }, { "a": null, "b": { "of any name": "x" } }])), Ok(()));
    for (value, reason) in [
        (json!({ "a": 1 }), " is not as `type` says"),
        (json!([{ "b": {} }]), "/0 lacks \"a\""),
        (json!([{ "a": 1.5 }]), "/0/a is not as `type` says: 1.5"),
        (json!([{ "a": 1, "c": 2 }]), "/0/c is not in the schema"),
        (json!([{ "a": 1, "b": { "n": "z" } }]), "/0/b/n is not as `enum` says: \"z\""),
    ] {
        let said = accepts(&schema, &value).unwrap_err();
        assert!(said.starts_with(reason), "{said}");
    }
}

#[test]
fn the_demos_file_is_as_its_schema_says() {
    let folder = tempfile::tempdir().unwrap();
    let mut demo = Command::new(env!("CARGO_BIN_EXE_taut"));
    // Without priorities it may miss deadlines: what it writes is the same.
    let ended =
        demo.args(["demo", "--seconds", "1", "--no-rt", "--json", "demo.json"]).current_dir(&folder).output();
    let ended = ended.unwrap();
    let written =
        fs::read(folder.path().join("demo.json")).unwrap_or_else(|error| panic!("{error}: {ended:?}"));
    schemas::check_as("demo", &written);
}
