// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut apply`: makes running processes adopt the present text of their system file.

use crate::check::read_file;
use crate::table::{GOOD, wrap};
use crate::verb::{CommonArgs, Failure, Outcome};
use clap::Args;
use std::io::Write;
use std::path::PathBuf;
use tautline::{Error, SystemError, apply_system};

/// Makes running processes adopt the present text of their system file: priorities, reservations, budgets and deadlines
///
/// First `taut` checks the new text together with everything else that runs in the domain. Then each process checks that it can adopt the
/// text without a restart: callbacks, nodes, cores, threads, topics, periods and deeper queues cannot change. If one process refuses,
/// nothing changes. Exits with 0 if all processes have adopted the text, 1 if one refused it, 2 if the file cannot be used.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut apply system.toml                      the file that a robot was started with, after an edit
  taut check system.toml --sensitivity        before: by how much times may grow
  taut report system.toml                     after: the measurements

docs/system-toml.md#changes-at-run-time says what can be changed.")]
pub struct ApplyArgs {
    /// The system file
    #[arg(default_value = "system.toml", value_name = "FILE")]
    file: PathBuf,
    #[command(flatten)]
    common: CommonArgs,
}

pub fn run(args: &ApplyArgs) -> Outcome {
    args.common.bound();
    read_file(&args.file)?;
    let domain = args.common.domain()?;
    let labels = apply_system(domain, &args.file).map_err(|error| match error {
        Error::System(SystemError::NotAdmitted { .. })
        | Error::NobodyHas { .. }
        | Error::NotTakenUp { .. } => Failure::no(error.to_string()),
        error => error.into(),
    })?;
    let mut out = crate::print::stdout();
    if args.common.json {
        return Ok(writeln!(out, "{}", serde_json::json!({ "domain": domain, "processes": labels }))?);
    }
    let text = format!("Taken up in domain {domain} by {}.", labels.join(", "));
    Ok(writeln!(out, "{GOOD}{}{GOOD:#}", wrap(&text))?)
}
