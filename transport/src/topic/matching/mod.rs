// SPDX-License-Identifier: MIT OR Apache-2.0
//! Matching: finds publishers and subscriptions for each other, and connects them.
//!
//! Each participant connects its own publishers: only this participant makes and removes connections in their memory. A participant that
//! creates a port first writes it to its record, and then reads the other records. So if two ports are created at the same time, at least
//! one sees the other:
//!
//! - A new publisher connects all subscriptions that it finds, of any participant, before it can be used to publish.
//! - A new subscription connects itself to the publishers of its own participant, and calls the janitors of the other participants,
//!   which connect it ([`Matcher::refresh`]). It waits for them for a limited time, because a process may be stopped.
//! - The subscription's participant finds new connections in the publisher's memory, and maps the memory that is needed to
//!   take from them.
//!
//! So threads that publish and take find everything prepared. One lock per participant guards this work; those threads never take it.

mod index;
#[cfg(all(test, not(taut_loom)))]
mod tests;

use crate::cleanup::janitor::LookOutcome;
use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::graph::events::GraphListeners;
use crate::graph::log::hash_of;
use crate::graph::own::{NodeEntry, OwnRecord};
use crate::graph::record::{PortKind, PortRecord};
use crate::graph::remote::RemoteGraph;
use crate::memory::file::{ArenaOwner, Peers};
use crate::memory::header::Gid;
use crate::topic::matching::index::{Index, IndexUpdate, warn_once};
use crate::topic::reader::core::{DiscoveredPublisher, SubscriptionCore};
use crate::topic::reader::source::{PeerPublishers, PublisherMemory};
use crate::topic::writer::core::{DiscoveredSubscription, PublisherCore};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use tautline_rt::PiMutex;
use tautline_rt::clock::{monotonic_ns, nanoseconds};

/// How long a new subscription waits for the participants of existing publishers.
const PATIENCE: Duration = Duration::from_millis(100);

pub(crate) struct Matcher {
    domain: Arc<Domain>,
    record: Arc<OwnRecord>,
    listeners: Arc<GraphListeners>,
    state: PiMutex<MatcherState>,
}

struct MatcherState {
    domain: Arc<Domain>,
    peers: Peers,
    index: Index,
    peer_publishers: PeerPublishers,
    publishers: BTreeMap<u64, Arc<PublisherCore>>,
    subscriptions: BTreeMap<u64, Arc<SubscriptionCore>>,
    /// The same ports by the hash of their topics' names.
    by_topic: HashMap<u64, OwnPorts>,
    /// Publishers with subscriptions that have ended and still hold samples.
    held_up: BTreeSet<u64>,
    /// Publishers of other participants that ended before this participant saw them, until their samples have
    /// been found.
    ended: Vec<(Gid, PortRecord)>,
    /// Publishers that have ended, until none of their samples is in use.
    departing: BTreeMap<u64, Arc<PublisherCore>>,
    /// Subscriptions that have ended, until their samples have been returned.
    returning: Vec<Arc<SubscriptionCore>>,
}

/// The ports of this participant on a topic, by their numbers.
#[derive(Default)]
struct OwnPorts {
    publishers: BTreeSet<u64>,
    subscriptions: BTreeSet<u64>,
}

/// The work that a change of the domain, or of an own port, makes necessary.
#[derive(Default)]
struct Work {
    /// Own ports that were changed.
    publishers: BTreeMap<u64, Arc<PublisherCore>>,
    subscriptions: BTreeMap<u64, Arc<SubscriptionCore>>,
    /// Participants whose janitors must be called.
    calls: BTreeSet<u64>,
    /// Publishers of other participants that own subscriptions have expected since this work began.
    asked: Vec<(Arc<SubscriptionCore>, Gid)>,
    /// Publishers that subscriptions of this participant no longer use.
    closed: BTreeSet<Gid>,
    /// Own publishers whose memory was given back.
    released: Vec<u64>,
    /// Own ports match others than before.
    has_new_matches: bool,
    outcome: LookOutcome,
}

impl Work {
    fn publisher(&mut self, core: &Arc<PublisherCore>) {
        self.publishers.entry(core.gid.number()).or_insert_with(|| core.clone());
    }

    fn subscription(&mut self, core: &Arc<SubscriptionCore>) {
        self.subscriptions.entry(core.gid.number()).or_insert_with(|| core.clone());
    }
}

impl Matcher {
    pub(crate) fn new(
        domain: &Arc<Domain>,
        own: u64,
        record: &Arc<OwnRecord>,
        listeners: &Arc<GraphListeners>,
    ) -> Self {
        let state = MatcherState {
            domain: domain.clone(),
            peers: Peers::default(),
            index: Index::new(own),
            peer_publishers: PeerPublishers::default(),
            publishers: BTreeMap::new(),
            subscriptions: BTreeMap::new(),
            by_topic: HashMap::new(),
            held_up: BTreeSet::new(),
            ended: Vec::new(),
            departing: BTreeMap::new(),
            returning: Vec::new(),
        };
        let (domain, record, listeners) = (domain.clone(), record.clone(), listeners.clone());
        Matcher { domain, record, listeners, state: PiMutex::new(state) }
    }

    /// Runs `what` with the lock held, settles what it changed, and then calls the janitors that this concerns.
    fn work<T>(&self, what: impl FnOnce(&mut MatcherState, &mut Work) -> T) -> (T, LookOutcome) {
        let mut work = Work::default();
        let result = {
            let mut state = self.state.lock();
            let result = what(&mut state, &mut work);
            state.settle(&mut work);
            result
        };
        // The record has no entry of most of them any more.
        work.released.iter().for_each(|number| self.record.forget(*number));
        if !work.calls.is_empty() {
            for member in self.domain.members().filter(|member| work.calls.contains(&member.id)) {
                self.domain.call(member.place);
            }
        }
        if work.has_new_matches {
            self.listeners.advance_matches();
        }
        (result, work.outcome)
    }

    /// As [`work`](Self::work), for callers other than the janitor: they leave to it what cannot be done now.
    fn work_and_leave<T>(&self, what: impl FnOnce(&mut MatcherState, &mut Work) -> T) -> T {
        let (result, outcome) = self.work(what);
        if let Some(place) = self.record.place().filter(|_| outcome.is_pending) {
            self.domain.call(place);
        }
        result
    }

    /// Announces a publisher, and connects the existing subscriptions.
    pub(crate) fn add_publisher(
        &self,
        core: &Arc<PublisherCore>,
        node: Option<&NodeEntry>,
    ) -> Result<(), TransportError> {
        let port = core.record(node.map(|node| node.number));
        let added = self.work_and_leave(|state, work| {
            self.record.add_port(core.gid.number(), &port)?;
            state.publishers.insert(core.gid.number(), core.clone());
            state.by_topic.entry(core.topic.hash()).or_default().publishers.insert(core.gid.number());
            state.connect_all(core, work)
        });
        added.inspect_err(|_| self.remove_publisher(core))
    }

    /// Announces a subscription, and has it connected to the existing publishers.
    pub(crate) fn add_subscription(
        &self,
        core: &Arc<SubscriptionCore>,
        node: Option<&NodeEntry>,
    ) -> Result<(), TransportError> {
        let port = core.record(node.map(|node| node.number));
        let added = self.work_and_leave(|state, work| {
            self.record.add_port(core.gid.number(), &port)?;
            state.subscriptions.insert(core.gid.number(), core.clone());
            state.by_topic.entry(core.topic.hash()).or_default().subscriptions.insert(core.gid.number());
            state.find_all(core, work)
        });
        // On an error the caller drops the subscription, which removes it again.
        added?;
        self.wait_for_connections(core);
        Ok(())
    }

    /// Waits until the participants of all existing publishers have connected a new subscription, for at most `PATIENCE`. Messages of the
    /// publishers that are missing then arrive as soon as their processes go on.
    fn wait_for_connections(&self, core: &Arc<SubscriptionCore>) {
        let Some(place) = self.record.place().filter(|_| core.expected() > 0) else { return };
        let calls = self.domain.calls(place);
        let end = Instant::now() + PATIENCE;
        loop {
            // Read before the refresh: a participant that connects the subscription calls this one.
            let seen = calls.0.load(Ordering::Acquire);
            let left = self.work_and_leave(|state, work| {
                state.refresh(work);
                work.subscription(core);
                let left = core.attach();
                work.outcome.is_pending |= left.is_err();
                left
            });
            // The janitor retries what was refused.
            let Ok(left) = left.inspect_err(warn_once) else { return };
            let patience = end.saturating_duration_since(Instant::now());
            if left == 0 {
                return;
            }
            if patience.is_zero() {
                tracing::warn!(
                    "{}: {left} publishers do not answer: are their processes stopped, or without processor time? Their \
                     messages arrive when they answer",
                    core.topic.named()
                );
                return;
            }
            calls.wait(seen, Some(monotonic_ns() + nanoseconds(patience)));
        }
    }

    /// The number of nodes in the domain whose name has this hash.
    pub(crate) fn nodes(&self, hash: u64) -> usize {
        let others = self.work_and_leave(|state, work| {
            state.refresh(work);
            state.index.nodes(hash)
        });
        others + self.record.nodes(hash)
    }

    /// Announces the entities of other hosts, and calls the participants whose ports this concerns.
    pub(crate) fn set_remote(&self, remote: &RemoteGraph) -> Result<(), TransportError> {
        let mut topics = BTreeSet::new();
        let said = self.record.set_remote(remote, &mut topics);
        self.work_and_leave(|state, work| {
            // A participant that has created a port since then has read the announcement.
            state.refresh(work);
            work.calls.extend(topics.iter().flat_map(|hash| state.index.participants(*hash)));
        });
        said
    }

    /// Announces a new segment of a publisher in use, so that its subscriptions map it.
    pub(crate) fn announce_segments(&self, core: &Arc<PublisherCore>) {
        self.work_and_leave(|_, work| work.publisher(core));
    }

    /// Removes a publisher that has ended: no thread publishes with it any more.
    pub(crate) fn remove_publisher(&self, core: &Arc<PublisherCore>) {
        self.work_and_leave(|state, work| {
            // Before others see that it has gone: so they see that it ended, and was not killed.
            core.end();
            if core.is_awaited(|gid| state.index.has(gid, core.topic.hash())) {
                self.record.end(core.gid.number());
            } else {
                self.record.remove(core.gid.number());
            }
            state.publishers.remove(&core.gid.number());
            for subscription in state.own_subscriptions(core.topic.hash()) {
                subscription.disconnect(core.gid, false);
                work.subscription(&subscription);
            }
            // A participant that has created a subscription since then has read the removal.
            state.refresh(work);
            work.calls.extend(state.index.participants(core.topic.hash()));
            state.forget(core.topic.hash(), core.gid.number());
            state.departing.insert(core.gid.number(), core.clone());
            work.closed.insert(core.gid);
        });
    }

    /// Removes a subscription that has gone; its samples may still be borrowed.
    pub(crate) fn remove_subscription(&self, core: &Arc<SubscriptionCore>) {
        self.work_and_leave(|state, work| {
            self.record.remove(core.gid.number());
            state.subscriptions.remove(&core.gid.number());
            state.returning.push(core.clone());
            state.close_returned(work);
            for publisher in state.own_publishers(core.topic.hash()) {
                state.disconnect(&publisher, core.gid, false, work);
            }
            // A participant that has created a publisher since then has read the removal.
            state.refresh(work);
            work.calls.extend(state.index.participants(core.topic.hash()));
            state.forget(core.topic.hash(), core.gid.number());
        });
    }

    /// For the janitor: reads what has changed in the domain since the last refresh, and updates this participant's ports.
    pub(crate) fn refresh(&self) -> LookOutcome {
        let look = |state: &mut MatcherState, work: &mut Work| {
            state.refresh(work);
            // A participant that no longer uses an ended publisher of this one has called.
            let departing: Vec<u64> = state.departing.keys().copied().collect();
            state.release(departing, work);
        };
        self.work(look).1
    }

    /// Whether a subscription may still look for samples of this participant's publishers, when the participant ends.
    pub(crate) fn is_awaited(&self) -> bool {
        let mut state = self.state.lock();
        let MatcherState { index, peers, departing, domain, .. } = &mut *state;
        index.refresh(domain, peers);
        departing.values().any(|core| core.is_awaited(|gid| index.has(gid, core.topic.hash())))
    }
}

impl MatcherState {
    fn own_publishers(&self, hash: u64) -> Vec<Arc<PublisherCore>> {
        let own = self.by_topic.get(&hash).into_iter().flat_map(|own| &own.publishers);
        own.filter_map(|number| self.publishers.get(number).cloned()).collect()
    }

    fn own_subscriptions(&self, hash: u64) -> Vec<Arc<SubscriptionCore>> {
        let own = self.by_topic.get(&hash).into_iter().flat_map(|own| &own.subscriptions);
        own.filter_map(|number| self.subscriptions.get(number).cloned()).collect()
    }

    fn forget(&mut self, hash: u64, number: u64) {
        let Some(own) = self.by_topic.get_mut(&hash) else { return };
        own.publishers.remove(&number);
        own.subscriptions.remove(&number);
        if own.publishers.is_empty() && own.subscriptions.is_empty() {
            self.by_topic.remove(&hash);
        }
    }

    /// Connects a new publisher to all existing subscriptions.
    fn connect_all(&mut self, core: &Arc<PublisherCore>, work: &mut Work) -> Result<(), TransportError> {
        work.publisher(core);
        // First, so that no subscription that exists now is new later.
        self.refresh(work);
        // Participants whose records cannot be read now may be able to read this one's.
        work.calls.extend(self.index.refused());
        let own = self.own_subscriptions(core.topic.hash());
        let own: Vec<_> =
            own.into_iter().map(|subscription| (subscription.record(None), subscription)).collect();
        let peers = self.index.ports(core.topic.hash(), PortKind::Subscription);
        let ports = own.iter().map(|(port, _)| port).chain(peers.iter().map(|(_, port)| port));
        core.expect(ports.filter(|port| port.topic == core.topic.name))?;
        let port = core.record(None);
        for (requested, subscription) in own {
            self.connect_own((core, &port), (&subscription, requested), work)?;
        }
        for (gid, port) in peers {
            // Also for an incompatible subscription: its monitor reports the mismatch.
            work.calls.extend((port.topic == core.topic.name).then_some(gid.participant()));
            self.connect_peer(core, gid, port, work)?;
        }
        let told =
            self.index.remote(core.topic.hash(), PortKind::Subscription, &core.topic).unwrap_or_default();
        core.set_remote(&told, &HashSet::new());
        Ok(())
    }

    /// Finds the existing publishers for a new subscription.
    fn find_all(&mut self, core: &Arc<SubscriptionCore>, work: &mut Work) -> Result<(), TransportError> {
        work.subscription(core);
        self.refresh(work);
        work.calls.extend(self.index.refused());
        let requested = core.record(None);
        for publisher in self.own_publishers(core.topic.hash()) {
            let port = publisher.record(None);
            self.connect_own((&publisher, &port), (core, requested.clone()), work)?;
        }
        for (gid, port) in self.index.ports(core.topic.hash(), PortKind::Publisher) {
            work.calls.extend((port.topic == core.topic.name).then_some(gid.participant()));
            if let Err(error) = self.expect_peer(core, gid, port, work) {
                self.index.retry((gid, core.topic.hash()));
                warn_once(&error);
            }
        }
        let told = self.index.remote(core.topic.hash(), PortKind::Publisher, &core.topic).unwrap_or_default();
        core.set_remote(&told, &HashSet::new());
        if let Err(error) = core.attach() {
            work.outcome.is_pending = true;
            warn_once(&error);
        }
        Ok(())
    }

    /// Connects a publisher and a subscription of this participant.
    fn connect_own(
        &mut self,
        (publisher, offered): (&Arc<PublisherCore>, &PortRecord),
        (subscription, requested): (&Arc<SubscriptionCore>, PortRecord),
        work: &mut Work,
    ) -> Result<(), TransportError> {
        if offered.topic != requested.topic {
            return Ok(());
        }
        work.publisher(publisher);
        work.subscription(subscription);
        let owner = ArenaOwner::Own(subscription.slot.doorbell().clone());
        publisher.connect(&DiscoveredSubscription { gid: subscription.gid, port: requested, owner })?;
        let source = PublisherMemory::Own(publisher.clone());
        subscription.expect(DiscoveredPublisher::new(publisher.gid, offered.clone(), source));
        subscription.attach().map(drop)
    }

    /// Connects a publisher to a subscription of another participant.
    fn connect_peer(
        &mut self,
        core: &Arc<PublisherCore>,
        gid: Gid,
        port: PortRecord,
        work: &mut Work,
    ) -> Result<(), TransportError> {
        if port.topic != core.topic.name {
            return Ok(());
        }
        let Some(peer) = self.peers.get(self.domain.number(), gid.participant())? else { return Ok(()) };
        work.publisher(core);
        let target = DiscoveredSubscription { gid, port, owner: ArenaOwner::Peer(peer) };
        if core.connect(&target)? {
            work.calls.insert(gid.participant());
        }
        Ok(())
    }

    /// Makes a subscription expect a publisher of another participant.
    fn expect_peer(
        &mut self,
        core: &Arc<SubscriptionCore>,
        gid: Gid,
        port: PortRecord,
        work: &mut Work,
    ) -> Result<(), TransportError> {
        if port.topic != core.topic.name {
            return Ok(());
        }
        let Some(peer) = self.peers.get(self.domain.number(), gid.participant())? else { return Ok(()) };
        let Some(source) = self.peer_publishers.get(&peer, gid, port.at)? else { return Ok(()) };
        work.subscription(core);
        if core.expect(DiscoveredPublisher::new(gid, port, source)) {
            work.asked.push((core.clone(), gid));
        }
        Ok(())
    }

    fn disconnect(&mut self, core: &Arc<PublisherCore>, subscription: Gid, is_dead: bool, work: &mut Work) {
        work.publisher(core);
        if core.disconnect(subscription, is_dead) {
            self.held_up.insert(core.gid.number());
        }
    }

    /// Reads what has changed in other participants' records, and connects or disconnects the ports that this concerns. What is refused is
    /// retried later.
    fn refresh(&mut self, work: &mut Work) {
        let IndexUpdate { added, ended, removed, gone, is_refused, grown } =
            self.index.refresh(&self.domain, &mut self.peers);
        work.outcome.has_gone |= gone;
        work.outcome.is_pending |= is_refused;
        for (gid, hash, is_dead) in removed {
            for core in self.own_publishers(hash) {
                self.disconnect(&core, gid, is_dead, work);
            }
            for core in self.own_subscriptions(hash) {
                core.disconnect(gid, is_dead);
                work.subscription(&core);
            }
        }
        for (gid, hash) in added {
            if !self.by_topic.contains_key(&hash) {
                continue;
            }
            let Some(port) = self.index.port((gid, hash)) else { continue };
            let result = match port.kind {
                PortKind::Subscription => {
                    let mut own = self.own_publishers(hash).into_iter();
                    own.try_for_each(|core| self.connect_peer(&core, gid, port.clone(), work))
                }
                PortKind::Publisher => {
                    let mut own = self.own_subscriptions(hash).into_iter();
                    own.try_for_each(|core| self.expect_peer(&core, gid, port.clone(), work))
                }
            };
            if let Err(error) = result {
                self.index.retry((gid, hash));
                warn_once(&error);
            }
        }
        self.find_ended(ended, work);
        let remote_changes = self.index.take_remote_changes();
        let ended = if remote_changes.is_empty() { HashSet::new() } else { self.index.ended() };
        for hash in remote_changes {
            for core in self.own_publishers(hash) {
                if let Some(told) = self.index.remote(hash, PortKind::Subscription, &core.topic) {
                    core.set_remote(&told, &ended);
                }
                work.publisher(&core);
            }
            for core in self.own_subscriptions(hash) {
                if let Some(told) = self.index.remote(hash, PortKind::Publisher, &core.topic) {
                    core.set_remote(&told, &ended);
                }
                work.subscription(&core);
            }
        }
        let grown: Vec<Gid> = grown.into_iter().flat_map(|id| self.peer_publishers.grown(id)).collect();
        for core in self.subscriptions.values() {
            let has_called =
                core.has_called.load(Ordering::Acquire) && core.has_called.swap(false, Ordering::AcqRel);
            if has_called {
                work.outcome.is_pending |= core.map_segments(None).is_err();
                work.subscription(core);
            } else if !grown.is_empty() {
                for publisher in &grown {
                    work.outcome.is_pending |= core.map_segments(Some(*publisher)).is_err();
                }
                work.subscription(core);
            }
            if core.is_unfinished() {
                work.outcome.is_pending |= core.attach().is_err();
                work.subscription(core);
            }
        }
        self.close_returned(work);
        if self.held_up.is_empty() {
            return;
        }
        let is_there = self.members();
        for number in std::mem::take(&mut self.held_up) {
            let Some(core) = self.publishers.get(&number) else { continue };
            if core.disconnect_closed(&is_there) {
                self.held_up.insert(number);
            }
            work.publisher(core);
        }
    }

    /// Attaches subscriptions to publishers that were created and ended between two refreshes, for the samples that those sent.
    fn find_ended(&mut self, ended: Vec<((Gid, u64), Vec<u8>)>, work: &mut Work) {
        let ports = ended.into_iter().filter(|((_, hash), _)| self.by_topic.contains_key(hash));
        let ports = ports.filter_map(|((gid, _), body)| Some((gid, PortRecord::parse(&body)?)));
        self.ended.extend(ports.filter(|(_, port)| port.kind == PortKind::Publisher));
        for (gid, port) in std::mem::take(&mut self.ended) {
            let own = self.own_subscriptions(hash_of(&port.topic));
            let mut all = own.iter();
            match all.try_for_each(|core| self.expect_peer(core, gid, port.clone(), work)) {
                Ok(()) => own.iter().for_each(|core| core.disconnect(gid, false)),
                Err(error) => {
                    self.ended.push((gid, port));
                    work.outcome.is_pending = true;
                    warn_once(&error);
                }
            }
        }
    }

    /// Returns a function that says whether a participant is in the domain.
    fn members(&self) -> impl Fn(u64) -> bool + use<> {
        let members: BTreeSet<u64> = self.domain.members().map(|member| member.id).collect();
        let own = self.index.own;
        move |id| id == own || members.contains(&id)
    }

    /// Gives back the memory of those of these ended publishers that no subscription uses any more.
    fn release(&mut self, numbers: impl IntoIterator<Item = u64>, work: &mut Work) {
        if self.departing.is_empty() {
            return;
        }
        let is_there = self.members();
        for number in numbers {
            let Some(core) = self.departing.get(&number) else { continue };
            let is_listed = |gid: Gid| match gid.participant() == self.index.own {
                true => self.subscriptions.contains_key(&gid.number()),
                false => self.index.has(gid, core.topic.hash()),
            };
            if core.release(&is_there, is_listed) {
                self.departing.remove(&number);
                work.released.push(number);
            }
        }
    }

    /// Closes the connections of subscriptions that have gone, and whose samples have been returned by now.
    fn close_returned(&mut self, work: &mut Work) {
        self.returning.retain(|core| {
            let is_returned = core.is_returned.load(Ordering::Acquire);
            if is_returned {
                work.closed.extend(core.close());
            }
            !is_returned
        });
    }

    /// Hands over what has changed to the threads that publish and take, and gives back what nobody uses any more.
    fn settle(&mut self, work: &mut Work) {
        // A participant that has made the connection by now need not be called.
        let still = work.asked.drain(..).filter(|(core, gid)| core.expects(*gid));
        work.calls.extend(still.map(|(_, gid)| gid.participant()));
        // Segments of samples that publishers have made are mapped before samples come from there.
        let publishers = std::mem::take(&mut work.publishers);
        for core in publishers.values().filter(|core| core.take_grown()) {
            work.calls.extend(core.participants());
            for subscription in self.own_subscriptions(core.topic.hash()) {
                work.outcome.is_pending |= subscription.map_segments(Some(core.gid)).is_err();
                work.subscription(&subscription);
            }
        }
        // Before the publishers: a server learns that a client has gone before it can no longer respond to it.
        for core in work.subscriptions.values() {
            let (closed, is_closing, has_new_matches) = core.settle();
            work.closed.extend(closed);
            work.outcome.is_pending |= is_closing;
            work.has_new_matches |= has_new_matches;
        }
        for core in publishers.values() {
            work.has_new_matches |= core.settle();
        }
        work.outcome.is_pending |= self.index.has_retries();
        let own = self.index.own;
        work.calls.extend(work.closed.iter().map(|gid| gid.participant()));
        work.calls.remove(&own);
        let closed = work.closed.range(Gid::of(own, 0)..).take_while(|gid| gid.participant() == own);
        let numbers: Vec<u64> = closed.map(|gid| gid.number()).collect();
        self.release(numbers, work);
        self.peer_publishers.forget();
    }
}
