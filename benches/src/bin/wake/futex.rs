// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floor: one futex wake each way and nothing else. Both processes map a file of the parent.

use std::fs::File;
use std::path::PathBuf;

use tautline_exchange::FutexPair;

use crate::Result;
use crate::child::{Link, Received, WAIT};
use crate::payload;
use crate::plan::{Job, Payload, Role};

/// Makes the memory of a pair.
pub fn make_memory(job: &Job) -> Result<()> {
    let file = File::create(memory(job))?;
    Ok(file.set_len(FutexPair::memory_bytes(job.payload.bytes) as u64)?)
}

fn memory(job: &Job) -> PathBuf {
    PathBuf::from("/dev/shm").join(format!("{}futex", job.prefix))
}

/// Runs `body` with one end of the link.
pub fn run(job: &Job, body: impl FnOnce(&mut dyn Link) -> Result<()>) -> Result<()> {
    let role = match job.role {
        Role::Ping => tautline_exchange::Role::Near,
        Role::Pong => tautline_exchange::Role::Far,
    };
    let file = File::options().read(true).write(true).open(memory(job))?;
    let pair = FutexPair::open(file, role, job.payload.bytes)?;
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
