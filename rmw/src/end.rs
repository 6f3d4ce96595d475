// SPDX-License-Identifier: MIT OR Apache-2.0
//! An end that messages come to: used by one thread at a time, and whom its publishers wake.

use crate::callback::{Callback, Function};
use crate::error::Result;
use crate::helper::Helper;
use crate::job::{self, Jobs};
use crate::node::Node;
use crate::signal::Waiter;
use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};
use std::task::{Poll, Waker};
use tautline_rt::PiMutex;
use tautline_transport::{MessageInfo, RawSample, RawSubscription, TakeError, Wakeable};

/// What has a queue of messages.
pub(crate) trait Port: Send + 'static {
    /// Whether it is a topic's, not a service's.
    const IS_TOPIC: bool;

    fn subscription(&self) -> &RawSubscription;
}

impl Port for RawSubscription {
    const IS_TOPIC: bool = true;

    fn subscription(&self) -> &RawSubscription {
        self
    }
}

/// A port of ROS's, which several threads use in turn.
pub(crate) struct End<P> {
    side: PiMutex<(P, Route)>,
    jobs: Arc<Jobs>,
    /// For new messages.
    callback: Callback,
    /// The helper has a task that calls it.
    is_served: AtomicBool,
}

/// Where the rings of a port go.
#[derive(Default)]
struct Route {
    to: Option<Arc<Waiter>>,
    /// The helper's task that calls for new messages.
    task: Option<Waker>,
    /// How many messages the callback was called for, since the end was made.
    told: u64,
}

impl<P: Port> End<P> {
    pub(crate) fn new(node: &Node, port: P) -> Result<Arc<Self>> {
        let jobs = Jobs::new(node, port.subscription(), P::IS_TOPIC)?;
        let (route, callback, is_served) = Default::default();
        Ok(Arc::new(End { side: PiMutex::new((port, route)), jobs, callback, is_served }))
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
            ring(port.subscription());
        }
    }

    /// Wakes who waits, for something else than a message.
    pub(crate) fn wake(&self) {
        let (port, route) = &*self.side.lock();
        match &route.to {
            Some(waiter) => Wakeable::wake(&**waiter),
            None => ring(port.subscription()),
        }
    }

    /// Takes a message; what the thread did with the one before is done.
    ///
    /// # Real-time
    /// As `take`, as [`with`](Self::with), and as [`job::end`].
    pub(crate) fn take(
        &self,
        take: impl FnOnce(&P) -> std::result::Result<Option<RawSample>, TakeError>,
    ) -> std::result::Result<Option<RawSample>, TakeError> {
        job::end();
        let (port, route) = &mut *self.side.lock();
        let taken = take(port);
        if matches!(taken, Ok(None) | Err(TakeError::TooManyHeld)) && port.subscription().waiting() > 0 {
            // On its way, or for later: whoever was called for it is called again when it can be taken.
            route.told = route.told.saturating_sub(1);
        }
        taken
    }

    /// The message that was taken is given to who asked for it. Executors that are called for messages do not wait here, so nobody
    /// sees when they are done with one.
    ///
    /// # Real-time
    /// As [`Jobs::begin`].
    pub(crate) fn begin(&self, info: &MessageInfo) {
        if !self.callback.is_set() {
            self.jobs.begin(info.released_ns);
        }
    }

    /// Sets the callback for new messages, or takes it back. It is called here for what waits and nobody was called for before, as
    /// other RMWs do it; after that the helper calls it.
    pub(crate) fn set_on_new(self: &Arc<Self>, helper: &Helper, function: Function) {
        self.callback.replace(function);
        self.callback.settle();
        if function.is_none() {
            return;
        }
        self.tell(None);
        if self.is_served.swap(true, Ordering::AcqRel) {
            return self.go_home();
        }
        let end = Arc::downgrade(self);
        helper.run(move || Self::serve(end));
    }

    /// Nobody is called any more: ROS destroys it.
    pub(crate) fn close(&self) {
        self.jobs.close();
        self.callback.replace(None);
        self.callback.settle();
    }

    /// Calls for what comes, until the end has gone.
    async fn serve(end: Weak<Self>) {
        poll_fn(|context| match end.upgrade() {
            None => Poll::Ready(()),
            Some(end) => {
                end.tell(Some(context.waker()));
                Poll::Pending
            }
        })
        .await;
    }

    /// Calls for what nobody was called for; the helper's task hears of what comes after that.
    fn tell(&self, task: Option<&Waker>) {
        let (call, new) = {
            let (port, route) = &mut *self.side.lock();
            route.task = task.cloned().or_else(|| route.task.take());
            let Some(call) = self.callback.begin() else { return };
            let subscription = port.subscription();
            if let Some(task) = task {
                route.hear(subscription, task);
            }
            let counters = subscription.counters();
            let past = counters.received() + counters.lost() + counters.expired() + counters.invalid();
            let all = past.saturating_add(subscription.waiting());
            // What was taken before anybody was told of it is no news.
            let told = std::mem::replace(&mut route.told, all).max(past);
            (call, all.saturating_sub(told))
        };
        call.run(usize::try_from(new).unwrap_or(usize::MAX));
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

/// Has whoever waits look, by the sampler's bell: one that was never quiet is rung, and nothing else.
fn ring(subscription: &RawSubscription) {
    subscription.set_quiet(false);
}
