// SPDX-License-Identifier: MIT OR Apache-2.0
//! Wakes a forwarding thread, and flags the topics or services concerned: only these are served.

use futures::task::{ArcWake, waker};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;
use tautline_transport::{SamplerSeat, Slot};

/// Wakes the relay's thread. As a waker, for use after setting a [`Flag`].
pub(crate) struct RelayWaker {
    slot: Slot,
    /// Whether the relay is draining rings and will read the flags afterwards: no ring is needed.
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

    /// Takes pending rings, which sets flags. Read the flags afterwards.
    pub(crate) fn drain(&self, seat: &SamplerSeat) {
        self.is_draining.store(true, Ordering::SeqCst);
        seat.drain(|_| {});
        self.is_draining.store(false, Ordering::SeqCst);
    }
}

impl ArcWake for RelayWaker {
    fn wake_by_ref(relay: &Arc<Self>) {
        // In one total order with the relay's two steps, the end of `RelayWaker::drain` and `Flag::take`: either the relay sees
        // the flag, or it is rung.
        if !relay.is_draining.load(Ordering::SeqCst) {
            relay.ring();
        }
    }
}

/// Set when a topic or service needs serving, for example when its subscription is rung. Its waker sets it and wakes the thread.
pub(crate) struct Flag {
    is_set: AtomicBool,
    thread: Waker,
}

impl Flag {
    /// A new flag, set.
    pub(crate) fn new(thread: Waker) -> Arc<Self> {
        Arc::new(Flag { is_set: AtomicBool::new(true), thread })
    }

    /// For the thread itself, which reads it again before it sleeps.
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
