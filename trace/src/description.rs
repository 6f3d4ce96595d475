// SPDX-License-Identifier: MIT OR Apache-2.0
//! Descriptions of the objects of events: entries of a table in the process's file, so that a recorder that starts late
//! knows their names.

use crate::event::ObjectId;
use crate::layout::{Map, NAME_BYTES, OBJECTS, ObjectWords};
use crate::sync::{AtomicU64, Ordering, fence};
use std::collections::VecDeque;
use std::ops::Range;

/// The kind of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
pub enum ObjectKind {
    /// A membership of a domain; the detail is the domain.
    Context = 1,
    /// A node; its parent is the context.
    Node = 2,
    /// A publisher; its parent is the node, the detail its depth.
    Publisher = 3,
    /// A subscription; its parent is the node, the detail its depth.
    Subscription = 4,
    /// A timer; its parent is the node, the detail its period in nanoseconds.
    Timer = 5,
    /// A callback; its parent is the subscription or the timer that it serves, if that is known.
    Callback = 6,
    /// A sampler; its parent is the context.
    Sampler = 7,
    /// A mirror's sender of one publisher's messages to a network; its gid is the one on the network.
    Sender = 8,
}

tautline_rt::names!(ObjectKind: const ALL: [ObjectKind; 8]; pub const fn name(self) -> &'static str {
    Context: "context", Node: "node", Publisher: "publisher", Subscription: "subscription", Timer: "timer",
    Callback: "callback", Sampler: "sampler", Sender: "sender",
});

impl ObjectKind {
    /// The kind with this name.
    pub fn from_name(name: &str) -> Option<ObjectKind> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    fn from_number(number: u32) -> Option<ObjectKind> {
        Self::ALL.into_iter().find(|kind| *kind as u32 == number)
    }
}

/// The description of an object.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Description {
    /// Unique in its process.
    pub id: ObjectId,
    /// Its kind.
    pub kind: ObjectKind,
    /// The object to which it belongs, or [`ObjectId::NONE`].
    pub parent: ObjectId,
    /// A number that depends on the kind.
    pub detail: u64,
    /// A publisher's or a sender's gid, as two words.
    pub gid: [u64; 2],
    /// When it was created, on `CLOCK_MONOTONIC`.
    pub created_ns: u64,
    /// A topic's or a node's fully qualified name, or a callback's name; at most its first 192 bytes.
    pub name: String,
}

/// The start of a name for which a description has room.
pub(crate) fn shortened(name: &str) -> &str {
    let end = (0..=NAME_BYTES.min(name.len())).rev().find(|at| name.is_char_boundary(*at)).unwrap_or(0);
    &name[..end]
}

/// The unused entries. The longest unused is taken first, so that an ended object's description stays readable as long as possible.
pub(crate) struct FreeEntries {
    never_used: Range<usize>,
    given_back: VecDeque<usize>,
}

impl FreeEntries {
    pub(crate) const fn none() -> FreeEntries {
        FreeEntries { never_used: 0..0, given_back: VecDeque::new() }
    }

    pub(crate) fn all() -> FreeEntries {
        FreeEntries { never_used: 0..OBJECTS, ..Self::none() }
    }

    /// `claim` gives an entry memory, and returns whether there was any.
    pub(crate) fn take(&mut self, claim: impl FnOnce(usize) -> bool) -> Option<usize> {
        let first = self.never_used.start;
        if self.never_used.is_empty() || !claim(first) {
            return self.given_back.pop_front();
        }
        self.never_used.start += 1;
        Some(first)
    }

    /// How many entries have memory, the first ones.
    pub(crate) fn claimed(&self) -> usize {
        self.never_used.start
    }

    pub(crate) fn give_back(&mut self, index: usize) {
        self.given_back.push_back(index);
    }
}

impl ObjectWords {
    /// Only one thread of the owner may write at a time.
    pub(crate) fn write(&self, object: &Description) {
        let turn = self.turn.load(Ordering::Relaxed) | 1;
        self.turn.store(turn, Ordering::Relaxed);
        // Pairs with the fence in `read`: a reader that gets a word from below also sees that the entry is being written.
        fence(Ordering::Release);
        self.kind.store(object.kind as u32, Ordering::Relaxed);
        self.name_bytes.store(object.name.len() as u32, Ordering::Relaxed);
        let words: [(&AtomicU64, u64); 6] = [
            (&self.id, object.id.0),
            (&self.parent, object.parent.0),
            (&self.detail, object.detail),
            (&self.gid[0], object.gid[0]),
            (&self.gid[1], object.gid[1]),
            (&self.created_ns, object.created_ns),
        ];
        for (to, from) in words {
            to.store(from, Ordering::Relaxed);
        }
        for (to, chunk) in self.name.iter().zip(object.name.as_bytes().chunks(8)) {
            let mut bytes = [0; 8];
            bytes[..chunk.len()].copy_from_slice(chunk);
            to.store(u64::from_le_bytes(bytes), Ordering::Relaxed);
        }
        // Release: pairs with the Acquire in `read`.
        self.turn.store(turn + 1, Ordering::Release);
    }

    /// The entry and its turn, which differs from that of the last read if the entry was reused; `None` while it is being
    /// written, was never used, or holds no valid description.
    pub(crate) fn read(&self) -> Option<(u64, Description)> {
        let turn = self.turn.load(Ordering::Acquire);
        if turn == 0 || turn & 1 == 1 {
            return None;
        }
        let word = |word: &AtomicU64| word.load(Ordering::Relaxed);
        let kind = ObjectKind::from_number(self.kind.load(Ordering::Relaxed));
        let name_bytes = (self.name_bytes.load(Ordering::Relaxed) as usize).min(NAME_BYTES);
        let mut name: Vec<u8> = self.name.iter().flat_map(|chunk| word(chunk).to_le_bytes()).collect();
        name.truncate(name_bytes);
        let description = Description {
            id: ObjectId(word(&self.id)),
            kind: kind?,
            parent: ObjectId(word(&self.parent)),
            detail: word(&self.detail),
            gid: [word(&self.gid[0]), word(&self.gid[1])],
            created_ns: word(&self.created_ns),
            name: String::from_utf8_lossy(&name).into_owned(),
        };
        fence(Ordering::Acquire);
        (self.turn.load(Ordering::Relaxed) == turn).then_some((turn, description))
    }
}

/// Every entry of a process's table that can be read.
pub(crate) fn entries(map: Map) -> impl Iterator<Item = (usize, u64, Description)> {
    // Relaxed: the caller has read `described`.
    let claimed = map.claimed_objects().load(Ordering::Relaxed) as usize;
    let entries = map.layout().objects.iter().take(claimed).enumerate();
    entries.filter_map(|(index, words)| words.read().map(|(turn, object)| (index, turn, object)))
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    fn blank() -> ObjectWords {
        // SAFETY: atomics, of which zero is valid.
        unsafe { core::mem::zeroed() }
    }

    #[test]
    fn what_is_written_is_read() {
        let entry = blank();
        assert_eq!(entry.read(), None);
        let mut object = Description {
            id: ObjectId(7),
            kind: ObjectKind::Publisher,
            parent: ObjectId(3),
            detail: 10,
            gid: [1, 2],
            created_ns: 99,
            name: "/robot/imu".to_owned(),
        };
        entry.write(&object);
        assert_eq!(entry.read(), Some((2, object.clone())));
        object.name = shortened(&"ä".repeat(200)).to_owned();
        assert_eq!(object.name.len(), 192);
        entry.write(&object);
        assert_eq!(entry.read(), Some((4, object)));
    }

    #[test]
    fn entries_without_memory_are_not_used() {
        let mut free = FreeEntries::all();
        let (full, room) = (|_| false, |_| true);
        assert_eq!([free.take(room), free.take(full), free.take(room)], [Some(0), None, Some(1)]);
        free.give_back(1);
        free.give_back(0);
        assert_eq!([free.take(full), free.take(room), free.take(full)], [Some(1), Some(2), Some(0)]);
        assert_eq!(free.claimed(), 3);
    }

    #[test]
    fn malformed_entries_are_not_read() {
        let entry = blank();
        entry.turn.store(2, Ordering::Relaxed);
        entry.kind.store(200, Ordering::Relaxed);
        assert_eq!(entry.read(), None, "no such kind");
        entry.kind.store(1, Ordering::Relaxed);
        entry.name_bytes.store(u32::MAX, Ordering::Relaxed);
        assert_eq!(entry.read().unwrap().1.name.len(), NAME_BYTES);
        entry.turn.store(3, Ordering::Relaxed);
        assert_eq!(entry.read(), None, "being written");
    }
}
