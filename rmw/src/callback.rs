// SPDX-License-Identifier: MIT OR Apache-2.0
//! Callbacks of ROS, called without any lock held, because they may do anything, and never after they were removed.

use std::cell::Cell;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};
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
    /// The innermost call on this thread's stack; its `around` leads to the enclosing calls.
    static INNERMOST: Cell<*const Call<'static>> = const { Cell::new(std::ptr::null()) };
}

/// Interval of the check whether a call has returned.
const LOOK: Duration = Duration::from_micros(50);
/// How long a callback waits for another one.
const PATIENCE: Duration = Duration::from_secs(1);

impl EventCallback {
    /// Sets the callback. The previous one may still be running; see [`settle`](Self::settle).
    pub(crate) fn replace(&self, function: Function) {
        self.is_set.store(function.is_some(), Ordering::Release);
        *self.function.lock() = Sent(function);
    }

    /// Waits until calls in progress in other threads have returned. The caller must hold no lock that they need. Called in a callback, it
    /// waits for one second at most, because the other call may in turn wait for that callback.
    pub(crate) fn settle(&self) {
        let (own, start) = (self.own_calls(), Instant::now());
        while self.calls.load(Ordering::Acquire) > own {
            if !INNERMOST.get().is_null() && start.elapsed() > PATIENCE {
                return tracing::warn!(
                    "a callback that was removed within another callback still runs after a second: keep what it uses, or remove it elsewhere"
                );
            }
            std::thread::sleep(LOOK);
        }
    }

    /// The number of this callback's calls on this thread's stack, which cannot return before the caller does.
    fn own_calls(&self) -> u32 {
        let (mut own, mut call) = (0, INNERMOST.get());
        // SAFETY: null, or a call that runs in this thread until it has put back the one around it.
        while let Some(inner) = unsafe { call.as_ref() } {
            own += u32::from(std::ptr::eq(inner.callback, self));
            call = inner.around.get();
        }
        own
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
        Some(Call { callback: self, function, around: Cell::new(std::ptr::null()) })
    }
}

/// A call in progress: [`EventCallback::settle`] waits for it.
pub(crate) struct Call<'c> {
    callback: &'c EventCallback,
    function: (unsafe extern "C" fn(*const c_void, usize), *const c_void),
    /// The call from which this one was made in this thread.
    around: Cell<*const Call<'static>>,
}

impl Call<'_> {
    /// Calls the callback with the number of events, unless it is 0.
    pub(crate) fn run(self, count: usize) {
        if count > 0 {
            self.around.set(INNERMOST.replace(std::ptr::from_ref(&self).cast()));
            let (function, data) = self.function;
            // SAFETY: rmw's contract: it may be called until another one is set, which waits for this.
            unsafe { function(data, count) };
            INNERMOST.set(self.around.get());
        }
    }
}

impl Drop for Call<'_> {
    fn drop(&mut self) {
        self.callback.calls.fetch_sub(1, Ordering::AcqRel);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Barrier, OnceLock};

    type Body<'b> = Box<dyn Fn() + Sync + 'b>;

    unsafe extern "C" fn run(body: *const c_void, _: usize) {
        // SAFETY: a `Body` that `of` was given, which outlives the call.
        unsafe { (*body.cast::<Body<'_>>())() }
    }

    fn of(body: &Body<'_>) -> EventCallback {
        let callback = EventCallback::default();
        callback.replace(Some((run, std::ptr::from_ref(body).cast())));
        callback
    }

    #[test]
    fn what_is_removed_within_another_callback_has_returned() {
        let (inside, removing) = (Barrier::new(2), AtomicBool::new(false));
        let has_returned = AtomicBool::new(false);
        let slow: Body<'_> = Box::new(|| {
            inside.wait();
            while !removing.load(Ordering::SeqCst) {
                std::thread::yield_now();
            }
            // Less than the second of patience, though others may have the core for a while at each of these.
            (0..50).for_each(|_| std::thread::yield_now());
            has_returned.store(true, Ordering::SeqCst);
        });
        let slow = of(&slow);
        let remover: Body<'_> = Box::new(|| {
            inside.wait();
            slow.replace(None);
            removing.store(true, Ordering::SeqCst);
            slow.settle();
            assert!(has_returned.load(Ordering::SeqCst));
        });
        let remover = of(&remover);
        std::thread::scope(|scope| {
            scope.spawn(|| slow.begin().unwrap().run(1));
            remover.begin().unwrap().run(1);
        });
        // A callback does not wait for itself.
        let itself = OnceLock::<EventCallback>::new();
        let body: Body<'_> = Box::new(|| itself.get().unwrap().settle());
        itself.get_or_init(|| of(&body)).begin().unwrap().run(1);
    }
}
