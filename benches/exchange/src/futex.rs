// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floors: one futex wake each way, or one for each message that goes one way, and nothing else.

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
/// Apart from each other by more than the lines that processors fetch together.
const WORDS: [usize; 2] = [0, 1024];
/// Messages that a ring has room for.
const RING: u32 = 64;
/// Bytes before a message in a ring: its topic.
const TOPIC_BYTES: usize = 8;

/// Memory that two processes share: a page with two words, then areas of the same size.
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
        // SAFETY: a new mapping at an address of the kernel's choice, of a file that the caller made as long as this.
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

    /// Waits at most so long until a word is not `seen`; returns whether it is.
    fn wait(&self, index: usize, seen: u32, patience: Duration) -> rustix::io::Result<bool> {
        let word = self.word(index);
        let timeout = Timespec {
            tv_sec: i64::try_from(patience.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: patience.subsec_nanos().into(),
        };
        // Acquire: what was written before the word can be read; pairs with the Release in `count`.
        while word.load(Ordering::Acquire) == seen {
            match futex::wait(word, Flags::empty(), seen, Some(&timeout)) {
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                Err(Errno::TIMEDOUT) => return Ok(false),
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// Counts a message in a word, and wakes who waits for it.
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
        // SAFETY: mapped in `open` with this length; nothing borrows it any more.
        // Ignored: it fails only for addresses that are not the mapping's.
        let _ = unsafe { munmap(self.memory.as_ptr().cast(), bytes) };
    }
}

/// One end of memory with a word and an area for either direction. A message is sent only when the one before was answered.
#[derive(Debug)]
pub struct FutexPair {
    shared: SharedMemory,
    /// Indices of the directions' words and areas.
    outgoing: usize,
    incoming: usize,
    /// Messages received, modulo 2^32.
    received: u32,
}

impl FutexPair {
    /// How long the file must be.
    pub fn memory_bytes(payload_bytes: usize) -> usize {
        SharedMemory::bytes(payload_bytes, 2)
    }

    /// Maps a file of [`memory_bytes`](Self::memory_bytes).
    pub fn open(file: impl AsFd, role: Role, payload_bytes: usize) -> rustix::io::Result<Self> {
        let (outgoing, incoming) = if role == Role::Near { (0, 1) } else { (1, 0) };
        Ok(Self { shared: SharedMemory::open(file, payload_bytes, 2)?, outgoing, incoming, received: 0 })
    }

    /// Has `fill` write a message, and wakes the other end.
    pub fn send(&mut self, fill: impl FnOnce(&mut [MaybeUninit<u8>])) -> rustix::io::Result<()> {
        let area = self.shared.area(self.outgoing).cast::<MaybeUninit<u8>>();
        // SAFETY: as long as an area; the peer reads it only between the wake below and its own next message.
        fill(unsafe { std::slice::from_raw_parts_mut(area, self.shared.area_bytes) });
        self.shared.count(self.outgoing)
    }

    /// Waits at most so long for a message and has it read.
    pub fn receive<T>(
        &mut self,
        patience: Duration,
        read: impl FnOnce(&[u8]) -> T,
    ) -> rustix::io::Result<Option<T>> {
        if !self.shared.wait(self.incoming, self.received, patience)? {
            return Ok(None);
        }
        self.received = self.received.wrapping_add(1);
        let area = self.shared.area(self.incoming);
        // SAFETY: as long as an area; the peer writes it again only after our next message.
        Ok(Some(read(unsafe { std::slice::from_raw_parts(area, self.shared.area_bytes) })))
    }
}

/// One end of memory through which messages go one way, of any topic: a word counts those sent, the other those received.
#[derive(Debug)]
pub struct FutexRing {
    shared: SharedMemory,
    /// Messages sent or received by this end, modulo 2^32.
    count: u32,
}

const SENT: usize = 0;
const RECEIVED: usize = 1;

impl FutexRing {
    /// How long the file must be.
    pub fn memory_bytes(payload_bytes: usize) -> usize {
        SharedMemory::bytes(TOPIC_BYTES + payload_bytes, RING as usize)
    }

    /// Maps a file of [`memory_bytes`](Self::memory_bytes), all of it zero.
    pub fn open(file: impl AsFd, payload_bytes: usize) -> rustix::io::Result<Self> {
        Ok(Self { shared: SharedMemory::open(file, TOPIC_BYTES + payload_bytes, RING as usize)?, count: 0 })
    }

    /// Has `fill` write a message of a topic once there is room for it, and wakes the other end. For the near end alone.
    pub fn send(
        &mut self,
        topic: usize,
        fill: impl FnOnce(&mut [MaybeUninit<u8>]),
    ) -> rustix::io::Result<()> {
        // Acquire: the reader is done with the area; pairs with the Release in `count`.
        while self.count.wrapping_sub(self.shared.word(RECEIVED).load(Ordering::Acquire)) >= RING {
            std::thread::sleep(Duration::from_micros(100));
        }
        let area = self.shared.area(self.count as usize).cast::<MaybeUninit<u8>>();
        // SAFETY: as long as an area; the peer has counted the message that was there, and reads the next one after the wake.
        let area = unsafe { std::slice::from_raw_parts_mut(area, self.shared.area_bytes) };
        let (before, payload) = area.split_at_mut(TOPIC_BYTES);
        before.copy_from_slice(&(topic as u64).to_ne_bytes().map(MaybeUninit::new));
        fill(payload);
        self.count = self.count.wrapping_add(1);
        self.shared.count(SENT)
    }

    /// Waits at most so long for a message and has it read; also its topic, as the other end says. For the far end alone.
    pub fn receive<T>(
        &mut self,
        patience: Duration,
        read: impl FnOnce(&[u8]) -> T,
    ) -> rustix::io::Result<Option<(usize, T)>> {
        if !self.shared.wait(SENT, self.count, patience)? {
            return Ok(None);
        }
        let area = self.shared.area(self.count as usize);
        // SAFETY: as long as an area; the peer writes it again only after it was counted below.
        let area = unsafe { std::slice::from_raw_parts(area, self.shared.area_bytes) };
        let (before, payload) = area.split_at(TOPIC_BYTES);
        let topic = before.try_into().map_or(u64::MAX, u64::from_ne_bytes);
        let received = (topic as usize, read(payload));
        self.count = self.count.wrapping_add(1);
        // Release: the area may be written again. Nobody sleeps on this word.
        self.shared.word(RECEIVED).store(self.count, Ordering::Release);
        Ok(Some(received))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_keeps_order_and_topics_and_holds_its_sender_back() {
        let file = tempfile::tempfile().unwrap();
        file.set_len(FutexRing::memory_bytes(16) as u64).unwrap();
        let mut far = FutexRing::open(&file, 16).unwrap();
        let count = 3 * RING as usize;
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
