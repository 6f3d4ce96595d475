// SPDX-License-Identifier: MIT OR Apache-2.0
//! A receiving endpoint: used by one thread at a time, and woken by its publishers.

use crate::callback::{EventCallback, Function};
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
    /// Whether the helper has a task that calls it.
    is_served: AtomicBool,
}

/// Where a port's rings go.
#[derive(Default)]
struct WakeTarget {
    to: Option<Arc<Waiter>>,
    /// The helper's task for new messages.
    task: Option<Waker>,
    /// Messages for which the callback was called so far.
    told: u64,
}

impl<P: MessageQueue> ReceivingEndpoint<P> {
    pub(crate) fn new(node: &Node, port: P) -> Result<Arc<Self>> {
        let jobs = Jobs::new(node, port.subscription(), P::IS_TOPIC)?;
        let (route, callback, is_served) = Default::default();
        Ok(Arc::new(ReceivingEndpoint { side: PiMutex::new((port, route)), jobs, callback, is_served }))
    }

    /// Uses the port.
    ///
    /// # Real-time
    /// Waits for another thread in it, which inherits this thread's priority.
    pub(crate) fn with<T>(&self, using: impl FnOnce(&mut P) -> T) -> T {
        using(&mut self.side.lock().0)
    }

    /// # Real-time
    /// As [`with`](Self::with), O(publishers).
    pub(crate) fn has_data(&self) -> bool {
        self.with(|port| port.subscription().has_samples())
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
        if !route.to.as_ref().is_some_and(|to| Arc::ptr_eq(to, waiter)) {
            let is_direct = match &**waiter {
                Waiter::Bell(bell) => subscription.wake_thread(Some(bell)),
                Waiter::Word(_) => subscription.wake_thread(None),
            };
            // Without room it is retried at the next wait.
            route.to = is_direct.then(|| waiter.clone());
        }
        subscription.wake_once(&Waker::from(waiter.clone()));
    }

    /// After a wait: from here on the helper calls the callback for new messages, if one is set. Otherwise rings still go to the
    /// waiter, and the next wait sees them.
    ///
    /// # Real-time
    /// One load without a callback; else as [`with`](Self::with), and one futex wake.
    pub(crate) fn detach(&self) {
        if self.callback.is_set() {
            self.go_home();
        }
    }

    /// Routes the rings to the helper's task, and wakes it.
    fn go_home(&self) {
        let (port, route) = &mut *self.side.lock();
        if let Some(task) = route.task.clone() {
            route.hear(port.subscription(), &task);
            ring(port.subscription());
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
    /// As `take`, as [`with`](Self::with), and as [`job::end`].
    pub(crate) fn take(
        &self,
        take: impl FnOnce(&P) -> std::result::Result<Option<RawSample>, TakeError>,
    ) -> std::result::Result<Option<RawSample>, TakeError> {
        job::end();
        let (port, route) = &mut *self.side.lock();
        let taken = take(port);
        if matches!(taken, Ok(None) | Err(TakeError::TooManyHeld)) && port.subscription().waiting() > 0 {
            // Not available yet: the callback must be called again when it is.
            route.told = route.told.saturating_sub(1);
        }
        taken
    }

    /// Starts a job for the taken message. Executors that use callbacks for new messages do not wait here, so the end of their
    /// jobs is unknown.
    ///
    /// # Real-time
    /// As [`Jobs::begin`].
    pub(crate) fn begin(&self, info: &MessageInfo) {
        if !self.callback.is_set() {
            self.jobs.begin(info.released_ns);
        }
    }

    /// Sets or removes the callback for new messages. It is called here for messages not reported before, like other RMWs do;
    /// later the helper calls it.
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

    /// Removes the callback: ROS destroys the endpoint.
    pub(crate) fn close(&self) {
        self.jobs.close();
        self.callback.replace(None);
        self.callback.settle();
    }

    /// Calls the callback for new messages, until the endpoint is destroyed.
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

    /// Calls the callback for unreported messages, and registers the helper's task for later ones.
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
            // Messages that were taken before they were reported do not count.
            let told = std::mem::replace(&mut route.told, all).max(past);
            (call, all.saturating_sub(told))
        };
        call.run(usize::try_from(new).unwrap_or(usize::MAX));
    }
}

impl WakeTarget {
    /// Routes the rings to the helper.
    fn hear(&mut self, subscription: &RawSubscription, task: &Waker) {
        if self.to.take().is_some() {
            subscription.wake_thread(None);
        }
        subscription.wake_once(task);
    }
}

/// Rings the sampler's bell; the subscription was never quiet, so this does nothing else.
fn ring(subscription: &RawSubscription) {
    subscription.set_quiet(false);
}
