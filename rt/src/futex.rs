// SPDX-License-Identifier: MIT OR Apache-2.0
//! A word on which threads of any process can sleep, or loom's model of one (`--cfg taut_loom`).

#[cfg(not(taut_loom))]
pub use kernel::FutexWord;
#[cfg(taut_loom)]
use loom::sync::atomic::{AtomicU32, Ordering};

/// The kernel's futex, for code that no loom model contains.
pub(crate) mod kernel {
    use std::sync::atomic::AtomicU32;

    /// A 32-bit word, also in shared memory, on which threads of any process can sleep.
    #[repr(transparent)]
    #[derive(Debug, Default)]
    pub struct FutexWord(pub AtomicU32);

    impl FutexWord {
        /// A word of this process.
        pub const fn new(value: u32) -> Self {
            FutexWord(AtomicU32::new(value))
        }

        /// Sleeps while the word equals `expected`, until [`wake`](Self::wake) or the absolute `CLOCK_MONOTONIC` time
        /// `deadline_ns`. May return early: the caller must check again.
        ///
        /// # Real-time
        /// One syscall. The time-out is absolute and monotonic: setting the clock does not affect it.
        pub fn wait(&self, expected: u32, deadline_ns: Option<u64>) {
            use rustix::thread::{Timespec, futex};
            let timeout = deadline_ns.map(|ns| Timespec {
                tv_sec: (ns / 1_000_000_000) as i64,
                tv_nsec: (ns % 1_000_000_000) as i64,
            });
            // EAGAIN (the word changed), ETIMEDOUT and EINTR all mean: look again.
            let any = core::num::NonZeroU32::MAX;
            let _ = futex::wait_bitset(&self.0, futex::Flags::empty(), expected, timeout.as_ref(), any);
        }

        /// Wakes every sleeper.
        ///
        /// # Real-time
        /// One syscall; no allocation.
        pub fn wake(&self) {
            // The only failure is a bad address, and the word is a reference.
            let _ =
                rustix::thread::futex::wake(&self.0, rustix::thread::futex::Flags::empty(), i32::MAX as u32);
        }
    }
}

/// A model of the kernel's futex: comparing and falling asleep are one step with respect to `wake`.
#[cfg(taut_loom)]
#[derive(Debug)]
pub struct FutexWord(pub AtomicU32, loom::sync::Mutex<()>, loom::sync::Condvar);

#[cfg(taut_loom)]
#[allow(missing_docs)]
impl FutexWord {
    pub fn new(value: u32) -> Self {
        FutexWord(AtomicU32::new(value), loom::sync::Mutex::new(()), loom::sync::Condvar::new())
    }

    pub fn wait(&self, expected: u32, _deadline_ns: Option<u64>) {
        let bucket = self.1.lock().unwrap();
        if self.0.load(Ordering::Relaxed) == expected {
            drop(self.2.wait(bucket).unwrap());
        }
    }

    pub fn wake(&self) {
        drop(self.1.lock().unwrap());
        self.2.notify_all();
    }
}
