// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wakes a forwarding thread, and flags the topics or services that need serving: only these are served.

use futures::task::{ArcWake, waker};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;
use tautline_transport::{SamplerSeat, Slot};

/// Wakes the relay's thread. Set a [`Flag`] before calling it as a waker.
pub(crate) struct RelayWaker {
    slot: Slot,
    /// Whether the relay's thread is draining rings: it reads the flags afterwards, so no ring is needed.
    is_draining: AtomicBool,
}

impl RelayWaker {
    pub(crate) fn new(slot: Slot) -> Arc<Self> {
        Arc::new(RelayWaker { slot, is_draining: AtomicBool::new(false) })
    }

    /// Always rings, because a command sets no flag.
    pub(crate) fn ring(&self) {
        self.slot.ring();
    }

    /// Takes pending rings, whose wakers set flags. The caller reads the flags afterwards.
    pub(crate) fn drain(&self, seat: &SamplerSeat) {
        self.is_draining.store(true, Ordering::SeqCst);
        seat.drain(|_| {});
        self.is_draining.store(false, Ordering::SeqCst);
    }
}

impl ArcWake for RelayWaker {
    fn wake_by_ref(relay: &Arc<Self>) {
        // SeqCst: in one total order with the relay thread's two steps, the end of `RelayWaker::drain` and then `Flag::take`: either
        // the relay's thread sees the flag, or it is rung.
        if !relay.is_draining.load(Ordering::SeqCst) {
            relay.ring();
        }
    }
}

/// Set while a topic or service needs serving, for example after its subscription is rung. Its waker sets it and wakes the thread.
pub(crate) struct Flag {
    is_set: AtomicBool,
    thread: Waker,
}

impl Flag {
    /// A new flag, set.
    pub(crate) fn new(thread: Waker) -> Arc<Self> {
        Arc::new(Flag { is_set: AtomicBool::new(true), thread })
    }

    /// Sets the flag without a wake: for the thread itself, which reads the flag again before it sleeps.
    pub(crate) fn set(&self) {
        self.is_set.store(true, Ordering::SeqCst);
    }

    pub(crate) fn take(&self) -> bool {
        self.is_set.swap(false, Ordering::SeqCst)
    }

    pub(crate) fn waker(self: &Arc<Self>) -> Waker {
        waker(self.clone())
    }
}

impl ArcWake for Flag {
    fn wake_by_ref(flag: &Arc<Self>) {
        flag.set();
        flag.thread.wake_by_ref();
    }
}
