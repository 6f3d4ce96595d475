// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cleanup at the end of a process that returns from `main` or calls `exit` while its other threads still run: objects that these
//! threads hold are not dropped then.

use std::ffi::{c_int, c_void};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::fork::ProcessMutex;

type Last = Box<dyn FnOnce() + Send>;

struct List {
    is_registered: bool,
    entries: Vec<(u64, Last)>,
}

impl List {
    const fn new() -> List {
        List { is_registered: false, entries: Vec::new() }
    }
}

static LIST: ProcessMutex<List> = ProcessMutex::new(List::new(), List::new);
/// The number of the next entry. It is not reset in a forked child, so that no entry of the parent has the same number.
static NEXT: AtomicU64 = AtomicU64::new(0);

/// A function that is called at the process's end, unless this is dropped before. A process that ends while this is being dropped
/// waits until the function has been dropped. The function may not hold another `AtExit`.
#[derive(Debug)]
#[must_use = "dropping it cancels the call at exit"]
pub struct AtExit(u64);

/// Calls `last` when the process ends normally, in the thread that ends it; functions registered later are called first. If the
/// process is killed, or calls `_exit`, nothing is called.
///
/// # Real-time
/// Setup only.
pub fn at_exit(last: impl FnOnce() + Send + 'static) -> AtExit {
    let mut list = LIST.lock();
    if !std::mem::replace(&mut list.is_registered, true) {
        // Registered again in a child, which may not call what its parent registered.
        // SAFETY: `run` may be called at any time from C, and does not unwind. If that is refused, nothing is called.
        unsafe { libc::atexit(run) };
    }
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    list.entries.push((number, Box::new(last)));
    AtExit(number)
}

impl Drop for AtExit {
    fn drop(&mut self) {
        LIST.lock().entries.retain(|(number, _)| *number != self.0);
    }
}

extern "C" fn run() {
    let entries = std::mem::take(&mut LIST.lock().entries);
    for (_, last) in entries.into_iter().rev() {
        // The panic has printed its message; the other entries are still called.
        let _ = catch_unwind(AssertUnwindSafe(last));
    }
}

/// Has children that are forked from now on exit without the exit handlers and static destructors, of any library, that this process
/// has registered by then. These are for the parent's objects, often threads, of which a child has none: a logging library waits for
/// its own forever. A child's own handlers are still called, and C's streams are flushed.
///
/// # Real-time
/// Setup only. Each fork registers a handler in the child.
pub fn exempt_children() {
    static REGISTERED: Once = Once::new();
    // SAFETY: `in_child` may be called in any child, and does not unwind. If that is refused, children exit as ever.
    REGISTERED.call_once(|| _ = unsafe { libc::pthread_atfork(None, None, Some(in_child)) });
}

unsafe extern "C" {
    /// Of the C library: as `atexit`, for a function that gets the status.
    fn on_exit(function: extern "C" fn(c_int, *mut c_void), argument: *mut c_void) -> c_int;
}

/// Handlers are called in the reverse order of their registration: this one before all of the parent's.
unsafe extern "C" fn in_child() {
    // SAFETY: `end` may be called at any time.
    unsafe { on_exit(end, std::ptr::null_mut()) };
}

extern "C" fn end(status: c_int, _: *mut c_void) {
    // SAFETY: all streams; ends the process.
    unsafe {
        libc::fflush(std::ptr::null_mut());
        libc::_exit(status);
    }
}
