// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floor: one futex wake each way and nothing else.
//!
//! The parent hands both processes the same memory as standard input: a page with two words that count the messages of
//! either direction, then a payload area for each.

use std::fs::File;
use std::io::stdin;
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::fs::{MemfdFlags, memfd_create};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::thread::futex::{self, Flags, Timespec};

use crate::Result;
use crate::child::{Link, Received, WAIT};
use crate::payload;
use crate::plan::{Job, Payload, Role};

const PAGE: usize = 4096;
/// Apart from each other by more than the lines that processors fetch together.
const WORDS: [usize; 2] = [0, 1024];

/// Anonymous memory for a pair, as a file.
pub fn memory(payload: Payload) -> Result<OwnedFd> {
    let file = File::from(memfd_create("wake", MemfdFlags::CLOEXEC)?);
    file.set_len(memory_len(payload) as u64)?;
    Ok(file.into())
}

/// Runs `body` with one end of the link.
pub fn run(job: &Job, body: impl FnOnce(&mut dyn Link) -> Result<()>) -> Result<()> {
    body(&mut FutexLink::open(job)?)
}

struct FutexLink {
    memory: NonNull<u8>,
    payload: Payload,
    /// Indices of the directions in `WORDS` and of the payload areas.
    outgoing: usize,
    incoming: usize,
    /// Messages received, modulo 2^32.
    received: u32,
}

impl FutexLink {
    fn open(job: &Job) -> Result<Self> {
        let (outgoing, incoming) = if job.role == Role::Ping { (0, 1) } else { (1, 0) };
        let stdin = stdin();
        let (access, share) = (ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED);
        // SAFETY: a new mapping at an address of the kernel's choice, of a file as long as the parent made it.
        let memory =
            unsafe { mmap(ptr::null_mut(), memory_len(job.payload), access, share, stdin.as_fd(), 0)? };
        let memory = NonNull::new(memory.cast()).ok_or("mmap returned null")?;
        Ok(Self { memory, payload: job.payload, outgoing, incoming, received: 0 })
    }

    fn word(&self, direction: usize) -> &AtomicU32 {
        // SAFETY: inside the first page, aligned, alive as long as self; both processes access it atomically.
        unsafe { AtomicU32::from_ptr(self.memory.add(WORDS[direction]).cast().as_ptr()) }
    }

    /// The start of a direction's payload area.
    fn area(&self, direction: usize) -> *mut u8 {
        let offset = PAGE + direction * area_len(self.payload);
        // SAFETY: inside the mapping, whose length has room for two areas.
        unsafe { self.memory.add(offset).as_ptr() }
    }
}

impl Link for FutexLink {
    fn send(&mut self, number: u64) -> Result<()> {
        // SAFETY: as long as an area; the peer reads it only between the wake below and its own next message.
        let out = unsafe {
            std::slice::from_raw_parts_mut(
                self.area(self.outgoing).cast::<MaybeUninit<u8>>(),
                self.payload.bytes,
            )
        };
        payload::write(out, self.payload, number);
        let word = self.word(self.outgoing);
        // Release: the payload is written; pairs with the Acquire in `receive`.
        word.fetch_add(1, Ordering::Release);
        futex::wake(word, Flags::empty(), 1)?;
        Ok(())
    }

    fn receive(&mut self) -> Result<Option<Received>> {
        let word = self.word(self.incoming);
        let timeout = Timespec { tv_sec: 0, tv_nsec: WAIT.subsec_nanos().into() };
        // Acquire: the payload can be read; pairs with the Release in `send`.
        while word.load(Ordering::Acquire) == self.received {
            match futex::wait(word, Flags::empty(), self.received, Some(&timeout)) {
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                Err(Errno::TIMEDOUT) => return Ok(None),
                Err(error) => return Err(error.into()),
            }
        }
        self.received = self.received.wrapping_add(1);
        // SAFETY: as long as an area; the peer writes it again only after our next message.
        let bytes = unsafe { std::slice::from_raw_parts(self.area(self.incoming), self.payload.bytes) };
        Ok(Some(Received { number: payload::read(bytes, self.payload)?, late: false }))
    }
}

impl Drop for FutexLink {
    fn drop(&mut self) {
        // SAFETY: mapped in `open` with this length; nothing borrows it any more.
        // Ignored: it fails only for addresses that are not the mapping's.
        let _ = unsafe { munmap(self.memory.as_ptr().cast(), memory_len(self.payload)) };
    }
}

fn area_len(payload: Payload) -> usize {
    payload.bytes.next_multiple_of(PAGE)
}

fn memory_len(payload: Payload) -> usize {
    PAGE + 2 * area_len(payload)
}
