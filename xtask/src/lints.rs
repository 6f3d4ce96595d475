// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clippy's findings, with the tests' build: clippy's compiler builds this workspace's packages. `cargo clippy` would check all that they depend
//! on beside building it, which takes as long as half of the tests' build.

use crate::machine;
use crate::steps::{self, Outcome, announce, ended};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Result};
use std::os::unix::fs::symlink;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::LazyLock;

/// `cargo` with these arguments, which build some of this workspace for tests.
pub fn cargo(arguments: &str) -> Command {
    let mut command = steps::cargo_with(arguments, wrapper().into_iter().flatten());
    // More arguments for the compiler, by clippy's way to give them. Optimising the parts of an optimised crate for each other takes a third of its
    // build's time; in cargo's profile, what macros and programs both need would be built anew by each command.
    command.env("CLIPPY_ARGS", "-Clto=off__CLIPPY_HACKERY__");
    command
}

/// Builds targets of packages, and shows what compiler and clippy find. A finding fails the step, but not what needs the build; says whether there
/// is one. Cargo repeats the findings in what it does not build again.
pub fn build(steps: &mut steps::Steps, name: &str, targets: &str) -> bool {
    let mut command = cargo(&format!("build {targets} --message-format=json"));
    // If it is not chosen, what is there is taken.
    let mut is_built = true;
    steps.step(name, || {
        let (found, outcome) = match findings(&mut command) {
            Ok(both) => both,
            Err(error) => (0, Outcome::Failed(format!("cannot be started: {error}"))),
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
    let mut found = BTreeSet::new();
    for line in child.stdout.take().into_iter().flat_map(|output| BufReader::new(output).lines()) {
        let Some(finding) = finding(&line?) else { continue };
        // A library's tests have what the library has.
        if found.insert(finding.clone()) {
            eprintln!("{finding}");
        }
    }
    Ok((found.len(), ended(child.wait())))
}

/// An error or a warning as compilers show it, but not how many there are.
fn finding(line: &str) -> Option<String> {
    let message = serde_json::from_str::<Value>(line).ok()?["message"].take();
    let text = message["message"].as_str()?;
    let is_count = text.starts_with("aborting due to") || text.ends_with(" emitted");
    (!is_count).then(|| message["rendered"].as_str().unwrap_or(text).to_owned())
}

/// By which cargo has clippy's compiler build this workspace, if it is there. By a link of its own: `cargo clippy` gives it other arguments, and
/// what both built under one path each would build anew for the other.
fn wrapper() -> Option<[String; 2]> {
    static DRIVER: LazyLock<Option<PathBuf>> = LazyLock::new(|| {
        let sysroot = Command::new("rustc").args(["--print", "sysroot"]).output().ok()?;
        let driver = PathBuf::from(String::from_utf8_lossy(&sysroot.stdout).trim()).join("bin/clippy-driver");
        let link = machine::target_dir().join("clippy-of-tests");
        if driver.is_file() && fs::read_link(&link).ok().as_ref() != Some(&driver) {
            let _ = fs::remove_file(&link);
            symlink(&driver, &link).ok()?;
        }
        link.is_file().then_some(link)
    });
    // No variable, for tests that build something would have it, too.
    let setting = |driver: &PathBuf| format!("build.rustc-workspace-wrapper='{}'", driver.display());
    DRIVER.as_ref().map(|driver| ["--config".to_owned(), setting(driver)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn findings_are_what_compilers_say_but_not_their_counts() {
        let line = |text: &str| {
            let message =
                serde_json::json!({"message": text, "rendered": format!("shown: {text}"), "spans": []});
            finding(&serde_json::json!({"reason": "compiler-message", "message": message}).to_string())
        };
        assert_eq!(line("unused variable: `b`").as_deref(), Some("shown: unused variable: `b`"));
        assert_eq!(line("linking with `cc` failed").as_deref(), Some("shown: linking with `cc` failed"));
        assert_eq!(line("2 warnings emitted"), None);
        assert_eq!(line("aborting due to 1 previous error"), None);
        assert_eq!(finding(r#"{"reason":"build-finished","success":true}"#), None);
        assert_eq!(finding("what a build script prints"), None);
    }
}
