// SPDX-License-Identifier: MIT OR Apache-2.0
//! From the network to shared memory: a sample is checked, and its body copied once, from Zenoh's slices into a loan, for all
//! subscriptions of the host.
//!
//! This runs in Zenoh's thread and never waits: a slow subscription loses its oldest samples, and memory is claimed by [another
//! thread](crate::unclaimed).

use crate::kept::{KeptSamples, Placed, Publisher, Request, Response, SessionId, Target};
use crate::unclaimed::{ClaimQueue, Claimant, Claimed, Next, Unclaimed};
use crate::wire::{Attachment, ENCAPSULATION, Malformed, TopicKey, check_encapsulation};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};
use tautline_relay::{Body, Delivery, Ingress, IngressUpdate, Inward, MessageMeta, Refused};
use tautline_rt::PiMutex;
use tautline_schema::Schema;
use tautline_transport::{Durability, Gid, LoanError, Reliability};
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply, ReplyKeyExpr};
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait};
use zenoh_ext::z_deserialize;

/// Messages arrive over several links, so out of order, and kept messages arrive again. Some implementations of the wire write GIDs
/// that their tokens do not announce (hiroz, zenoh-ros2-sdk), so messages of unknown publishers are forwarded.
pub(crate) const DELIVERY: Delivery = Delivery { early: None, is_ordered: false };
/// Time-out of a request for kept samples.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// How long the graph must be unchanged before missing kept samples are requested again.
const RETRY_TIME: Duration = Duration::from_secs(1);
/// How long new samples wait, at the start, until the existing publishers are known.
const START_TIMEOUT: Duration = Duration::from_secs(1);

/// Why a sample from the network was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Dropped {
    #[error(transparent)]
    Malformed(#[from] Malformed),
    #[error("a deletion, which topics do not have")]
    Deletion,
    #[error("negative sequence number")]
    Sequence,
    #[error("time stamp before 1970")]
    Time,
    #[error("too many messages wait for shared memory")]
    Unclaimed,
    #[error("a publisher keeps more bytes than wait for shared memory at most")]
    Kept,
}

/// How often kept samples are requested again from publishers that have sent none; the first time after a second, then at growing
/// intervals. A publisher may have none.
const MOST_RETRIES: u32 = 5;

/// An incoming topic. Dropping it ends the subscriptions on the network.
pub(crate) struct Incoming {
    entrance: Arc<Entrance>,
    gate: Arc<Gate>,
    retries: Option<Retries>,
    samples: [Subscriber<()>; 2],
}

/// Repeated requests for a transient-local topic: to publishers from which no kept samples have arrived.
struct Retries {
    requests: Requests,
    /// The number of each session's publishers that keep samples.
    keeping: BTreeMap<SessionId, usize>,
    count: u32,
    next: Instant,
    _publishers: [Subscriber<()>; 2],
}

impl Incoming {
    /// Starts taking a topic's samples. If `old` took them so far, its subscriptions are kept and `ingress` continues where the old ingress
    /// ended, so that no sample is missed in between.
    pub(crate) fn start(
        session: &Session,
        key: &TopicKey,
        inward: &Inward,
        mut ingress: Ingress,
        old: Option<Incoming>,
        max_bytes: usize,
        claims: ClaimQueue,
    ) -> zenoh::Result<Self> {
        let qos = &inward.qos;
        let is_kept = qos.durability == Durability::TransientLocal;
        let mut kept = is_kept.then(|| KeptSamples::new(qos.depth, qos.reliability == Reliability::Reliable));
        let entrance: Arc<Entrance> = old.as_ref().map(|old| old.entrance.clone()).unwrap_or_default();
        // Zenoh's threads wait for this lock with their samples until the new gate exists.
        let mut inside = entrance.0.lock();
        let mut waiting = Vec::new();
        if let Some(Way { kept: former, port }) = old.as_ref().and_then(|old| old.gate.0.lock().take()) {
            if let (Some(kept), Some(former)) = (&mut kept, former) {
                kept.take_over(former);
            }
            let SampleAdmission { ingress: former, mut unclaimed, .. } = port;
            // All publishers of a network are one class, so the tracking of their sequence numbers continues.
            ingress.take_over(former, false);
            waiting.extend(std::iter::from_fn(|| unclaimed.pop()));
        }
        let gate = Arc::new_cyclic(|gate: &Weak<Gate>| {
            let unclaimed = Unclaimed::new(gate.clone(), claims);
            Gate(PiMutex::new(Some(Way { kept, port: SampleAdmission { ingress, max_bytes, unclaimed } })))
        });
        gate.with(|way| {
            waiting.into_iter().for_each(|(sample, source)| way.port.keep_unclaimed(sample, source));
        });
        let requests =
            Requests { session: session.clone(), gate: Arc::downgrade(&gate), key: key.to_string() };
        *inside = Some(requests.clone());
        drop(inside);
        let samples = match old {
            Some(old) => old.samples,
            None => Entrance::declare(&entrance, session, key)?,
        };
        let mut retries = None;
        if is_kept {
            // After subscribing to samples: so a sample that is published after the response to a request arrives, too.
            let _publishers = requests.watch()?;
            let (keeping, count, next) = (BTreeMap::new(), 0, Instant::now());
            retries = Some(Retries { requests, keeping, count, next, _publishers });
        }
        Ok(Incoming { entrance, gate, retries, samples })
    }

    pub(crate) fn is_kept(&self) -> bool {
        self.retries.is_some()
    }

    /// Requests missing kept samples again: Zenoh may have announced a publisher late or not at all, or a request was lost. `keeping` is
    /// the number of each session's publishers of this topic that keep samples, according to the graph. Call it periodically.
    pub(crate) fn retry(&mut self, keeping: &BTreeMap<SessionId, usize>) {
        let Some(retries) = &mut self.retries else { return };
        let now = Instant::now();
        if retries.keeping != *keeping {
            let next = now + RETRY_TIME;
            (retries.keeping, retries.count, retries.next) = (keeping.clone(), 0, next);
        }
        if retries.count >= MOST_RETRIES || now < retries.next {
            return;
        }
        retries.next = now + RETRY_TIME * (2 << retries.count);
        retries.count += 1;
        let missing = self.gate.with(|way| way.kept.as_ref().map(|kept| kept.missing(keeping)));
        missing.into_iter().flatten().for_each(|request| retries.requests.send(Some(request)));
    }

    /// Takes only the last samples of publishers that are not `present`. Returns whether there are such publishers.
    pub(crate) fn close(&self, present: &BTreeSet<Gid>) -> bool {
        self.gate.with(|way| way.port.ingress.close(present))
    }

    pub(crate) fn change(&self, change: IngressUpdate) {
        self.gate.with(|way| way.port.ingress.change(change));
    }

    /// Validates messages by this definition from now on.
    pub(crate) fn describe(&self, schema: &Arc<Schema>) {
        self.gate.with(|way| way.port.ingress.describe(schema.clone()));
    }
}

/// The callbacks' reference to the present gate: the subscriptions on the network outlive a gate.
#[derive(Default)]
struct Entrance(PiMutex<Option<Requests>>);

impl Entrance {
    fn declare(
        entrance: &Arc<Entrance>,
        session: &Session,
        key: &TopicKey,
    ) -> zenoh::Result<[Subscriber<()>; 2]> {
        let (of_group, of_topic) = (entrance.clone(), entrance.clone());
        // Newer publishers of types with an unbounded `uint8[]`, such as images, use this key.
        let cpu_group = session.declare_subscriber(key.cpu_group()).allowed_origin(Locality::Remote);
        // Sequence numbers under this key also count samples for other subscriptions: gaps are not losses.
        let cpu_group = cpu_group.callback(move |sample| {
            of_group.pass(|way| {
                way.port.take(sample, false);
                None
            });
        });
        let cpu_group = cpu_group.wait()?;
        let samples = session.declare_subscriber(key.to_string()).allowed_origin(Locality::Remote);
        let samples = samples.callback(move |sample| of_topic.pass(|way| way.receive(sample)));
        Ok([cpu_group, samples.wait()?])
    }

    /// # Real-time
    /// Two locks that inherit priority; what a sample costs is [`Ingress::receive`]'s. Waits while a new gate takes over.
    fn pass(&self, receive: impl FnOnce(&mut Way) -> Option<Request>) {
        let inside = self.0.lock();
        let Some(requests) = &*inside else { return };
        let Some(gate) = requests.gate.upgrade() else { return };
        let Some(request) = gate.with(receive) else { return };
        let requests = requests.clone();
        drop(inside);
        requests.send(Some(request));
    }
}

/// Requests the samples that the publishers of a topic keep.
#[derive(Clone)]
struct Requests {
    session: Session,
    gate: Weak<Gate>,
    /// The topic's key expression.
    key: String,
}

impl Requests {
    /// Subscribes to the tokens and heartbeats of publishers, and requests the tokens of existing publishers.
    fn watch(&self) -> zenoh::Result<[Subscriber<()>; 2]> {
        let publishers = format!("{}/@adv/pub/**", self.key);
        let (coming, beating) = (self.clone(), self.clone());
        let tokens = self.session.liveliness().declare_subscriber(publishers.clone());
        let tokens = tokens.callback(move |token| coming.send(coming.token(&token))).wait()?;
        let numbers = self.session.declare_subscriber(publishers.clone()).allowed_origin(Locality::Remote);
        let numbers = numbers.callback(move |number| beating.send(beating.heartbeat(&number))).wait()?;
        let start = Start { requests: self.clone(), found: PiMutex::default() };
        let found = self.session.liveliness().get(publishers).timeout(START_TIMEOUT);
        found.callback(move |token| token.result().into_iter().for_each(|token| start.add(token))).wait()?;
        Ok([tokens, numbers])
    }

    fn with_kept(&self, act: impl FnOnce(&mut KeptSamples<Sample>) -> Option<Request>) -> Option<Request> {
        self.gate.upgrade()?.with(|way| act(way.kept.as_mut()?))
    }

    /// Handles a publisher's token, which appeared or ended.
    fn token(&self, token: &Sample) -> Option<Request> {
        let publisher = Publisher::of_token(token.key_expr().as_str(), self.session.zid())?;
        self.with_kept(|kept| match token.kind() {
            SampleKind::Put => kept.appeared(publisher),
            SampleKind::Delete => {
                kept.ended(publisher);
                None
            }
        })
    }

    /// Handles a heartbeat, which has the number of a publisher's last sample.
    fn heartbeat(&self, sample: &Sample) -> Option<Request> {
        let publisher = Publisher::of_token(sample.key_expr().as_str(), self.session.zid())?;
        let number = z_deserialize::<u32>(sample.payload()).ok()?;
        self.with_kept(|kept| kept.heartbeat(publisher, number))
    }

    fn send(&self, request: Option<Request>) {
        if let Some(request) = request {
            Answer::to(request, self).request();
        }
    }

    /// Sends from another thread: Zenoh drops callbacks while it holds a lock that sending takes.
    fn send_from_drop(&self, requests: Vec<Request>) {
        let answers: Vec<_> = requests.into_iter().map(|request| Answer::to(request, self)).collect();
        if answers.is_empty() {
            return;
        }
        let send = move || answers.into_iter().for_each(Answer::request);
        if let Err(error) = std::thread::Builder::new().name("gw-kept".into()).spawn(send) {
            tracing::warn!("what publishers of {} keep cannot be requested: {error}", self.key);
        }
    }
}

/// Collects requests to the existing publishers. Zenoh drops it when all are found, at the latest after the time-out.
struct Start {
    requests: Requests,
    found: PiMutex<Vec<Request>>,
}

impl Start {
    fn add(&self, token: &Sample) {
        let request = self.requests.token(token);
        self.found.lock().extend(request);
    }
}

impl Drop for Start {
    fn drop(&mut self) {
        if let Some(gate) = self.requests.gate.upgrade() {
            gate.with(Way::started);
        }
        self.requests.send_from_drop(std::mem::take(&mut *self.found.lock()));
    }
}

/// Collects the response to a request. The response is complete when this is dropped: by Zenoh, at the latest after the time-out, or
/// because the request cannot be sent.
struct Answer {
    requests: Requests,
    request: Request,
    response: PiMutex<Response<Sample>>,
}

impl Answer {
    fn to(request: Request, requests: &Requests) -> Self {
        Answer { requests: requests.clone(), request, response: PiMutex::default() }
    }

    fn request(self) {
        let Request { target, what, .. } = self.request;
        let cache = format!("{}/@adv/pub/{target}/**?{}", self.requests.key, what.parameters());
        let session = self.requests.session.clone();
        let get = session.get(&cache).allowed_destination(Locality::Remote).target(QueryTarget::All);
        let get = get.consolidation(ConsolidationMode::None).accept_replies(ReplyKeyExpr::Any);
        if let Err(error) = get.timeout(REQUEST_TIMEOUT).callback(move |reply| self.add(reply)).wait() {
            tracing::warn!("{cache} cannot be requested: {error}");
        }
    }

    fn add(&self, reply: Reply) {
        let Ok(sample) = reply.into_result() else { return };
        let is_wanted = sample.key_expr().as_str() == self.requests.key
            && sample.place().is_some_and(|(publisher, _)| self.request.target.includes(publisher));
        if is_wanted {
            self.response.lock().push(sample, &self.request);
        }
    }
}

impl Drop for Answer {
    fn drop(&mut self) {
        let Some(gate) = self.requests.gate.upgrade() else { return };
        let Response { samples, dropped, .. } = std::mem::take(&mut *self.response.lock());
        let lost = gate.with(|way| {
            (0..dropped).for_each(|_| way.port.ingress.counters().dropped(Dropped::Kept));
            way.answered(self.request.target, samples.into())
        });
        self.requests.send_from_drop(Vec::from_iter(lost));
    }
}

/// The path of incoming samples, shared by the threads of several links; `None` after another gate took over.
struct Gate(PiMutex<Option<Way>>);

impl Gate {
    fn with<T: Default>(&self, act: impl FnOnce(&mut Way) -> T) -> T {
        self.0.lock().as_mut().map(act).unwrap_or_default()
    }
}

impl Claimant for Gate {
    fn pass_waiting(&self, claimed: Claimed) -> Next {
        self.with(|way| way.port.pass_waiting(claimed))
    }
}

struct Way {
    /// `None`: the topic is not transient local.
    kept: Option<KeptSamples<Sample>>,
    port: SampleAdmission,
}

impl Way {
    fn receive(&mut self, sample: Sample) -> Option<Request> {
        let port = &mut self.port;
        match &mut self.kept {
            Some(kept) => kept.published(sample, &mut |sample| port.take(sample, true)),
            None => {
                port.take(sample, true);
                None
            }
        }
    }

    fn started(&mut self) {
        let port = &mut self.port;
        if let Some(kept) = &mut self.kept {
            kept.started(&mut |sample| port.take(sample, true));
        }
    }

    /// Handles the kept samples that publishers sent. Returns a request for lost samples.
    fn answered(&mut self, target: Target, samples: Vec<Sample>) -> Option<Request> {
        let (port, kept) = (&mut self.port, self.kept.as_mut()?);
        let mut deliver = |sample| port.take(sample, true);
        let (late, lost) = match target {
            Target::Publisher(publisher) => kept.answered(publisher, samples, &mut deliver),
            Target::Session(_) => (kept.answered_by_session(samples, &mut deliver), None),
        };
        port.ingress.counters().lost(late);
        lost
    }
}

struct SampleAdmission {
    ingress: Ingress,
    max_bytes: usize,
    unclaimed: Unclaimed,
}

impl SampleAdmission {
    fn take(&mut self, sample: Sample, are_numbers_whole: bool) {
        let source = match self.check(&sample) {
            Ok(source) => MessageMeta { are_numbers_whole, ..source },
            Err(reason) => return self.ingress.counters().dropped(reason),
        };
        let body = Payload(sample.payload());
        if self.unclaimed.is_empty()
            && self.ingress.missing_memory(&source.publisher, body.len_bytes()).is_none()
        {
            self.ingress.receive(&body, source);
        } else {
            self.keep_unclaimed(sample, source);
        }
    }

    fn keep_unclaimed(&mut self, sample: Sample, source: MessageMeta) {
        if !self.unclaimed.push(sample, source) {
            self.ingress.refuse(&source, Dropped::Unclaimed);
        }
    }

    /// Passes the first message that waits for memory, if its memory is claimed.
    fn pass_waiting(&mut self, claimed: Claimed) -> Next {
        let Some((sample, source)) = self.unclaimed.first() else { return Next::Done };
        let body = Payload(sample.payload());
        let missing = self.ingress.missing_memory(&source.publisher, body.len_bytes());
        match (missing, claimed) {
            (None, _) => self.ingress.receive(&body, *source),
            (Some(claimer), None) => return Next::Claim(claimer, body.len_bytes()),
            (Some(_), Some(claimed)) => {
                let reason = claimed.err().unwrap_or(LoanError::OutOfMemory);
                self.ingress.refuse(source, Refused::Loan(reason));
            }
        }
        self.unclaimed.pop();
        if self.unclaimed.is_empty() { Next::Done } else { Next::Pass }
    }

    /// Checks the attachment and encapsulation of a sample. Returns its metadata.
    fn check(&self, sample: &Sample) -> Result<MessageMeta, Dropped> {
        if sample.kind() != SampleKind::Put {
            return Err(Dropped::Deletion);
        }
        let attachment = parse_attachment(sample.attachment())?;
        let number = u64::try_from(attachment.sequence_number).map_err(|_| Dropped::Sequence)?;
        // However far ahead: a host without a battery-backed clock may be years behind all others.
        let timestamp_ns = attachment.source_timestamp_ns;
        if timestamp_ns < 0 {
            return Err(Dropped::Time);
        }
        let mut head = [0; ENCAPSULATION.len()];
        let copied = copy(sample.payload().slices(), 0, &mut head);
        check_encapsulation(head.get(..copied).unwrap_or_default())?;
        if sample.payload().len() - ENCAPSULATION.len() > self.max_bytes {
            return Err(Malformed::PayloadTooLong.into());
        }
        let (publisher, number) = (attachment.gid, Some(number));
        Ok(MessageMeta { publisher, number, are_numbers_whole: true, timestamp_ns })
    }
}

/// A payload's body, after its encapsulation, which was checked.
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
        tautline_rt::copy_to_shared(&mut to[at..at + len], &slice[..len]);
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
