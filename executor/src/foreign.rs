// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks that other executors run, such as rclcpp's. Their jobs are measured like this crate's jobs.

use std::cell::{Cell, OnceCell, RefCell};
use std::io;
use std::sync::Arc;
use std::time::Duration;

use tautline_rt::clock::{monotonic_ns, nanoseconds, thread_cpu_ns};
use tautline_rt::fork::ProcessMark;
use tautline_rt::{
    BudgetTimer, CoreTime, OwnPriority, PiMutex, RtError, ThreadInfo, current_affinity, current_policy,
    current_tid,
};

use crate::account::CoreTimeAccount;
use crate::hot::BudgetEnforcer;
use crate::job::QueueState;
use crate::stats::{Job, kind};
use crate::{CallbackOptions, CallbackStats, OverrunPolicy, Policy, StatisticsFile};

thread_local! {
    /// The thread's id, and the process in which it was read: in a forked child the thread has another id.
    static TID: Cell<Option<(ProcessMark, u32)>> = const { Cell::new(None) };
    static METER: Meter = const { Meter { read: Cell::new(None), lap_ns: Cell::new(0), is_exact: Cell::new(false) } };
    static ENFORCER: RefCell<Option<BudgetEnforcer>> = const { RefCell::new(None) };
    /// Made by the first job of a callback that accounts for core time; `None` if the kernel refused.
    static ACCOUNT: OnceCell<Option<CoreTimeAccount>> = const { OnceCell::new() };
}

/// For this long after a reading of a thread's processor time, jobs are measured by `CLOCK_MONOTONIC`, which needs no system call. A
/// wake-up takes longer, so only jobs in a row are measured in this way.
const WINDOW: Duration = Duration::from_micros(5);

/// The distance between the first two releases is not recorded: a timer that was due before its executor began to spin is late then, and so
/// is everything that it triggers.
const UNEVEN: u64 = 2;

/// Measures the processor time of a thread's jobs: never too low, and too high by at most [`WINDOW`], if the thread lost the core.
struct Meter {
    /// The last reading: the processor time, and `CLOCK_MONOTONIC`.
    read: Cell<Option<(u64, u64)>>,
    /// When the last job ended, by `CLOCK_MONOTONIC`.
    lap_ns: Cell<u64>,
    /// Whether each job reads the processor time.
    is_exact: Cell<bool>,
}

impl Meter {
    /// The processor time at the last reading: the end of the last job, if measurement is exact. `None` before the first reading.
    fn since_ns(&self) -> Option<u64> {
        self.read.get().map(|(used_ns, _)| used_ns)
    }

    /// Takes the first reading, at the start of the thread's first job.
    fn begin(&self) {
        if self.read.get().is_none() {
            self.lap(monotonic_ns());
        }
    }

    /// Returns the processor time used since the end of the last job.
    fn lap(&self, now_ns: u64) -> u64 {
        let elapsed_ns = now_ns.saturating_sub(self.lap_ns.replace(now_ns));
        let before = self.read.get();
        let is_near = |read_ns| now_ns.saturating_sub(read_ns) < WINDOW.as_nanos() as u64;
        if !self.is_exact.get() && before.is_some_and(|(_, read_ns)| is_near(read_ns)) {
            return elapsed_ns;
        }
        let used_ns = thread_cpu_ns();
        self.read.set(Some((used_ns, now_ns)));
        let Some((before_ns, _)) = before else { return 0 };
        let used_ns = used_ns.saturating_sub(before_ns);
        // The difference includes the preceding jobs that were measured without a reading.
        if self.is_exact.get() { used_ns } else { used_ns.min(elapsed_ns) }
    }
}

/// Enforces the budgets of callbacks with [`OverrunPolicy::Demote`] in this thread from now on, if `holds`. `policy` is the thread's
/// policy, which was set with [`set_own_priority`](tautline_rt::set_own_priority), and is restored after a demotion.
///
/// # Real-time
/// Setup only.
///
/// # Errors
/// Those of [`BudgetTimer::new`].
pub fn hold_to_budgets(policy: Policy, holds: bool) -> Result<(), RtError> {
    ENFORCER.with(|enforcer| {
        // Dropped before the new timer is created: a thread has at most one.
        let former = enforcer.take();
        let holds = holds || former.is_some();
        drop(former);
        if holds {
            let timer = BudgetTimer::new(Arc::new(OwnPriority::with_ordinary_children(policy)))?;
            enforcer.replace(Some(BudgetEnforcer::demoting(timer, None)));
            // Budgets count from the end of the last job.
            METER.with(|meter| {
                meter.is_exact.set(true);
                meter.lap(monotonic_ns())
            });
        }
        Ok(())
    })
}

/// A callback whose thread does not belong to this crate. The code that knows when its jobs start and end calls these functions,
/// in the thread that runs the jobs.
///
/// ```
/// use tautline_executor::{CallbackOptions, ForeignCallback, ForeignStatistics, ProcessInfo, StatisticsFile, foreign, job::QueueState};
///
/// let prefix = format!("taut_doc_{}_", std::process::id());
/// let file = StatisticsFile::create(&prefix, &ProcessInfo::default())?;
/// let callback = ForeignCallback::new(&file, &CallbackOptions::other().name("detect"))?;
/// foreign::idle(); // before the thread waits
/// callback.begin(Some(0), QueueState::default()); // the release, in ns of CLOCK_MONOTONIC
/// callback.end(Some(0));
/// let process = &ForeignStatistics::list(&prefix)?[0];
/// assert_eq!(process.read()?.unwrap().callbacks[0].completions, 1);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct ForeignCallback {
    /// Several threads may run it, but each counter may have only one writer at a time.
    stats: PiMutex<CallbackStats>,
    measures_execution: bool,
    /// Whether the budgets of its jobs are enforced.
    holds: bool,
    /// The shortest time taken from a job that is recorded, if core time is accounted for.
    accounts_ns: Option<u64>,
    process: ProcessMark,
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

    /// As [`new`](Self::new), for a callback of which only the publications are observed: each [`publish`](Self::publish) counts as a job.
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
        stats.set_limits(options);
        stats.place(Some(file), kind)?;
        stats.describe_jobs(options.period, options.execution_time);
        if options.policy.realtime_priority().is_some() {
            // The intended policy and cores, so that admission counts the callback from now on. The first job records the actual thread.
            let cores = options.cores.map_or_else(current_affinity, Ok).map_err(io::Error::other)?;
            stats.set_thread(&ThreadInfo { tid: 0, name: String::new(), policy: options.policy, cores });
        }
        let holds = options.execution_time && options.overrun_policy == OverrunPolicy::Demote;
        let (stats, measures_execution) = (PiMutex::new(stats), options.execution_time);
        let process = ProcessMark::new();
        Ok(ForeignCallback { stats, measures_execution, holds, accounts_ns: None, process })
    }

    /// As [`Executor::account_core_time`](crate::Executor::account_core_time), for the callback's jobs in any thread.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// The kernel does not provide the data.
    pub fn account_core_time(mut self, least: Option<Duration>) -> io::Result<ForeignCallback> {
        if least.is_some() {
            CoreTime::new().map_err(io::Error::other)?;
            self.stats.lock().describe_account();
        }
        self.accounts_ns = least.map(nanoseconds);
        Ok(self)
    }

    /// Starts a job of the callback in this thread, released at the `CLOCK_MONOTONIC` time `release_ns`, and records the state of its queue.
    /// Without that time the job is neither counted nor late: only its processor time is recorded, and held to its budget.
    ///
    /// # Real-time
    /// Waits for a thread that starts or ends a job of it at the same time, with priority inheritance; no allocation; four syscalls
    /// if another thread ran the previous job, one in a thread's first job, one more in each of these cases where the execution
    /// time is measured, at most three where it is held to its budget, and three where core time is accounted for, five in a thread's first job.
    pub fn begin(&self, release_ns: Option<u64>, queue: QueueState) {
        self.with_account(CoreTimeAccount::begin);
        let stats = self.stats.lock();
        note_thread(&stats, self.process);
        if let Some(release_ns) = release_ns {
            stats.note_queue(queue);
            stats.release_after(UNEVEN, release_ns);
        }
        if self.measures_execution {
            METER.with(Meter::begin);
        }
        if self.holds {
            // A take, and whatever else the thread has done since it waited, may have used much of the budget.
            let now_ns = thread_cpu_ns();
            let since_ns = METER.with(Meter::since_ns).unwrap_or(now_ns);
            let release_ns = release_ns.unwrap_or(u64::MAX);
            with_enforcer(|enforcer| enforcer.begin(release_ns, since_ns, now_ns, stats.budget()));
        }
    }

    /// Ends the job that began with this release. If its execution time is measured, the job is charged this thread's processor time since
    /// the end of the previous job, or since [`idle`]; this time is returned. It is never too low, and at most 5 µs too high if the thread
    /// lost the core soon after a job before; exact where budgets are held or [`used_ns`] was called.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin), with at most one syscall where the execution time is measured.
    pub fn end(&self, release_ns: Option<u64>) -> Option<u64> {
        let now_ns = monotonic_ns();
        let is_demoted = self.holds && with_enforcer(BudgetEnforcer::end) == Some(true);
        let execution_ns = self.measures_execution.then(|| METER.with(|meter| meter.lap(now_ns)));
        let stats = self.stats.lock();
        let job = release_ns.map(|release_ns| (release_ns, now_ns.saturating_sub(release_ns)));
        let late = job.filter(|(_, response_ns)| stats.is_late(*response_ns));
        self.with_account(|account| {
            account.end(&stats, false, late.map(|(release_ns, _)| (release_ns, now_ns)))
        });
        if is_demoted {
            stats.demoted();
        }
        if let Some((release_ns, response_ns)) = job {
            stats.complete(&Job { release_ns, response_ns, execution_ns, input_size: None });
        } else if let Some(execution_ns) = execution_ns {
            stats.execution().record(execution_ns);
        }
        execution_ns
    }

    fn with_account(&self, using: impl FnOnce(&CoreTimeAccount)) {
        let Some(least_ns) = self.accounts_ns else { return };
        let make = || CoreTime::new().ok().map(|clock| CoreTimeAccount::new(clock, least_ns));
        // A thread in shutdown has no thread-locals.
        let _ = ACCOUNT.try_with(|account| account.get_or_init(make).as_ref().map(using));
    }

    /// Records that the callback published in this thread, at the `CLOCK_MONOTONIC` time `now_ns`.
    ///
    /// # Real-time
    /// As [`begin`](Self::begin) where the execution time is not measured.
    pub fn publish(&self, now_ns: u64) {
        let stats = self.stats.lock();
        note_thread(&stats, self.process);
        stats.publish(UNEVEN, now_ns);
    }
}

/// This thread's id, in the process of the callback.
fn own_tid(process: ProcessMark) -> u32 {
    match TID.get() {
        Some((of, tid)) if of == process => tid,
        _ => {
            let tid = current_tid();
            TID.set(Some((process, tid)));
            tid
        }
    }
}

/// Records that this thread runs the callback, if another one did before.
fn note_thread(stats: &CallbackStats, process: ProcessMark) {
    let tid = own_tid(process);
    if stats.tid() != tid
        && let (Ok(policy), Ok(cores)) = (current_policy(), current_affinity())
    {
        stats.set_thread(&ThreadInfo { tid, name: String::new(), policy, cores });
    }
}

/// Calls `using` with this thread's enforcer; `None` in a thread that enforces no budgets.
fn with_enforcer<R>(using: impl FnOnce(&BudgetEnforcer) -> R) -> Option<R> {
    ENFORCER.try_with(|enforcer| enforcer.try_borrow().ok()?.as_ref().map(using)).ok()?
}

/// Call when this thread starts to wait: the processor time used since its last job is charged to no job. It is returned.
///
/// # Real-time
/// Wait-free; no allocation; at most one syscall.
pub fn idle() -> u64 {
    METER.with(|meter| meter.lap(monotonic_ns()))
}

/// As [`idle`], in a thread that really begins to wait. Where core time is accounted for, the processor time used until now is not part of
/// the next job's wait for the core.
///
/// # Real-time
/// As [`idle`]; three syscalls more where core time is accounted for.
pub fn wait() -> u64 {
    // A thread in shutdown has no thread-locals.
    let _ = ACCOUNT.try_with(|account| account.get().and_then(Option::as_ref).map(CoreTimeAccount::pause));
    idle()
}

/// When this thread's last measured job ended, or [`idle`] was called, on `CLOCK_MONOTONIC`; 0 before.
///
/// # Real-time
/// Wait-free; no allocation; no syscall.
pub fn lap_ns() -> u64 {
    METER.with(|meter| meter.lap_ns.get())
}

/// The processor time that this thread has used since its last job, or since [`idle`]; `None` before the first of these. From the first call
/// on, jobs of this thread are measured exactly, with one syscall each.
///
/// # Real-time
/// Wait-free; no allocation; one syscall.
pub fn used_ns() -> Option<u64> {
    METER.with(|meter| {
        meter.is_exact.set(true);
        Some(thread_cpu_ns().saturating_sub(meter.since_ns()?))
    })
}

/// The processor time that another library's executors use in this process's threads for each callback.
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

    /// Records a callback that has ended. The thread used `before_ns` for it until its message was taken, and `after_ns` from then on.
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

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_rt::clock::burn_cpu;

    /// Jobs in a row and longer ones: each is between what it used for certain, and at most a window more than it may have used.
    #[test]
    fn a_job_is_measured_not_too_low_and_hardly_too_high() {
        idle();
        // Where a virtual machine stood still, its clocks disagree for a moment.
        let mut too_high = Vec::new();
        let mut since_ns = thread_cpu_ns();
        for n in 0..20_000 {
            let begun_ns = thread_cpu_ns();
            if n % 100 == 0 {
                burn_cpu(Duration::from_micros(20));
            }
            let done_ns = thread_cpu_ns();
            let measured_ns = idle();
            let now_ns = thread_cpu_ns();
            let most_ns = now_ns - since_ns + WINDOW.as_nanos() as u64;
            // The clocks may differ by a thousandth.
            let least_ns = (done_ns - begun_ns) - (done_ns - begun_ns) / 1_000;
            assert!(least_ns <= measured_ns, "{least_ns} {measured_ns} {most_ns}");
            if measured_ns > most_ns {
                too_high.push((measured_ns, most_ns));
            }
            since_ns = done_ns;
        }
        assert!(too_high.len() <= 2, "{too_high:?}");
    }

    /// What came before anyone waited is no job, and the first job may have come late.
    #[test]
    fn the_start_of_an_executor_does_not_count() {
        let prefix = format!("taut_test_uneven_{}_", std::process::id());
        let file = StatisticsFile::create(&prefix, &crate::ProcessInfo::of_this()).unwrap();
        let options = CallbackOptions::other().name("detect");
        let callback = ForeignCallback::new(&file, &options).unwrap();
        let timer = ForeignCallback::by_publications(&file, &options.name("tick")).unwrap();
        let lost = QueueState { lost: 1, ..QueueState::default() };
        for release_ns in [None, Some(1_000), Some(1_010), Some(1_110), Some(1_200)] {
            callback.begin(release_ns, lost);
            callback.end(release_ns);
            release_ns.iter().for_each(|now_ns| timer.publish(*now_ns));
        }
        let seen = &crate::ForeignStatistics::list(&prefix).unwrap()[0].read().unwrap().unwrap().callbacks;
        for of in seen {
            assert_eq!((of.releases, of.completions, of.first_release_ns), (4, 4, 1_000), "{of:?}");
            assert_eq!(of.response.n(), 4 * u64::from(of.execution.n() > 0), "{of:?}");
            assert_eq!((of.least_distance_ns, of.greatest_distance_ns), (Some(90), Some(100)), "{of:?}");
        }
        assert_eq!((seen[0].lost, seen[1].lost), (4, 0));
        assert_eq!((seen[0].execution.n(), seen[1].execution.n()), (5, 0), "its processor time is known");
    }
}
