// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verbs that run separate programs, so that only their users build what these programs need.

use crate::verb::{Failure, Outcome};
use clap::Args;
use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use tautline_rt::host::with_former_open_files;

/// A program that is built from a folder of this repository, and that every installable package with `taut` contains.
macro_rules! packaged {
    ($program:literal, $package:literal, $folder:literal) => {
        Sibling {
            program: $program,
            build: concat!(
                "if taut was installed from a package, reinstall that (`pip install --force-reinstall taut`, `apt reinstall tautline`); \
                 otherwise build it with `cargo build --release -p ",
                $package,
                "`, or install it with `cargo install --locked --path ",
                $folder,
                "`"
            ),
        }
    };
}

/// Records, plays and processes bags. It links their formats and compression.
pub const BAG: Sibling = packaged!("taut-bag", "taut-bag", "cli/bag");

/// Shows the present state of a domain. It links the terminal library.
pub const TOP: Sibling = packaged!("taut-top", "taut-top", "cli/top");

/// Selects messages. It links the implementation of jq's language.
pub const FILTER: Sibling = packaged!("taut-filter", "taut-filter", "cli/filter");

/// Carries topics to other hosts. It links Zenoh.
pub const GATEWAY: Sibling = packaged!("taut-gateway", "tautline-gateway", "transport/zenoh");

/// The programs that have verbs of `taut`, with these verbs: for completions and manual pages.
pub const WITH_VERBS: [(&Sibling, &[&str]); 2] = [(&BAG, &["record", "play", "bag"]), (&TOP, &["top"])];

/// The arguments that are passed to another program, including `--help`.
#[derive(Args, Clone, Debug)]
#[command(disable_help_flag = true, disable_version_flag = true)]
pub struct PassedOn {
    /// Options: `--help` lists them
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "OPTIONS")]
    arguments: Vec<OsString>,
}

/// A separate program, and the command that builds it.
pub struct Sibling {
    /// The file's name.
    pub program: &'static str,
    /// How to build it, as part of a sentence.
    pub build: &'static str,
}

impl Sibling {
    /// Replaces this process by the program with these arguments. Does not return if the program was started.
    ///
    /// # Errors
    /// The program could not be started.
    pub fn run(&self, verb: &[&str], passed_on: &PassedOn) -> Outcome<ExitCode> {
        let arguments: Vec<_> = verb.iter().map(OsString::from).chain(passed_on.arguments.clone()).collect();
        Err(self.become_it(&arguments))
    }

    /// Replaces this process by the program, from the folder of this program or from PATH. Returns only if that fails.
    pub fn become_it(&self, arguments: &[OsString]) -> Failure {
        let program = self.path();
        let source = with_former_open_files(Command::new(&program).args(arguments)).exec();
        self.error(&program, &source)
    }

    /// The program's path: in the folder of this program if it exists there, otherwise its name, for PATH.
    pub fn path(&self) -> PathBuf {
        let beside = std::env::current_exe().unwrap_or_default().with_file_name(self.program);
        if beside.is_file() { beside } else { self.program.into() }
    }

    /// The error for a program that could not be started.
    pub fn error(&self, path: &Path, source: &io::Error) -> Failure {
        let Sibling { program, build } = self;
        let here = std::env::current_exe().unwrap_or_default();
        Failure::unusable(match source.kind() {
            io::ErrorKind::NotFound => {
                format!("{program} is not there: neither beside {} nor in PATH; {build}", here.display())
            }
            _ => format!("{} cannot be run: {source}", path.display()),
        })
    }
}
