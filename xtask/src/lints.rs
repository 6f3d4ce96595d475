// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clippy's findings, with the tests' build: clippy's compiler builds this workspace's packages. `cargo clippy` would check all that they depend
//! on beside building it, which takes as long as half of the tests' build.

use crate::steps::{self, Outcome, announce, ended};
use serde_json::Value;
use std::io::{BufRead, BufReader, Result};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::LazyLock;

/// `cargo` with these arguments, which build some of this workspace for tests.
pub fn cargo(arguments: &str) -> Command {
    steps::cargo_with(arguments, wrapper().into_iter().flatten())
}

/// Builds, and shows what compiler and clippy find. A finding fails the step, but not what needs the build; says whether there is one. Cargo
/// repeats the findings in what it does not build again.
pub fn build(steps: &mut steps::Steps, name: &str, packages: &str) -> bool {
    let mut command = cargo(&format!("build {packages} --all-targets --message-format=json"));
    let mut is_built = false;
    steps.step(name, || {
        let (found, outcome) = match findings(&mut command) {
            Ok(both) => both,
            Err(error) => return Outcome::Failed(format!("cannot be started: {error}")),
        };
        is_built = matches!(outcome, Outcome::Ok);
        match outcome {
            Outcome::Ok if found != 0 => Outcome::Failed(format!("{found} warnings")),
            Outcome::Ok if wrapper().is_none() => {
                Outcome::Failed("built, but there is no clippy: `rustup component add clippy`".to_owned())
                    .unless_ci()
            }
            other => other,
        }
    });
    is_built
}

/// Runs a build that prints JSON; shows and counts what it says of the code.
fn findings(command: &mut Command) -> Result<(usize, Outcome)> {
    announce(command);
    let mut child = command.stdout(Stdio::piped()).spawn()?;
    let mut found = 0;
    for line in child.stdout.take().into_iter().flat_map(|output| BufReader::new(output).lines()) {
        let Some(finding) = finding(&line?) else { continue };
        eprintln!("{finding}");
        found += 1;
    }
    Ok((found, ended(child.wait())))
}

/// An error or a warning about a place in the code, as compilers show it.
fn finding(line: &str) -> Option<String> {
    let message = serde_json::from_str::<Value>(line).ok()?["message"].take();
    let is_somewhere = message["spans"].as_array().is_some_and(|spans| !spans.is_empty());
    is_somewhere.then(|| message["rendered"].as_str().unwrap_or_default().to_owned())
}

/// By which cargo has clippy's compiler build this workspace, if it is there.
fn wrapper() -> Option<[String; 2]> {
    static DRIVER: LazyLock<Option<PathBuf>> = LazyLock::new(|| {
        let sysroot = Command::new("rustc").args(["--print", "sysroot"]).output().ok()?;
        let driver = PathBuf::from(String::from_utf8_lossy(&sysroot.stdout).trim()).join("bin/clippy-driver");
        driver.is_file().then_some(driver)
    });
    // No variable, for tests that build something would have it, too.
    let setting = |driver: &PathBuf| format!("build.rustc-workspace-wrapper='{}'", driver.display());
    DRIVER.as_ref().map(|driver| ["--config".to_owned(), setting(driver)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_finding_is_about_a_place_in_the_code() {
        let message = |spans: &str| {
            format!(
                r#"{{"reason":"compiler-message","message":{{"rendered":"warning: unused","spans":{spans}}}}}"#
            )
        };
        assert_eq!(finding(&message("[{}]")).as_deref(), Some("warning: unused"));
        assert_eq!(finding(&message("[]")), None, "a summary");
        assert_eq!(finding(r#"{"reason":"build-finished","success":true}"#), None);
        assert_eq!(finding("what a build script prints"), None);
    }
}
