// SPDX-License-Identifier: MIT OR Apache-2.0
//! Errors of callback threads.

use std::fmt;

use tautline_rt::{Policy, RtError};

/// Why a callback could not be started, or how it ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExecutorError {
    /// The thread could not be set up; the source names the fix.
    #[error("callback `{name}` cannot start: {source}")]
    Thread {
        /// The callback.
        name: String,
        /// The cause.
        source: RtError,
    },
    /// There is no shared memory for the callback's statistics.
    #[error("callback `{name}` cannot start: no slot for its statistics: {source}")]
    Statistics {
        /// The callback.
        name: String,
        /// The cause.
        source: std::io::Error,
    },
    /// There is no bell that publishers could ring.
    #[error("callback `{name}` cannot start with direct wake-ups: {source}")]
    DirectWake {
        /// The callback.
        name: String,
        /// The cause.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A handler that would never be called.
    #[error(
        "callback `{name}` has a handler for overruns, but its execution times are not measured: drop \
         `.execution_time(false)`, or the handler"
    )]
    UnmeasuredBudget {
        /// The callback.
        name: String,
    },
    /// The callback's budget cannot be enforced.
    #[error("callback `{name}` cannot be held to its budget: {problem}")]
    CannotHold {
        /// The callback.
        name: String,
        /// The reason, and the fix.
        problem: &'static str,
    },
    /// The callback runs under a policy that cannot become the requested one.
    #[error(
        "callback `{name}` runs under {from}, which cannot become {to} while it runs: restart its program"
    )]
    CannotChange {
        /// The callback.
        name: String,
        /// Its present policy.
        from: Policy,
        /// The requested policy.
        to: Policy,
    },
    /// Busy polling without exactly one core.
    #[error(
        "callback `{name}` cannot busy-poll on cores {cores}: give it exactly one, with CallbackOptions::core"
    )]
    BusyPollCores {
        /// The callback.
        name: String,
        /// The cores it may run on.
        cores: String,
    },
    /// Real-time busy polling where the machine, or the process's cpuset, has one core.
    #[error(
        "callback `{name}` cannot busy-poll at real-time priority {priority} on the only core that this process may use: \
         drop busy_poll, or use CallbackOptions::other"
    )]
    BusyPollOnlyCore {
        /// The callback.
        name: String,
        /// Its priority.
        priority: u8,
    },
    /// A thread would never run, because busy-polling callbacks of its priority or above occupy all its
    /// cores.
    #[error(
        "`{busy}`, which busy-polls at priority {busy_priority}, would starve `{starved}`, which may run on \
         {cores} only: move one of them to another core, or give `{starved}` a priority above {busy_priority}"
    )]
    Starved {
        /// The busy-polling callback.
        busy: String,
        /// Its priority.
        busy_priority: u8,
        /// The thread that would never run.
        starved: String,
        /// The cores of that thread.
        cores: String,
    },
    /// Callbacks that panicked; the others were joined as usual.
    #[error("{}", list(callbacks))]
    Panicked {
        /// All of them, in the order of their start.
        callbacks: Vec<Panic>,
    },
    /// A callback waits for its own end.
    #[error("callback `{name}` cannot wait for its own end: join it from another thread")]
    JoinsItself {
        /// The callback.
        name: String,
    },
    /// More distinct periods or deadlines than priorities.
    #[error(
        "{levels} distinct values need {levels} priorities, but there are only {highest} from 1 to {highest}: \
             start higher, or give some callbacks equal values"
    )]
    TooFewPriorities {
        /// Distinct values.
        levels: usize,
        /// The highest priority allowed.
        highest: u8,
    },
    /// A highest priority outside 1..=99.
    #[error("the highest priority {highest} is out of range: SCHED_FIFO takes 1 to 99")]
    BadHighest {
        /// The requested value.
        highest: u8,
    },
}

/// A callback that panicked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Panic {
    /// The callback.
    pub callback: String,
    /// The panic's message.
    pub message: String,
}

impl fmt::Display for Panic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "callback `{}` panicked: {}", self.callback, self.message)
    }
}

fn list(panics: &[Panic]) -> String {
    panics.iter().map(Panic::to_string).collect::<Vec<_>>().join("; ")
}
