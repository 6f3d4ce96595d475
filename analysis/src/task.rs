// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

use crate::release::{Distances, Release};

/// One callback (or any other recurring work) of the core under analysis. All times are nanoseconds, at most
/// 2^64 - 2; a longer [`Duration`] is kept as `u64::MAX`, which the analysis refuses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Task {
    /// Name used in results and errors; need not be unique.
    pub name: String,
    /// Shortest time between two releases; more than 0.
    pub period_ns: u64,
    /// Worst-case execution time of one job, alone on the core; more than 0.
    pub wcet_ns: u64,
    /// Least time from a job's start to the message it publishes; 0 if not known. Used to pass jitter on in chains.
    pub bcet_ns: u64,
    /// The deadline of a job, relative to the nominal release; may exceed the period.
    pub deadline_ns: u64,
    /// How much later than nominal a job may become ready; may exceed the period.
    pub jitter_ns: u64,
    /// Least time between two actual releases, whatever the jitter; 0 for none, at most the period.
    pub min_distance_ns: u64,
    /// Releases as seen in a trace, in place of the period, which is then their mean; see [`Release::from_trace`].
    pub distances: Option<Distances>,
    /// Longest time lower priorities can hold this task up besides their non-preemptive sections: the longest critical
    /// section whose ceiling is at or above its priority; [`blocking`](crate::blocking()) computes it.
    pub blocking_ns: u64,
    /// Longest section that nothing preempts, at most the wcet; it delays higher priorities. If it is the wcet, the
    /// task runs to its end once started.
    pub non_preemptive_ns: u64,
    /// As in SCHED_FIFO, a larger number is a higher priority. Tasks of one priority delay each other: a job is taken
    /// to wait for every job of its level, a safe bound for first-in, first-out order.
    pub priority: u8,
    /// The reservation that the kernel grants and enforces, if the task runs under SCHED_DEADLINE. Its priority is then above
    /// all others, [`Reservation::PRIORITY`]; it delays them by its reservation, whatever its wcet.
    pub reservation: Option<Reservation>,
    /// The thread that this task shares with all others of the same group; `None` for a thread of its own.
    pub group: Option<Group>,
    /// When it has its turn among the tasks of its thread, for [`Order::Priority`].
    pub rank: Rank,
    /// The lowest priority at which its thread runs it, for a task of a group whose thread lowers itself from `priority`, its ceiling: the
    /// ceiling while it waits, takes a job or runs a timer, and this while it runs a job. `None`: the thread keeps its priority.
    pub lowered_to: Option<u8>,
    /// Whether one round of a thread that goes by ranks may run it several times: a join by stamps makes sets of what it took in earlier
    /// rounds, too.
    pub repeats: bool,
    /// Middleware work for each message, in place of [`Overheads::per_message_ns`]: `Some(0)` for a task that no
    /// message wakes, such as a timer interrupt. Used only by the analyses that take [`Overheads`].
    pub message_overhead_ns: Option<u64>,
    /// The time that an executor of a library other than Tautline uses for each job, in the task's thread: in rclcpp, to wait, to
    /// find what is ready, and to take it. Used only by the analyses that take [`Overheads`].
    pub executor_overhead_ns: u64,
    /// How often a job may wait for a lock that inherits priorities: each time it switches to the holder and back.
    pub lock_waits: u64,
    /// What happens to a job that uses more than is charged for it.
    pub hold: Hold,
    /// The most messages that its queue keeps, if that is known; a timer keeps one release. A task whose budget is enforced may publish as
    /// many at once when it is late.
    pub depth: Option<u64>,
    /// Whether its messages may arrive in another order than they were sent in, as far as their jitter allows.
    pub unordered: bool,
}

/// How a task's budget is enforced: the time that is charged for a job with all work per message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Hold {
    /// Nothing: its wcet is taken to be right.
    #[default]
    Nothing,
    /// A job that exceeds its budget continues below all others, once it holds no lock that they use.
    Demoted {
        /// The longest section of such a lock: each job may exceed its budget at the section's start, and end with it. In nanoseconds.
        section_ns: u64,
    },
    /// It sleeps until a period after its release. What is left of a budget may be used right before the next one, unless all
    /// releases are whole periods apart.
    Suspended {
        /// Whether a budget may be used later than at its begin.
        deferred: bool,
    },
}

/// A reservation of processor time: SCHED_DEADLINE's, which is a constant-bandwidth server (Abeni & Buttazzo 1998) whose deadline is its
/// period, and which waits for its next period when its runtime is used up.
///
/// It runs as soon as it has work and runtime: nothing of its core is above it. In any window it uses no more than its runtime and,
/// for each part of the period that passes, that part of it: for others a task of this period and cost, released with a jitter of
/// one period. That needs reservations which do not wait for one another: one on a core, or no more of them than cores among which they move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Reservation {
    /// Processor time in each period, in nanoseconds.
    pub runtime_ns: u64,
    /// The period, in nanoseconds.
    pub period_ns: u64,
}

impl Reservation {
    /// Above all priorities of SCHED_FIFO.
    pub const PRIORITY: u8 = 100;

    /// How exactly the kernel compares what is left of a runtime with what is left of its period: in units of 1,024 ns.
    pub(crate) const GRANULARITY_NS: u64 = 2_048;
}

/// A thread that runs several tasks, one job after the other. They must have one priority.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Group {
    /// Distinguishes the groups of a core.
    pub id: u32,
    /// How the next job is chosen.
    pub order: Order,
}

/// The order in which a thread runs the jobs of its tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Order {
    /// One queue of (callback, message), first in, first out: the order of Tautline's callback groups.
    Fifo,
    /// Any order that leaves no job waiting while the thread idles, such as tasks that each drain their queue.
    Any,
    /// The waiting job with the highest [rank](Task::rank), without preemption: a ROS executor to which the RMW reports the most important
    /// message alone, and which finds timers itself.
    Priority,
}

/// When a task has its turn in a group with [`Order::Priority`]. An executor of ROS 2 works in rounds: after each wait it runs one job of
/// each timer that was due then, and one of each task of the highest rank of which any was ready.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Rank {
    /// In the rounds of this rank: the highest first.
    Of(u8),
    /// A timer, in the first round after its release.
    Timer {
        /// Whether timers run before all else in a round. In an executor of rclpy with several nodes, messages of one node come before the
        /// timers of the next.
        is_first: bool,
    },
}

impl Rank {
    pub(crate) fn is_timer(self) -> bool {
        matches!(self, Self::Timer { .. })
    }
}

impl Task {
    /// A task whose deadline is its period, without jitter or blocking.
    pub fn new(name: impl Into<String>, period: Duration, wcet: Duration, priority: u8) -> Self {
        Self {
            name: name.into(),
            period_ns: nanos(period),
            wcet_ns: nanos(wcet),
            bcet_ns: 0,
            deadline_ns: nanos(period),
            jitter_ns: 0,
            min_distance_ns: 0,
            distances: None,
            blocking_ns: 0,
            non_preemptive_ns: 0,
            priority,
            reservation: None,
            group: None,
            rank: Rank::Of(0),
            lowered_to: None,
            repeats: false,
            message_overhead_ns: None,
            executor_overhead_ns: 0,
            lock_waits: 0,
            hold: Hold::Nothing,
            depth: None,
            unordered: false,
        }
    }

    /// Gives the task a reservation, and the priority of a task with a reservation.
    #[must_use = "it returns the changed Task"]
    pub fn reserved(mut self, runtime: Duration, period: Duration) -> Self {
        let (runtime_ns, period_ns) = (nanos(runtime), nanos(period));
        self.reservation = Some(Reservation { runtime_ns, period_ns });
        self.priority = Reservation::PRIORITY;
        self
    }

    /// Sets the deadline, relative to the nominal release.
    #[must_use = "it returns the changed Task"]
    pub fn deadline(mut self, deadline: Duration) -> Self {
        self.deadline_ns = nanos(deadline);
        self
    }

    /// Sets the release jitter.
    #[must_use = "it returns the changed Task"]
    pub fn jitter(mut self, jitter: Duration) -> Self {
        self.jitter_ns = nanos(jitter);
        self
    }

    /// Sets how the task is released; the deadline stays.
    #[must_use = "it returns the changed Task"]
    pub fn released(mut self, release: Release) -> Self {
        let Release { period_ns, jitter_ns, min_distance_ns, distances } = release;
        (self.period_ns, self.jitter_ns) = (period_ns, jitter_ns);
        (self.min_distance_ns, self.distances) = (min_distance_ns, distances);
        self
    }

    /// Sets the blocking by lower priorities.
    #[must_use = "it returns the changed Task"]
    pub fn blocking(mut self, blocking: Duration) -> Self {
        self.blocking_ns = nanos(blocking);
        self
    }

    /// Sets the longest section that nothing preempts.
    #[must_use = "it returns the changed Task"]
    pub fn non_preemptive(mut self, section: Duration) -> Self {
        self.non_preemptive_ns = nanos(section);
        self
    }

    /// Lets the task share a thread with others.
    #[must_use = "it returns the changed Task"]
    pub fn group(mut self, id: u32, order: Order) -> Self {
        self.group = Some(Group { id, order });
        self
    }

    /// Sets when the task has its turn among the tasks of its thread, for [`Order::Priority`].
    #[must_use = "it returns the changed Task"]
    pub fn rank(mut self, rank: Rank) -> Self {
        self.rank = rank;
        self
    }

    /// Lets the thread, which has the task's priority while it waits, run the task at this one.
    #[must_use = "it returns the changed Task"]
    pub fn lowered_to(mut self, priority: u8) -> Self {
        self.lowered_to = Some(priority);
        self
    }

    /// Sets the middleware work for each message of this task, in place of [`Overheads::per_message_ns`].
    #[must_use = "it returns the changed Task"]
    pub fn message_overhead(mut self, overhead: Duration) -> Self {
        self.message_overhead_ns = Some(nanos(overhead));
        self
    }

    /// The lowest priority at which it runs: its own, unless its thread lowers itself.
    pub(crate) fn lowest(&self) -> u8 {
        self.lowered_to.filter(|_| self.group.is_some()).map_or(self.priority, |own| own.min(self.priority))
    }

    /// The highest priority at which it runs: timers may run at the ceiling of their thread.
    pub(crate) fn highest(&self) -> u8 {
        if self.rank.is_timer() { self.priority } else { self.lowest() }
    }

    /// What one job costs its thread: its execution time, two context switches, two for each lock that it waits for, one if the thread
    /// lowers itself, which lets others run at once, and what its executor uses.
    pub(crate) fn charged_ns(&self, overheads: &Overheads) -> u64 {
        let switches = self.lock_waits.saturating_add(1).saturating_mul(2);
        let switches = switches.saturating_add(u64::from(self.lowest() < self.priority));
        let switches_ns = overheads.context_switch_ns.saturating_mul(switches);
        self.wcet_ns.saturating_add(switches_ns).saturating_add(self.executor_overhead_ns)
    }

    /// What one job costs at the thread's ceiling before the thread lowers itself: what its executor uses, and two context switches.
    pub(crate) fn waits_ns(&self, overheads: &Overheads) -> u64 {
        overheads.context_switch_ns.saturating_mul(2).saturating_add(self.executor_overhead_ns)
    }

    /// What one message costs at the highest priority.
    pub(crate) fn per_message_ns(&self, overheads: &Overheads) -> u64 {
        self.message_overhead_ns.unwrap_or(overheads.per_message_ns)
    }

    /// Whether nothing but a queue bounds how late it publishes: others do not rely on its wcet.
    pub(crate) fn is_held(&self) -> bool {
        self.hold != Hold::Nothing || self.reservation.is_some()
    }

    /// The same task on a machine without overheads.
    pub(crate) fn without_overheads(&self) -> Task {
        Task { message_overhead_ns: None, executor_overhead_ns: 0, ..self.clone() }
    }

    /// How the task is released.
    pub fn release(&self) -> Release {
        Release {
            period_ns: self.period_ns,
            jitter_ns: self.jitter_ns,
            min_distance_ns: self.min_distance_ns,
            distances: self.distances.clone(),
        }
    }
}

/// The overheads of the machine and the middleware, in addition to the callbacks, in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Overheads {
    /// One context switch; each job of a callback is charged two.
    pub context_switch_ns: u64,
    /// Publisher, transport and sampler work on this core for one message of any topic, the sampler's own context
    /// switches included; charged at the highest priority.
    pub per_message_ns: u64,
    /// Time between two timer ticks of the core; 0 for a core without.
    pub tick_period_ns: u64,
    /// Work of one timer tick, charged at the highest priority.
    pub tick_ns: u64,
    /// The kernel's limit on real-time work, if it has one.
    pub throttling: Option<Throttling>,
}

/// Real-time throttling: the share of each period that real-time threads may have (`kernel.sched_rt_runtime_us` and
/// `sched_rt_period_us`; the fair server of Linux 6.12 and later takes away as much, and no sooner).
///
/// A pause ends with its period, so pauses are no more than a task of the highest priority, of this period and of
/// wcet period - runtime. There is none if the work that can be released in one period is within the runtime: less
/// than that cannot use it up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Throttling {
    /// Real-time work allowed in each period, in nanoseconds.
    pub runtime_ns: u64,
    /// Length of the period, in nanoseconds; more than 0.
    pub period_ns: u64,
}

impl Throttling {
    /// What Linux sets by default: 950 ms of each second.
    pub const LINUX: Self = Self { runtime_ns: 950_000_000, period_ns: 1_000_000_000 };
}

impl Overheads {
    /// A machine and a middleware without overheads.
    pub const NONE: Self =
        Self { context_switch_ns: 0, per_message_ns: 0, tick_period_ns: 0, tick_ns: 0, throttling: None };
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
