// SPDX-License-Identifier: MIT OR Apache-2.0
//! Takes messages: polls every topic once in a period, and copies its messages into the ring.
//!
//! # Real-time
//! The thread runs at SCHED_FIFO 1, where that is permitted: below all callbacks. It allocates only for a new publisher or topic, and
//! waits for no other thread while it records. A message for which the ring has no room stays in the observer's queue.

use super::event::Part;
use super::observers::{Counts, Observer};
use crate::ring::{HEAD_BYTES, Head};
use rtrb::Producer;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use tautline_bag::MOST_BYTES;
use tautline_rt::clock::{monotonic_ns, sleep_until_monotonic, wall_ns};
use tautline_transport::{Gid, RawSample, RawSubscription, TakeError};

/// The most messages of a topic in one poll, so that other topics get their turn.
const MOST_AT_ONCE: usize = 4096;
/// The clock is read once for this number of topics without messages.
const AT_A_TIME: usize = 32;
/// The longest time between two checks whether the recording has ended.
const LONGEST_SLEEP_NS: u64 = 100_000_000;
/// How long the end of a recording waits for the disk.
const PATIENCE_NS: u64 = 30_000_000_000;

/// The polling period, and whether recording is paused.
pub struct Pace {
    pub period_ns: u64,
    pub is_paused: Arc<AtomicBool>,
}

pub struct Reader {
    producer: Producer<u8>,
    new_observers: Receiver<Observer>,
    pace: Pace,
    stop: Arc<AtomicBool>,
    places: Vec<Place>,
    /// From `CLOCK_MONOTONIC` to the times in the bag.
    offset_ns: i64,
    began_ns: u64,
    /// The time from which messages are recorded: the beginning, or the end of the last pause.
    since_ns: u64,
    /// Messages that are published later are not recorded.
    until_ns: u64,
    waited: u64,
}

/// The statistics of a topic's messages.
#[derive(Clone, Debug, Default)]
pub struct Taken {
    pub messages: u64,
    pub bytes: u64,
    /// Messages overwritten in the queue, counted by gaps in the publishers' numbers.
    pub lost: u64,
    /// Messages that are longer than the ring, or than a message of a bag may be.
    pub oversized: u64,
    /// Messages left out by `--throttle`.
    pub throttled: u64,
    pub paused: u64,
    /// The longest time between two polls.
    pub stall_ns: u64,
    pub ports: Vec<Port>,
}

#[derive(Clone, Copy, Debug)]
pub struct Port {
    pub gid: Gid,
    /// The number of its first message that was taken.
    pub first: u64,
    /// The number of its last message that was taken.
    last: u64,
    /// The most messages that it sent in one second.
    pub peak: u64,
    second_ns: u64,
    in_second: u64,
}

/// The result of the reader.
pub struct Harvest {
    pub topics: Vec<Taken>,
    /// The number of polls that found no room in the ring.
    pub waited: u64,
    pub began_ns: u64,
    pub ended_ns: u64,
}

struct Place {
    part: Part,
    subscription: RawSubscription,
    throttle_ns: Option<u64>,
    due_ns: u64,
    counts: Arc<Counts>,
    /// A message that was taken, and for which the ring has no room.
    held: Option<RawSample>,
    looked_ns: u64,
    /// The subscription is for the time after a pause, which has not ended yet.
    is_renewed: bool,
    /// Messages that former subscriptions lost.
    lost_before: u64,
    /// Former subscriptions that still have messages.
    former: Vec<RawSubscription>,
    taken: Taken,
}

impl Reader {
    pub fn new(
        producer: Producer<u8>,
        new_observers: Receiver<Observer>,
        pace: Pace,
        stop: Arc<AtomicBool>,
    ) -> Self {
        let began_ns = monotonic_ns();
        let offset_ns = wall_ns() - began_ns.cast_signed();
        Reader {
            producer,
            new_observers,
            pace,
            stop,
            places: Vec::new(),
            offset_ns,
            began_ns,
            since_ns: began_ns,
            until_ns: u64::MAX,
            waited: 0,
        }
    }

    /// From `CLOCK_MONOTONIC` to times of reception.
    pub fn offset_ns(&self) -> i64 {
        self.offset_ns
    }

    pub fn run(mut self) -> Harvest {
        let (mut next_ns, mut is_paused) = (self.began_ns, false);
        loop {
            let is_last = self.stop.load(Ordering::Acquire);
            // Read before the observers that are sent at the end of a pause.
            let was_paused = std::mem::replace(&mut is_paused, self.pace.is_paused.load(Ordering::Acquire));
            self.admit();
            let looked_ns = monotonic_ns();
            if was_paused && !is_paused {
                self.since_ns = looked_ns;
            }
            self.take_waiting(is_paused);
            if is_last {
                break;
            }
            // The thread uses half of a core at most, however many topics there are.
            let now_ns = monotonic_ns();
            next_ns = next_ns.saturating_add(self.pace.period_ns).max(now_ns + (now_ns - looked_ns));
            self.sleep_until(next_ns);
        }
        self.drain(is_paused);
        let topics =
            self.places.into_iter().map(|place| Taken { lost: place.lost(), ..place.taken }).collect();
        Harvest { topics, waited: self.waited, began_ns: self.began_ns, ended_ns: monotonic_ns() }
    }

    /// Sleeps in slices, so that a long period does not delay the end.
    fn sleep_until(&self, ns: u64) {
        while !self.stop.load(Ordering::Relaxed) && monotonic_ns() < ns {
            sleep_until_monotonic(ns.min(monotonic_ns() + LONGEST_SLEEP_NS));
        }
    }

    /// Takes the messages that were sent before the end, as the ring gets room for them. Messages for which it gets none are lost.
    fn drain(&mut self, is_paused: bool) {
        let ended_ns = monotonic_ns();
        self.until_ns = ended_ns;
        for place in &mut self.places {
            place.looked_ns = u64::MAX;
        }
        while !self.producer.is_abandoned() && monotonic_ns() - ended_ns < PATIENCE_NS {
            let waited = self.waited;
            let took = self.take_waiting(is_paused);
            if self.waited != waited {
                sleep_until_monotonic(monotonic_ns() + self.pace.period_ns.min(LONGEST_SLEEP_NS));
            } else if !took {
                return;
            }
        }
        for place in &mut self.places {
            while place.next(ended_ns).is_some() {
                place.taken.lost += 1;
            }
        }
    }

    fn admit(&mut self) {
        while let Ok(observer) = self.new_observers.try_recv() {
            let Observer { number, part, subscription, throttle_ns, counts, is_renewed } = observer;
            match self.places.get_mut(number) {
                Some(place) if is_renewed => {
                    let former = std::mem::replace(&mut place.subscription, subscription);
                    for sample in std::iter::from_fn(|| take(&former)).take(MOST_AT_ONCE) {
                        place.port_of(&sample);
                        place.taken.paused += 1;
                    }
                    place.lost_before += former.counters().lost();
                    place.is_renewed = true;
                }
                Some(place) => {
                    // The messages left in the former subscription are taken first.
                    place.former.push(std::mem::replace(&mut place.subscription, subscription));
                }
                None => self.places.push(Place {
                    part,
                    subscription,
                    throttle_ns,
                    due_ns: 0,
                    counts,
                    held: None,
                    looked_ns: u64::MAX,
                    is_renewed: false,
                    lost_before: 0,
                    former: Vec::new(),
                    taken: Taken::default(),
                }),
            }
        }
    }

    /// Takes the messages that wait in each observer, in turn. Returns whether there were any.
    fn take_waiting(&mut self, is_paused: bool) -> bool {
        let (mut took, until_ns) = (false, self.until_ns);
        let mut now_ns = monotonic_ns();
        for (number, place) in self.places.iter_mut().enumerate() {
            if number % AT_A_TIME == 0 {
                now_ns = monotonic_ns();
            }
            place.taken.stall_ns = place.taken.stall_ns.max(now_ns.saturating_sub(place.looked_ns));
            if place.looked_ns != u64::MAX || !self.stop.load(Ordering::Relaxed) {
                place.looked_ns = now_ns;
            }
            place.is_renewed &= is_paused;
            if place.is_renewed || place.is_empty() {
                continue;
            }
            now_ns = monotonic_ns();
            for _ in 0..MOST_AT_ONCE {
                // A message that waited for room was wanted.
                let is_wanted = place.held.is_some();
                let Some(sample) = place.next(until_ns) else { break };
                took = true;
                place.port_of(&sample);
                if !is_wanted && !place.wants(&sample, is_paused) {
                    continue;
                }
                let (front, front_bytes) = place.part.front(&sample.info());
                let front = &front[..front_bytes];
                let whole = HEAD_BYTES + 4 + front.len() + sample.body().len();
                if whole > self.producer.buffer().capacity().min(MOST_BYTES) {
                    place.taken.oversized += 1;
                    continue;
                }
                let (released_ns, since_ns) = (sample.info().released_ns, self.since_ns);
                // A message that was kept for late joiners arrived when this recorder joined.
                let received_ns = released_ns.max(since_ns).min(now_ns.max(since_ns));
                let log_ns = received_ns.cast_signed().saturating_add(self.offset_ns).max(0).cast_unsigned();
                if copy(&mut self.producer, number, log_ns, front, &sample) {
                    place.note(&sample);
                } else {
                    place.held = Some(sample);
                    self.waited += 1;
                    break;
                }
            }
            place.counts.lost.store(place.lost(), Ordering::Relaxed);
        }
        took
    }
}

/// Copies a message into the ring, once. Returns `false` if there is no room.
fn copy(producer: &mut Producer<u8>, number: usize, log_ns: u64, front: &[u8], sample: &RawSample) -> bool {
    let (body, info) = (sample.body(), sample.info());
    let head = Head {
        topic: number as u32,
        cdr_bytes: (4 + front.len() + body.len()) as u32,
        sequence: info.sequence_number,
        log_ns,
        publish_ns: info.source_timestamp_ns.max(0).cast_unsigned(),
        publisher: info.publisher_gid,
    };
    if producer.slots() < HEAD_BYTES + 4 + front.len() + body.len() {
        return false;
    }
    // This succeeds, because there is room for all parts.
    let parts: [&[u8]; 4] = [&head.to_bytes(), &tautline_msgs::HEADER, front, body];
    parts.iter().all(|part| producer.push_entire_slice(part).is_ok())
}

fn take(subscription: &RawSubscription) -> Option<RawSample> {
    loop {
        match subscription.try_take() {
            // A server states that there will be no response.
            Ok(Some(taken)) if !taken.is_message() => {}
            Ok(taken) => return taken,
            // The subscription counts it.
            Err(TakeError::Invalid(_)) => {}
            Err(TakeError::TooManyHeld) => return None,
        }
    }
}

impl Place {
    fn lost(&self) -> u64 {
        let former: u64 = self.former.iter().map(|former| former.counters().lost()).sum();
        self.lost_before + former + self.subscription.counters().lost() + self.taken.lost
    }

    fn is_empty(&self) -> bool {
        self.held.is_none() && self.former.is_empty() && !self.subscription.has_samples()
    }

    /// The next message that was released by then.
    fn next(&mut self, until_ns: u64) -> Option<RawSample> {
        if let Some(held) = self.held.take() {
            return Some(held);
        }
        while let Some(former) = self.former.first() {
            if let Some(sample) = take(former) {
                return Some(sample);
            }
            self.lost_before += former.counters().lost();
            self.former.remove(0);
        }
        // A message may be in the queues of both subscriptions.
        let is_known = |ports: &[Port], sample: &RawSample| {
            let of = ports.iter().find(|port| port.gid == sample.port_gid());
            of.is_some_and(|port| port.last >= sample.port_sequence_number())
        };
        for _ in 0..MOST_AT_ONCE {
            let sample = take(&self.subscription)?;
            // An earlier message of another publisher may be queued behind this one.
            if sample.info().released_ns > until_ns {
                continue;
            }
            if self.part != Part::Message || !is_known(&self.taken.ports, &sample) {
                return Some(sample);
            }
        }
        None
    }

    fn wants(&mut self, sample: &RawSample, is_paused: bool) -> bool {
        if is_paused {
            self.taken.paused += 1;
            return false;
        }
        let Some(interval_ns) = self.throttle_ns else { return true };
        let released_ns = sample.info().released_ns;
        if released_ns < self.due_ns {
            self.taken.throttled += 1;
            return false;
        }
        // The grid keeps the rate where the publisher's period does not divide the interval.
        self.due_ns = match released_ns - self.due_ns {
            late if late < interval_ns => self.due_ns + interval_ns,
            _ => released_ns + interval_ns,
        };
        true
    }

    fn note(&mut self, sample: &RawSample) {
        let bytes = sample.body().len() as u64 + 4;
        self.taken.messages += 1;
        self.taken.bytes += bytes;
        self.counts.messages.store(self.taken.messages, Ordering::Relaxed);
        self.counts.bytes.store(self.taken.bytes, Ordering::Relaxed);
        let released_ns = sample.info().released_ns;
        let port = self.port_of(sample);
        if released_ns.saturating_sub(port.second_ns) >= 1_000_000_000 {
            (port.second_ns, port.in_second) = (released_ns, 0);
        }
        port.last = sample.port_sequence_number();
        port.in_second += 1;
        port.peak = port.peak.max(port.in_second);
    }

    /// The port that sent a message. Its first one may be left out of the bag: it was not missed.
    fn port_of(&mut self, sample: &RawSample) -> &mut Port {
        let (gid, first) = (sample.port_gid(), sample.port_sequence_number());
        let ports = &mut self.taken.ports;
        let at = ports.iter().position(|port| port.gid == gid).unwrap_or_else(|| {
            let second_ns = sample.info().released_ns;
            ports.push(Port { gid, first, last: 0, peak: 0, second_ns, in_second: 0 });
            ports.len() - 1
        });
        &mut ports[at]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rtrb::RingBuffer;
    use std::sync::mpsc::channel;
    use tautline_transport::{Limits, Participant, Qos, TopicType};

    #[test]
    fn a_throttled_message_that_waited_for_room_is_kept() {
        tautline_rt::domain::test_scope("test");
        let participant = Participant::new(147).unwrap();
        let topic_type = TopicType::new("demo_msgs/msg/Bytes");
        let (qos, limits) = (Qos::keep_last(4), Limits { held: 1, ..Limits::default() });
        let publisher = participant.create_raw_publisher("/thinned", &topic_type, qos, limits).unwrap();
        let subscription = participant.create_observer("/thinned", &topic_type, 4, limits).unwrap();
        let (to_reader, new_observers) = channel();
        let (part, throttle_ns) = (Part::Message, Some(1_000_000_000_000_000));
        let counts = Arc::default();
        let observer = Observer { number: 0, part, subscription, throttle_ns, counts, is_renewed: false };
        assert!(to_reader.send(observer).is_ok());
        let (mut producer, mut consumer) = RingBuffer::<u8>::new(1 << 16);
        producer.push_entire_slice(&[0; 1 << 16]).unwrap();
        let pace = Pace { period_ns: 1_000_000, is_paused: Arc::default() };
        let mut reader = Reader::new(producer, new_observers, pace, Arc::default());
        reader.admit();
        publisher.publish(&[1; 64]).unwrap();
        assert!(reader.take_waiting(false));
        assert_eq!((reader.waited, reader.places[0].taken.messages), (1, 0), "the ring is full");
        consumer.read_chunk(1 << 16).unwrap().commit_all();
        publisher.publish(&[2; 64]).unwrap();
        assert!(reader.take_waiting(false));
        let taken = &reader.places[0].taken;
        assert_eq!((taken.messages, taken.throttled), (1, 1));
    }
}
