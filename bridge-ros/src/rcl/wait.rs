// SPDX-License-Identifier: MIT OR Apache-2.0
//! Waiting for several things at once.

use super::context::Context;
use super::error::{RclError, check};
use super::guard::{GraphGuard, GuardCondition};
use super::service::{RosClient, RosServer};
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
    /// A request can be taken.
    Server(&'a RosServer),
    /// A response can be taken.
    Client(&'a RosClient),
}

/// Waits; a thread has one of its own.
pub struct WaitSet {
    raw: rcl_wait_set_t,
    sizes: Sizes,
    ready: Vec<bool>,
    _context: Arc<Context>,
}

/// How many of each kind.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
struct Sizes {
    subscriptions: usize,
    guards: usize,
    servers: usize,
    clients: usize,
}

impl Sizes {
    fn of(all: &[Waitable<'_>]) -> Self {
        let mut sizes = Sizes::default();
        for one in all {
            *sizes.of_kind(one) += 1;
        }
        sizes
    }

    fn of_kind(&mut self, one: &Waitable<'_>) -> &mut usize {
        match one {
            Waitable::Subscription(_) => &mut self.subscriptions,
            Waitable::Guard(_) | Waitable::Graph(_) => &mut self.guards,
            Waitable::Server(_) => &mut self.servers,
            Waitable::Client(_) => &mut self.clients,
        }
    }
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
            Ok(WaitSet { raw, sizes: Sizes::default(), ready: Vec::new(), _context: context.clone() })
        }
    }

    /// Waits until one of `all` is ready, at most for `timeout` if there is one. Says of each, in their order, whether it
    /// is ready.
    ///
    /// # Errors
    /// [`RclError`].
    pub fn wait(&mut self, all: &[Waitable<'_>], timeout: Option<Duration>) -> Result<&[bool], RclError> {
        let sizes = Sizes::of(all);
        self.ready.clear();
        // SAFETY: the set is initialised; what is added to it lives until the wait has returned, for `all` is borrowed
        // so long, and is not looked at afterwards.
        unsafe {
            if sizes != self.sizes {
                let Sizes { subscriptions, guards, servers, clients } = sizes;
                let code = rcl_wait_set_resize(&mut self.raw, subscriptions, guards, 0, clients, servers, 0);
                check("resizing a wait set", code)?;
                self.sizes = sizes;
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
                    Waitable::Server(it) => rcl_wait_set_add_service(&mut self.raw, it.raw(), nowhere),
                    Waitable::Client(it) => rcl_wait_set_add_client(&mut self.raw, it.raw(), nowhere),
                };
                check("filling a wait set", code)?;
            }
            let timeout = timeout.map_or(-1, |timeout| i64::try_from(timeout.as_nanos()).unwrap_or(-1));
            let code = rcl_wait(&mut self.raw, timeout);
            if code != RCL_RET_TIMEOUT as rcl_ret_t {
                check("waiting", code)?;
            }
            let mut seen = Sizes::default();
            for one in all {
                let count = seen.of_kind(one);
                let index = *count;
                *count += 1;
                let is_ready = match one {
                    Waitable::Subscription(_) => !(*self.raw.subscriptions.add(index)).is_null(),
                    Waitable::Guard(_) | Waitable::Graph(_) => {
                        !(*self.raw.guard_conditions.add(index)).is_null()
                    }
                    Waitable::Server(_) => !(*self.raw.services.add(index)).is_null(),
                    Waitable::Client(_) => !(*self.raw.clients.add(index)).is_null(),
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
