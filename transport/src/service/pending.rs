// SPDX-License-Identifier: MIT OR Apache-2.0
//! The pending requests of a client: a table of fixed size, without a lock.
//!
//! ```text
//!          claim          arm             answer, fail           put             take (future)
//!    free -------> claimed ----> waiting ---------------> writing ----> done ----------------> free
//!      ^                            |                        |
//!      +--- release (dropped) ------+    release (dropped)   +----> abandoned ----> free (by the writer)
//! ```
//!
//! The state of a table entry contains the number of its pending request. No other request of the client has this number.
//! So an attempt to complete a request that has been cancelled meanwhile fails, even if the entry is used for another
//! request by then.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::sync::{AtomicU64, Ordering, fence};
use crate::topic::subscription::hot::RawSample;
use core::cell::UnsafeCell;
use std::sync::Arc;
use std::task::Wake;
use tautline_rt::WakerCell;

/// Maximum number of pending requests of one client, including waits for a server to appear: the number of
/// bits in a word.
pub const MAX_PENDING_REQUESTS: usize = 64;

/// Fewer in the loom model, which checks every interleaving.
const PLACES: usize = if cfg!(taut_loom) { 2 } else { MAX_PENDING_REQUESTS };

#[derive(Debug)]
pub(crate) enum Outcome<R = RawSample> {
    Response(R),
    /// Every server that got the request has ended, or the relay that forwarded it got no response.
    ServerGone,
    /// There is a server: the outcome of a wait without a request.
    Available,
}

/// The phase of an entry: the lowest bits of its state. The number of its request is above them.
const PHASE: u64 = 0b111;
const FREE: u64 = 0;
const CLAIMED: u64 = 1;
const WAITING: u64 = 2;
const WRITING: u64 = 3;
const DONE: u64 = 4;
const ABANDONED: u64 = 5;

/// The state of a place that waits for the response to this request, or with 0 for a server. `None`: no request has that number.
fn waiting(sequence_number: u64) -> Option<u64> {
    let number = sequence_number.checked_mul(PHASE + 1)?;
    Some(number | WAITING)
}

fn has_request(state: u64) -> bool {
    state > PHASE
}

fn in_phase(state: u64, phase: u64) -> u64 {
    state & !PHASE | phase
}

struct PendingSlot<R> {
    state: AtomicU64,
    /// The servers that may answer, by their bits.
    servers: AtomicU64,
    /// Accessed by the thread that writes the outcome, by the future when it is done, and by the thread that
    /// frees the entry.
    outcome: UnsafeCell<Option<Outcome<R>>>,
}

impl<R> Default for PendingSlot<R> {
    fn default() -> Self {
        PendingSlot {
            state: AtomicU64::new(FREE),
            servers: AtomicU64::new(0),
            outcome: UnsafeCell::new(None),
        }
    }
}

// SAFETY: `outcome` is accessed by the thread that moved `state` to `writing`, until `state` is `done`, and by the owner of the
// place from then on: the transitions of `state` synchronize them. An Outcome is Send.
unsafe impl<R: Send> Sync for PendingSlot<R> {}

/// The waiting tasks. Separate from the table, so that a doorbell that holds this as a waker owns nothing else.
pub(crate) struct Waiters {
    occupied: AtomicU64,
    /// Whoever collects wakes them, and so does the sampler.
    wakers: [WakerCell; PLACES],
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

pub(crate) struct PendingTable<R = RawSample> {
    waiters: Arc<Waiters>,
    /// The existing servers, by their bits.
    alive: AtomicU64,
    places: [PendingSlot<R>; PLACES],
}

impl<R> PendingTable<R> {
    #[allow(clippy::disallowed_methods, reason = "when a client is made")]
    pub(crate) fn new() -> Self {
        let waiters =
            Waiters { occupied: AtomicU64::new(0), wakers: core::array::from_fn(|_| WakerCell::default()) };
        let places = core::array::from_fn(|_| PendingSlot::default());
        PendingTable { waiters: Arc::new(waiters), alive: AtomicU64::new(0), places }
    }

    pub(crate) fn waiters(&self) -> &Arc<Waiters> {
        &self.waiters
    }

    /// The existing servers, by their bits.
    pub(crate) fn alive(&self) -> u64 {
        self.alive.load(Ordering::SeqCst)
    }

    /// Claims a place. `None`: all are taken.
    ///
    /// # Real-time
    /// Wait-free, O(places); no allocation; no syscall.
    pub(crate) fn claim(&self) -> Option<usize> {
        let claim = |place: &PendingSlot<R>| {
            // Acquire: pairs with the Release that freed it.
            place.state.compare_exchange(FREE, CLAIMED, Ordering::Acquire, Ordering::Relaxed).is_ok()
        };
        let index = self.places.iter().position(claim)?;
        self.waiters.occupied.fetch_or(1 << index, Ordering::SeqCst);
        Some(index)
    }

    /// Arms a claimed place for the request `sequence_number`, which is about to be sent to the existing servers: once it is sent, call
    /// [`sent`](Self::sent). 0 waits for a server.
    pub(crate) fn arm(&self, index: usize, sequence_number: u64) {
        let (Some(place), Some(state)) = (self.places.get(index), waiting(sequence_number)) else { return };
        place.servers.store(self.alive(), Ordering::Relaxed);
        place.state.store(state, Ordering::SeqCst);
    }

    /// Called once the request of an armed place was sent. Handles servers that have disappeared by now;
    /// [`servers_changed`](Self::servers_changed) handles those that disappear later.
    pub(crate) fn sent(&self, index: usize) {
        fence(Ordering::SeqCst);
        if let Some(place) = self.places.get(index) {
            self.remove_servers(index, place, !self.alive());
        }
    }

    pub(crate) fn register(&self, index: usize, waker: &core::task::Waker) {
        if let Some(registered) = self.waiters.wakers.get(index) {
            registered.register(waker);
        }
    }

    /// Takes the outcome, if it is there: the place is then free.
    pub(crate) fn take(&self, index: usize) -> Option<Outcome<R>> {
        let place = self.places.get(index)?;
        // Acquire: pairs with the Release in `complete`.
        if place.state.load(Ordering::Acquire) & PHASE != DONE {
            return None;
        }
        // SAFETY: the state is `done`, so only the place's owner accesses the outcome.
        let outcome = unsafe { (*place.outcome.get()).take() };
        self.free(index, place);
        outcome
    }

    /// Releases a place whose owner no longer waits.
    ///
    /// # Real-time
    /// Lock-free: a second and a third look if it is being completed right now; no allocation; no syscall.
    pub(crate) fn release(&self, index: usize) {
        let Some(place) = self.places.get(index) else { return };
        loop {
            let state = place.state.load(Ordering::Acquire);
            let leave =
                |next| place.state.compare_exchange(state, next, Ordering::AcqRel, Ordering::Relaxed).is_ok();
            match state & PHASE {
                DONE => return drop(self.take(index)),
                WRITING => {
                    if leave(in_phase(state, ABANDONED)) {
                        return;
                    }
                }
                // Not yet free: another request could claim a free place before its bit in `occupied` is cleared.
                _ => {
                    if leave(CLAIMED) {
                        return self.free(index, place);
                    }
                }
            }
        }
    }

    fn free(&self, index: usize, place: &PendingSlot<R>) {
        if let Some(waker) = self.waiters.wakers.get(index) {
            waker.clear();
        }
        self.waiters.occupied.fetch_and(!(1 << index), Ordering::SeqCst);
        place.state.store(FREE, Ordering::Release);
    }

    /// Passes the outcome of a request to the task that waits for it. If no task waits any more, or another server was faster, the
    /// outcome is dropped.
    ///
    /// # Real-time
    /// Wait-free, O(pending requests); no allocation; a syscall if the task's thread sleeps.
    pub(crate) fn answer(&self, sequence_number: u64, outcome: Outcome<R>) {
        let Some(state) = waiting(sequence_number).filter(|&state| has_request(state)) else { return };
        let asked = |(_, place): &(usize, &PendingSlot<R>)| place.state.load(Ordering::Relaxed) == state;
        if let Some((index, place)) = self.occupied().find(asked) {
            self.complete(index, place, state, outcome);
        }
    }

    /// Sets the servers that exist, `alive`. Those in `gone` have disappeared, and all of their responses were taken before.
    ///
    /// # Real-time
    /// As [`answer`](Self::answer).
    pub(crate) fn servers_changed(&self, gone: u64, alive: u64) {
        // Before the requests are checked: for a request that is armed after the check, `sent` reads it.
        self.alive.store(alive, Ordering::SeqCst);
        fence(Ordering::SeqCst);
        for (index, place) in self.occupied() {
            let state = place.state.load(Ordering::SeqCst);
            if has_request(state) {
                self.remove_servers(index, place, gone);
            } else if state == WAITING && alive != 0 {
                self.complete(index, place, state, Outcome::Available);
            }
        }
    }

    /// Ends all requests and waits for servers: no server answers any more.
    ///
    /// # Real-time
    /// As [`answer`](Self::answer).
    pub(crate) fn end(&self) {
        self.servers_changed(u64::MAX, 0);
        for (index, place) in self.occupied() {
            let state = place.state.load(Ordering::SeqCst);
            if state == WAITING {
                self.complete(index, place, state, Outcome::ServerGone);
            }
        }
    }

    fn remove_servers(&self, index: usize, place: &PendingSlot<R>, gone: u64) {
        let state = place.state.load(Ordering::SeqCst);
        if !has_request(state) || state & PHASE != WAITING {
            return;
        }
        // If the place has been reused meanwhile, these are the servers of a later request, which cannot answer that one either.
        if place.servers.fetch_and(!gone, Ordering::SeqCst) & !gone == 0 {
            self.complete(index, place, state, Outcome::ServerGone);
        }
    }

    fn occupied(&self) -> impl Iterator<Item = (usize, &PendingSlot<R>)> {
        bits(self.waiters.occupied.load(Ordering::SeqCst))
            .filter_map(|index| Some((index, self.places.get(index)?)))
    }

    /// Stores the outcome if the place is still in `state`, and wakes the task.
    fn complete(&self, index: usize, place: &PendingSlot<R>, state: u64, outcome: Outcome<R>) {
        let writing = in_phase(state, WRITING);
        if place.state.compare_exchange(state, writing, Ordering::AcqRel, Ordering::Relaxed).is_err() {
            return;
        }
        // SAFETY: the state is `writing`, so only this function accesses the outcome.
        unsafe { *place.outcome.get() = Some(outcome) };
        // Release: pairs with the Acquire in `take`.
        let done = in_phase(state, DONE);
        if place.state.compare_exchange(writing, done, Ordering::AcqRel, Ordering::Relaxed).is_ok() {
            self.waiters.wake_one(index);
        } else {
            // SAFETY: the state is `abandoned`, so still only this function accesses the outcome.
            drop(unsafe { (*place.outcome.get()).take() });
            self.free(index, place);
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

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn any_number_is_answered_once_or_not_at_all() {
        let table = PendingTable::<u32>::new();
        table.servers_changed(0, 1);
        let index = table.claim().expect("a place");
        table.arm(index, 7);
        table.sent(index);
        for number in [0, 6, 8, u64::MAX, 7 | 1 << 61] {
            table.answer(number, Outcome::Response(0));
            assert!(table.take(index).is_none(), "{number}");
        }
        table.answer(7, Outcome::Response(1));
        table.answer(7, Outcome::Response(2));
        assert!(matches!(table.take(index), Some(Outcome::Response(1))));
        assert!(table.take(index).is_none());
        table.answer(7, Outcome::Response(3));
        assert_eq!(table.claim(), Some(index), "free again");
    }

    #[test]
    fn a_request_ends_with_the_last_server_that_got_it() {
        let table = PendingTable::<u32>::new();
        table.servers_changed(0, 0b11);
        let index = table.claim().expect("a place");
        table.arm(index, 1);
        table.sent(index);
        table.servers_changed(0b01, 0b110);
        assert!(table.take(index).is_none(), "one is left");
        table.servers_changed(0b10, 0b100);
        assert!(matches!(table.take(index), Some(Outcome::ServerGone)), "the third did not get it");
    }

    /// The sampler preempts a thread of low priority that has taken the response, before its wake.
    #[test]
    #[allow(clippy::disallowed_methods, reason = "a test")]
    fn the_sampler_wakes_a_task_that_another_thread_is_waking() {
        struct Preempted(Arc<Waiters>, AtomicU64);
        impl Wake for Preempted {
            fn wake(self: Arc<Self>) {
                self.wake_by_ref();
            }

            fn wake_by_ref(self: &Arc<Self>) {
                if self.1.fetch_add(1, Ordering::Relaxed) == 0 {
                    self.0.wake_all();
                }
            }
        }
        let table = PendingTable::<u32>::new();
        table.servers_changed(0, 1);
        let index = table.claim().expect("a place");
        table.arm(index, 1);
        table.sent(index);
        let task = Arc::new(Preempted(table.waiters().clone(), AtomicU64::new(0)));
        table.register(index, &task.clone().into());
        table.answer(1, Outcome::Response(0));
        assert_eq!(task.1.load(Ordering::Relaxed), 2);
        assert!(matches!(table.take(index), Some(Outcome::Response(0))));
        assert_eq!(Arc::strong_count(&task), 1, "nothing is registered any more");
    }
}

/// Every interleaving of who sends, who collects, and who drops what waits.
#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use loom::cell::Cell;
    use loom::thread;

    /// A response that loom watches: to touch it in two threads at once is an error, and so is to lose it undropped.
    struct DropProbe(u64, loom::sync::Arc<Cell<u32>>);
    // SAFETY: for the model; loom checks the accesses.
    unsafe impl Send for DropProbe {}

    impl Drop for DropProbe {
        fn drop(&mut self) {
            self.1.set(self.1.get() + 1);
        }
    }

    type Model = loom::sync::Arc<PendingTable<DropProbe>>;

    fn table() -> Model {
        let table = PendingTable::new();
        table.servers_changed(0, 1);
        loom::sync::Arc::new(table)
    }

    fn response(number: u64) -> (Outcome<DropProbe>, Dropped) {
        let cell = loom::sync::Arc::new(Cell::new(0));
        (Outcome::Response(DropProbe(number, cell.clone())), Dropped(cell))
    }

    struct Dropped(loom::sync::Arc<Cell<u32>>);
    // SAFETY: as above.
    unsafe impl Send for Dropped {}

    fn send(table: &Model, number: u64) -> usize {
        let index = table.claim().expect("a place");
        table.arm(index, number);
        table.sent(index);
        index
    }

    fn model(f: impl Fn() + Sync + Send + 'static) {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(3);
        builder.check(f);
    }

    /// Starts the thread that collects, which does `what`.
    fn collector(table: &Model, what: impl FnOnce(&Model) + 'static) -> thread::JoinHandle<()> {
        let table = table.clone();
        thread::spawn(move || what(&table))
    }

    #[test]
    fn loom_a_request_that_is_dropped_while_it_is_answered() {
        model(|| {
            let table = table();
            let index = send(&table, 1);
            let (outcome, dropped) = response(1);
            let collector = collector(&table, move |table| table.answer(1, outcome));
            table.release(index);
            collector.join().unwrap();
            assert_eq!(dropped.0.get(), 1, "the response was given back once");
            assert!(table.claim().is_some() && table.claim().is_some(), "both places are free");
        });
    }

    #[test]
    fn loom_the_server_goes_while_its_answer_arrives() {
        // One thread collects: what the server sent first, then that it has gone. The other sends one request more.
        model(|| {
            let table = table();
            let first = send(&table, 1);
            let (outcome, dropped) = response(1);
            let collector = collector(&table, move |table| {
                table.answer(1, outcome);
                table.servers_changed(1, 0);
            });
            let second = send(&table, 2);
            collector.join().unwrap();
            assert!(matches!(table.take(first), Some(Outcome::Response(DropProbe(1, _)))));
            assert!(matches!(table.take(second), Some(Outcome::ServerGone)), "whenever it was sent");
            assert_eq!(dropped.0.get(), 1);
        });
    }

    #[test]
    fn loom_a_place_changes_hands_while_the_server_goes() {
        // What the collector saw waiting is dropped, and its place is claimed for another request, which must end as well.
        model(|| {
            let table = table();
            let filler = table.claim().expect("so that there is one place for two requests");
            let first = send(&table, 1);
            let collector = collector(&table, |table| table.servers_changed(1, 0));
            table.release(first);
            let second = table.claim();
            if let Some(second) = second {
                table.arm(second, 2);
                table.sent(second);
            }
            collector.join().unwrap();
            if let Some(second) = second {
                assert!(matches!(table.take(second), Some(Outcome::ServerGone)));
            }
            table.release(filler);
            assert!(table.claim().is_some() && table.claim().is_some(), "both places are free");
        });
    }

    #[test]
    fn loom_an_answer_to_one_request_is_not_that_to_another() {
        model(|| {
            let table = table();
            let filler = table.claim().expect("so that there is one place for two requests");
            let first = send(&table, 1);
            let (outcome, dropped) = response(1);
            let collector = collector(&table, move |table| table.answer(1, outcome));
            table.release(first);
            let second = table.claim().inspect(|&second| table.arm(second, 2));
            collector.join().unwrap();
            assert_eq!(dropped.0.get(), 1);
            if let Some(second) = second {
                assert!(table.take(second).is_none(), "it waits");
            }
            table.release(filler);
        });
    }
}
