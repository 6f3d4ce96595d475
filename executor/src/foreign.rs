// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that other executors run, such as rclcpp's. Their jobs are measured like this crate's jobs.

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
}

impl ForeignCallback {
    /// These options are used: name, policy, cores, period, deadline, budget, bound, and whether the execution time is measured.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The system's error for the file.
    pub fn new(file: &StatisticsFile, options: &CallbackOptions) -> io::Result<ForeignCallback> {
        let stats = CallbackStats::new(&*options.name);
        stats.set_deadline(options.effective_deadline());
        stats.set_budget(options.budget);
        stats.set_bound(options.bound);
        stats.place(Some(file), kind::CALLBACK)?;
        stats.describe_jobs(options.period, options.execution_time);
        if options.policy.realtime_priority().is_some() {
            // What its thread is to be: admission counts it from here on. The first job says what it is.
            let cores = options.cores.map_or_else(current_affinity, Ok).map_err(io::Error::other)?;
            stats.set_thread(&ThreadInfo { tid: 0, name: String::new(), policy: options.policy, cores });
        }
        Ok(ForeignCallback { stats: PiMutex::new(stats), measures_execution: options.execution_time })
    }

    /// Starts a job of the callback in this thread, released at the `CLOCK_MONOTONIC` time `release_ns`.
    ///
    /// # Real-time
    /// Waits for a thread that starts or ends a job of it at the same time, with priority inheritance; no allocation; four syscalls
    /// if another thread ran the previous job, one in a thread's first job, and one more in each of these cases where the execution
    /// time is measured.
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

    /// Ends the job. If its execution time is measured, the job is charged this thread's processor time since the end of the previous
    /// job, or since [`idle`].
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), with one syscall where the execution time is measured.
    pub fn end(&self, release_ns: u64) {
        let response_ns = monotonic_ns().saturating_sub(release_ns);
        let execution_ns = self.measures_execution.then(|| STOPWATCH.with(Stopwatch::lap));
        self.stats.lock().complete(&Job { release_ns, response_ns, execution_ns, input_size: None });
    }

    /// Records the state of its queue.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), without syscalls.
    pub fn note_queue(&self, queue: QueueState) {
        self.stats.lock().note_queue(queue);
    }
}

/// Call when this thread starts to wait: the processor time used since its last job is charged to no job.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn idle() {
    STOPWATCH.with(Stopwatch::lap);
}
