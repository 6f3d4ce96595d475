// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: records the messages of topics into a bag, unseen by their publishers.
//!
//! The main thread discovers publishers; `reader` takes messages and copies them once, into a ring of locked memory; `bag_writer` writes
//! from the ring to the disk.

pub mod args;
mod aside;
mod bag_writer;
mod black_box;
mod channels;
mod choice;
mod event;
mod observers;
mod reader;
mod statement;

pub use args::{Compressed, RecordArgs, size};

use aside::Aside;
use bag_writer::BagWriter;
use black_box::{Alarms, Dumper};
use choice::Choice;
use indicatif::ProgressBar;
use observers::Observers;
use reader::{Pace, Reader};
use statement::Statement;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use taut_cli::verb::{End, Failure, Outcome};
use tautline_bag::{BagError, Options, Writer};
use tautline_rt::{self as rt, MemoryLock, Policy, ThreadBuilder};
use tautline_transport::Participant;

/// The interval at which publishers are discovered.
const LOOK: Duration = Duration::from_millis(20);
/// The interval at which a terminal shows the counts.
const SAY: Duration = Duration::from_millis(500);

pub fn run(args: &RecordArgs) -> Outcome {
    let choice = Choice::new(args)?;
    let domain = args.common.domain()?;
    let mut end = End::of(&args.common)?;
    if let Some(cores) = args.cores {
        // The threads that this one starts inherit the cores.
        rt::set_affinity(cores).map_err(|error| Failure::unusable(format!("--cores: {error}")))?;
    }
    let pause = Pause { wanted: flag(args.paused), is_paused: flag(args.paused) };
    let asked = flag(false);
    // Two requests at once are one, unlike two toggles.
    match args.black_box {
        Some(_) => listen(&asked, |asked| asked.store(true, Ordering::Relaxed))?,
        None => listen(&pause.wanted, |wanted| {
            wanted.fetch_xor(true, Ordering::Relaxed);
        })?,
    }
    // Memory is locked before the first message.
    if let Err(error) = rt::lock_memory(MemoryLock::OnFault) {
        eprintln!("taut: warning: the buffers are not locked into memory: {error}");
    }
    let (producer, consumer) = crate::ring::touched(args.budget.saturating_sub(args.memory_bytes() as u64))?;
    let folder = args.output.clone().unwrap_or_else(|| args.default_folder().into());
    let participant = Participant::new(domain)?;
    let (stop, is_over) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let (observers, new_observers) = Observers::new(participant, choice, args)?;
    let period_ns = rt::clock::nanoseconds(args.period).max(100_000);
    let pace = Pace { period_ns, is_paused: pause.is_paused.clone() };
    let reader = Reader::new(producer, new_observers.observers, pace, stop.clone());
    let mut behind = match args.black_box {
        None => {
            let writer = Writer::create(&folder, args.options(), session(domain, reader.offset_ns()))?;
            Behind::BagWriter(BagWriter::start(
                writer,
                consumer,
                new_observers.announced,
                is_over.clone(),
                reader.offset_ns(),
            )?)
        }
        Some(span) => {
            let plan = args.plan(&folder, domain, span, reader.offset_ns())?;
            let tracing = args.tracing(domain, span)?;
            let alarms = Alarms::new(domain, &args.on, &args.silent, span, asked)?;
            let dumper = Dumper::start(plan, consumer, new_observers.announced, tracing, is_over.clone())?;
            Behind::Dumper(dumper, Box::new(alarms))
        }
    };
    let priority = if args.no_rt { None } else { rt::permission::realtime_permitted(1).is_ok().then_some(1) };
    let policy = priority.map_or(Policy::Other { nice: 0 }, Policy::Fifo);
    let thread = ThreadBuilder::new("reader").policy(policy);
    let thread = thread.spawn(move || move || reader.run())?;

    end.restart();
    let until = if end.timeout().is_some() { "" } else { ", until Ctrl-C" };
    let what = match args.black_box {
        None => String::new(),
        Some(span) => format!("the last {} s of ", span.as_secs_f64()),
    };
    eprintln!("recording {what}domain {domain} into {}{until}", folder.display());
    let watched = watch(args, &end, observers, &mut behind, (&is_over, &pause));
    // Whatever happened, the messages sent until now are taken and then written.
    stop.store(true, Ordering::Release);
    let taken = thread.join()?;
    let observers = match watched {
        Ok(observers) => observers,
        Err(failure) => {
            // The bag is complete nevertheless.
            match behind {
                Behind::BagWriter(writer) => drop(writer.finish(BTreeMap::new())?),
                Behind::Dumper(dumper, _) => drop(dumper.finish()?),
            }
            return Err(failure);
        }
    };
    let statement = Statement::new(observers, taken, args.period);
    match behind {
        Behind::BagWriter(writer) => {
            let written = writer.finish(statement.for_the_file());
            statement.print(&folder, written, args.common.json)
        }
        Behind::Dumper(dumper, _) => {
            let dumped = dumper.finish();
            black_box::print(args.common.json, &folder, dumped, &statement)
        }
    }
}

/// The thread that takes messages out of the ring.
enum Behind {
    BagWriter(BagWriter),
    Dumper(Dumper, Box<Alarms>),
}

fn flag(value: bool) -> Arc<AtomicBool> {
    Arc::new(AtomicBool::new(value))
}

/// Whether the recorder is to be paused, and whether the reader is.
struct Pause {
    wanted: Arc<AtomicBool>,
    is_paused: Arc<AtomicBool>,
}

impl Pause {
    /// Pauses or resumes the reader as requested.
    fn follow(&self, observers: &Observers, tell: impl Fn(&str)) -> Outcome {
        let wanted = self.wanted.load(Ordering::Relaxed);
        if self.is_paused.load(Ordering::Relaxed) && !wanted {
            observers.renew(tell)?;
        }
        // The reader gets the new observers before it resumes.
        self.is_paused.store(wanted, Ordering::Release);
        Ok(())
    }
}

/// Watches the domain until the end, or until the thread behind the ring has failed.
fn watch(
    args: &RecordArgs,
    end: &End,
    mut observers: Observers,
    behind: &mut Behind,
    (is_over, pause): (&AtomicBool, &Pause),
) -> Outcome<Observers> {
    let progress = progress(args.common.json);
    let mut said = Instant::now();
    let mut aside = if args.cores.is_none() { Some(Aside::new()?) } else { None };
    while !end.is_reached() && !is_over.load(Ordering::Acquire) {
        let tell = |words: &str| progress.suspend(|| eprintln!("taut: {words}"));
        observers.look(tell)?;
        pause.follow(&observers, tell)?;
        if let Some(words) = aside.as_mut().and_then(|aside| aside.look(observers.processes())) {
            progress.suspend(|| eprintln!("taut: {words}"));
        }
        if let Behind::Dumper(dumper, alarms) = behind {
            for alarm in alarms.look(&observers)? {
                progress.suspend(|| eprintln!("taut: {}: {}", alarm.kind.name(), alarm.words));
                dumper.alarm(alarm);
            }
        }
        if said.elapsed() >= SAY {
            said = Instant::now();
            let state = if pause.is_paused.load(Ordering::Relaxed) { "paused, " } else { "" };
            progress.set_message(format!("{state}{}", observers.progress()));
        }
        if observers.is_empty() {
            end.print_waiting_once(|| "a topic to record".to_owned());
        }
        end.pause(LOOK);
    }
    progress.finish_and_clear();
    Ok(observers)
}

/// A progress bar, which is hidden without a terminal and with JSON.
pub fn progress(json: bool) -> ProgressBar {
    let progress = taut_cli::trace::record::progress(json);
    if !json {
        progress.enable_steady_tick(SAY);
    }
    progress
}

/// Makes SIGUSR1 and the enter key pause or resume the recording, or request that the black box is written.
fn listen(flag: &Arc<AtomicBool>, change: fn(&AtomicBool)) -> Outcome {
    let flag = flag.clone();
    let handle = move || change(&flag);
    let mut signals = signal_hook::iterator::Signals::new([signal_hook::consts::SIGUSR1])
        .map_err(|error| Failure::unusable(format!("SIGUSR1 cannot be caught: {error}")))?;
    let on_signal = handle.clone();
    std::thread::spawn(move || signals.forever().for_each(|_| on_signal()));
    crate::terminal::on_line(move |_| handle());
    Ok(())
}

impl RecordArgs {
    fn plan(&self, folder: &Path, domain: u32, span: Duration, offset_ns: i64) -> Outcome<black_box::Plan> {
        // Refused now, rather than when an alarm needs the folder.
        if folder.exists() {
            return Err(BagError::Exists(folder.to_owned()).into());
        }
        std::fs::create_dir(folder).map_err(|source| BagError::Write { path: folder.to_owned(), source })?;
        Ok(black_box::Plan {
            folder: folder.to_owned(),
            options: Options { keep_files: None, ..self.options() },
            session: session(domain, offset_ns),
            // The time before the alarm, and the time after it.
            span_ns: rt::clock::nanoseconds(span.saturating_add(self.after)),
            after_ns: rt::clock::nanoseconds(self.after),
            most_bags: self.keep.map(|keep| keep.get() as usize),
            offset_ns,
        })
    }

    /// The recorder of trace events. `None` if trace events are not wanted, or if another recorder runs.
    fn tracing(&self, domain: u32, span: Duration) -> Outcome<Option<black_box::Tracing>> {
        if self.no_trace {
            return Ok(None);
        }
        match tautline_transport::start_recorder(domain) {
            Ok(recorder) => {
                let span_ns = rt::clock::nanoseconds(span + self.after);
                Ok(Some(black_box::Tracing::start(recorder, domain, span_ns)?))
            }
            Err(error) => {
                eprintln!("taut: warning: the black box keeps no trace events: {error}");
                Ok(None)
            }
        }
    }
}

/// The metadata of each file about the host and the recorder.
fn session(domain: u32, offset_ns: i64) -> BTreeMap<String, String> {
    let (wall, monotonic) = (rt::clock::wall_ns(), rt::clock::monotonic_ns());
    [
        ("host", rt::host::name()),
        ("domain", domain.to_string()),
        ("taut", env!("CARGO_PKG_VERSION").to_owned()),
        ("started_unix_ns", wall.to_string()),
        ("started_monotonic_ns", monotonic.to_string()),
        // Times of reception are CLOCK_MONOTONIC plus this, even if the wall clock is set.
        ("log_time_minus_monotonic_ns", offset_ns.to_string()),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}
