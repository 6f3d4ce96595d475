// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ring of one thread: one writer that never waits, one reader that may come late.
//!
//! The writer overwrites the oldest event when the ring is full. The reader detects what it missed:
//!
//! ```text
//! writer, event number n                 reader, from number `drained`
//!  1 begun = n + 1                        1 committed, with acquire
//!  2 fence                                2 copies the words of what is left of drained..committed
//!  3 the words, at n modulo capacity      3 fence
//!  4 committed = n + 1, with release      4 begun: numbers below begun - capacity may have been torn: lost
//! ```
//!
//! A reader that copied a word of event `n + capacity` sees, through the two fences, a `begun` above `n + capacity`, and
//! throws its copy of event `n` away. Numbers never restart, even if another thread gets the ring.

use crate::event::WORDS;
use crate::sync::{AtomicU32, AtomicU64, Ordering, fence};

/// The words beside the events. Two cache lines: the writer's, and those that others write.
#[repr(C, align(128))]
pub(crate) struct RingHead {
    begun: AtomicU64,
    pub(crate) committed: AtomicU64,
    /// The kernel's id of the thread that writes here; zero: no thread.
    pub(crate) tid: AtomicU32,
    /// Whether the events have memory, which they keep.
    pub(crate) ready: AtomicU32,
    pub(crate) name: [AtomicU64; 2],
    _line: [AtomicU64; 3],
    /// The number up to which a recorder has fetched all events.
    pub(crate) drained: AtomicU64,
}

/// A ring's head and its events: `WORDS` words for each, a power of two of them.
#[derive(Clone, Copy)]
pub(crate) struct Ring<'m> {
    pub(crate) head: &'m RingHead,
    events: &'m [AtomicU64],
}

/// The result of reading a ring.
#[derive(Debug, PartialEq, Eq, Default)]
pub(crate) struct Drained {
    /// The number of the event from which to continue.
    pub(crate) next: u64,
    /// Events that were overwritten before they were read.
    pub(crate) lost: u64,
}

impl<'m> Ring<'m> {
    /// # Panics
    /// If the words are not a power of two of events.
    pub(crate) fn new(head: &'m RingHead, events: &'m [AtomicU64]) -> Ring<'m> {
        assert!(events.len().is_multiple_of(WORDS) && (events.len() / WORDS).is_power_of_two());
        Ring { head, events }
    }

    pub(crate) fn capacity(&self) -> u64 {
        (self.events.len() / WORDS) as u64
    }

    fn at(&self, number: u64) -> &'m [AtomicU64] {
        let first = (number & (self.capacity() - 1)) as usize * WORDS;
        self.events.get(first..first + WORDS).unwrap_or_default()
    }

    /// Touches every page of the events, so that writing to them costs no page fault.
    pub(crate) fn touch(&self) {
        for word in self.events.iter().step_by(512) {
            word.store(0, Ordering::Relaxed);
        }
    }

    /// Appends an event. Only the thread that owns the ring may do so.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn push(&self, words: [u64; WORDS]) {
        // Between two pushes `begun` and `committed` are equal. `begun` is loaded because loom then finds every race.
        let number = self.head.begun.load(Ordering::Relaxed);
        self.head.begun.store(number.wrapping_add(1), Ordering::Relaxed);
        // Pairs with the fence in `drain`: a reader that gets a word from below gets this `begun`, too.
        fence(Ordering::Release);
        for (slot, word) in self.at(number).iter().zip(words) {
            slot.store(word, Ordering::Relaxed);
        }
        // Release: pairs with the Acquire in `drain`.
        self.head.committed.store(number.wrapping_add(1), Ordering::Release);
    }

    /// Copies the events from number `from` on to the end of `copy`. The head is written by another process: if it is wrong, the
    /// result is wrong, and nothing worse happens.
    pub(crate) fn drain(&self, from: u64, copy: &mut Vec<[u64; WORDS]>) -> Drained {
        let committed = self.head.committed.load(Ordering::Acquire);
        if committed < from {
            return Drained { next: committed, lost: 0 };
        }
        let first = from.max(committed.saturating_sub(self.capacity()));
        let start = copy.len();
        for number in first..committed {
            let mut words = [0; WORDS];
            for (word, slot) in words.iter_mut().zip(self.at(number)) {
                *word = slot.load(Ordering::Relaxed);
            }
            copy.push(words);
        }
        fence(Ordering::Acquire);
        let begun = self.head.begun.load(Ordering::Relaxed);
        let whole = begun.saturating_sub(self.capacity()).clamp(first, committed);
        copy.drain(start..start + (whole - first) as usize);
        Drained { next: committed, lost: whole - from }
    }

    /// Whether the ring has memory and no owner.
    pub(crate) fn is_spare(&self) -> bool {
        // Acquire: pairs with the Release of the thread that gave the ring memory.
        self.head.ready.load(Ordering::Acquire) != 0 && self.head.tid.load(Ordering::Relaxed) == 0
    }

    /// Gives the ring to the thread `tid`, if it has memory and no owner. Returns whether it did.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    pub(crate) fn claim(&self, tid: u32) -> bool {
        // AcqRel: pairs with the Release of the thread that gives a ring back.
        self.is_spare() && self.head.tid.compare_exchange(0, tid, Ordering::AcqRel, Ordering::Relaxed).is_ok()
    }

    /// Whether a recorder has fetched all events.
    pub(crate) fn is_drained(&self) -> bool {
        self.head.drained.load(Ordering::Relaxed) == self.head.committed.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
impl RingHead {
    pub(crate) fn new() -> RingHead {
        RingHead {
            begun: AtomicU64::new(0),
            committed: AtomicU64::new(0),
            tid: AtomicU32::new(0),
            ready: AtomicU32::new(0),
            name: [AtomicU64::new(0), AtomicU64::new(0)],
            _line: [AtomicU64::new(0), AtomicU64::new(0), AtomicU64::new(0)],
            drained: AtomicU64::new(0),
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    fn events(capacity: usize) -> Vec<AtomicU64> {
        (0..capacity * WORDS).map(|_| AtomicU64::new(0)).collect()
    }

    #[test]
    fn a_late_reader_counts_what_it_missed() {
        let (head, events) = (RingHead::new(), events(8));
        let ring = Ring::new(&head, &events);
        let mut copy = Vec::new();
        assert_eq!(ring.drain(0, &mut copy), Drained { next: 0, lost: 0 });
        for n in 0..5 {
            ring.push([n; WORDS]);
        }
        assert_eq!(ring.drain(0, &mut copy), Drained { next: 5, lost: 0 });
        assert_eq!(copy, [0, 1, 2, 3, 4].map(|n| [n; WORDS]));
        for n in 5..25 {
            ring.push([n; WORDS]);
        }
        copy.clear();
        // 17..25 are there. None is being overwritten now.
        assert_eq!(ring.drain(5, &mut copy), Drained { next: 25, lost: 12 });
        assert_eq!(copy, [17, 18, 19, 20, 21, 22, 23, 24].map(|n| [n; WORDS]));
    }

    #[test]
    fn a_head_full_of_lies_gives_wrong_numbers_and_nothing_worse() {
        for begun in [0, 3, u64::MAX] {
            for committed in [0, 7, 8, 1 << 40, u64::MAX] {
                for from in [0, 5, u64::MAX] {
                    let (head, events) = (RingHead::new(), events(8));
                    head.begun.store(begun, Ordering::Relaxed);
                    head.committed.store(committed, Ordering::Relaxed);
                    let (ring, mut copy) = (Ring::new(&head, &events), Vec::new());
                    let drained = ring.drain(from, &mut copy);
                    assert!(copy.len() <= 8 && drained.next == committed, "{begun} {committed} {from}");
                    ring.push([1; WORDS]);
                }
            }
        }
    }

    #[test]
    fn a_reader_beside_a_fast_writer_sees_no_torn_event() {
        // As many as miri does in a moment.
        let total = if cfg!(miri) { 200 } else { 300_000 };
        let (head, events) = (RingHead::new(), events(16));
        let ring = Ring::new(&head, &events);
        std::thread::scope(|scope| {
            scope.spawn(move || (0..total).for_each(|n| ring.push([n; WORDS])));
            let (mut next, mut lost, mut copy) = (0, 0, Vec::new());
            while next < total {
                let start = copy.len();
                let drained = ring.drain(next, &mut copy);
                lost += drained.lost;
                next = drained.next;
                assert!(copy[start..].iter().all(|words| words.iter().all(|word| *word == words[0])));
            }
            assert_eq!(copy.len() as u64 + lost, total);
            assert!(copy.windows(2).all(|pair| pair[0][0] < pair[1][0]));
        });
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    //! Every interleaving of a writer that laps its ring and a reader. Run by `cargo xtask test`.
    use super::*;
    use loom::sync::Arc;

    #[test]
    fn loom_no_event_is_torn_and_none_is_lost_uncounted() {
        let mut builder = loom::model::Builder::new();
        builder.preemption_bound = Some(3);
        builder.check(|| {
            const TOTAL: u64 = 3;
            let memory =
                Arc::new((RingHead::new(), (0..2 * WORDS).map(|_| AtomicU64::new(0)).collect::<Vec<_>>()));
            let writer = {
                let memory = memory.clone();
                loom::thread::spawn(move || {
                    let ring = Ring::new(&memory.0, &memory.1);
                    (1..=TOTAL).for_each(|n| ring.push([n; WORDS]));
                })
            };
            let ring = Ring::new(&memory.0, &memory.1);
            let mut copy = Vec::new();
            // Beside the writer, and once more when nothing is left uncounted.
            let first = ring.drain(0, &mut copy);
            writer.join().unwrap();
            let last = ring.drain(first.next, &mut copy);
            let (next, lost) = (last.next, first.lost + last.lost);
            assert_eq!((next, copy.len() as u64 + lost), (TOTAL, TOTAL));
            for words in &copy {
                assert!(words.iter().all(|word| *word == words[0]), "torn: {copy:?}");
            }
            assert!(copy.windows(2).all(|pair| pair[0][0] < pair[1][0]));
        });
    }
}
