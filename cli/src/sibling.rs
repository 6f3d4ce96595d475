// SPDX-License-Identifier: MIT OR Apache-2.0
//! Verbs that are programs of their own, so that nobody builds what they need who does not use them.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

/// Why another program was not started.
#[derive(Debug, thiserror::Error)]
pub enum SiblingError {
    #[error(
        "{program} is not built: neither beside {} nor in PATH; build it with `cargo build --release -p {package}`, or install it with `cargo install --path {folder}`",
        beside.display()
    )]
    Missing { program: &'static str, package: &'static str, folder: &'static str, beside: PathBuf },
    #[error("{} cannot be run: {source}", program.display())]
    Exec { program: PathBuf, source: std::io::Error },
}

/// A program, and the package and folder that it is built from.
pub struct Sibling {
    pub program: &'static str,
    pub package: &'static str,
    pub folder: &'static str,
}

impl Sibling {
    /// Becomes the program: the one beside this one, else the one in PATH. Does not return if it could be started.
    pub fn become_it(&self, arguments: &[OsString]) -> SiblingError {
        let own = std::env::current_exe().unwrap_or_default();
        let beside = own.with_file_name(self.program);
        let program = if beside.is_file() { beside } else { self.program.into() };
        let source = Command::new(&program).args(arguments).exec();
        match source.kind() {
            std::io::ErrorKind::NotFound => {
                let Sibling { program, package, folder } = *self;
                SiblingError::Missing { program, package, folder, beside: own }
            }
            _ => SiblingError::Exec { program, source },
        }
    }
}
