// SPDX-License-Identifier: MIT OR Apache-2.0
//! The options of a callback thread.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use tautline_rt::clock::nanoseconds;
use tautline_rt::{CoreSet, Policy, ThreadBuilder};

/// The settings of a callback thread: plain data, checked when the callback is spawned.
///
/// ```
/// use tautline_executor::CallbackOptions;
/// use std::time::Duration;
///
/// let options = CallbackOptions::fifo(20).core(1).name("/odom").period(Duration::from_millis(10));
/// assert_eq!(options.effective_deadline(), Some(Duration::from_millis(10)));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
#[must_use = "hand it to Executor::spawn_callback"]
pub struct CallbackOptions {
    /// Usually the topic. The thread is named `cb:<name>`, shortened to 15 bytes. Empty: the callback's number.
    pub name: String,
    /// The thread's name instead of the callback's, such as that of its group.
    pub thread_name: Option<String>,
    /// How the thread is scheduled.
    pub policy: Policy,
    /// The cores that it may use; `None`: those of the thread that spawns it, or any core if it has a
    /// reservation.
    pub cores: Option<CoreSet>,
    /// The size of its stack, which is touched before the thread becomes real-time.
    pub stack_bytes: usize,
    /// The shortest time between two releases: the deadline's default, and the refill period of [`OverrunPolicy::Suspend`].
    pub period: Option<Duration>,
    /// A job whose response takes longer than this misses its deadline. `None`: the period.
    pub deadline: Option<Duration>,
    /// The CPU time that a job may use: see [`CallbackOptions::budget`].
    pub budget: Option<Duration>,
    /// Jobs with longer responses are recorded with their times: see [`CallbackOptions::bound`].
    pub bound: Option<Duration>,
    /// What happens to a job that uses more than its budget.
    pub overrun_policy: OverrunPolicy,
    /// The handlers for a job that used more than its budget, and for a job that missed its deadline.
    pub watch: Watch,
    /// Poll all the time instead of parking: see [`CallbackOptions::busy_poll`].
    pub busy_poll: bool,
    /// Let publishers wake the thread: see [`CallbackOptions::direct_wake`].
    pub direct_wake: bool,
    /// Whether the sampler wakes the thread if the process has no bell left for direct wake-ups; otherwise that is an error.
    pub is_direct_wake_optional: bool,
    /// How long a thread with `direct_wake` polls for a message before it sleeps: see [`CallbackOptions::spin`].
    pub spin: Duration,
    /// Measure execution times, at one syscall per job (none if the thread busy-polls). On by default.
    pub execution_time: bool,
}

impl CallbackOptions {
    /// `SCHED_FIFO` at a priority of 1 (lowest) to 99.
    pub const fn fifo(priority: u8) -> CallbackOptions {
        CallbackOptions::new(Policy::Fifo(priority))
    }

    /// `SCHED_DEADLINE`: the kernel reserves `runtime` of processor time in each `period` for the thread, and enforces it as a limit. The
    /// thread preempts every `SCHED_FIFO` thread, including the sampler. A job that takes longer than `runtime` waits for the next period,
    /// and delays no other thread.
    ///
    /// State the callback's own `period` and `budget` as usual. To get its time at once, a job needs a `runtime` slightly above its
    /// budget: otherwise the kernel may decide that a job which is woken early exceeds its reservation, and let it wait.
    ///
    /// It needs `CAP_SYS_NICE`. The kernel binds such a thread to one core only if it does not balance between cores, or if real-time
    /// work is not limited. Without [`core`](Self::core) the thread runs on any core.
    ///
    /// ```
    /// use tautline_executor::{CallbackOptions, Policy};
    /// use std::time::Duration;
    ///
    /// let options = CallbackOptions::reserved(Duration::from_millis(4), Duration::from_millis(20)).name("/points");
    /// assert_eq!(options.policy, Policy::Deadline { runtime_ns: 4_000_000, period_ns: 20_000_000 });
    /// ```
    pub fn reserved(runtime: Duration, period: Duration) -> CallbackOptions {
        let (runtime_ns, period_ns) = (nanoseconds(runtime), nanoseconds(period));
        CallbackOptions::new(Policy::Deadline { runtime_ns, period_ns })
    }

    /// `SCHED_OTHER`: for work without a deadline.
    pub const fn other() -> CallbackOptions {
        CallbackOptions::new(Policy::Other { nice: 0 })
    }

    /// Any policy.
    pub const fn new(policy: Policy) -> CallbackOptions {
        CallbackOptions {
            name: String::new(),
            thread_name: None,
            policy,
            cores: None,
            stack_bytes: ThreadBuilder::STACK_BYTES,
            period: None,
            deadline: None,
            budget: None,
            bound: None,
            overrun_policy: OverrunPolicy::Tell,
            watch: Watch { on_overrun: None, on_deadline_miss: None },
            busy_poll: false,
            direct_wake: false,
            is_direct_wake_optional: false,
            spin: Duration::ZERO,
            execution_time: true,
        }
    }

    /// Sets the name.
    pub fn name(mut self, name: impl Into<String>) -> CallbackOptions {
        self.name = name.into();
        self
    }

    /// Names the thread `cb:<name>`, independent of the callback's name.
    pub fn thread_name(mut self, name: impl Into<String>) -> CallbackOptions {
        self.thread_name = Some(name.into());
        self
    }

    /// Binds the thread to one core.
    pub const fn core(self, core: usize) -> CallbackOptions {
        self.cores(CoreSet::one(core))
    }

    /// Binds the thread to a set of cores.
    pub const fn cores(mut self, cores: CoreSet) -> CallbackOptions {
        self.cores = Some(cores);
        self
    }

    /// Sets the size of the stack.
    pub const fn stack_bytes(mut self, bytes: usize) -> CallbackOptions {
        self.stack_bytes = bytes;
        self
    }

    /// Sets the period, and with it the deadline unless one is set.
    pub const fn period(mut self, period: Duration) -> CallbackOptions {
        self.period = Some(period);
        self
    }

    /// Sets the deadline, relative to the release.
    pub const fn deadline(mut self, deadline: Duration) -> CallbackOptions {
        self.deadline = Some(deadline);
        self
    }

    /// Sets the CPU time that a job may use: its wcet, as used in the response-time analysis.
    ///
    /// Checked once, when a job ends, with the CPU clock that measures execution times: a job that used more is an overrun,
    /// which is counted and reported to [`on_overrun`](Self::on_overrun). The job is not stopped, because only the job
    /// itself can leave its data consistent. The excess delays lower priorities, whose bounds then no longer hold, unless
    /// the job is [demoted](Self::demote_on_overrun). Not detected if [`execution_time`](Self::execution_time) is off.
    pub const fn budget(mut self, budget: Duration) -> CallbackOptions {
        self.budget = Some(budget);
        self
    }

    /// Sets the response time that the analysis computed. Jobs that take longer are recorded with their times
    /// among the [moments](crate::CallbackSnapshot::moments), so that each can be explained.
    pub const fn bound(mut self, bound: Duration) -> CallbackOptions {
        self.bound = Some(bound);
        self
    }

    /// Enforces the budget by demotion: a job that has used up its budget continues as `SCHED_OTHER`, below every real-time thread,
    /// until it ends. Jobs that were released before its end, and have waited for it, also run below. Jobs released later run at
    /// the thread's priority again. So the bounds of other callbacks do not depend on whether the budget is enough.
    ///
    /// A high-resolution timer demotes the thread in the middle of the job, a few microseconds late. Only the job's own time counts, not
    /// the time of threads that preempted it or the time in which the job waited. A job that waits for a long time gets a signal each time
    /// that the rest of its budget has passed, or 50 µs: its system calls may then return `EINTR`, and each signal takes a microsecond or two
    /// of the budget, so that one which waits for milliseconds with less than 0.1 ms left may be demoted. Each job costs two more system
    /// calls: state them in the analysis (`demotion` in the system file's overheads). Where timers do not reach a busy thread (PREEMPT_RT), a
    /// thread of higher priority does it, the [enforcer](tautline_rt::prove_enforcement), at the cost of at most one system call and two runs
    /// of that thread for each job. In a group each job has its member's budget, and at most the group's; the members are demoted
    /// together.
    ///
    /// It requires a real-time policy and measured execution times, and does not apply to a busy-polling
    /// thread. With [`Realtime::Off`](crate::Realtime::Off) budgets are not enforced.
    ///
    /// # Real-time
    /// A demoted job holds its locks as a thread of low priority: use [`PiMutex`](tautline_rt::PiMutex), which inherits the
    /// priority of its waiters.
    pub const fn demote_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::Demote;
        self
    }

    /// Enforces the budget by suspension: a job that has used up its budget is suspended, in the middle of its work, until one period after
    /// its release. Then it gets another budget, and so on. Jobs that were released meanwhile run on the rest of these budgets. A job
    /// released a period after the last refill, or later, has its own budget again. So the bounds of other callbacks do not depend on
    /// whether the budget is enough. Unlike a [demoted](Self::demote_on_overrun) job, a suspended job gets its share even if other threads
    /// leave no processor time.
    ///
    /// For callbacks with a `period`, and with one stream whose jitter is shorter than the period. Otherwise the same as
    /// `demote_on_overrun`, at the same cost.
    ///
    /// # Real-time
    /// A suspended job keeps everything that it holds, including locks: a thread that waits for such a lock may wait for up to a period. Do
    /// not use it for callbacks that share locks, including the allocator's; demote those instead.
    pub const fn suspend_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::Suspend;
        self
    }

    /// Like [`demote_on_overrun`](Self::demote_on_overrun), but the callback also ends when such a job ends, with its thread still below
    /// all others: for callbacks that must not continue after an overrun. Its handlers are called, and its statistics show that it has
    /// ended. In a group it ends the group.
    pub const fn end_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::End;
        self
    }

    /// Sets the handler for a job that used more CPU time than its budget.
    ///
    /// # Real-time
    /// The handler runs on the callback's thread, at its priority, directly after the job and before the next one. Its
    /// time must be bounded like that of the callback itself: for example, it sets a flag that makes the next job do
    /// less. Calling it allocates nothing. Its time is charged to no job, and needs one more syscall; the next job's
    /// response time includes it.
    pub fn on_overrun(mut self, handler: impl Fn(&Overrun) + Send + Sync + 'static) -> CallbackOptions {
        self.watch.on_overrun = Some(Handler(Arc::new(handler)));
        self
    }

    /// Sets the handler for a job that ended later than its deadline. It runs after the overrun handler, if both are
    /// called.
    ///
    /// # Real-time
    /// As [`on_overrun`](Self::on_overrun).
    pub fn on_deadline_miss(
        mut self,
        handler: impl Fn(&DeadlineMiss) + Send + Sync + 'static,
    ) -> CallbackOptions {
        self.watch.on_deadline_miss = Some(Handler(Arc::new(handler)));
        self
    }

    /// Polls the callback in a loop on its own core: no wake-up, no parking, one core at 100 %.
    ///
    /// Needs exactly one core, and is refused if it would starve a thread that the executor knows. It cannot protect
    /// other threads: at a real-time priority, keep them off that core (`isolcpus`, or their affinity), because there
    /// they get only the time that `sched_rt_runtime_us` leaves.
    pub const fn busy_poll(mut self) -> CallbackOptions {
        self.busy_poll = true;
        self
    }

    /// Lets publishers wake the thread directly, without the sampler: a message reaches its callback one thread switch
    /// earlier, and costs less CPU time.
    ///
    /// Messages of subscriptions and requests wake the thread in this way; timers, responses and everything else still wake it
    /// through the sampler. The cost: a publisher makes one futex wake for each such thread that sleeps, whereas one futex wake of the
    /// sampler serves all other threads of the process. Of several threads that take one topic, the first one on the publisher's core
    /// may preempt it before it has woken the next: where they have bounds, let the sampler wake them. docs/wake-ups.md compares the ways.
    ///
    /// Off by default. With a system file it is on for the threads for which the file says so, and for those where no bound gets worse.
    /// For a busy-polling thread, which never sleeps, this has no effect. A callback that blocks in its own executor (`block_on`) would
    /// not be woken there.
    pub const fn direct_wake(mut self) -> CallbackOptions {
        self.direct_wake = true;
        self
    }

    /// Lets a thread with [`direct_wake`](Self::direct_wake) poll for this time for more messages before it sleeps; other threads
    /// sleep at once. Zero by default, at most 1 ms: to poll for longer, use [`busy_poll`](Self::busy_poll).
    ///
    /// Falling asleep and being woken cost some µs, and an interrupt across cores if the message arrives meanwhile. If responses
    /// arrive that fast, polling for as long is cheaper. The cost: each wake-up uses this additional time of its core, at the
    /// thread's priority, which delays lower priorities. Add it to the wcet in the response-time analysis.
    pub const fn spin(mut self, spin: Duration) -> CallbackOptions {
        self.spin = spin;
        self
    }

    /// Sets whether execution times are measured.
    pub const fn execution_time(mut self, measured: bool) -> CallbackOptions {
        self.execution_time = measured;
        self
    }

    /// The deadline, or else the period.
    pub const fn effective_deadline(&self) -> Option<Duration> {
        match self.deadline {
            Some(deadline) => Some(deadline),
            None => self.period,
        }
    }
}

/// What happens to a job that uses more processor time than its budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OverrunPolicy {
    /// It is counted, and reported to [`CallbackOptions::on_overrun`].
    #[default]
    Tell,
    /// See [`CallbackOptions::demote_on_overrun`].
    Demote,
    /// See [`CallbackOptions::suspend_on_overrun`].
    Suspend,
    /// See [`CallbackOptions::end_on_overrun`].
    End,
}

/// A job used more CPU time than its budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Overrun {
    /// The number of the job in its callback, from 1.
    pub job: u64,
    /// When it was released, in `CLOCK_MONOTONIC` ns.
    pub release_ns: u64,
    /// The CPU time it used.
    pub execution_ns: u64,
    /// The CPU time that it was allowed to use.
    pub budget_ns: u64,
}

/// A job ended later than its deadline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeadlineMiss {
    /// The number of the job in its callback, from 1.
    pub job: u64,
    /// When it was released, in `CLOCK_MONOTONIC` ns.
    pub release_ns: u64,
    /// The time from its release to its end.
    pub response_ns: u64,
    /// The maximum of this time.
    pub deadline_ns: u64,
}

/// The handlers that are called when a job violates an assumption of the analysis.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Watch {
    /// See [`CallbackOptions::on_overrun`].
    pub on_overrun: Option<Handler<Overrun>>,
    /// See [`CallbackOptions::on_deadline_miss`].
    pub on_deadline_miss: Option<Handler<DeadlineMiss>>,
}

/// A function provided by the user. A clone is the same function.
pub struct Handler<E>(Arc<dyn Fn(&E) + Send + Sync>);

impl<E> Handler<E> {
    pub(crate) fn call(&self, event: &E) {
        (self.0)(event);
    }
}

impl<E> Clone for Handler<E> {
    fn clone(&self) -> Handler<E> {
        Handler(Arc::clone(&self.0))
    }
}

impl<E> PartialEq for Handler<E> {
    fn eq(&self, other: &Handler<E>) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}

impl<E> Eq for Handler<E> {}

impl<E> fmt::Debug for Handler<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Handler")
    }
}
