// SPDX-License-Identifier: MIT OR Apache-2.0
//! The setup part of a subscription: the publishers that it is connected to. The subscription and the matching code share it. The
//! thread that takes works with a table that is handed over to it: see [`receiver`](super::receiver).

use crate::error::TransportError;
use crate::graph::record::{PortKind, PortRecord};
use crate::memory::connection::ReaderState;
use crate::memory::header::Gid;
use crate::qos::{History, Limits, Liveliness, Qos};
use crate::topic::chunks::{Chunks, Keyed};
use crate::topic::declaration::Topic;
use crate::topic::endpoints::{Endpoint, EndpointList, Endpoints, LivelinessSource, MatchCounts, Mismatch};
use crate::topic::reader::receiver::{
    Receiver, ReceiverKind, TakeState, WriterEntry, WriterProxy, WriterTable,
};
use crate::topic::reader::source::PublisherMemory;
use std::collections::HashSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use tautline_doorbell::Slot;
use tautline_rt::{LatestReader, LatestWriter, PiMutex, latest};

/// The maximum number of ended publishers with samples that no take has seen: beyond it, the samples of the one that ended first are lost,
/// and counted.
const UNSEEN: usize = 64;

/// What a subscription is made for, besides its topic.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SubscriptionRole {
    /// It is a relay's: its messages are passed on.
    pub(crate) is_relay: bool,
    pub(crate) is_observer: bool,
    /// For a client's responses: the number of the port of its requests.
    pub(crate) partner: Option<u64>,
    /// The number of the port, if it was allocated before.
    pub(crate) number: Option<u64>,
}

pub(crate) struct SubscriptionCore {
    pub(crate) gid: Gid,
    pub(crate) topic: Topic,
    pub(crate) qos: Qos,
    pub(crate) limits: Limits,
    pub(crate) is_relay: bool,
    is_observer: bool,
    /// For a client's responses: the number of the port of its requests.
    partner: Option<u64>,
    pub(crate) slot: Arc<Slot>,
    pub(crate) matched: Arc<MatchCounts>,
    /// Samples of ended publishers that no take has seen and none will.
    pub(crate) forgotten: AtomicU64,
    /// The subscription has gone, and all its samples have been returned.
    pub(crate) is_returned: AtomicBool,
    /// The taking thread requests a refresh by the setup code: a sample cannot be reached, or an ended publisher has nothing left.
    pub(crate) has_called: AtomicBool,
    /// The number of publishers that are expected, or must be closed.
    unfinished: AtomicUsize,
    setup: PiMutex<Setup>,
}

struct Setup {
    proxies: Chunks<WriterProxy>,
    /// The publishers that have ended, in the order of their ends.
    ended: Vec<Gid>,
    /// Publishers that have ended, but to which a sample, or the table of the taking thread, still refers.
    closing: Vec<WriterProxy>,
    /// Publishers whose participant has not made a connection yet.
    expected: Vec<DiscoveredPublisher>,
    endpoints: Endpoints,
    table: LatestWriter<Arc<WriterTable>>,
    is_stale: bool,
}

/// A publisher as its record describes it.
pub(crate) struct DiscoveredPublisher {
    gid: Gid,
    port: PortRecord,
    source: PublisherMemory,
    /// It has ended; the value states whether together with its participant.
    gone: Option<bool>,
}

impl DiscoveredPublisher {
    pub(crate) fn new(gid: Gid, port: PortRecord, source: PublisherMemory) -> Self {
        DiscoveredPublisher { gid, port, source, gone: None }
    }
}

impl SubscriptionCore {
    pub(crate) fn create(
        gid: Gid,
        topic: Topic,
        qos: Qos,
        limits: Limits,
        role: SubscriptionRole,
        slot: Arc<Slot>,
    ) -> (Arc<Self>, TakeState) {
        let (table, reader) = latest(Arc::<WriterTable>::default());
        let setup = Setup {
            proxies: Chunks::default(),
            ended: Vec::new(),
            closing: Vec::new(),
            expected: Vec::new(),
            endpoints: Endpoints::default(),
            table,
            is_stale: false,
        };
        let core = SubscriptionCore {
            gid,
            topic,
            qos,
            limits,
            is_relay: role.is_relay,
            is_observer: role.is_observer,
            partner: role.partner,
            slot,
            matched: Arc::default(),
            forgotten: AtomicU64::new(0),
            is_returned: AtomicBool::new(false),
            has_called: AtomicBool::new(false),
            unfinished: AtomicUsize::new(0),
            setup: PiMutex::new(setup),
        };
        (Arc::new(core), TakeState::new(reader))
    }

    /// The subscription's entry in the record.
    pub(crate) fn record(&self, node: Option<u64>) -> PortRecord {
        PortRecord {
            node,
            relay: self.is_relay,
            observer: self.is_observer,
            slot: self.slot.index() as u32,
            at: self.limits.held as u64,
            partner: self.partner,
            ..self.topic.record(PortKind::Subscription, &self.qos)
        }
    }

    /// Adds a discovered publisher. True if its participant is to make a connection, which [`attach`](Self::attach) then finds.
    pub(crate) fn expect(&self, expected: DiscoveredPublisher) -> bool {
        let mut setup = self.setup.lock();
        let gid = expected.gid;
        if setup.endpoints.contains(gid) || setup.expected.iter().any(|other| other.gid == gid) {
            return false;
        }
        let qos = expected.port.qos.qos();
        match self.mismatch(&expected.port, &qos) {
            Some(mismatch) => {
                self.topic.warn_of_mismatch(mismatch, "subscription", "publisher", &expected.port);
                let is_relay = expected.port.relay;
                setup.endpoints.set(Endpoint {
                    mismatch: Some(mismatch),
                    is_relay,
                    ..Endpoint::new(gid, qos)
                });
                false
            }
            None => {
                setup.expected.push(expected);
                self.note_unfinished(&setup);
                true
            }
        }
    }

    fn mismatch(&self, port: &PortRecord, offered: &Qos) -> Option<Mismatch> {
        if !self.topic.topic_type.agrees_with(&port.topic_type()) {
            return Some(Mismatch::Type);
        }
        let takes_all = self.is_relay || self.is_observer || port.relay;
        offered.incompatibility(&self.qos).filter(|_| !takes_all).map(Mismatch::Qos)
    }

    /// Attaches publishers that are expected and whose participants have made a connection by now. Returns how many are still expected.
    /// Call [`settle`](Self::settle) afterwards.
    ///
    /// # Errors
    /// The system refuses to map a publisher's memory; others were attached.
    pub(crate) fn attach(&self) -> Result<usize, TransportError> {
        let mut setup = self.setup.lock();
        let mut error = None;
        let mut waiting = Vec::new();
        for expected in std::mem::take(&mut setup.expected) {
            match self.try_attach(&mut setup, &expected) {
                Ok(true) => {}
                Ok(false) if expected.gone.is_some() => {}
                Ok(false) => waiting.push(expected),
                Err(refused) => {
                    error = Some(refused);
                    waiting.push(expected);
                }
            }
        }
        setup.expected = waiting;
        self.note_unfinished(&setup);
        error.map_or(Ok(setup.expected.len()), Err)
    }

    fn try_attach(&self, setup: &mut Setup, expected: &DiscoveredPublisher) -> Result<bool, TransportError> {
        let DiscoveredPublisher { gid, port, source, gone } = expected;
        let Some(connection) = source.connection(self.gid, gone.is_some())? else { return Ok(false) };
        if connection.block().back.state() != ReaderState::Unknown {
            // It was attached before, and has been removed since.
            return Ok(false);
        }
        let slot = port.slot as usize;
        let owner = source.owner();
        owner.reach(slot)?;
        let (segments, grown) = source.segments()?;
        connection.bring_in();
        connection.block().back.mapped.store(grown, Ordering::Relaxed);
        connection.block().back.set_state(ReaderState::Attached);
        // A server's responses go to single clients, each of which has its own sequence numbers.
        let is_others = self.is_observer && port.partner.is_some();
        let qos = port.qos.qos();
        let both_keep_all =
            [qos.history, self.qos.history].map(|history| history == History::KeepAll) == [true; 2];
        let kind = match (is_others, both_keep_all) {
            (true, _) => ReceiverKind::Others,
            (false, true) => ReceiverKind::KeepsAll { depth: self.qos.depth },
            (false, false) => ReceiverKind::Overwritten,
        };
        let receiver = Arc::new(Receiver::new(*gid, kind, connection, source.head(), owner, slot));
        let has_lease =
            qos.liveliness == Liveliness::ManualByTopic && qos.liveliness_lease_duration.is_some();
        let liveliness = has_lease.then(|| LivelinessSource::new(receiver.connection().clone()));
        let PortRecord { relay: is_relay, partner, .. } = *port;
        setup.endpoints.set(Endpoint { is_relay, partner, liveliness, ..Endpoint::new(*gid, qos) });
        let entry = WriterEntry { receiver, segments, grown, has_ended: false };
        setup.proxies.insert(WriterProxy { publisher: *gid, source: source.clone(), entry });
        setup.is_stale = true;
        if let Some(is_dead) = gone {
            end(setup, *gid, *is_dead);
        }
        Ok(true)
    }

    pub(crate) fn expects(&self, publisher: Gid) -> bool {
        self.setup.lock().expected.iter().any(|expected| expected.gid == publisher)
    }

    /// How many publishers are expected.
    pub(crate) fn expected(&self) -> usize {
        self.setup.lock().expected.len()
    }

    /// Whether publishers are expected, or are to be closed.
    pub(crate) fn is_unfinished(&self) -> bool {
        self.unfinished.load(Ordering::Relaxed) != 0
    }

    fn note_unfinished(&self, setup: &Setup) {
        self.unfinished.store(setup.expected.len() + setup.closing.len(), Ordering::Relaxed);
    }

    /// Ends a publisher. `is_dead`: with its participant, so killed unless its memory says that it ended. Then [`settle`](Self::settle).
    pub(crate) fn disconnect(&self, publisher: Gid, is_dead: bool) {
        let mut setup = self.setup.lock();
        let is_expected = |expected: &DiscoveredPublisher| expected.gid == publisher;
        let Some(place) = setup.expected.iter().position(is_expected) else {
            return end(&mut setup, publisher, is_dead);
        };
        // Attaches it a last time, for what it sent before it was found.
        let mut expected = setup.expected.swap_remove(place);
        expected.gone = Some(is_dead);
        if self.try_attach(&mut setup, &expected).is_err() {
            setup.expected.push(expected);
        }
        self.note_unfinished(&setup);
    }

    /// Maps the segments that a publisher has added since the last call; those of all publishers for `None`.
    ///
    /// # Errors
    /// The system refuses.
    pub(crate) fn map_segments(&self, publisher: Option<Gid>) -> Result<(), TransportError> {
        let mut setup = self.setup.lock();
        let Setup { proxies, is_stale, .. } = &mut *setup;
        let all = || proxies.iter().map(Keyed::key).collect();
        for gid in publisher.map_or_else(all, |gid| vec![gid]) {
            let Some(known) = proxies.get(gid).filter(|known| !known.entry.has_ended) else { continue };
            let (segments, grown) = known.source.segments()?;
            // Release: pairs with the Acquire in `Back::is_behind`; the segments are mapped.
            known.entry.receiver.block().back.mapped.store(grown, Ordering::Release);
            if !Arc::ptr_eq(&segments, &known.entry.segments)
                && let Some(known) = proxies.get_mut(gid)
            {
                (known.entry.segments, known.entry.grown) = (segments, grown);
                *is_stale = true;
            }
        }
        Ok(())
    }

    /// Sets the endpoints on other hosts, with their tags, and the tags of those that have ended by themselves.
    pub(crate) fn set_remote(&self, told: &[(Gid, u64)], ended: &HashSet<u64>) {
        self.setup.lock().endpoints.set_remote(told, ended);
    }

    /// Hands over what has changed, rings for it, and notifies monitors. Returns the publishers whose connections were closed,
    /// whether others are still to be closed, and whether the endpoints of the topic have changed.
    pub(crate) fn settle(&self) -> (Vec<Gid>, bool, bool) {
        let mut setup = self.setup.lock();
        self.forget_unseen(&mut setup);
        // `close_done` hands over what is new, too.
        let was_stale = setup.is_stale;
        let (closed, is_closing) = close_done(&mut setup);
        self.note_unfinished(&setup);
        let is_stale = setup.is_stale;
        if is_stale {
            hand_over(&mut setup);
        }
        let has_changed = setup.endpoints.notify(&self.matched);
        if has_changed {
            self.slot.doorbell().arena().ring_events(self.slot.index());
        }
        if was_stale || is_stale {
            // Samples that were queued before it was attached rang nobody, and the former table still has what is closed. Last: a client
            // checks its servers when it is rung.
            self.slot.ring();
        }
        (closed, is_closing, has_changed)
    }

    /// Forgets ended publishers that no take has seen: those that have sent nothing, and all but the newest `UNSEEN`.
    fn forget_unseen(&self, setup: &mut Setup) {
        let ended = setup.ended.iter().filter_map(|gid| setup.proxies.get(*gid));
        let unseen: Vec<_> = ended.filter(|proxy| proxy.entry.receiver.is_new()).collect();
        let too_many = unseen.len().saturating_sub(UNSEEN);
        let mut has_forgotten = false;
        for (place, proxy) in unseen.into_iter().enumerate() {
            if (place < too_many || !proxy.entry.receiver.has_samples())
                && let Some(lost) = proxy.entry.receiver.forget()
            {
                self.forgotten.fetch_add(lost, Ordering::Relaxed);
                has_forgotten = true;
            }
        }
        setup.is_stale |= has_forgotten;
    }

    /// Closes the connections of a subscription that has gone, when its samples are back. Returns the publishers, which may reuse memory.
    pub(crate) fn close(&self) -> Vec<Gid> {
        let mut setup = self.setup.lock();
        setup.expected.clear();
        let close = |proxy: &WriterProxy| {
            proxy.entry.receiver.block().back.set_state(ReaderState::Closed);
            proxy.publisher
        };
        let proxies = std::mem::take(&mut setup.proxies);
        let closing = std::mem::take(&mut setup.closing);
        let proxies = proxies.iter().chain(&closing);
        let closed = proxies.map(close).collect();
        // No thread takes any more: the tables are dropped here, which keep the publishers' memory mapped.
        setup.table = latest(Arc::default()).0;
        closed
    }

    pub(crate) fn monitor(&self) -> LatestReader<Arc<EndpointList>> {
        self.setup.lock().endpoints.monitor()
    }
}

/// Marks a publisher as ended: what it sent is still taken, and nothing comes after it.
fn end(setup: &mut Setup, publisher: Gid, is_dead: bool) {
    let mut was_killed = false;
    if let Some(proxy) = setup.proxies.get_mut(publisher).filter(|proxy| !proxy.entry.has_ended) {
        was_killed = is_dead && !proxy.source.has_ended();
        // If mapping is refused, the samples in those segments are lost, and counted.
        if let Ok((segments, _)) = proxy.source.segments() {
            proxy.entry.segments = segments;
        }
        proxy.entry.has_ended = true;
        setup.ended.push(publisher);
        setup.is_stale = true;
    }
    setup.endpoints.remove(publisher, was_killed);
}

fn hand_over(setup: &mut Setup) {
    setup.is_stale = false;
    setup.table.write(Arc::new(WriterTable { proxies: setup.proxies.clone() }));
}

/// Closes the publishers that are done, once neither the taking thread's table nor a sample refers to them any more: they may reuse their
/// memory. Returns them, and whether others are still referred to.
fn close_done(setup: &mut Setup) -> (Vec<Gid>, bool) {
    let Setup { proxies, ended, closing, .. } = setup;
    ended.retain(|gid| {
        let is_done = proxies.get(*gid).is_none_or(|proxy| proxy.entry.receiver.is_done());
        if is_done {
            closing.extend(proxies.remove(*gid));
        }
        !is_done
    });
    if setup.closing.is_empty() {
        return (Vec::new(), false);
    }
    // Each write drops one of the tables that were handed over before, except the one that the taking thread has: that is dropped after the
    // thread has taken a new one.
    (0..2).for_each(|_| hand_over(setup));
    let mut closed = Vec::new();
    setup.closing.retain(|proxy| {
        let stays = Arc::strong_count(&proxy.entry.receiver) > 1;
        if !stays {
            // Acquire: all uses of the receiver by other threads are over.
            std::sync::atomic::fence(Ordering::Acquire);
            proxy.entry.receiver.block().back.set_state(ReaderState::Closed);
            closed.push(proxy.publisher);
        }
        stays
    });
    let is_closing = !setup.closing.is_empty();
    setup.is_stale = is_closing;
    (closed, is_closing)
}
