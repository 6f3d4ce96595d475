// SPDX-License-Identifier: MIT OR Apache-2.0
//! What Tautline takes from others: its licences, sources, duplicates and vulnerabilities, by cargo-deny as `deny.toml` says; and that the oldest
//! compiler that Tautline names may build it.

use crate::steps::{Outcome, Steps, cargo, execute};
use crate::{machine, tools};
use serde_json::Value;
use std::collections::{HashMap, HashSet};
use std::path::Path;
use std::process::Command;

/// All workspaces, the product's first. `dylib` has no lock file: it takes what the product has.
const WORKSPACES: [&str; 6] = ["", "benches", "bridge-ros", "node/r2r", "rmw", "transport/zenoh/peers"];

/// Whose duplicates are none of ours: hiroz brings a Zenoh of its own, with all transports.
const THEIRS: &str = "transport/zenoh/peers";

/// What `deny.toml` allows and the product does not need any more.
const STALE: &str =
    "-D unmatched-skip -D unnecessary-skip -D license-not-encountered -D license-exception-not-encountered";

/// Checks all workspaces.
pub fn test(steps: &mut Steps) {
    steps.step("dependencies: licences, sources, duplicates", || match tools::program("cargo-deny") {
        Ok(deny) => WORKSPACES.iter().try_for_each(|folder| comply(&deny, folder)).into(),
        Err(reason) => Outcome::Failed(reason).unless_ci(),
    });
    steps.step("dependencies: advisories", || match tools::program("cargo-deny") {
        Ok(deny) => advisories(&deny),
        Err(reason) => Outcome::Failed(reason).unless_ci(),
    });
    steps.step("dependencies: rust-version", || {
        WORKSPACES.iter().try_for_each(|folder| builds_with_ours(folder))
    });
}

/// Whether a workspace's crates are what `deny.toml` allows.
fn comply(deny: &Path, folder: &str) -> Result<(), String> {
    let mut command = Command::new(deny);
    command.current_dir(machine::root()).args(["--locked", "--config", "deny.toml", "--log-level", "error"]);
    command.arg("--manifest-path").arg(Path::new(folder).join("Cargo.toml")).arg("check");
    command.args((folder.is_empty()).then_some(STALE).into_iter().flat_map(|stale| stale.split(' ')));
    command.args(["licenses", "sources"]).args((folder != THEIRS).then_some("bans"));
    let folder = if folder.is_empty() { "the root" } else { folder };
    execute(&mut command).map_err(|reason| format!("{folder}: {reason}; deny.toml says what is allowed"))
}

/// Whether what the product takes has known vulnerabilities. Where the database cannot be had, that is said.
fn advisories(deny: &Path) -> Outcome {
    let run = |arguments: &[&str]| {
        let mut command = Command::new(deny);
        command.current_dir(machine::root()).args(["--config", "deny.toml"]).args(arguments);
        command
    };
    match run(&["fetch", "db"]).output() {
        Ok(output) if output.status.success() => {
            execute(&mut run(&["check", "--disable-fetch", "advisories"])).into()
        }
        Ok(output) => {
            let said = String::from_utf8_lossy(&output.stderr);
            let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("it says nothing");
            Outcome::Skipped(format!("RustSec's database cannot be fetched: {last}"))
        }
        Err(error) => Outcome::Failed(error.to_string()),
    }
}

/// Whether all packages of a workspace name the product's `rust-version`, and what those that are published are built with asks for none above it. Cargo
/// says so itself only to who has such a compiler.
fn builds_with_ours(folder: &str) -> Result<(), String> {
    let manifest = machine::root().join(folder).join("Cargo.toml");
    let mut command = cargo(
        "metadata --locked --all-features --format-version 1 --filter-platform x86_64-unknown-linux-gnu",
    );
    let output = command.arg("--manifest-path").arg(&manifest).output().map_err(|error| error.to_string())?;
    if !output.status.success() {
        return Err(format!("{folder}: {}", String::from_utf8_lossy(&output.stderr).trim()));
    }
    let metadata = serde_json::from_slice(&output.stdout).map_err(|error| error.to_string())?;
    let faults = above(&metadata, env!("CARGO_PKG_RUST_VERSION"));
    if faults.is_empty() { Ok(()) } else { Err(format!("{}: {}", manifest.display(), faults.join("; "))) }
}

/// What in cargo's metadata does not go with our `rust-version`.
fn above(metadata: &Value, ours: &str) -> Vec<String> {
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let by_id = |values: &Value| -> HashMap<String, Value> {
        list(values).into_iter().map(|value| (id(&value["id"]), value)).collect()
    };
    let (packages, nodes) = (by_id(&metadata["packages"]), by_id(&metadata["resolve"]["nodes"]));
    let (mut faults, mut open) = (Vec::new(), Vec::new());
    for member in list(&metadata["workspace_members"]).iter().map(id) {
        let package = &packages[&member];
        if package["rust_version"] != ours {
            faults.push(format!("{} does not say rust-version = \"{ours}\"", id(&package["name"])));
        }
        // `publish = false` is an empty list of registries.
        open.extend(package["publish"].is_null().then_some(member));
    }
    let mut seen: HashSet<String> = open.iter().cloned().collect();
    while let Some(package) = open.pop() {
        let asked = id(&packages[&package]["rust_version"]);
        if version(&asked) > version(ours) {
            let [name, number] = ["name", "version"].map(|field| id(&packages[&package][field]));
            faults.push(format!("{name} {number} asks for Rust {asked}"));
        }
        for dependency in list(&nodes[&package]["deps"]) {
            let is_dev = list(&dependency["dep_kinds"]).iter().all(|kind| kind["kind"] == "dev");
            if !is_dev && seen.insert(id(&dependency["pkg"])) {
                open.push(id(&dependency["pkg"]));
            }
        }
    }
    faults
}

fn id(value: &Value) -> String {
    value.as_str().unwrap_or_default().to_owned()
}

/// Its numbers, to compare.
fn version(text: &str) -> [u32; 3] {
    let mut numbers = text.split('.').map(|number| number.parse().unwrap_or(0));
    [(); 3].map(|()| numbers.next().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn what_needs_a_newer_compiler_is_named() {
        let package = |id: &str, rust_version: Option<&str>, publish: Value| json!({"id": id, "name": id, "version": "1.0.0", "rust_version": rust_version, "publish": publish});
        let needs = |pkg: &str, kind: Option<&str>| json!({"pkg": pkg, "dep_kinds": [{"kind": kind}]});
        let metadata = json!({
            "workspace_members": ["ours", "tests", "old"],
            "packages": [
                package("ours", Some("1.89"), Value::Null),
                package("tests", Some("1.89"), json!([])),
                package("old", Some("1.80"), json!([])),
                package("fits", Some("1.89.0"), Value::Null),
                package("silent", None, Value::Null),
                package("new", Some("1.90"), Value::Null),
                package("newer", Some("1.100.1"), Value::Null),
                package("of tests", Some("1.91"), Value::Null),
            ],
            "resolve": {"nodes": [
                {"id": "ours", "deps": [needs("fits", None), needs("silent", Some("build")), needs("of tests", Some("dev"))]},
                {"id": "tests", "deps": [needs("of tests", None)]},
                {"id": "silent", "deps": [needs("new", None), needs("newer", None)]},
                {"id": "fits", "deps": []}, {"id": "new", "deps": []}, {"id": "newer", "deps": []},
            ]},
        });
        let mut faults = above(&metadata, "1.89");
        faults.sort();
        assert_eq!(
            faults,
            [
                "new 1.0.0 asks for Rust 1.90",
                "newer 1.0.0 asks for Rust 1.100.1",
                "old does not say rust-version = \"1.89\""
            ]
        );
    }
}
