// SPDX-License-Identifier: MIT OR Apache-2.0
//! Counts the references to a sample: of its loan, of each subscription that it was sent to, and of the history for late joiners.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::sync::{AtomicU32, Ordering};

/// The number of references to one sample. All functions are wait-free except [`pin`](Self::pin), which is lock-free: it tries again
/// if another reference is added or released meanwhile.
pub(crate) struct References(AtomicU32);

impl References {
    /// The count of a free sample.
    pub(crate) fn none() -> Self {
        References(AtomicU32::new(0))
    }

    /// Sets the first reference, that of the thread which has taken a free sample.
    pub(crate) fn begin(&self) {
        // Release: pairs with the Acquire in `pin`. A thread that pins this use of the sample sees that the former use is over, for
        // example that the sample is not kept any more.
        self.0.store(1, Ordering::Release);
    }

    /// Adds a reference, for a caller that has one.
    pub(crate) fn add(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// Adds a reference unless the sample is free, for a caller that has none. Returns whether it was added.
    pub(crate) fn pin(&self) -> bool {
        let more = |count: u32| (count != 0).then(|| count + 1);
        self.0.fetch_update(Ordering::Acquire, Ordering::Relaxed, more).is_ok()
    }

    /// Releases a reference. Returns whether it was the last one: then the sample is to be given back.
    pub(crate) fn release(&self) -> bool {
        // Release, and Acquire for the last one: the other holders' use of the sample is over before it is taken again.
        self.0.fetch_sub(1, Ordering::AcqRel) == 1
    }

    pub(crate) fn is_none(&self) -> bool {
        self.0.load(Ordering::Acquire) == 0
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use loom::cell::UnsafeCell;
    use loom::sync::Arc;

    /// As `Pool::release` and `Pool::list_free` do it: the publishing thread frees the sample, or finds that setup code has.
    #[test]
    fn loom_a_sample_that_setup_frees_is_taken_again_when_its_use_is_over() {
        struct Sample(References, UnsafeCell<u64>);
        // SAFETY: loom checks the accesses.
        unsafe impl Sync for Sample {}
        // SAFETY: as above.
        unsafe impl Send for Sample {}
        loom::model(|| {
            let sample = Arc::new(Sample(References::none(), UnsafeCell::new(1)));
            sample.0.begin();
            sample.0.add();
            let setup = {
                let sample = sample.clone();
                loom::thread::spawn(move || {
                    // SAFETY: loom checks it.
                    assert_eq!(sample.1.with(|content| unsafe { *content }), 1);
                    sample.0.release()
                })
            };
            let is_listed = sample.0.release();
            if is_listed || sample.0.is_none() {
                sample.0.begin();
                // SAFETY: loom checks it.
                sample.1.with_mut(|content| unsafe { *content = 2 });
            }
            assert_ne!(setup.join().unwrap(), is_listed, "one of the two frees it");
        });
    }
}
