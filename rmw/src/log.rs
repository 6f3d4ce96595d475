// SPDX-License-Identifier: MIT OR Apache-2.0
//! Forwards Tautline's log to ROS's log, as logger `rmw_tautline`.

use crate::bindings::*;
use crate::error::Error;
use crate::handle::exported;
use crate::helper::ordinary_thread;
use std::ffi::CString;
use std::fmt::{self, Write};
use std::sync::atomic::{AtomicPtr, AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use tautline_rt::fork::{ProcessMark, ProcessMutex, without_forks};
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

/// Lowest severity to forward.
static LEAST: AtomicU32 = AtomicU32::new(RMW_LOG_SEVERITY_INFO);

/// Queue of lines; more are counted.
const LINES: usize = 256;

/// Forwards log lines from now on, unless the process has a `tracing` subscriber. A separate thread does it, because a handler of
/// ROS's log may hold its own lock while publishing, and Tautline may log while holding one of its locks. A forked child, which has no
/// such thread, starts its own.
pub(crate) fn start() {
    static STARTING: ProcessMutex<()> = ProcessMutex::new((), || ());
    let _starting = STARTING.lock();
    if Queue::current().is_some() {
        return;
    }
    let (lines, waiting) = sync_channel(LINES);
    let thread =
        ordinary_thread("rmw_log").and_then(|thread| thread.spawn(move || move || pass_on(&waiting)));
    if thread.is_ok() {
        let queue = Box::into_raw(Box::new(Queue { process: ProcessMark::new(), lines }));
        // Release: pairs with the Acquire in `current`. A forked child leaks its parent's queue.
        QUEUE.store(queue, Ordering::Release);
        let _ = tracing::subscriber::set_global_default(ToRos { left_out: AtomicU32::new(0) });
    }
}

/// The queue of the lines that this process's thread logs.
struct Queue {
    process: ProcessMark,
    lines: SyncSender<(u32, CString)>,
}

/// Never freed.
static QUEUE: AtomicPtr<Queue> = AtomicPtr::new(std::ptr::null_mut());

impl Queue {
    /// The queue that this process created; `None` if only its parent did.
    fn current() -> Option<&'static Queue> {
        // SAFETY: null, or a queue that is never dropped.
        let queue = unsafe { QUEUE.load(Ordering::Acquire).as_ref() };
        queue.filter(|queue| queue.process.is_here())
    }
}

struct ToRos {
    left_out: AtomicU32,
}

fn pass_on(lines: &Receiver<(u32, CString)>) {
    for (severity, text) in lines {
        // A forked child logs, too, and needs the locks of ROS's handlers.
        // SAFETY: NUL-terminated texts that outlive the call; the format takes one.
        without_forks(|| unsafe {
            let (name, format) = (c"rmw_tautline".as_ptr(), c"%s".as_ptr());
            rcutils_log(std::ptr::null(), severity as i32, name, format, text.as_ptr());
        });
    }
}

fn severity(level: &Level) -> u32 {
    match *level {
        Level::ERROR => RMW_LOG_SEVERITY_ERROR,
        Level::WARN => RMW_LOG_SEVERITY_WARN,
        Level::INFO => RMW_LOG_SEVERITY_INFO,
        _ => RMW_LOG_SEVERITY_DEBUG,
    }
}

impl Subscriber for ToRos {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event() && severity(metadata.level()) >= LEAST.load(Ordering::Relaxed)
    }

    fn event(&self, event: &Event<'_>) {
        let mut line = Line::default();
        event.record(&mut line);
        let left_out = self.left_out.swap(0, Ordering::Relaxed);
        if left_out > 0 {
            line.0 += &format!(" ({left_out} earlier lines were dropped)");
        }
        let text = CString::new(line.0.replace('\0', " ")).unwrap_or_default();
        let line = (severity(event.metadata().level()), text);
        if Queue::current().is_none_or(|queue| queue.lines.try_send(line).is_err()) {
            self.left_out.fetch_add(left_out + 1, Ordering::Relaxed);
        }
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

/// An event's text, followed by its fields.
#[derive(Default)]
struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a string cannot fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

exported! {
    fn rmw_set_log_severity(severity: rmw_log_severity_t) {
        if !(RMW_LOG_SEVERITY_DEBUG..=RMW_LOG_SEVERITY_FATAL).contains(&severity) {
            return Err(Error::invalid(format!("{severity} is not a severity of rmw")));
        }
        LEAST.store(severity, Ordering::Relaxed);
        tracing::callsite::rebuild_interest_cache();
        Ok(())
    }
}
