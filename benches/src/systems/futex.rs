// SPDX-License-Identifier: MIT OR Apache-2.0
//! The floors: one futex wake each way or for each message, and a copy of the payload within a process.

use std::fs::File;
use std::hint::black_box;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tautline_exchange::{
    FutexPair, FutexRing, Job, Line, Link, Measured, Result, Role, Sink, Source, Stamp, play, say, stop_flag,
};
use tautline_rt::clock::monotonic_ns;

use super::LOOK;

/// At least as many bytes are copied between two looks at the clock.
const COPIED_BYTES: usize = 256 << 10;

/// Runs one end of round trips; the job's endpoint is the file of the shared memory.
pub fn run(job: &Job) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    job.as_application(move || {
        let (whole, streaming) = (own.way.whole, own.way.mode == "streaming");
        // One that both touch on the same core is in its caches.
        let in_turn = own.way.mode == "futex";
        let pair = FutexPair::open(memory(&own)?, own.role, own.payload_bytes, in_turn)?;
        let mut end = End { pair, whole, streaming };
        play(&own, &mut end, &stop, own.endpoint.clone())
    })
}

fn memory(job: &Job) -> Result<File> {
    let path = job.endpoint.as_deref().ok_or("no file for the shared memory")?;
    Ok(File::options().read(true).write(true).open(path)?)
}

/// Runs one end of a flow, all of whose topics go through one ring.
pub fn flow(job: &Job) -> Result<()> {
    let (own, flag) = (job.clone(), stop_flag());
    job.as_application(move || {
        let mut ring = FutexRing::open(memory(&own)?, own.payload_bytes)?;
        let whole = own.way.whole;
        if own.role == Role::Near {
            return Source::play(&own, flag, |topic, stamp| {
                Ok(ring.send(topic, |out| stamp.write_uninit(out, whole))?)
            });
        }
        let sink = Sink::new(&own);
        let inlets = sink.inlets(&own);
        say(&Line::Ready(own.endpoint.clone()));
        while !flag.load(Ordering::Relaxed) {
            let Some((topic, stamp)) = ring.receive(LOOK, |bytes| Stamp::read(bytes, whole))? else {
                continue;
            };
            let stamp = stamp?;
            inlets.iter().filter(|(of, _)| *of == topic).for_each(|(_, inlet)| inlet.arrive(stamp));
        }
        say(&Line::Measured(sink.measured()));
        Ok(())
    })
}

struct End {
    pair: FutexPair,
    whole: bool,
    /// The payload is written with non-temporal stores.
    streaming: bool,
}

impl Link for End {
    fn send(&mut self, number: u64) -> Result<()> {
        let stamp = Stamp { number, sent_ns: monotonic_ns() };
        Ok(self.pair.send(|out| match self.streaming {
            true => stamp.write_streaming(out),
            false => stamp.write_uninit(out, self.whole),
        })?)
    }

    fn receive(&mut self, patience: Duration) -> Result<Option<u64>> {
        let stamp = self.pair.receive(patience, |bytes| Stamp::read(bytes, self.whole))?;
        Ok(stamp.transpose()?.map(|stamp| stamp.number))
    }
}

/// How long a copy of the payload takes.
pub fn copy(job: &Job) -> Result<()> {
    let own = job.clone();
    job.as_application(move || {
        say(&Line::Measured(copies(&own)));
        Ok(())
    })
}

fn copies(job: &Job) -> Measured {
    let (from, mut to) = (vec![1_u8; job.payload_bytes], vec![2_u8; job.payload_bytes]);
    // Enough of them that the clock costs nothing.
    let copies = (COPIED_BYTES / job.payload_bytes).max(1) as u64;
    let mut measured = Measured::default();
    let start_ns = monotonic_ns();
    let mut now = start_ns;
    while now - start_ns < job.budget.as_nanos() as u64 {
        for _ in 0..copies {
            to.copy_from_slice(black_box(&from));
            black_box(&mut to);
        }
        let before = std::mem::replace(&mut now, monotonic_ns());
        measured.times_ns.push((now - before) / copies);
    }
    measured
}
