// SPDX-License-Identifier: MIT OR Apache-2.0
//! The path of a topic's incoming messages: from which publishers, of which type, through which port of the domain.

use crate::limiter::Limiter;
use crate::route::EarlyLimits;
use crate::stats::{Numbers, TopicCounters};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_rt::clock::{monotonic_ns, nanoseconds, wall_ns};
use tautline_schema::{DynamicMessage, Endian, Schema};
use tautline_transport::{Gid, LoanError, MemoryClaimer, MessageInfo, PublishError, RawPublisher};

/// Fast CDR appends up to this many bytes after the last field.
const TRAILING_BYTES: usize = 8;

/// The port for incoming messages.
pub enum IngressPort {
    None,
    /// The existing port of the key, with its samples for late joiners.
    Same,
    New(Box<RawPublisher>),
}

/// The publishers whose messages an ingress forwards, and other known publishers, whose messages arrive by another path.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Senders {
    /// Publishers whose messages are forwarded, each with its lifespan.
    wanted: BTreeMap<Gid, Option<Duration>>,
    others: BTreeSet<Gid>,
}

/// The role of a message's publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SenderRole {
    Wanted(Option<Duration>),
    Other,
    /// Not known yet: its messages are held or forwarded, see [`Delivery::early`].
    Unknown,
}

impl Senders {
    /// Of all `known` publishers of the topic, messages of `publishers` (each with its lifespan) are forwarded. Without a port they are
    /// treated as messages of unknown publishers.
    pub fn of(known: &BTreeSet<Gid>, publishers: &BTreeMap<Gid, Option<Duration>>, has_port: bool) -> Self {
        Senders {
            wanted: if has_port { publishers.clone() } else { BTreeMap::new() },
            others: known.iter().filter(|gid| !publishers.contains_key(gid)).copied().collect(),
        }
    }

    fn find(&self, gid: &Gid) -> SenderRole {
        match self.wanted.get(gid) {
            Some(lifespan) => SenderRole::Wanted(*lifespan),
            None if self.others.contains(gid) => SenderRole::Other,
            None => SenderRole::Unknown,
        }
    }
}

/// A message's bytes without encapsulation, in one or more slices.
pub trait Body {
    /// Number of bytes.
    fn len_bytes(&self) -> usize;
    /// All bytes, if they are one slice.
    fn whole(&self) -> Option<&[u8]>;
    /// Copies the first bytes, as many as `to` holds; the rest of `to` becomes zero.
    fn copy_to(&self, to: &mut [u8]);
}

impl Body for [u8] {
    fn len_bytes(&self) -> usize {
        self.len()
    }

    fn whole(&self) -> Option<&[u8]> {
        Some(self)
    }

    fn copy_to(&self, to: &mut [u8]) {
        let len = to.len().min(self.len());
        tautline_rt::copy_to_shared(&mut to[..len], &self[..len]);
        to[len..].fill(0);
    }
}

/// Metadata of a message from the far side.
#[derive(Clone, Copy, Debug)]
pub struct MessageMeta {
    /// Its publisher.
    pub publisher: Gid,
    /// Its sequence number, if known.
    pub number: Option<u64>,
    /// Whether a gap in the sequence numbers is a loss.
    pub are_numbers_whole: bool,
    /// Source time stamp, since 1970.
    pub timestamp_ns: i64,
}

/// Why a message from the far side was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The message came sooner than the rate limit permits.
    #[error("rate limit")]
    Rate,
    /// Its publisher was not discovered in time, or too many such messages were held.
    #[error("publisher not known yet")]
    Unknown,
    /// The message is older than its publisher's lifespan, by the clocks of both hosts.
    #[error("older than its publisher's lifespan")]
    Expired,
    /// The length differs from that of its fixed-size type.
    #[error("length differs from the type's")]
    Length,
    /// Its content is not valid for its type.
    #[error("not a message of its type")]
    Invalid,
    /// Shared memory is exhausted.
    #[error(transparent)]
    Loan(#[from] LoanError),
    /// Publishing failed.
    #[error("{0}")]
    Publish(PublishError),
}

/// A message of an unknown publisher.
struct Early {
    body: Vec<u8>,
    source: MessageMeta,
    since: Instant,
}

/// The path on which messages of a topic, or of a class of its publishers, enter the domain.
pub struct Ingress {
    port: IngressPort,
    /// `None`: the definition is not known.
    schema: Option<Arc<Schema>>,
    counters: Arc<TopicCounters>,
    limiter: Limiter,
    senders: Senders,
    numbers: Numbers,
    early: Vec<Early>,
    early_bytes: usize,
    delivery: Delivery,
}

/// How messages arrive at an ingress.
#[derive(Clone, Copy, Debug)]
pub struct Delivery {
    /// How many messages of unknown publishers are held; `None`: they are forwarded.
    pub early: Option<EarlyLimits>,
    /// Whether a publisher's messages arrive in order, so that an earlier sequence number is a duplicate.
    pub is_ordered: bool,
}

impl Ingress {
    /// A new ingress.
    pub fn new(
        port: IngressPort,
        schema: Option<Arc<Schema>>,
        counters: Arc<TopicCounters>,
        limiter: Limiter,
        senders: Senders,
        delivery: Delivery,
    ) -> Self {
        let (numbers, early, early_bytes) = Default::default();
        Ingress { port, schema, counters, limiter, senders, numbers, early, early_bytes, delivery }
    }

    /// Continues where `old` ended: sequence numbers reveal duplicates. But samples that a new port must keep for late joiners
    /// (`is_kept`) have to pass through it, so existing subscriptions get them again.
    pub fn take_over(&mut self, old: Ingress, is_kept: bool) {
        let is_same_port = matches!(self.port, IngressPort::Same);
        if is_same_port {
            self.port = old.port;
        }
        if is_same_port || !is_kept {
            self.numbers = old.numbers;
        }
        self.early = old.early;
        self.settle();
    }

    /// Sets senders and rate, and the port if there was none.
    pub fn change(&mut self, IngressUpdate { senders, limiter, port }: IngressUpdate) {
        if limiter.period_ns() != self.limiter.period_ns() {
            self.limiter = limiter;
        }
        if let Some(port) = port {
            self.port = IngressPort::New(port);
        }
        self.senders = senders;
        self.settle();
    }

    /// Sets the definition, which was not known: messages are validated by it from now on.
    pub fn describe(&mut self, schema: Arc<Schema>) {
        self.schema = Some(schema);
    }

    /// Of known publishers, forwards only the last messages of those that have ended, i.e. are not `present`. Returns whether there are
    /// such publishers. One that comes now may send before it is announced: it stays unknown until then.
    pub fn close(&mut self, present: &BTreeSet<Gid>) -> bool {
        let Senders { wanted, others } = &mut self.senders;
        others.extend(wanted.keys().filter(|gid| present.contains(*gid)));
        wanted.retain(|gid, _| !present.contains(gid));
        !wanted.is_empty()
    }

    /// The counters of this ingress's messages.
    pub fn counters(&self) -> &Arc<TopicCounters> {
        &self.counters
    }

    /// Whether messages of unknown publishers are held.
    pub fn is_waiting(&self) -> bool {
        !self.early.is_empty()
    }

    /// Whether messages of this publisher are ignored, because they arrive by another path.
    pub fn ignores(&self, publisher: &Gid) -> bool {
        self.senders.find(publisher) == SenderRole::Other
    }

    /// A claimer, for use in a thread that may claim memory, if a message of this publisher needs memory that is not claimed yet.
    ///
    /// # Real-time
    /// As [`RawPublisher::has_memory`].
    pub fn missing_memory(&self, publisher: &Gid, len_bytes: usize) -> Option<MemoryClaimer> {
        let IngressPort::New(port) = &self.port else { return None };
        // Bytes after the last field are dropped.
        let len_bytes = len_bytes.min(port.topic_type().body_bytes.unwrap_or(len_bytes));
        let has_memory = self.ignores(publisher) || port.has_memory(len_bytes);
        (!has_memory).then(|| port.claimer())
    }

    /// Drops a message.
    pub fn refuse(&mut self, source: &MessageMeta, reason: impl ToString) {
        self.is_new(source);
        self.counters.dropped(reason);
    }

    /// Forwards a message, holds it if its publisher is unknown, or ignores it if it arrives by another path.
    ///
    /// # Real-time
    /// One look-up, one loan, one copy; validation in time linear in the body if the definition is known. The body of an unknown
    /// publisher is copied to the heap.
    pub fn receive<B: Body + ?Sized>(&mut self, body: &B, source: MessageMeta) {
        match self.senders.find(&source.publisher) {
            SenderRole::Wanted(lifespan) => self.pass(body, source, lifespan),
            SenderRole::Other => {}
            SenderRole::Unknown => match self.delivery.early {
                Some(limits) => self.keep_early(body, source, limits),
                None => self.pass(body, source, None),
            },
        }
    }

    /// Counts the messages that are missing before this one. Returns false for a duplicate.
    fn is_new(&mut self, source: &MessageMeta) -> bool {
        let Some(number) = source.number.filter(|_| source.are_numbers_whole) else { return true };
        let missing = self.numbers.missing(source.publisher, number);
        self.counters.lost(missing.unwrap_or(0));
        missing.is_some() || !self.delivery.is_ordered
    }

    fn pass<B: Body + ?Sized>(&mut self, body: &B, source: MessageMeta, lifespan: Option<Duration>) {
        if !self.is_new(&source) {
            return;
        }
        match self.publish(body, source, lifespan) {
            Ok(len_bytes) => self.counters.passed(len_bytes, source.timestamp_ns),
            Err(reason) => self.counters.dropped(reason),
        }
    }

    /// Validates a message and publishes it. Returns its length.
    fn publish<B: Body + ?Sized>(
        &mut self,
        body: &B,
        source: MessageMeta,
        lifespan: Option<Duration>,
    ) -> Result<usize, Refused> {
        let IngressPort::New(port) = &self.port else { return Err(Refused::Unknown) };
        let info = MessageInfo {
            sequence_number: source.number.unwrap_or(0),
            source_timestamp_ns: source.timestamp_ns,
            released_ns: 0,
            publisher_gid: source.publisher,
        };
        port.traced().received(&info);
        if !self.limiter.admits(monotonic_ns()) {
            return Err(Refused::Rate);
        }
        let left = lifespan.map(|lifespan| left(lifespan, source.timestamp_ns)).transpose()?;
        let valid = |schema: &Schema, bytes: &[u8]| {
            DynamicMessage::validate(schema, bytes, Endian::Little).map_err(|_| Refused::Invalid)
        };
        // Bytes after the last field are dropped.
        let (len_bytes, is_checked) = match (port.topic_type().body_bytes, &self.schema, body.whole()) {
            (Some(fixed), ..) if (fixed..=fixed + TRAILING_BYTES).contains(&body.len_bytes()) => {
                (fixed, false)
            }
            (Some(_), ..) => return Err(Refused::Length),
            (None, Some(schema), Some(bytes)) => (bytes.len().saturating_sub(valid(schema, bytes)?), true),
            (None, ..) => (body.len_bytes(), false),
        };
        let mut loan = port.loan(len_bytes)?;
        body.copy_to(&mut loan);
        if let Some(schema) = self.schema.as_ref().filter(|_| !is_checked) {
            valid(schema, &loan)?;
        }
        let published = match left {
            None => loan.publish_as(info),
            Some(left) => loan.publish_as_for(info, left),
        };
        published.map_err(|unpublished| Refused::Publish(unpublished.into()))?;
        Ok(len_bytes)
    }

    fn keep_early<B: Body + ?Sized>(&mut self, body: &B, source: MessageMeta, limits: EarlyLimits) {
        let len_bytes = body.len_bytes();
        if self.early.len() >= limits.samples || self.early_bytes + len_bytes > limits.bytes {
            return self.counters.dropped(Refused::Unknown);
        }
        self.early_bytes += len_bytes;
        let mut copied = vec![0; len_bytes];
        body.copy_to(&mut copied);
        self.early.push(Early { body: copied, source, since: Instant::now() });
    }

    /// Applies changed senders to held messages, in order.
    fn settle(&mut self) {
        self.early_bytes = 0;
        for early in std::mem::take(&mut self.early) {
            match self.senders.find(&early.source.publisher) {
                SenderRole::Wanted(lifespan) => self.pass(&*early.body, early.source, lifespan),
                SenderRole::Other => {}
                SenderRole::Unknown => {
                    self.early_bytes += early.body.len();
                    self.early.push(early);
                }
            }
        }
        // A new publisher may have the same GID and count from the start.
        let wanted = &self.senders.wanted;
        self.numbers.forget(|gid| !wanted.contains_key(gid));
    }

    /// Drops messages that were held too long. Call it periodically.
    pub fn drop_expired(&mut self) {
        let Some(EarlyLimits { time, .. }) = self.delivery.early else { return };
        let is_late = |early: &Early| early.since.elapsed() >= time;
        if self.early.first().is_some_and(is_late) {
            let (counters, bytes) = (&self.counters, &mut self.early_bytes);
            self.early.retain(|early| {
                let stays = !is_late(early);
                if !stays {
                    *bytes -= early.body.len();
                    counters.dropped(Refused::Unknown);
                }
                stays
            });
        }
    }
}

/// A change of an ingress.
pub struct IngressUpdate {
    /// The senders.
    pub senders: Senders,
    /// The rate limit.
    pub limiter: Limiter,
    /// The port, if there was none.
    pub port: Option<Box<RawPublisher>>,
}

/// Remaining lifespan of a message, by the clocks of both hosts. A time stamp in the future counts as now.
fn left(lifespan: Duration, timestamp_ns: i64) -> Result<Duration, Refused> {
    let age_ns = wall_ns().saturating_sub(timestamp_ns).max(0).unsigned_abs();
    match nanoseconds(lifespan).saturating_sub(age_ns) {
        0 => Err(Refused::Expired),
        left_ns => Ok(Duration::from_nanos(left_ns)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::{Limits, Participant, Qos, TopicType};

    const NAMES: [Gid; 3] = [Gid([1; 16]), Gid([2; 16]), Gid([3; 16])];
    const DELIVERY: Delivery = Delivery {
        early: Some(EarlyLimits { samples: 2, bytes: 100, time: Duration::from_secs(3600) }),
        is_ordered: true,
    };

    fn source(publisher: Gid, number: u64) -> MessageMeta {
        MessageMeta { publisher, number: Some(number), are_numbers_whole: true, timestamp_ns: wall_ns() }
    }

    /// A message in slices.
    struct Pieces<'b>(&'b [u8]);

    impl Body for Pieces<'_> {
        fn len_bytes(&self) -> usize {
            self.0.len()
        }

        fn whole(&self) -> Option<&[u8]> {
            None
        }

        fn copy_to(&self, to: &mut [u8]) {
            self.0.copy_to(to);
        }
    }

    #[test]
    fn who_is_of_another_class_is_not_waited_for() {
        let [wanted, other, new] = NAMES;
        let publishers = BTreeMap::from([(wanted, None)]);
        let found = |known: &[Gid], has_port| {
            let senders = Senders::of(&known.iter().copied().collect(), &publishers, has_port);
            [wanted, other, new].map(|gid| senders.find(&gid))
        };
        use SenderRole::{Other, Unknown, Wanted};
        assert_eq!(found(&[wanted, other], true), [Wanted(None), Other, Unknown]);
        assert_eq!(found(&[wanted, other, new], true), [Wanted(None), Other, Other]);
        // Its port failed: its messages are held for the retry.
        assert_eq!(found(&[wanted, other], false), [Unknown, Other, Unknown]);
    }

    /// Small messages find memory, as every publisher's; what a large one lacks is claimed by who may do that, once.
    #[test]
    fn memory_that_is_missing_is_claimed_elsewhere() {
        crate::tests::isolated();
        let participant = Participant::new(212).unwrap();
        let topic_type = TopicType::new("test_msgs/msg/Image");
        let (qos, limits) = (Qos::keep_last(10), Limits::default());
        let heard = participant.create_raw_subscription("/x", &topic_type, qos, limits).unwrap();
        let port = participant.create_relay_publisher("/x", &topic_type, qos, limits).unwrap();
        let growths = port.counters();
        let [one, other, _] = NAMES;
        let mut ingress = Ingress::new(
            IngressPort::New(Box::new(port)),
            None,
            Arc::default(),
            Limiter::new(None),
            Senders::of(&[one, other].into(), &[(one, None)].into(), true),
            DELIVERY,
        );
        assert!(ingress.missing_memory(&one, 4096).is_none());
        let image = vec![7; 2 << 20];
        assert!(ingress.missing_memory(&other, image.len()).is_none(), "it comes another way");
        let mut claims = 0;
        for number in 1..=10 {
            if let Some(claimer) = ingress.missing_memory(&one, image.len()) {
                claimer.claim(image.len()).unwrap();
                claims += 1;
            }
            let before = growths.growths();
            ingress.receive(&image[..], source(one, number));
            assert_eq!(growths.growths(), before);
            assert_eq!(heard.try_take().unwrap().unwrap().body().len(), image.len());
        }
        assert_eq!(claims, 2, "a sample comes back with the next take");
        ingress.refuse(&source(one, 11), Refused::Rate);
        ingress.receive(&image[..], source(one, 12));
        let reading = ingress.counters().read(Duration::ZERO);
        assert_eq!((reading.messages, reading.lost, reading.dropped.values().sum()), (11, 0, 1_u64));
    }

    #[test]
    fn what_is_a_message_of_a_known_sender_comes_in_once_and_in_order() {
        crate::tests::isolated();
        let participant = Participant::new(211).unwrap();
        let schema = Schema::from_text(&"std_msgs/msg/String".parse().unwrap(), "string data\n").unwrap();
        let topic_type = TopicType::new("std_msgs/msg/String").with_hash(schema.hash().to_string());
        let (qos, limits) = (Qos::keep_last(10), Limits::default());
        let heard = participant.create_raw_subscription("/x", &topic_type, qos, limits).unwrap();
        let port = participant.create_raw_publisher("/x", &topic_type, qos, limits).unwrap();
        let take = || heard.try_take().unwrap().map(|sample| sample.body().to_vec());
        let counters = Arc::<TopicCounters>::default();
        let [one, other, new] = NAMES;
        let senders = |wanted: &[(Gid, Option<Duration>)]| {
            Senders::of(&[one, other].into(), &wanted.iter().copied().collect(), true)
        };
        let mut ingress = Ingress::new(
            IngressPort::New(Box::new(port)),
            Some(Arc::new(schema)),
            counters.clone(),
            Limiter::new(None),
            senders(&[(one, None)]),
            DELIVERY,
        );
        let dropped = |reason: Refused| {
            counters.read(Duration::ZERO).dropped.get(&reason.to_string()).copied().unwrap_or(0)
        };
        let claimed = [0xFF, 0xFF, 0xFF, 0x7F, b'a', 0];
        let nonsense = [&claimed[..], &[], &[3, 0, 0, 0, b'a', b'b'], &[2, 0, 0, 0, 0xFF, 0], &[0; 40]];
        for (number, body) in (1..).zip(nonsense) {
            ingress.receive(body, source(one, number));
            ingress.receive(&Pieces(body), source(one, number + 1));
            ingress.numbers.forget(|_| true);
        }
        assert_eq!((take(), dropped(Refused::Invalid)), (None, 10));

        let text = [3, 0, 0, 0, b'a', b'b', 0];
        ingress.receive(&text[..], source(one, 1));
        ingress.receive(&text[..], source(one, 1));
        ingress.receive(&text[..], source(other, 1));
        ingress.receive(&Pieces(&text), source(one, 4));
        assert_eq!([take(), take(), take()], [Some(text.to_vec()), Some(text.to_vec()), None]);
        assert_eq!(counters.read(Duration::ZERO).lost, 2);

        // Not known yet: held, as far as there is room.
        for number in 1..=3 {
            ingress.receive(&text[..], source(new, number));
        }
        assert_eq!((take(), ingress.is_waiting(), dropped(Refused::Unknown)), (None, true, 1));
        let change = |wanted: &[_]| IngressUpdate {
            senders: senders(wanted),
            limiter: Limiter::new(None),
            port: None,
        };
        ingress.change(change(&[(new, None)]));
        assert_eq!([take().is_some(), take().is_some(), take().is_some()], [true, true, false]);

        // Where not all publishers are announced, they are forwarded.
        ingress.delivery.early = None;
        ingress.receive(&text[..], source(Gid([9; 16]), 1));
        assert_eq!([take().is_some(), take().is_some()], [true, false]);

        // All have ended: the last messages still come, and those of one that follows before it is announced.
        assert!(ingress.close(&BTreeSet::from([one, other])));
        for publisher in [new, Gid([8; 16]), other] {
            ingress.receive(&text[..], source(publisher, 4));
        }
        assert_eq!([take().is_some(), take().is_some(), take().is_some()], [true, true, false]);
        // It is there, and comes another way.
        assert!(!ingress.close(&BTreeSet::from([new])));
        ingress.receive(&text[..], source(new, 5));
        assert!(take().is_none());

        // Older than an hour, or not, by the other host's stamp.
        const HOUR: Duration = Duration::from_secs(3600);
        let hour_ns = HOUR.as_nanos() as i64;
        ingress.change(change(&[(one, Some(HOUR))]));
        for (number, age_ns) in [(1, hour_ns + 1), (2, hour_ns / 2), (3, -hour_ns / 2)] {
            let source = MessageMeta { timestamp_ns: wall_ns() - age_ns, ..source(one, number) };
            ingress.receive(&text[..], source);
        }
        assert_eq!((std::iter::from_fn(take).count(), dropped(Refused::Expired)), (2, 1));
        // A message that expires in the queue is skipped at take.
        const SHORT: Duration = Duration::from_millis(3);
        ingress.change(change(&[(one, Some(SHORT))]));
        for number in 10.. {
            ingress.receive(&text[..], source(one, number));
            let over_ns = monotonic_ns() + nanoseconds(SHORT);
            while monotonic_ns() < over_ns {}
            assert_eq!(take(), None);
            // On a busy machine it may have expired before it was queued.
            if heard.counters().expired() > 0 {
                break;
            }
        }
    }
}
