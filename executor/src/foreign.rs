// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that other executors run, such as rclcpp's. Their jobs are measured like this crate's jobs.

use std::cell::RefCell;
use std::io;
use std::sync::Arc;

use tautline_rt::clock::{monotonic_ns, thread_cpu_ns};
use tautline_rt::{
    BudgetTimer, OwnPriority, PiMutex, RtError, ThreadInfo, current_affinity, current_policy, current_tid,
};

use crate::hot::{BudgetEnforcer, Stopwatch};
use crate::job::QueueState;
use crate::stats::{Job, kind};
use crate::{CallbackOptions, CallbackStats, OverrunPolicy, Policy, StatisticsFile};

thread_local! {
    static TID: u32 = current_tid();
    static STOPWATCH: Stopwatch = const { Stopwatch::new(false) };
    static ENFORCER: RefCell<Option<BudgetEnforcer>> = const { RefCell::new(None) };
}

/// Holds jobs of callbacks with [`OverrunPolicy::Demote`] to their budgets in this thread from now on, if `holds`. `policy` is the thread's,
/// which it got with [`set_own_priority`](tautline_rt::set_own_priority), and gets back after a demotion.
///
/// # Real-time
/// Setup only.
///
/// # Errors
/// Those of [`BudgetTimer::new`].
pub fn hold_to_budgets(policy: Policy, holds: bool) -> Result<(), RtError> {
    ENFORCER.with(|enforcer| {
        // Before the new one: a thread has at most one timer.
        let former = enforcer.take();
        let holds = holds || former.is_some();
        drop(former);
        if holds {
            let timer = BudgetTimer::new(Arc::new(OwnPriority::with_ordinary_children(policy)))?;
            enforcer.replace(Some(BudgetEnforcer::demoting(timer, None)));
        }
        Ok(())
    })
}

/// A callback whose thread does not belong to this crate. The code that knows when its jobs start and end calls these functions,
/// in the thread that runs the jobs.
///
/// ```
/// use tautline_executor::{CallbackOptions, ForeignCallback, ForeignStatistics, ProcessInfo, StatisticsFile, foreign};
///
/// let prefix = format!("taut_doc_{}_", std::process::id());
/// let file = StatisticsFile::create(&prefix, &ProcessInfo::default())?;
/// let callback = ForeignCallback::new(&file, &CallbackOptions::other().name("detect"))?;
/// foreign::idle(); // before the thread waits
/// callback.begin(0); // the release, in ns of CLOCK_MONOTONIC
/// callback.end(0);
/// let process = &ForeignStatistics::list(&prefix)?[0];
/// assert_eq!(process.read()?.unwrap().callbacks[0].completions, 1);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct ForeignCallback {
    /// Several threads may run it, but each counter may have only one writer at a time.
    stats: PiMutex<CallbackStats>,
    measures_execution: bool,
    /// Whether its jobs are held to their budgets.
    holds: bool,
}

impl ForeignCallback {
    /// These options are used: name, policy, cores, period, deadline, budget, bound, overrun policy (only [`OverrunPolicy::Demote`] is
    /// enforced), and whether the execution time is measured.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error for the file.
    pub fn new(file: &StatisticsFile, options: &CallbackOptions) -> io::Result<ForeignCallback> {
        Self::of_kind(file, options, kind::CALLBACK)
    }

    /// As [`new`](Self::new) for a callback of which only its publications are seen: [`publish`](Self::publish) is its only job.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn by_publications(file: &StatisticsFile, options: &CallbackOptions) -> io::Result<ForeignCallback> {
        Self::of_kind(file, options, kind::PUBLICATIONS)
    }

    fn of_kind(file: &StatisticsFile, options: &CallbackOptions, kind: u64) -> io::Result<ForeignCallback> {
        let stats = CallbackStats::new(&*options.name);
        stats.set_deadline(options.effective_deadline());
        stats.set_budget(options.budget);
        stats.set_bound(options.bound);
        stats.place(Some(file), kind)?;
        stats.describe_jobs(options.period, options.execution_time);
        if options.policy.realtime_priority().is_some() {
            // What its thread is to be: admission counts it from here on. The first job says what it is.
            let cores = options.cores.map_or_else(current_affinity, Ok).map_err(io::Error::other)?;
            stats.set_thread(&ThreadInfo { tid: 0, name: String::new(), policy: options.policy, cores });
        }
        let holds = options.execution_time && options.overrun_policy == OverrunPolicy::Demote;
        Ok(ForeignCallback { stats: PiMutex::new(stats), measures_execution: options.execution_time, holds })
    }

    /// Starts a job of the callback in this thread, released at the `CLOCK_MONOTONIC` time `release_ns`.
    ///
    /// # Real-time
    /// Waits for a thread that starts or ends a job of it at the same time, with priority inheritance; no allocation; four syscalls
    /// if another thread ran the previous job, one in a thread's first job, one more in each of these cases where the execution
    /// time is measured, and at most two where it is held to its budget.
    pub fn begin(&self, release_ns: u64) {
        let stats = self.stats.lock();
        note_thread(&stats);
        stats.release(release_ns);
        if self.measures_execution {
            STOPWATCH.with(Stopwatch::begin);
        }
        if self.holds {
            let since_ns = STOPWATCH.with(Stopwatch::since_ns).unwrap_or_else(thread_cpu_ns);
            with_enforcer(|enforcer| enforcer.begin(release_ns, since_ns, stats.budget()));
        }
    }

    /// Ends the job. If its execution time is measured, the job is charged this thread's processor time since the end of the previous
    /// job, or since [`idle`]; this time is returned.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), with one syscall where the execution time is measured.
    pub fn end(&self, release_ns: u64) -> Option<u64> {
        let response_ns = monotonic_ns().saturating_sub(release_ns);
        if self.holds && with_enforcer(BudgetEnforcer::end) == Some(true) {
            self.stats.lock().demoted();
        }
        let execution_ns = self.measures_execution.then(|| STOPWATCH.with(Stopwatch::lap));
        self.stats.lock().complete(&Job { release_ns, response_ns, execution_ns, input_size: None });
        execution_ns
    }

    /// It published in this thread, at the `CLOCK_MONOTONIC` time `now_ns`.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin) where the execution time is not measured.
    pub fn publish(&self, now_ns: u64) {
        let stats = self.stats.lock();
        note_thread(&stats);
        stats.publish(now_ns);
    }

    /// Records the state of its queue.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), without syscalls.
    pub fn note_queue(&self, queue: QueueState) {
        self.stats.lock().note_queue(queue);
    }
}

/// Records that this thread runs the callback, if another one did before.
fn note_thread(stats: &CallbackStats) {
    let tid = TID.with(|tid| *tid);
    if stats.tid() != tid
        && let (Ok(policy), Ok(cores)) = (current_policy(), current_affinity())
    {
        stats.set_thread(&ThreadInfo { tid, name: String::new(), policy, cores });
    }
}

/// `None` in a thread that holds nothing to a budget.
fn with_enforcer<R>(using: impl FnOnce(&BudgetEnforcer) -> R) -> Option<R> {
    ENFORCER.try_with(|enforcer| enforcer.try_borrow().ok()?.as_ref().map(using)).ok()?
}

/// Call when this thread starts to wait: the processor time used since its last job is charged to no job. It is returned.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn idle() -> u64 {
    STOPWATCH.with(Stopwatch::lap)
}

/// The processor time that this thread has used since its last job, or since [`idle`]; `None` before the first of these.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn used_ns() -> Option<u64> {
    STOPWATCH.with(|stopwatch| Some(thread_cpu_ns().saturating_sub(stopwatch.since_ns()?)))
}

/// What the executors of another library use in this process's threads for each callback.
#[derive(Debug)]
pub struct ForeignExecutor {
    /// Each counter may have only one writer at a time.
    stats: PiMutex<CallbackStats>,
    is_alone: bool,
}

impl ForeignExecutor {
    /// `is_alone`: the callbacks do nothing, so that everything is overhead.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error for the file.
    pub fn new(file: &StatisticsFile, library: &str, is_alone: bool) -> io::Result<ForeignExecutor> {
        let stats = CallbackStats::new(library);
        stats.place(Some(file), if is_alone { kind::EXECUTOR_ALONE } else { kind::EXECUTOR })?;
        Ok(ForeignExecutor { stats: PiMutex::new(stats), is_alone })
    }

    /// A callback has ended. The thread used `before_ns` for it until its message was taken, and `after_ns` from then on.
    ///
    /// # Real-time
    /// Waits for a thread in it, with priority inheritance; no allocation; no syscall.
    pub fn record(&self, before_ns: u64, after_ns: u64) {
        let (overhead_ns, response_ns) =
            if self.is_alone { (before_ns.saturating_add(after_ns), 0) } else { (before_ns, after_ns) };
        let execution_ns = Some(overhead_ns);
        self.stats.lock().complete(&Job { release_ns: 0, response_ns, execution_ns, input_size: None });
    }
}
