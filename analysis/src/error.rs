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

    /// A part that is larger than its whole.
    #[error("task `{task}` has a {field} longer than its {limit}: set it to the {limit} at most")]
    TooLarge {
        /// The task at fault.
        task: String,
        /// The field at fault: `minimum distance`, `bcet` or `non-preemptive section`.
        field: &'static str,
        /// The field it may not exceed.
        limit: &'static str,
    },

    /// A reservation that cannot be analysed.
    #[error("the reservation of task `{task}` has no meaning: {problem}")]
    BadReservation {
        /// The task at fault.
        task: String,
        /// What is wrong with it.
        problem: &'static str,
    },

    /// The jobs of a task need more than what is reserved for them.
    #[error(
        "task `{task}` has no bounded response time: its jobs take up to {charged_ns} ns each, overheads included, which is more in \
         the long run than its reservation of {runtime_ns} ns in {period_ns} ns: raise its runtime, or lower a rate or a wcet"
    )]
    SmallReservation {
        /// The task without a bound.
        task: String,
        /// What a job takes, in nanoseconds.
        charged_ns: u64,
        /// What is reserved, in nanoseconds.
        runtime_ns: u64,
        /// In each of these, in nanoseconds.
        period_ns: u64,
    },

    /// Tasks of one thread that disagree about it.
    #[error("tasks `{task}` and `{other}` share a thread but not its priority or order: give both the same")]
    MixedGroup {
        /// One of them.
        task: String,
        /// The other.
        other: String,
    },

    /// Instants that bound nothing.
    #[error("the trace gives no release curve: {problem}; record it in order, over several releases")]
    BadTrace {
        /// What is wrong with it.
        problem: &'static str,
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

    /// A level that needs exactly the whole core never recovers from jitter or blocking, and no queue can be sized
    /// for it.
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

    /// Its executor gives it no bound.
    #[error(
        "task `{task}` has no bounded response time: {reason}; use one SingleThreadedExecutor per callback group, each in its own thread"
    )]
    ByExecutor {
        /// The task without a bound.
        task: String,
        /// Why.
        reason: Unbounded,
    },

    /// Without a bound for one task, what it triggers or delays has none either.
    #[error(
        "task `{task}` has no bounded response time because `{cause}`, which triggers or delays it, has none"
    )]
    Upstream {
        /// The task without a bound.
        task: String,
        /// The first task without one.
        cause: String,
    },

    /// Tasks that trigger one another, directly or through others.
    #[error(
        "tasks {tasks} trigger one another in a circle: let one of them run periodically and read the topic"
    )]
    Cycle {
        /// The tasks of the circle, in their order.
        tasks: String,
    },

    /// Jitter that grows in every round: chains delay each other across cores.
    #[error(
        "the jitter of task `{task}` still grows after {rounds} rounds and is {jitter_ns} ns, while the work at priority \
         {priority} and above needs {:.1} % of its core: chains delay each other in a circle; raise the priority of \
         the later callbacks of a chain, or lower a wcet",
        utilisation * 100.0
    )]
    Diverges {
        /// The task whose jitter grew last.
        task: String,
        /// Its jitter so far.
        jitter_ns: u64,
        /// Its priority.
        priority: u8,
        /// Utilisation of its level: 1.0 is the whole core.
        utilisation: f64,
        /// The rounds spent.
        rounds: u32,
    },

    /// More levels than there are priorities.
    #[error(
        "{levels} priorities are needed but only 1 to {highest} are free: raise the highest, or let callbacks share threads"
    )]
    TooFewPriorities {
        /// How many are needed.
        levels: usize,
        /// The highest that may be used.
        highest: u8,
    },

    /// No order of priorities meets all deadlines.
    #[error(
        "no priority order meets every deadline: none of {tasks} meets its deadline at the lowest priority that is \
         left, so lower a wcet or a rate, or move one of them to another core"
    )]
    NoAssignment {
        /// The tasks that could not be placed.
        tasks: String,
    },

    /// The analysis cannot handle this join.
    #[error("task `{task}` cannot wait for its inputs: {problem}")]
    BadJoin {
        /// The task that waits.
        task: String,
        /// What is wrong with it.
        problem: &'static str,
    },

    /// A chain through a join whose messages may never lie within its window.
    #[error(
        "chain `{chain}` has no bounded reaction time: messages of `{input}` may be {gap_ns} ns apart, more than the window \
         of {window_ns} ns of `{task}`, so that no set may come together: make the window as long"
    )]
    Starved {
        /// The chain.
        chain: String,
        /// The join.
        task: String,
        /// The input.
        input: String,
        /// The window, in nanoseconds.
        window_ns: u64,
        /// How far apart its messages may be, in nanoseconds.
        gap_ns: u64,
    },

    /// A chain through a join that may never forward an input, whatever its window.
    #[error("chain `{chain}` has no bounded reaction time at `{task}`: {problem}")]
    NotReflected {
        /// The chain.
        chain: String,
        /// The join.
        task: String,
        /// Why it may not.
        problem: &'static str,
    },

    /// A chain through a value that others write, too.
    #[error(
        "chain `{chain}` has no bounded reaction time: `{other}` may overwrite what it passes on before that is read: let each publish a topic \
         of its own, or let the topic trigger the next callback"
    )]
    Overwritten {
        /// The chain.
        chain: String,
        /// Who else writes the value.
        other: String,
    },

    /// A task that is suspended when it overruns, but is not released in each period.
    #[error(
        "task `{task}` is suspended when it overruns, but may be released later than a period, so that nothing bounds what it takes from \
         others on its core: demote it instead, or lower its jitter"
    )]
    Bunched {
        /// The task.
        task: String,
    },

    /// The releases of a task come at once for longer than can be followed.
    #[error(
        "task `{task}` may be released {releases} times at once, by a jitter of {jitter_ns} ns, which is more than can be followed: lower its jitter"
    )]
    LongBurst {
        /// The task.
        task: String,
        /// How many releases come at once.
        releases: u64,
        /// Its jitter.
        jitter_ns: u64,
    },

    /// A system or chain that refers to a task, core or stage which is not there.
    #[error("`{name}` refers to {what} {index}, which does not exist: there are {count}")]
    BadReference {
        /// The task or chain at fault.
        name: String,
        /// What it refers to: `task` or `core`.
        what: &'static str,
        /// Its index.
        index: usize,
        /// How many exist.
        count: usize,
    },
}

/// Why the executor of a callback gives it no bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unbounded {
    /// Several threads run it and others at one priority, in an order that they choose, and poll while they wait for one another.
    MultiThreaded,
    /// Another thread passes it on, and it runs in its executor's own order.
    Events,
    /// A timer of an executor that takes messages first, of which the RMW always reports more.
    TimerAfterMessages,
}

impl std::fmt::Display for Unbounded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Unbounded::MultiThreaded => {
                "the threads of a MultiThreadedExecutor run callbacks in an order of their own, and poll while they wait for one another"
            }
            Unbounded::Events => {
                "an EventsExecutor gets its messages from another thread, and runs callbacks in an order of its own"
            }
            Unbounded::TimerAfterMessages => {
                "a StaticSingleThreadedExecutor takes the messages of all priorities before it runs a timer"
            }
        })
    }
}
