// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the network to shared memory: a sample is checked, and its body copied once, from Zenoh's slices into a loan, for all
//! subscriptions of the host.
//!
//! This runs in Zenoh's thread and never waits: a slow subscription loses its oldest samples.

use crate::kept::{Kept, Publisher};
use crate::wire::{Attachment, ENCAPSULATION, Malformed, TopicKey, check_encapsulation};
use std::sync::{Arc, Weak};
use std::time::Duration;
use tautline_relay::{Body, Delivery, Ingress, IngressUpdate, Inward, Source, TopicCounters};
use tautline_rt::PiMutex;
use tautline_rt::clock::wall_ns;
use tautline_transport::{Durability, Reliability};
use zenoh::bytes::ZBytes;
use zenoh::query::{ConsolidationMode, Reply, ReplyKeyExpr};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, RecoveryConfig};

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
    gate: Arc<Gate>,
    _subscriber: Subscriber,
    /// Newer publishers of images and the like use this key.
    _cpu_group: zenoh::pubsub::Subscriber<()>,
}

/// Field order is drop order.
enum Subscriber {
    Plain { _samples: zenoh::pubsub::Subscriber<()> },
    Kept { _publishers: zenoh::pubsub::Subscriber<()>, _samples: AdvancedSubscriber<()> },
}

impl Incoming {
    pub(crate) fn start(
        session: &Session,
        key: &TopicKey,
        inward: &Inward,
        ingress: Ingress,
        max_bytes: usize,
    ) -> zenoh::Result<Self> {
        let (counters, qos) = (ingress.counters().clone(), &inward.qos);
        let is_kept = qos.durability == Durability::TransientLocal;
        let way = Way {
            kept: is_kept.then(|| Kept::new(qos.depth)),
            early: is_kept.then(Vec::new),
            port: Port { ingress, max_bytes },
        };
        let gate = Arc::new(Gate { way: PiMutex::new(Some(way)), counters });
        let (of_group, receiving) = (gate.clone(), gate.clone());
        let cpu_group = session.declare_subscriber(key.cpu_group()).allowed_origin(Locality::Remote);
        // Their sequence numbers also count samples to other subscriptions: gaps are not losses.
        let cpu_group =
            cpu_group.callback(move |sample| of_group.with(|way| way.port.take(&sample, false))).wait()?;
        let requests = Requests { session: session.clone(), gate: Arc::downgrade(&gate), depth: qos.depth };
        // Before the samples: a publisher's token comes before what it publishes.
        let publishers = is_kept.then(|| requests.clone().watch(key)).transpose()?;
        let subscriber = session.declare_subscriber(key.to_string()).allowed_origin(Locality::Remote);
        let subscriber = subscriber.callback(move |sample| receiving.with(|way| way.receive(sample)));
        let Some(_publishers) = publishers else {
            let _subscriber = Subscriber::Plain { _samples: subscriber.wait()? };
            return Ok(Incoming { gate, _subscriber, _cpu_group: cpu_group });
        };
        let mut samples = subscriber.advanced().query_timeout(HISTORY_TIMEOUT).subscriber_detection();
        if qos.reliability == Reliability::Reliable {
            samples = samples.recovery(RecoveryConfig::default().heartbeat());
        }
        let _subscriber = Subscriber::Kept { _publishers, _samples: samples.wait()? };
        // After the samples: what is published after the answer arrives.
        let early = gate.with(|way| way.early.take());
        early.into_iter().flatten().for_each(|(publisher, token)| requests.send(publisher, &token));
        Ok(Incoming { gate, _subscriber, _cpu_group: cpu_group })
    }

    /// See [`Ingress::change`].
    pub(crate) fn change(&self, change: IngressUpdate) {
        self.gate.with(|way| way.port.ingress.change(change));
    }

    /// Ends this one and returns its ingress for the next.
    pub(crate) fn end(self) -> Option<Ingress> {
        Some(self.gate.way.lock().take()?.port.ingress)
    }
}

/// Requests what each publisher of a topic keeps.
#[derive(Clone)]
struct Requests {
    session: Session,
    gate: Weak<Gate>,
    depth: usize,
}

impl Requests {
    /// Watches publishers, those that exist and those that come.
    fn watch(self, key: &TopicKey) -> zenoh::Result<zenoh::pubsub::Subscriber<()>> {
        let (session, publishers) = (self.session.clone(), format!("{key}/@adv/pub/**"));
        let watch = session.liveliness().declare_subscriber(publishers).history(true);
        watch.callback(move |token| self.changed(&token)).wait()
    }

    fn changed(&self, token: &Sample) {
        let (key, own) = (token.key_expr().as_str(), self.session.zid());
        let publisher = Publisher::of_token(key, own).filter(|_| token.kind() == SampleKind::Put);
        let (Some(publisher), Some(gate)) = (publisher, self.gate.upgrade()) else { return };
        if gate.with(|way| way.appeared(publisher, key)) {
            self.send(publisher, key);
        }
    }

    /// `token`: its key is that of the publisher's cache.
    fn send(&self, publisher: Publisher, token: &str) {
        // A publisher keeps no more than is requested, and so does each of those of a session.
        const PUBLISHERS: usize = 64;
        let most = if publisher.is_single() { self.depth } else { self.depth.saturating_mul(PUBLISHERS) };
        let answer = Answer { gate: self.gate.clone(), publisher, most, kept: PiMutex::default() };
        let request = self.session.get(format!("{token}?_max={}", self.depth));
        let request = request.allowed_destination(Locality::Remote).timeout(HISTORY_TIMEOUT);
        let request = request.consolidation(ConsolidationMode::None).accept_replies(ReplyKeyExpr::Any);
        if let Err(error) = request.callback(move |reply| answer.add(reply)).wait() {
            tracing::warn!("what the publisher of token {token} keeps cannot be requested: {error}");
        }
    }
}

/// The answer to a request, which ends when Zenoh drops it, at the latest after the time-out.
struct Answer {
    gate: Weak<Gate>,
    publisher: Publisher,
    most: usize,
    kept: PiMutex<Vec<Sample>>,
}

impl Answer {
    fn add(&self, reply: Reply) {
        let Ok(sample) = reply.into_result() else { return };
        let mut kept = self.kept.lock();
        if kept.len() < self.most {
            kept.push(sample);
        } else if let Some(gate) = self.gate.upgrade() {
            gate.counters.dropped("more kept samples than requested");
        }
    }
}

impl Drop for Answer {
    fn drop(&mut self) {
        if let Some(gate) = self.gate.upgrade() {
            let kept = std::mem::take(&mut *self.kept.lock());
            gate.with(|way| way.answered(self.publisher, kept));
        }
    }
}

/// The way in, shared by the threads of several links.
struct Gate {
    /// `None` after another one took over.
    way: PiMutex<Option<Way>>,
    counters: Arc<TopicCounters>,
}

impl Gate {
    fn with<T: Default>(&self, act: impl FnOnce(&mut Way) -> T) -> T {
        self.way.lock().as_mut().map(act).unwrap_or_default()
    }
}

struct Way {
    /// Of a transient-local topic.
    kept: Option<Kept<Sample>>,
    /// Until samples are received: the publishers to request from, with the keys of their tokens.
    early: Option<Vec<(Publisher, String)>>,
    port: Port,
}

impl Way {
    /// A publisher has appeared. Returns whether to send the request now.
    fn appeared(&mut self, publisher: Publisher, token: &str) -> bool {
        let is_new = self.kept.as_mut().is_some_and(|kept| kept.appeared(publisher));
        if let Some(early) = self.early.as_mut().filter(|_| is_new) {
            early.push((publisher, token.to_owned()));
        }
        is_new && self.early.is_none()
    }

    /// A published or recovered sample.
    fn receive(&mut self, sample: Sample) {
        let port = &mut self.port;
        match &mut self.kept {
            Some(kept) => kept.published(sample, &mut |sample| port.take(&sample, true)),
            None => port.take(&sample, true),
        }
    }

    /// What a publisher keeps.
    fn answered(&mut self, publisher: Publisher, samples: Vec<Sample>) {
        let (Some(kept), port) = (&mut self.kept, &mut self.port) else { return };
        let late = kept.answered(publisher, samples, &mut |sample| port.take(&sample, true));
        port.ingress.counters().lost(late);
    }
}

/// Admits what is a sample.
struct Port {
    ingress: Ingress,
    max_bytes: usize,
}

impl Port {
    fn take(&mut self, sample: &Sample, are_numbers_whole: bool) {
        match self.check(sample) {
            Ok(source) => {
                self.ingress.receive(&Payload(sample.payload()), Source { are_numbers_whole, ..source });
            }
            Err(reason) => self.ingress.counters().dropped(reason),
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
