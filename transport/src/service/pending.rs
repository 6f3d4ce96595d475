// SPDX-License-Identifier: MIT OR Apache-2.0
//! The requests of a client that wait for an answer: a table of fixed size, without a lock.
//!
//! ```text
//!          claim          arm             answer, fail           put             take (future)
//!    free -------> claimed ----> waiting ---------------> writing ----> done ----------------> free
//!      ^                            |                        |
//!      +--- release (dropped) ------+    release (dropped)   +----> abandoned ----> free (who was writing)
//! ```
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::subscription::RawSample;
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};
use futures::task::AtomicWaker;
use std::sync::Arc;
use std::task::Wake;

/// Most requests of one client that wait at once, those for a server to appear included: the bits of a word.
pub const MAX_PENDING_REQUESTS: usize = 64;

/// What became of a request.
pub(crate) enum Outcome {
    Response(RawSample),
    /// Every server that got the request has gone.
    ServerGone,
    /// There is a server: what is waited for without a request.
    Available,
}

const FREE: u32 = 0;
const CLAIMED: u32 = 1;
const WAITING: u32 = 2;
const WRITING: u32 = 3;
const DONE: u32 = 4;
const ABANDONED: u32 = 5;

#[derive(Default)]
struct Place {
    state: AtomicU32,
    /// Of the request; 0 if a server is waited for.
    sequence_number: AtomicU64,
    /// The servers that may answer, by their bits.
    servers: AtomicU64,
    /// Touched by who is writing, by the future when done, by who frees it.
    outcome: UnsafeCell<Option<Outcome>>,
}

// SAFETY: `outcome` is touched by whoever moved `state` to `writing`, until that is `done`, and by the owner of the place
// from then on: the atomics hand it over. An Outcome is Send.
unsafe impl Sync for Place {}

/// The tasks that wait. Apart from the table, so that a doorbell that holds it as a waker owns nothing else.
pub(crate) struct Waiters {
    occupied: AtomicU64,
    wakers: [AtomicWaker; MAX_PENDING_REQUESTS],
}

impl Waiters {
    /// # Real-time
    /// Wait-free, O(pending requests); no allocation; a syscall for each task whose thread sleeps.
    pub(crate) fn wake_all(&self) {
        for index in bits(self.occupied.load(Ordering::SeqCst)) {
            self.wake_one(index);
        }
    }

    fn wake_one(&self, index: usize) {
        if let Some(waker) = self.wakers.get(index) {
            waker.wake();
        }
    }
}

impl Wake for Waiters {
    fn wake(self: Arc<Self>) {
        self.wake_all();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.wake_all();
    }
}

pub(crate) struct Table {
    waiters: Arc<Waiters>,
    places: [Place; MAX_PENDING_REQUESTS],
}

impl Table {
    #[allow(clippy::disallowed_methods, reason = "when a client is made")]
    pub(crate) fn new() -> Self {
        let waiters =
            Waiters { occupied: AtomicU64::new(0), wakers: core::array::from_fn(|_| AtomicWaker::new()) };
        Table { waiters: Arc::new(waiters), places: core::array::from_fn(|_| Place::default()) }
    }

    pub(crate) fn waiters(&self) -> &Arc<Waiters> {
        &self.waiters
    }

    /// Claims a place. `None`: all are taken.
    ///
    /// # Real-time
    /// Wait-free, O(places); no allocation; no syscall.
    pub(crate) fn claim(&self) -> Option<usize> {
        let claim = |place: &Place| {
            // Acquire: pairs with the Release that freed it.
            place.state.compare_exchange(FREE, CLAIMED, Ordering::Acquire, Ordering::Relaxed).is_ok()
        };
        let index = self.places.iter().position(claim)?;
        self.waiters.occupied.fetch_or(1 << index, Ordering::SeqCst);
        Some(index)
    }

    /// The request `sequence_number` is about to go to `servers`.
    pub(crate) fn arm(&self, index: usize, sequence_number: u64, servers: u64) {
        let Some(place) = self.places.get(index) else { return };
        place.sequence_number.store(sequence_number, Ordering::Relaxed);
        place.servers.store(servers, Ordering::Relaxed);
        place.state.store(WAITING, Ordering::SeqCst);
    }

    /// Of the servers of an armed place only `alive` are left: one may have gone before the request was armed.
    pub(crate) fn check_servers(&self, index: usize, alive: u64) {
        if let Some(place) = self.places.get(index) {
            self.lose(index, place, !alive);
        }
    }

    /// Looks for the outcome, after registering `waker`.
    pub(crate) fn register(&self, index: usize, waker: &core::task::Waker) {
        if let Some(registered) = self.waiters.wakers.get(index) {
            registered.register(waker);
        }
    }

    /// Takes the outcome, if it is there: the place is then free.
    pub(crate) fn take(&self, index: usize) -> Option<Outcome> {
        let place = self.places.get(index)?;
        // Acquire: pairs with the Release in `complete`.
        if place.state.load(Ordering::Acquire) != DONE {
            return None;
        }
        // SAFETY: done, so it is this place's owner's alone.
        let outcome = unsafe { (*place.outcome.get()).take() };
        self.free(index, place);
        outcome
    }

    /// Whoever owns the place no longer waits.
    pub(crate) fn release(&self, index: usize) {
        let Some(place) = self.places.get(index) else { return };
        loop {
            let state = place.state.load(Ordering::Acquire);
            match state {
                DONE => {
                    drop(self.take(index));
                    return;
                }
                WRITING => {
                    let left =
                        place.state.compare_exchange(WRITING, ABANDONED, Ordering::AcqRel, Ordering::Acquire);
                    if left.is_ok() {
                        return;
                    }
                }
                _ => {
                    // Not yet free: that would be a place of somebody else's before its bit is gone.
                    let left =
                        place.state.compare_exchange(state, CLAIMED, Ordering::AcqRel, Ordering::Acquire);
                    if left.is_ok() {
                        self.free(index, place);
                        return;
                    }
                }
            }
        }
    }

    fn free(&self, index: usize, place: &Place) {
        if let Some(waker) = self.waiters.wakers.get(index) {
            drop(waker.take());
        }
        self.waiters.occupied.fetch_and(!(1 << index), Ordering::SeqCst);
        place.state.store(FREE, Ordering::Release);
    }

    /// A response came: whoever waits for it gets it.
    ///
    /// # Real-time
    /// Wait-free, O(pending requests); no allocation; a syscall if the task's thread sleeps.
    pub(crate) fn answer(&self, response: RawSample) {
        let sequence_number = response.info().sequence_number;
        let asked = |place: &Place| {
            sequence_number != 0 && place.sequence_number.load(Ordering::Relaxed) == sequence_number
        };
        for (index, place) in self.occupied() {
            if asked(place) {
                self.complete(index, place, asked, Outcome::Response(response));
                return;
            }
        }
        // Nobody waits for it any more, or another server was faster.
    }

    /// The servers `gone` will not answer.
    pub(crate) fn servers_gone(&self, gone: u64) {
        for (index, place) in self.occupied() {
            self.lose(index, place, gone);
        }
    }

    /// There is a server.
    pub(crate) fn available(&self) {
        let waits = |place: &Place| place.sequence_number.load(Ordering::Relaxed) == 0;
        for (index, place) in self.occupied() {
            if waits(place) {
                self.complete(index, place, waits, Outcome::Available);
            }
        }
    }

    fn lose(&self, index: usize, place: &Place, gone: u64) {
        let asks = |place: &Place| place.sequence_number.load(Ordering::Relaxed) != 0;
        if !asks(place) || place.state.load(Ordering::SeqCst) != WAITING {
            return;
        }
        let before = place.servers.fetch_and(!gone, Ordering::SeqCst);
        if before & !gone == 0 {
            let lost = |place: &Place| asks(place) && place.servers.load(Ordering::SeqCst) == 0;
            self.complete(index, place, lost, Outcome::ServerGone);
        }
    }

    fn occupied(&self) -> impl Iterator<Item = (usize, &Place)> {
        bits(self.waiters.occupied.load(Ordering::SeqCst))
            .filter_map(|index| Some((index, self.places.get(index)?)))
    }

    /// Puts the outcome in, unless the place is not, or no longer, that of a request that `is_meant`.
    fn complete(&self, index: usize, place: &Place, is_meant: impl Fn(&Place) -> bool, outcome: Outcome) {
        if place.state.compare_exchange(WAITING, WRITING, Ordering::AcqRel, Ordering::Relaxed).is_err() {
            return;
        }
        // Between the look and the exchange it may have been freed and claimed for another request.
        let next = if is_meant(place) {
            // SAFETY: writing, so it is this function's alone.
            unsafe { *place.outcome.get() = Some(outcome) };
            DONE
        } else {
            WAITING
        };
        // Release: pairs with the Acquire in `take`.
        if place.state.compare_exchange(WRITING, next, Ordering::AcqRel, Ordering::Relaxed).is_err() {
            // SAFETY: abandoned, so it is still this function's alone.
            drop(unsafe { (*place.outcome.get()).take() });
            self.free(index, place);
        } else if next == DONE {
            self.waiters.wake_one(index);
        }
    }
}

/// The positions of the bits that are set.
fn bits(mut word: u64) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let index = word.trailing_zeros() as usize;
        word &= word.wrapping_sub(1);
        (index < u64::BITS as usize).then_some(index)
    })
}

/// What one thread at a time works on; who finds another at it does not wait.
pub(crate) struct Turn<T> {
    busy: AtomicU32,
    missed: AtomicU32,
    value: UnsafeCell<T>,
}

// SAFETY: `busy` lets one thread at a time at the value; a T is Send.
unsafe impl<T: Send> Sync for Turn<T> {}

impl<T> Turn<T> {
    pub(crate) fn new(value: T) -> Self {
        Turn { busy: AtomicU32::new(0), missed: AtomicU32::new(0), value: UnsafeCell::new(value) }
    }

    /// Works on the value unless another thread does right now. True if somebody came meanwhile and went: what they came for
    /// may have been missed, so they have to come again.
    ///
    /// # Real-time
    /// Wait-free.
    #[must_use]
    pub(crate) fn attempt(&self, work: impl FnOnce(&mut T)) -> bool {
        if self.busy.swap(1, Ordering::SeqCst) != 0 {
            // Either the other one sees this when it is done, or it is done already.
            self.missed.store(1, Ordering::SeqCst);
            if self.busy.swap(1, Ordering::SeqCst) != 0 {
                return false;
            }
        }
        // SAFETY: `busy` was 0 and is 1 until this is done.
        work(unsafe { &mut *self.value.get() });
        self.busy.store(0, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        self.missed.swap(0, Ordering::SeqCst) != 0
    }
}
