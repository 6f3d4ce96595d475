// SPDX-License-Identifier: MIT OR Apache-2.0
//! What benches are told, and those that need nothing else: what is not for this program to know is passed on.

use crate::build::Build;
use std::ffi::OsStr;
use std::path::PathBuf;
use std::process::Command;

// Without a text for users: it would stand in place of the bench's own.
#[derive(clap::Args, Clone, Default)]
pub struct Options {
    /// Fewer and shorter rounds
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    #[arg(skip)]
    pub build: Build,
    /// Passed on: see `-- --help`
    #[arg(last = true)]
    pub arguments: Vec<String>,
}

impl Options {
    /// Of a quick run of the tests' build.
    pub fn of_tests() -> Options {
        Options { quick: true, build: Build::Tests, ..Options::default() }
    }

    /// A bench of the package that most are in.
    pub fn command(&self, name: &str) -> Command {
        self.command_of("tautline-benches", name)
    }

    /// The domain's bench, in a package of its own.
    pub fn domain(&self) -> Command {
        self.command_of("tautline-bench-domain", "domain")
    }

    fn command_of(&self, package: &str, name: &str) -> Command {
        let mut command = self.build.program(package, name);
        self.pass_on(&mut command, &["--quick"]);
        command
    }

    /// Adds all to a bench which calls a quick run so.
    pub fn pass_on(&self, command: &mut Command, quick: &[&str]) {
        if self.quick {
            command.args(quick);
        }
        pass(command, "--json", self.json.as_ref());
        command.args(&self.arguments);
    }
}

/// Adds an option that was given.
pub fn pass(command: &mut Command, name: &str, value: Option<impl AsRef<OsStr>>) {
    if let Some(value) = value {
        command.arg(name).arg(value);
    }
}
