// SPDX-License-Identifier: MIT OR Apache-2.0
//! The words of all timers, and the room for them in the sampler's queue: both grow in the thread that creates a
//! timer.

use crate::timer::TimerWords;
use rtrb::{Consumer, Producer, RingBuffer};
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::{Mutex, OnceLock, PoisonError};
use tautline_doorbell::{WINDOWS, first_slot, place, window_slots};

/// Timers by their next release, each with its slot.
pub(crate) type Due = BinaryHeap<Reverse<(u64, usize)>>;

/// The words of the timers, by slot: a window of them exists once a timer was made at one of its slots.
pub(crate) struct Timers {
    windows: [OnceLock<Box<[TimerWords]>>; WINDOWS],
    spare_sender: Mutex<SpareQueuesSender>,
}

/// Gives the sampler larger queues, allocated by the thread that makes a timer, and frees those that it left.
struct SpareQueuesSender {
    larger: Producer<Due>,
    emptied: Consumer<Due>,
}

/// Where the sampler finds larger queues and leaves the smaller ones.
pub(crate) struct SpareQueues {
    pub(crate) larger: Consumer<Due>,
    pub(crate) emptied: Producer<Due>,
}

impl Timers {
    pub(crate) fn new() -> (Self, SpareQueues) {
        // A queue for each window at most.
        let (to_sampler, larger) = RingBuffer::new(WINDOWS);
        let (emptied, from_sampler) = RingBuffer::new(WINDOWS);
        let spare_sender = Mutex::new(SpareQueuesSender { larger: to_sampler, emptied: from_sampler });
        let timers = Timers { windows: Default::default(), spare_sender };
        timers.cover(0);
        (timers, SpareQueues { larger, emptied })
    }

    /// A timer may be armed at `slot` from now on. Allocates if none could before in its window.
    pub(crate) fn cover(&self, slot: usize) {
        let (window, _) = place(slot);
        if self.windows.get(window).is_some_and(|words| words.get().is_none()) {
            self.add_window(window);
        }
    }

    #[cold]
    fn add_window(&self, window: usize) {
        let mut spare_sender = self.spare_sender.lock().unwrap_or_else(PoisonError::into_inner);
        while spare_sender.emptied.pop().is_ok() {}
        let Some(words) = self.windows.get(window).filter(|words| words.get().is_none()) else { return };
        // Before the words: a timer that is armed finds room in the queue.
        let slots = first_slot(window) + window_slots(window);
        let _ = spare_sender.larger.push(BinaryHeap::with_capacity(slots));
        let _ = words.set((0..window_slots(window)).map(|_| TimerWords::default()).collect());
    }

    /// # Real-time
    /// Wait-free.
    pub(crate) fn get(&self, slot: usize) -> Option<&TimerWords> {
        let (window, index) = place(slot);
        self.windows.get(window)?.get()?.get(index)
    }

    /// # Panics
    /// If no timer was ever made at `slot`.
    pub(crate) fn at(&self, slot: usize) -> &TimerWords {
        self.get(slot).expect("who has a timer's slot has covered it")
    }
}

impl SpareQueues {
    /// Moves what is due into a larger queue if there is one: O(timers), once for each time that slots have doubled.
    ///
    /// # Real-time
    /// Wait-free; no allocation.
    pub(crate) fn move_to_larger(&mut self, due: &mut Due) {
        while let Ok(mut larger) = self.larger.pop() {
            if larger.capacity() >= due.capacity() {
                // Not `append`, which keeps the longer one's memory.
                larger.extend(due.drain());
                std::mem::swap(due, &mut larger);
            }
            // Whoever makes the next timer drops it. There is a place for each.
            if let Err(rtrb::PushError::Full(kept)) = self.emptied.push(larger) {
                std::mem::forget(kept);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_doorbell::NEAR_SLOTS;

    #[test]
    fn what_is_due_moves_into_more_room() {
        let (timers, mut spares) = Timers::new();
        let mut due = Due::new();
        spares.move_to_larger(&mut due);
        assert!(due.capacity() >= NEAR_SLOTS);
        let all: Vec<_> = (0..100).map(|n| Reverse((1000 - n, n as usize))).collect();
        due.extend(all.iter().copied());
        let far = first_slot(2);
        timers.cover(far);
        spares.move_to_larger(&mut due);
        assert!(due.capacity() >= far + window_slots(2));
        assert_eq!(due.into_sorted_vec(), all);
    }
}
