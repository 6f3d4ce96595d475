// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the network to shared memory: the claim is checked, the body is copied once, from the network's slices into a
//! loan, for all subscriptions of the host.
//!
//! It is done in Zenoh's own thread, as soon as the sample is there. Nothing in it waits: a subscription that is slow
//! loses its oldest samples.

use crate::lifespans::Lifespans;
use crate::mirror::InQos;
use crate::wire::{Attachment, ENCAPSULATION, Malformed, TopicKey, check_encapsulation};
use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::Duration;
use tautline_relay::{Counters, Numbers};
use tautline_rt::clock::wall_ns;
use tautline_schema::{DynamicMessage, Endian, Schema};
use tautline_transport::{
    Durability, Gid, History, Limits, LoanError, MessageInfo, PublishError, RawPublisher, Reliability,
    TracedPort,
};
use zenoh::bytes::ZBytes;
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, RecoveryConfig};

/// A time stamp further ahead of this host's clock is no time.
const FUTURE_NS: i64 = 3_600_000_000_000;
/// Fast CDR appends up to this many bytes after the last field.
const TRAILING_BYTES: usize = 8;
/// How long a publisher is waited for that was asked for what it keeps.
const HISTORY_TIMEOUT: Duration = Duration::from_secs(10);

/// Gids of publishers as the network knows them: of this host's, what carries one of these comes from here.
pub(crate) type OwnGids = Arc<RwLock<HashSet<Gid>>>;

/// Why a sample from the network was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Dropped {
    #[error(transparent)]
    Malformed(#[from] Malformed),
    #[error("a deletion, which topics do not have")]
    Deletion,
    #[error("published by this host")]
    Own,
    /// Not counted: it comes into the domain another way.
    #[error("carried by somebody else")]
    Elsewhere,
    #[error("negative sequence number")]
    Sequence,
    #[error("time stamp before 1970 or far in the future")]
    Time,
    #[error("older than its publisher's lifespan")]
    Expired,
    #[error("length differs from the type's")]
    Length,
    #[error("not a message of its type")]
    Invalid,
    #[error("{0}")]
    Loan(#[from] LoanError),
    #[error("{0}")]
    Publish(PublishError),
}

/// A topic that comes in. Dropping it ends the subscription on the network.
pub(crate) struct Incoming {
    _subscriber: Subscriber,
    /// Where newer publishers of images and the like put them.
    _cpu_group: zenoh::pubsub::Subscriber<()>,
}

enum Subscriber {
    Plain { _subscriber: zenoh::pubsub::Subscriber<()> },
    Late { _subscriber: AdvancedSubscriber<()> },
}

impl Incoming {
    pub(crate) fn start(session: &Session, key: &TopicKey, qos: InQos, inlet: Inlet) -> zenoh::Result<Self> {
        let inlet = Arc::new(inlet);
        let of_group = inlet.clone();
        let cpu_group = session.declare_subscriber(key.cpu_group()).allowed_origin(Locality::Remote);
        // Their numbers count what goes to others, too: gaps in them are no losses.
        let cpu_group = cpu_group.callback(move |sample| of_group.receive(&sample, false)).wait()?;
        let incoming = |subscriber| Incoming { _subscriber: subscriber, _cpu_group: cpu_group };
        let subscriber = session.declare_subscriber(key.to_string()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| inlet.receive(&sample, true));
        if qos.durability == Durability::Volatile {
            return Ok(incoming(Subscriber::Plain { _subscriber: subscriber.wait()? }));
        }
        let depth = usize::try_from(qos.depth).unwrap_or(usize::MAX);
        let mut late = subscriber
            .history(HistoryConfig::default().detect_late_publishers().max_samples(depth))
            .query_timeout(HISTORY_TIMEOUT)
            .subscriber_detection();
        if qos.reliability == Reliability::Reliable {
            late = late.recovery(RecoveryConfig::default().heartbeat());
        }
        Ok(incoming(Subscriber::Late { _subscriber: late.wait()? }))
    }
}

/// What a sample has to pass.
pub(crate) struct Checks {
    pub(crate) own: OwnGids,
    /// Publishers of the topic whose samples come into the domain another way.
    pub(crate) passed_over: OwnGids,
    pub(crate) lifespans: Arc<Lifespans>,
    pub(crate) max_bytes: usize,
    /// Of a type that this host has a definition of.
    pub(crate) schema: Option<Arc<Schema>>,
}

/// Where samples go, and what they are checked against.
pub(crate) struct Inlet {
    /// Samples of one topic come from several links' threads.
    port: Mutex<RawPublisher>,
    traced: TracedPort,
    counters: Arc<Counters>,
    numbers: Arc<Mutex<Numbers>>,
    checks: Checks,
    /// Of a type whose size is fixed and known.
    body_bytes: Option<usize>,
}

impl Inlet {
    /// `numbers` are what came through the one before it.
    pub(crate) fn new(
        port: RawPublisher,
        counters: Arc<Counters>,
        numbers: Arc<Mutex<Numbers>>,
        checks: Checks,
    ) -> Self {
        let (body_bytes, traced) = (port.topic_type().body_bytes, port.traced());
        Inlet { port: Mutex::new(port), traced, counters, numbers, checks, body_bytes }
    }

    fn receive(&self, sample: &Sample, are_numbers_whole: bool) {
        if sample.kind() != SampleKind::Put {
            return self.counters.dropped(Dropped::Deletion);
        }
        match self.take(sample.payload(), sample.attachment()) {
            Ok(taken) if are_numbers_whole => {
                let mut numbers = self.numbers.lock().unwrap_or_else(PoisonError::into_inner);
                let missing = numbers.missing(taken.gid, taken.sequence_number.unsigned_abs());
                self.counters.lost(missing.unwrap_or(0));
            }
            Ok(_) | Err(Dropped::Elsewhere) => {}
            Err(reason) => self.counters.dropped(reason),
        }
    }

    fn take(&self, payload: &ZBytes, attachment: Option<&ZBytes>) -> Result<Attachment, Dropped> {
        let attachment = parse_attachment(attachment)?;
        if self.checks.own.read().unwrap_or_else(PoisonError::into_inner).contains(&attachment.gid) {
            return Err(Dropped::Own);
        }
        if self.checks.passed_over.read().unwrap_or_else(PoisonError::into_inner).contains(&attachment.gid) {
            return Err(Dropped::Elsewhere);
        }
        let sequence_number = u64::try_from(attachment.sequence_number).map_err(|_| Dropped::Sequence)?;
        let source_timestamp_ns = attachment.source_timestamp_ns;
        if source_timestamp_ns < 0 || source_timestamp_ns.saturating_sub(wall_ns()) > FUTURE_NS {
            return Err(Dropped::Time);
        }
        let publisher_gid = attachment.gid;
        let source = MessageInfo { sequence_number, source_timestamp_ns, released_ns: 0, publisher_gid };
        self.traced.received(&source);
        let left = self.left(attachment.gid, source_timestamp_ns)?;
        let len_bytes = self.body_len(payload)?;
        {
            let publisher = self.port.lock().unwrap_or_else(PoisonError::into_inner);
            let mut loan = publisher.loan(len_bytes)?;
            copy_body(payload, &mut loan);
            if let Some(schema) = &self.checks.schema {
                DynamicMessage::validate(schema, &loan, Endian::Little).map_err(|_| Dropped::Invalid)?;
            }
            let published = match left {
                None => loan.publish_as(source),
                Some(left) => loan.publish_as_for(source, left),
            };
            published.map_err(|unpublished| Dropped::Publish(unpublished.into()))?;
        }
        self.counters.passed(len_bytes, source_timestamp_ns);
        Ok(attachment)
    }

    /// How long a sample is still to be delivered, if its publisher has a lifespan: by the clocks of both hosts. One that is ahead
    /// of this host's clock is new.
    fn left(&self, publisher: Gid, source_timestamp_ns: i64) -> Result<Option<Duration>, Dropped> {
        let Some(lifespan_ns) = self.checks.lifespans.get(&publisher) else { return Ok(None) };
        let age_ns = wall_ns().saturating_sub(source_timestamp_ns).max(0).unsigned_abs();
        match lifespan_ns.saturating_sub(age_ns) {
            0 => Err(Dropped::Expired),
            left_ns => Ok(Some(Duration::from_nanos(left_ns))),
        }
    }

    /// The length of the body, once its frame has been checked.
    fn body_len(&self, payload: &ZBytes) -> Result<usize, Dropped> {
        let mut head = [0; ENCAPSULATION.len()];
        let copied = copy(payload.slices(), 0, &mut head);
        check_encapsulation(head.get(..copied).unwrap_or_default())?;
        let len_bytes = payload.len() - ENCAPSULATION.len();
        if len_bytes > self.checks.max_bytes {
            return Err(Malformed::PayloadTooLong.into());
        }
        match self.body_bytes {
            None => Ok(len_bytes),
            Some(fixed) if (fixed..=fixed + TRAILING_BYTES).contains(&len_bytes) => Ok(fixed),
            Some(_) => Err(Dropped::Length),
        }
    }
}

fn parse_attachment(attachment: Option<&ZBytes>) -> Result<Attachment, Malformed> {
    let attachment = attachment.ok_or(Malformed::NoAttachment)?;
    if attachment.len() != Attachment::BYTES {
        return Err(Malformed::Attachment);
    }
    let mut bytes = [0; Attachment::BYTES];
    copy(attachment.slices(), 0, &mut bytes);
    Attachment::parse(&bytes)
}

fn copy_body(payload: &ZBytes, body: &mut [u8]) {
    let copied = copy(payload.slices(), ENCAPSULATION.len(), body);
    // A loan's content is unspecified, and the slices are what they are, whatever length they claim.
    if let Some(rest) = body.get_mut(copied..) {
        rest.fill(0);
    }
}

/// Copies what follows the first `skip` bytes of `slices` to `to`, as much as fits. Returns how much that was.
fn copy<'a>(slices: impl Iterator<Item = &'a [u8]>, mut skip: usize, to: &mut [u8]) -> usize {
    let mut at = 0;
    for slice in slices {
        let (skipped, slice) = slice.split_at(skip.min(slice.len()));
        skip -= skipped.len();
        let len = slice.len().min(to.len() - at);
        to[at..at + len].copy_from_slice(&slice[..len]);
        at += len;
        if at == to.len() {
            break;
        }
    }
    at
}

/// The quality of service of the port that samples from the network go through.
pub(crate) fn port_qos(qos: InQos) -> tautline_transport::Qos {
    let depth = usize::try_from(qos.depth).unwrap_or(usize::MAX).clamp(1, Limits::MAX_DEPTH);
    tautline_transport::Qos {
        history: History::KeepLast,
        durability: qos.durability,
        reliability: qos.reliability,
        ..tautline_transport::Qos::keep_last(depth)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::{Participant, Qos, TopicType};

    #[test]
    fn what_is_no_message_of_its_type_is_dropped() {
        crate::tests::isolated();
        let participant = Participant::new(216).unwrap();
        let schema = Schema::from_text(&"std_msgs/msg/String".parse().unwrap(), "string data\n").unwrap();
        let topic_type = TopicType::new("std_msgs/msg/String").with_hash(schema.hash().to_string());
        let (qos, limits) = (Qos::keep_last(10), Limits::default());
        let subscription = participant.create_raw_subscription("/x", &topic_type, qos, limits).unwrap();
        let port = participant.create_raw_publisher("/x", &topic_type, qos, limits).unwrap();
        let schema = Some(Arc::new(schema));
        let lifespans = Arc::<Lifespans>::default();
        let (own, passed_over) = Default::default();
        let checks = Checks { own, passed_over, lifespans: lifespans.clone(), max_bytes: 100, schema };
        let inlet = Inlet::new(port, Arc::default(), Arc::default(), checks);
        let attachment = Attachment { sequence_number: 1, source_timestamp_ns: wall_ns(), gid: Gid([3; 16]) };
        let attachment = ZBytes::from(attachment.encode());
        let take = |body: &[u8]| {
            inlet.take(&ZBytes::from([&ENCAPSULATION[..], body].concat()), Some(&attachment)).map(drop)
        };
        let claimed = [0xFF, 0xFF, 0xFF, 0x7F, b'a', 0];
        for body in [&claimed[..], &[], &[3, 0, 0, 0, b'a', b'b'], &[2, 0, 0, 0, 0xFF, 0], &[0; 40]] {
            assert_eq!(take(body), Err(Dropped::Invalid), "{body:?}");
        }
        assert!(subscription.try_take().unwrap().is_none());
        let body = [3, 0, 0, 0, b'a', b'b', 0];
        assert_eq!(take(&body), Ok(()));
        assert_eq!(subscription.try_take().unwrap().unwrap().body(), body);

        // An hour is over, or not, by the stamp of the other host.
        const HOUR_NS: i64 = 3_600_000_000_000;
        lifespans.set(Gid([3; 16]), Some(HOUR_NS as u64));
        for (age_ns, expected) in
            [(HOUR_NS + 1, Err(Dropped::Expired)), (HOUR_NS / 2, Ok(())), (-HOUR_NS / 2, Ok(()))]
        {
            let attachment =
                Attachment { sequence_number: 2, source_timestamp_ns: wall_ns() - age_ns, gid: Gid([3; 16]) };
            let payload = ZBytes::from([&ENCAPSULATION[..], &body].concat());
            let taken = inlet.take(&payload, Some(&ZBytes::from(attachment.encode())));
            assert_eq!(taken.map(drop), expected, "{age_ns}");
        }
        assert_eq!(std::iter::from_fn(|| subscription.try_take().unwrap()).count(), 2);
        // One that is queued longer than it has left is passed over when it is to be taken.
        lifespans.set(Gid([3; 16]), Some(3_000_000));
        let expired = || subscription.counters().expired();
        while expired() == 0 {
            let attachment =
                Attachment { sequence_number: 3, source_timestamp_ns: wall_ns(), gid: Gid([3; 16]) };
            let payload = ZBytes::from([&ENCAPSULATION[..], &body].concat());
            let taken = inlet.take(&payload, Some(&ZBytes::from(attachment.encode())));
            let over_ns = tautline_rt::clock::monotonic_ns() + 3_000_000;
            while tautline_rt::clock::monotonic_ns() < over_ns {}
            // On a busy machine it may have been too late before it was queued.
            assert!(matches!(taken, Ok(_) | Err(Dropped::Expired)), "{taken:?}");
            assert!(subscription.try_take().unwrap().is_none());
        }
    }

    #[test]
    fn bodies_are_gathered_from_slices() {
        let whole: Vec<u8> = (0..100).collect();
        for size in 1..101 {
            for skip in [0, 1, 4, 50, 99, 100] {
                let mut body = vec![0xFF; 100 - skip];
                assert_eq!(copy(whole.chunks(size), skip, &mut body), 100 - skip, "{size} {skip}");
                assert_eq!(body, whole[skip..]);
            }
        }
        let mut short = [0; 3];
        assert_eq!(copy(whole.chunks(2), 4, &mut short), 3);
        assert_eq!(short, [4, 5, 6]);
        assert_eq!(copy([].into_iter(), 4, &mut short), 0);
        assert_eq!(copy(whole.chunks(7), 200, &mut short), 0);
    }
}
