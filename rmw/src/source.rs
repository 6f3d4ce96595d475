// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a wait set waits for data of: whom publishers wake.

use crate::callback::{Callback, Function};
use crate::helper::Helper;
use crate::signal::Waiter;
use std::future::poll_fn;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::task::{Poll, Waker};
use std::time::Duration;
use tautline_rt::PiMutex;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{RawSample, RawSubscription, TakeError};

/// Where the rings of one subscription go.
#[derive(Default)]
pub(crate) struct Route {
    to: Option<Arc<Waiter>>,
}

impl Route {
    /// Leads the rings for `subscription` to `waiter`, once; the caller looks into the queue after this.
    ///
    /// Publishers wake the waiter's thread themselves, if its bell has a place for them. What is no publisher's ring is the sampler's in
    /// any case, whose place the helper has: when a publisher is connected that has sent something before, a new segment is mapped.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions of the wait set) the first time; no allocation; no syscall.
    pub(crate) fn lead(&mut self, subscription: &RawSubscription, waiter: &Arc<Waiter>) {
        if !self.to.as_ref().is_some_and(|to| Arc::ptr_eq(to, waiter)) {
            match &**waiter {
                Waiter::Bell(bell) => subscription.wake_thread(Some(bell)),
                Waiter::Word(_) => subscription.wake_thread(None),
            }
            self.to = Some(waiter.clone());
        }
        subscription.wake_once(&Waker::from(waiter.clone()));
    }

    /// Leads them to the helper.
    fn lead_home(&mut self, subscription: &RawSubscription, waker: &Waker) {
        if self.to.take().is_some() {
            subscription.wake_thread(None);
        }
        subscription.wake_once(waker);
    }
}

/// A subscription with its route, by one thread at a time.
pub(crate) trait Side {
    fn parts(&mut self) -> (&RawSubscription, &mut Route);
}

/// How long a take waits for a sample that came in memory which is not mapped here yet, and how often it looks.
const MAPPING_NS: u64 = 20_000_000;
const LOOK: Duration = Duration::from_micros(50);

/// Takes what a wait has said to be there. A sample may be in a segment that its publisher has just made, and the janitor is about to
/// map: it is waited for, without the lock.
///
/// # Real-time
/// As `take`; where a publisher's memory has grown, 20 ms more at most.
pub(crate) fn take<S: Side>(
    side: &PiMutex<S>,
    take: impl Fn(&S) -> Result<Option<RawSample>, TakeError>,
) -> Result<Option<RawSample>, TakeError> {
    let mut give_up_ns = None;
    loop {
        let is_there = {
            let mut side = side.lock();
            match take(&side)? {
                None => side.parts().0.waiting() > 0,
                taken => return Ok(taken),
            }
        };
        let now_ns = monotonic_ns();
        if !is_there || now_ns >= *give_up_ns.get_or_insert(now_ns + MAPPING_NS) {
            return Ok(None);
        }
        std::thread::sleep(LOOK);
    }
}

/// An end that messages come to.
pub(crate) trait Receives: Send + Sync + 'static {
    fn on_new(&self) -> &OnNew;
    /// Has the helper woken for the next message, and looks: how many have been taken or lost so far, how many wait.
    fn look(&self, waker: &Waker) -> (u64, u64);
}

/// The callback of an end for new messages.
#[derive(Default)]
pub(crate) struct OnNew {
    callback: Callback,
    /// Counts the callbacks that were set: the helper serves the last one.
    generation: AtomicU64,
    /// How many messages it was told of since the end was made.
    told: AtomicU64,
}

/// Sets the callback of `end`, or takes it back. The helper calls it, also for what is there already.
pub(crate) fn set_on_new<E: Receives>(end: &Arc<E>, helper: &Helper, function: Function) {
    let on_new = end.on_new();
    let is_to_be_served = function.is_some();
    on_new.callback.set(function);
    let generation = on_new.generation.fetch_add(1, Ordering::AcqRel) + 1;
    if is_to_be_served {
        on_new.told.store(0, Ordering::Relaxed);
        let end = Arc::downgrade(end);
        helper.run(move || serve(end, generation));
    }
}

/// Tells of what comes, until the end has gone or has another callback.
async fn serve<E: Receives>(end: Weak<E>, generation: u64) {
    let is_current = |end: &Arc<E>| end.on_new().generation.load(Ordering::Acquire) == generation;
    poll_fn(|context| match end.upgrade().filter(is_current) {
        None => Poll::Ready(()),
        Some(end) => {
            let (past, waiting) = end.look(context.waker());
            let on_new = end.on_new();
            let all = past.saturating_add(waiting);
            // What was taken before anybody was told of it is no news.
            let new = all.saturating_sub(on_new.told.swap(all, Ordering::Relaxed).max(past));
            on_new.callback.call(usize::try_from(new).unwrap_or(usize::MAX));
            Poll::Pending
        }
    })
    .await;
}

/// The look of an end whose side is locked.
pub(crate) fn look(side: &mut impl Side, waker: &Waker) -> (u64, u64) {
    let (subscription, route) = side.parts();
    route.lead_home(subscription, waker);
    let counters = subscription.counters();
    let past = counters.received() + counters.lost() + counters.expired() + counters.invalid();
    (past, subscription.waiting())
}
