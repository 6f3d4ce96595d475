// SPDX-License-Identifier: MIT OR Apache-2.0
//! A participant's record of its nodes and ports: an append-only log, so that a reader that has read it once reads only new
//! entries.
//!
//! The record is one part of the participant's file: a word with the number of valid bytes, a word that counts how often the
//! record was rewritten, then entries. When there is no room for another entry, the entries that are still valid are written into
//! a new part, and only after that the head of the file points to this part. So a reader gets whole entries, at whatever point
//! the writer is stopped or killed. A reader of the former part reads the head again, and starts again.
//!
//! | in an entry | bytes |
//! |---|--:|
//! | its length, these words included, a multiple of 8 | 4 |
//! | its kind | 4 |
//! | its number, with which a later entry revokes it | 8 |
//! | the hash of the name of its topic, or of its node, for lookup | 8 |
//! | its content, and zeros | the rest |

use crate::error::TransportError;
use crate::graph::log_part::{PREFACE_BYTES, Part};
use crate::memory::file::{OwnMemory, PackedRange, ParticipantHeader, Peer};
use crate::memory::ranges::Range;
use rustix::io::Errno;
use std::collections::BTreeMap;
use std::io;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use tautline_rt::shm::Mapping;

/// Longest record that is written or read.
const MAX_BYTES: u64 = 64 << 20;
const HEAD_BYTES: usize = 24;

/// The kind of an entry. A reader skips kinds that it does not know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u32)]
pub(crate) enum EntryKind {
    /// The entry with this number is no longer valid.
    Gone = 1,
    Node = 2,
    /// A publisher or subscription of this participant.
    Port = 3,
    /// A publisher or subscription of another host, announced by a gateway.
    RemotePort = 4,
    /// A service or client of another host.
    RemoteService = 5,
    /// The participant's ports are proxies for those of other hosts: it belongs to a gateway or a bridge.
    Relay = 6,
    /// The publisher with this number has ended, and its samples wait for subscriptions that have not found them yet. The content
    /// is that of the port's entry.
    Ended = 7,
    /// A publisher elsewhere has ended normally: it did not die. The entry has the publisher's tag in place
    /// of a hash.
    RemoteEnded = 8,
}

impl EntryKind {
    fn from_word(word: u32) -> Option<Self> {
        use EntryKind::{Ended, Gone, Node, Port, Relay, RemoteEnded, RemotePort, RemoteService};
        let all = [Gone, Node, Port, RemotePort, RemoteService, Relay, Ended, RemoteEnded];
        all.into_iter().find(|kind| *kind as u32 == word)
    }
}

/// An entry of a record. Entries of another process are untrusted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LogEntry {
    pub(crate) kind: EntryKind,
    pub(crate) number: u64,
    pub(crate) hash: u64,
    pub(crate) body: Vec<u8>,
}

impl LogEntry {
    fn encode(&self) -> Vec<u8> {
        let len = (HEAD_BYTES + self.body.len()).next_multiple_of(8);
        let mut bytes = Vec::with_capacity(len);
        bytes.extend_from_slice(&(len as u32).to_ne_bytes());
        bytes.extend_from_slice(&(self.kind as u32).to_ne_bytes());
        bytes.extend_from_slice(&self.number.to_ne_bytes());
        bytes.extend_from_slice(&self.hash.to_ne_bytes());
        bytes.extend_from_slice(&self.body);
        bytes.resize(len, 0);
        bytes
    }

    /// The first entry of `bytes` (`None` if its kind is not known), and its length. `None`: the bytes are not an entry.
    fn decode(bytes: &[u8]) -> Option<(Option<LogEntry>, usize)> {
        let word = |at: usize| Some(u64::from_ne_bytes(bytes.get(at..at + 8)?.try_into().ok()?));
        let first = word(0)?.to_ne_bytes();
        let [len, kind] =
            [0, 4].map(|at| u32::from_ne_bytes([first[at], first[at + 1], first[at + 2], first[at + 3]]));
        let len = len as usize;
        if len < HEAD_BYTES || !len.is_multiple_of(8) || len > bytes.len() {
            return None;
        }
        let (number, hash) = (word(8)?, word(16)?);
        let body = bytes[HEAD_BYTES..len].to_vec();
        Some((EntryKind::from_word(kind).map(|kind| LogEntry { kind, number, hash, body }), len))
    }
}

/// The hash of a topic's name: FNV-1a, for it must be the same in every process.
pub(crate) fn hash_of(topic: &str) -> u64 {
    hash_of_bytes(topic.as_bytes())
}

pub(crate) fn hash_of_bytes(bytes: &[u8]) -> u64 {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, step)
}

/// The owner's side of its record.
pub(crate) struct Log {
    memory: Arc<OwnMemory>,
    part: Option<(Range, Arc<Mapping>)>,
    /// Its previous position, where another process may still read it.
    former: Option<Range>,
    used: usize,
    /// The valid entries, as bytes.
    live: BTreeMap<u64, Vec<u8>>,
    live_bytes: usize,
    next_number: u64,
    turn: u64,
}

impl Log {
    pub(crate) fn new(memory: Arc<OwnMemory>) -> Self {
        Log {
            memory,
            part: None,
            former: None,
            used: 0,
            live: BTreeMap::new(),
            live_bytes: 0,
            next_number: 1,
            turn: 0,
        }
    }

    /// A number for the next entry.
    pub(crate) fn number(&mut self) -> u64 {
        let number = self.next_number;
        self.next_number += 1;
        number
    }

    /// Adds an entry, whose number no entry had before.
    ///
    /// # Errors
    /// There is no memory for it: then nothing has changed.
    pub(crate) fn add(&mut self, entry: &LogEntry) -> io::Result<()> {
        let bytes = entry.encode();
        self.live_bytes += bytes.len();
        self.live.insert(entry.number, bytes.clone());
        self.append(&bytes).inspect_err(|_| {
            self.live.remove(&entry.number);
            self.live_bytes -= bytes.len();
        })
    }

    /// Removes an entry. If there is no memory to record this, readers see the entry until the next change for which there is memory.
    pub(crate) fn remove(&mut self, number: u64) -> io::Result<()> {
        let Some(bytes) = self.live.remove(&number) else { return Ok(()) };
        self.live_bytes -= bytes.len();
        self.append(&LogEntry { kind: EntryKind::Gone, number, hash: 0, body: Vec::new() }.encode())
    }

    /// Turns the entry of a port into that of an ended one. If there is no memory, readers see this later: see [`remove`](Self::remove).
    pub(crate) fn end(&mut self, number: u64) -> io::Result<()> {
        let Some(entry) = self.live.get_mut(&number) else { return Ok(()) };
        entry[4..8].copy_from_slice(&(EntryKind::Ended as u32).to_ne_bytes());
        let bytes = entry.clone();
        self.append(&bytes)
    }

    /// Whether there is a valid entry with this number.
    pub(crate) fn has(&self, number: u64) -> bool {
        self.live.contains_key(&number)
    }

    /// The number of valid entries of this kind with this hash.
    pub(crate) fn count(&self, kind: EntryKind, hash: u64) -> usize {
        let is_one = |bytes: &&Vec<u8>| {
            bytes[4..8] == (kind as u32).to_ne_bytes() && bytes[16..HEAD_BYTES] == hash.to_ne_bytes()
        };
        self.live.values().filter(is_one).count()
    }

    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        match &self.part {
            Some((_, part)) if self.used + bytes.len() <= part.len_bytes() - PREFACE_BYTES => {
                self.used = Part::of(part).append(self.used, bytes);
                Ok(())
            }
            _ => self.rewrite(),
        }
    }

    /// Writes the valid entries into a new part, twice as long as needed.
    fn rewrite(&mut self) -> io::Result<()> {
        let len = (2 * (PREFACE_BYTES + self.live_bytes) as u64).next_multiple_of(self.memory.page_bytes());
        if len > MAX_BYTES {
            let path = self.memory.path().display();
            return Err(io::Error::other(format!(
                "{path}: its record is {len} bytes long, the limit is {MAX_BYTES}"
            )));
        }
        let range = self.memory.reserve(len)?;
        let map = self.memory.claim(range).and_then(|()| self.memory.map(range));
        let part = map.inspect_err(|_| self.memory.release(range))?;
        self.turn += 1;
        let place = PackedRange::to_word(range);
        let entries = self.live.values().map(Vec::as_slice);
        self.used = Part::of(&part).publish(&self.memory.head().record, place, self.turn, entries);
        // A reader of the former part checks the head afterwards, and has done so by the next rewrite, which releases the part.
        let former = self.part.replace((range, part)).map(|(range, _)| range);
        if let Some(released) = std::mem::replace(&mut self.former, former) {
            self.memory.release(released);
        }
        Ok(())
    }
}

/// A reader's position in the record of a participant.
#[derive(Debug, Default)]
pub(crate) struct Reader {
    /// The record's position and rewrite count from the head: a rewritten record may get a former position again.
    place: u64,
    turn: u64,
    part: Option<Arc<Mapping>>,
    position: usize,
}

/// The entries that a reader has not read before.
#[derive(Debug, Default)]
pub(crate) struct LogUpdate {
    /// The record was rewritten: entries that were read before are no longer valid.
    pub(crate) anew: bool,
    /// Each with its position in the record, at which [`Reader::entry`] finds it until the record is rewritten.
    pub(crate) entries: Vec<(LogEntry, usize)>,
    /// The record is damaged from here on.
    pub(crate) is_damaged: bool,
}

impl Reader {
    /// Reads the new entries; none if the participant's file was removed.
    ///
    /// # Errors
    /// Those of [`Peer::map`], or the owner rewrites the record without a pause: then nothing has been read.
    pub(crate) fn read(&mut self, peer: &Peer) -> Result<LogUpdate, TransportError> {
        let mut update = LogUpdate::default();
        // The record is rewritten when its length has doubled: seldom, and not for ever.
        for attempt in 0..1000 {
            if attempt > 8 {
                // Shifts the next attempt relative to the owner's rewrites.
                std::thread::yield_now();
            }
            let place = peer.head().record.load(Ordering::Acquire);
            let turn = |part: &Arc<Mapping>| Part::of(part).turn();
            if place != self.place || self.part.as_ref().map(turn) != Some(self.turn) {
                let Some(range) = PackedRange::from_word(place).filter(|range| range.len <= MAX_BYTES) else {
                    update.is_damaged = place != 0;
                    if place == 0 && self.part.is_some() {
                        // The participant has ended, and leaves nothing.
                        *self = Reader::default();
                        update.anew = true;
                    }
                    return Ok(update);
                };
                let Some(part) = peer.map(range, false)? else { return Ok(update) };
                *self = Reader { place, turn: turn(&part), part: Some(part), position: 0 };
                update = LogUpdate { anew: true, ..LogUpdate::default() };
            }
            let position = self.position;
            let Some(bytes) = self.bytes(peer.head(), None) else { continue };
            let Some(bytes) = bytes else {
                update.is_damaged = true;
                return Ok(update);
            };
            let mut at = 0;
            while at < bytes.len() {
                let Some((entry, len)) = LogEntry::decode(&bytes[at..]) else {
                    update.is_damaged = true;
                    return Ok(update);
                };
                update.entries.extend(entry.map(|entry| (entry, position + at)));
                at += len;
            }
            self.position = position + at;
            return Ok(update);
        }
        // The owner was faster each time. The next read begins with the first entry.
        *self = Reader::default();
        Err(TransportError::File { path: peer.path().to_owned(), source: Errno::AGAIN.into() })
    }

    /// The entry at a position that `read` returned. `None`: the record was rewritten meanwhile, or is damaged.
    pub(crate) fn entry(&self, head: &ParticipantHeader, position: usize) -> Option<LogEntry> {
        // A part that the record has left is not read: that would allocate memory for its pages.
        if head.record.load(Ordering::Acquire) != self.place {
            return None;
        }
        LogEntry::decode(&self.bytes(head, Some(position))??)?.0
    }

    /// A copy of the valid bytes from this reader's position on, or of one entry. `None`: the record was rewritten meanwhile;
    /// `Some(None)`: it is damaged.
    fn bytes(&self, head: &ParticipantHeader, entry: Option<usize>) -> Option<Option<Vec<u8>>> {
        let part = Part::of(self.part.as_ref()?);
        part.read(&head.record, (self.place, self.turn), |part| match entry {
            None => part.copy_from(self.position),
            Some(at) => part.copy_entry(at),
        })
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::graph::domain::Domain;
    use crate::memory::file::Peer;
    use crate::tests::isolated;
    use std::sync::atomic::AtomicBool;

    struct Both {
        memory: Arc<OwnMemory>,
        log: Log,
        peer: Peer,
        _domain: Arc<Domain>,
    }

    fn both(domain: u32) -> Both {
        isolated();
        let _domain = Domain::join(domain).unwrap();
        let memory = Arc::new(OwnMemory::create(domain).unwrap());
        memory.create_arena();
        let peer = Peer::open(domain, memory.id()).unwrap().unwrap();
        Both { log: Log::new(memory.clone()), memory, peer, _domain }
    }

    impl Drop for Both {
        fn drop(&mut self) {
            self.memory.retire();
        }
    }

    fn read(reader: &mut Reader, peer: &Peer) -> LogUpdate {
        reader.read(peer).unwrap()
    }

    fn entry(log: &mut Log, body: &str) -> LogEntry {
        LogEntry { kind: EntryKind::Port, number: log.number(), hash: hash_of(body), body: body.into() }
    }

    /// Bodies come back with the zeros that follow them.
    fn text(entry: &LogEntry) -> &str {
        std::str::from_utf8(&entry.body).unwrap().trim_end_matches('\0')
    }

    #[test]
    fn only_what_is_new_is_read() {
        let mut both = both(222);
        let mut reader = Reader::default();
        assert!(read(&mut reader, &both.peer).entries.is_empty());
        let entries = ["/a", "/bc", "/camera/left/image"].map(|body| entry(&mut both.log, body));
        both.log.add(&entries[0]).unwrap();
        both.log.add(&entries[1]).unwrap();
        let update = read(&mut reader, &both.peer);
        assert!(update.anew && !update.is_damaged);
        assert_eq!(update.entries.iter().map(|(entry, _)| text(entry)).collect::<Vec<_>>(), ["/a", "/bc"]);
        assert!(read(&mut reader, &both.peer).entries.is_empty());
        both.log.add(&entries[2]).unwrap();
        both.log.remove(1).unwrap();
        let update = read(&mut reader, &both.peer);
        assert!(!update.anew);
        let found: Vec<_> = update.entries.iter().map(|(entry, _)| (entry.kind, entry.number)).collect();
        assert_eq!(found, [(EntryKind::Port, 3), (EntryKind::Gone, 1)]);
        assert_eq!(text(&reader.entry(both.peer.head(), update.entries[0].1).unwrap()), "/camera/left/image");
    }

    #[test]
    fn what_counts_is_written_anew_when_there_is_no_room() {
        let mut both = both(223);
        let mut reader = Reader::default();
        let mut known: BTreeMap<u64, String> = BTreeMap::new();
        let (mut anew, mut positions) = (0, BTreeMap::new());
        for n in 0..3000 {
            let new = entry(&mut both.log, &format!("/topic{}", "x".repeat(n % 200)));
            both.log.add(&new).unwrap();
            if n > 50 {
                both.log.remove(new.number - 50).unwrap();
            }
            if n % 7 == 0 {
                let update = read(&mut reader, &both.peer);
                assert!(!update.is_damaged);
                if update.anew {
                    (anew, known, positions) = (anew + 1, BTreeMap::new(), BTreeMap::new());
                }
                for (entry, position) in &update.entries {
                    match entry.kind {
                        EntryKind::Gone => drop(known.remove(&entry.number)),
                        _ => drop(known.insert(entry.number, text(entry).to_owned())),
                    }
                    positions.insert(entry.number, *position);
                }
                let written: BTreeMap<u64, String> = both
                    .log
                    .live
                    .iter()
                    .map(|(number, bytes)| {
                        (*number, text(&LogEntry::decode(bytes).unwrap().0.unwrap()).to_owned())
                    })
                    .collect();
                assert_eq!(known, written);
            }
        }
        assert!(anew > 2, "{anew}");
        assert!(both.log.part.as_ref().unwrap().0.len < 64 << 10, "it does not grow for ever");
    }

    /// Each entry says its own number many times: one that is mixed of two is found.
    #[test]
    fn nothing_torn_is_read_while_it_is_written() {
        let mut both = both(224);
        let (ended, reading) = (AtomicBool::new(false), AtomicBool::new(false));
        let Both { log, peer, .. } = &mut both;
        let (read_entries, anew) = std::thread::scope(|scope| {
            let reader = scope.spawn(|| {
                let (mut reader, mut count, mut anew) = (Reader::default(), 0, 0);
                loop {
                    let is_last = ended.load(Ordering::Acquire);
                    let update = read(&mut reader, peer);
                    assert!(!update.is_damaged);
                    anew += u32::from(update.anew);
                    for (entry, _) in update.entries.iter().filter(|(entry, _)| entry.kind == EntryKind::Port)
                    {
                        assert_eq!(
                            text(entry),
                            entry.number.to_string().repeat(1 + entry.number as usize % 40)
                        );
                        count += 1;
                    }
                    reading.store(true, Ordering::Release);
                    if is_last {
                        return (count, anew);
                    }
                }
            });
            while !reading.load(Ordering::Acquire) {
                std::thread::yield_now();
            }
            for n in 1..=20_000_u64 {
                let number = log.number();
                assert_eq!(number, n);
                let body = number.to_string().repeat(1 + n as usize % 40).into();
                log.add(&LogEntry { kind: EntryKind::Port, number, hash: 0, body }).unwrap();
                if n > 20 {
                    log.remove(n - 20).unwrap();
                }
            }
            ended.store(true, Ordering::Release);
            reader.join().unwrap()
        });
        println!("{read_entries} entries were read, {anew} times from the start");
        assert!(read_entries > 1 && anew > 0);
    }

    #[test]
    fn lies_are_damage_and_no_panic() {
        let mut both = both(225);
        for body in ["/a", "/b"] {
            let new = entry(&mut both.log, body);
            both.log.add(&new).unwrap();
        }
        let (_, part) = both.log.part.clone().unwrap();
        let record = &both.memory.head().record;
        let truth = record.load(Ordering::Relaxed);
        for lie in [u64::MAX, 1, truth + 1, truth | 1 << 60] {
            record.store(lie, Ordering::Relaxed);
            let update = read(&mut Reader::default(), &both.peer);
            assert!(update.entries.is_empty(), "{lie}");
        }
        record.store(truth, Ordering::Relaxed);
        for lie in [u64::MAX, 4, 1 << 40] {
            Part::of(&part).valid.store(lie, Ordering::Relaxed);
            assert!(read(&mut Reader::default(), &both.peer).is_damaged, "{lie}");
        }
        Part::of(&part).valid.store(both.log.used as u64, Ordering::Relaxed);
        for lie in [0, 8, 25, u64::from(u32::MAX), 1 << 20] {
            let first = Part::of(&part).words[0].swap(lie, Ordering::Relaxed);
            assert!(read(&mut Reader::default(), &both.peer).is_damaged, "{lie}");
            Part::of(&part).words[0].store(first, Ordering::Relaxed);
        }
        // A kind of a later version.
        Part::of(&part).words[0].store(
            Part::of(&part).words[0].load(Ordering::Relaxed) & 0xffff_ffff | 99 << 32,
            Ordering::Relaxed,
        );
        let update = read(&mut Reader::default(), &both.peer);
        assert!(!update.is_damaged && update.entries.len() == 1, "it is passed over");
    }
}
