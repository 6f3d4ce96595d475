// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that other executors run, such as rclcpp's: their jobs are measured as this crate's are.

use std::io;

use tautline_rt::clock::monotonic_ns;
use tautline_rt::{PiMutex, ThreadInfo, current_affinity, current_policy, current_tid};

use crate::hot::Stopwatch;
use crate::job::QueueState;
use crate::stats::{Job, kind};
use crate::{CallbackOptions, CallbackStats, StatisticsFile};

thread_local! {
    static TID: u32 = current_tid();
    static STOPWATCH: Stopwatch = const { Stopwatch::new(false) };
}

/// A callback whose thread is not this crate's. Whoever knows when its jobs begin and end says so, in the thread that runs them.
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
    /// Several threads may run it, and each counter has one writer at a time.
    stats: PiMutex<CallbackStats>,
    measures_execution: bool,
}

impl ForeignCallback {
    /// Of the options, the name, the period, the deadline, the budget, the bound and whether the execution time is measured are used.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// What the system said of the file.
    pub fn new(file: &StatisticsFile, options: &CallbackOptions) -> io::Result<ForeignCallback> {
        let stats = CallbackStats::new(&*options.name);
        stats.set_deadline(options.effective_deadline());
        stats.set_budget(options.budget);
        stats.set_bound(options.bound);
        stats.place(Some(file), kind::CALLBACK)?;
        stats.describe_jobs(options.period, options.execution_time);
        Ok(ForeignCallback { stats: PiMutex::new(stats), measures_execution: options.execution_time })
    }

    /// A job of it begins in this thread, that was released at `release_ns` of `CLOCK_MONOTONIC`.
    ///
    /// # Real-time
    /// Waits for another thread that begins or ends a job of it right now, and lends it this one's priority; no allocation;
    /// four syscalls when another thread ran the job before, one in a thread's first, and one more there where the execution time is
    /// measured.
    pub fn begin(&self, release_ns: u64) {
        let stats = self.stats.lock();
        let tid = TID.with(|tid| *tid);
        if stats.tid() != tid
            && let (Ok(policy), Ok(cores)) = (current_policy(), current_affinity())
        {
            stats.set_thread(&ThreadInfo { tid, name: String::new(), policy, cores });
        }
        stats.release(release_ns);
        if self.measures_execution {
            STOPWATCH.with(Stopwatch::begin);
        }
    }

    /// The job ends. It is charged the processor time of this thread since the end of the job before, or since [`idle`], if its execution
    /// time is measured.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), with one syscall where the execution time is measured.
    pub fn end(&self, release_ns: u64) {
        let response_ns = monotonic_ns().saturating_sub(release_ns);
        let execution_ns = self.measures_execution.then(|| STOPWATCH.with(Stopwatch::lap));
        self.stats.lock().complete(&Job { release_ns, response_ns, execution_ns, input_size: None });
    }

    /// What its queue was found to be.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), without syscalls.
    pub fn note_queue(&self, queue: QueueState) {
        self.stats.lock().note_queue(queue);
    }
}

/// What this thread has used since its last job is no job's: it begins to wait.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn idle() {
    STOPWATCH.with(Stopwatch::lap);
}
