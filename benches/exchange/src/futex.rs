// SPDX-License-Identifier: MIT OR Apache-2.0
//! The lower bounds: only one futex wake per direction, or per message of a one-way flow.

use std::mem::MaybeUninit;
use std::os::fd::AsFd;
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::thread::futex::{self, Flags, Timespec};

use crate::job::Role;

const PAGE: usize = 4096;
/// Farther apart than the cache lines that processors prefetch together.
const WORDS: [usize; 2] = [0, 1024];
/// Capacity of a ring at most.
const RING: usize = 64;
/// Buffers of this many bytes together are written in turn: one that is written again has left the reader's own caches by then, and not the
/// one that both share. Below the other number of bytes a message nothing is gained by that.
const ROTATED_BYTES: usize = 4 << 20;
/// See [`ROTATED_BYTES`].
const LEAST_ROTATED: usize = 16 << 10;
/// Bytes before a message in a ring: its topic.
const TOPIC_BYTES: usize = 8;

/// Memory shared by two processes: a page with two words, then areas of equal size.
#[derive(Debug)]
struct SharedMemory {
    memory: NonNull<u8>,
    area_bytes: usize,
    areas: usize,
}

impl SharedMemory {
    fn bytes(area_bytes: usize, areas: usize) -> usize {
        PAGE + areas * area_bytes.next_multiple_of(PAGE)
    }

    fn open(file: impl AsFd, area_bytes: usize, areas: usize) -> rustix::io::Result<Self> {
        let (access, share) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED);
        let bytes = Self::bytes(area_bytes, areas);
        // SAFETY: a new mapping at an address of the kernel's choice, of a file of this length.
        let memory = unsafe { mmap(ptr::null_mut(), bytes, access, share, file, 0)? };
        let memory = NonNull::new(memory.cast()).ok_or(Errno::NOMEM)?;
        Ok(Self { memory, area_bytes, areas })
    }

    fn word(&self, index: usize) -> &AtomicU32 {
        // SAFETY: inside the first page, aligned, alive as long as self; both processes access it atomically.
        unsafe { AtomicU32::from_ptr(self.memory.add(WORDS[index]).cast().as_ptr()) }
    }

    /// The start of an area.
    fn area(&self, index: usize) -> *mut u8 {
        let offset = PAGE + (index % self.areas) * self.area_bytes.next_multiple_of(PAGE);
        // SAFETY: inside the mapping, whose length has room for all areas.
        unsafe { self.memory.add(offset).as_ptr() }
    }

    /// Waits until a word is not `seen`, at most for the given time; returns whether it is.
    fn wait(&self, index: usize, seen: u32, patience: Duration) -> rustix::io::Result<bool> {
        let word = self.word(index);
        let timeout = Timespec {
            tv_sec: i64::try_from(patience.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: patience.subsec_nanos().into(),
        };
        // Acquire: writes before the word are visible; pairs with the Release in `count`.
        while word.load(Ordering::Acquire) == seen {
            match futex::wait(word, Flags::empty(), seen, Some(&timeout)) {
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                Err(Errno::TIMEDOUT) => return Ok(false),
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// Counts a message in a word, and wakes its waiter.
    fn count(&self, index: usize) -> rustix::io::Result<()> {
        let word = self.word(index);
        // Release: the message is written; pairs with the Acquire in `wait`.
        word.fetch_add(1, Ordering::Release);
        futex::wake(word, Flags::empty(), 1).map(drop)
    }
}

impl Drop for SharedMemory {
    fn drop(&mut self) {
        let bytes = Self::bytes(self.area_bytes, self.areas);
        // SAFETY: mapped in `open` with this length; nothing borrows it now.
        // Ignored: fails only for addresses outside the mapping.
        let _ = unsafe { munmap(self.memory.as_ptr().cast(), bytes) };
    }
}

/// Buffers that messages of a size go through in turn.
fn rotated(payload_bytes: usize) -> usize {
    if payload_bytes < LEAST_ROTATED { 1 } else { (ROTATED_BYTES / payload_bytes).max(1) }
}

/// One side of memory with a word and buffers per direction. A message is sent only after the previous one was answered.
#[derive(Debug)]
pub struct FutexPair {
    shared: SharedMemory,
    /// Indices of the directions' words and first areas.
    outgoing: usize,
    incoming: usize,
    /// Buffers of a direction.
    buffers: usize,
    /// Messages sent and received, modulo 2^32.
    sent: u32,
    received: u32,
}

impl FutexPair {
    /// Required length of the file.
    pub fn memory_bytes(payload_bytes: usize) -> usize {
        SharedMemory::bytes(payload_bytes, 2 * rotated(payload_bytes))
    }

    /// Maps a file of [`memory_bytes`](Self::memory_bytes). Each side may write its buffers in turn, or the first one alone; both do the same.
    pub fn open(
        file: impl AsFd,
        role: Role,
        payload_bytes: usize,
        in_turn: bool,
    ) -> rustix::io::Result<Self> {
        let (outgoing, incoming) = if role == Role::Near { (0, 1) } else { (1, 0) };
        let buffers = if in_turn { rotated(payload_bytes) } else { 1 };
        let shared = SharedMemory::open(file, payload_bytes, 2 * buffers)?;
        Ok(Self { shared, outgoing, incoming, buffers, sent: 0, received: 0 })
    }

    fn area(&self, direction: usize, number: u32) -> *mut u8 {
        self.shared.area(direction + 2 * (number as usize % self.buffers))
    }

    /// Writes a message with `fill`, and wakes the other side.
    pub fn send(&mut self, fill: impl FnOnce(&mut [MaybeUninit<u8>])) -> rustix::io::Result<()> {
        let area = self.area(self.outgoing, self.sent).cast::<MaybeUninit<u8>>();
        self.sent = self.sent.wrapping_add(1);
        // SAFETY: the length of an area; the peer reads it only between the wake below and its own next message.
        fill(unsafe { std::slice::from_raw_parts_mut(area, self.shared.area_bytes) });
        self.shared.count(self.outgoing)
    }

    /// Waits for a message, at most for the given time, and reads it.
    pub fn receive<T>(
        &mut self,
        patience: Duration,
        read: impl FnOnce(&[u8]) -> T,
    ) -> rustix::io::Result<Option<T>> {
        if !self.shared.wait(self.incoming, self.received, patience)? {
            return Ok(None);
        }
        let area = self.area(self.incoming, self.received);
        self.received = self.received.wrapping_add(1);
        // SAFETY: the length of an area; the peer writes it again only after our next message.
        Ok(Some(read(unsafe { std::slice::from_raw_parts(area, self.shared.area_bytes) })))
    }
}

/// One side of memory for a one-way flow of any topics: one word counts sent messages, the other received ones.
#[derive(Debug)]
pub struct FutexRing {
    shared: SharedMemory,
    /// Messages that it has room for.
    room: u32,
    /// Messages sent or received by this side, modulo 2^32.
    count: u32,
}

/// As many as there are [buffers](rotated) of a large message, but two at least.
fn room(payload_bytes: usize) -> usize {
    if payload_bytes < LEAST_ROTATED { RING } else { rotated(payload_bytes).clamp(2, RING) }
}

const SENT: usize = 0;
const RECEIVED: usize = 1;

impl FutexRing {
    /// Required length of the file.
    pub fn memory_bytes(payload_bytes: usize) -> usize {
        SharedMemory::bytes(TOPIC_BYTES + payload_bytes, room(payload_bytes))
    }

    /// Maps a file of [`memory_bytes`](Self::memory_bytes), all of it zero.
    pub fn open(file: impl AsFd, payload_bytes: usize) -> rustix::io::Result<Self> {
        let room = room(payload_bytes);
        let shared = SharedMemory::open(file, TOPIC_BYTES + payload_bytes, room)?;
        Ok(Self { shared, room: room as u32, count: 0 })
    }

    /// Writes a message of a topic with `fill` when there is room, and wakes the other side. For the near endpoint only.
    pub fn send(
        &mut self,
        topic: usize,
        fill: impl FnOnce(&mut [MaybeUninit<u8>]),
    ) -> rustix::io::Result<()> {
        // Acquire: the reader has finished with the area; pairs with the Release in `count`.
        while self.count.wrapping_sub(self.shared.word(RECEIVED).load(Ordering::Acquire)) >= self.room {
            std::thread::yield_now();
        }
        let area = self.shared.area((self.count % self.room) as usize).cast::<MaybeUninit<u8>>();
        // SAFETY: the length of an area; the peer has counted the previous message, and reads the next one after the wake.
        let area = unsafe { std::slice::from_raw_parts_mut(area, self.shared.area_bytes) };
        let (before, payload) = area.split_at_mut(TOPIC_BYTES);
        before.copy_from_slice(&(topic as u64).to_ne_bytes().map(MaybeUninit::new));
        fill(payload);
        self.count = self.count.wrapping_add(1);
        self.shared.count(SENT)
    }

    /// Waits for a message, at most for the given time, and reads it and its topic. For the far endpoint only.
    pub fn receive<T>(
        &mut self,
        patience: Duration,
        read: impl FnOnce(&[u8]) -> T,
    ) -> rustix::io::Result<Option<(usize, T)>> {
        if !self.shared.wait(SENT, self.count, patience)? {
            return Ok(None);
        }
        let area = self.shared.area((self.count % self.room) as usize);
        // SAFETY: the length of an area; the peer writes it again only after the count below.
        let area = unsafe { std::slice::from_raw_parts(area, self.shared.area_bytes) };
        let (before, payload) = area.split_at(TOPIC_BYTES);
        let topic = before.try_into().map_or(u64::MAX, u64::from_ne_bytes);
        let received = (topic as usize, read(payload));
        self.count = self.count.wrapping_add(1);
        // Release: the area may be written again. No thread sleeps on this word.
        self.shared.word(RECEIVED).store(self.count, Ordering::Release);
        Ok(Some(received))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_a_pair_go_through_its_buffers_in_turn() {
        let (bytes, near, far) = (1 << 20, Role::Near, Role::Far);
        let file = tempfile::tempfile().unwrap();
        file.set_len(FutexPair::memory_bytes(bytes) as u64).unwrap();
        let mut ends = [near, far].map(|role| FutexPair::open(&file, role, bytes, true).unwrap());
        let mut places = Vec::new();
        for number in 0..9 {
            let fill = |out: &mut [MaybeUninit<u8>]| {
                places.push(out.as_ptr().addr());
                out.fill(MaybeUninit::new(number));
            };
            ends[0].send(fill).unwrap();
            let read = ends[1].receive(Duration::ZERO, |bytes| (bytes[0], bytes.len())).unwrap();
            assert_eq!(read, Some((number, bytes)));
        }
        assert_eq!(places[4..8], places[..4]);
        assert_eq!(places.iter().collect::<std::collections::BTreeSet<_>>().len(), 4);
    }

    #[test]
    fn a_ring_keeps_order_and_topics_and_holds_its_sender_back() {
        let file = tempfile::tempfile().unwrap();
        file.set_len(FutexRing::memory_bytes(16) as u64).unwrap();
        let mut far = FutexRing::open(&file, 16).unwrap();
        let count = 3 * RING;
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut near = FutexRing::open(&file, 16).unwrap();
                for number in 0..count {
                    let fill = |out: &mut [MaybeUninit<u8>]| out.fill(MaybeUninit::new(number as u8));
                    near.send(number % 7, fill).unwrap();
                }
            });
            for number in 0..count {
                let (topic, first) = far.receive(Duration::from_secs(20), |bytes| bytes[0]).unwrap().unwrap();
                assert_eq!((topic, first), (number % 7, number as u8));
            }
        });
        assert_eq!(far.receive(Duration::ZERO, |_| ()).unwrap(), None);
    }
}
