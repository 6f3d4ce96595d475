// SPDX-License-Identifier: MIT OR Apache-2.0
//! Transient local: the last samples of a publisher are kept for late joiners.
//!
//! The publisher holds one more reference to each of these samples. The setup code of a late joiner's connection submits them to
//! the connection before the publisher knows of it. So a late joiner takes its history like all other samples, without a copy,
//! even from a publisher that stays silent forever.
//!
//! The publisher may release a kept sample at any moment, so the setup code may not simply use it. It first adds a reference to a
//! sample that still has references, and then checks whether this sample is still the one that is kept.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::memory::pool::Pool;
use crate::sync::{AtomicU64, Ordering};

/// The value of a place where no sample is kept.
const NONE: u64 = u64::MAX;

/// The samples that positions refer to.
pub(crate) trait Samples {
    /// Adds a reference to a sample, if it has any.
    fn pin(&self, chunk: u64) -> bool;

    /// The sequence number in a sample's header.
    ///
    /// # Safety
    /// The sample is pinned and was kept after that: nobody writes its header.
    unsafe fn number(&self, chunk: u64) -> Option<u64>;

    /// Releases one reference.
    fn release(&self, chunk: u64);
}

impl Samples for Pool {
    fn pin(&self, chunk: u64) -> bool {
        self.find(chunk).is_some_and(|(segment, index)| segment.pin(index))
    }

    unsafe fn number(&self, chunk: u64) -> Option<u64> {
        let (segment, index) = self.find(chunk)?;
        // SAFETY: nobody writes the header, as the caller promises.
        Some(unsafe { segment.header(index).as_ref() }.sequence_number)
    }

    fn release(&self, chunk: u64) {
        if let Some((segment, index)) = self.find(chunk) {
            segment.release(index);
        }
    }
}

/// The positions of the kept samples, each at the index of its number.
pub(crate) struct History {
    kept: Box<[AtomicU64]>,
}

impl History {
    pub(crate) fn new(depth: usize) -> Self {
        History { kept: (0..depth.max(1)).map(|_| AtomicU64::new(NONE)).collect() }
    }

    fn place(&self, number: u64) -> Option<&AtomicU64> {
        self.kept.get((number % self.kept.len() as u64) as usize)
    }

    /// The number of the first sample that is kept when `published` was published last.
    pub(crate) fn first_kept(&self, published: u64) -> u64 {
        (published + 1).saturating_sub(self.kept.len() as u64).max(1)
    }

    /// Keeps a sample, which has a reference for this; returns the one that it replaces. For the thread that publishes.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn keep(&self, number: u64, chunk: u64) -> Option<u64> {
        // Release: pairs with the Acquire in `each_kept`; the sample is written.
        let before = self.place(number)?.swap(chunk, Ordering::AcqRel);
        (before != NONE).then_some(before)
    }

    /// The offset of the kept sample with this number. For the thread that publishes.
    pub(crate) fn kept(&self, number: u64) -> Option<u64> {
        self.place(number).map(|place| place.load(Ordering::Relaxed)).filter(|chunk| *chunk != NONE)
    }

    /// Calls `each` with the newest `depth` kept samples after number `after`, in their order, and gives it one reference to each.
    ///
    /// # Real-time
    /// O(depth), whatever the publisher does.
    pub(crate) fn each_kept(
        &self,
        after: u64,
        published: u64,
        depth: u64,
        samples: &impl Samples,
        mut each: impl FnMut(u64, u64),
    ) {
        let first = self.first_kept(published).max((published + 1).saturating_sub(depth)).max(after + 1);
        for number in first..=published {
            let Some(place) = self.place(number) else { return };
            let chunk = place.load(Ordering::Acquire);
            if chunk == NONE || !samples.pin(chunk) {
                continue;
            }
            // Still kept, so it is written, and is not written again before its last reference is released; this function has one.
            // SAFETY: pinned before, and kept now.
            let is_it =
                place.load(Ordering::Acquire) == chunk && unsafe { samples.number(chunk) } == Some(number);
            if is_it {
                each(number, chunk);
            } else {
                samples.release(chunk);
            }
        }
    }

    /// Releases the kept samples, when no thread publishes any more.
    pub(crate) fn release(&self, samples: &impl Samples) {
        for place in &self.kept {
            let chunk = place.swap(NONE, Ordering::AcqRel);
            if chunk != NONE {
                samples.release(chunk);
            }
        }
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use crate::memory::references::References;
    use crate::sync::AtomicU32;
    use loom::cell::UnsafeCell;
    use loom::sync::Arc;

    /// A sample with the header's number alone, which loom watches: to read it while it is written is an error.
    struct ModelSample {
        references: References,
        /// In place of the pool's list of free samples, which orders what is given back before it is taken again.
        is_free: AtomicU32,
        number: UnsafeCell<u64>,
    }

    /// A publisher that keeps one sample. Its samples: one that is kept, one that is pinned, one that is loaned.
    struct Model {
        samples: [ModelSample; 3],
        history: History,
    }

    // SAFETY: for the model; loom checks the accesses.
    unsafe impl Sync for Model {}
    // SAFETY: as above.
    unsafe impl Send for Model {}

    impl Samples for Model {
        fn pin(&self, chunk: u64) -> bool {
            self.samples[chunk as usize].references.pin()
        }

        unsafe fn number(&self, chunk: u64) -> Option<u64> {
            // SAFETY: loom checks it.
            Some(self.samples[chunk as usize].number.with(|number| unsafe { *number }))
        }

        fn release(&self, chunk: u64) {
            let sample = &self.samples[chunk as usize];
            if sample.references.release() {
                sample.is_free.store(1, Ordering::Release);
            }
        }
    }

    impl Model {
        fn new() -> Arc<Self> {
            let samples = [(); 3].map(|()| ModelSample {
                references: References::none(),
                is_free: AtomicU32::new(1),
                number: UnsafeCell::new(0),
            });
            let model = Model { samples, history: History::new(1) };
            model.publish(1);
            Arc::new(model)
        }

        /// As `Segment::take` and `RawPublisher::publish_loan` do it.
        fn publish(&self, number: u64) {
            let take = |sample: &&ModelSample| {
                sample.is_free.compare_exchange(1, 0, Ordering::Acquire, Ordering::Relaxed).is_ok()
            };
            let sample = self.samples.iter().find(take).expect("a sample is free");
            sample.references.begin();
            // SAFETY: loom checks it.
            sample.number.with_mut(|place| unsafe { *place = number });
            sample.references.add();
            let chunk = self.samples.iter().position(|other| std::ptr::eq(other, sample)).unwrap() as u64;
            if let Some(former) = self.history.keep(number, chunk) {
                self.release(former);
            }
            self.release(chunk);
        }
    }

    #[test]
    fn loom_a_kept_sample_is_taken_over_whole_or_not_at_all() {
        loom::model(|| {
            let model = Model::new();
            let publisher = {
                let model = model.clone();
                // The second gives the first sample back, the third takes it again.
                loom::thread::spawn(move || [2, 3].into_iter().for_each(|number| model.publish(number)))
            };
            let mut found = None;
            model.history.each_kept(0, 1, 1, &*model, |number, chunk| found = Some((number, chunk)));
            if let Some((number, chunk)) = found {
                // SAFETY: loom checks it.
                assert_eq!((number, unsafe { model.number(chunk) }), (1, Some(1)));
                model.release(chunk);
            }
            publisher.join().unwrap();
            model.history.release(&*model);
            assert!(
                model.samples.iter().all(|sample| sample.references.is_none()),
                "every reference is given back"
            );
        });
    }
}
