// SPDX-License-Identifier: MIT OR Apache-2.0
//! The outputs of log lines: the console and `/rosout`; and the thread that writes the lines of real-time
//! threads there.

use super::console;
use super::line::{FixedLine, Line};
use super::rings::{self, Drain, LINES, Lost};
use super::rosout::Rosout;
use super::severity::{LogSeverity, is_below};
use std::cell::Cell;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, MutexGuard, Weak};
use std::time::Duration;
use tautline_rt::Policy;
use tautline_rt::clock::wall_ns;
use tautline_rt::fork::ProcessMutex;

/// Interval at which the rings are read while there are lines; the first line after a silence wakes the thread.
const PERIOD: Duration = Duration::from_millis(20);

struct Sink {
    is_started: bool,
    drain: Drain,
    topics: Vec<OfNode>,
}

impl Sink {
    const fn with(drain: Drain) -> Sink {
        Sink { is_started: false, drain, topics: Vec::new() }
    }
}

/// The topic of a node's loggers.
struct OfNode {
    logger: String,
    topic: Weak<Rosout>,
    life: Weak<()>,
}

impl OfNode {
    fn is_used(&self) -> bool {
        self.topic.strong_count() != 0 && self.life.strong_count() != 0
    }
}

static SINK: ProcessMutex<Sink> =
    ProcessMutex::new(Sink::with(Drain::new()), || Sink::with(Drain::of_child()));
static LOST: AtomicU64 = AtomicU64::new(0);
pub(super) static TO_CONSOLE: AtomicBool = AtomicBool::new(true);

thread_local! {
    /// Set while this thread writes: lines that are logged meanwhile, as by a publisher, go to the console only.
    static WRITING: Cell<bool> = const { Cell::new(false) };
}

/// Lines of real-time threads that were lost because their ring was full.
pub fn lost_lines() -> u64 {
    LOST.load(Ordering::Relaxed)
}

/// Writes the lines that real-time threads have logged so far. A context does this when it ends.
pub fn flush() {
    if !WRITING.get() {
        Writing::begin().drain();
    }
}

/// Makes rings for real-time threads, and starts the thread that empties them.
pub(crate) fn start() {
    let mut sink = SINK.lock();
    if std::mem::replace(&mut sink.is_started, true) {
        return;
    }
    sink.drain.prepare();
    drop(sink);
    // Not a thread of `tautline-rt`: its stack, which opening a topic needs, would be touched, and so be resident, in each process.
    let thread = std::thread::Builder::new().name("log".into());
    if let Err(error) = thread.spawn(write_for_ever) {
        tracing::warn!("lines of real-time threads are written only when other threads log: {error}");
    }
}

fn write_for_ever() {
    // The thread that started this one may be a real-time thread.
    if let Err(error) = tautline_rt::set_policy(Policy::Other { nice: 5 }) {
        tracing::warn!("the thread that writes the log: {error}");
    }
    let look = || {
        let mut writing = Writing::begin();
        let any = writing.drain();
        writing.sink.drain.reclaim();
        // After the lines of these topics were written.
        writing.sink.topics.retain(OfNode::is_used);
        writing.sink.drain.prepare();
        any
    };
    loop {
        while look() {
            std::thread::sleep(PERIOD);
        }
        rings::sleep(|| !look());
    }
}

/// Publishes the lines of the node with this logger on this topic, until `life` dangles.
pub(super) fn add_topic(logger: &str, topic: Weak<Rosout>, life: Weak<()>) {
    let mut writing = Writing::begin();
    // The lines of nodes that have ended are written before their topics are removed.
    writing.drain();
    writing.sink.topics.retain(OfNode::is_used);
    writing.sink.topics.push(OfNode { logger: logger.to_owned(), topic, life });
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
    // Earlier lines of real-time threads are written first.
    writing.drain();
    writing.write(&line);
}

/// Not cached, because a thread may become real-time after its first line.
fn is_realtime() -> bool {
    tautline_rt::current_policy().is_ok_and(|policy| policy.realtime_priority().is_some())
}

struct Writing {
    sink: MutexGuard<'static, Sink>,
    // Dropped after the lock: dropping the last one of a context ends threads that may log.
    used: Vec<Arc<Rosout>>,
}

impl Writing {
    fn begin() -> Writing {
        let sink = SINK.lock();
        WRITING.set(true);
        Writing { sink, used: Vec::new() }
    }

    /// Writes the waiting lines. Returns whether there were any.
    fn drain(&mut self) -> bool {
        let Writing { sink, used } = self;
        let Sink { drain, topics, .. } = &mut **sink;
        let mut losses = Vec::new();
        let any = drain.drain(|line| deliver(topics, used, &line.as_line()), |lost| losses.push(lost));
        for Lost { lines, tid } in losses {
            LOST.fetch_add(lines, Ordering::Relaxed);
            let text = match tid {
                0 => format!("{lines} lines lost: no ring was free for their real-time threads"),
                tid => format!("{lines} lines lost: the ring of thread {tid}, of {LINES} lines, was full"),
            };
            let (time_ns, severity) = (wall_ns(), LogSeverity::Warn);
            let line = Line { time_ns, severity, logger: "logging", text: &text, file: "", line: 0 };
            deliver(topics, used, &line);
        }
        any
    }

    fn write(&mut self, line: &Line<'_>) {
        deliver(&self.sink.topics, &mut self.used, line);
    }
}

impl Drop for Writing {
    fn drop(&mut self) {
        WRITING.set(false);
    }
}

/// Writes a line to the console and to `/rosout`. Adds the topics on which it was published to `used`.
fn deliver(topics: &[OfNode], used: &mut Vec<Arc<Rosout>>, line: &Line<'_>) {
    if TO_CONSOLE.load(Ordering::Relaxed) {
        console::write(line);
    }
    // In each context, the topic of the node that is nearest above the logger.
    let above = topics.iter().filter(|of| is_below(line.logger, &of.logger));
    let mut published: Vec<Weak<Rosout>> = Vec::new();
    for OfNode { topic, .. } in above {
        if !published.iter().any(|other| other.ptr_eq(topic)) {
            published.push(topic.clone());
            if let Some(topic) = topic.upgrade() {
                topic.publish(line);
                if !used.iter().any(|other| Arc::ptr_eq(other, &topic)) {
                    used.push(topic);
                }
            }
        }
    }
}

/// When dropped, writes the lines that callbacks logged.
pub(crate) struct FlushOnDrop;

impl Drop for FlushOnDrop {
    fn drop(&mut self) {
        flush();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::logging::Logger;
    use tautline_transport::Participant;

    #[test]
    fn nodes_whose_loggers_have_gone_are_forgotten() {
        let rosout = Arc::new(Rosout::new(Participant::new(56).unwrap()));
        let names = || SINK.lock().topics.iter().map(|of| of.logger.clone()).collect::<Vec<_>>();
        let add = |name: &str| {
            let logger = Logger::of_node(name);
            logger.add_topic(Arc::downgrade(&rosout));
            logger
        };
        let robot = add("/robot");
        drop(add("/arm"));
        let driver = add("/robot/hand").child("driver");
        assert_eq!(names(), ["robot", "robot.hand"], "a child is enough");
        drop((robot, driver));
        let _again = add("/robot");
        assert_eq!(names(), ["robot"]);
    }
}
