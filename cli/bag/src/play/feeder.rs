// SPDX-License-Identifier: MIT OR Apache-2.0
//! Reads the bag: checks its messages and puts them into the ring in order, as far ahead as there is room.

use super::player::{BEGIN, Control, END};
use crate::bag::placed;
use crate::ring::{HEAD_BYTES, Head, LATCHED_BYTES};
use rtrb::Producer;
use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};
use tautline_bag::{BagError, Ordered, OwnedMessage, is_compressed};
use tautline_msgs::cdr::Endian;
use tautline_msgs::split_header;
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::Gid;

/// Playing begins when this much of the bag's time has been read, or after reading for this long.
const ENOUGH: Duration = Duration::from_secs(2);
/// The interval at which the feeder checks for room in the ring.
const PERIOD: Duration = Duration::from_millis(1);

/// A topic that is played.
#[derive(Clone)]
pub struct Part {
    pub schema: Option<Arc<Schema>>,
    /// The number of messages kept for late joiners. Those from before the beginning are sent at the beginning.
    pub kept: usize,
    /// The longest body so far.
    pub largest: Arc<AtomicUsize>,
}

pub struct Feeder {
    pub bag: Ordered,
    /// The part of each topic of the bag; `None` if the topic is not played.
    pub numbers: Vec<Option<usize>>,
    pub parts: Vec<Part>,
    pub producer: Producer<u8>,
    pub control: Arc<Control>,
    /// The bag's earliest time of reception.
    pub start_ns: u64,
    /// Messages received before this time are left out.
    pub from_ns: u64,
    /// Messages received after this time are left out.
    pub to_ns: u64,
    /// The number of passes; `None` repeats the bag for ever.
    pub times: Option<u64>,
    /// The number of messages put into the ring.
    pub given: u64,
    /// The messages that publishers had kept at this time. They are read from the bag once.
    pub latched: Option<(u64, Vec<(usize, OwnedMessage)>)>,
    /// The number of leaps before the place that is read.
    pub generation: u64,
    pub fed: Fed,
    /// When filling the ring began, and the time of reception of its first message.
    pub filling: Option<(Instant, u64)>,
    /// The bag's seconds that are played in one second.
    pub rate: f64,
}

/// The result of feeding.
#[derive(Default)]
pub struct Fed {
    /// For each part: the number of messages that are not of its type or too long, and the reason for the first one.
    pub unplayable: Vec<(u64, Option<String>)>,
    /// The number of messages of topics that a damaged file does not describe.
    pub untold: u64,
    /// The number of messages that publishers had kept, and for which there was no memory.
    pub unkept: u64,
    /// The bag could not be read any further.
    pub failed: Option<BagError>,
    /// The number of damaged places in the bag, and a description of the first one.
    pub damaged: u64,
    pub damage: Option<String>,
}

/// The messages that the publishers of a topic had kept.
#[derive(Clone, Default)]
struct Latched {
    messages: VecDeque<OwnedMessage>,
    bytes: usize,
    /// The number of all messages so far, whether they are still kept or not.
    published: usize,
}

impl Latched {
    fn keep(&mut self, message: OwnedMessage, most: usize) {
        if most == 0 {
            return;
        }
        self.published += 1;
        self.bytes += message.cdr.len();
        self.messages.push_back(message);
        while self.messages.len() > most || self.bytes > LATCHED_BYTES && self.messages.len() > 1 {
            self.bytes -= self.messages.pop_front().map_or(0, |message| message.cdr.len());
        }
    }

    /// The number of messages that were left out although the publisher had kept them.
    fn missing(&self, most: usize) -> u64 {
        (self.published.min(most) - self.messages.len()) as u64
    }
}

/// Why feeding stopped.
enum Halt {
    /// The player has ended, or was stopped.
    Over,
    /// Playing continues at another place of the bag.
    Leap,
    Failed(BagError),
}

impl Feeder {
    pub fn run(mut self) -> Fed {
        self.fed.unplayable = vec![(0, None); self.parts.len()];
        let (mut from_ns, mut passes) = (self.from_ns, 0);
        self.fed.failed = loop {
            self.generation = self.control.generation.load(Ordering::Acquire);
            if self.generation > 0 {
                // The passes that were read ahead are read again.
                passes = self.control.pass.load(Ordering::Acquire);
                from_ns = self.control.seek_ns.load(Ordering::Relaxed);
            }
            let halt = loop {
                let given = match self.pass(from_ns, passes) {
                    Ok(given) => given,
                    Err(halt) => break halt,
                };
                let is_whole = from_ns == self.from_ns;
                (from_ns, passes) = (self.from_ns, passes + 1);
                if given == 0 && is_whole || self.times.is_some_and(|times| passes >= times) {
                    break self.rest();
                }
            };
            match halt {
                Halt::Leap => {}
                Halt::Over => break None,
                Halt::Failed(error) => break Some(error),
            }
        };
        self.control.is_filled.store(true, Ordering::Release);
        self.fed.damage = self.bag.damage().next().map(|(path, damage)| placed(path, &damage));
        self.fed.damaged = self.bag.damages();
        self.fed
    }

    /// Feeds the bag once, from a time of reception on, and returns the number of messages.
    fn pass(&mut self, from_ns: u64, pass: u64) -> Result<u64, Halt> {
        let given = self.given;
        let keeps = self.parts.iter().any(|part| part.kept > 0);
        let is_known = self.latched.as_ref().is_some_and(|(of_ns, _)| *of_ns == from_ns);
        // A kept message may be from any earlier time.
        self.bag.rewind(if keeps && !is_known { 0 } else { from_ns });
        let mut kept = vec![Latched::default(); self.parts.len()];
        let mut has_begun = false;
        while let Some(message) = self.bag.next_message().map_err(Halt::Failed)? {
            self.check_halt()?;
            let Some(part) = self.numbers.get(message.topic) else {
                self.fed.untold += 1;
                continue;
            };
            let Some(part) = *part else { continue };
            if message.stamp.log_ns < from_ns {
                if !is_known {
                    kept[part].keep(message, self.parts[part].kept);
                }
                continue;
            }
            if !std::mem::replace(&mut has_begun, true) {
                self.begin(&mut kept, from_ns, pass)?;
            }
            if message.stamp.log_ns > self.to_ns {
                break;
            }
            self.feed(part, &message, message.stamp.log_ns)?;
        }
        if !has_begun {
            self.begin(&mut kept, from_ns, pass)?;
        }
        Ok(self.given - given)
    }

    /// Starts the time of a pass when its first message has been read, and feeds the messages that publishers had kept then, in the
    /// order of their reception.
    fn begin(&mut self, kept: &mut [Latched], from_ns: u64, pass: u64) -> Result<(), Halt> {
        let latched = match self.latched.take() {
            Some((of_ns, latched)) if of_ns == from_ns => latched,
            _ => {
                let missing = kept.iter().zip(&self.parts).map(|(kept, part)| kept.missing(part.kept));
                self.fed.unkept += missing.sum::<u64>();
                let of_part = |(part, kept): (usize, &mut Latched)| {
                    kept.messages.drain(..).map(|message| (part, message)).collect::<Vec<_>>()
                };
                let mut all: Vec<_> = kept.iter_mut().enumerate().flat_map(of_part).collect();
                all.sort_by_key(|(_, message)| message.stamp.log_ns);
                all
            }
        };
        let begin = mark(BEGIN, from_ns.max(self.start_ns), self.generation);
        self.put(Head { publish_ns: pass, ..begin }, &[])?;
        latched.iter().try_for_each(|(part, message)| self.feed(*part, message, from_ns))?;
        self.latched = Some((from_ns, latched));
        Ok(())
    }

    fn feed(&mut self, part: usize, message: &OwnedMessage, log_ns: u64) -> Result<(), Halt> {
        let most = self.producer.buffer().capacity() - HEAD_BYTES;
        let body = body(self.parts[part].schema.as_ref(), &message.cdr).and_then(|body| match body.len() {
            len if len > most => Err(format!("a message of {len} bytes is longer than --budget")),
            _ => Ok(body),
        });
        let body = match body {
            Ok(body) => body,
            Err(why) => {
                let (count, first) = &mut self.fed.unplayable[part];
                *count += 1;
                first.get_or_insert(why);
                return Ok(());
            }
        };
        self.parts[part].largest.fetch_max(body.len(), Ordering::Relaxed);
        let head = Head {
            topic: part as u32,
            cdr_bytes: body.len() as u32,
            sequence: message.stamp.sequence.into(),
            log_ns,
            publish_ns: message.stamp.publish_ns,
            publisher: Gid::default(),
        };
        self.given += 1;
        let (since, from_ns) = *self.filling.get_or_insert((Instant::now(), log_ns));
        let ahead_ns = log_ns.saturating_sub(from_ns) as f64 / self.rate;
        if since.elapsed() > ENOUGH || ahead_ns > ENOUGH.as_nanos() as f64 {
            self.control.is_filled.store(true, Ordering::Release);
        }
        self.put(head, &body)
    }

    /// Puts a message into the ring as soon as there is room.
    fn put(&mut self, head: Head, body: &[u8]) -> Result<(), Halt> {
        while self.producer.slots() < HEAD_BYTES + body.len() {
            self.control.is_filled.store(true, Ordering::Release);
            self.check_halt()?;
            std::thread::sleep(PERIOD);
        }
        let parts: [&[u8]; 2] = [&head.to_bytes(), body];
        let is_put = parts.iter().all(|part| self.producer.push_entire_slice(part).is_ok());
        if is_put { Ok(()) } else { Err(Halt::Over) }
    }

    /// Returns the reason if feeding must not continue at this place.
    fn check_halt(&self) -> Result<(), Halt> {
        if self.control.is_stopped()
            || self.control.is_over.load(Ordering::Acquire)
            || self.producer.is_abandoned()
        {
            return Err(Halt::Over);
        }
        let is_here = self.control.generation.load(Ordering::Acquire) == self.generation;
        if is_here { Ok(()) } else { Err(Halt::Leap) }
    }

    /// Marks the end, and waits until the player has ended or continues at another place.
    fn rest(&mut self) -> Halt {
        if let Err(halt) = self.put(mark(END, 0, self.generation), &[]) {
            return halt;
        }
        self.control.is_filled.store(true, Ordering::Release);
        loop {
            match self.check_halt() {
                Ok(()) => std::thread::sleep(PERIOD),
                Err(halt) => return halt,
            }
        }
    }
}

fn mark(topic: u32, log_ns: u64, generation: u64) -> Head {
    Head { topic, cdr_bytes: 0, sequence: generation, log_ns, publish_ns: 0, publisher: Gid::default() }
}

/// The body to publish, little-endian and without padding at the end, or why the bytes are not a message of the type.
fn body<'m>(schema: Option<&Arc<Schema>>, cdr: &'m [u8]) -> Result<Cow<'m, [u8]>, String> {
    if is_compressed(cdr) {
        return Err(
            "it is compressed by itself; what `taut bag convert` makes of the bag can be played".to_owned()
        );
    }
    let (endian, body) = split_header(cdr).map_err(|fault| fault.to_string())?;
    match (schema, endian) {
        (None, Endian::Little) => Ok(body.into()),
        (None, Endian::Big) => Err("it is big-endian, and its definition is not known".to_owned()),
        (Some(schema), Endian::Little) => {
            let trailing = DynamicMessage::validate(schema, body, tautline_schema::Endian::Little)
                .map_err(|error| error.to_string())?;
            Ok(body[..body.len().saturating_sub(trailing)].into())
        }
        (Some(schema), Endian::Big) => {
            let message = DynamicMessage::from_cdr(schema, cdr).map_err(|error| error.to_string())?;
            Ok(message.to_body().into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_bag::Stamp;

    #[test]
    fn kept_messages_without_memory_are_counted() {
        let mut latched = Latched::default();
        let mut keep = |bytes: usize| {
            let (stamp, cdr) = (Stamp::default(), vec![0; bytes]);
            latched.keep(OwnedMessage { topic: 0, stamp, cdr }, 3);
            (latched.messages.len(), latched.missing(3))
        };
        let long = LATCHED_BYTES / 2;
        assert_eq!([10, 10, 10, 10].map(&mut keep), [(1, 0), (2, 0), (3, 0), (3, 0)]);
        assert_eq!([long, long, long].map(&mut keep), [(3, 0), (2, 1), (2, 1)]);
        // The last one stays, however long it is.
        assert_eq!(keep(LATCHED_BYTES + 1), (1, 2));
        assert_eq!([10, 10, 10].map(keep), [(1, 2), (2, 1), (3, 0)]);
    }
}
