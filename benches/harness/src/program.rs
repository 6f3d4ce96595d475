// SPDX-License-Identifier: MIT OR Apache-2.0
//! What every bench's program does.

use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use tautline_rt::CoreSet;

use crate::Result;

/// Says why a program failed.
pub fn exit(name: &str, result: std::result::Result<(), impl Display>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{name}: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Set by Ctrl-C and SIGTERM, so that children are killed and files removed; the second one ends the program at once.
pub fn interrupted() -> Result<Arc<AtomicBool>> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register_conditional_shutdown(signal, 130, interrupted.clone())?;
        signal_hook::flag::register(signal, interrupted.clone())?;
    }
    Ok(interrupted)
}

/// Two different cores: those that were named with `--cores`, else the first two allowed.
pub fn two_cores(named: Option<&[usize]>) -> Result<[usize; 2]> {
    let chosen = match named {
        Some(named) => named.to_vec(),
        None => CoreSet::allowed()?.iter().take(2).collect(),
    };
    match chosen[..] {
        [one, other] if one != other => Ok([one, other]),
        _ if named.is_some() => Err(format!("--cores takes two different cores, not {chosen:?}").into()),
        _ => Err(format!("two cores are needed, this process may use {chosen:?}").into()),
    }
}

/// A bar for so many steps.
pub fn progress_bar(steps: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} of about {duration}  {msg}")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(steps).with_style(style)
}

pub fn write(path: &Path, text: &str) -> Result {
    std::fs::write(path, text).map_err(|error| format!("cannot write {}: {error}", path.display()).into())
}

/// Writes the numbers of a run.
pub fn write_json(path: &Path, numbers: &(impl Serialize + ?Sized)) -> Result {
    write(path, &(serde_json::to_string_pretty(numbers)? + "\n"))
}

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
