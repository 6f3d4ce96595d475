// SPDX-License-Identifier: MIT OR Apache-2.0
//! A receiving endpoint: used by one thread at a time, and woken by its publishers.

use crate::bindings::rmw_event_callback_t;
use crate::callback::EventCallback;
use crate::context::Context;
use crate::error::Result;
use crate::job::{self, Jobs};
use crate::node::Node;
use crate::notifier::NotifierWaker;
use crate::on_new::{Listener, Listeners};
use crate::signal::Waiter;
use crate::thread::{self, ThreadPlan};
use std::ffi::c_void;
use std::sync::{Arc, Weak};
use std::task::Waker;
use tautline_rt::PiMutex;
use tautline_rt::clock::{monotonic_ns, wall_ns};
use tautline_transport::{MessageInfo, RawSample, RawSubscription, TakeError, Wakeable};

/// An endpoint with a queue of messages.
pub(crate) trait MessageQueue: Send + 'static {
    /// Whether it belongs to a topic, not to a service.
    const IS_TOPIC: bool;

    fn subscription(&self) -> &RawSubscription;
}

impl MessageQueue for RawSubscription {
    const IS_TOPIC: bool = true;

    fn subscription(&self) -> &RawSubscription {
        self
    }
}

/// A port that several ROS threads use in turn.
pub(crate) struct ReceivingEndpoint<P> {
    side: PiMutex<(P, WakeTarget)>,
    jobs: Arc<Jobs>,
    /// Called for new messages.
    callback: EventCallback,
    /// The listeners that the publishing threads of this context notify.
    listeners: Arc<Listeners>,
}

/// The target of a port's rings.
#[derive(Default)]
struct WakeTarget {
    /// The waiter of the thread that waits, or waited last.
    to: Option<Arc<Waiter>>,
    /// Whether publishers wake the thread directly.
    is_direct: bool,
    /// The target while no thread waits; set with the first callback.
    notifier: Option<Arc<NotifierWaker>>,
    /// Messages for which the callback was called so far.
    reported: u64,
}

impl<P: MessageQueue> ReceivingEndpoint<P> {
    pub(crate) fn new(node: &Node, port: P, listeners: Arc<Listeners>) -> Result<Arc<Self>> {
        let jobs = Jobs::new(node, port.subscription(), P::IS_TOPIC)?;
        let (route, callback) = Default::default();
        let side = PiMutex::new((port, route));
        Ok(Arc::new(ReceivingEndpoint { side, jobs, callback, listeners }))
    }

    /// Uses the port.
    ///
    /// # Real-time
    /// Waits for another thread in it, which inherits this thread's priority.
    pub(crate) fn with<T>(&self, using: impl FnOnce(&mut P) -> T) -> T {
        using(&mut self.side.lock().0)
    }

    pub(crate) fn jobs(&self) -> &Jobs {
        &self.jobs
    }

    /// The thread that is to run its callback.
    pub(crate) fn thread(&self) -> Option<&Arc<ThreadPlan>> {
        self.jobs.thread.as_ref()
    }

    /// The rank of its callback, if its thread is to run the highest first.
    pub(crate) fn rank(&self) -> Option<u8> {
        self.jobs.rank
    }

    /// # Real-time
    /// As [`with`](Self::with), O(publishers).
    pub(crate) fn has_data(&self) -> bool {
        self.with(|port| port.subscription().has_samples())
    }

    /// The waiter that it wakes, if publishers ring its bell.
    ///
    /// # Real-time
    /// As [`with`](Self::with); no allocation; no syscall.
    pub(crate) fn bell(&self) -> Option<Arc<Waiter>> {
        let (_, route) = &*self.side.lock();
        route.to.clone().filter(|_| route.is_direct)
    }

    /// Lets new messages wake `waiter`, once; the caller checks the queue afterwards.
    ///
    /// Publishers wake the waiter's thread directly, if its bell has room. All other rings go through the sampler, which is the
    /// helper here: for example, when a publisher with earlier messages connects, a new segment is mapped.
    ///
    /// # Real-time
    /// As [`with`](Self::with); O(subscriptions of the wait set) the first time; no allocation; no syscall.
    pub(crate) fn attach(&self, waiter: &Arc<Waiter>) {
        let (port, route) = &mut *self.side.lock();
        let subscription = port.subscription();
        if self.callback.is_set() {
            subscription.set_own_look(false);
        }
        // If the bell has no room, the next wait retries.
        if !(route.is_direct && route.to.as_ref().is_some_and(|to| Arc::ptr_eq(to, waiter))) {
            route.is_direct = subscription.wake_thread(waiter.bell());
            route.to = Some(waiter.clone());
        }
        subscription.wake_once(&Waker::from(waiter.clone()));
    }

    /// Ends a wait: from here on the callback for new messages is called, if one is set. Otherwise rings still go to the
    /// waiter, and the next wait sees them.
    ///
    /// # Real-time
    /// One load without a callback; else as [`with`](Self::with), and one futex wake.
    pub(crate) fn detach(&self) {
        if self.callback.is_set() {
            self.route_to_notifier();
            // The notifier calls the callback for messages that arrived meanwhile.
            self.with(|port| ring(port.subscription()));
        }
    }

    /// Routes the rings of other contexts to the notifier, if there is a callback; publishers of this context call it. A thread that still
    /// waits is woken, and attaches again. The caller checks the queue afterwards.
    fn route_to_notifier(&self) {
        let (port, route) = &mut *self.side.lock();
        let subscription = port.subscription();
        let Some(notifier) = route.notifier.as_ref().filter(|_| self.callback.is_set()) else { return };
        let waiter = route.to.take();
        if waiter.is_some() || !route.is_direct {
            route.is_direct = subscription.wake_thread(notifier.waiter.bell());
        }
        subscription.wake_once(&Waker::from(notifier.clone()));
        subscription.set_own_look(true);
        if let Some(waiter) = waiter {
            Wakeable::wake(&*waiter);
        }
    }

    /// Wakes the waiting thread for another reason than a message.
    pub(crate) fn wake(&self) {
        let (port, route) = &*self.side.lock();
        match &route.to {
            Some(waiter) => Wakeable::wake(&**waiter),
            None => ring(port.subscription()),
        }
    }

    /// Takes a message, which ends this thread's previous job.
    ///
    /// # Real-time
    /// As `take`, as [`with`](Self::with), as [`thread::raise`], and as [`job::end`].
    pub(crate) fn take(
        &self,
        take: impl FnOnce(&P) -> std::result::Result<Option<RawSample>, TakeError>,
    ) -> std::result::Result<Option<RawSample>, TakeError> {
        thread::raise();
        job::end();
        let (port, route) = &mut *self.side.lock();
        let taken = take(port);
        if matches!(taken, Ok(None) | Err(TakeError::TooManyHeld)) && port.subscription().waiting() > 0 {
            // Not available yet: the callback must be called again when it is.
            route.reported = route.reported.saturating_sub(1);
        }
        taken
    }

    /// Starts a job for the taken message, and returns when it appeared on this host, by the system clock, in nanoseconds. Executors that
    /// use callbacks for new messages do not wait here, so the end of their jobs is unknown.
    ///
    /// # Real-time
    /// As [`Jobs::begin`], and as [`thread::run_at`].
    pub(crate) fn begin(&self, info: &MessageInfo) -> i64 {
        let now_ns = monotonic_ns();
        if let Some(plan) = self.thread() {
            thread::govern_taker(plan);
        }
        if !self.callback.is_set() {
            if self.jobs.is_early(info.released_ns) {
                self.with(|port| port.subscription().forget_max_queue());
            }
            self.jobs.begin(info.released_ns, now_ns);
            if let (Some(plan), Some(priority)) = (self.thread(), self.rank()) {
                thread::run_at(plan, priority);
            }
        }
        let age_ns = now_ns.saturating_sub(info.released_ns);
        wall_ns().saturating_sub(i64::try_from(age_ns).unwrap_or(0))
    }

    /// Sets or removes the callback for new messages. It is called here for messages not reported before, like other RMWs do;
    /// later the publishing thread calls it, or the notifier for a publisher of another context.
    pub(crate) fn set_on_new(
        self: &Arc<Self>,
        context: &Context,
        callback: rmw_event_callback_t,
        data: *const c_void,
    ) -> Result {
        let Some(function) = callback else {
            // In a forked child nothing calls it, and a call of the parent's never returns.
            if context.is_of_this_process() {
                self.remove_on_new();
            }
            return Ok(());
        };
        context.waiters.check_process()?;
        let waker = context.serve(self.listener(), self.thread().map(|plan| plan.priority))?;
        self.side.lock().1.notifier = Some(waker);
        self.callback.replace(Some((function, data)));
        self.callback.settle();
        self.listeners.add(self.listener());
        self.receive();
        Ok(())
    }

    fn remove_on_new(self: &Arc<Self>) {
        self.callback.replace(None);
        self.callback.settle();
        self.with(|port| port.subscription().set_own_look(false));
        // Publishers of this context rang nobody until here: a thread that has begun to wait looks again.
        self.wake();
        self.listeners.remove(&self.listener());
    }

    fn listener(self: &Arc<Self>) -> Weak<dyn Listener> {
        Arc::downgrade(self) as Weak<dyn Listener>
    }

    /// Removes the callback: ROS destroys the endpoint.
    pub(crate) fn close(self: &Arc<Self>) {
        self.jobs.close();
        self.remove_on_new();
    }
}

impl<P: MessageQueue> Listener for ReceivingEndpoint<P> {
    fn receive(&self) {
        self.route_to_notifier();
        self.notify();
    }

    fn notify(&self) {
        let (call, new) = {
            let (port, route) = &mut *self.side.lock();
            let Some(call) = self.callback.begin() else { return };
            let subscription = port.subscription();
            let counters = subscription.counters();
            let past = counters.received() + counters.lost() + counters.expired() + counters.invalid();
            let all = past.saturating_add(subscription.waiting());
            // Messages that were taken before they were reported do not count.
            let reported = std::mem::replace(&mut route.reported, all).max(past);
            (call, all.saturating_sub(reported))
        };
        call.run(usize::try_from(new).unwrap_or(usize::MAX));
    }
}

/// Rings the sampler's bell; the subscription was never quiet, so this does nothing else.
fn ring(subscription: &RawSubscription) {
    subscription.set_quiet(false);
}
