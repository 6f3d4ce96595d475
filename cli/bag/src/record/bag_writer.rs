// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that writes messages from the ring to the disk.

use super::channels::Channels;
use super::observers::Announced;
use crate::ring::{HEAD_BYTES, Ring, oldest};
use rtrb::Consumer;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};
use taut_cli::verb::Outcome;
use tautline_bag::{BagError, Finished, TopicId, Writer};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::{Policy, ThreadBuilder};

/// The interval between flushes. A kill loses what was written since the last one.
const FLUSH: Duration = Duration::from_millis(500);
/// The age of a message that is being written: above the first the disk is behind, below the second it keeps up again.
const BEHIND_NS: i64 = 250_000_000;
const ABREAST_NS: i64 = 50_000_000;
/// The interval at which the writer checks for messages.
const PERIOD: Duration = Duration::from_millis(10);

pub struct BagWriter {
    statement: Sender<BTreeMap<String, String>>,
    thread: tautline_rt::JoinHandle<Written>,
}

/// The result of the writer.
pub struct Written {
    pub finished: Result<Finished, BagError>,
    /// The error after which nothing more was written.
    pub failed: Option<BagError>,
    pub messages: u64,
    /// The longest time that a write took.
    pub stall: Duration,
}

impl BagWriter {
    pub fn start(
        writer: Writer,
        consumer: Consumer<u8>,
        announced: Receiver<Announced>,
        is_over: Arc<AtomicBool>,
        offset_ns: i64,
    ) -> Outcome<Self> {
        let (statement, stated) = channel();
        let thread = ThreadBuilder::new("bag-writer").policy(Policy::Other { nice: 0 });
        let channels = Channels::new(announced);
        let (ids, scratch) = (Vec::new(), Vec::new());
        let work = Work { writer, consumer, channels, ids, scratch, messages: 0, offset_ns };
        let thread = thread.spawn(move || move || work.run(&is_over, &stated))?;
        Ok(BagWriter { statement, thread })
    }

    /// Writes the rest of the ring, and then the statement. The reader must have ended.
    pub fn finish(self, statement: BTreeMap<String, String>) -> Outcome<Written> {
        // If the thread has ended before, its result has the reason.
        let _ = self.statement.send(statement);
        Ok(self.thread.join()?)
    }
}

struct Work {
    writer: Writer,
    consumer: Consumer<u8>,
    channels: Channels,
    ids: Vec<TopicId>,
    /// The copy of a message that wraps around the ring's end.
    scratch: Vec<u8>,
    messages: u64,
    /// From `CLOCK_MONOTONIC` to times of reception.
    offset_ns: i64,
}

impl Work {
    fn run(mut self, is_over: &AtomicBool, stated: &Receiver<BTreeMap<String, String>>) -> Written {
        let (mut flushed, mut stall) = (Instant::now(), Duration::ZERO);
        let failed = loop {
            let start = Instant::now();
            let written = self.write_next().and_then(|is_more| {
                // A silent topic is in the bag, too.
                self.channels.refresh();
                self.channels.write(&mut self.writer, &mut self.ids)?;
                if flushed.elapsed() >= FLUSH {
                    flushed = Instant::now();
                    self.writer.flush()?;
                }
                Ok(is_more)
            });
            stall = stall.max(start.elapsed());
            match written {
                Err(error) => break Some(error),
                Ok(true) => {}
                // The reader has ended.
                Ok(false) if crate::ring::has_ended(&self.consumer) && self.consumer.is_empty() => {
                    break None;
                }
                Ok(false) => std::thread::sleep(PERIOD),
            }
        };
        let Work { writer, consumer, messages, .. } = self;
        // The reader must not wait for room in the ring.
        drop(consumer);
        is_over.store(true, Ordering::Release);
        let finished = match &failed {
            None | Some(BagError::Full { .. }) => writer.finish(stated.recv().unwrap_or_default()),
            Some(_) => Ok(Finished { files: Vec::new(), removed: 0 }),
        };
        Written { finished, failed, messages, stall }
    }

    /// Writes the next message. Returns `false` if there is none.
    fn write_next(&mut self) -> Result<bool, BagError> {
        let Some((head, chunk)) = oldest(&mut self.consumer) else { return Ok(false) };
        // A kill loses everything newer than the message that is written.
        let now_ns = monotonic_ns().cast_signed().saturating_add(self.offset_ns);
        let age_ns = now_ns.saturating_sub_unsigned(head.log_ns);
        if !(ABREAST_NS..=BEHIND_NS).contains(&age_ns) {
            self.writer.set_behind(age_ns > BEHIND_NS);
        }
        let cdr = Ring::of(&chunk).bytes(HEAD_BYTES, head.cdr_bytes as usize, &mut self.scratch);
        let written = self.channels.write_message(&mut self.writer, &mut self.ids, &head, cdr)?;
        let Some(is_written) = written else { return Ok(false) };
        // The end of the recording reports the number of missing messages.
        self.messages += u64::from(is_written);
        chunk.commit_all();
        Ok(true)
    }
}
