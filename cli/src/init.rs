// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut init`: writes a commented system file to start from.

mod running;

use crate::report::overheads::measured_lines;
use crate::trace::{self, record};
use crate::verb::{CommonArgs, End, Failure, Outcome, time};
use clap::Args;
use serde_json::json;
use std::collections::HashMap;
use std::fs::OpenOptions;
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;
use tautline_analysis::file::SystemFile;
use tautline_executor::ProcessSnapshot;

/// The template; it passes `taut check` unchanged.
const TEMPLATE: &str = include_str!("init.toml");

/// Writes a commented system file to start from
///
/// The file describes a small robot and passes `taut check`; change it until it describes yours. With --from-running it describes what
/// runs in the domain: nodes of Tautline and of ROS 2 on rmw_tautline, their callbacks, topics, periods and execution times as a trace
/// shows them, and what executors of ROS 2 use, if their nodes run with TAUT_OVERHEADS=on. What is guessed is marked as such. An existing
/// file is never overwritten.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut init
  taut init --from-running robot.toml                  ten seconds of what runs now
  taut init --from-running --seconds 60 robot.toml
  taut init --from-trace run.trace robot.toml          what `taut trace record` recorded on this host")]
pub struct InitArgs {
    /// The file to write
    #[arg(default_value = "system.toml", value_name = "FILE")]
    file: PathBuf,
    /// Describe what runs in the domain
    #[arg(long)]
    from_running: bool,
    /// Observe it for this time; a plain number is in seconds
    #[arg(long, value_name = "TIME", value_parser = time, default_value = "10", requires = "from_running")]
    seconds: Duration,
    /// Describe what a recording contains
    #[arg(long, value_name = "TRACE", conflicts_with = "from_running")]
    from_trace: Option<PathBuf>,
    #[command(flatten)]
    common: CommonArgs,
}

pub fn run(args: &InitArgs) -> Outcome<ExitCode> {
    let path = args.file.display();
    if args.file.exists() {
        return Err(exists(&args.file));
    }
    if let (None, false) = (&args.from_trace, args.from_running) {
        write(&args.file, TEMPLATE)?;
        print(args, None, &format!("Wrote {path}. Change it to your system, then run: taut check {path}"))?;
        return Ok(ExitCode::SUCCESS);
    }
    let (recording, overheads) = match &args.from_trace {
        Some(_) if args.common.is_domain_named() => return Err(trace::has_its_domain()),
        Some(trace) => (trace::file::read(trace)?, Vec::new()),
        None => (observe(args)?, measured_lines(args.common.domain()?)?),
    };
    let priorities = match args.from_trace {
        Some(_) => HashMap::new(),
        None => waiting_priorities(args.common.domain()?)?,
    };
    recording.warnings.iter().for_each(|warning| eprintln!("taut: warning: {warning}"));
    let described = running::describe(&recording, &overheads, &priorities);
    if described.callbacks == 0 {
        return Err(Failure::no(match &args.from_trace {
            Some(trace) => format!(
                "no callback ran in {}, so there is nothing to describe: record for longer, or while the nodes work",
                trace.display()
            ),
            None => format!(
                "no callback ran while the domain was observed, so there is nothing to describe; longer: --seconds {}",
                args.seconds.as_secs().max(1).saturating_mul(6)
            ),
        }));
    }
    write(&args.file, &described.text)?;
    let running::Described { callbacks, guesses, .. } = described;
    let parsed = SystemFile::parse(&described.text);
    let next = if parsed.is_ok() {
        format!("\nCorrect the guesses, then run: taut check {path}")
    } else {
        String::new()
    };
    let wrote = format!("Wrote {path}: {callbacks} callbacks, {guesses} guesses, marked `guess`{next}");
    print(args, Some((callbacks, guesses)), &wrote)?;
    match parsed {
        Ok(_) => Ok(ExitCode::SUCCESS),
        Err(problems) => Err(Failure::no(format!("{path} is not complete yet:\n{problems}"))),
    }
}

/// Prints what was written, as JSON or as text. The template's callbacks are not counted, because they are examples.
fn print(args: &InitArgs, counts: Option<(usize, usize)>, words: &str) -> io::Result<()> {
    let (callbacks, guesses) = counts.unzip();
    let report =
        json!({ "file": args.file.display().to_string(), "callbacks": callbacks, "guesses": guesses });
    let text = if args.common.json { report.to_string() } else { words.to_owned() };
    writeln!(crate::print::stdout(), "{text}")
}

/// The priority with which each thread of the domain takes messages, by process and thread: a thread may have another one while it runs a
/// callback.
fn waiting_priorities(domain: u32) -> Outcome<HashMap<(u32, u32), u8>> {
    let (processes, _) = tautline_system::shared_statistics(domain)?;
    // A process that is ending, or has another version, is omitted.
    let snapshots = processes.iter().filter_map(|process| process.read().ok().flatten());
    let of_one = |snapshot: ProcessSnapshot| {
        let pid = snapshot.process.pid;
        let callbacks = snapshot.callbacks.into_iter().filter(|callback| !callback.ended);
        callbacks.filter_map(move |callback| Some(((pid, callback.tid), callback.priority?)))
    };
    Ok(snapshots.flat_map(of_one).collect())
}

fn observe(args: &InitArgs) -> Outcome<trace::recording::Recording> {
    let domain = args.common.domain()?;
    let time = args.common.timeout().map_or(args.seconds, |timeout| timeout.min(args.seconds));
    let mut end = End::after(Some(time))?;
    // A new folder, in which no other user can have put a file.
    let folder = std::env::temp_dir().join(format!("taut-init-{}", std::process::id()));
    let refuse = |error: io::Error| trace::output::unwritable(&folder, &error);
    std::fs::DirBuilder::new().mode(0o700).create(&folder).map_err(refuse)?;
    let (file, begun) = (folder.join("trace"), format!("observing domain {domain} for {time:?}"));
    let recorded = record::record(&file, domain, &mut end, args.common.json, &begun);
    let recording = recorded.and_then(|_| trace::file::read(&file));
    let _ = std::fs::remove_dir_all(&folder);
    recording.map(running::of_those_that_run)
}

fn exists(path: &Path) -> Failure {
    let path = path.display();
    Failure::no(format!("{path} exists and is left as it is: name another file, or remove it first"))
}

fn write(path: &Path, text: &str) -> Outcome {
    let written = OpenOptions::new().write(true).create_new(true).open(path);
    written.and_then(|mut file| file.write_all(text.as_bytes())).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => exists(path),
        _ => Failure::unusable(format!("{} cannot be written: {error}", path.display())),
    })
}
