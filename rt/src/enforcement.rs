// SPDX-License-Identifier: MIT OR Apache-2.0
//! The kinds of enforcement of budgets.

/// What ends the budget of a thread that never sleeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Enforcement {
    /// The thread's own timer, which the kernel serves in an interrupt, or in a thread of higher priority.
    Timer,
    /// The enforcer: a thread of this process with a higher priority. For kernels whose timers do not reach such a thread (PREEMPT_RT
    /// as shipped serves them at `SCHED_FIFO` 1).
    Enforcer,
}

crate::names!(Enforcement: Display {
    Timer: "a timer of each thread", Enforcer: "the enforcer, a thread of higher priority",
});
