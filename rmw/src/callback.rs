// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks of ROS's, called outside of every lock, for they may do anything; and not any more once they were taken back.

use std::cell::Cell;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// `rmw_event_callback_t` and what it is called with; `None` takes a callback back.
pub(crate) type Function = Option<(unsafe extern "C" fn(*const c_void, usize), *const c_void)>;

/// A place for a callback.
#[derive(Default)]
pub(crate) struct Callback {
    function: Mutex<Sent>,
    is_set: AtomicBool,
    /// Calls that have not returned.
    calls: AtomicU32,
}

#[derive(Clone, Copy, Default)]
struct Sent(Function);

// SAFETY: rmw's word: callbacks are called in any thread.
unsafe impl Send for Sent {}

thread_local! {
    /// Whether this thread is in a callback.
    static IS_CALLED: Cell<bool> = const { Cell::new(false) };
}

/// How often it is looked whether a call has returned.
const LOOK: Duration = Duration::from_micros(50);

impl Callback {
    /// Sets the callback. The one before may be running; see [`settle`](Self::settle).
    pub(crate) fn replace(&self, function: Function) {
        self.is_set.store(function.is_some(), Ordering::Release);
        *self.function.lock().unwrap_or_else(PoisonError::into_inner) = Sent(function);
    }

    /// Waits until calls that began before have returned, without a lock of theirs; but not in a callback.
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

    /// Begins a call, if there is a callback: with the lock of what is counted, which [`Call::run`] is called without.
    pub(crate) fn begin(&self) -> Option<Call<'_>> {
        let function = self.function.lock().unwrap_or_else(PoisonError::into_inner);
        let function = function.0?;
        self.calls.fetch_add(1, Ordering::AcqRel);
        Some(Call { callback: self, function })
    }
}

/// A call that has begun: the callback is not given up before it has returned.
pub(crate) struct Call<'c> {
    callback: &'c Callback,
    function: (unsafe extern "C" fn(*const c_void, usize), *const c_void),
}

impl Call<'_> {
    /// Calls with how many things happened, if some did.
    pub(crate) fn run(self, count: usize) {
        if count > 0 {
            let is_called = IS_CALLED.replace(true);
            let (function, data) = self.function;
            // SAFETY: rmw's word: it can be called until another one is set, which waits for this.
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
