// SPDX-License-Identifier: MIT OR Apache-2.0
//! The wait set.

use super::context::Context;
use super::error::{RclError, check};
use super::guard::{GraphGuard, GuardCondition};
use super::service::{RosClient, RosServer};
use super::subscription::RosSubscription;
use r2r_rcl::*;
use std::sync::Arc;
use std::time::Duration;

/// An entity to wait for.
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

/// A wait set; each thread has its own.
pub struct WaitSet {
    raw: rcl_wait_set_t,
    /// Capacity for subscriptions, guard conditions, clients and services.
    sizes: [usize; 4],
    /// The index of each entity in the set, among its kind.
    places: Vec<usize>,
    ready: Vec<bool>,
    _context: Arc<Context>,
}

// SAFETY: it is used by one thread at a time.
unsafe impl Send for WaitSet {}

impl WaitSet {
    /// Creates a wait set.
    pub fn new(context: &Arc<Context>) -> Result<Self, RclError> {
        // SAFETY: rcl's protocol: zero, initialise.
        unsafe {
            let mut raw = rcl_get_zero_initialized_wait_set();
            let allocator = rcutils_get_default_allocator();
            let made = rcl_wait_set_init(&mut raw, 0, 0, 0, 0, 0, 0, context.raw(), allocator);
            check("making a wait set", made)?;
            let (sizes, places, ready) = Default::default();
            Ok(WaitSet { raw, sizes, places, ready, _context: context.clone() })
        }
    }

    /// Waits until one of `all` is ready, at most for `timeout` if given. Returns for each, in order, whether it is ready.
    pub fn wait(&mut self, all: &[Waitable<'_>], timeout: Option<Duration>) -> Result<&[bool], RclError> {
        let count = |is: fn(&Waitable<'_>) -> bool| all.iter().filter(|one| is(one)).count();
        let sizes = [
            count(|one| matches!(one, Waitable::Subscription(_))),
            count(|one| matches!(one, Waitable::Guard(_) | Waitable::Graph(_))),
            count(|one| matches!(one, Waitable::Client(_))),
            count(|one| matches!(one, Waitable::Server(_))),
        ];
        self.places.clear();
        self.ready.clear();
        // SAFETY: the set is initialised; entities in it live until the wait returns, because `all` is borrowed for that time,
        // and are not accessed afterwards.
        unsafe {
            if sizes != self.sizes {
                let [subscriptions, guards, clients, servers] = sizes;
                let code = rcl_wait_set_resize(&mut self.raw, subscriptions, guards, 0, clients, servers, 0);
                check("resizing a wait set", code)?;
                self.sizes = sizes;
            }
            check("clearing a wait set", rcl_wait_set_clear(&mut self.raw))?;
            for one in all {
                let (set, mut place) = (&mut self.raw, 0);
                let code = match one {
                    Waitable::Subscription(it) => rcl_wait_set_add_subscription(set, it.raw(), &mut place),
                    Waitable::Guard(it) => rcl_wait_set_add_guard_condition(set, it.raw(), &mut place),
                    Waitable::Graph(it) => rcl_wait_set_add_guard_condition(set, it.raw(), &mut place),
                    Waitable::Server(it) => rcl_wait_set_add_service(set, it.raw(), &mut place),
                    Waitable::Client(it) => rcl_wait_set_add_client(set, it.raw(), &mut place),
                };
                check("filling a wait set", code)?;
                self.places.push(place);
            }
            let timeout = timeout.map_or(-1, |timeout| i64::try_from(timeout.as_nanos()).unwrap_or(-1));
            let code = rcl_wait(&mut self.raw, timeout);
            if code != RCL_RET_TIMEOUT as rcl_ret_t {
                check("waiting", code)?;
            }
            for (one, &place) in all.iter().zip(&self.places) {
                // Entities that are not ready are null now.
                let is_ready = match one {
                    Waitable::Subscription(_) => !(*self.raw.subscriptions.add(place)).is_null(),
                    Waitable::Guard(_) | Waitable::Graph(_) => {
                        !(*self.raw.guard_conditions.add(place)).is_null()
                    }
                    Waitable::Server(_) => !(*self.raw.services.add(place)).is_null(),
                    Waitable::Client(_) => !(*self.raw.clients.add(place)).is_null(),
                };
                self.ready.push(is_ready && code == RCL_RET_OK as rcl_ret_t);
            }
        }
        Ok(&self.ready)
    }
}

impl Drop for WaitSet {
    fn drop(&mut self) {
        // SAFETY: initialised and exclusive.
        let _ = unsafe { rcl_wait_set_fini(&mut self.raw) };
    }
}
