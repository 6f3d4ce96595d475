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
    /// Sets the callback. The one before is not called any more when this returns; unless a callback sets it, it waits for that.
    pub(crate) fn set(&self, function: Function) {
        self.is_set.store(function.is_some(), Ordering::Release);
        *self.function.lock().unwrap_or_else(PoisonError::into_inner) = Sent(function);
        while self.calls.load(Ordering::Acquire) != 0 && !IS_CALLED.get() {
            std::thread::sleep(LOOK);
        }
    }

    /// # Real-time
    /// Wait-free: one load.
    pub(crate) fn is_set(&self) -> bool {
        self.is_set.load(Ordering::Acquire)
    }

    /// Calls it with how many things happened, if there is one and if some did. Returns whether it did.
    pub(crate) fn call(&self, count: usize) -> bool {
        let function = {
            let function = self.function.lock().unwrap_or_else(PoisonError::into_inner);
            self.calls.fetch_add(1, Ordering::AcqRel);
            function.0.filter(|_| count > 0)
        };
        if let Some((function, data)) = function {
            let is_called = IS_CALLED.replace(true);
            // SAFETY: rmw's word: it can be called until another one is set, which waits for this.
            unsafe { function(data, count) };
            IS_CALLED.set(is_called);
        }
        self.calls.fetch_sub(1, Ordering::AcqRel);
        function.is_some()
    }
}
