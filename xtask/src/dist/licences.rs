// SPDX-License-Identifier: MIT OR Apache-2.0
//! The licence texts of what a program contains of others, which are to be passed on with it: from the packages that cargo has unpacked.

use crate::steps::{cargo, json_of};
use crate::{files, machine};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// Files of a package that are meant for those who pass it on.
const NAMES: [&str; 5] = ["LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE"];

/// The texts of everything that these packages of a workspace link on a target, each once, after the packages that have it.
pub fn of(manifest: &str, packages: &[&str], target: &str) -> Result<String, String> {
    let mut metadata = cargo("metadata --format-version 1 --locked --manifest-path");
    metadata.arg(machine::root().join(manifest)).args(["--filter-platform", target]);
    let metadata = json_of(&mut metadata)?;
    let names: Vec<_> = array(&metadata["packages"]).filter_map(|package| package["name"].as_str()).collect();
    if let Some(unknown) = packages.iter().find(|package| !names.contains(package)) {
        return Err(format!("{manifest} has no package {unknown}"));
    }
    let mut texts = BTreeMap::<String, Vec<String>>::new();
    for package in linked(&metadata, packages) {
        let word = |key: &str| package[key].as_str().unwrap_or_default();
        let name = format!("{} {} ({})", word("name"), word("version"), word("license"));
        let folder = Path::new(word("manifest_path")).with_file_name("");
        let mut found = texts_in(&folder).map_err(files::at(&folder))?;
        if found.is_empty() {
            // It names its licence alone.
            found.insert(format!("No text is in the package: see {}\n", word("repository")));
        }
        found.into_iter().for_each(|text| texts.entry(text).or_default().push(name.clone()));
    }
    let mut parts: Vec<_> = texts.into_iter().map(|(text, names)| (names, text)).collect();
    parts.sort();
    let line = "=".repeat(80);
    let part =
        |(names, text): &(Vec<String>, String)| format!("\n{line}\n{}\n{line}\n\n{text}", names.join("\n"));
    let head = "Parts of others in the programs of this package, with their licences.\n";
    Ok(head.to_owned() + &parts.iter().map(part).collect::<String>())
}

/// Packages of others that are linked with these, in the order of their names.
fn linked<'m>(metadata: &'m Value, packages: &[&str]) -> Vec<&'m Value> {
    let nodes: BTreeMap<&str, &Value> =
        array(&metadata["resolve"]["nodes"]).filter_map(|node| Some((node["id"].as_str()?, node))).collect();
    let is_begin = |package: &&Value| {
        package["source"].is_null() && packages.iter().any(|name| package["name"] == *name)
    };
    let mut open: Vec<_> =
        array(&metadata["packages"]).filter(is_begin).filter_map(|package| package["id"].as_str()).collect();
    let mut found = BTreeSet::from_iter(open.iter().copied());
    while let Some(id) = open.pop() {
        let Some(node) = nodes.get(id) else { continue };
        // Not what builds or tests it.
        let is_linked = |of: &&Value| array(&of["dep_kinds"]).any(|kind| kind["kind"].is_null());
        let needs = array(&node["deps"]).filter(is_linked).filter_map(|of| of["pkg"].as_str());
        open.extend(needs.filter(|id| found.insert(id)));
    }
    let is_others = |package: &&Value| {
        !package["source"].is_null() && package["id"].as_str().is_some_and(|id| found.contains(id))
    };
    array(&metadata["packages"]).filter(is_others).collect()
}

fn array(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

fn texts_in(folder: &Path) -> std::io::Result<BTreeSet<String>> {
    let mut texts = BTreeSet::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().to_uppercase();
        if NAMES.iter().any(|begin| name.starts_with(begin)) && entry.file_type()?.is_file() {
            texts.insert(String::from_utf8_lossy(&fs::read(entry.path())?).replace("\r\n", "\n"));
        }
    }
    Ok(texts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_linked_is_named_with_its_text() {
        let text = of("Cargo.toml", &["tautline-rt"], "aarch64-unknown-linux-gnu").unwrap();
        assert!(text.contains("\nrustix 1.") && text.contains("Permission is hereby granted"), "{text}");
        // It is a tool of tests.
        assert!(!text.contains("\nloom 0."));
        assert!(of("Cargo.toml", &["none"], "aarch64-unknown-linux-gnu").is_err());
    }
}
