// SPDX-License-Identifier: MIT OR Apache-2.0
use std::time::Duration;

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
    /// Latest end wanted, relative to the nominal release; may exceed the period.
    pub deadline_ns: u64,
    /// How much later than nominal a job may become ready; may exceed the period.
    pub jitter_ns: u64,
    /// Longest time lower priorities can hold this task up: the longest critical section whose ceiling is at or above
    /// its priority (priority inheritance or ceiling assumed).
    pub blocking_ns: u64,
    /// As in SCHED_FIFO, a larger number is a higher priority. Tasks of one priority delay each other: a job is taken
    /// to wait for every job of its level, a safe bound for first-in, first-out order.
    pub priority: u8,
    /// Middleware work for each message, in place of [`Overheads::per_message_ns`]: `Some(0)` for a task that no
    /// message wakes, such as a timer interrupt. Used only by the analyses that take [`Overheads`].
    pub message_overhead_ns: Option<u64>,
}

impl Task {
    /// A task whose deadline is its period, without jitter or blocking.
    pub fn new(name: impl Into<String>, period: Duration, wcet: Duration, priority: u8) -> Self {
        Self {
            name: name.into(),
            period_ns: nanos(period),
            wcet_ns: nanos(wcet),
            deadline_ns: nanos(period),
            jitter_ns: 0,
            blocking_ns: 0,
            priority,
            message_overhead_ns: None,
        }
    }

    /// Sets the deadline, relative to the nominal release.
    #[must_use]
    pub fn deadline(mut self, deadline: Duration) -> Self {
        self.deadline_ns = nanos(deadline);
        self
    }

    /// Sets the release jitter.
    #[must_use]
    pub fn jitter(mut self, jitter: Duration) -> Self {
        self.jitter_ns = nanos(jitter);
        self
    }

    /// Sets the blocking by lower priorities.
    #[must_use]
    pub fn blocking(mut self, blocking: Duration) -> Self {
        self.blocking_ns = nanos(blocking);
        self
    }

    /// Sets the middleware work for each message of this task, in place of [`Overheads::per_message_ns`].
    #[must_use]
    pub fn message_overhead(mut self, overhead: Duration) -> Self {
        self.message_overhead_ns = Some(nanos(overhead));
        self
    }
}

/// What the machine and the middleware cost on top of the callbacks, in nanoseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Overheads {
    /// One context switch; each job of a callback is charged two.
    pub context_switch_ns: u64,
    /// Publisher, transport and sampler work on this core for one message of any topic, the sampler's own context
    /// switches included; charged at the highest priority.
    pub per_message_ns: u64,
}

impl Overheads {
    /// A machine and a middleware that cost nothing.
    pub const NONE: Self = Self { context_switch_ns: 0, per_message_ns: 0 };
}

/// The share of the core the tasks need: the sum of wcet / period, 1.0 being the whole core. Infinite (or NaN) if a
/// period is 0. For display; the analysis compares exactly.
#[must_use]
pub fn utilisation(tasks: &[Task]) -> f64 {
    tasks.iter().map(|task| task.wcet_ns as f64 / task.period_ns as f64).sum()
}

fn nanos(duration: Duration) -> u64 {
    u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)
}
