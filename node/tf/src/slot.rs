// SPDX-License-Identifier: MIT OR Apache-2.0
//! One sample in memory that is reused: a sequence lock made of atomics, whose readers never wait.
//!
//! ```text
//! writer, sample number n                reader, for sample number n
//!  1 number = 0, with release             1 number, with acquire: other than n + 1: overwritten
//!  2 fence                                2 copies the words
//!  3 the words                            3 fence
//!  4 number = n + 1, with release         4 number again: other than n + 1: overwritten meanwhile
//! ```
//!
//! A reader that copied a word of a later sample sees, through the two fences, a number that is not n + 1. It does not
//! retry: the wanted sample has been overwritten permanently, because numbers are never reused.

use crate::sync::{AtomicU64, Ordering, fence};
use crate::transform::Transform;

/// Words of a transform. Models keep only the translation's x, which shows a torn sample as well.
const TRANSFORM_WORDS: usize = if cfg!(taut_loom) { 1 } else { 7 };
const WORDS: usize = 4 + TRANSFORM_WORDS;

/// Whether a transform is valid at its stamp, or always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Valid at every time, whatever its stamp: `/tf_static`.
    Static,
    /// Valid at its stamp, and interpolated between stamps: `/tf`.
    Dynamic,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sample {
    pub(crate) number: u64,
    pub(crate) older: Option<u64>,
    pub(crate) stamp_ns: i64,
    /// The newest stamp of the run when this sample was set: its own, unless it came late.
    pub(crate) newest_ns: i64,
    /// Number of the first sample of the run, which ends when the frame is cleared or its kind changes.
    pub(crate) first: u64,
    pub(crate) parent: u32,
    pub(crate) kind: Kind,
    pub(crate) transform: Transform,
}

pub(crate) struct Slot {
    /// Number of the sample + 1; zero: none, or one is being written.
    number: AtomicU64,
    /// Number + 1 of the next older sample of this frame; zero: none. Changes when a late sample is inserted between
    /// them.
    older: AtomicU64,
    words: [AtomicU64; WORDS],
}

impl Slot {
    pub(crate) fn new() -> Slot {
        let word = |_| AtomicU64::new(0);
        Slot { number: word(0), older: word(0), words: std::array::from_fn(word) }
    }

    /// Overwrites the slot's sample. Only the writer may call this.
    pub(crate) fn write(&self, sample: &Sample) {
        // Release: pairs with the Acquires in `while_holding`. A reader that does not find the sample finds a newer one in `newest`.
        self.number.store(0, Ordering::Release);
        // Pairs with the fence in `while_holding`: a reader that reads a word below does not find the old number again.
        fence(Ordering::Release);
        self.older.store(link(sample.older), Ordering::Relaxed);
        for (slot, word) in self.words.iter().zip(words(sample)) {
            slot.store(word, Ordering::Relaxed);
        }
        // Release: pairs with the first Acquire in `while_holding`.
        self.number.store(sample.number + 1, Ordering::Release);
    }

    /// Sets the next older sample of the slot's sample, once the older one is written. Only the writer may call this.
    pub(crate) fn link(&self, older: u64) {
        // Release: pairs with the Acquire in `read`, which then finds the older sample complete.
        self.older.store(link(Some(older)), Ordering::Release);
    }

    /// Sample `number`, if it is still in the slot.
    pub(crate) fn read(&self, number: u64) -> Option<Sample> {
        self.while_holding(number, || {
            // Acquire: pairs with the Release in `link`.
            let older = self.older.load(Ordering::Acquire).checked_sub(1);
            sample(number, older, std::array::from_fn(|word| self.words[word].load(Ordering::Relaxed)))
        })
    }

    /// `newest_ns` of sample `number`, if it is still in the slot.
    pub(crate) fn newest_ns(&self, number: u64) -> Option<i64> {
        self.while_holding(number, || self.words[1].load(Ordering::Relaxed).cast_signed())
    }

    fn while_holding<R>(&self, number: u64, read: impl FnOnce() -> R) -> Option<R> {
        // Acquire: pairs with the Releases in `write`.
        if self.number.load(Ordering::Acquire) != number + 1 {
            return None;
        }
        let read = read();
        fence(Ordering::Acquire);
        (self.number.load(Ordering::Acquire) == number + 1).then_some(read)
    }
}

fn link(older: Option<u64>) -> u64 {
    older.map_or(0, |number| number + 1)
}

fn words(sample: &Sample) -> impl Iterator<Item = u64> {
    let static_bit = u64::from(sample.kind == Kind::Static);
    let meta = [
        sample.stamp_ns.cast_unsigned(),
        sample.newest_ns.cast_unsigned(),
        sample.first,
        u64::from(sample.parent) << 1 | static_bit,
    ];
    let Transform { translation, rotation } = sample.transform;
    meta.into_iter().chain(translation.into_iter().chain(rotation).map(f64::to_bits))
}

fn sample(number: u64, older: Option<u64>, words: [u64; WORDS]) -> Sample {
    let (meta, numbers) = words.split_at(4);
    let mut transform = Transform::IDENTITY;
    let places = transform.translation.iter_mut().chain(&mut transform.rotation);
    places.zip(numbers).for_each(|(place, word)| *place = f64::from_bits(*word));
    Sample {
        number,
        older,
        stamp_ns: meta[0].cast_signed(),
        newest_ns: meta[1].cast_signed(),
        first: meta[2],
        parent: (meta[3] >> 1) as u32,
        kind: if meta[3] & 1 == 0 { Kind::Dynamic } else { Kind::Static },
        transform,
    }
}
