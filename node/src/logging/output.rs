// SPDX-License-Identifier: MIT OR Apache-2.0
//! Where lines go: the console and `/rosout`; and the thread that brings them there from real-time threads.

use super::line::{FixedLine, Line};
use super::rings::{self, Drain, LINES, Lost};
use super::rosout::Rosout;
use super::severity::is_below;
use super::{LogSeverity, console};
use std::cell::Cell;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, Once, PoisonError, Weak};
use std::time::{Duration, Instant};
use tautline_rt::Policy;
use tautline_rt::clock::wall_ns;

/// How often the rings are looked at while a thread has one, and while none has.
const PERIOD: Duration = Duration::from_millis(20);
const IDLE_PERIOD: Duration = Duration::from_millis(250);
/// How often the rings of threads that have ended are looked for.
const RECLAIM_PERIOD: Duration = Duration::from_secs(1);

struct Sink {
    drain: Drain,
    /// By logger: those of nodes.
    topics: Vec<(String, Weak<Rosout>)>,
}

static SINK: Mutex<Sink> = Mutex::new(Sink { drain: Drain::new(), topics: Vec::new() });
static LOST: AtomicU64 = AtomicU64::new(0);
pub(super) static TO_CONSOLE: AtomicBool = AtomicBool::new(true);

thread_local! {
    /// Set while this thread writes: what is logged meanwhile, as by a publisher, goes to the console only.
    static WRITING: Cell<bool> = const { Cell::new(false) };
}

/// Lines that real-time threads logged and nobody will see, because their ring was full.
pub fn lost_lines() -> u64 {
    LOST.load(Ordering::Relaxed)
}

/// Writes what real-time threads have logged so far. A context does so when it ends.
pub fn flush() {
    if !WRITING.get() {
        Writing::begin().drain();
    }
}

/// Makes rings for real-time threads, and starts the thread that empties them.
pub(crate) fn start() {
    static STARTED: Once = Once::new();
    STARTED.call_once(|| {
        lock().drain.prepare();
        // Not of rt's: its stack, which opening a topic needs, would be touched, and so be resident, in each process.
        let thread = std::thread::Builder::new().name("log".into());
        if let Err(error) = thread.spawn(write_for_ever) {
            tracing::warn!("what real-time threads log is written only when others log: {error}");
        }
    });
}

fn write_for_ever() {
    // Who started it may be a real-time thread.
    if let Err(error) = tautline_rt::set_policy(Policy::Other { nice: 5 }) {
        tracing::warn!("the thread that writes the log: {error}");
    }
    let mut reclaimed = Instant::now();
    loop {
        let mut writing = Writing::begin();
        let busy = writing.drain();
        if reclaimed.elapsed() >= RECLAIM_PERIOD {
            reclaimed = Instant::now();
            writing.sink.drain.reclaim();
            writing.sink.topics.retain(|(_, topic)| topic.strong_count() != 0);
        }
        writing.sink.drain.prepare();
        drop(writing);
        std::thread::sleep(if busy { PERIOD } else { IDLE_PERIOD });
    }
}

/// What the logger of a node logs goes to this topic.
pub(crate) fn add_topic(logger: &str, topic: Weak<Rosout>) {
    let mut sink = lock();
    // Nodes come and go, and come again under their former names.
    if !sink.topics.iter().any(|(other, of)| other == logger && of.ptr_eq(&topic)) {
        sink.topics.push((logger.to_owned(), topic));
    }
}

pub(super) fn log(line: Line<'_>, text: fmt::Arguments<'_>) {
    if rings::is_mine() || is_realtime() {
        return rings::push(FixedLine::new(line, text));
    }
    let text = text.as_str().map_or_else(|| fmt::format(text).into(), std::borrow::Cow::Borrowed);
    let line = Line { text: &text, ..line };
    if WRITING.get() {
        return console::write(&line);
    }
    let mut writing = Writing::begin();
    // What real-time threads logged before comes before.
    writing.drain();
    writing.write(&line);
}

/// A thread may become real-time after its first line.
fn is_realtime() -> bool {
    tautline_rt::current_policy().is_ok_and(|policy| policy.realtime_priority().is_some())
}

fn lock() -> MutexGuard<'static, Sink> {
    SINK.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The one who writes.
struct Writing {
    sink: MutexGuard<'static, Sink>,
}

impl Writing {
    fn begin() -> Writing {
        let sink = lock();
        WRITING.set(true);
        Writing { sink }
    }

    /// Whether some thread has a ring.
    fn drain(&mut self) -> bool {
        let Sink { drain, topics } = &mut *self.sink;
        let mut losses = Vec::new();
        let busy = drain.drain(|line| deliver(topics, &line.as_line()), |lost| losses.push(lost));
        for Lost { lines, tid } in losses {
            LOST.fetch_add(lines, Ordering::Relaxed);
            let text = match tid {
                0 => format!("{lines} lines lost: no ring was free for their real-time threads"),
                tid => format!("{lines} lines lost: the ring of thread {tid}, of {LINES} lines, was full"),
            };
            let (time_ns, severity) = (wall_ns(), LogSeverity::Warn);
            deliver(topics, &Line { time_ns, severity, logger: "logging", text: &text, file: "", line: 0 });
        }
        busy
    }

    fn write(&mut self, line: &Line<'_>) {
        deliver(&self.sink.topics, line);
    }
}

impl Drop for Writing {
    fn drop(&mut self) {
        WRITING.set(false);
    }
}

fn deliver(topics: &[(String, Weak<Rosout>)], line: &Line<'_>) {
    if TO_CONSOLE.load(Ordering::Relaxed) {
        console::write(line);
    }
    // Of the node that is nearest above the logger, in each context.
    let above = topics.iter().filter(|(logger, _)| is_below(line.logger, logger));
    let mut published: Vec<Weak<Rosout>> = Vec::new();
    for (_, topic) in above {
        if !published.iter().any(|other| other.ptr_eq(topic)) {
            published.push(topic.clone());
            if let Some(topic) = topic.upgrade() {
                topic.publish(line);
            }
        }
    }
}

/// Writes, when it is dropped, what callbacks logged.
pub(crate) struct FlushOnDrop;

impl Drop for FlushOnDrop {
    fn drop(&mut self) {
        flush();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_that_comes_again_is_listed_once() {
        for name in ["robot", "arm", "robot"] {
            add_topic(name, Weak::new());
        }
        let names: Vec<_> = lock().topics.iter().map(|(name, _)| name.clone()).collect();
        assert_eq!(names, ["robot", "arm"]);
    }
}
