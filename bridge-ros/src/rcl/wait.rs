// SPDX-License-Identifier: MIT OR Apache-2.0
//! Waiting for several things at once.

use super::context::Context;
use super::error::{RclError, check};
use super::guard::{GraphGuard, GuardCondition};
use super::subscription::RosSubscription;
use r2r_rcl::*;
use std::sync::Arc;
use std::time::Duration;

/// What can be waited for.
pub enum Waitable<'a> {
    /// A message can be taken.
    Subscription(&'a RosSubscription),
    /// It was triggered.
    Guard(&'a GuardCondition),
    /// The graph changed.
    Graph(&'a GraphGuard),
}

/// Waits; a thread has one of its own.
pub struct WaitSet {
    raw: rcl_wait_set_t,
    subscriptions: usize,
    guards: usize,
    ready: Vec<bool>,
    _context: Arc<Context>,
}

// SAFETY: it is used by one thread at a time.
unsafe impl Send for WaitSet {}

impl WaitSet {
    /// Makes one.
    ///
    /// # Errors
    /// [`RclError`].
    pub fn new(context: &Arc<Context>) -> Result<Self, RclError> {
        // SAFETY: rcl's protocol: zero, initialise.
        unsafe {
            let mut raw = rcl_get_zero_initialized_wait_set();
            let allocator = rcutils_get_default_allocator();
            let made = rcl_wait_set_init(&mut raw, 0, 0, 0, 0, 0, 0, context.raw(), allocator);
            check("making a wait set", made)?;
            Ok(WaitSet { raw, subscriptions: 0, guards: 0, ready: Vec::new(), _context: context.clone() })
        }
    }

    /// Waits until one of `all` is ready, at most for `timeout` if there is one. Says of each, in their order, whether it
    /// is ready.
    ///
    /// # Errors
    /// [`RclError`].
    pub fn wait(&mut self, all: &[Waitable<'_>], timeout: Option<Duration>) -> Result<&[bool], RclError> {
        let subscriptions = all.iter().filter(|one| matches!(one, Waitable::Subscription(_))).count();
        let guards = all.len() - subscriptions;
        self.ready.clear();
        // SAFETY: the set is initialised; what is added to it lives until the wait has returned, for `all` is borrowed
        // so long, and is not looked at afterwards.
        unsafe {
            if (subscriptions, guards) != (self.subscriptions, self.guards) {
                check(
                    "resizing a wait set",
                    rcl_wait_set_resize(&mut self.raw, subscriptions, guards, 0, 0, 0, 0),
                )?;
                (self.subscriptions, self.guards) = (subscriptions, guards);
            }
            check("clearing a wait set", rcl_wait_set_clear(&mut self.raw))?;
            for one in all {
                let nowhere = std::ptr::null_mut();
                let code = match one {
                    Waitable::Subscription(it) => {
                        rcl_wait_set_add_subscription(&mut self.raw, it.raw(), nowhere)
                    }
                    Waitable::Guard(it) => rcl_wait_set_add_guard_condition(&mut self.raw, it.raw(), nowhere),
                    Waitable::Graph(it) => rcl_wait_set_add_guard_condition(&mut self.raw, it.raw(), nowhere),
                };
                check("filling a wait set", code)?;
            }
            let timeout = timeout.map_or(-1, |timeout| i64::try_from(timeout.as_nanos()).unwrap_or(-1));
            let code = rcl_wait(&mut self.raw, timeout);
            if code != RCL_RET_TIMEOUT as rcl_ret_t {
                check("waiting", code)?;
            }
            let (mut subscription, mut guard) = (0, 0);
            for one in all {
                let is_ready = match one {
                    Waitable::Subscription(_) => {
                        subscription += 1;
                        !(*self.raw.subscriptions.add(subscription - 1)).is_null()
                    }
                    _ => {
                        guard += 1;
                        !(*self.raw.guard_conditions.add(guard - 1)).is_null()
                    }
                };
                self.ready.push(is_ready && code == RCL_RET_OK as rcl_ret_t);
            }
        }
        Ok(&self.ready)
    }
}

impl Drop for WaitSet {
    fn drop(&mut self) {
        // SAFETY: initialised, and nobody else has it.
        let _ = unsafe { rcl_wait_set_fini(&mut self.raw) };
    }
}
