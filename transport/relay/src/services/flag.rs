// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which services something happened to in the domain: the others are not looked at.

use futures::task::ArcWake;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Waker;

/// Of one service. As its waker it sets itself and wakes the thread.
pub(super) struct Flag {
    is_set: AtomicBool,
    thread: Waker,
}

impl Flag {
    /// One that is set.
    pub(super) fn new(thread: &Waker) -> Arc<Self> {
        Arc::new(Flag { is_set: AtomicBool::new(true), thread: thread.clone() })
    }

    /// For the thread itself, which looks at it again before it waits.
    pub(super) fn set(&self) {
        self.is_set.store(true, Ordering::SeqCst);
    }

    pub(super) fn take(&self) -> bool {
        self.is_set.swap(false, Ordering::SeqCst)
    }
}

impl ArcWake for Flag {
    fn wake_by_ref(flag: &Arc<Self>) {
        flag.set();
        flag.thread.wake_by_ref();
    }
}
