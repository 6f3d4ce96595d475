// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut check`: response times, queue capacities and chains of a system file, before anything runs.
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use crate::table::count;
use crate::verb::{Failure, Outcome};
use admit::Admitted;
pub use admit::this_host;
use clap::Args;
use migrate::Migration;
use tautline_analysis::file::{CheckedSystem, FileError, SystemFile};

mod admit;
mod gantt;
mod json;
mod migrate;
mod sensitivity;
mod table;

/// Checks that every callback and chain of a system file meets its deadline
///
/// Computes worst-case response times with overheads, queue capacities and end-to-end latencies from periods, execution
/// times and priorities. Exits with 0 if all deadlines are met, 1 if not, 2 if the file cannot be used; all errors of the
/// file are listed with line and column. With --admit the file is checked together with everything that runs in the domain, as when a
/// process starts with it; 1 then means that the process would be refused.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut check system.toml                      the table, the chains, the warnings
  taut check system.toml --sensitivity        how much each execution time may grow
  taut check system.toml --svg timeline.svg   which job runs when after the critical instant
  taut check system.toml --admit              together with everything that runs in the domain
  taut check system.toml --json | jq .schedulable
  taut check system.toml --migrate            a file of an earlier version for this one

taut init writes a commented file to begin with; docs/system-toml.md explains the format.")]
pub struct CheckArgs {
    /// The system file
    #[arg(default_value = "system.toml", value_name = "FILE")]
    file: PathBuf,
    /// Print one JSON object instead of the table
    #[arg(long)]
    json: bool,
    /// Draw the timeline of the critical instant
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print also by how much the load, the overheads and each execution time may grow (a dozen analyses for each callback)
    #[arg(long)]
    sensitivity: bool,
    /// Check the file together with the running processes of the domain
    #[arg(long, conflicts_with = "sensitivity")]
    admit: bool,
    /// Rewrite a file of an earlier version for the current one and print what changed; comments and order stay
    #[arg(long, conflicts_with_all = ["admit", "sensitivity", "svg"])]
    migrate: bool,
    /// The domain [default: TAUT_DOMAIN, else ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", requires = "admit", value_parser = clap::value_parser!(u32).range(0..=232))]
    domain: Option<u32>,
}

/// Runs the verb; the exit code is the verdict.
pub fn run(args: &CheckArgs) -> Outcome<ExitCode> {
    let path = args.file.display();
    if args.migrate {
        let migration = Migration::of_file(&args.file)
            .map_err(|reason| Failure::unusable(format!("`{path}` is not migrated: {reason}")))?;
        let mut out = crate::print::stdout();
        match args.json {
            true => writeln!(out, "{}", migration.to_json(&args.file))?,
            false => writeln!(out, "{}", migration.to_text(&args.file))?,
        }
        return Ok(ExitCode::SUCCESS);
    }
    let file = read_file(&args.file)?;
    let admitted = args.admit.then(|| Admitted::new(&file, &path.to_string(), args.domain)).transpose();
    let admitted = admitted.map_err(Failure::unusable)?;
    let checked = admitted.as_ref().map_or_else(|| file.check(), |admitted| admitted.checked().clone());
    let is_good = admitted.as_ref().map_or(checked.schedulable, Admitted::is_admitted);
    if let Some(path) = &args.svg {
        crate::replace::write(path, gantt::draw(&checked))
            .map_err(|error| Failure::unwritable(path, &error))?;
    }
    match print(args, &file, &checked, admitted.as_ref()) {
        // A broken pipe is no error: the reader has ended (`taut check | head`).
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error.into()),
        _ if is_good => Ok(ExitCode::SUCCESS),
        _ => Ok(ExitCode::from(1)),
    }
}

fn print(
    args: &CheckArgs,
    file: &SystemFile,
    checked: &CheckedSystem,
    admitted: Option<&Admitted>,
) -> io::Result<()> {
    let growth = args.sensitivity.then(|| sensitivity::Growth::of(file));
    let mut out = crate::print::stdout();
    if args.json {
        json::write(checked, growth.as_ref(), admitted.map(Admitted::json), &mut out)?;
    } else {
        table::write(checked, &mut out)?;
        if let Some(growth) = &growth {
            sensitivity::write(growth, &mut out)?;
        }
        if let Some(admitted) = admitted {
            admitted.write(&mut out)?;
        }
        if let Some(path) = &args.svg {
            writeln!(out, "\nTimeline of the critical instant: {}", path.display())?;
        }
    }
    out.flush()
}

/// Reads a system file, or prints its problems.
pub fn read_file(path: &Path) -> Outcome<SystemFile> {
    SystemFile::read(path).map_err(|error| file_failure(&error))
}

/// The failure of a system file, whose problems are printed as file:line:column, to which editors can jump.
pub fn file_failure(error: &FileError) -> Failure {
    let FileError::Content { path, source } = error else { return Failure::unusable(error.to_string()) };
    let path = path.display();
    for problem in &source.0 {
        eprintln!("{path}:{}:{}: {}", problem.line, problem.column, problem.message);
    }
    Failure::unusable(format!("{path} has {}", count(source.0.len(), "problem")))
}
