// SPDX-License-Identifier: MIT OR Apache-2.0
//! How many refer to a sample: its loan, each subscription that it was sent to, and what keeps it for late joiners.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::sync::{AtomicU32, Ordering};

/// The number of references to one sample. All functions are wait-free but [`pin`](Self::pin), which is lock-free: another reference that
/// comes or goes meanwhile makes it try again.
pub(crate) struct References(AtomicU32);

impl References {
    /// Of a free sample.
    pub(crate) fn none() -> Self {
        References(AtomicU32::new(0))
    }

    /// The first one, of who has taken a free sample.
    pub(crate) fn begin(&self) {
        // Release: pairs with the Acquire in `pin`. Who pins this use of the sample sees that the former one is over, for example
        // that the sample is not kept any more.
        self.0.store(1, Ordering::Release);
    }

    /// One more, for who has one.
    pub(crate) fn add(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// One more, if there is any: the sample is not free then. For who has none of its own.
    pub(crate) fn pin(&self) -> bool {
        let more = |count: u32| (count != 0).then(|| count + 1);
        self.0.fetch_update(Ordering::Acquire, Ordering::Relaxed, more).is_ok()
    }

    /// One less. True if it was the last one: then the sample is to be given back.
    pub(crate) fn release(&self) -> bool {
        // Release, and Acquire for the last one: what others did with the sample is over before it is taken again.
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
