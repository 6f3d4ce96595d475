// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks as an RMW sees them: a thread's work from a take until it takes again or waits.

use crate::error::Result;
use crate::node::Node;
use crate::thread::ThreadPlan;
use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tautline_executor::job::QueueState;
use tautline_executor::{ForeignCallback, ForeignExecutor, foreign};
use tautline_rt::clock::monotonic_ns;
use tautline_trace::{Object, SamplerObject};
use tautline_transport::{RawSubscription, SubscriptionCounters};

/// The jobs of one endpoint.
pub(crate) struct Jobs {
    traced: Object,
    measured: Option<Arc<ForeignCallback>>,
    /// Where the executor's overhead is recorded, if that is measured.
    executor: Option<Arc<ForeignExecutor>>,
    counters: Arc<SubscriptionCounters>,
    depth: u64,
    /// Whether the processor time of this process's callbacks is measured, also without tracing.
    is_measured: bool,
    /// Lost messages reported so far.
    noted: AtomicU64,
    /// The callback's rank, if its thread is to run the highest first; also the priority at which it does, if the file says so.
    pub(crate) rank: Option<u8>,
    /// The thread to which the system file assigns the callback.
    pub(crate) thread: Option<Arc<ThreadPlan>>,
    /// The time at which a thread first waited for the endpoint, where callbacks are measured; 0 before.
    awaited_ns: AtomicU64,
}

/// This thread's job.
struct Job {
    jobs: Arc<Jobs>,
    /// The release of its message; `None` if no thread had waited for the endpoint by then.
    released_ns: Option<u64>,
    /// Processor time that the thread used before the job: in waits that no job followed, and since the last one.
    before_ns: Option<(u64, u64)>,
}

/// Processor time that this thread has used for its next job.
#[derive(Clone, Copy)]
struct Before {
    /// In waits that no job followed.
    used_ns: u64,
    /// The time limit of its last wait. After that the executor may have run a timer, whose execution time is no overhead.
    limit_ns: Option<u64>,
}

impl Before {
    fn is_over(self, now_ns: u64) -> bool {
        self.limit_ns.is_some_and(|limit_ns| now_ns >= limit_ns)
    }

    /// Returns and resets the times at the start of a job; `None` if the executor may have run a timer before.
    fn take(now_ns: u64) -> Option<(u64, u64)> {
        let before = BEFORE.try_with(|cell| cell.replace(Before { used_ns: 0, ..cell.get() })).ok()?;
        foreign::used_ns().filter(|_| !before.is_over(now_ns)).map(|used_ns| (before.used_ns, used_ns))
    }
}

thread_local! {
    static RUNNING: RefCell<Option<Job>> = const { RefCell::new(None) };
    static BEFORE: Cell<Before> = const { Cell::new(Before { used_ns: 0, limit_ns: None }) };
    /// Whether this thread's wake was traced.
    static IS_AWAKE: Cell<bool> = const { Cell::new(false) };
}

impl Jobs {
    pub(crate) fn new(node: &Node, subscription: &RawSubscription, is_topic: bool) -> Result<Arc<Self>> {
        let topic = subscription.topic();
        let (system, node) = (&node.context().system, &node.full_name);
        let (thread, rank) = system.place(node, topic);
        let (name, measured) = system.callback(node, topic, is_topic)?;
        let executor = system.executor(node, topic)?;
        let traced = tautline_trace::subscription_callback_init(subscription.trace_id(), &name);
        let counters = subscription.counters();
        let noted = AtomicU64::new(counters.lost());
        Ok(Arc::new(Jobs {
            traced,
            measured,
            executor,
            counters,
            depth: subscription.qos().depth as u64,
            is_measured: system.measures_execution(),
            noted,
            rank,
            thread,
            awaited_ns: AtomicU64::new(0),
        }))
    }

    /// Whether no thread has waited for the endpoint.
    pub(crate) fn is_new(&self) -> bool {
        self.awaited_ns.load(Ordering::Relaxed) == 0
    }

    /// Records that a thread waits for the endpoint since `now_ns`.
    pub(crate) fn wait_for(&self, now_ns: u64) {
        // The first thread's time stays.
        let _ = self.awaited_ns.compare_exchange(0, now_ns, Ordering::Relaxed, Ordering::Relaxed);
    }

    /// Whether no thread had waited for the endpoint when a message was released, so that it waited for its program to spin: in no bound.
    pub(crate) fn is_early(&self, released_ns: u64) -> bool {
        released_ns < self.awaited_ns.load(Ordering::Relaxed)
    }

    /// Begins a job: this thread has taken a message that was released at `released_ns`, and runs the callback.
    ///
    /// # Real-time
    /// A load if nobody traces or measures; else as [`ForeignCallback::begin`], with one syscall more where overheads are measured or callbacks
    /// only traced.
    pub(crate) fn begin(self: &Arc<Self>, released_ns: u64, now_ns: u64) {
        if self.measured.is_none() && self.executor.is_none() && !tautline_trace::is_on() {
            return;
        }
        let released = (!self.is_early(released_ns)).then_some(released_ns);
        if let Some(measured) = &self.measured {
            let lost = self.counters.lost();
            let before = self.noted.fetch_max(lost, Ordering::Relaxed);
            let (lost, max_queue) = (lost.saturating_sub(before), self.counters.max_queue());
            // A timer that the executor may have run since its wait is no part of the job.
            if BEFORE.try_with(|before| before.get().is_over(now_ns)).unwrap_or(false) {
                foreign::idle();
            }
            measured.begin(released, QueueState { lost, max_queue, depth: self.depth });
        }
        if !self.is_measured && tautline_trace::is_on() {
            foreign::idle();
        }
        tautline_trace::callback_start(self.traced.id(), released_ns);
        // A thread in shutdown has no thread-locals.
        let before_ns = self.executor.as_ref().and_then(|_| Before::take(now_ns));
        let job = Job { jobs: self.clone(), released_ns: released, before_ns };
        let _ = RUNNING.try_with(|running| running.replace(Some(job)));
    }
}

impl Jobs {
    /// Ends this thread's job of the endpoint, which is being destroyed.
    pub(crate) fn close(self: &Arc<Self>) {
        let is_mine =
            |running: &Option<Job>| running.as_ref().is_some_and(|job| Arc::ptr_eq(&job.jobs, self));
        if RUNNING.try_with(|running| is_mine(&running.borrow())).unwrap_or(false) {
            end();
        }
    }
}

/// Ends this thread's job, because the thread takes or waits. Returns whether there was one.
///
/// # Real-time
/// A load if nothing runs; else as [`ForeignCallback::end`], with one syscall where callbacks are only traced.
pub(crate) fn end() -> bool {
    let running = RUNNING.try_with(|running| running.borrow_mut().take()).ok().flatten();
    let Some(Job { jobs, released_ns, before_ns }) = running else { return false };
    let used_ns = jobs.measured.as_ref().and_then(|measured| measured.end(released_ns));
    let is_wanted = jobs.executor.is_some() || tautline_trace::is_on();
    let used_ns = used_ns.or_else(|| is_wanted.then(foreign::idle));
    tautline_trace::callback_end(jobs.traced.id(), used_ns);
    if let (Some(executor), Some(used_ns), Some((in_vain_ns, before_ns))) =
        (&jobs.executor, used_ns, before_ns)
    {
        executor.record(in_vain_ns.saturating_add(before_ns), used_ns.saturating_sub(before_ns));
    }
    true
}

/// Ends this thread's job and begins a wait of at most `timeout_ns`, which is used only where callbacks are measured or traced.
///
/// # Real-time
/// As [`end`]; one syscall more where callbacks are measured, if none has run.
pub(crate) fn wait(waits: &SamplerObject, timeout_ns: Option<u64>, is_measured: bool) {
    let before = BEFORE.get();
    let in_vain_ns = if end() || !is_measured { 0 } else { foreign::wait() };
    let used_ns = if in_vain_ns == 0 || before.is_over(foreign::lap_ns()) { 0 } else { in_vain_ns };
    // Another clock reading would cost as much as the rest of this.
    let until = |now_ns: u64| timeout_ns.map(|timeout_ns| now_ns.saturating_add(timeout_ns));
    let limit_ns = if is_measured { until(foreign::lap_ns()) } else { None };
    BEFORE.set(Before { used_ns: before.used_ns.saturating_add(used_ns), limit_ns });
    if tautline_trace::is_on() {
        if IS_AWAKE.replace(false) {
            tautline_trace::spin_end(waits);
        }
        tautline_trace::spin_start(waits, until(monotonic_ns()));
    }
}

/// Ends a wait: something is ready, or it timed out.
///
/// # Real-time
/// Two loads if nobody traces; else an event.
pub(crate) fn wake(waits: &SamplerObject, is_ready: bool) {
    if is_ready {
        IS_AWAKE.set(tautline_trace::is_on());
        tautline_trace::spin_wake(waits);
    } else {
        tautline_trace::spin_timeout(waits);
    }
}
