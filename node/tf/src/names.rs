// SPDX-License-Identifier: MIT OR Apache-2.0
//! The names of frames: a hash table that one thread writes and any thread reads. Names are never removed.

use std::fmt;

use crate::sync::{AtomicU64, Ordering};

/// Number of a frame in one [`Buffer`](crate::Buffer): a name is looked up only once, and the number costs no
/// lookup.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FrameId(pub(crate) u32);

/// The name of a frame, stored inline, so that errors contain names without an allocation.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct FrameName([u8; FrameName::MAX_BYTES]);

const WORDS: usize = FrameName::MAX_BYTES / 8;

impl FrameName {
    /// The longest name, in bytes of UTF-8.
    pub const MAX_BYTES: usize = 64;

    /// The placeholder for a number that this buffer did not assign.
    pub(crate) const FOREIGN: FrameName = {
        let mut bytes = [0; FrameName::MAX_BYTES];
        let text = b"(a FrameId of another buffer)";
        bytes.split_at_mut(text.len()).0.copy_from_slice(text);
        FrameName(bytes)
    };

    /// The name of a frame without a leading slash. The error is the truncated name, if it is not valid: empty, longer than
    /// [`MAX_BYTES`](Self::MAX_BYTES), or with a zero byte.
    pub(crate) fn parse(name: &str) -> Result<FrameName, FrameName> {
        let name = name.strip_prefix('/').unwrap_or(name);
        let usable = name.len().min(FrameName::MAX_BYTES);
        let end = name.bytes().position(|byte| byte == 0).unwrap_or(usable).min(usable);
        let end = (0..=end).rev().find(|end| name.is_char_boundary(*end)).unwrap_or(0);
        let mut bytes = [0; FrameName::MAX_BYTES];
        bytes[..end].copy_from_slice(&name.as_bytes()[..end]);
        if end == name.len() && end > 0 { Ok(FrameName(bytes)) } else { Err(FrameName(bytes)) }
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        let end = self.0.iter().position(|byte| *byte == 0).unwrap_or(self.0.len());
        // The name consists of whole characters only.
        str::from_utf8(&self.0[..end]).unwrap_or_default()
    }

    fn words(&self) -> [u64; WORDS] {
        let mut words = [0; WORDS];
        for (word, bytes) in words.iter_mut().zip(self.0.as_chunks::<8>().0) {
            *word = u64::from_le_bytes(*bytes);
        }
        words
    }

    fn of_words(words: [u64; WORDS]) -> FrameName {
        let mut name = [0; FrameName::MAX_BYTES];
        for (bytes, word) in name.as_chunks_mut::<8>().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        FrameName(name)
    }
}

impl fmt::Display for FrameName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_str().fmt(f)
    }
}

impl fmt::Debug for FrameName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_str().fmt(f)
    }
}

/// Names by number, and an open-addressing table of numbers by the hash of the name, at most half full.
pub(crate) struct Names {
    names: Box<[[AtomicU64; WORDS]]>,
    /// Number of the frame + 1; zero: empty.
    table: Box<[AtomicU64]>,
    len: AtomicU64,
}

impl Names {
    pub(crate) fn new(frames: usize) -> Names {
        Names {
            names: (0..frames).map(|_| std::array::from_fn(|_| AtomicU64::new(0))).collect(),
            table: (0..Names::table_len(frames)).map(|_| AtomicU64::new(0)).collect(),
            len: AtomicU64::new(0),
        }
    }

    pub(crate) fn bytes(frames: usize) -> usize {
        frames * size_of::<[AtomicU64; WORDS]>() + Names::table_len(frames) * size_of::<AtomicU64>()
    }

    fn table_len(frames: usize) -> usize {
        (2 * frames).next_power_of_two()
    }

    pub(crate) fn len(&self) -> usize {
        // Acquire: pairs with the Release in `insert`.
        self.len.load(Ordering::Acquire) as usize
    }

    pub(crate) fn spare(&self) -> usize {
        self.names.len() - self.len()
    }

    /// The slots where the name may be: it is before the first empty one.
    fn probe(&self, name: &FrameName) -> impl Iterator<Item = &AtomicU64> {
        // FNV-1a over words, its high bits mixed into the low ones, which are used.
        let hash = name.words().iter().fold(0xcbf2_9ce4_8422_2325, |hash: u64, word| {
            let hash = (hash ^ word).wrapping_mul(0x0100_0000_01b3);
            hash ^ (hash >> 29)
        });
        let (before, after) = self.table.split_at(hash as usize & (self.table.len() - 1));
        after.iter().chain(before)
    }

    /// # Real-time
    /// Wait-free. On average fewer than two names are compared, at most all.
    pub(crate) fn find(&self, name: &FrameName) -> Option<FrameId> {
        for slot in self.probe(name) {
            // Acquire: pairs with the Release in `insert`, which comes after the name.
            let frame = u32::try_from(slot.load(Ordering::Acquire)).ok()?.checked_sub(1).map(FrameId)?;
            if self.get(frame).as_ref() == Some(name) {
                return Some(frame);
            }
        }
        None
    }

    /// The name of a frame; `None` if it is another buffer's frame.
    pub(crate) fn get(&self, frame: FrameId) -> Option<FrameName> {
        let words = self.names.get(frame.0 as usize)?;
        Some(FrameName::of_words(std::array::from_fn(|word| words[word].load(Ordering::Relaxed))))
    }

    /// Adds a name that is not in the table, and returns its number; `None` if the table is full. Only the writer may call this.
    pub(crate) fn insert(&self, name: &FrameName) -> Option<FrameId> {
        let number = self.len();
        for (slot, word) in self.names.get(number)?.iter().zip(name.words()) {
            slot.store(word, Ordering::Relaxed);
        }
        let slot = self.probe(name).find(|slot| slot.load(Ordering::Relaxed) == 0)?;
        // Release: pairs with the Acquire in `find`.
        slot.store(number as u64 + 1, Ordering::Release);
        // Release: pairs with the Acquire in `len`.
        self.len.store(number as u64 + 1, Ordering::Release);
        u32::try_from(number).ok().map(FrameId)
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn names_are_found_until_the_table_is_full_and_after() {
        let names = Names::new(5);
        for (number, name) in ["a", "b", "/c", "été", "e"].iter().enumerate() {
            let name = FrameName::parse(name).unwrap();
            assert_eq!(names.find(&name), None);
            assert_eq!(names.insert(&name), Some(FrameId(number as u32)));
            assert_eq!(names.find(&name), Some(FrameId(number as u32)));
        }
        assert_eq!((names.len(), names.spare()), (5, 0));
        assert_eq!(names.insert(&FrameName::parse("f").unwrap()), None);
        assert_eq!(names.find(&FrameName::parse("f").unwrap()), None);
        assert_eq!(names.get(names.find(&FrameName::parse("c").unwrap()).unwrap()).unwrap().as_str(), "c");
        assert_eq!(names.get(FrameId(5)), None);
    }

    #[test]
    fn what_names_no_frame_is_shown_as_far_as_it_goes() {
        let long = "é".repeat(33);
        for (name, shown) in [("", ""), ("/", ""), ("a\0b", "a"), (&long, &long[..64])] {
            assert_eq!(FrameName::parse(name).unwrap_err().as_str(), shown);
        }
        assert_eq!(FrameName::parse(&long[..64]).unwrap().as_str(), &long[..64]);
        assert_eq!(FrameName::parse("//a").unwrap().as_str(), "/a");
        assert_eq!(FrameName::parse(&format!("x{}", "é".repeat(32))).unwrap_err().as_str().len(), 63);
    }
}
