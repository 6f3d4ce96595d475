// SPDX-License-Identifier: MIT OR Apache-2.0
//! The priority of a thread that is demoted now and then.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

use crate::schedule::schedule;
use crate::{Enforcement, Policy, RtError, set_policy_of};

/// The `SCHED_FIFO` or `SCHED_RR` priority of a thread, which other threads can change. A thread that is demoted at that time gets the new
/// priority when the demotion ends.
#[derive(Debug)]
pub struct OwnPriority {
    is_round_robin: bool,
    /// The kernel's flag for threads that start ordinary threads, which a thread without privileges cannot clear.
    flags: libc::c_int,
    priority: AtomicU8,
    /// Set before the thread lowers its own priority, and cleared before it gets its priority back.
    lowered: AtomicBool,
    /// What enforces the thread's budgets, once it has a `BudgetTimer`.
    pub(crate) enforced: OnceLock<Enforcement>,
}

impl OwnPriority {
    /// How often a change is repeated, because the thread has changed its policy itself meanwhile.
    const TRIES: u32 = 1_000;

    /// The priority of a thread with this policy. A thread without a priority gets `SCHED_FIFO` if it is changed.
    pub fn new(policy: Policy) -> OwnPriority {
        OwnPriority {
            is_round_robin: matches!(policy, Policy::RoundRobin(_)),
            flags: 0,
            priority: AtomicU8::new(policy.realtime_priority().unwrap_or(1)),
            lowered: AtomicBool::new(false),
            enforced: OnceLock::new(),
        }
    }

    /// The priority of a thread that got it with [`set_own_priority`](crate::set_own_priority): threads that it starts are ordinary.
    pub fn with_ordinary_children(policy: Policy) -> OwnPriority {
        OwnPriority { flags: libc::SCHED_RESET_ON_FORK, ..OwnPriority::new(policy) }
    }

    /// The policy that the thread has, or gets back after a demotion.
    pub fn policy(&self) -> Policy {
        self.with(self.priority.load(Ordering::SeqCst))
    }

    pub(crate) const fn with(&self, priority: u8) -> Policy {
        if self.is_round_robin { Policy::RoundRobin(priority) } else { Policy::Fifo(priority) }
    }

    /// Demotes the thread, which calls it, also in a signal handler. False if the kernel refuses.
    pub(crate) fn lower(&self) -> bool {
        self.lowered.store(true, Ordering::SeqCst);
        let is_lowered = schedule(Policy::Other { nice: 0 }, self.flags);
        if !is_lowered {
            self.lowered.store(false, Ordering::SeqCst);
        }
        is_lowered
    }

    /// Restores the thread's own priority, which other threads may change meanwhile. False if the kernel refuses, because the process no
    /// longer has the privilege: the thread then stays demoted.
    pub(crate) fn resume(&self) -> bool {
        self.lowered.store(false, Ordering::SeqCst);
        // A thread that changes the priority later sets the policy, too.
        for _ in 0..8 {
            let policy = self.policy();
            if !schedule(policy, self.flags) {
                self.lowered.store(true, Ordering::SeqCst);
                return false;
            }
            if self.policy() == policy {
                break;
            }
        }
        true
    }

    /// Gives thread `tid` another priority, or its former one with an error.
    pub(crate) fn replace(&self, tid: u32, priority: u8) -> Result<(), RtError> {
        let former = self.priority.swap(priority, Ordering::SeqCst);
        let changed = self.settle(tid);
        if changed.is_err() {
            self.priority.store(former, Ordering::SeqCst);
            // The thread may have its former policy already.
            let _ = self.settle(tid);
        }
        changed
    }

    /// Sets the thread's policy, again if the thread has changed it meanwhile. The thread's later changes use the stored priority.
    fn settle(&self, tid: u32) -> Result<(), RtError> {
        let mut outcome = Ok(());
        for _ in 0..Self::TRIES {
            let lowered = self.lowered.load(Ordering::SeqCst);
            let policy = if lowered { Policy::Other { nice: 0 } } else { self.policy() };
            outcome = match set_policy_of(tid, policy) {
                Err(error @ RtError::PolicyNotKept { .. }) => Err(error),
                Err(error) => return Err(error),
                Ok(()) if self.lowered.load(Ordering::SeqCst) == lowered => return Ok(()),
                Ok(()) => continue,
            };
        }
        outcome
    }
}
