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
use std::sync::atomic::{AtomicU64, Ordering};

/// What is said of a place where nothing is kept.
const NONE: u64 = u64::MAX;

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

    /// Keeps a sample, which has a reference for it; returns the one whose place it takes. For the thread that publishes.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn keep(&self, number: u64, chunk: u64) -> Option<u64> {
        // Release: pairs with the Acquire in `each_kept`; the sample is written.
        let before = self.place(number)?.swap(chunk, Ordering::AcqRel);
        (before != NONE).then_some(before)
    }

    /// Where the sample with this number lies, which is kept. For the thread that publishes.
    pub(crate) fn kept(&self, number: u64) -> Option<u64> {
        self.place(number).map(|place| place.load(Ordering::Relaxed)).filter(|chunk| *chunk != NONE)
    }

    /// Gives `each` the newest `depth` samples that are kept, those after number `after`, in their order, and one reference to each.
    ///
    /// # Real-time
    /// O(depth), whatever the publisher does.
    pub(crate) fn each_kept(
        &self,
        after: u64,
        published: u64,
        depth: u64,
        pool: &Pool,
        mut each: impl FnMut(u64, u64),
    ) {
        let first = self.first_kept(published).max((published + 1).saturating_sub(depth)).max(after + 1);
        for number in first..=published {
            let Some(place) = self.place(number) else { return };
            let chunk = place.load(Ordering::Acquire);
            let Some((segment, index)) = pool.find(chunk).filter(|_| chunk != NONE) else { continue };
            if !segment.pin(index) {
                continue;
            }
            // Still kept, so written, and not to be written again before the last reference goes, of which one is ours.
            // SAFETY: a header that nobody writes.
            let is_it = place.load(Ordering::Acquire) == chunk
                && unsafe { segment.header(index).as_ref() }.sequence_number == number;
            if is_it {
                each(number, chunk);
            } else {
                segment.release(index);
            }
        }
    }

    /// Gives back what is kept, when nobody publishes any more.
    pub(crate) fn release(&self, pool: &Pool) {
        for place in &self.kept {
            let chunk = place.swap(NONE, Ordering::AcqRel);
            if let Some((segment, index)) = pool.find(chunk).filter(|_| chunk != NONE) {
                segment.release(index);
            }
        }
    }
}
