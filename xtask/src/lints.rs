// SPDX-License-Identifier: MIT OR Apache-2.0
//! Clippy's and rustdoc's findings, with the tests' build: this workspace's packages are built by clippy's compiler, and documented beside. `cargo
//! clippy` and `cargo doc` would check all that they depend on beside building it, which takes as long as half of the tests' build.

use crate::compiler;
use crate::steps::{self, Outcome, announce, ended};
use serde_json::Value;
use std::collections::BTreeSet;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// `cargo` with these arguments, which build some of this workspace for tests.
pub fn cargo(arguments: &str) -> Command {
    // No variable, for tests that build something would have it, too.
    let setting = |path: &PathBuf| format!("build.rustc-workspace-wrapper='{}'", path.display());
    let wrapper = compiler::path().map(|path| ["--config".to_owned(), setting(path)]);
    let mut command = steps::cargo_with(arguments, wrapper.into_iter().flatten());
    // More arguments for the compiler, by clippy's way to give them. Optimising the parts of an optimised crate for each other takes a third of its
    // build's time; in cargo's profile, what macros and programs both need would be built anew by each command.
    command.env("CLIPPY_ARGS", "-Clto=off__CLIPPY_HACKERY__");
    command
}

/// Builds targets of packages, and shows what compiler, clippy and rustdoc find. A finding fails the step, but not what needs the build; says whether
/// there is one. Cargo repeats the findings in what it does not build again.
pub fn build(steps: &mut steps::Steps, name: &str, targets: &str) -> bool {
    build_with(steps, name, targets, |command| command)
}

/// As [`build`], with variables of its own.
pub fn build_with(
    steps: &mut steps::Steps,
    name: &str,
    targets: &str,
    change: impl FnOnce(&mut Command) -> &mut Command,
) -> bool {
    // If it is not chosen, what is there is taken.
    let mut is_built = true;
    steps.step(name, || {
        let built = Built::by(change(&mut json(targets)));
        is_built = built.is_ok();
        match built {
            Ok(built) if !built.findings.is_empty() => {
                Outcome::Failed(format!("{} warnings", built.findings.len()))
            }
            Ok(_) if compiler::path().is_none() => Outcome::Failed(
                "built without clippy: `rustup component add clippy`, or see above".to_owned(),
            )
            .unless_ci(),
            built => built.map(drop).into(),
        }
    });
    is_built
}

/// The JSON that rustdoc made of each library of these targets, which are built for it.
pub fn documents(targets: &str) -> Result<Vec<PathBuf>, String> {
    Ok(Built::by(&mut json(targets))?.documents)
}

/// What can be run of a build that is there, or is made, by a command of [`json`]'s kind.
pub fn executables(command: &mut Command) -> Result<Vec<Executable>, String> {
    Ok(Built::by(command)?.executables)
}

/// A build that says in JSON what it makes and finds.
pub fn json(targets: &str) -> Command {
    cargo(&format!("build {targets} --message-format=json"))
}

/// A program, or a target's tests.
pub struct Executable {
    /// Of its package's `Cargo.toml`.
    pub folder: PathBuf,
    pub target: String,
    pub is_test: bool,
    pub path: PathBuf,
}

impl Executable {
    fn of(said: &Value) -> Option<Self> {
        Some(Executable {
            folder: Path::new(said["manifest_path"].as_str()?).parent()?.to_owned(),
            target: said["target"]["name"].as_str()?.to_owned(),
            is_test: said["profile"]["test"] == true,
            path: said["executable"].as_str()?.into(),
        })
    }
}

/// What such a build has said.
#[derive(Default)]
struct Built {
    /// What compilers say of the code, which has been shown. A library's tests have what the library has.
    findings: BTreeSet<String>,
    documents: Vec<PathBuf>,
    executables: Vec<Executable>,
}

impl Built {
    fn by(command: &mut Command) -> Result<Self, String> {
        announce(command);
        let say = |error: io::Error| format!("cannot be started: {error}");
        let mut child = command.stdout(Stdio::piped()).spawn().map_err(say)?;
        let mut built = Built::default();
        for line in child.stdout.take().into_iter().flat_map(|output| BufReader::new(output).lines()) {
            built.hear(&line.map_err(say)?);
        }
        ended(child.wait())?;
        Ok(built)
    }

    fn hear(&mut self, line: &str) {
        // Build scripts print something else.
        let Ok(mut said) = serde_json::from_str::<Value>(line) else { return };
        self.documents.extend(document(&said));
        self.executables.extend(Executable::of(&said));
        if let Some(finding) = finding(&said["message"].take())
            && self.findings.insert(finding.clone())
        {
            eprintln!("{finding}");
        }
    }
}

/// An error or a warning as compilers show it, but not how many there are.
fn finding(message: &Value) -> Option<String> {
    let text = message["message"].as_str()?;
    let is_count = text.starts_with("aborting due to") || text.ends_with(" emitted");
    (!is_count).then(|| message["rendered"].as_str().unwrap_or(text).to_owned())
}

/// What rustdoc made of a library that cargo tells of.
fn document(artifact: &Value) -> Option<PathBuf> {
    if artifact["reason"] != "compiler-artifact" || artifact["profile"]["test"] == true {
        return None;
    }
    let library = artifact["target"]["name"].as_str()?.replace('-', "_");
    let files = artifact["filenames"].as_array()?.iter().filter_map(Value::as_str);
    files.map(|file| compiler::document(Path::new(file), &library)).find(|document| document.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn findings_are_what_compilers_say_but_not_their_counts() {
        let said = |text: &str| {
            finding(&serde_json::json!({"message": text, "rendered": format!("shown: {text}"), "spans": []}))
        };
        assert_eq!(said("unused variable: `b`").as_deref(), Some("shown: unused variable: `b`"));
        assert_eq!(said("linking with `cc` failed").as_deref(), Some("shown: linking with `cc` failed"));
        assert_eq!(said("2 warnings emitted"), None);
        assert_eq!(said("aborting due to 1 previous error"), None);
        let mut built = Built::default();
        built.hear(r#"{"reason":"build-finished","success":true}"#);
        built.hear("what a build script prints");
        assert!(built.findings.is_empty() && built.documents.is_empty());
    }
}
