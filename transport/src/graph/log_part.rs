// SPDX-License-Identifier: MIT OR Apache-2.0
//! The part of a participant's file that holds its record: one process writes it, others copy out of it at any time.
//!
//! A record moves to another part when it is written anew, and its former part may later hold it again. So a copy counts only if the head
//! of the file still names this part afterwards, and the part still has the same turn (a seqlock whose number is both).

use crate::sync::{AtomicU64, Ordering, fence};
use tautline_rt::shm::Mapping;

/// The words before the entries.
pub(super) const PREFACE_BYTES: usize = 16;

#[derive(Clone, Copy)]
pub(super) struct Part<'p> {
    /// How many bytes of entries are valid.
    pub(super) valid: &'p AtomicU64,
    /// How often the record was written anew.
    turn: &'p AtomicU64,
    pub(super) words: &'p [AtomicU64],
}

impl<'p> Part<'p> {
    /// A part is not shorter than a page.
    pub(super) fn of(map: &'p Mapping) -> Self {
        let len = map.len_bytes() / 8;
        // SAFETY: all of a mapping, at the start of a page; any bytes are atomics.
        let words = unsafe { std::slice::from_raw_parts(map.start().cast::<AtomicU64>().as_ptr(), len) };
        Part { valid: &words[0], turn: &words[1], words: &words[PREFACE_BYTES / 8..] }
    }

    /// The turn of the record that lies in this part, or soon will.
    pub(super) fn turn(self) -> u64 {
        // Acquire: pairs with the Release in `publish`; what is copied after this is not of a former turn.
        self.turn.load(Ordering::Acquire)
    }

    /// Appends an entry after `used` bytes; returns how many bytes are used then. For the owner.
    pub(super) fn append(self, used: usize, entry: &[u8]) -> usize {
        let used = self.write(used, entry);
        // Release: pairs with the Acquire in `valid`; what is valid has been written.
        self.valid.store(used as u64, Ordering::Release);
        used
    }

    /// Fills a part that the record does not lie in, and moves the record there; returns how many bytes are used. For the owner.
    pub(super) fn publish<'e>(
        self,
        record: &AtomicU64,
        place: u64,
        turn: u64,
        entries: impl Iterator<Item = &'e [u8]>,
    ) -> usize {
        let used = entries.fold(0, |used, entry| self.write(used, entry));
        self.valid.store(used as u64, Ordering::Relaxed);
        // Release: pairs with the Acquire in `turn`; a reader that sees this turn sees no entry of a former one.
        self.turn.store(turn, Ordering::Release);
        // Release: pairs with the Acquires of readers; the part is whole, and its turn is this one.
        record.store(place, Ordering::Release);
        // Later writes into the former part come after this store: pairs with the fence in `read`.
        fence(Ordering::SeqCst);
        used
    }

    fn write(self, at: usize, bytes: &[u8]) -> usize {
        for (word, bytes) in self.words[at / 8..].iter().zip(bytes.chunks_exact(8)) {
            word.store(u64::from_ne_bytes(bytes.try_into().unwrap_or_default()), Ordering::Relaxed);
        }
        at + bytes.len()
    }

    /// The result of `copy`, if the record lay in this part, at this place and turn, until the copy was complete; otherwise `None`.
    pub(super) fn read<T>(
        self,
        record: &AtomicU64,
        (place, turn): (u64, u64),
        copy: impl FnOnce(Self) -> T,
    ) -> Option<T> {
        let copied = copy(self);
        // A reader that has copied bytes written after the record had moved sees below that it has moved.
        fence(Ordering::Acquire);
        // Acquire: pairs with the Release in `publish`. If the record has come back to this place, its turn is seen, too.
        let is_there = record.load(Ordering::Acquire) == place && self.turn() == turn;
        is_there.then_some(copied)
    }

    /// A copy of the valid bytes from a position on. `None`: the part is damaged.
    pub(super) fn copy_from(self, position: usize) -> Option<Vec<u8>> {
        let valid = self.valid()?;
        self.copy(position, valid)
    }

    /// A copy of the entry at a position, of the length that it states. `None`: the part is damaged.
    pub(super) fn copy_entry(self, position: usize) -> Option<Vec<u8>> {
        let valid = self.valid()?;
        let len = self.words.get(position / 8)?.load(Ordering::Relaxed) as u32 as usize;
        self.copy(position, position.checked_add(len)?.min(valid))
    }

    fn valid(self) -> Option<usize> {
        let valid = usize::try_from(self.valid.load(Ordering::Acquire)).ok()?;
        (valid.is_multiple_of(8) && valid <= self.words.len() * 8).then_some(valid)
    }

    fn copy(self, from: usize, to: usize) -> Option<Vec<u8>> {
        let words = self.words.get(from / 8..to / 8)?;
        Some(words.iter().flat_map(|word| word.load(Ordering::Relaxed).to_ne_bytes()).collect())
    }
}

#[cfg(all(test, taut_loom))]
mod loom_tests {
    use super::*;
    use loom::sync::Arc;

    /// Two parts between which the record moves, of two entries of a word at most, and the head's word.
    struct Model {
        record: AtomicU64,
        parts: [[AtomicU64; 4]; 2],
    }

    impl Model {
        fn part(&self, place: u64) -> Part<'_> {
            let words = &self.parts[place as usize - 1];
            Part { valid: &words[0], turn: &words[1], words: &words[2..] }
        }

        fn publish(&self, turn: u64) -> usize {
            let (place, entry) = (2 - turn % 2, turn.to_ne_bytes());
            self.part(place).publish(&self.record, place, turn, std::iter::once(&entry[..]))
        }
    }

    #[test]
    fn loom_a_copy_of_a_record_is_of_one_turn() {
        loom::model(|| {
            let model = Arc::new(Model {
                record: AtomicU64::new(0),
                parts: [(); 2].map(|()| [(); 4].map(|()| AtomicU64::new(0))),
            });
            model.publish(1);
            let owner = {
                let model = model.clone();
                // The third turn is written where the first one was.
                loom::thread::spawn(move || {
                    model.publish(2);
                    let used = model.publish(3);
                    model.part(1).append(used, &3_u64.to_ne_bytes());
                })
            };
            let place = model.record.load(Ordering::Acquire);
            let part = model.part(place);
            let turn = part.turn();
            if let Some(copied) = part.read(&model.record, (place, turn), |part| part.copy_from(0)) {
                let copied = copied.expect("it is not damaged");
                assert!(copied.len() == 8 || turn == 3 && copied.len() == 16, "{turn}: {copied:?}");
                assert!(copied.chunks(8).all(|entry| entry == turn.to_ne_bytes()), "{turn}: {copied:?}");
            }
            owner.join().unwrap();
        });
    }
}
