// SPDX-License-Identifier: MIT OR Apache-2.0

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tautline_rt::CoreSet;

use crate::{Result, exit, write, write_json};

/// What most benches are told.
#[derive(Clone, Debug, Parser)]
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

/// What a bench is told whose tables are in the documents.
#[derive(Clone, Debug, Parser)]
pub struct Documented {
    #[command(flatten)]
    pub run: Run,
    /// Write the tables of the documents to FILE
    #[arg(long, value_name = "FILE")]
    pub markdown: Option<PathBuf>,
}

impl Documented {
    /// Writes the numbers and the tables if it was told to.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, numbers: &(impl Serialize + ?Sized), tables: impl FnOnce() -> String) -> Result {
        self.run.write(numbers)?;
        self.markdown.as_ref().map_or(Ok(()), |path| write(path, &tables()))
    }
}

/// The whole program of a bench that is told nothing else than a [`Run`], or what is [`Documented`]; `about` is the first line of its help.
pub fn program<T: Parser>(name: &'static str, about: &'static str, measure: fn(&T) -> Result) -> ExitCode {
    let told = T::command().name(name).about(about).get_matches();
    exit(name, measure(&T::from_arg_matches(&told).unwrap_or_else(|error| error.exit())))
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
