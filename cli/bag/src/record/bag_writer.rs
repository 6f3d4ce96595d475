// SPDX-License-Identifier: MIT OR Apache-2.0
//! The thread that writes messages from the ring to the disk.

use super::channels::Channels;
use super::observers::Announced;
use crate::ring::{HEAD_BYTES, Head};
use rtrb::Consumer;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};
use taut_cli::verb::Outcome;
use tautline_bag::{BagError, Finished, Stamp, TopicId, Writer};
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

    /// Decides by the age of the message that is written whether the disk keeps up: a kill loses everything newer.
    fn update_behind(&self, log_ns: u64) {
        let now_ns = monotonic_ns().cast_signed().saturating_add(self.offset_ns);
        let age_ns = now_ns.saturating_sub_unsigned(log_ns);
        if age_ns > BEHIND_NS {
            self.writer.set_behind(true);
        } else if age_ns < ABREAST_NS {
            self.writer.set_behind(false);
        }
    }

    /// Writes the next message. Returns `false` if there is none.
    fn write_next(&mut self) -> Result<bool, BagError> {
        let mut head = [0; HEAD_BYTES];
        let Ok(chunk) = self.consumer.read_chunk(HEAD_BYTES) else { return Ok(false) };
        let (first, second) = chunk.as_slices();
        head[..first.len()].copy_from_slice(first);
        head[first.len()..].copy_from_slice(second);
        let head = Head::from_bytes(head);
        self.update_behind(head.log_ns);
        let whole = HEAD_BYTES + head.cdr_bytes as usize;
        // The reader has not completed the message.
        let Ok(chunk) = self.consumer.read_chunk(whole) else { return Ok(false) };
        let Some(channel) = self.channels.of(&head) else { return Ok(false) };
        self.channels.write(&mut self.writer, &mut self.ids)?;
        let (topic, events) = (self.ids[channel], self.channels.events(&head));
        let (first, second) = chunk.as_slices();
        let cdr = if second.is_empty() {
            &first[HEAD_BYTES..]
        } else {
            self.scratch.clear();
            self.scratch.extend_from_slice(first);
            self.scratch.extend_from_slice(second);
            &self.scratch[HEAD_BYTES..]
        };
        let stamp =
            Stamp { sequence: head.sequence as u32, log_ns: head.log_ns, publish_ns: head.publish_ns };
        let is_written = match events.map(|events| events.written(cdr)) {
            None => self.writer.write(topic, stamp, cdr).map(|()| true),
            Some(Ok(event)) => self.writer.write(topic, stamp, &event).map(|()| true),
            // The bytes are not a request of the service. The end of the recording reports the number of missing messages.
            Some(Err(_)) => Ok(false),
        };
        self.messages += u64::from(is_written?);
        chunk.commit_all();
        Ok(true)
    }
}
