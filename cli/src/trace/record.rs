// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut trace record`.

use super::file::Writer;
use super::output::unwritable;
use super::recording::Entry;
use crate::verb::{CommonArgs, End, Failure, Outcome, time};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tautline_rt::{self as rt, Policy};
use tautline_trace::Record;

/// The interval at which rings are read. A thread's ring suffices for 200,000 events per second.
const PERIOD: Duration = Duration::from_millis(10);

/// Records every process of a domain into a file, until Ctrl-C or for a time
///
/// Running processes begin to record a moment later, new ones at once. What ended processes left in
/// their rings (TAUT_TRACE=on) is fetched too. Runs at low priority; events that it fetches too late are counted.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut trace record                              until Ctrl-C, into taut.trace
  taut trace record --seconds 10 -o run.trace
  taut trace record --seconds 0                  only what ended processes left: the last events before a crash
  taut trace record --domain 42 --json | jq .events_lost")]
pub struct RecordArgs {
    /// End after this time, as with --timeout; a plain number is in seconds [default: end at Ctrl-C]
    #[arg(long, value_name = "TIME", value_parser = time)]
    seconds: Option<Duration>,
    /// The recording
    #[arg(short, long, value_name = "FILE", default_value = "taut.trace")]
    out: PathBuf,
}

/// The progress of the recording.
#[derive(Default)]
pub struct Sum {
    processes: u64,
    events: u64,
    lost: u64,
    failed: Option<io::Error>,
}

pub fn run(args: &RecordArgs, common: &CommonArgs) -> Outcome {
    let domain = common.domain()?;
    let time = [args.seconds, common.timeout()].into_iter().flatten().min();
    let mut end = End::after(time)?;
    let until = if end.timeout().is_none() { ", until Ctrl-C" } else { "" };
    let begun = format!("recording domain {domain} into {}{until}", args.out.display());
    let (sum, time) = record(&args.out, domain, &mut end, common.json, &begun)?;
    print(args, common, domain, &sum, time);
    Ok(())
}

/// Records a domain into a file, and prints `begun` when it begins. Returns what was recorded, and for how long.
///
/// # Errors
/// Another recorder records the domain, or the file cannot be written.
pub fn record(
    path: &Path,
    domain: u32,
    end: &mut End,
    is_json: bool,
    begun: &str,
) -> Outcome<(Sum, Duration)> {
    lower_priority()?;
    let mut recorder = tautline_transport::start_recorder(domain)?;
    let refuse = |error: io::Error| unwritable(path, &error);
    let file = File::create(path).map_err(refuse)?;
    let mut writer = Writer::new(BufWriter::new(file)).map_err(refuse)?;
    writer.entry(&session(domain)).map_err(refuse)?;

    let (mut sum, start) = (Sum::default(), Instant::now());
    end.restart();
    let progress = progress(is_json);
    eprintln!("{begun}");
    let mut next_flush = start + Duration::from_secs(1);
    while !end.is_reached() {
        recorder.poll(&mut |record| note(&mut writer, &mut sum, &record));
        for complaint in recorder.complaints() {
            progress.suspend(|| eprintln!("taut: warning: {complaint}"));
        }
        progress.set_message(format!(
            "{} processes recording, {} events, {} lost",
            recorder.recording(),
            sum.events,
            sum.lost
        ));
        if Instant::now() >= next_flush {
            writer.flush().map_err(refuse)?;
            next_flush += Duration::from_secs(1);
        }
        if let Some(error) = sum.failed.take() {
            return Err(refuse(error));
        }
        end.pause(PERIOD);
    }
    recorder.finish(&mut |record| note(&mut writer, &mut sum, &record));
    writer.entry(&Entry::Finished { monotonic_ns: rt::clock::monotonic_ns() }).map_err(refuse)?;
    writer.flush().map_err(refuse)?;
    if let Some(error) = sum.failed {
        return Err(refuse(error));
    }
    progress.finish_and_clear();
    Ok((sum, start.elapsed()))
}

fn note(writer: &mut Writer<BufWriter<File>>, sum: &mut Sum, record: &Record<'_>) {
    match record {
        Record::Process { .. } => sum.processes += 1,
        Record::Events { events, .. } => sum.events += events.len() as u64,
        Record::Lost { events, .. } | Record::Unrecorded { events, .. } => {
            sum.lost = sum.lost.saturating_add(*events)
        }
        _ => {}
    }
    if let Err(error) = writer.record(record) {
        sum.failed.get_or_insert(error);
    }
}

fn print(args: &RecordArgs, common: &CommonArgs, domain: u32, sum: &Sum, time: Duration) {
    let file = args.out.display();
    // The recording is complete; a closed terminal is no error.
    if common.json {
        let report = json!({
            "file": args.out, "domain": domain, "seconds": time.as_secs_f64(),
            "processes": sum.processes, "events": sum.events, "events_lost": sum.lost,
        });
        println!("{report}");
    } else {
        let Sum { processes, events, lost, .. } = sum;
        println!("{file}: {events} events of {processes} processes, {lost} lost");
    }
}

/// Shows progress, only on a terminal and not with --json.
pub fn progress(json: bool) -> ProgressBar {
    if json {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{spinner} {elapsed} {msg}");
    ProgressBar::new_spinner().with_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()))
}

/// Lowers this thread to nice 10, unless it is nicer already, or is a batch or idle thread.
fn lower_priority() -> Outcome {
    let lowered = rt::current_policy().and_then(|policy| match policy {
        Policy::Other { nice: 10.. } | Policy::Unmanaged(_) => Ok(()),
        _ => rt::set_policy(Policy::Other { nice: 10 }),
    });
    lowered.map_err(|error| Failure::unusable(format!("the recorder cannot lower its priority: {error}")))
}

/// The first entry of a recording.
pub fn session(domain: u32) -> Entry {
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    Entry::Session {
        domain,
        taut: env!("CARGO_PKG_VERSION").to_owned(),
        kernel: kernel.trim_end().to_owned(),
        started_monotonic_ns: rt::clock::monotonic_ns(),
        started_unix_ns: rt::clock::wall_ns(),
        host: rt::host::name(),
        clock: clock(),
    }
}

/// Identifies this `CLOCK_MONOTONIC`: the boot of the kernel and the time namespace. Empty if unknown.
fn clock() -> String {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    // A kernel without time namespaces has a single clock.
    let namespace = std::fs::read_link("/proc/self/ns/time").unwrap_or_default();
    match boot.trim_end() {
        "" => String::new(),
        boot => format!("{boot} {}", namespace.display()),
    }
}
