// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads of the system file: the thread that waits for a callback's messages runs that callback, and gets the policy and core that the
//! file states.

use crate::error::{Error, Result};
use std::cell::RefCell;
use std::sync::Arc;
use tautline_analysis::file::CheckedCallback;
use tautline_rt::{CoreSet, MemoryLock, Policy, ThreadBuilder};

/// What the file states of a thread.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct ThreadPlan {
    /// Its name in the file: `cb:` and the callback or group.
    name: String,
    policy: Policy,
    /// `None`: any core.
    core: Option<usize>,
}

thread_local! {
    /// What this thread has.
    static APPLIED: RefCell<Option<Arc<ThreadPlan>>> = const { RefCell::new(None) };
}

impl ThreadPlan {
    pub(crate) fn of(callback: &CheckedCallback) -> Self {
        let entry = &callback.entry;
        let policy = match entry.reservation {
            Some(reservation) => {
                Policy::Deadline { runtime_ns: reservation.runtime_ns, period_ns: reservation.period_ns }
            }
            None => Policy::Fifo(entry.priority),
        };
        let core = (!entry.floats).then_some(callback.core);
        ThreadPlan { name: entry.thread.clone(), policy, core }
    }

    /// Gives this thread its policy and core, and reads both back.
    fn apply(&self) -> Result {
        let refuse = |error: tautline_rt::RtError| {
            Error::other(format!(
                "thread '{}' of TAUT_SYSTEM: {error}; TAUT_REALTIME=off only measures",
                self.name
            ))
        };
        tautline_rt::prefault_stack(ThreadBuilder::STACK_BYTES / 4);
        if let Some(core) = self.core {
            tautline_rt::set_affinity(CoreSet::one(core)).map_err(refuse)?;
        }
        tautline_rt::set_policy(self.policy).map_err(refuse)?;
        tracing::info!("this thread is '{}' of the system file: {}", self.name, self.policy);
        Ok(())
    }
}

/// Before the first thread is governed: memory stays in place, and what was freed is used again.
pub(crate) fn prepare() -> Result {
    let refuse = |error| Error::other(format!("TAUT_SYSTEM: {error}; TAUT_REALTIME=off only measures"));
    tautline_rt::lock_memory(MemoryLock::OnFault).map_err(refuse)?;
    tautline_rt::keep_freed_memory();
    Ok(())
}

/// Makes this thread the one that all `wanted` name. If they name several, it is the one with the highest priority, and a warning names two.
///
/// # Real-time
/// O(wanted); no syscall and no allocation if the thread is that already.
///
/// # Errors
/// The policy or the core is refused.
pub(crate) fn govern<'p>(wanted: impl Iterator<Item = &'p Arc<ThreadPlan>>) -> Result {
    let (mut highest, mut other): (Option<&Arc<ThreadPlan>>, Option<&Arc<ThreadPlan>>) = (None, None);
    for plan in wanted {
        match highest {
            Some(known) if Arc::ptr_eq(known, plan) => {}
            Some(known) if rank(known.policy) >= rank(plan.policy) => other = Some(plan),
            known => (highest, other) = (Some(plan), known.or(other)),
        }
    }
    let Some(plan) = highest else { return Ok(()) };
    let is_applied = |applied: &RefCell<Option<Arc<ThreadPlan>>>| {
        applied.borrow().as_ref().is_some_and(|applied| Arc::ptr_eq(applied, plan))
    };
    // A thread in shutdown has no thread-locals.
    if APPLIED.try_with(is_applied).unwrap_or(true) {
        return Ok(());
    }
    if let Some(other) = other {
        tracing::warn!(
            "one executor waits for callbacks of two threads of the system file, '{}' and '{}': give each an executor, or name one group for \
             them",
            plan.name,
            other.name
        );
    }
    plan.apply()?;
    let _ = APPLIED.try_with(|applied| applied.replace(Some(plan.clone())));
    Ok(())
}

fn rank(policy: Policy) -> u8 {
    match policy {
        Policy::Fifo(priority) => priority,
        // Above all others.
        _ => u8::MAX,
    }
}
