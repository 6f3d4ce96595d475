// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks of ROS, called without any lock held, because they may do anything, and never after they were removed.

use std::cell::Cell;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;
use tautline_rt::PiMutex;

/// `rmw_event_callback_t` and its argument; `None` removes a callback.
pub(crate) type Function = Option<(unsafe extern "C" fn(*const c_void, usize), *const c_void)>;

/// Holds a callback.
#[derive(Default)]
pub(crate) struct EventCallback {
    function: PiMutex<Sent>,
    is_set: AtomicBool,
    /// Calls in progress.
    calls: AtomicU32,
}

#[derive(Clone, Copy, Default)]
struct Sent(Function);

// SAFETY: rmw's contract: callbacks may be called in any thread.
unsafe impl Send for Sent {}

thread_local! {
    /// Whether this thread is in a callback.
    static IS_CALLED: Cell<bool> = const { Cell::new(false) };
}

/// Interval of the check whether a call has returned.
const LOOK: Duration = Duration::from_micros(50);

impl EventCallback {
    /// Sets the callback. The previous one may still be running; see [`settle`](Self::settle).
    pub(crate) fn replace(&self, function: Function) {
        self.is_set.store(function.is_some(), Ordering::Release);
        *self.function.lock() = Sent(function);
    }

    /// Waits until calls in progress have returned, unless called from a callback. The caller must hold no lock that they need.
    pub(crate) fn settle(&self) {
        while self.calls.load(Ordering::Acquire) != 0 && !IS_CALLED.get() {
            std::thread::sleep(LOOK);
        }
    }

    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn is_set(&self) -> bool {
        self.is_set.load(Ordering::Acquire)
    }

    /// Begins a call if a callback is set. Call this with the counters locked, and [`Call::run`] unlocked.
    pub(crate) fn begin(&self) -> Option<Call<'_>> {
        let function = self.function.lock();
        let function = function.0?;
        self.calls.fetch_add(1, Ordering::AcqRel);
        Some(Call { callback: self, function })
    }
}

/// A call in progress: [`EventCallback::settle`] waits for it.
pub(crate) struct Call<'c> {
    callback: &'c EventCallback,
    function: (unsafe extern "C" fn(*const c_void, usize), *const c_void),
}

impl Call<'_> {
    /// Calls the callback with the number of events, unless it is 0.
    pub(crate) fn run(self, count: usize) {
        if count > 0 {
            let is_called = IS_CALLED.replace(true);
            let (function, data) = self.function;
            // SAFETY: rmw's contract: it may be called until another one is set, which waits for this.
            unsafe { function(data, count) };
            IS_CALLED.set(is_called);
        }
    }
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.callback.calls.fetch_sub(1, Ordering::AcqRel);
    }
}
