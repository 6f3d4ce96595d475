// SPDX-License-Identifier: MIT OR Apache-2.0
//! An end that messages come to: used by one thread at a time, and whom its publishers wake.

use crate::callback::{Callback, Function};
use crate::helper::Helper;
use crate::signal::Waiter;
use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::task::{Poll, Waker};
use std::time::Duration;
use tautline_rt::PiMutex;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{RawSample, RawSubscription, TakeError, Wakeable};

/// What has a queue of messages.
pub(crate) trait Port: Send + 'static {
    fn subscription(&self) -> &RawSubscription;
}

impl Port for RawSubscription {
    fn subscription(&self) -> &RawSubscription {
        self
    }
}

/// A port of ROS's, which several threads use in turn.
pub(crate) struct End<P> {
    side: PiMutex<(P, Route)>,
    /// For new messages.
    callback: Callback,
    /// The helper has a task that calls it.
    is_served: AtomicBool,
    /// How many messages the callback was called for, since the end was made.
    told: AtomicU64,
}

/// Where the rings of a port go.
#[derive(Default)]
struct Route {
    to: Option<Arc<Waiter>>,
    /// The helper's task that calls for new messages.
    task: Option<Waker>,
}

/// How long a take waits for a sample that came in memory which is not mapped here yet, and how often it looks.
const MAPPING_NS: u64 = 20_000_000;
const LOOK: Duration = Duration::from_micros(50);

impl<P: Port> End<P> {
    pub(crate) fn new(port: P) -> Arc<Self> {
        let (callback, is_served, told) = Default::default();
        Arc::new(End { side: PiMutex::new((port, Route::default())), callback, is_served, told })
    }

    /// Uses the port.
    ///
    /// # Real-time
    /// Waits for who uses it right now, and lends it this thread's priority.
    pub(crate) fn with<T>(&self, using: impl FnOnce(&mut P) -> T) -> T {
        using(&mut self.side.lock().0)
    }

    /// # Real-time
    /// As [`with`](Self::with), O(publishers).
    pub(crate) fn has_data(&self) -> bool {
        self.with(|port| port.subscription().has_samples())
    }

    /// Has `waiter` woken by what comes, once; the caller looks into the queue after this.
    ///
    /// Publishers wake the waiter's thread themselves, if its bell has a place for them. What is no publisher's ring is the sampler's in
    /// any case, whose place the helper has: when a publisher is connected that has sent something before, a new segment is mapped.
    ///
    /// # Real-time
    /// As [`with`](Self::with); O(subscriptions of the wait set) the first time; no allocation; no syscall.
    pub(crate) fn attach(&self, waiter: &Arc<Waiter>) {
        let (port, route) = &mut *self.side.lock();
        let subscription = port.subscription();
        if !route.to.as_ref().is_some_and(|to| Arc::ptr_eq(to, waiter)) {
            let is_direct = match &**waiter {
                Waiter::Bell(bell) => subscription.wake_thread(Some(bell)),
                Waiter::Word(_) => subscription.wake_thread(None),
            };
            // Without a place it is tried again at the next wait.
            route.to = is_direct.then(|| waiter.clone());
        }
        subscription.wake_once(&Waker::from(waiter.clone()));
    }

    /// After a wait: the helper calls for what comes from here on, if it is to. Else rings go on to the waiter, where the next wait sees
    /// them.
    ///
    /// # Real-time
    /// One load without a callback; else as [`with`](Self::with), and one futex wake.
    pub(crate) fn detach(&self) {
        if self.callback.is_set() {
            self.go_home();
        }
    }

    /// Leads the rings to the helper's task, and has that look.
    fn go_home(&self) {
        let (port, route) = &mut *self.side.lock();
        if let Some(task) = route.task.clone() {
            route.hear(port.subscription(), &task);
            // A ring, of which the helper's thread knows.
            port.subscription().set_quiet(false);
        }
    }

    /// Wakes who waits, for something else than a message.
    pub(crate) fn wake(&self) {
        let (port, route) = &*self.side.lock();
        match &route.to {
            Some(waiter) => Wakeable::wake(&**waiter),
            None => port.subscription().set_quiet(false),
        }
    }

    /// Takes what a wait has said to be there. A sample may be in a segment that its publisher has just made, and the janitor is about to
    /// map, or be on its way into the queue: it is waited for, without the lock.
    ///
    /// # Real-time
    /// As `take`; 20 ms more at most where a publisher's memory has grown, or where it was interrupted while it published.
    pub(crate) fn take(
        &self,
        take: impl Fn(&P) -> Result<Option<RawSample>, TakeError>,
    ) -> Result<Option<RawSample>, TakeError> {
        let mut give_up_ns = None;
        loop {
            let is_there = self.with(|port| match take(port)? {
                None => Ok(Err(port.subscription().waiting() > 0)),
                Some(sample) => Ok(Ok(sample)),
            });
            let is_there = match is_there? {
                Ok(sample) => return Ok(Some(sample)),
                Err(is_there) => is_there,
            };
            let now_ns = monotonic_ns();
            if is_there && now_ns >= *give_up_ns.get_or_insert(now_ns + MAPPING_NS) {
                // Whoever was called for it is called again when it can be taken.
                let less = |told: u64| Some(told.saturating_sub(1));
                let _ = self.told.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less);
                return Ok(None);
            }
            if !is_there {
                return Ok(None);
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Sets the callback for new messages, or takes it back. The helper calls it, also for what is there already.
    pub(crate) fn set_on_new(self: &Arc<Self>, helper: &Helper, function: Function) {
        self.told.store(0, Ordering::Relaxed);
        self.callback.set(function);
        if function.is_none() {
            return;
        }
        if self.is_served.swap(true, Ordering::AcqRel) {
            return self.go_home();
        }
        let end = Arc::downgrade(self);
        helper.run(move || Self::serve(end));
    }

    /// Nobody is called any more: ROS destroys it.
    pub(crate) fn close(&self) {
        self.callback.set(None);
    }

    /// Calls for what comes, until the end has gone.
    async fn serve(end: Weak<Self>) {
        poll_fn(|context| match end.upgrade() {
            None => Poll::Ready(()),
            Some(end) => {
                end.tell(context.waker());
                Poll::Pending
            }
        })
        .await;
    }

    fn tell(&self, task: &Waker) {
        let (past, waiting) = {
            let (port, route) = &mut *self.side.lock();
            route.task = Some(task.clone());
            if !self.callback.is_set() {
                return;
            }
            let subscription = port.subscription();
            route.hear(subscription, task);
            let counters = subscription.counters();
            let past = counters.received() + counters.lost() + counters.expired() + counters.invalid();
            (past, subscription.waiting())
        };
        let all = past.saturating_add(waiting);
        // What was taken before anybody was told of it is no news.
        let new = all.saturating_sub(self.told.swap(all, Ordering::Relaxed).max(past));
        self.callback.call(usize::try_from(new).unwrap_or(usize::MAX));
    }
}

impl Route {
    /// Leads the rings to the helper.
    fn hear(&mut self, subscription: &RawSubscription, task: &Waker) {
        if self.to.take().is_some() {
            subscription.wake_thread(None);
        }
        subscription.wake_once(task);
    }
}
