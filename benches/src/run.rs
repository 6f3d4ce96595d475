// SPDX-License-Identifier: MIT OR Apache-2.0

use std::path::PathBuf;

use serde::Serialize;
use tautline_rt::CoreSet;

use crate::{Result, write_json};

/// What most benches are told.
#[derive(Clone, Debug, clap::Args)]
pub struct Run {
    /// Fewer and shorter rounds
    #[arg(long)]
    pub quick: bool,
    /// Write the numbers to FILE as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

impl Run {
    /// Writes the numbers if it was told to.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, numbers: &(impl Serialize + ?Sized)) -> Result {
        self.json.as_ref().map_or(Ok(()), |path| write_json(path, numbers))
    }
}

/// The core that was named with `--core`, else the last one; one that this process may use.
///
/// # Errors
/// There is none, or it may not use that one.
pub fn one_core(named: Option<usize>) -> Result<usize> {
    let allowed = CoreSet::allowed()?;
    match named.or_else(|| allowed.iter().last()) {
        Some(core) if allowed.iter().any(|other| other == core) => Ok(core),
        Some(core) => Err(format!("core {core} is not among those this process may use: {allowed:?}").into()),
        None => Err("no core may be used".into()),
    }
}
