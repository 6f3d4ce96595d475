// SPDX-License-Identifier: MIT OR Apache-2.0
//! The free list of slots, or of thread bells. Any thread can claim and release an entry without a lock, because a request
//! with a time-out claims a slot in a callback.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use crate::sync::{AtomicU64, Ordering};

/// Entries are claimed in turn: each rests as long as possible before it is used again, so that a publisher that has not yet noticed
/// the end of a subscription does not ring its successor (harmless, but a spurious wake-up).
pub(super) struct FreePlaces {
    /// One bit for each free entry.
    free: Box<[AtomicU64]>,
    /// Where the next search begins.
    next: AtomicU64,
}

impl FreePlaces {
    pub(super) fn new(places: usize) -> Self {
        let all = |word: usize| match places - word * 64 {
            64.. => u64::MAX,
            fewer => (1u64 << fewer) - 1,
        };
        let free = (0..places.div_ceil(64)).map(|word| AtomicU64::new(all(word))).collect();
        FreePlaces { free, next: AtomicU64::new(0) }
    }

    /// Claims a place. `None`: none is free, or other threads have just claimed those that were.
    ///
    /// # Real-time
    /// Wait-free, O(places); no allocation; no syscall.
    pub(super) fn take(&self) -> Option<usize> {
        let next = self.next.load(Ordering::Relaxed) as usize;
        let (start, from_next) = (next / 64, u64::MAX << (next % 64));
        // The word in which the search begins is visited twice: first from the bit `next` on, at last up to it.
        for turn in 0..=self.free.len() {
            let index = (start + turn) % self.free.len();
            let wanted = match turn {
                0 => from_next,
                _ if turn == self.free.len() => !from_next,
                _ => u64::MAX,
            };
            let word = self.free.get(index)?;
            let mut bits = word.load(Ordering::Relaxed) & wanted;
            while bits != 0 {
                let bit = bits & bits.wrapping_neg();
                // Acquire: pairs with the Release in `give_back`; the former owner does not use the place any more.
                let free = word.fetch_and(!bit, Ordering::Acquire);
                if free & bit != 0 {
                    let place = index * 64 + bit.trailing_zeros() as usize;
                    self.next.store(((place + 1) % (64 * self.free.len())) as u64, Ordering::Relaxed);
                    return Some(place);
                }
                // Another thread was faster. Only bits that were free at the first load are tried: at most 64 turns.
                bits &= free;
            }
        }
        None
    }

    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(super) fn give_back(&self, place: usize) {
        if let Some(word) = self.free.get(place / 64) {
            word.fetch_or(1 << (place % 64), Ordering::Release);
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn each_is_claimed_once_and_rests_before_it_is_claimed_again() {
        let places = FreePlaces::new(70);
        assert_eq!([0; 3].map(|_| places.take()), [0, 1, 2].map(Some));
        places.give_back(1);
        places.give_back(0);
        let rest: Vec<_> = std::iter::from_fn(|| places.take()).collect();
        assert_eq!(rest, (3..70).chain([0, 1]).collect::<Vec<_>>(), "those that were used are the last");
        places.give_back(68);
        assert_eq!((places.take(), places.take()), (Some(68), None));
    }

    #[test]
    fn from_several_threads() {
        const THREADS: usize = 4;
        let places = FreePlaces::new(THREADS * 64);
        let taken = std::thread::scope(|scope| {
            let take = || (0..64).map(|_| places.take().expect("there is one")).collect::<Vec<_>>();
            let threads = [(); THREADS].map(|()| scope.spawn(take));
            threads.map(|thread| thread.join().expect("it ends well"))
        });
        let mut taken = taken.concat();
        taken.sort();
        assert_eq!(taken, (0..THREADS * 64).collect::<Vec<_>>());
    }
}
