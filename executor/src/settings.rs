// SPDX-License-Identifier: MIT OR Apache-2.0
//! Changes of running callbacks: priorities, reservations, budgets, deadlines.

use std::sync::{Arc, Mutex, PoisonError};

use tautline_rt::{Policy, RtError, policy_of, set_policy_of};

use crate::callback::CallbackShared;
use crate::{CallbackOptions, ExecutorError};

/// The callbacks of an executor, including some that have ended.
pub(crate) type Callbacks = Arc<Mutex<Vec<Arc<CallbackShared>>>>;

/// Access to the callbacks of an [`Executor`](crate::Executor), without keeping the executor alive: see
/// [`Executor::settings`](crate::Executor::settings).
#[derive(Clone)]
pub struct CallbackSettings {
    callbacks: Callbacks,
}

impl CallbackSettings {
    pub(crate) fn new(callbacks: Callbacks) -> CallbackSettings {
        CallbackSettings { callbacks }
    }

    /// Gives every running callback with the name of `options` the priority or reservation of the policy in `options`, and its budget,
    /// deadline and bound. Returns the number of these callbacks. Everything else stays unchanged. For a member of a group, the group's
    /// thread gets the priority. A job that is running keeps its former budget.
    ///
    /// # Real-time
    /// Not for callback threads: some system calls for each callback, and a lock.
    ///
    /// # Errors
    /// [`ExecutorError::CannotChange`]: the callback runs under another kind of policy. [`ExecutorError::Thread`]: the kernel refuses.
    /// Callbacks that were already changed get their former policies again.
    pub fn change(&self, options: &CallbackOptions) -> Result<usize, ExecutorError> {
        let callbacks = self.callbacks.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let running = callbacks.iter().filter(|callback| !callback.end.has_ended());
        let found: Vec<_> = running
            .filter_map(|callback| {
                let mut all = std::iter::once(&callback.stats).chain(&callback.members);
                Some((callback, all.find(|stats| stats.name() == options.name)?))
            })
            .collect();
        let mut changed: Vec<(&CallbackShared, Policy)> = Vec::new();
        for (callback, _) in &found {
            match set(callback, &options.name, options.policy) {
                Ok(former) => changed.push((callback, former)),
                Err(error) => {
                    for (callback, former) in changed {
                        let _ = set(callback, &options.name, former);
                    }
                    return Err(error);
                }
            }
        }
        found.iter().for_each(|(_, stats)| stats.set_limits(options));
        Ok(found.len())
    }
}

/// Sets the thread's policy, and returns the former one.
fn set(callback: &CallbackShared, name: &str, policy: Policy) -> Result<Policy, ExecutorError> {
    let failed = |source: RtError| ExecutorError::Thread { name: name.to_owned(), source };
    let tid = callback.info.tid;
    let former = match callback.info.policy {
        Policy::Fifo(_) | Policy::RoundRobin(_) => callback.priority.policy(),
        _ => policy_of(tid).map_err(failed)?,
    };
    match (former, policy) {
        // A thread without a real-time policy has no priority to change.
        (Policy::Other { .. } | Policy::Unmanaged(_), _) => return Ok(former),
        (Policy::Fifo(_), Policy::Fifo(priority)) | (Policy::RoundRobin(_), Policy::RoundRobin(priority)) => {
            callback.priority.change(tid, priority).map_err(failed)?;
        }
        (Policy::Deadline { .. }, Policy::Deadline { .. }) => set_policy_of(tid, policy).map_err(failed)?,
        (from, to) => return Err(ExecutorError::CannotChange { name: name.to_owned(), from, to }),
    }
    for stats in std::iter::once(&callback.stats).chain(&callback.members) {
        stats.describe_priority(policy);
    }
    Ok(former)
}

tautline_rt::debug_fields!(CallbackSettings);
