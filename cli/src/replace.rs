// SPDX-License-Identifier: MIT OR Apache-2.0
//! Files of the user's that a verb rewrites.

use std::path::Path;
use std::{fs, io};

/// Replaces the file atomically and keeps its permissions.
pub fn replace(path: &Path, text: &str) -> io::Result<()> {
    // Follows a symbolic link, so that its target is replaced.
    let path = fs::canonicalize(path)?;
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    fs::write(&partial, text)?;
    fs::set_permissions(&partial, fs::metadata(&path)?.permissions())?;
    fs::rename(&partial, &path)
}
