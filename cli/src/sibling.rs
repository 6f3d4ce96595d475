// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verbs that run separate programs, so that only their users build what these programs need.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

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

/// A separate program, and the command that builds it.
pub struct Sibling {
    pub program: &'static str,
    pub build: &'static str,
}

impl Sibling {
    /// Replaces this process by the program, from the folder of this program or from PATH. Returns only if that fails.
    pub fn become_it(&self, arguments: &[OsString]) -> SiblingError {
        let program = self.path();
        let source = Command::new(&program).args(arguments).exec();
        self.error(program, source)
    }

    /// The program's path: in the folder of this program if it exists there, otherwise its name, for PATH.
    pub fn path(&self) -> PathBuf {
        let beside = std::env::current_exe().unwrap_or_default().with_file_name(self.program);
        if beside.is_file() { beside } else { self.program.into() }
    }

    /// The error for a program that could not be started.
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
