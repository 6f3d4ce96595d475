// SPDX-License-Identifier: MIT OR Apache-2.0
//! What ends the sleep of a thread that passes on, and says which topics or services it is about: the others are not looked at.

use futures::task::{ArcWake, waker};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;
use tautline_transport::{SamplerSeat, Slot};

/// Wakes the relay's thread. As a waker it is for who has set a [`Flag`].
pub(crate) struct RelayWaker {
    slot: Slot,
    /// Whether the relay takes rings just now, and will look at the flags after that: it need not be rung.
    is_draining: AtomicBool,
}

impl RelayWaker {
    pub(crate) fn new(slot: Slot) -> Arc<Self> {
        Arc::new(RelayWaker { slot, is_draining: AtomicBool::new(false) })
    }

    /// Whatever the relay does just now: a command is no flag.
    pub(crate) fn ring(&self) {
        self.slot.ring();
    }

    /// Takes the rings that are pending, which sets flags. They are to be looked at afterwards.
    pub(crate) fn drain(&self, seat: &SamplerSeat) {
        self.is_draining.store(true, Ordering::SeqCst);
        seat.drain(|_| {});
        self.is_draining.store(false, Ordering::SeqCst);
    }
}

impl ArcWake for RelayWaker {
    fn wake_by_ref(relay: &Arc<Self>) {
        // In one total order with the relay's own two steps, the end of `RelayWaker::drain` and `Flag::take`: either it sees the
        // flag, or it is rung.
        if !relay.is_draining.load(Ordering::SeqCst) {
            relay.ring();
        }
    }
}

/// Set when something happened to a topic or a service here, such as that its subscription was rung. As its waker it sets itself and
/// wakes the thread.
pub(crate) struct Flag {
    is_set: AtomicBool,
    thread: Waker,
}

impl Flag {
    /// One that is set.
    pub(crate) fn new(thread: Waker) -> Arc<Self> {
        Arc::new(Flag { is_set: AtomicBool::new(true), thread })
    }

    /// For the thread itself, which looks at it again before it sleeps.
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
