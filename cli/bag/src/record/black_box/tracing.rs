// SPDX-License-Identifier: MIT OR Apache-2.0
//! Trace events of the last seconds, in memory.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;
use taut_cli::trace::file::Writer;
use taut_cli::trace::record::session;
use taut_cli::trace::recording::Entry;
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{Policy, ThreadBuilder};
use tautline_trace::{Event, Record, Recorder};

/// The interval at which events are fetched, as in `taut trace record`.
const PERIOD: Duration = Duration::from_millis(10);
/// The most events that are kept: 64 MB.
const MOST_EVENTS: usize = 1_600_000;
/// How long the writing of the file is waited for.
const PATIENCE: Duration = Duration::from_secs(30);

/// The thread that keeps the events. It ends when this is dropped.
pub struct Tracing {
    ask: Sender<(PathBuf, Sender<io::Result<u64>>)>,
}

/// Events of one thread, in order.
struct Batch {
    process: u32,
    tid: u32,
    events: Vec<Event>,
}

struct Kept {
    domain: u32,
    span_ns: u64,
    /// The process and the description of what events may refer to.
    known: Vec<(u32, Entry)>,
    batches: VecDeque<Batch>,
    events: usize,
    /// Processes that have ended, and have events here.
    ended: Vec<u32>,
}

impl Tracing {
    pub fn start(mut recorder: Recorder, domain: u32, span_ns: u64) -> Result<Self, tautline_rt::RtError> {
        let (ask, asked) = channel::<(PathBuf, Sender<io::Result<u64>>)>();
        let (known, batches, ended) = (Vec::new(), VecDeque::new(), Vec::new());
        let mut kept = Kept { domain, span_ns, known, batches, events: 0, ended };
        let thread = ThreadBuilder::new("tracing").policy(Policy::Other { nice: 10 });
        thread.spawn(move || {
            move || loop {
                recorder.poll(&mut |record| kept.note(&record));
                kept.drop_old();
                match asked.recv_timeout(PERIOD) {
                    Ok((path, answer)) => drop(answer.send(kept.write(&path))),
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => return recorder.finish(&mut |_| {}),
                }
            }
        })?;
        Ok(Tracing { ask })
    }

    /// Writes a recording for `taut trace` and returns the number of its events.
    pub fn write(&self, path: &Path) -> Option<u64> {
        let (answer, answered) = channel();
        self.ask.send((path.to_owned(), answer)).ok()?;
        match answered.recv_timeout(PATIENCE).ok()? {
            Ok(events) => Some(events),
            Err(error) => {
                eprintln!("taut: warning: {}: {error}", path.display());
                None
            }
        }
    }
}

impl Kept {
    fn note(&mut self, record: &Record<'_>) {
        match *record {
            Record::Process { process, .. }
            | Record::Object { process, .. }
            | Record::Thread { process, .. } => {
                self.known.extend(Entry::of(record).map(|entry| (process, entry)));
            }
            Record::Events { process, tid, events } => {
                self.events += events.len();
                self.batches.push_back(Batch { process, tid, events: events.to_vec() });
            }
            Record::Ended { process } => self.ended.push(process),
            _ => {}
        }
    }

    fn drop_old(&mut self) {
        let oldest_ns = monotonic_ns().saturating_sub(self.span_ns);
        let is_old = |batch: &Batch| batch.events.last().is_none_or(|event| event.time_ns < oldest_ns);
        while self.batches.front().is_some_and(|batch| is_old(batch) || self.events > MOST_EVENTS) {
            self.events -= self.batches.pop_front().map_or(0, |batch| batch.events.len());
        }
        let (batches, known) = (&self.batches, &mut self.known);
        self.ended.retain(|process| {
            let has_events = batches.iter().any(|batch| batch.process == *process);
            if !has_events {
                known.retain(|(of, _)| of != process);
            }
            has_events
        });
    }

    fn write(&self, path: &Path) -> io::Result<u64> {
        let mut writer = Writer::new(BufWriter::new(File::create(path)?))?;
        writer.entry(&session(self.domain))?;
        self.known.iter().try_for_each(|(_, entry)| writer.entry(entry))?;
        for Batch { process, tid, events } in &self.batches {
            writer.events(*process, *tid, events)?;
        }
        writer.entry(&Entry::Finished { monotonic_ns: monotonic_ns() })?;
        writer.flush()?;
        Ok(self.events as u64)
    }
}
