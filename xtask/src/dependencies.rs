// SPDX-License-Identifier: MIT OR Apache-2.0
//! What Tautline takes from others: its licences, sources, duplicates and vulnerabilities, by cargo-deny as `deny.toml` says; and that the oldest
//! compiler that Tautline names may build it.

use crate::steps::{Outcome, Steps, cargo, execute, json_of};
use crate::{machine, tools};
use serde_json::Value;
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
    let deny = || tools::program("cargo-deny");
    steps.step("dependencies: licences, sources, duplicates", || {
        Outcome::with(deny(), |deny| WORKSPACES.iter().try_for_each(|folder| comply(&deny, folder)))
    });
    steps.step("dependencies: advisories", || Outcome::with(deny(), |deny| advisories(&deny)));
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
        let mut command = Command::new("timeout");
        command.arg("120").arg(deny).args(["--config", "deny.toml"]).args(arguments);
        command.current_dir(machine::root()).env("GIT_TERMINAL_PROMPT", "0");
        command
    };
    let output = match run(&["fetch", "db"]).output() {
        Ok(output) if output.status.success() => {
            return execute(&mut run(&["--offline", "check", "advisories"])).into();
        }
        Ok(output) => output,
        Err(error) => return Outcome::Failed(error.to_string()),
    };
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no answer within two minutes");
    Outcome::Skipped(format!("RustSec's database cannot be fetched: {last}"))
}

/// Whether a compiler of the product's `rust-version` may build all packages of a workspace. Cargo says so itself only to those who have such a compiler.
fn builds_with_ours(folder: &str) -> Result<(), String> {
    let manifest = machine::root().join(folder).join("Cargo.toml");
    let mut command = cargo(
        "metadata --locked --all-features --format-version 1 --filter-platform x86_64-unknown-linux-gnu",
    );
    let metadata = json_of(command.arg("--manifest-path").arg(&manifest));
    let metadata = metadata.map_err(|reason| format!("{folder}: {reason}"))?;
    let faults = above(&metadata["packages"], env!("CARGO_PKG_RUST_VERSION"));
    if faults.is_empty() { Ok(()) } else { Err(format!("{}: {}", manifest.display(), faults.join("; "))) }
}

/// Packages of others that ask for a newer compiler than ours, and packages of ours that do not name it. Who names none is not known to ask for one.
fn above(packages: &Value, ours: &str) -> Vec<String> {
    let faults = packages.as_array().into_iter().flatten().filter_map(|package| {
        let [name, version, asked] =
            ["name", "version", "rust_version"].map(|field| package[field].as_str().unwrap_or_default());
        let is_fault =
            if package["source"].is_null() { asked != ours } else { numbers(asked) > numbers(ours) };
        is_fault.then(|| format!("{name} {version} has rust-version = \"{asked}\", ours is \"{ours}\""))
    });
    faults.collect()
}

/// Of a version, to compare.
fn numbers(version: &str) -> [u32; 3] {
    let mut numbers = version.split('.').map(|number| number.parse().unwrap_or(0));
    [(); 3].map(|()| numbers.next().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn who_needs_a_newer_compiler_is_named() {
        let ours = |name: &str, asked: Option<&str>| json!({"name": name, "version": "1.0.0", "rust_version": asked, "source": null});
        let theirs = |name: &str, asked: Option<&str>| json!({"name": name, "version": "1.0.0", "rust_version": asked, "source": "registry"});
        let packages = [
            ours("ours", Some("1.89")),
            ours("silent", None),
            ours("old", Some("1.80")),
            theirs("fits", Some("1.89.0")),
            theirs("older", Some("1.9")),
            theirs("unknown", None),
            theirs("new", Some("1.90")),
            theirs("newer", Some("1.100.1")),
        ];
        let faults = above(&json!(packages), "1.89");
        let named: Vec<_> = faults.iter().filter_map(|fault| fault.split(' ').next()).collect();
        assert_eq!(named, ["silent", "old", "new", "newer"]);
        assert_eq!(faults[2], "new 1.0.0 has rust-version = \"1.90\", ours is \"1.89\"");
    }
}
