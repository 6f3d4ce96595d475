// SPDX-License-Identifier: MIT OR Apache-2.0
//! The words of all timers, and the room for them in the sampler's queue: both grow in the thread that creates a
//! timer.

use rtrb::{Consumer, Producer, RingBuffer};
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use tautline_doorbell::{Activity, WINDOWS, first_slot, place, window_slots};

/// Timers by their next release, each with its slot.
pub(crate) type Due = BinaryHeap<Reverse<(u64, usize)>>;

/// The words that a timer and the sampler share, for each slot.
#[derive(Default)]
pub(crate) struct TimerWords {
    /// Whether the timer was armed or dropped, so that the sampler has to update its queue.
    pub(crate) changed: AtomicBool,
    /// Zero: there is no timer here.
    pub(crate) period_ns: AtomicU64,
    pub(crate) first_release_ns: AtomicU64,
    /// Counts the timers that were armed here.
    pub(crate) armed: AtomicU64,
    /// The number of the armed timer that `released` counts for; written by the sampler.
    pub(crate) accepted: AtomicU64,
    /// As `released`, but counted before `last_due_ns` is written; written by the sampler.
    pub(crate) begun: AtomicU64,
    /// Releases so far; written by the sampler.
    pub(crate) released: AtomicU64,
    /// The activity that a watchdog monitors, as a word: each release is one period after the last activity. 0 for a timer.
    pub(crate) activity: AtomicU64,
    /// When the last release of a watchdog was due; written by the sampler.
    pub(crate) last_due_ns: AtomicU64,
}

impl TimerWords {
    /// Arms the slot, and returns the number of the armed timer. The caller rings the slot.
    pub(crate) fn arm(&self, first_release_ns: u64, period_ns: u64, activity: Option<Activity>) -> u64 {
        self.first_release_ns.store(first_release_ns, Ordering::Relaxed);
        let number = self.armed.fetch_add(1, Ordering::Relaxed) + 1;
        self.activity.store(activity.map_or(0, Activity::to_word), Ordering::Relaxed);
        // Release, both: each pairs with an Acquire in the sampler, which then reads the words above, even if it was woken by the ring of
        // the slot's former timer.
        self.period_ns.store(period_ns, Ordering::Release);
        self.changed.store(true, Ordering::Release);
        number
    }

    /// Ends the releases. The caller rings the slot.
    pub(crate) fn disarm(&self) {
        self.period_ns.store(0, Ordering::Relaxed);
        self.changed.store(true, Ordering::Release);
    }

    /// Returns the number of releases of the timer that was armed as `number`, if it is greater than `seen`.
    ///
    /// A number below `seen` is no release: if a slot is reused at once, the sampler may accept its timer twice, once for the ring of the
    /// former timer. The second time it counts from 0 again, and reaches the same numbers.
    pub(crate) fn released_since(&self, number: u64, seen: u64) -> Option<u64> {
        // Acquire: each pairs with the sampler's Release.
        if self.accepted.load(Ordering::Acquire) != number {
            return None; // the count is a former timer's
        }
        let released = self.released.load(Ordering::Acquire);
        (released > seen).then_some(released)
    }
}

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
        // At most one queue for each window.
        let (to_sampler, larger) = RingBuffer::new(WINDOWS);
        let (emptied, from_sampler) = RingBuffer::new(WINDOWS);
        let spare_sender = Mutex::new(SpareQueuesSender { larger: to_sampler, emptied: from_sampler });
        let timers = Timers { windows: Default::default(), spare_sender };
        timers.cover(0);
        (timers, SpareQueues { larger, emptied })
    }

    /// Allocates the words of the slot's window, if there are none, so that a timer can be armed at `slot`.
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
        // The queue comes before the words, so that an armed timer finds room in it.
        let _ = spare_sender.larger.push(queue_for(first_slot(window) + window_slots(window)));
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

/// An empty queue with room for this many timers. The room has been touched: the sampler's first use of a page would be a page fault.
fn queue_for(timers: usize) -> Due {
    let mut room = vec![Reverse((u64::MAX, usize::MAX)); timers];
    room.clear();
    room.into()
}

impl SpareQueues {
    /// Moves the timers into a larger queue if there is one: O(timers), once for each time that slots have doubled.
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
            // The thread that adds the next window frees it. There is a place for each queue.
            if let Err(rtrb::PushError::Full(kept)) = self.emptied.push(larger) {
                std::mem::forget(kept);
            }
        }
    }
}

/// The timers by their next release. It has room for as many as there are slots where one may be armed, so pushing never allocates.
pub(crate) struct TimerQueue {
    pub(crate) due: Due,
    pub(crate) spares: SpareQueues,
}

impl TimerQueue {
    pub(crate) fn new(mut spares: SpareQueues) -> Self {
        let mut due = Due::new();
        spares.move_to_larger(&mut due);
        TimerQueue { due, spares }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_doorbell::NEAR_SLOTS;
    use tautline_rt::page_faults;

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

    #[test]
    fn the_room_has_been_touched() {
        let (timers, mut spares) = Timers::new();
        // Half a megabyte, which no allocator has left from before.
        timers.cover(first_slot(5));
        let mut due = Due::new();
        spares.move_to_larger(&mut due);
        // The code has to be in memory, too.
        due.push(Reverse((0, 0)));
        let before = page_faults().minor;
        (1..due.capacity()).for_each(|n| due.push(Reverse((n as u64, n))));
        let faults = page_faults().minor - before;
        assert!(faults < 10, "{faults} for {} timers", due.len());
    }
}
