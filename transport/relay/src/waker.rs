// SPDX-License-Identifier: MIT OR Apache-2.0
//! What ends the relay's sleep, and says which topics it is about.

use futures::task::{ArcWake, waker};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;
use tautline_transport::{SamplerSeat, Slot};

/// Wakes the relay's thread.
pub(crate) struct RelayWaker {
    slot: Slot,
    /// Whether the relay takes rings just now, and will look at the flags after that: it need not be rung.
    is_draining: AtomicBool,
}

impl RelayWaker {
    pub(crate) fn new(slot: Slot) -> Arc<Self> {
        Arc::new(RelayWaker { slot, is_draining: AtomicBool::new(false) })
    }

    pub(crate) fn wake(&self) {
        self.slot.ring();
    }

    /// Takes the rings that are pending, which sets flags. They are to be looked at afterwards.
    pub(crate) fn drain(&self, seat: &SamplerSeat) {
        self.is_draining.store(true, Ordering::SeqCst);
        seat.drain(|_| {});
        self.is_draining.store(false, Ordering::SeqCst);
    }
}

/// Set when a topic's subscription was rung, or may take again since a sample was given back.
pub(crate) struct Flag {
    is_set: AtomicBool,
    relay: Arc<RelayWaker>,
}

impl Flag {
    /// One that is set.
    pub(crate) fn new(relay: Arc<RelayWaker>) -> Arc<Self> {
        Arc::new(Flag { is_set: AtomicBool::new(true), relay })
    }

    /// For the relay's own thread, which looks at it again before it sleeps.
    pub(crate) fn set(&self) {
        self.is_set.store(true, Ordering::SeqCst);
    }

    pub(crate) fn take(&self) -> bool {
        self.is_set.swap(false, Ordering::SeqCst)
    }

    /// Sets it and ends the relay's sleep.
    pub(crate) fn waker(self: &Arc<Self>) -> Waker {
        waker(self.clone())
    }
}

impl ArcWake for Flag {
    fn wake_by_ref(flag: &Arc<Self>) {
        // In one total order with the relay's own two steps, the end of `RelayWaker::drain` and `Flag::take`: either it sees the
        // flag, or it is rung.
        flag.set();
        if !flag.relay.is_draining.load(Ordering::SeqCst) {
            flag.relay.wake();
        }
    }
}
