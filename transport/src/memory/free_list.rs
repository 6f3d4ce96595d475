// SPDX-License-Identifier: MIT OR Apache-2.0
//! Which samples of a publisher are free, and the order in which they are used again.
//!
//! A cache line that the core which read it still holds must be fetched from that core's cache when it is written again. So a
//! sample waits until others have been freed after it; by then its lines are fetched from a cache that both cores share.
#![deny(clippy::disallowed_methods, clippy::disallowed_types, clippy::disallowed_macros)]
#![deny(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing)]

use core::sync::atomic::{AtomicU32, AtomicUsize, Ordering};

/// The free samples of a size, as words that the list's owner assigns. Only one thread uses the list. Its fields are atomics, which this
/// thread uses like plain values, so that a table that is handed over to the thread can contain the list.
///
/// The samples that were freed last wait in the order in which they were freed. A longer stack has the others: of these, the one that
/// was added last is used first. So no more samples are used in turn than those that wait and those in use.
pub(crate) struct FreeList {
    /// Without places if one sample is used in turn: the stack of the others has that order.
    waiting: Box<[AtomicU32]>,
    /// The place of the sample that has waited longest. The next field counts the samples that wait.
    first: AtomicUsize,
    waiting_len: AtomicUsize,
    others: Box<[AtomicU32]>,
    others_len: AtomicUsize,
}

impl FreeList {
    /// An empty list for `samples` samples, of which `in_turn` are used in turn.
    #[allow(clippy::disallowed_methods, reason = "set-up")]
    pub(crate) fn new(samples: usize, in_turn: usize) -> Self {
        let places = |count: usize| (0..count).map(|_| AtomicU32::new(0)).collect();
        FreeList {
            waiting: places(if in_turn > 1 { in_turn.min(samples) } else { 0 }),
            first: AtomicUsize::new(0),
            waiting_len: AtomicUsize::new(0),
            others: places(samples),
            others_len: AtomicUsize::new(0),
        }
    }

    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn take(&self) -> Option<u32> {
        if let Some(last) = self.last_of_others() {
            self.others_len.store(last, Ordering::Relaxed);
            return Some(self.others.get(last)?.load(Ordering::Relaxed));
        }
        self.take_waiting(self.waiting_len.load(Ordering::Relaxed))
    }

    /// The sample that is taken next, if none is freed before.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn next(&self) -> Option<u32> {
        let place = match self.last_of_others() {
            Some(last) => self.others.get(last),
            None if self.is_empty() => None,
            None => self.waiting.get(self.first.load(Ordering::Relaxed)),
        };
        Some(place?.load(Ordering::Relaxed))
    }

    /// The place of the next sample among the others; `None` if the next one is a sample that waits.
    fn last_of_others(&self) -> Option<usize> {
        let waiting = self.waiting_len.load(Ordering::Relaxed);
        let is_others_turn = waiting < self.waiting.len() || self.waiting.is_empty();
        self.others_len.load(Ordering::Relaxed).checked_sub(1).filter(|_| is_others_turn)
    }

    fn take_waiting(&self, waiting: usize) -> Option<u32> {
        self.waiting_len.store(waiting.checked_sub(1)?, Ordering::Relaxed);
        let first = self.first.load(Ordering::Relaxed);
        self.first.store(self.place(first + 1), Ordering::Relaxed);
        Some(self.waiting.get(first)?.load(Ordering::Relaxed))
    }

    /// The place `at` modulo the number of places; `at` is less than twice that number.
    fn place(&self, at: usize) -> usize {
        if at < self.waiting.len() { at } else { at - self.waiting.len() }
    }

    /// Adds a sample that was freed just now.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn give(&self, sample: u32) {
        if self.waiting.is_empty() {
            return self.add(sample);
        }
        if self.waiting_len.load(Ordering::Relaxed) == self.waiting.len()
            && let Some(longest) = self.take_waiting(self.waiting.len())
        {
            self.add(longest);
        }
        let waiting = self.waiting_len.load(Ordering::Relaxed);
        let last = self.place(self.first.load(Ordering::Relaxed) + waiting);
        if let Some(place) = self.waiting.get(last) {
            place.store(sample, Ordering::Relaxed);
            self.waiting_len.store(waiting + 1, Ordering::Relaxed);
        }
    }

    /// Adds a sample to the others, without a wait.
    pub(crate) fn add(&self, sample: u32) {
        let others = self.others_len.load(Ordering::Relaxed);
        if let Some(place) = self.others.get(others) {
            place.store(sample, Ordering::Relaxed);
            self.others_len.store(others + 1, Ordering::Relaxed);
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.waiting_len.load(Ordering::Relaxed) + self.others_len.load(Ordering::Relaxed) == 0
    }
}

#[cfg(all(test, not(taut_loom)))]
#[allow(clippy::disallowed_methods, clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use rand::RngExt;
    use std::collections::{BTreeSet, VecDeque};

    fn list(samples: u32, in_turn: usize) -> FreeList {
        let list = FreeList::new(samples as usize, in_turn);
        (0..samples).rev().for_each(|sample| list.add(sample));
        list
    }

    fn take<const N: usize>(list: &FreeList) -> [u32; N] {
        [(); N].map(|()| list.take().unwrap())
    }

    #[test]
    fn samples_are_used_again_in_the_order_in_which_they_were_freed() {
        let list = list(4, 4);
        assert_eq!((take(&list), list.take()), ([0, 1, 2, 3], None));
        [3, 1, 2].into_iter().for_each(|sample| list.give(sample));
        assert_eq!((take(&list), list.take()), ([3, 1, 2], None));
    }

    #[test]
    fn what_was_freed_last_is_used_first_if_one_is_used_in_turn() {
        let list = list(4, 1);
        assert_eq!(take(&list), [0, 1, 2, 3]);
        [3, 1, 2].into_iter().for_each(|sample| list.give(sample));
        assert_eq!((take(&list), list.take()), ([2, 1, 3], None));
    }

    #[test]
    fn no_more_are_used_in_turn_than_asked_for_and_those_that_are_in_use() {
        for (in_turn, in_use) in [(1, 0), (3, 0), (3, 2), (8, 5)] {
            let (list, mut queue, mut used) = (list(40, in_turn), VecDeque::new(), BTreeSet::new());
            for round in 0..400 {
                let sample = list.take().unwrap();
                queue.push_back(sample);
                if queue.len() > in_use {
                    list.give(queue.pop_front().unwrap());
                }
                if round >= 200 {
                    used.insert(sample);
                }
            }
            assert_eq!(used.len(), in_turn + in_use, "{in_turn} in turn, {in_use} in use");
        }
    }

    #[test]
    fn none_is_lost_and_none_is_taken_twice() {
        let mut random = tautline_seed::random();
        for _ in 0..200 {
            let samples = random.random_range(1..50);
            let list = list(samples, random.random_range(1..60));
            let mut taken = Vec::new();
            for _ in 0..500 {
                if random.random() {
                    let next = list.next();
                    match list.take() {
                        Some(sample) => {
                            assert_eq!(next, Some(sample));
                            taken.push(sample);
                        }
                        None => assert_eq!(taken.len(), samples as usize),
                    }
                } else if !taken.is_empty() {
                    list.give(taken.swap_remove(random.random_range(0..taken.len())));
                }
                assert_eq!(list.is_empty(), taken.len() == samples as usize);
                assert_eq!(taken.iter().collect::<BTreeSet<_>>().len(), taken.len());
            }
            taken.extend(std::iter::from_fn(|| list.take()));
            taken.sort_unstable();
            assert_eq!(taken, (0..samples).collect::<Vec<_>>());
        }
    }
}
