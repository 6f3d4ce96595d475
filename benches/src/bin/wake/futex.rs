// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floor: one futex wake each way and nothing else. The parent hands both processes the same memory as standard input.

use std::fs::File;
use std::io::stdin;
use std::os::fd::OwnedFd;

use rustix::fs::{MemfdFlags, memfd_create};
use tautline_exchange::FutexPair;

use crate::Result;
use crate::child::{Link, Received, WAIT};
use crate::payload;
use crate::plan::{Job, Payload, Role};

/// Anonymous memory for a pair, as a file.
pub fn memory(payload: Payload) -> Result<OwnedFd> {
    let file = File::from(memfd_create("wake", MemfdFlags::CLOEXEC)?);
    file.set_len(FutexPair::memory_bytes(payload.bytes) as u64)?;
    Ok(file.into())
}

/// Runs `body` with one end of the link.
pub fn run(job: &Job, body: impl FnOnce(&mut dyn Link) -> Result<()>) -> Result<()> {
    let role = match job.role {
        Role::Ping => tautline_exchange::Role::Near,
        Role::Pong => tautline_exchange::Role::Far,
    };
    let pair = FutexPair::open(stdin(), role, job.payload.bytes)?;
    body(&mut FutexLink { pair, payload: job.payload })
}

struct FutexLink {
    pair: FutexPair,
    payload: Payload,
}

impl Link for FutexLink {
    fn send(&mut self, number: u64) -> Result<()> {
        Ok(self.pair.send(|out| payload::write(out, self.payload, number))?)
    }

    fn receive(&mut self) -> Result<Option<Received>> {
        let read = |bytes: &[u8]| payload::read(bytes, self.payload);
        let Some(number) = self.pair.receive(WAIT, read)? else { return Ok(None) };
        Ok(Some(Received { number: number?, late: false }))
    }
}
