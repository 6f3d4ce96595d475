// SPDX-License-Identifier: MIT OR Apache-2.0
//! Futures that wait for a transform.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use crate::buffer::{Buffer, Frame, Stamped, Time, sealed::Resolve};
use crate::error::{LookupError, WaitError};
use crate::names::FrameName;
use crate::sync::{Ordering, fence};
use crate::tree::PathError;
use crate::waiters::{ANY, FRAME, FREE};

impl Buffer {
    /// Waits until there is a transform: a future, which the writer's [`set`](crate::Writer::set) wakes. It also ends if the time
    /// is earlier than a frame's newest stamp by more than [`Limits::cache_time`](crate::Limits::cache_time), because such a transform can no longer
    /// be set. There is no time-out: drop the future to give up.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. Each poll makes at most three lookups; the first poll that must wait
    /// searches for one of [`Limits::waiters`](crate::Limits::waiters) entries. A waker is cloned.
    ///
    /// # Errors
    /// If a name is not a valid frame name, for example empty. The future waits for a frame that does not
    /// exist yet.
    pub fn wait_for(
        &self,
        target: impl Frame,
        source: impl Frame,
        time: Time,
    ) -> Result<WaitFor, LookupError> {
        Ok(WaitFor::new(self.clone(), target.name(self)?, source.name(self)?, time))
    }
}

/// Waits for a transform: see [`Buffer::wait_for`]. Occupies one of [`Limits::waiters`](crate::Limits::waiters) entries from
/// the first poll that waits until it is ready or dropped.
#[must_use = "futures do nothing unless polled"]
pub struct WaitFor {
    buffer: Buffer,
    target: FrameName,
    source: FrameName,
    time: Time,
    place: Option<usize>,
}

impl WaitFor {
    pub(crate) fn new(buffer: Buffer, target: FrameName, source: FrameName, time: Time) -> WaitFor {
        WaitFor { buffer, target, source, time, place: None }
    }

    /// Looks the transform up. The error is the interest: what is missing.
    fn lookup(&self) -> Result<Result<Stamped, LookupError>, u64> {
        let (Ok(target), Ok(source)) = (self.target.find(&self.buffer), self.source.find(&self.buffer))
        else {
            return Err(ANY);
        };
        let error = match self.buffer.find(target, source, self.time) {
            Ok(found) => return Ok(Ok(found)),
            Err(error) => error,
        };
        match (error, self.time) {
            (PathError::Extrapolation { asked_ns, newest_ns, .. }, Time::At(_))
                if asked_ns < newest_ns.saturating_sub(self.buffer.tree.cache_ns) =>
            {
                Ok(Err(self.buffer.explain(target, source, error)))
            }
            (PathError::Extrapolation { frame, .. }, Time::At(_)) => Err(FRAME + u64::from(frame.0)),
            _ => Err(ANY),
        }
    }

    /// Registers the interest, and looks the transform up again: a later set of it wakes the future.
    fn register(&self, place: usize, interest: u64) -> Result<Result<Stamped, LookupError>, u64> {
        // Release: pairs with the Acquire in `notify`.
        self.buffer.tree.waiters.places[place].interest.store(interest, Ordering::Release);
        // Pairs with the fence in `notify`.
        fence(Ordering::SeqCst);
        self.lookup()
    }

    fn wait(&mut self, cx: &Context<'_>) -> Result<Result<Stamped, LookupError>, WaitOn> {
        let missing = match self.lookup() {
            Ok(ready) => return Ok(ready),
            Err(missing) => missing,
        };
        let waiters = &self.buffer.tree.waiters;
        let Some(place) = self.place.or_else(|| waiters.claim(self.time.stamp_ns())) else {
            return Err(WaitOn::Full);
        };
        self.place = Some(place);
        waiters.places[place].waker.register(cx.waker());
        match self.register(place, missing) {
            Err(still) if still == missing => Err(WaitOn::Set),
            // Something else is missing by now: any set wakes.
            Err(_) => self.register(place, ANY).map_err(|_| WaitOn::Set),
            ready => ready.map_err(|_| WaitOn::Set),
        }
    }

    fn leave(&mut self) {
        let waiters = &self.buffer.tree.waiters;
        if let Some(place) = self.place.take() {
            // Before another future can claim the place.
            drop(waiters.places[place].waker.take());
            waiters.places[place].interest.store(FREE, Ordering::Release);
            waiters.taken.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

enum WaitOn {
    Set,
    Full,
}

impl Future for WaitFor {
    type Output = Result<Stamped, WaitError>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let ready = match self.wait(cx) {
            Ok(ready) => ready.map_err(WaitError::from),
            Err(WaitOn::Set) => return Poll::Pending,
            Err(WaitOn::Full) => Err(WaitError::WaitersFull { waiters: self.buffer.tree.limits.waiters }),
        };
        self.leave();
        Poll::Ready(ready)
    }
}

impl Drop for WaitFor {
    fn drop(&mut self) {
        self.leave();
    }
}
