// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut record`: records the messages of topics into a bag, unseen by their publishers.
//!
//! The main thread discovers publishers; `reader` takes messages and copies them once, into a ring of locked memory; `bag_writer` writes
//! from the ring to the disk.

mod aside;
mod bag_writer;
mod black_box;
mod channels;
mod choice;
mod event;
mod observers;
mod reader;
mod statement;

use aside::Aside;
use bag_writer::BagWriter;
use black_box::{Alarms, Dumper, Kind};
use choice::Choice;
use clap::Args;
use indicatif::ProgressBar;
use observers::Observers;
use reader::{Pace, Reader};
use statement::Statement;
use std::collections::BTreeMap;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use taut_cli::completions;
use taut_cli::date::date;
use taut_cli::verb::{CommonArgs, End, Failure, Outcome, time};
use tautline_bag::{BagError, Compression, Options, Writer};
use tautline_rt::{self as rt, CoreSet, MemoryLock, Policy, ThreadBuilder};
use tautline_transport::Participant;

/// The interval at which publishers are discovered.
const LOOK: Duration = Duration::from_millis(20);
/// The interval at which a terminal shows the counts.
const SAY: Duration = Duration::from_millis(500);

/// Records topics into a bag, as rosbag2 writes them: MCAP files and a metadata.yaml
///
/// Publishers do not notice: none waits for the recorder, wakes it, or lists it. Lost messages are counted. At the end the recorder prints
/// the stall that each topic survives: a queue of `--depth` messages over the rate of its fastest publisher.
/// Ctrl-C ends the recording. `taut bag recover` repairs the bag of a killed recorder, which has all but the last half second.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  taut record /scan /odom                          until Ctrl-C, into a new folder
  taut record -a --exclude 'camera|/rosout' -o run1
  taut record --service /add --action /dock        requests and responses as events
  taut record --type sensor_msgs/msg/Image --compression zstd --max-size 1GB
  taut record -a --max-time 5min --keep 12         the last hour
  taut record -a --black-box 30s --budget 1GB      the last 30 s before a deadline is missed, a process dies, a topic falls silent
  taut record /scan --throttle /scan=1 --timeout 60s --json

Exit codes: 0 nothing was lost; 1 something was, or a named topic did not come; 2 it could not be written.
On a terminal the enter key pauses and goes on; so does SIGUSR1. A black box is written then.")]
pub struct RecordArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Topics; those that do not exist are waited for
    #[arg(value_name = "TOPIC", add = completions::topics())]
    topics: Vec<String>,
    /// Every topic, service and action, also those that appear later
    #[arg(short, long)]
    all: bool,
    /// Requests and responses of this service, as /SERVICE/_service_event; may be given several times
    #[arg(long, value_name = "SERVICE")]
    service: Vec<String>,
    /// Goals, results, cancellations, feedback and states of this action; may be given several times
    #[arg(long, value_name = "ACTION")]
    action: Vec<String>,
    /// Topics whose name matches this regular expression in part
    #[arg(short = 'e', long, value_name = "REGEX")]
    regex: Option<String>,
    /// Topics of this type, or services; may be given several times
    #[arg(long = "type", value_name = "TYPE")]
    types: Vec<String>,
    /// Except topics whose name matches this regular expression in part
    #[arg(short = 'x', long, value_name = "REGEX")]
    exclude: Option<String>,
    /// Also topics of other hosts and of ROS, which see a subscription and send their messages
    #[arg(long)]
    fetch: bool,
    /// The bag: a folder that does not exist yet [default: bag_ and the time]
    #[arg(short, long, value_name = "FOLDER")]
    output: Option<PathBuf>,
    /// How chunks are compressed
    #[arg(long, value_enum, default_value_t = Compressed::None)]
    compression: Compressed,
    /// Begin a new file when one has this size, such as 500MB or 4GiB
    #[arg(long, value_name = "SIZE", value_parser = size)]
    max_size: Option<u64>,
    /// Begin a new file when one has messages of this time
    #[arg(long, value_name = "TIME", value_parser = time)]
    max_time: Option<Duration>,
    /// Keep no more files than this, or bags of a black box: the oldest is removed
    #[arg(long, value_name = "N")]
    keep: Option<NonZeroU32>,
    /// Keep at most this number of messages of this topic per second; may be given several times
    #[arg(long, value_name = "TOPIC=HZ", value_parser = throttle)]
    throttle: Vec<(String, f64)>,
    /// Begin without recording
    #[arg(long)]
    paused: bool,
    /// Memory for messages that wait for the disk, locked and touched at the start
    #[arg(long, value_name = "SIZE", default_value = "256MB", value_parser = size)]
    budget: u64,
    /// Messages that wait in the queue of each publisher [default: the greatest depth of the topic's endpoints, or as many as have 1 MiB, up to 1000]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    depth: Option<u32>,
    /// The interval at which messages are taken
    #[arg(long, value_name = "TIME", default_value = "2ms", value_parser = time)]
    period: Duration,
    /// Keep the last TIME in memory, and write it into a bag of its own at each event of --on
    #[arg(long, value_name = "TIME", value_parser = time, conflicts_with = "paused")]
    black_box: Option<Duration>,
    /// The events at which the black box is written
    #[arg(long, value_enum, value_name = "WHAT", value_delimiter = ',', requires = "black_box",
          default_values_t = [Kind::Deadline, Kind::Death, Kind::Silence, Kind::Request])]
    on: Vec<Kind>,
    /// A topic is silent after this time [default: ten times its longest pause, 1s at least]; may be given several times
    #[arg(long, value_name = "TOPIC=TIME", value_parser = silent, requires = "black_box")]
    silent: Vec<(String, Duration)>,
    /// The bag also has the messages of this time after the event
    #[arg(long, value_name = "TIME", value_parser = time, default_value = "1s", requires = "black_box")]
    after: Duration,
    /// Keep no trace events in the black box: processes do not record any for it
    #[arg(long, requires = "black_box")]
    no_trace: bool,
    /// Run on these cores alone, such as 0-1,4 [default: those that no real-time thread of the domain is bound to, if there are any]
    #[arg(long, value_name = "LIST", value_parser = cores)]
    cores: Option<CoreSet>,
    /// Take messages at an ordinary priority, instead of SCHED_FIFO 1 where that is permitted
    #[arg(long)]
    no_rt: bool,
}

#[derive(clap::ValueEnum, Clone, Copy, Debug, PartialEq, Eq)]
pub enum Compressed {
    /// Without compression
    None,
    /// Small
    Zstd,
    /// Fast
    Lz4,
}

impl From<Compressed> for Compression {
    fn from(compressed: Compressed) -> Self {
        match compressed {
            Compressed::None => Compression::None,
            Compressed::Zstd => Compression::Zstd,
            Compressed::Lz4 => Compression::Lz4,
        }
    }
}

/// A number of bytes and its unit.
pub fn size(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit: f64 = match &text[digits.len()..] {
        "" | "B" => 1.0,
        "kB" | "KB" | "k" | "K" => 1e3,
        "MB" | "M" => 1e6,
        "GB" | "G" => 1e9,
        "TB" | "T" => 1e12,
        "KiB" => 1024.0,
        "MiB" => 1048576.0,
        "GiB" => 1073741824.0,
        "TiB" => 1099511627776.0,
        other => return Err(format!("'{other}' is no unit: B, kB, MB, GB, TB, KiB, MiB, GiB, TiB")),
    };
    let number = digits.parse::<f64>().ok().map(|number| number * unit).filter(|n| (1.0..1e18).contains(n));
    number.map(|bytes| bytes as u64).ok_or_else(|| format!("'{text}' is no size: 500MB or 4GiB is one"))
}

fn silent(text: &str) -> Result<(String, Duration), String> {
    let (topic, text) = text.rsplit_once('=').ok_or("TOPIC=TIME, such as /scan=200ms")?;
    Ok((taut_cli::arguments::full_name(topic), time(text)?))
}

fn cores(text: &str) -> Result<CoreSet, String> {
    let cores = CoreSet::parse(text).filter(|cores| !cores.is_empty());
    cores.ok_or_else(|| format!("'{text}' is no list of cores: 0-1,4 is one"))
}

fn throttle(text: &str) -> Result<(String, f64), String> {
    let (topic, hz) = text.rsplit_once('=').ok_or("TOPIC=HZ, such as /scan=10")?;
    let hz = hz.parse::<f64>().ok().filter(|hz| (1e-6..1e9).contains(hz));
    let hz = hz.ok_or("HZ is a number of messages a second, above 0")?;
    Ok((taut_cli::arguments::full_name(topic), hz))
}

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
            black_box::print(args, &folder, dumped, &statement)
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
    /// The part of the budget for data on their way to the disk.
    fn memory_bytes(&self) -> usize {
        (self.budget / 8).clamp(8 << 10, 32 << 20) as usize
    }

    fn options(&self) -> Options {
        Options {
            compression: self.compression.into(),
            split_bytes: self.max_size,
            split_ns: self.max_time.map(rt::clock::nanoseconds),
            keep_files: self.keep,
            memory_bytes: Some(self.memory_bytes()),
        }
    }

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

    /// `bag_` or `black_box_` and the time, UTC.
    fn default_folder(&self) -> String {
        let what = if self.black_box.is_some() { "black_box" } else { "bag" };
        format!("{what}_{}", date(rt::clock::wall_ns()).replace(' ', "-").replace(':', "_"))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_rates_are_read() {
        assert_eq!([size("500MB"), size("4GiB"), size("7")], [Ok(500_000_000), Ok(4 << 30), Ok(7)]);
        for wrong in ["", "0", "-1MB", "5 MB", "3 parsec", "1e30GB", "nan"] {
            assert!(size(wrong).is_err(), "{wrong}");
        }
        assert_eq!(throttle("scan=10"), Ok(("/scan".into(), 10.0)));
        for wrong in ["/scan", "/scan=", "/scan=0", "/scan=x", "/scan=-1"] {
            assert!(throttle(wrong).is_err(), "{wrong}");
        }
    }
}
