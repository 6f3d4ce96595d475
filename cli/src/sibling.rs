// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verbs that are programs of their own, so that nobody builds what they need who does not use them.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;
use tautline::rt::host::with_former_open_files;

/// Why another program was not started.
#[derive(Debug, thiserror::Error)]
pub enum SiblingError {
    #[error(
        "{program} is not built: neither beside {} nor in PATH; {build}", beside.display()
    )]
    Missing { program: &'static str, build: &'static str, beside: PathBuf },
    #[error("{} cannot be run: {source}", program.display())]
    Exec { program: PathBuf, source: std::io::Error },
}

/// A program, and how to build it.
pub struct Sibling {
    pub program: &'static str,
    pub build: &'static str,
}

impl Sibling {
    /// Becomes the program: the one beside this one, else the one in PATH. Does not return if it could be started.
    pub fn become_it(&self, arguments: &[OsString]) -> SiblingError {
        let program = self.path();
        let source = with_former_open_files(Command::new(&program).args(arguments)).exec();
        self.error(program, source)
    }

    /// Where it is: beside this program, else to be looked for in PATH.
    pub fn path(&self) -> PathBuf {
        let beside = std::env::current_exe().unwrap_or_default().with_file_name(self.program);
        if beside.is_file() { beside } else { self.program.into() }
    }

    /// Why it could not be started.
    pub fn error(&self, program: PathBuf, source: std::io::Error) -> SiblingError {
        match source.kind() {
            std::io::ErrorKind::NotFound => {
                let Sibling { program, build } = *self;
                SiblingError::Missing { program, build, beside: std::env::current_exe().unwrap_or_default() }
            }
            _ => SiblingError::Exec { program, source },
        }
    }
}
