// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace`: records the trace events of running processes, and shows them.

mod chrome;
pub mod csv;
pub mod file;
mod hops;
mod latency;
pub mod messages;
pub mod output;
pub mod record;
pub mod recording;
mod ways;

use crate::verb::{CommonArgs, Failure, Outcome, Verbs};
use clap::{Args, Subcommand};
use output::write_to;
use std::path::{Path, PathBuf};

/// Records publications, takes, callbacks and the sampler of running processes; exports them; computes latencies.
///
/// Programs need no preparation: without a recorder an event costs less than a nanosecond. See docs/tracing.md.
#[derive(Subcommand, Clone, Debug)]
#[command(after_help = "Examples:
  taut trace record --seconds 10 -o run.trace       every process of the domain, for ten seconds
  taut trace latency run.trace                      from publication to callback, per topic
  taut trace hops a.trace b.trace                   each hop of messages that gateways and bridges pass on
  taut trace export run.trace --format perfetto     run.trace.json, for https://ui.perfetto.dev
  taut trace export run.trace --format csv -o -     every event as a line

TAUT_TRACE=on lets a program record from its first event, before a recorder is there.")]
pub enum Verb {
    Record(record::RecordArgs),
    Export(ExportArgs),
    Latency(latency::LatencyArgs),
    Hops(hops::HopsArgs),
}

/// Writes a recording in another format
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut trace export run.trace --format perfetto            run.trace.json, for https://ui.perfetto.dev
  taut trace export run.trace --format chrome -o run.json  the same, for chrome://tracing
  taut trace export run.trace --format csv -o - | head")]
pub struct ExportArgs {
    /// The recording
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The format; perfetto and chrome are the same JSON
    #[arg(long, value_enum, default_value_t = Format::Perfetto)]
    format: Format,
    /// The output; - is standard output [default: FILE with .json or .csv appended]
    #[arg(short, long, value_name = "OUT")]
    out: Option<PathBuf>,
}

#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// JSON for ui.perfetto.dev: threads, callbacks as slices, arrows from publication to callback
    Perfetto,
    /// The same JSON, for chrome://tracing
    Chrome,
    /// A line per event
    Csv,
}

/// The failure of verbs that read a recording.
pub fn has_its_domain() -> Failure {
    Failure::unusable("a recording contains its domain: --domain goes with `taut trace record`")
}

pub fn run(args: &Verbs<Verb>) -> Outcome {
    let common = &args.common;
    if !matches!(args.verb, Verb::Record(_)) {
        common.bound();
    }
    match &args.verb {
        Verb::Record(args) => record::run(args, common),
        _ if common.is_domain_named() => Err(has_its_domain()),
        Verb::Export(args) => export(args, common),
        Verb::Latency(args) => latency::run(args, common.json),
        Verb::Hops(args) => hops::run(args, common.json),
    }
}

fn export(args: &ExportArgs, common: &CommonArgs) -> Outcome {
    let recording = file::read(&args.file)?;
    recording.warnings.iter().for_each(|warning| eprintln!("taut: warning: {warning}"));
    let out = args.out.clone().unwrap_or_else(|| {
        let mut name = args.file.clone().into_os_string();
        name.push(if args.format == Format::Csv { ".csv" } else { ".json" });
        name.into()
    });
    write_to(&out, |to| match args.format {
        Format::Perfetto | Format::Chrome => chrome::write(&recording, to),
        Format::Csv => csv::write(&recording, to),
    })?;
    let (file, events) = (out.display().to_string(), recording.events.len());
    match common.json {
        _ if out == Path::new("-") => {}
        true => println!("{}", serde_json::json!({ "file": file, "events": events })),
        false => eprintln!("{file}: {events} events"),
    }
    Ok(())
}
