// SPDX-License-Identifier: MIT OR Apache-2.0
//! Cleanup at the end of a process that returns from `main` or calls `exit` while its other threads still run: objects that these
//! threads hold are not dropped then.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};

type Last = Box<dyn FnOnce() + Send>;

struct List {
    entries: Vec<(u64, Last)>,
    next: u64,
}

static LIST: Mutex<List> = Mutex::new(List { entries: Vec::new(), next: 0 });
/// The process whose list this is: one that it forks has a copy, whose lock a thread may hold that is not there.
static PID: AtomicU32 = AtomicU32::new(0);

fn list() -> MutexGuard<'static, List> {
    LIST.lock().unwrap_or_else(PoisonError::into_inner)
}

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
    static REGISTERED: Once = Once::new();
    // SAFETY: `run` may be called at any time from C, and does not unwind. If that is refused, nothing is called.
    REGISTERED.call_once(|| _ = unsafe { libc::atexit(run) });
    let mut list = list();
    if PID.swap(std::process::id(), Ordering::Relaxed) != std::process::id() {
        // What its parent leaves is not to be done here, nor dropped.
        std::mem::forget(std::mem::take(&mut list.entries));
    }
    list.next += 1;
    let number = list.next;
    list.entries.push((number, Box::new(last)));
    AtExit(number)
}

impl Drop for AtExit {
    fn drop(&mut self) {
        let mut list = list();
        list.entries.retain(|(number, _)| *number != self.0);
    }
}

extern "C" fn run() {
    if PID.load(Ordering::Relaxed) != std::process::id() {
        return;
    }
    let entries = std::mem::take(&mut list().entries);
    for (_, last) in entries.into_iter().rev() {
        // Said by the panic itself; the others are still called.
        let _ = catch_unwind(AssertUnwindSafe(last));
    }
}
