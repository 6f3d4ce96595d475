// SPDX-License-Identifier: MIT OR Apache-2.0
//! The hot path: everything that runs on a real-time callback thread between two callbacks.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Wake, Waker, ready};
use std::time::Duration;

use futures::Stream;
use futures::task::AtomicWaker;
use tautline_rt::clock::{monotonic_ns, nanoseconds, thread_cpu_ns};
use tautline_rt::{BudgetTimer, Refill, RemainingBudget};
use tautline_trace::{Object, ObjectId};

use crate::account::CoreTimeAccount;
use crate::options::Watch;
use crate::stats::{self, CallbackStats, QueueState};

thread_local! {
    static CURRENT: RefCell<Option<CallbackThread>> = const { RefCell::new(None) };
}

/// The state of a callback thread that its streams can read.
pub(crate) struct CallbackThread {
    /// Records jobs; `None` in a group, which measures its members itself.
    pub measured: Option<Measured>,
    pub control: Arc<TaskControl>,
    pub busy: bool,
    pub parker: Option<Arc<dyn Parker>>,
    /// The queue state that a group's member found, until the group records it.
    pub queue: Cell<QueueState>,
    /// The input size that the running job has stated, until it ends.
    pub input_size: Cell<Option<u64>>,
    pub trace: Object,
    /// In a group: the trace id of the callback for the item that a stream has just yielded.
    pub announced: Cell<ObjectId>,
}

impl CallbackThread {
    fn address(&self) -> usize {
        Arc::as_ptr(&self.control).addr()
    }
}

pub(crate) struct Measured {
    pub stats: Arc<CallbackStats>,
    pub watch: Watch,
    /// `None` if execution times are not measured.
    pub stopwatch: Option<Stopwatch>,
    /// Whether the thread uses processor time while it waits for the next job.
    pub spins: bool,
    /// Enforces the jobs' budgets, if enabled.
    pub enforcer: Option<BudgetEnforcer>,
    /// Records the time taken from the core, if it is accounted for.
    pub account: Option<CoreTimeAccount>,
}

/// Enforces the budgets of jobs: see [`OverrunPolicy`](crate::OverrunPolicy).
pub(crate) struct BudgetEnforcer {
    timer: BudgetTimer,
    how: Enforcement,
    /// Jobs that have started and not ended: streams of one callback may overlap.
    running: Cell<u32>,
}

enum Enforcement {
    Demote {
        /// Ends the callback with a demoted job, if enabled.
        ends: Option<Arc<TaskControl>>,
        /// When the last demoted job ended: jobs released before that have waited for it.
        overran_until_ns: Cell<u64>,
    },
    Suspend {
        period: Duration,
        /// The rest of the last refill: from an overrun until a job is released that has not waited for the overrun.
        behind: Cell<Option<RemainingBudget>>,
    },
}

impl BudgetEnforcer {
    pub const fn demoting(timer: BudgetTimer, ends: Option<Arc<TaskControl>>) -> BudgetEnforcer {
        let how = Enforcement::Demote { ends, overran_until_ns: Cell::new(0) };
        BudgetEnforcer { timer, how, running: Cell::new(0) }
    }

    pub const fn suspending(timer: BudgetTimer, period: Duration) -> BudgetEnforcer {
        let how = Enforcement::Suspend { period, behind: Cell::new(None) };
        BudgetEnforcer { timer, how, running: Cell::new(0) }
    }

    /// Starts to enforce the budget of a job, which counts from the thread's processor time `since_ns`; the present one is `now_ns`. A job
    /// that has waited for a demoted job runs demoted, too: its release is past, so at the thread's priority no analysis counts it.
    pub fn begin(&self, release_ns: u64, since_ns: u64, now_ns: u64, budget: Option<Duration>) {
        let is_first = self.running.replace(self.running.get().saturating_add(1)) == 0;
        match &self.how {
            Enforcement::Demote { overran_until_ns, .. }
                if is_first && release_ns < overran_until_ns.get() =>
            {
                self.timer.demote();
            }
            Enforcement::Demote { .. } => {
                if let Some(budget) = budget {
                    self.timer.arm_late(since_ns, now_ns, budget);
                }
            }
            Enforcement::Suspend { period, behind } => {
                if let Some(budget) = budget.filter(|_| is_first) {
                    behind.set(behind.get().filter(|left| release_ns < left.refill_at_ns));
                    let (budget_ns, refill) = Self::refill(release_ns, budget, *period, behind.get());
                    self.timer.arm_refilled(since_ns, now_ns, budget_ns, refill);
                }
            }
        }
    }

    /// What is left of the budget, in ns, and its next refill. A release more than one period ago counts as one period ago: otherwise the
    /// job would get all refills since at once.
    fn refill(
        release_ns: u64,
        budget: Duration,
        period: Duration,
        left: Option<RemainingBudget>,
    ) -> (u64, Refill) {
        let (period_ns, now_ns) = (nanoseconds(period), monotonic_ns());
        let release_ns = release_ns.clamp(now_ns.saturating_sub(period_ns), now_ns);
        let own = RemainingBudget {
            budget_ns: nanoseconds(budget),
            refill_at_ns: release_ns.saturating_add(period_ns),
        };
        let RemainingBudget { budget_ns, refill_at_ns } = left.unwrap_or(own);
        (budget_ns, Refill { at_ns: refill_at_ns, period, budget })
    }

    /// Ends the enforcement for a job; returns whether it was demoted or suspended. Of overlapping jobs the last one returns it for all.
    pub fn end(&self) -> bool {
        self.running.set(self.running.get().saturating_sub(1));
        if self.running.get() > 0 {
            return false;
        }
        match &self.how {
            Enforcement::Demote { ends, overran_until_ns } => {
                // A callback that ends stays demoted, because it has no more jobs.
                let demoted = match ends {
                    Some(_) => self.timer.disarm_for_good(),
                    None => self.timer.disarm(),
                };
                if demoted {
                    overran_until_ns.set(monotonic_ns());
                    if let Some(control) = ends {
                        control.stop();
                    }
                }
                demoted
            }
            Enforcement::Suspend { behind, .. } => {
                let (suspended, left) = self.timer.disarm_refilled();
                behind.set((suspended || behind.get().is_some()).then_some(left));
                suspended
            }
        }
    }

    /// Whether the running job was suspended, because its budget was used up.
    fn has_slept(&self) -> bool {
        self.timer.was_suspended()
    }
}

/// Measures execution times on the thread that created it.
///
/// The thread's CPU clock costs a syscall, so it is read once per job, at its end: a job is charged the processor time since the end of
/// the previous job, which its callback and the executor used. It is not read if that job ended less than [`SHORT_NS`] ago: then the
/// thread was not preempted, and has used all the time that has passed. A busy poller uses the
/// processor all the time, but has it to itself: there the monotonic clock, which costs no syscall, is read at both ends.
pub(crate) struct Stopwatch {
    busy: bool,
    /// The end of the previous job; `None` before the first.
    since_ns: Cell<Option<u64>>,
    /// The end of the previous job on the monotonic clock. For a busy poller, `since_ns` is on that clock already.
    ended_ns: Cell<u64>,
    /// Jobs since the CPU clock was last read; limited, because the clocks differ in rate.
    unread: Cell<u32>,
}

/// Shorter than two context switches.
const SHORT_NS: u64 = 1000;
/// The CPU clock is read again after this many short jobs.
const SHORT_JOBS: u32 = 64;

impl Stopwatch {
    pub const fn new(busy: bool) -> Stopwatch {
        Stopwatch { busy, since_ns: Cell::new(None), ended_ns: Cell::new(0), unread: Cell::new(0) }
    }

    pub fn begin(&self) {
        if self.busy {
            self.since_ns.set(Some(monotonic_ns()));
        } else if self.since_ns.get().is_none() {
            self.since_ns.set(Some(thread_cpu_ns()));
        }
    }

    /// Returns the execution time of a job that ends at `now_ns` (monotonic). `is_exact`: the CPU clock is read even after a short job.
    pub fn lap(&self, now_ns: u64, is_exact: bool) -> u64 {
        let passed_ns = now_ns.saturating_sub(self.ended_ns.replace(now_ns));
        let is_short = !is_exact && passed_ns < SHORT_NS && self.unread.get() < SHORT_JOBS;
        let end_ns = match self.since_ns.get() {
            _ if self.busy => now_ns,
            Some(since_ns) if is_short => since_ns.saturating_add(passed_ns),
            _ => thread_cpu_ns(),
        };
        self.unread.set(if is_short { self.unread.get() + 1 } else { 0 });
        end_ns.saturating_sub(self.since_ns.replace(Some(end_ns)).unwrap_or(end_ns))
    }
}

impl Measured {
    /// Records the start of a job. `of`: the statistics of its callback, which are the thread's own or a group member's.
    fn begin(&self, release_ns: u64, of: &CallbackStats) -> StartedJob {
        self.stats.release(release_ns);
        if let Some(account) = &self.account {
            account.begin();
        }
        if let Some(stopwatch) = &self.stopwatch {
            stopwatch.begin();
            if let (Some(enforcer), Some(since_ns)) = (&self.enforcer, stopwatch.since_ns.get()) {
                let now_ns = if self.spins { thread_cpu_ns() } else { since_ns };
                // A group's budget is for the job of each member.
                let budget = of.budget().into_iter().chain(self.stats.budget()).min();
                enforcer.begin(release_ns, since_ns, now_ns, budget);
            }
        }
        StartedJob { release_ns }
    }

    /// Records the end of a job, now. `of` is as in `begin`.
    fn end(&self, begun: StartedJob, input_size: Option<u64>, of: &CallbackStats) -> stats::Job {
        let StartedJob { release_ns } = begun;
        let now_ns = monotonic_ns();
        let response_ns = now_ns.saturating_sub(release_ns);
        if let Some(account) = &self.account {
            let slept = self.enforcer.as_ref().is_some_and(BudgetEnforcer::has_slept);
            account.end(of, slept, of.is_late(response_ns).then_some((release_ns, now_ns)));
        }
        if self.enforcer.as_ref().is_some_and(BudgetEnforcer::end) {
            self.stats.demoted();
            if !std::ptr::eq(of, &*self.stats) {
                of.demoted();
            }
        }
        let is_exact = self.enforcer.is_some();
        let execution_ns = self.stopwatch.as_ref().map(|stopwatch| stopwatch.lap(now_ns, is_exact));
        stats::Job { release_ns, response_ns, execution_ns, input_size }
    }

    /// Ends a job that does not complete.
    fn abandon(&self) {
        if let Some(account) = &self.account {
            account.abandon();
        }
        let Some(enforcer) = &self.enforcer else { return };
        if enforcer.end() {
            self.stats.demoted();
        }
        // The next job's budget counts from here. Without budgets that job is charged what this one used, like everything between jobs.
        if let Some(stopwatch) = self.stopwatch.as_ref().filter(|_| enforcer.running.get() == 0) {
            stopwatch.lap(monotonic_ns(), true);
        }
    }

    /// Excludes the time of handlers, if one was called, from the next job's execution time.
    fn exclude_handlers(&self, told: bool) {
        if let (true, Some(stopwatch)) = (told, &self.stopwatch) {
            stopwatch.lap(monotonic_ns(), true);
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct StartedJob {
    release_ns: u64,
}

/// Makes the current thread a callback thread, before it turns real-time.
pub(crate) fn enter(thread: CallbackThread) {
    CURRENT.set(Some(thread));
}

/// Calls `ask` with the current callback thread; `None` on any other thread, and during thread shutdown.
fn current<R>(ask: impl FnOnce(&CallbackThread) -> R) -> Option<R> {
    CURRENT.try_with(|thread| thread.try_borrow().ok()?.as_ref().map(ask)).ok()?
}

/// The callback that a stream has announced since the last call.
fn announced() -> Option<ObjectId> {
    current(|thread| thread.announced.take()).filter(|callback| *callback != ObjectId::NONE)
}

/// Whether the current thread polls its callback in a loop. A stream then need not register a waker. If it is polled
/// through a combinator that polls only woken futures (`join_all`, `FuturesUnordered`), it calls
/// `cx.waker().wake_by_ref()` when it returns `Pending`.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn busy_polling() -> bool {
    current(|thread| thread.busy).unwrap_or(false)
}

/// Whether the current thread's callback has been requested to end. A stream that always has a next item, for
/// example under overload, never lets its callback wait. So it checks this and returns `Pending`; at that point
/// the callback ends.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn stop_requested() -> bool {
    // Acquire: pairs with the Release in `TaskControl::stop`.
    current(|thread| thread.control.stopped.load(Ordering::Acquire)).unwrap_or(false)
}

// ---- Running a future until it ends or is stopped ----

/// The state shared by a callback's thread and its handle.
#[derive(Default)]
pub(crate) struct TaskControl {
    started: AtomicBool,
    stopped: AtomicBool,
    waker: AtomicWaker,
}

impl TaskControl {
    /// Lets the future be polled.
    pub fn start(&self) {
        self.started.store(true, Ordering::Release);
        self.waker.wake();
    }

    /// Ends the future at its next poll, and wakes it for that poll.
    pub fn stop(&self) {
        self.stopped.store(true, Ordering::Release);
        self.waker.wake();
    }
}

/// How a callback thread sleeps if not only the executor's wakers can wake it: see
/// [`CallbackOptions::direct_wake`](crate::CallbackOptions::direct_wake).
pub trait Parker: Any + Send + Sync {
    /// Sleeps until [`unpark`](Self::unpark) has been called since the last return, after polling for that for `spin` without sleeping.
    /// Only the parker's own thread calls it.
    fn park(&self, spin: Duration);

    /// Wakes the thread if it sleeps; otherwise the thread checks again before it sleeps.
    fn unpark(&self);
}

struct ParkerWaker(Arc<dyn Parker>);

impl Wake for ParkerWaker {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.0.unpark();
    }
}

#[allow(clippy::disallowed_methods, reason = "set-up")]
pub(crate) fn waker_of(parker: &Arc<dyn Parker>) -> Waker {
    Waker::from(Arc::new(ParkerWaker(Arc::clone(parker))))
}

/// The parker on which the current thread sleeps, if it has one. Unparking it wakes the callback.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn parker() -> Option<Arc<dyn Parker>> {
    current(|thread| thread.parker.clone()).flatten()
}

/// Whether [`parker`] would return `known`.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn parks_on(known: Option<&Arc<dyn Parker>>) -> bool {
    let same = |here: Option<&Arc<dyn Parker>>| match (here, known) {
        (Some(here), Some(known)) => Arc::ptr_eq(here, known),
        (None, None) => true,
        _ => false,
    };
    current(|thread| same(thread.parker.as_ref())).unwrap_or(known.is_none())
}

/// How a callback thread waits for its future.
pub(crate) enum WaitMode {
    /// On a parker, after a spin.
    On(Arc<dyn Parker>, Waker, Duration),
    /// Not at all: it polls again at once.
    Busy,
}

/// A callback's future: held back until started, ended when stopped, polled again and again when busy.
pub(crate) struct Controlled {
    pub future: Pin<Box<dyn Future<Output = ()>>>,
    pub control: Arc<TaskControl>,
    pub waiting: WaitMode,
}

impl Drop for Controlled {
    /// Drops the thread's waker, although handles may keep the control.
    fn drop(&mut self) {
        drop(self.control.waker.take());
    }
}

impl Future for Controlled {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let Controlled { future, control, waiting } = &mut *self;
        // Registered before the flags are read, so that a later change wakes the task.
        control.waker.register(cx.waker());
        // Acquire: each pairs with the Release in `TaskControl`.
        if control.stopped.load(Ordering::Acquire) {
            return Poll::Ready(());
        }
        if !control.started.load(Ordering::Acquire) {
            return Poll::Pending;
        }
        // It loops here: a return to the pool would cost more than the poll, and the pool has no other task.
        match waiting {
            // No waker is needed, because the future is polled again in any case.
            WaitMode::Busy => loop {
                if future.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_ready()
                    || control.stopped.load(Ordering::Acquire)
                {
                    return Poll::Ready(());
                }
            },
            WaitMode::On(parker, waker, spin) => {
                control.waker.register(waker);
                let mut cx = Context::from_waker(waker);
                loop {
                    if control.stopped.load(Ordering::Acquire) || future.as_mut().poll(&mut cx).is_ready() {
                        return Poll::Ready(());
                    }
                    parker.park(*spin);
                }
            }
        }
    }
}

// ---- Measuring jobs ----

/// A job that has started: see [`job`](crate::job).
#[derive(Debug)]
#[must_use = "call finish() when the item has been dealt with"]
pub struct Job {
    begun: Option<StartedJob>,
    callback: ObjectId,
    /// The thread that began it, by the address of its control block.
    thread: usize,
}

/// Starts a job of the current thread's callback, released at the `CLOCK_MONOTONIC` time `release_ns`.
///
/// # Real-time
/// Wait-free; no allocation; no syscall, except one in a thread's first job, one where a budget is enforced for a thread that spins, and
/// three where core time is accounted for.
pub fn begin(release_ns: u64) -> Job {
    begin_for(current(|thread| thread.trace.id()).unwrap_or_default(), release_ns)
}

/// Like [`begin`], with the trace id of the stream's callback.
///
/// # Real-time
/// As [`begin`].
pub fn begin_for(callback: ObjectId, release_ns: u64) -> Job {
    let begun = current(|thread| {
        let begun = thread.measured.as_ref().map(|measured| measured.begin(release_ns, &measured.stats));
        if begun.is_none() {
            thread.announced.set(callback);
        }
        (begun, thread.address())
    });
    let (begun, thread) = begun.map_or((None, 0), |(begun, thread)| (Some(begun), thread));
    // A group begins a member's job at its turn.
    let callback = if matches!(begun, Some(None)) { ObjectId::NONE } else { callback };
    tautline_trace::callback_start(callback, release_ns);
    Job { begun: begun.flatten(), callback, thread }
}

impl Job {
    /// Ends the job and records its response and execution time. Call it on the thread that began the job: on another one it does not
    /// complete, and disturbs none of that thread's jobs.
    ///
    /// # Real-time
    /// Wait-free; no allocation; one syscall to read the CPU clock. None if execution times are not measured, if the thread busy-polls, or,
    /// where no budget is enforced, for up to 64 jobs in a row that each end less than 1 µs after the one before. If
    /// budgets are enforced by timers: one more, as many at the start of the job, and after an overrun another one at both; by the enforcer:
    /// at most a futex wake at the start. If core time is accounted
    /// for: three more. In addition, the cost of the handlers of [`CallbackOptions`](crate::CallbackOptions), if one is called.
    pub fn finish(mut self) {
        let begun = self.begun.take();
        let ended = |thread: &CallbackThread| {
            let to = thread.measured.as_ref().filter(|_| thread.address() == self.thread)?;
            Some(to.end(begun?, thread.input_size.take(), &to.stats))
        };
        let job = current(ended).flatten();
        tautline_trace::callback_end(self.callback, job.as_ref().and_then(|job| job.execution_ns));
        if let Some(job) = job {
            current(|thread| {
                if let Some(to) = &thread.measured {
                    to.exclude_handlers(to.watch.call_handlers(to.stats.complete(&job), &job));
                }
            });
        }
    }
}

impl Drop for Job {
    /// Its stream was dropped: the job does not complete, and neither its budget nor the account of core time goes on.
    fn drop(&mut self) {
        if self.begun.is_some() {
            current(|thread| {
                if let Some(measured) = thread.measured.as_ref().filter(|_| thread.address() == self.thread) {
                    thread.input_size.take();
                    measured.abandon();
                }
            });
        }
    }
}

/// States the size of the input of the job that runs on the current thread, in the unit with which its execution time grows: points, bytes,
/// tracks. Execution times are then kept by size, too ([`CallbackSnapshot::inputs`](crate::CallbackSnapshot::inputs)), and `taut report
/// --wcet` fits `wcet = a + b * size`.
///
/// The last call before the job's end counts. If jobs overlap on one thread, the size applies to the job that ends next. Outside of
/// callback threads, and if execution times are not measured, it does nothing.
///
/// # Real-time
/// Wait-free; no allocation; no syscall. The end of the job then checks at most 32 classes and 64 execution
/// times.
pub fn set_input_size(size: u64) {
    current(|thread| thread.input_size.set(Some(size)));
}

/// Adds the queue state that a stream found to the statistics of the current thread's callback.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn note_queue(queue: QueueState) {
    current(|thread| match &thread.measured {
        Some(measured) => measured.stats.note_queue(queue),
        None => {
            let before = thread.queue.get();
            thread.queue.set(QueueState { lost: before.lost.wrapping_add(queue.lost), ..queue });
        }
    });
}

// ---- Callback groups ----

/// An object of any type that is dropped with a group.
pub(crate) type GroupGuard = Box<dyn core::any::Any + Send>;

/// All members of a group, as one future. One poll runs at most one job, then yields to the stop flag.
pub(crate) struct GroupFuture {
    pub members: Box<[Box<dyn GroupMember>]>,
    pub running: Option<usize>,
    /// Counts the jobs of all members.
    pub total: Measured,
    pub _kept: Vec<GroupGuard>,
}

impl Future for GroupFuture {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let group = self.get_mut();
        let next = match group.running {
            Some(index) => index,
            None => match ready!(oldest(&mut group.members, cx)) {
                Some(index) => index,
                None => return Poll::Ready(()),
            },
        };
        // Only a job that has to wait is still running at the next poll.
        group.running = Some(next);
        if let Some(member) = group.members.get_mut(next) {
            ready!(member.run(&group.total, cx));
        }
        group.running = None;
        cx.waker().wake_by_ref();
        Poll::Pending
    }
}

/// Polls every member for its next item and returns the index of the one released first; among equals, of the one added first.
/// Pending: no item yet. `None`: all streams have ended.
fn oldest(members: &mut [Box<dyn GroupMember>], cx: &mut Context<'_>) -> Poll<Option<usize>> {
    let mut oldest: Option<(u64, usize)> = None;
    let mut waiting = false;
    for (index, member) in members.iter_mut().enumerate() {
        match member.look_ahead(cx) {
            Poll::Ready(Some(release_ns)) if oldest.is_none_or(|(least, _)| release_ns < least) => {
                oldest = Some((release_ns, index));
            }
            Poll::Ready(_) => {}
            Poll::Pending => waiting = true,
        }
    }
    match oldest {
        Some((_, index)) => Poll::Ready(Some(index)),
        None if waiting => Poll::Pending,
        None => Poll::Ready(None),
    }
}

/// A stream and its callback, with their types hidden.
pub(crate) trait GroupMember {
    /// The release of the next item, which is taken from the stream and kept; `None` after the last item.
    fn look_ahead(&mut self, cx: &mut Context<'_>) -> Poll<Option<u64>>;

    /// Runs the callback on the kept item, or continues it.
    fn run(&mut self, total: &Measured, cx: &mut Context<'_>) -> Poll<()>;
}

pub(crate) struct StreamMember<S: Stream, F, Fut> {
    pub stream: Pin<Box<S>>,
    pub ended: bool,
    pub release: fn(&S::Item) -> u64,
    pub callback: F,
    pub next: Option<S::Item>,
    /// The memory of the callback's future, allocated once and used for every job.
    pub future: Pin<Box<Option<Fut>>>,
    pub begun: Option<StartedJob>,
    pub stats: Arc<CallbackStats>,
    pub watch: Watch,
    /// The trace id of the callback, if the stream does not provide one.
    pub trace: Object,
    /// The trace id of the callback for the kept item.
    pub traced: ObjectId,
}

impl<S, F, Fut> GroupMember for StreamMember<S, F, Fut>
where
    S: Stream,
    F: FnMut(S::Item) -> Fut,
    Fut: Future<Output = ()>,
{
    fn look_ahead(&mut self, cx: &mut Context<'_>) -> Poll<Option<u64>> {
        if self.next.is_none() && !self.ended {
            let next = self.stream.as_mut().poll_next(cx);
            if let Some(queue) = current(|thread| thread.queue.take()) {
                self.stats.note_queue(queue);
            }
            self.next = ready!(next);
            self.ended = self.next.is_none();
            self.traced = announced().unwrap_or(self.trace.id());
        }
        Poll::Ready(self.next.as_ref().map(self.release))
    }

    fn run(&mut self, total: &Measured, cx: &mut Context<'_>) -> Poll<()> {
        if let Some(item) = self.next.take() {
            let release_ns = (self.release)(&item);
            self.stats.release(release_ns);
            // A size that a member's stream stated belongs to no job.
            current(|thread| thread.input_size.take());
            self.begun = Some(total.begin(release_ns, &self.stats));
            tautline_trace::callback_start(self.traced, release_ns);
            self.future.set(Some((self.callback)(item)));
        }
        if let Some(future) = self.future.as_mut().as_pin_mut() {
            ready!(future.poll(cx));
        }
        // Dropped before the clock is read: the drop of an item is part of its job.
        self.future.set(None);
        if let Some(begun) = self.begun.take() {
            let input_size = current(|thread| thread.input_size.take()).flatten();
            let job = total.end(begun, input_size, &self.stats);
            tautline_trace::callback_end(self.traced, job.execution_ns);
            let of_member = self.watch.call_handlers(self.stats.complete(&job), &job);
            // Input sizes of different members have different units.
            let of_all = stats::Job { input_size: None, ..job };
            let of_group = total.watch.call_handlers(total.stats.complete(&of_all), &job);
            total.exclude_handlers(of_member || of_group);
        }
        Poll::Ready(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_that_ends_soon_after_another_is_charged_what_has_passed() {
        let stopwatch = Stopwatch::new(false);
        stopwatch.begin();
        stopwatch.lap(0, true);
        assert_eq!(
            [10, 300, SHORT_NS + 299].map(|now_ns| stopwatch.lap(now_ns, false)),
            [10, 290, SHORT_NS - 1]
        );
        // What this thread has used is not known to the clock above.
        let second_ns = 1_000_000_000;
        assert!(stopwatch.lap(second_ns, false) < second_ns / 2, "longer: what it has used");
        assert!(stopwatch.lap(second_ns + 10, true) != 10, "as exactly as can be");
    }

    #[test]
    fn the_cpu_clock_is_read_now_and_then_in_a_row_of_short_jobs() {
        let stopwatch = Stopwatch::new(false);
        stopwatch.begin();
        stopwatch.lap(0, true);
        let unread = (1..=10 * u64::from(SHORT_JOBS)).map(|job| {
            stopwatch.lap(job * 10, false);
            stopwatch.unread.get()
        });
        assert_eq!(unread.filter(|unread| *unread == 0).count(), 9);
    }
}
