// SPDX-License-Identifier: MIT OR Apache-2.0
//! Futures that wait for a transform, in entries that were allocated with the buffer.
//!
//! A waiter first writes into its entry what it waits for, and then looks up once more; the writer first sets a
//! transform, and then checks the entries. With a sequentially consistent fence between the two steps on each side, at
//! least one of them sees the other.
//!
//! ```text
//!  FREE --claim--> ANY  <--> FRAME + n (a sample of frame n, at the time asked for or later)
//!   ^---- drop, or ready ---------'
//! ```

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll};

use crate::buffer::{Buffer, Stamped, Time, sealed::Resolve};
use crate::error::{LookupError, WaitError};
use crate::names::{FrameId, FrameName};
use crate::sync::{AtomicI64, AtomicU64, AtomicUsize, AtomicWaker, Ordering, fence};
use crate::tree::PathError;

const FREE: u64 = 0;
/// Every set may be the one.
const ANY: u64 = 1;
const FRAME: u64 = 2;

struct Waiter {
    interest: AtomicU64,
    from_ns: AtomicI64,
    waker: AtomicWaker,
}

pub(crate) struct Waiters {
    places: Box<[Waiter]>,
    taken: AtomicUsize,
}

impl Waiters {
    pub(crate) fn new(waiters: usize) -> Waiters {
        let waiter = |_| Waiter {
            interest: AtomicU64::new(FREE),
            from_ns: AtomicI64::new(0),
            waker: AtomicWaker::new(),
        };
        Waiters { places: (0..waiters).map(waiter).collect(), taken: AtomicUsize::new(0) }
    }

    pub(crate) fn bytes(waiters: usize) -> usize {
        waiters * size_of::<Waiter>()
    }

    /// Wakes who may go on now that a sample of `frame` was set: everyone, if it may matter to others, too.
    pub(crate) fn notify(&self, frame: FrameId, stamp_ns: i64, everyone: bool) {
        // Pairs with the fence in `WaitFor::say`.
        fence(Ordering::SeqCst);
        if self.taken.load(Ordering::Relaxed) == 0 {
            return;
        }
        for waiter in &self.places {
            // Acquire: pairs with the Release in `WaitFor::say`; its waker is there.
            let interest = waiter.interest.load(Ordering::Acquire);
            let its =
                interest == FRAME + u64::from(frame.0) && stamp_ns >= waiter.from_ns.load(Ordering::Relaxed);
            if interest == ANY || its || (everyone && interest != FREE) {
                waiter.waker.wake();
            }
        }
    }

    fn claim(&self, time: Time) -> Option<usize> {
        let free = |waiter: &Waiter| {
            waiter.interest.compare_exchange(FREE, ANY, Ordering::Acquire, Ordering::Relaxed).is_ok()
        };
        let place = self.places.iter().position(free)?;
        let from_ns = match time {
            Time::Latest => i64::MIN,
            Time::At(stamp_ns) => stamp_ns,
        };
        self.places[place].from_ns.store(from_ns, Ordering::Relaxed);
        self.taken.fetch_add(1, Ordering::Relaxed);
        Some(place)
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

    /// What there is, or what is missing.
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

    /// Says what is waited for, and looks again: whatever is set after that wakes.
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
        let Some(place) = self.place.or_else(|| waiters.claim(self.time)) else { return Err(WaitOn::Full) };
        self.place = Some(place);
        waiters.places[place].waker.register(cx.waker());
        match self.register(place, missing) {
            Err(still) if still == missing => Err(WaitOn::Set),
            // It is about something else by now: any set will do.
            Err(_) => self.register(place, ANY).map_err(|_| WaitOn::Set),
            ready => ready.map_err(|_| WaitOn::Set),
        }
    }

    fn leave(&mut self) {
        let waiters = &self.buffer.tree.waiters;
        if let Some(place) = self.place.take() {
            // Before the place is another's.
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
