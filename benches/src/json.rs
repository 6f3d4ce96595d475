// SPDX-License-Identifier: MIT OR Apache-2.0

use std::fs;
use std::path::Path;

use serde::Serialize;

/// Writes the numbers of a run to `path`.
///
/// # Errors
///
/// If the file cannot be written.
pub fn write_json(path: &Path, numbers: &impl Serialize) -> Result<(), Box<dyn std::error::Error>> {
    let text = serde_json::to_string_pretty(numbers)?;
    fs::write(path, text + "\n").map_err(|error| format!("cannot write {}: {error}", path.display()).into())
}
