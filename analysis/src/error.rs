// SPDX-License-Identifier: MIT OR Apache-2.0

/// Why no response time or queue capacity could be given.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum AnalysisError {
    /// A period of zero: infinitely many releases.
    #[error("task `{task}` has a period of 0 ns: set it to the shortest time between two releases")]
    ZeroPeriod {
        /// The task at fault.
        task: String,
    },

    /// A worst-case execution time of zero bounds nothing.
    #[error("task `{task}` has a wcet of 0 ns: set it to the longest execution time measured or computed")]
    ZeroWcet {
        /// The task at fault.
        task: String,
    },

    /// A time beyond what 64 bits of nanoseconds hold; [`Task`](crate::Task) keeps such a time as `u64::MAX`.
    #[error(
        "task `{task}` has a {field} of more than 584 years (the limit is 2^64 - 2 ns): set a shorter one"
    )]
    TooLong {
        /// The task at fault.
        task: String,
        /// The field at fault: `period`, `wcet`, `deadline`, `jitter`, `blocking` or `message overhead`.
        field: &'static str,
    },

    /// The task and all work at its priority or above need more than the core: the backlog grows for ever.
    #[error(
        "task `{task}` has no bounded response time: the work at priority {priority} and above, overheads included, \
         needs {:.1} % of the core (the limit is 100 %): lower a rate or a wcet, or move a task to another core",
        utilisation * 100.0
    )]
    Overload {
        /// The first task without a bound.
        task: String,
        /// Its priority, the level that is overloaded.
        priority: u8,
        /// Utilisation of this level: 1.0 is the whole core.
        utilisation: f64,
    },

    /// A level that needs exactly the whole core never catches up with jitter or blocking, nor may it size a queue.
    #[error(
        "task `{task}` has no slack: the work at priority {priority} and above needs 100 % of the core, \
         where jitter, blocking and queues have no safe bound: lower a rate or a wcet"
    )]
    NoSlack {
        /// The task without slack.
        task: String,
        /// Its priority, the level that is full.
        priority: u8,
    },

    /// The busy window is too long to follow to its end.
    #[error(
        "task `{task}` did not converge in {iterations} iterations: the work at priority {priority} and above needs \
         {:.6} % of the core, too close to 100 %: lower a rate or a wcet",
        utilisation * 100.0
    )]
    IterationLimit {
        /// The task without a result.
        task: String,
        /// Its priority, the level analysed.
        priority: u8,
        /// Utilisation of this level: 1.0 is the whole core.
        utilisation: f64,
        /// The iterations spent.
        iterations: u32,
    },

    /// An intermediate or final result does not fit its integer.
    #[error(
        "the response time or queue of task `{task}` exceeds 64 bits (584 years): lower its times or its load"
    )]
    Overflow {
        /// The task whose analysis overflowed.
        task: String,
    },
}
