// SPDX-License-Identifier: MIT OR Apache-2.0
//! The setup part of a publisher: its memory, and the subscriptions that it is connected to. The publisher and the matching code share
//! it. The thread that publishes works with a table that is handed over to it: see [`sender`](super::sender).

use crate::error::TransportError;
use crate::graph::own::OwnRecord;
use crate::graph::record::{PortKind, PortRecord};
use crate::memory::connection::{ReaderState, Shape};
use crate::memory::control::{PublisherControl, Traffic, View};
use crate::memory::file::{ArenaOwner, OwnMemory};
use crate::memory::header::Gid;
use crate::memory::pool::{MAX_SAMPLES, Pool, SEGMENTS, Segment, SegmentView, SegmentViews};
use crate::memory::sizes::{Demand, Window, grown_sample_bytes, sample_bytes};
use crate::qos::{Claim, Durability, Limits, Qos};
use crate::topic::chunks::{Chunks, Keyed};
use crate::topic::declaration::Topic;
use crate::topic::endpoints::{Endpoint, Endpoints, MatchCounts, Mismatch};
use crate::topic::writer::history::History;
use crate::topic::writer::sender::{
    PublishState, ReaderChannel, ReaderProxy, ReaderTable, SpareList, words_for,
};
use std::collections::{BTreeSet, HashSet};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tautline_doorbell::Slot;
use tautline_rt::{LatestWriter, PiMutex, affinity_of, latest};

/// The minimum number of samples that a publisher whose memory is claimed on use claims at once.
const FIRST_SAMPLES: usize = 4;
/// The number of responses for which a publisher has memory from the start: each of its clients gets other samples.
const FIRST_RESPONSES: usize = 16;
/// While its samples take less than this many bytes, a publisher that needs more of them gets twice as many, so that it seldom needs more.
/// As much is claimed ahead for relayed messages.
const DOUBLED_BYTES: usize = 1 << 20;

/// Whether this process and the processes of all subscriptions are bound to the same core.
fn is_on_one_core(proxies: &Chunks<ReaderProxy>) -> bool {
    let core_of = |process| affinity_of(process).ok().filter(|cores| cores.len() == 1);
    let Some(own) = core_of(std::process::id()) else { return false };
    let mut takers = proxies.iter().map(|proxy| &proxy.sender).filter(|sender| !sender.is_observer);
    takers.all(|sender| core_of(sender.process()) == Some(own))
}

/// What a publisher is made for, besides its topic.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PublisherRole {
    /// It is a relay's: it passes on the messages of other publishers.
    pub(crate) is_relay: bool,
    /// Each sample goes to one subscription: responses.
    pub(crate) is_addressed: bool,
    /// For a server's responses: the number of the port of its requests.
    pub(crate) partner: Option<u64>,
    /// The number of the port, if it was allocated before.
    pub(crate) number: Option<u64>,
}

pub(crate) struct PublisherCore {
    pub(crate) gid: Gid,
    pub(crate) topic: Topic,
    pub(crate) qos: Qos,
    pub(crate) limits: Limits,
    pub(crate) is_relay: bool,
    /// Each sample goes to one subscription: responses.
    pub(crate) is_addressed: bool,
    /// For a server's responses: the number of the port of its requests.
    partner: Option<u64>,
    pub(crate) slot: Arc<Slot>,
    pub(crate) history: Option<History>,
    /// The number of the last sample that was published.
    pub(crate) published: AtomicU64,
    pub(crate) traffic: Traffic,
    pub(crate) matched: Arc<MatchCounts>,
    /// The lock inherits priority: the janitor holds it while it maps memory, and a publishing thread may be a real-time one.
    setup: PiMutex<Setup>,
}

/// Guarded by a lock that publishing takes only to claim memory: for a message that is longer than all before, and in a publisher
/// that claims on use for each page of a queue, until the queue has all of its memory.
struct Setup {
    memory: Arc<OwnMemory>,
    record: Arc<OwnRecord>,
    control: Option<PublisherControl>,
    pool: Pool,
    /// The size of the samples that are loaned. There may also be segments with shorter samples, until none
    /// of these is in use.
    sample_bytes: usize,
    /// `sample_bytes` of the table that was handed over last, and of one that the publishing thread has read, or of an older one.
    handed_bytes: usize,
    read_bytes: usize,
    /// The segments have changed since this was last checked.
    has_grown: bool,
    /// Views of the segments, with the number of changes at which they were made.
    views: Option<(SegmentViews, u32)>,
    proxies: Chunks<ReaderProxy>,
    /// Senders that are not yet in a table that was handed over.
    unserved: Vec<Arc<ReaderChannel>>,
    retired: usize,
    /// The minimum length of the senders' lists of samples in use, now or after they took their spare lists, in words.
    words: usize,
    demand: Demand,
    endpoints: Endpoints,
    table: LatestWriter<Arc<ReaderTable>>,
    is_stale: bool,
}

impl Setup {
    fn note_read(&mut self) {
        if self.table.is_read() {
            self.read_bytes = self.read_bytes.max(self.handed_bytes);
        }
    }
}

/// A subscription as its record describes it.
pub(crate) struct DiscoveredSubscription {
    pub(crate) gid: Gid,
    pub(crate) port: PortRecord,
    pub(crate) owner: ArenaOwner,
}

impl PublisherCore {
    /// Makes the memory of a publisher that has no subscription yet.
    pub(crate) fn create(
        (memory, record): (&Arc<OwnMemory>, &Arc<OwnRecord>),
        gid: Gid,
        topic: Topic,
        qos: Qos,
        limits: Limits,
        role: PublisherRole,
        slot: Arc<Slot>,
    ) -> Result<(Arc<Self>, PublishState), TransportError> {
        let history = (qos.durability == Durability::TransientLocal).then(|| History::new(qos.depth));
        let sample_bytes = sample_bytes(topic.topic_type.body_bytes.unwrap_or(limits.message_bytes));
        let control = PublisherControl::create(memory, gid).map_err(|source| TransportError::Memory {
            topic: topic.name.clone(),
            bytes: memory.page_bytes(),
            sample_bytes,
            source,
        })?;
        let traffic = control.traffic();
        let claims_on_use = limits.claim == Claim::OnUse;
        let first = Arc::new(ReaderTable::empty(sample_bytes, claims_on_use));
        let (table, reader) = latest(first);
        let setup = Setup {
            memory: memory.clone(),
            record: record.clone(),
            has_grown: false,
            views: None,
            demand: Demand::of_publisher(&qos),
            control: Some(control),
            pool: Pool::default(),
            sample_bytes,
            handed_bytes: sample_bytes,
            read_bytes: sample_bytes,
            proxies: Chunks::default(),
            unserved: Vec::new(),
            retired: 0,
            words: 0,
            endpoints: Endpoints::default(),
            table,
            is_stale: true,
        };
        let core = PublisherCore {
            gid,
            topic,
            qos,
            limits,
            is_relay: role.is_relay,
            is_addressed: role.is_addressed,
            partner: role.partner,
            slot,
            history,
            published: AtomicU64::new(0),
            traffic,
            matched: Arc::default(),
            setup: PiMutex::new(setup),
        };
        let grown = core.grow(&mut core.setup.lock(), None);
        if let Err(error) = grown {
            core.release(|_| false, |_| false);
            return Err(error);
        }
        core.hand_over(&mut core.setup.lock());
        Ok((Arc::new(core), PublishState::new(reader)))
    }

    /// The publisher's entry in the record.
    pub(crate) fn record(&self, node: Option<u64>) -> PortRecord {
        let setup = self.setup.lock();
        PortRecord {
            node,
            relay: self.is_relay,
            slot: self.slot.index() as u32,
            at: setup.control.as_ref().map_or(0, PublisherControl::place),
            partner: self.partner,
            ..self.topic.record(PortKind::Publisher, &self.qos)
        }
    }

    /// Connects a subscription, unless it is known or does not match. True if it did: call [`settle`](Self::settle) afterwards.
    ///
    /// # Errors
    /// There is no shared memory for it: nothing has changed.
    pub(crate) fn connect(&self, target: &DiscoveredSubscription) -> Result<bool, TransportError> {
        let mut setup = self.setup.lock();
        if setup.control.is_none() || setup.endpoints.contains(target.gid) {
            return Ok(false);
        }
        let qos = target.port.qos.qos();
        let mismatch = self.mismatch(&target.port, &qos);
        let PortRecord { relay: is_relay, observer: is_observer, partner, .. } = target.port;
        let endpoint =
            Endpoint { mismatch, is_relay, is_observer, partner, ..Endpoint::new(target.gid, qos) };
        if let Some(mismatch) = mismatch {
            if !is_observer {
                self.topic.warn_of_mismatch(mismatch, "publisher", "subscription", &target.port);
            }
            setup.endpoints.set(endpoint);
            return Ok(false);
        }
        let slot = target.port.slot as usize;
        if !target.owner.reach(slot)? {
            // The memory of the subscription's participant has gone, and the subscription goes with it.
            return Ok(false);
        }
        let shape = target.port.shape(self.limits.loans);
        self.grow(&mut setup, Some(shape))?;
        let is_on_use = self.limits.claim == Claim::OnUse;
        let Setup { control: Some(control), pool, sample_bytes, words, .. } = &mut *setup else {
            return Ok(false);
        };
        let refuse = |source| self.no_memory(shape.queues_bytes() as u64, *sample_bytes, source);
        let connected = control.connect(target.gid, shape, if is_on_use { 0 } else { usize::MAX });
        let (connection, place) = connected.map_err(refuse)?;
        let owner = (target.owner.clone(), slot);
        let samples = pool.end().max(*words * 64);
        let is_own = target.gid.participant() == self.gid.participant();
        let sender = ReaderChannel::new(target.gid, is_own, shape, &target.port, owner, connection, samples);
        let history = self.history.as_ref().filter(|_| qos.durability == Durability::TransientLocal);
        if let Some(history) = history {
            if is_on_use {
                let claimed = control.claim_queues(&place, self.qos.depth.min(shape.depth));
                claimed.map_err(|source| {
                    control.disconnect(sender.connection(), place);
                    refuse(source)
                })?;
            }
            sender.preload(history, self.published.load(Ordering::Acquire), pool);
        }
        let (subscription, sender) = (target.gid, Arc::new(sender));
        setup.unserved.push(sender.clone());
        setup.proxies.insert(ReaderProxy { subscription, sender, place, spare: None });
        self.join(&mut setup.demand, shape);
        setup.endpoints.set(endpoint);
        setup.is_stale = true;
        if history.is_some() {
            // Before the next late joiner is connected: there is memory for one at a time.
            self.hand_over(&mut setup);
            self.top_up(&mut setup);
        }
        Ok(true)
    }

    fn mismatch(&self, port: &PortRecord, requested: &Qos) -> Option<Mismatch> {
        if !self.topic.topic_type.agrees_with(&port.topic_type()) {
            return Some(Mismatch::Type);
        }
        let takes_all = self.is_relay || port.relay || port.observer;
        self.qos.incompatibility(requested).filter(|_| !takes_all).map(Mismatch::Qos)
    }

    fn no_memory(&self, bytes: u64, sample_bytes: usize, source: io::Error) -> TransportError {
        TransportError::Memory { topic: self.topic.name.clone(), bytes, sample_bytes, source }
    }

    fn join(&self, demand: &mut Demand, Shape { depth, held, is_observer, .. }: Shape) {
        match self.is_addressed {
            true if is_observer => demand.observed = demand.observed.max(depth),
            // Each queue holds different samples.
            true => demand.depth = demand.depth.saturating_add(depth),
            false => demand.join(depth, 0),
        }
        demand.join(0, held);
    }

    /// Claims at once the memory for all subscriptions that are about to be connected.
    ///
    /// # Errors
    /// There is no shared memory for it.
    pub(crate) fn expect<'a>(
        &self,
        ports: impl Iterator<Item = &'a PortRecord>,
    ) -> Result<(), TransportError> {
        let mut setup = self.setup.lock();
        let fits = |port: &&PortRecord| self.mismatch(port, &port.qos.qos()).is_none();
        self.grow(&mut setup, ports.filter(fits).map(|port| port.shape(self.limits.loans)))
    }

    /// The number of samples that are claimed before they are needed.
    fn ahead(&self, demand: Demand, sample_bytes: usize) -> usize {
        let all = demand.samples(self.limits.loans);
        match self.limits.claim {
            Claim::OnUse => 0,
            Claim::Ahead if self.is_addressed => {
                all.min(self.limits.loans + FIRST_RESPONSES + demand.observed)
            }
            // The length of relayed messages is not stated.
            Claim::Ahead if self.is_relay => all.min(DOUBLED_BYTES / sample_bytes),
            Claim::Ahead => all + Window::of_machine().spare(demand, sample_bytes, all, &self.limits),
        }
    }

    /// Adds samples up to the number that is claimed ahead, for the subscriptions that are connected and for `more`.
    fn grow(&self, setup: &mut Setup, more: impl IntoIterator<Item = Shape>) -> Result<(), TransportError> {
        let mut demand = setup.demand;
        more.into_iter().for_each(|shape| self.join(&mut demand, shape));
        let (wanted, there) =
            (self.ahead(demand, setup.sample_bytes), setup.pool.samples(setup.sample_bytes));
        if there >= wanted {
            return Ok(());
        }
        self.add_samples(setup, wanted - there)
    }

    fn add_samples(&self, setup: &mut Setup, needed: usize) -> Result<(), TransportError> {
        let sample_bytes = setup.sample_bytes;
        let there = setup.pool.samples(sample_bytes);
        let is_small = (there + needed).saturating_mul(sample_bytes) < DOUBLED_BYTES;
        let is_crowded = setup.pool.segments().count() >= SEGMENTS / 2;
        let samples = if is_small || is_crowded { needed.max(there) } else { needed };
        let bytes = samples.saturating_mul(sample_bytes) as u64;
        let refuse = |source| self.no_memory(bytes, sample_bytes, source);
        let too_many = || io::Error::other("more samples, or segments of samples, than a publisher can have");
        let id = setup.pool.next_id().filter(|_| samples <= MAX_SAMPLES).ok_or_else(|| refuse(too_many()))?;
        let range = setup.memory.reserve(bytes).map_err(refuse)?;
        let make = || {
            setup.memory.claim(range)?;
            let map = setup.memory.map(range)?;
            map.populate(0, map.len_bytes(), true)?;
            Ok(map)
        };
        let map = make().map_err(|source| {
            setup.memory.release(range);
            refuse(source)
        })?;
        // The rest of the last page is used for samples, too.
        let samples = (map.len_bytes() / sample_bytes).clamp(samples, MAX_SAMPLES);
        let segment = Arc::new(Segment::new(id, range, map, sample_bytes, samples, setup.pool.end()));
        setup.pool.add(segment.clone());
        if let Some(control) = &setup.control {
            control.show_segment(&segment);
        }
        setup.record.grew();
        setup.has_grown = true;
        setup.is_stale = true;
        Ok(())
    }

    /// Claims at least one more sample, for a publisher whose memory is claimed on use, or which sends responses or relays. Large samples
    /// are claimed one by one at first, and never more than a quarter of those that exist.
    pub(crate) fn claim_more(&self) -> io::Result<()> {
        let mut setup = self.setup.lock();
        let there = setup.pool.samples(setup.sample_bytes);
        let most = setup.demand.samples(self.limits.loans);
        let doubled = there.max(FIRST_SAMPLES);
        let is_small = doubled.saturating_mul(setup.sample_bytes) < DOUBLED_BYTES;
        let more = if is_small { doubled } else { (there / 4).max(1) }.min(most.saturating_sub(there));
        if more == 0 || setup.control.is_none() {
            return Err(io::Error::other("all samples are in use, or the publisher has ended"));
        }
        self.add_samples(&mut setup, more).map_err(|error| match error {
            TransportError::Memory { source, .. } => source,
            other => io::Error::other(other.to_string()),
        })?;
        self.hand_over(&mut setup);
        Ok(())
    }

    /// Makes samples as long as a message of `len_bytes`, longer than all before, needs, or twice that at most. Returns their length.
    /// `is_publishing`: this is the publishing thread, which loans no shorter samples from now on.
    pub(crate) fn lengthen(&self, len_bytes: usize, is_publishing: bool) -> io::Result<usize> {
        let mut setup = self.setup.lock();
        let (before, wanted) = (setup.sample_bytes, grown_sample_bytes(len_bytes));
        if wanted <= before || setup.control.is_none() {
            return Ok(before);
        }
        setup.sample_bytes = wanted;
        if let Err(error) = self.grow(&mut setup, None) {
            setup.sample_bytes = before;
            return Err(io::Error::other(error.to_string()));
        }
        if is_publishing {
            setup.read_bytes = wanted;
        }
        self.forget_short_segments(&mut setup);
        self.hand_over(&mut setup);
        Ok(wanted)
    }

    /// Releases the segments of shorter samples of which none is in use, and from which the publishing thread loans no more.
    fn forget_short_segments(&self, setup: &mut Setup) {
        setup.note_read();
        let is_short =
            |segment: &&Arc<Segment>| segment.sample_bytes() < setup.read_bytes && segment.is_unused();
        let short: Vec<_> = setup.pool.segments().filter(is_short).cloned().collect();
        for segment in short {
            setup.views = None;
            setup.pool.remove(segment.id());
            if let Some(control) = &setup.control {
                control.hide_segment(segment.id());
            }
            setup.memory.release(segment.range);
            setup.record.grew();
            setup.is_stale = true;
        }
    }

    /// Claims the memory of a subscription's queues for `samples` samples, if it is claimed on use.
    pub(crate) fn claim_queues(&self, subscription: Gid, samples: usize) -> io::Result<()> {
        let mut setup = self.setup.lock();
        let Setup { control: Some(control), proxies, .. } = &mut *setup else { return Ok(()) };
        match proxies.get(subscription) {
            Some(proxy) => control.claim_queues(&proxy.place, samples),
            None => Ok(()),
        }
    }

    /// Disconnects a subscription that has gone, perhaps with its process. True if it had attached and may still hold samples: see
    /// [`disconnect_closed`](Self::disconnect_closed). Call [`settle`](Self::settle) afterwards.
    pub(crate) fn disconnect(&self, subscription: Gid, is_dead: bool) -> bool {
        let mut setup = self.setup.lock();
        setup.endpoints.remove(subscription, is_dead);
        let Setup { proxies, pool, is_stale, retired, demand, .. } = &mut *setup;
        let Some(ReaderProxy { sender, place, .. }) = proxies.get(subscription) else { return false };
        if !is_dead && sender.block().back.state() == ReaderState::Attached {
            if !sender.is_leaving() {
                sender.leave();
                // The samples in its queue stay there while the other subscriptions go on.
                demand.join(0, place.shape.depth);
                if let Err(error) = self.grow(&mut setup, None) {
                    tracing::warn!(
                        "loans may fail until a subscription that has gone has returned its samples: {error}"
                    );
                }
            }
            return true;
        }
        *retired += usize::from(sender.retire(pool));
        *is_stale = true;
        false
    }

    /// Retires the subscriptions that have gone and have closed their connections by now, or whose participants no longer exist. True if
    /// others have not.
    pub(crate) fn disconnect_closed(&self, is_there: impl Fn(u64) -> bool) -> bool {
        let mut setup = self.setup.lock();
        let Setup { proxies, pool, is_stale, retired, .. } = &mut *setup;
        let mut is_held_up = false;
        for sender in proxies.iter().map(|proxy| &proxy.sender).filter(|sender| sender.is_leaving()) {
            let is_closed = sender.block().back.state() == ReaderState::Closed;
            if is_closed || !is_there(sender.subscription.participant()) {
                *retired += usize::from(sender.retire(pool));
                *is_stale = true;
            } else {
                is_held_up = true;
            }
        }
        is_held_up
    }

    /// Whether the publisher has added segments since the last call.
    pub(crate) fn take_grown(&self) -> bool {
        std::mem::take(&mut self.setup.lock().has_grown)
    }

    /// The participants of its subscriptions.
    pub(crate) fn participants(&self) -> BTreeSet<u64> {
        self.setup.lock().proxies.iter().map(|proxy| proxy.sender.subscription.participant()).collect()
    }

    /// Sets the endpoints on other hosts, with their tags, and the tags of those that have ended by themselves.
    pub(crate) fn set_remote(&self, told: &[(Gid, u64)], ended: &HashSet<u64>) {
        self.setup.lock().endpoints.set_remote(told, ended);
    }

    /// Hands over what has changed, and notifies monitors. Returns whether the endpoints of the topic have changed.
    pub(crate) fn settle(&self) -> bool {
        let mut setup = self.setup.lock();
        self.forget_drained(&mut setup);
        self.forget_short_segments(&mut setup);
        if setup.is_stale {
            self.hand_over(&mut setup);
            self.top_up(&mut setup);
        }
        let has_changed = setup.endpoints.notify(&self.matched);
        if has_changed {
            self.slot.doorbell().arena().ring_events(self.slot.index());
            // The publisher's task may wait for room in a queue that has gone.
            self.slot.ring();
        }
        has_changed
    }

    /// Gives late joiners what was published while they were set up, by a thread that had not seen them yet. The publishing thread checks
    /// for a new table after it has published, and this function checks for new samples after the table was handed over: one of the two
    /// sees what the other did.
    fn top_up(&self, setup: &mut Setup) {
        let Some(history) = &self.history else { return };
        std::sync::atomic::fence(Ordering::SeqCst);
        // Bounded: a publisher that publishes this often takes over the tables that it is handed.
        for _ in 0..64 {
            let published = self.published.load(Ordering::Acquire);
            let mut has_more = false;
            for ReaderProxy { sender, .. } in setup.proxies.iter().filter(|one| one.sender.lacks(published)) {
                let Some(is_new) = sender.preload(history, published, &setup.pool) else { continue };
                // The sender was held for a moment: the publishing thread may have skipped it, even if no sample was left for it.
                has_more = true;
                if is_new {
                    sender.ring();
                }
            }
            if !has_more {
                return;
            }
            // Again, for senders that the publishing thread skipped while they were held.
            self.hand_over(setup);
            std::sync::atomic::fence(Ordering::SeqCst);
        }
    }

    fn forget_drained(&self, setup: &mut Setup) {
        if setup.retired == 0 {
            return;
        }
        let Setup { proxies, retired, control, is_stale, demand, .. } = setup;
        let drained = proxies.iter().filter(|proxy| proxy.sender.is_drained());
        let drained: Vec<Gid> = drained.map(Keyed::key).collect();
        if drained.is_empty() {
            return;
        }
        for proxy in drained.iter().filter_map(|gid| proxies.remove(*gid)) {
            if let Some(control) = control {
                control.disconnect(proxy.sender.connection(), proxy.place);
            }
        }
        *retired -= drained.len();
        *is_stale = true;
        *demand = Demand::of_publisher(&self.qos);
        for ReaderProxy { sender, place, .. } in proxies.iter() {
            self.join(demand, place.shape);
            if sender.is_leaving() {
                demand.join(0, place.shape.depth);
            }
        }
    }

    fn hand_over(&self, setup: &mut Setup) {
        setup.is_stale = false;
        let words = words_for(setup.pool.end());
        if setup.words < words {
            setup.words = words;
            let short = setup.proxies.iter().filter(|proxy| proxy.sender.room() < words * 64);
            for gid in short.map(Keyed::key).collect::<Vec<_>>() {
                // A sender that the publishing thread has not adopted yet gets its longer list at once.
                if let Some(proxy) = setup.proxies.get_mut(gid).filter(|one| !one.sender.enlarge(words)) {
                    proxy.spare = Some(Arc::new(SpareList::new(words)));
                }
            }
        }
        setup.note_read();
        setup.handed_bytes = setup.sample_bytes;
        let in_turn = Window::of_machine().in_turn(setup.sample_bytes);
        let in_turn = if in_turn > 1 && is_on_one_core(&setup.proxies) { 1 } else { in_turn };
        let table = ReaderTable {
            proxies: setup.proxies.clone(),
            pool: setup.pool.for_publishing(setup.sample_bytes, in_turn),
            claims_on_use: self.limits.claim == Claim::OnUse,
        };
        setup.table.write(Arc::new(table));
        setup.unserved.drain(..).for_each(|sender| sender.block().out.serve());
    }

    /// The memory that a subscription of the same process maps.
    pub(crate) fn view(&self) -> Option<View> {
        self.setup.lock().control.as_ref().map(View::of_own)
    }

    /// The segments that a subscription of the same process reads, and their change count. The same views as before if nothing has changed.
    pub(crate) fn segment_views(&self) -> (SegmentViews, u32) {
        let mut setup = self.setup.lock();
        let grown = setup.control.as_ref().map_or(0, |control| control.head().grown.load(Ordering::Acquire));
        if let Some(views) = setup.views.as_ref().filter(|(_, of)| *of == grown) {
            return views.clone();
        }
        let mut views: Vec<Option<SegmentView>> = Vec::new();
        for segment in setup.pool.segments() {
            views.resize(views.len().max(segment.id() + 1), None);
            let (map, sample_bytes) = (segment.map.clone(), segment.sample_bytes());
            views[segment.id()] = Some(SegmentView { map, sample_bytes, place: segment.range.offset });
        }
        setup.views.insert((views.into(), grown)).clone()
    }

    pub(crate) fn monitor(&self) -> tautline_rt::LatestReader<Arc<crate::topic::endpoints::EndpointList>> {
        self.setup.lock().endpoints.monitor()
    }

    /// Marks the publisher as ended: no thread publishes any more. Samples that were sent stay until they are taken.
    pub(crate) fn end(&self) {
        let mut setup = self.setup.lock();
        if let Some(history) = &self.history {
            history.release(&setup.pool);
        }
        if let Some(control) = &setup.control {
            control.end();
        }
        setup.is_stale = false;
    }

    /// Gives the memory back, if the publisher has ended and no subscription uses it: `is_there` says which participants are alive,
    /// `is_listed` which subscriptions exist. Returns false if a subscription still uses it.
    pub(crate) fn release(&self, is_there: impl Fn(u64) -> bool, is_listed: impl Fn(Gid) -> bool) -> bool {
        let mut setup = self.setup.lock();
        let Setup { proxies, pool, retired, .. } = &mut *setup;
        let is_done = |sender: &ReaderChannel| match sender.block().back.state() {
            ReaderState::Unknown => !is_listed(sender.subscription),
            ReaderState::Attached => !is_there(sender.subscription.participant()),
            ReaderState::Closed => true,
        };
        for sender in proxies.iter().map(|proxy| &proxy.sender).filter(|sender| is_done(sender)) {
            *retired += usize::from(sender.retire_finally(pool));
        }
        self.forget_drained(&mut setup);
        if setup.proxies.len() > 0 {
            return false;
        }
        let segments: Vec<_> = setup.pool.segments().map(|segment| segment.range).collect();
        segments.into_iter().for_each(|range| setup.memory.release(range));
        (setup.pool, setup.views) = (Pool::default(), None);
        if let Some(control) = setup.control.take() {
            control.release();
        }
        true
    }

    /// Whether an existing subscription has not found its connection, or all segments, yet.
    pub(crate) fn is_awaited(&self, is_listed: impl Fn(Gid) -> bool) -> bool {
        let setup = self.setup.lock();
        let Some(control) = &setup.control else { return false };
        let grown = control.head().grown.load(Ordering::Acquire);
        let is_behind = |sender: &ReaderChannel| sender.block().back.is_behind(grown);
        setup
            .proxies
            .iter()
            .any(|ReaderProxy { sender, .. }| is_behind(sender) && is_listed(sender.subscription))
    }
}
