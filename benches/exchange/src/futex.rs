// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floor: one futex wake each way and nothing else.

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

/// One end of memory that two processes share: a page with two words that count the messages of either direction, then a
/// payload area for each. A message is sent only when the one before was answered.
#[derive(Debug)]
pub struct FutexPair {
    memory: NonNull<u8>,
    payload_bytes: usize,
    /// Indices of the directions in `WORDS` and of the payload areas.
    outgoing: usize,
    incoming: usize,
    /// Messages received, modulo 2^32.
    received: u32,
}

impl FutexPair {
    /// How long the file must be.
    #[must_use]
    pub fn memory_bytes(payload_bytes: usize) -> usize {
        PAGE + 2 * area_bytes(payload_bytes)
    }

    /// Maps a file of [`memory_bytes`](Self::memory_bytes).
    ///
    /// # Errors
    /// It cannot be mapped.
    pub fn open(file: impl AsFd, role: Role, payload_bytes: usize) -> rustix::io::Result<Self> {
        let (outgoing, incoming) = if role == Role::Near { (0, 1) } else { (1, 0) };
        let (access, share) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED);
        let bytes = Self::memory_bytes(payload_bytes);
        // SAFETY: a new mapping at an address of the kernel's choice, of a file that the caller made as long as this.
        let memory = unsafe { mmap(ptr::null_mut(), bytes, access, share, file, 0)? };
        let memory = NonNull::new(memory.cast()).ok_or(Errno::NOMEM)?;
        Ok(Self { memory, payload_bytes, outgoing, incoming, received: 0 })
    }

    /// Has `fill` write a message, and wakes the other end.
    ///
    /// # Errors
    /// The futex's.
    pub fn send(&mut self, fill: impl FnOnce(&mut [MaybeUninit<u8>])) -> rustix::io::Result<()> {
        let area = self.area(self.outgoing).cast::<MaybeUninit<u8>>();
        // SAFETY: as long as an area; the peer reads it only between the wake below and its own next message.
        fill(unsafe { std::slice::from_raw_parts_mut(area, self.payload_bytes) });
        let word = self.word(self.outgoing);
        // Release: the payload is written; pairs with the Acquire in `receive`.
        word.fetch_add(1, Ordering::Release);
        futex::wake(word, Flags::empty(), 1).map(drop)
    }

    /// Waits at most so long for a message and has it read.
    ///
    /// # Errors
    /// The futex's.
    pub fn receive<T>(
        &mut self,
        patience: Duration,
        read: impl FnOnce(&[u8]) -> T,
    ) -> rustix::io::Result<Option<T>> {
        let word = self.word(self.incoming);
        let timeout = Timespec {
            tv_sec: i64::try_from(patience.as_secs()).unwrap_or(i64::MAX),
            tv_nsec: patience.subsec_nanos().into(),
        };
        // Acquire: the payload can be read; pairs with the Release in `send`.
        while word.load(Ordering::Acquire) == self.received {
            match futex::wait(word, Flags::empty(), self.received, Some(&timeout)) {
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                Err(Errno::TIMEDOUT) => return Ok(None),
                Err(error) => return Err(error),
            }
        }
        self.received = self.received.wrapping_add(1);
        // SAFETY: as long as an area; the peer writes it again only after our next message.
        let bytes = unsafe { std::slice::from_raw_parts(self.area(self.incoming), self.payload_bytes) };
        Ok(Some(read(bytes)))
    }

    fn word(&self, direction: usize) -> &AtomicU32 {
        // SAFETY: inside the first page, aligned, alive as long as self; both processes access it atomically.
        unsafe { AtomicU32::from_ptr(self.memory.add(WORDS[direction]).cast().as_ptr()) }
    }

    /// The start of a direction's payload area.
    fn area(&self, direction: usize) -> *mut u8 {
        let offset = PAGE + direction * area_bytes(self.payload_bytes);
        // SAFETY: inside the mapping, whose length has room for two areas.
        unsafe { self.memory.add(offset).as_ptr() }
    }
}

impl Drop for FutexPair {
    fn drop(&mut self) {
        let bytes = Self::memory_bytes(self.payload_bytes);
        // SAFETY: mapped in `open` with this length; nothing borrows it any more.
        // Ignored: it fails only for addresses that are not the mapping's.
        let _ = unsafe { munmap(self.memory.as_ptr().cast(), bytes) };
    }
}

fn area_bytes(payload_bytes: usize) -> usize {
    payload_bytes.next_multiple_of(PAGE)
}
