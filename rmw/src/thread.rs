// SPDX-License-Identifier: MIT OR Apache-2.0
//! Threads of the system file: the thread that waits for a callback's messages runs that callback, and gets the priority and core that
//! the file states.
//!
//! A group may state that its thread has the running callback's priority. Such a thread has the highest of them, its ceiling, except from a
//! take until it takes again or waits: an RMW does not see a callback's end.

use crate::error::{Error, Result};
use std::cell::{Cell, RefCell};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use tautline_analysis::file::{CallbackEntry, CheckedCallback, OverrunPolicy};
use tautline_executor::foreign;
use tautline_rt::fork::{ProcessMark, ProcessMutex};
use tautline_rt::{CoreSet, MemoryLock, Policy, RtError, ThreadBuilder, prove_enforcement};

/// A thread as the system file states it.
#[derive(Debug)]
pub(crate) struct ThreadPlan {
    /// Its unique name in the file: `cb:` and the callback or group.
    pub(crate) name: String,
    /// That with which it waits.
    pub(crate) priority: u8,
    /// The lowest priority of its callbacks, if it runs each at its own.
    lowest: Option<u8>,
    core: usize,
    /// Whether the thread's callback is held to its budget; it is then the only callback of the thread.
    holds: bool,
    /// The last thread to which this plan was applied; 0: none.
    tid: AtomicU32,
}

/// The plan applied to a thread.
struct Applied {
    plan: Arc<ThreadPlan>,
    /// The process that applied it: a forked child's thread is ordinary.
    process: ProcessMark,
    /// The thread's priority: the plan's, or the running callback's; `None` if it was refused, for good.
    priority: Cell<Option<u8>>,
}

impl Applied {
    /// Gives this thread another priority.
    fn switch(&self, priority: u8) {
        if self.priority.get().is_none_or(|own| own == priority) {
            return;
        }
        let switched = tautline_rt::switch_own_priority(priority);
        // Logged once.
        self.priority.set(switched.is_ok().then_some(priority));
        if let Err(error) = switched {
            warn_of_refusal(&self.plan.refused(error));
        }
    }
}

thread_local! {
    static APPLIED: RefCell<Option<Applied>> = const { RefCell::new(None) };
}

/// Whether memory is locked.
static IS_PREPARED: ProcessMutex<bool> = ProcessMutex::new(false, || false);
/// Whether a warning was logged about an executor that runs callbacks of several threads.
static IS_WARNED: AtomicBool = AtomicBool::new(false);

impl ThreadPlan {
    /// The thread of `callback`, one of `all`.
    pub(crate) fn of(callback: &CheckedCallback, all: &[CheckedCallback]) -> Self {
        let CallbackEntry { thread: name, priority, overrun, .. } = &callback.entry;
        let own = all.iter().map(|of| &of.entry).filter(|of| of.thread == *name);
        let lowest = own.map(CallbackEntry::running_priority).min().filter(|lowest| lowest < priority);
        let (name, priority, core) = (name.clone(), *priority, callback.core);
        let holds = *overrun == OverrunPolicy::Demote;
        ThreadPlan { name, priority, lowest, core, holds, tid: AtomicU32::new(0) }
    }

    fn refused(&self, error: RtError) -> Error {
        Error::other(format!(
            "thread '{}' of TAUT_SYSTEM: {error}; TAUT_REALTIME=off only measures",
            self.name
        ))
    }

    /// Checks whether a thread may have the priority and core, by a thread that has them for a moment, and may be held to its budget there.
    pub(crate) fn check_permission(&self) -> Result {
        let probe =
            ThreadBuilder::new("rt-probe").policy(Policy::Fifo(self.priority)).cores(CoreSet::one(self.core));
        let is_permitted =
            probe.spawn(|| || ()).and_then(|thread| thread.join()).and_then(|()| match self.holds {
                true => prove_enforcement(self.priority.saturating_add(1)).map(drop),
                false => Ok(()),
            });
        is_permitted.map_err(|error| self.refused(error))
    }

    /// Gives this thread its priority and core, and reads both back, as before that the lowest priority of its callbacks. Threads that it
    /// starts are ordinary again.
    fn apply(&self) -> Result {
        let refuse = |error| self.refused(error);
        prepare().map_err(refuse)?;
        tautline_rt::prefault_stack(ThreadBuilder::STACK_BYTES / 4);
        for priority in self.lowest.into_iter().chain([self.priority]) {
            tautline_rt::set_own_priority(priority).map_err(refuse)?;
        }
        tautline_rt::set_affinity(CoreSet::one(self.core)).map_err(refuse)?;
        foreign::hold_to_budgets(Policy::Fifo(self.priority), self.holds).map_err(refuse)?;
        let (tid, name) = (tautline_rt::current_tid(), &self.name);
        let former = self.tid.swap(tid, Ordering::Relaxed);
        if former != 0 && former != tid && tautline_rt::policy_of(former).is_ok() {
            tracing::warn!(
                "two threads, {former} and {tid}, wait for callbacks of '{name}', which the system file gives one thread: its bounds do not \
                 hold; use one executor for them, with one thread, or name two groups in the file"
            );
        }
        let lower = self.lowest.map(|lowest| format!(", in callbacks their own, from {lowest} on"));
        let lower = lower.unwrap_or_default();
        tracing::info!("this thread is '{name}' of the system file: SCHED_FIFO {}{lower}", self.priority);
        Ok(())
    }
}

/// Prepares the process for the first governed thread: memory is locked, and freed memory is reused.
fn prepare() -> std::result::Result<(), RtError> {
    let mut is_prepared = IS_PREPARED.lock();
    if !*is_prepared {
        tautline_rt::lock_memory(MemoryLock::OnFault)?;
        tautline_rt::keep_freed_memory();
        *is_prepared = true;
    }
    Ok(())
}

/// Applies the plan that all `wanted` name to this thread. If they name several, the one with the highest priority is applied, and a
/// warning names two. A thread never gets a lower priority than it got here before.
///
/// # Real-time
/// O(wanted); no syscall and no allocation if the thread is that already.
///
/// # Errors
/// Locked memory, the priority or the core is refused.
pub(crate) fn govern<'p>(wanted: impl Iterator<Item = &'p Arc<ThreadPlan>>) -> Result {
    let (mut highest, mut other): (Option<&Arc<ThreadPlan>>, Option<&Arc<ThreadPlan>>) = (None, None);
    for plan in wanted {
        match highest {
            Some(known) if Arc::ptr_eq(known, plan) => {}
            Some(known) if known.priority >= plan.priority => other = Some(plan),
            known => (highest, other) = (Some(plan), known.or(other)),
        }
    }
    let Some(plan) = highest else { return Ok(()) };
    if let Some(other) = other {
        warn_of_two(plan, other);
    }
    become_thread(plan).map(drop)
}

fn warn_of_two(plan: &ThreadPlan, other: &ThreadPlan) {
    if !IS_WARNED.swap(true, Ordering::Relaxed) {
        tracing::warn!(
            "one executor runs callbacks of two threads of the system file, '{}' and '{}': give each an executor, or name one group for \
             them",
            plan.name,
            other.name
        );
    }
}

/// Applies `plan` to this thread, unless it is applied, or one for another thread with that priority or a higher one. Returns whether it
/// was applied.
fn become_thread(plan: &Arc<ThreadPlan>) -> Result<bool> {
    let is_applied = |applied: &Applied| {
        let Applied { plan: applied, .. } = applied;
        if Arc::ptr_eq(applied, plan) {
            return true;
        }
        // A context that was made after another one has plans of its own.
        if applied.name == plan.name {
            return false;
        }
        warn_of_two(plan, applied);
        applied.priority >= plan.priority
    };
    // A thread in shutdown has no thread-locals.
    let is_new = APPLIED.try_with(|applied| !with(applied, is_applied).unwrap_or(false)).unwrap_or(false);
    if is_new {
        plan.apply()?;
        note_applied(plan, true);
    }
    Ok(is_new)
}

/// What is applied to this thread in this process.
fn with<R>(applied: &RefCell<Option<Applied>>, using: impl FnOnce(&Applied) -> R) -> Option<R> {
    applied.borrow().as_ref().filter(|applied| applied.process.is_here()).map(using)
}

fn note_applied(plan: &Arc<ThreadPlan>, is_governed: bool) {
    let priority = Cell::new(is_governed.then_some(plan.priority));
    let new = Applied { plan: plan.clone(), process: ProcessMark::new(), priority };
    let _ = APPLIED.try_with(|applied| applied.replace(Some(new)));
}

fn warn_of_refusal(error: &Error) {
    tracing::warn!("thread {} stays as it is: {error:?}", tautline_rt::current_tid());
}

/// Governs this thread, which runs a callback, as it has taken its message or published what only this callback publishes. Returns whether
/// the plan was applied now.
///
/// # Real-time
/// As [`govern`].
pub(crate) fn govern_runner(plan: &Arc<ThreadPlan>) -> bool {
    become_thread(plan).unwrap_or_else(|error| {
        warn_of_refusal(&error);
        // Logged once.
        note_applied(plan, false);
        false
    })
}

/// Governs this thread, which has taken a callback's message. Usually it has waited for it, and this does nothing.
///
/// # Real-time
/// As [`govern`].
pub(crate) fn govern_taker(plan: &Arc<ThreadPlan>) {
    if govern_runner(plan) {
        tracing::warn!(
            "thread {} takes messages of '{}' and does not wait for them in the RMW, as those of a MultiThreadedExecutor or an EventsExecutor \
             do: from this message on it has the file's priority and core, but its jobs seem longer than they are; its bounds need an executor \
             with one thread that waits",
            tautline_rt::current_tid(),
            plan.name
        );
    }
}

/// Gives this thread the priority of the callback whose message it has taken, if it is the callback's thread and the file states that it runs
/// each at its own: until [`raise`].
///
/// # Real-time
/// At most one syscall; no allocation.
pub(crate) fn run_at(plan: &Arc<ThreadPlan>, priority: u8) {
    if plan.lowest.is_some() {
        let switch = |applied: &Applied| {
            if Arc::ptr_eq(&applied.plan, plan) {
                applied.switch(priority);
            }
        };
        let _ = APPLIED.try_with(|applied| with(applied, switch));
    }
}

/// Gives this thread, which takes or waits, the priority of its plan again.
///
/// # Real-time
/// A few loads, and one syscall after [`run_at`] another priority; no allocation.
pub(crate) fn raise() {
    let _ = APPLIED.try_with(|applied| with(applied, |applied| applied.switch(applied.plan.priority)));
}
