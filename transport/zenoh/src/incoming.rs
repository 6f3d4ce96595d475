// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the network to shared memory: a sample is checked, and its body copied once, from Zenoh's slices into a loan, for all
//! subscriptions of the host.
//!
//! This runs in Zenoh's thread and never waits: a slow subscription loses its oldest samples.

use crate::wire::{Attachment, ENCAPSULATION, Malformed, TopicKey, check_encapsulation};
use std::sync::Arc;
use std::time::Duration;
use tautline_relay::{Body, Delivery, Ingress, IngressUpdate, Inward, Source, TopicCounters};
use tautline_rt::PiMutex;
use tautline_rt::clock::wall_ns;
use tautline_transport::{Durability, Reliability};
use zenoh::bytes::ZBytes;
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig, RecoveryConfig};

/// Messages arrive over several links, and kept ones again. Other implementations of the wire write GIDs that their tokens do not
/// announce (hiroz, zenoh-ros2-sdk).
pub(crate) const DELIVERY: Delivery = Delivery { early: None, is_ordered: false };
/// A time stamp further ahead of this host's clock is invalid.
const FUTURE_NS: i64 = 3_600_000_000_000;
/// Time-out of a request for kept samples.
const HISTORY_TIMEOUT: Duration = Duration::from_secs(10);

/// Why a sample from the network was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Dropped {
    #[error(transparent)]
    Malformed(#[from] Malformed),
    #[error("a deletion, which topics do not have")]
    Deletion,
    #[error("negative sequence number")]
    Sequence,
    #[error("time stamp before 1970 or far in the future")]
    Time,
}

/// An incoming topic. Dropping it ends the subscription on the network.
pub(crate) struct Incoming {
    ingress: Arc<Gate>,
    _subscriber: Subscriber,
    /// Newer publishers of images and the like use this key.
    _cpu_group: zenoh::pubsub::Subscriber<()>,
}

enum Subscriber {
    Plain { _subscriber: zenoh::pubsub::Subscriber<()> },
    Late { _subscriber: AdvancedSubscriber<()> },
}

impl Incoming {
    pub(crate) fn start(
        session: &Session,
        key: &TopicKey,
        inward: &Inward,
        ingress: Ingress,
        max_bytes: usize,
    ) -> zenoh::Result<Self> {
        let counters = ingress.counters().clone();
        let ingress = Arc::new(Gate { ingress: PiMutex::new(Some(ingress)), counters, max_bytes });
        let (of_group, receiving) = (ingress.clone(), ingress.clone());
        let cpu_group = session.declare_subscriber(key.cpu_group()).allowed_origin(Locality::Remote);
        // Their sequence numbers also count samples to other subscriptions: gaps are not losses.
        let cpu_group = cpu_group.callback(move |sample| of_group.take(&sample, false)).wait()?;
        let incoming = |subscriber| Incoming { ingress, _subscriber: subscriber, _cpu_group: cpu_group };
        let subscriber = session.declare_subscriber(key.to_string()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| receiving.take(&sample, true));
        if inward.qos.durability == Durability::Volatile {
            return Ok(incoming(Subscriber::Plain { _subscriber: subscriber.wait()? }));
        }
        let mut late = subscriber
            .history(HistoryConfig::default().detect_late_publishers().max_samples(inward.qos.depth))
            .query_timeout(HISTORY_TIMEOUT)
            .subscriber_detection();
        if inward.qos.reliability == Reliability::Reliable {
            late = late.recovery(RecoveryConfig::default().heartbeat());
        }
        Ok(incoming(Subscriber::Late { _subscriber: late.wait()? }))
    }

    /// See [`Ingress::change`].
    pub(crate) fn change(&self, change: IngressUpdate) {
        self.ingress.with(|ingress| ingress.change(change));
    }

    /// Ends this one and returns its ingress for the next.
    pub(crate) fn end(self) -> Option<Ingress> {
        self.ingress.ingress.lock().take()
    }
}

/// Receives samples of one topic from the threads of several links; `None` after another one took over.
struct Gate {
    ingress: PiMutex<Option<Ingress>>,
    counters: Arc<TopicCounters>,
    max_bytes: usize,
}

impl Gate {
    fn with(&self, act: impl FnOnce(&mut Ingress)) {
        if let Some(ingress) = &mut *self.ingress.lock() {
            act(ingress);
        }
    }

    fn take(&self, sample: &Sample, are_numbers_whole: bool) {
        match self.check(sample) {
            Ok(source) => {
                let source = Source { are_numbers_whole, ..source };
                self.with(|ingress| ingress.receive(&Payload(sample.payload()), source));
            }
            Err(reason) => self.counters.dropped(reason),
        }
    }

    /// The metadata of a sample, after checking its frame.
    fn check(&self, sample: &Sample) -> Result<Source, Dropped> {
        if sample.kind() != SampleKind::Put {
            return Err(Dropped::Deletion);
        }
        let attachment = parse_attachment(sample.attachment())?;
        let number = u64::try_from(attachment.sequence_number).map_err(|_| Dropped::Sequence)?;
        let timestamp_ns = attachment.source_timestamp_ns;
        if timestamp_ns < 0 || timestamp_ns.saturating_sub(wall_ns()) > FUTURE_NS {
            return Err(Dropped::Time);
        }
        let mut head = [0; ENCAPSULATION.len()];
        let copied = copy(sample.payload().slices(), 0, &mut head);
        check_encapsulation(head.get(..copied).unwrap_or_default())?;
        if sample.payload().len() - ENCAPSULATION.len() > self.max_bytes {
            return Err(Malformed::PayloadTooLong.into());
        }
        let (publisher, number) = (attachment.gid, Some(number));
        Ok(Source { publisher, number, are_numbers_whole: true, timestamp_ns })
    }
}

/// The body behind the encapsulation, which was checked.
struct Payload<'p>(&'p ZBytes);

impl Body for Payload<'_> {
    fn len_bytes(&self) -> usize {
        self.0.len() - ENCAPSULATION.len()
    }

    fn whole(&self) -> Option<&[u8]> {
        let mut slices = self.0.slices();
        let only = slices.next().filter(|_| slices.next().is_none())?;
        only.get(ENCAPSULATION.len()..)
    }

    fn copy_to(&self, to: &mut [u8]) {
        let copied = copy(self.0.slices(), ENCAPSULATION.len(), to);
        // The slices may be shorter than the length that they claim.
        to[copied..].fill(0);
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

/// Copies `slices` without the first `skip` bytes to `to`, as far as it fits. Returns the number of bytes.
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

#[cfg(test)]
mod tests {
    use super::*;
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
