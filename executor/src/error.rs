// SPDX-License-Identifier: MIT OR Apache-2.0
//! What can go wrong with callback threads.

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
        /// What was refused.
        source: RtError,
    },
    /// No memory that other processes can read.
    #[error("callback `{name}` cannot start: no place for its statistics: {source}")]
    Statistics {
        /// The callback.
        name: String,
        /// What was refused.
        source: std::io::Error,
    },
    /// Nothing that publishers could wake.
    #[error("callback `{name}` cannot start with direct wake-ups: {source}")]
    DirectWake {
        /// The callback.
        name: String,
        /// What was refused.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A handler that nothing would ever call.
    #[error(
        "callback `{name}` has a handler for overruns, but its execution times are not measured: drop \
         `.execution_time(false)`, or the handler"
    )]
    UnmeasuredBudget {
        /// The callback.
        name: String,
    },
    /// Jobs that cannot be held to their budget.
    #[error("callback `{name}` is to be held to its budget, but {problem}")]
    CannotHold {
        /// The callback.
        name: String,
        /// Why not, and what to do.
        problem: &'static str,
    },
    /// A callback that runs under another kind of policy than it is to have.
    #[error(
        "callback `{name}` runs under {from}, which cannot become {to} while it runs: restart its program"
    )]
    CannotChange {
        /// The callback.
        name: String,
        /// What it has.
        from: Policy,
        /// What it was to have.
        to: Policy,
    },
    /// Busy polling without a core of its own.
    #[error(
        "callback `{name}` cannot busy-poll on cores {cores}: give it exactly one, with CallbackOptions::core"
    )]
    BusyPollCores {
        /// The callback.
        name: String,
        /// The cores it may run on.
        cores: String,
    },
    /// Real-time busy polling on a machine with one core.
    #[error(
        "callback `{name}` cannot busy-poll at real-time priority {priority} on the only core of this machine: \
         drop busy_poll, or use CallbackOptions::other"
    )]
    BusyPollOnlyCore {
        /// The callback.
        name: String,
        /// Its priority.
        priority: u8,
    },
    /// A thread would never run, because busy pollers of its priority or above hold all its cores.
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
    /// A callback that waits for its own end.
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
        /// The one asked for.
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
