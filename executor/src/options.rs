// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a callback thread is asked to be.

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
    /// What the thread is named for instead, such as the callback's group.
    pub thread_name: Option<String>,
    /// How the thread is scheduled.
    pub policy: Policy,
    /// Where it may run; `None`: where the thread that spawns it may, or on any core if it has a reservation.
    pub cores: Option<CoreSet>,
    /// The size of its stack, which is touched before the thread turns real-time.
    pub stack_bytes: usize,
    /// The least time between two releases; only the deadline's default depends on it.
    pub period: Option<Duration>,
    /// A job whose response takes longer than this misses its deadline. `None`: the period.
    pub deadline: Option<Duration>,
    /// The CPU time that a job may use: see [`CallbackOptions::budget`].
    pub budget: Option<Duration>,
    /// Jobs whose responses take longer are kept with their instants: see [`CallbackOptions::bound`].
    pub bound: Option<Duration>,
    /// What becomes of a job that uses more.
    pub overrun_policy: OverrunPolicy,
    /// What happens after a job that used more than its budget, and after one that missed its deadline.
    pub watch: Watch,
    /// Poll all the time instead of parking: see [`CallbackOptions::busy_poll`].
    pub busy_poll: bool,
    /// Let publishers wake the thread: see [`CallbackOptions::direct_wake`].
    pub direct_wake: bool,
    /// How long such a thread looks for a message before it sleeps: see [`CallbackOptions::spin`].
    pub spin: Duration,
    /// Measure execution times, at one syscall per job (none if the thread polls busily). On by default.
    pub execution_time: bool,
}

impl CallbackOptions {
    /// `SCHED_FIFO` at a priority of 1 (lowest) to 99.
    pub const fn fifo(priority: u8) -> CallbackOptions {
        CallbackOptions::new(Policy::Fifo(priority))
    }

    /// `SCHED_DEADLINE`: `runtime` of processor time in each `period`, which the kernel reserves for the thread and holds it to. It
    /// preempts every `SCHED_FIFO` thread, the sampler too; a job that takes longer than `runtime` waits for the next period, and delays nobody.
    ///
    /// The callback's own `period` and `budget` are stated as any other's. A job that is to find its time at once wants a `runtime` a
    /// little above its budget: else the kernel may find one that is woken early beyond what it has reserved, and keep it waiting.
    ///
    /// It needs `CAP_SYS_NICE`, and the kernel binds such a thread to one core only where it does not balance between cores, or has no
    /// limit on real-time work; without [`core`](Self::core) it runs on any.
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
            spin: Duration::ZERO,
            execution_time: true,
        }
    }

    /// Sets the name.
    pub fn name(mut self, name: impl Into<String>) -> CallbackOptions {
        self.name = name.into();
        self
    }

    /// Names the thread `cb:<name>`, whatever the callback is called.
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

    /// Sets the CPU time that a job may use: its wcet, as response-time analysis was told.
    ///
    /// Checked once, when a job ends, with the CPU clock that measures execution times: a job that used more is an
    /// overrun, which is counted and told to [`on_overrun`](Self::on_overrun). The job is not stopped: nobody but
    /// itself could leave its data whole. What it took too long delays lower priorities, whose bounds no longer hold, unless
    /// it is [demoted](Self::demote_on_overrun).
    /// Not noticed where [`execution_time`](Self::execution_time) is off.
    pub const fn budget(mut self, budget: Duration) -> CallbackOptions {
        self.budget = Some(budget);
        self
    }

    /// Sets the response time that analysis computed. Jobs that take longer are kept with their instants among the
    /// [moments](crate::CallbackSnapshot::moments), so that each can be explained.
    pub const fn bound(mut self, bound: Duration) -> CallbackOptions {
        self.bound = Some(bound);
        self
    }

    /// Holds each job to its budget: one that has used it up goes on as `SCHED_OTHER`, below every real-time thread, until it ends;
    /// and so do the jobs that were released before that, which have waited for it. What is released later is done at the
    /// thread's priority again. So the bounds of other callbacks do not rest on the budget being enough.
    ///
    /// A high-resolution timer demotes the thread in the midst of the job, a few microseconds late; it finds out what was the
    /// job's own time, and not that of others who preempted it, nor that in
    /// which the job waited: a job that waits long in its midst gets a signal each time that what is left of its budget has passed. Each job costs two system calls more: state them in the analysis
    /// (`demotion` in the system file's overheads). A group's thread holds each member to its own budget, and demotes them together.
    ///
    /// For real-time policies and measured execution times, not for a thread that polls busily. With
    /// [`Realtime::Off`](crate::Realtime::Off) there is nothing to hold.
    ///
    /// # Real-time
    /// Locks that the job holds then are held by a thread of low priority: use [`PiMutex`](tautline_rt::PiMutex), whose waiters
    /// lend it theirs.
    pub const fn demote_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::Demote;
        self
    }

    /// Holds each job to its budget: one that has used it up is suspended, in the midst of what it does, until a period after its release,
    /// where it gets another budget, and so on. The jobs that were released meanwhile are done with what it leaves of these. What is released
    /// a period after the last refill or later has a budget of its own again. So the bounds of other callbacks do not rest on the budget being
    /// enough, and unlike a [demoted](Self::demote_on_overrun) job a suspended one still gets its share where others leave nothing.
    ///
    /// For callbacks with a `period`, and one stream whose jitter is shorter than that; else as `demote_on_overrun`, at the same cost.
    ///
    /// # Real-time
    /// It sleeps with all that it holds, locks too: whoever waits for one waits for up to a period. Not for callbacks that share locks, the
    /// allocator's among them; demote those.
    pub const fn suspend_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::Suspend;
        self
    }

    /// As [`demote_on_overrun`](Self::demote_on_overrun), and the callback ends when such a job does, its thread still below all
    /// others: for one that nobody trusts any more once it has broken its word. Its handlers are called, its statistics say that it has ended.
    /// In a group it ends the group.
    pub const fn end_on_overrun(mut self) -> CallbackOptions {
        self.overrun_policy = OverrunPolicy::End;
        self
    }

    /// Sets what happens after a job that used more CPU time than its budget.
    ///
    /// # Real-time
    /// The handler runs on the callback's thread, at its priority, right after the job and before the next one: what it
    /// does must be as bounded as the callback itself, such as setting a flag that makes the next job do less. Calling
    /// it allocates nothing. Its time is charged to no job, and costs one syscall more; the next job's response does
    /// contain it.
    pub fn on_overrun(mut self, handler: impl Fn(&Overrun) + Send + Sync + 'static) -> CallbackOptions {
        self.watch.on_overrun = Some(Handler(Arc::new(handler)));
        self
    }

    /// Sets what happens after a job that ended later than its deadline; after the overrun's handler, if both are called.
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

    /// Polls the callback in a loop on a core of its own: no wake-up, no parking, one core at 100 %.
    ///
    /// Needs exactly one core, and is refused where it would starve a thread that the executor knows of. Others it
    /// cannot protect: at a real-time priority, keep them off that core (`isolcpus`, or their affinity), for all they
    /// get there is what `sched_rt_runtime_us` leaves them.
    pub const fn busy_poll(mut self) -> CallbackOptions {
        self.busy_poll = true;
        self
    }

    /// Lets publishers wake the thread themselves, without the sampler between: a message reaches its callback one change of
    /// threads earlier, and costs less CPU time.
    ///
    /// What it costs: a publisher makes one futex wake for each such thread that sleeps, where one wakes the sampler for all
    /// others of the process. Bounds that were computed with a sampler still hold, for it delays nobody by what it no longer
    /// does. Messages of subscriptions and requests come so; timers, responses and everything else still wake the thread through the
    /// sampler. A thread that polls busily sleeps nowhere: there this changes nothing. A callback that blocks in an executor of its
    /// own (`block_on`) would not be woken there.
    pub const fn direct_wake(mut self) -> CallbackOptions {
        self.direct_wake = true;
        self
    }

    /// Lets a thread with [`direct_wake`](Self::direct_wake) look for so long whether more comes before it sleeps; others sleep at
    /// once. Zero by default, at most 1 ms: whoever wants to look for longer polls [busily](Self::busy_poll).
    ///
    /// Falling asleep and being woken cost some µs, and an interrupt across cores if the message comes meanwhile: where answers
    /// come that fast, looking for as long is cheaper. What it costs: each wake-up uses so much more of its core, at the thread's
    /// priority, which delays those below; response-time analysis wants it added to the wcet.
    pub const fn spin(mut self, spin: Duration) -> CallbackOptions {
        self.spin = spin;
        self
    }

    /// Says whether execution times are measured.
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

/// What becomes of a job that uses more processor time than its budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum OverrunPolicy {
    /// It is counted, and told to [`CallbackOptions::on_overrun`].
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
    /// Which of the callback's jobs it was, from 1.
    pub job: u64,
    /// When it was released, in ns of `CLOCK_MONOTONIC`.
    pub release_ns: u64,
    /// The CPU time it used.
    pub execution_ns: u64,
    /// What it might have used.
    pub budget_ns: u64,
}

/// A job ended later than its deadline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeadlineMiss {
    /// Which of the callback's jobs it was, from 1.
    pub job: u64,
    /// When it was released, in ns of `CLOCK_MONOTONIC`.
    pub release_ns: u64,
    /// The time from there to its end.
    pub response_ns: u64,
    /// What that should have been at most.
    pub deadline_ns: u64,
}

/// What is called when a job violates what was assumed of it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Watch {
    /// See [`CallbackOptions::on_overrun`].
    pub on_overrun: Option<Handler<Overrun>>,
    /// See [`CallbackOptions::on_deadline_miss`].
    pub on_deadline_miss: Option<Handler<DeadlineMiss>>,
}

/// A function of the user's. A clone is the same function.
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
