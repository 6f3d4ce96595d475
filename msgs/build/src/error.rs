// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fmt;
use std::path::PathBuf;

use tautline_gen::GenerateError;
use tautline_schema::SchemaError;

/// Why no code was generated. `Debug`, which is what cargo shows of a `build.rs` that fails, is the message as
/// well.
#[derive(thiserror::Error)]
pub enum Error {
    /// A definition is missing or not valid; with file, line and column.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// No code can be written.
    #[error(transparent)]
    Generate(#[from] GenerateError),
    /// A folder has no definitions.
    #[error("{folder} has no definitions: it needs to be a package (msg/*.msg, srv/*.srv, action/*.action) or to hold packages", folder = folder.display())]
    Empty {
        /// The folder.
        folder: PathBuf,
    },
    /// A package that was asked for is not there.
    #[error("no folder has package {package}: there are {found}")]
    Missing {
        /// The package.
        package: String,
        /// Those that there are.
        found: String,
    },
    /// A `package.xml` does not say how the package is called.
    #[error("{path} has no <name> that a package can have", path = path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
    },
    /// A file cannot be read or written.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// This is not run by cargo.
    #[error("{variable} is not set: call this from build.rs, or name the file with `Builder::file`")]
    NotCargo {
        /// What cargo sets.
        variable: &'static str,
    },
}

impl fmt::Debug for Error {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{self}")
    }
}
