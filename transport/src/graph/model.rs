// SPDX-License-Identifier: MIT OR Apache-2.0
//! The whole graph, kept up to date from each participant's record. The cost of an update depends only on what has changed since
//! the last one.

use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::graph::entities::{
    Death, EndpointKind, GraphSnapshot, NodeInfo, NodeName, ServiceEndpoint, ServiceKind, TopicEndpoint,
};
use crate::graph::log::{EntryKind, LogEntry, Reader};
use crate::graph::origin::{Origin, Rank};
use crate::graph::record::{NodeRecord, PortKind, PortRecord, RemotePortRecord, RemoteServiceRecord};
use crate::memory::file::{PackedRange, Peer};
use crate::memory::header::Gid;
use crate::memory::ranges::Range;
use crate::names::{is_of_service, service_of};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::io::ErrorKind::WouldBlock;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// The `own` id of a reader that is not a participant.
pub(crate) const VISITOR: u64 = 0;

/// How long, and for how many publishers, their normal end is remembered.
const ENDED_TIME: Duration = Duration::from_secs(10);
const MOST_ENDED: usize = 4096;

/// What this process knows of a domain's graph.
#[derive(Default)]
pub(crate) struct Model {
    /// The participant that reads the graph, and whether it announces remote endpoints itself.
    own: u64,
    is_teller: bool,
    /// The domain's epoch when `snapshot` was made.
    pub(crate) epoch: Option<u32>,
    members: HashMap<u64, ParticipantRecord>,
    /// The listed entries, in order; the last part of a key names the source.
    nodes: BTreeSet<(Arc<NodeInfo>, Gid)>,
    endpoints: BTreeMap<(String, EndpointKind, Gid, Gid), Arc<TopicEndpoint>>,
    services: BTreeMap<(String, ServiceKind, Gid, Gid), Arc<ServiceEndpoint>>,
    /// The announcers of remote entities, by tag, the best one first.
    told: HashMap<u64, Vec<(Rank, Gid)>>,
    /// Tags of publishers that ended normally, and since when this is known.
    ended: VecDeque<(Instant, u64)>,
    /// Processes that ended without ending their endpoints and nodes; recorded only for a visitor.
    pub(crate) deaths: Vec<Death>,
    snapshot: Arc<GraphSnapshot>,
}

struct ParticipantRecord {
    /// `None`: the record is skipped.
    peer: Option<Peer>,
    generation: u64,
    reader: Reader,
    is_relay: bool,
    nodes: BTreeMap<u64, NodeRecord>,
    ports: BTreeMap<u64, PortRecord>,
    remote_ports: BTreeMap<u64, RemotePortRecord>,
    remote_services: BTreeMap<u64, RemoteServiceRecord>,
}

impl ParticipantRecord {
    fn new(peer: Option<Peer>) -> Self {
        ParticipantRecord {
            peer,
            generation: 0,
            reader: Reader::default(),
            is_relay: false,
            nodes: BTreeMap::new(),
            ports: BTreeMap::new(),
            remote_ports: BTreeMap::new(),
            remote_services: BTreeMap::new(),
        }
    }

    fn pid(&self) -> Option<u32> {
        self.peer.as_ref().map(Peer::pid).filter(|_| !self.is_relay)
    }

    fn numbers(&self) -> Vec<u64> {
        let services = self.remote_services.keys();
        self.nodes
            .keys()
            .chain(self.ports.keys())
            .chain(self.remote_ports.keys())
            .chain(services)
            .copied()
            .collect()
    }

    fn add(&mut self, entry: &LogEntry) {
        let (number, body) = (entry.number, &entry.body);
        match entry.kind {
            EntryKind::Gone | EntryKind::Ended => {}
            EntryKind::Node => self.nodes.extend(NodeRecord::parse(body).map(|node| (number, node))),
            EntryKind::Port => self.ports.extend(PortRecord::parse(body).map(|port| (number, port))),
            EntryKind::RemotePort => {
                self.remote_ports.extend(RemotePortRecord::parse(body).map(|port| (number, port)));
            }
            EntryKind::RemoteService => {
                self.remote_services.extend(RemoteServiceRecord::parse(body).map(|end| (number, end)));
            }
            EntryKind::Relay => self.is_relay = true,
            EntryKind::RemoteEnded => {}
        }
    }

    fn remove(&mut self, number: u64) {
        self.nodes.remove(&number);
        self.ports.remove(&number);
        self.remote_ports.remove(&number);
        self.remote_services.remove(&number);
    }

    fn node(&self, number: u64) -> Option<&NodeName> {
        self.nodes.get(&number).map(|node| &node.name)
    }

    /// The node or endpoint of the entry `number`, as the graph lists it; `None` if it is not listed.
    fn listed(&self, own: u64, id: u64, number: u64) -> Option<Listed> {
        if let Some(NodeRecord { name, enclave, origin }) = self.nodes.get(&number) {
            let (name, enclave) = (name.clone(), enclave.clone());
            let origin = origin.clone().unwrap_or_else(|| here(Gid::of(id, number)));
            let (is_remote, teller) = (self.is_relay, self.is_relay.then_some(id));
            return Some(Listed::Node(NodeInfo {
                name,
                enclave,
                pid: self.pid(),
                is_remote,
                origin,
                teller,
            }));
        }
        if let Some(port) = self.ports.get(&number).filter(|port| !self.is_relay && !port.observer) {
            let (gid, kind) = (Gid::of(id, number), port.kind);
            let node = port.node.and_then(|node| self.nodes.get(&node)).map(|node| node.name.clone());
            if let Some(service) = service_of(&port.topic) {
                // The publisher of requests is the client.
                let kind = match kind {
                    EndpointKind::Publisher => ServiceKind::Client,
                    EndpointKind::Subscription => ServiceKind::Server,
                };
                return Some(Listed::Service(ServiceEndpoint {
                    kind,
                    name: service.to_owned(),
                    type_name: port.type_name.clone(),
                    type_hash: port.hash.clone(),
                    gid,
                    node,
                    pid: self.pid(),
                    is_remote: false,
                    origin: here(gid),
                    teller: None,
                }));
            }
            return (!is_of_service(&port.topic)).then(|| {
                Listed::Topic(TopicEndpoint {
                    kind,
                    topic: port.topic.clone(),
                    topic_type: port.topic_type(),
                    gid,
                    qos: port.qos.qos(),
                    node,
                    pid: self.pid(),
                    is_remote: false,
                    is_own: id == own,
                    origin: here(gid),
                    teller: None,
                })
            });
        }
        if let Some(port) = self.remote_ports.get(&number) {
            return Some(Listed::Topic(port.endpoint(self.node(port.node)?, Some(id))));
        }
        let service = self.remote_services.get(&number)?;
        Some(Listed::Service(service.endpoint(self.node(service.node)?, Some(id))))
    }
}

enum Listed {
    Node(NodeInfo),
    Topic(TopicEndpoint),
    Service(ServiceEndpoint),
}

impl Listed {
    fn origin(&self) -> (&Origin, Option<u64>) {
        match self {
            Listed::Node(node) => (&node.origin, node.teller),
            Listed::Topic(end) => (&end.origin, end.teller),
            Listed::Service(end) => (&end.origin, end.teller),
        }
    }
}

fn here(gid: Gid) -> Origin {
    Origin { tag: gid.tag(), ..Origin::default() }
}

fn log_skipped(error: &TransportError) {
    tracing::warn!("a participant is left out of the graph: {error} (logged once)");
}

impl Model {
    pub(crate) fn new(own: u64) -> Self {
        Model { own, ..Model::default() }
    }

    pub(crate) fn refresh(&mut self, domain: &Domain) -> Result<Arc<GraphSnapshot>, TransportError> {
        // Read before the records: the next refresh sees what changes after this.
        let epoch = domain.epoch();
        if self.epoch == Some(epoch) {
            return Ok(self.snapshot.clone());
        }
        let seen: Vec<_> = domain.members().collect();
        let there: HashSet<u64> = seen.iter().map(|member| member.id).collect();
        let gone: Vec<u64> = self.members.keys().filter(|id| !there.contains(id)).copied().collect();
        for id in gone {
            if let Some(mut member) = self.members.remove(&id) {
                self.read_last_entries(id, &mut member);
                self.note_death(id, &mut member);
                self.unlist(id, &member);
            }
        }
        let mut is_behind = false;
        for member in seen {
            if self.members.get(&member.id).is_none_or(|known| known.generation != member.generation) {
                match self.update(domain.number(), member.id, member.generation) {
                    // The record changes all the time: the entries read before are listed, and the next refresh reads it again.
                    Err(TransportError::File { source, .. }) if source.kind() == WouldBlock => {
                        is_behind = true
                    }
                    updated => updated?,
                }
            }
        }
        let nodes = self.nodes.iter().filter(|(node, gid)| self.is_used(node.teller, &node.origin, *gid));
        let endpoints = self.endpoints.iter();
        let endpoints = endpoints.filter(|((.., gid), end)| self.is_used(end.teller, &end.origin, *gid));
        let services = self.services.iter();
        let services = services.filter(|((.., gid), end)| self.is_used(end.teller, &end.origin, *gid));
        self.snapshot = Arc::new(GraphSnapshot {
            nodes: nodes.map(|(node, _)| node.clone()).collect(),
            endpoints: endpoints.map(|(_, end)| end.clone()).collect(),
            services: services.map(|(_, end)| end.clone()).collect(),
            rivals: self.rivals(),
            ended: self.ended.iter().map(|(_, tag)| *tag).collect(),
        });
        self.epoch = Some(epoch).filter(|_| !is_behind);
        Ok(self.snapshot.clone())
    }

    /// The position of the memory of a publisher of this host.
    pub(crate) fn memory_of(&self, publisher: Gid) -> Option<(&Peer, Range)> {
        let member = self.members.get(&publisher.participant())?;
        let port = member.ports.get(&publisher.number()).filter(|port| port.kind == PortKind::Publisher)?;
        Some((member.peer.as_ref()?, PackedRange::from_word(port.at)?))
    }

    /// Removes participants that have died and were not cleaned up after: there may be no other process to do that.
    pub(crate) fn forget_dead(&mut self, domain: &Domain) {
        let dead: Vec<u64> =
            self.members.keys().filter(|id| !Peer::is_alive(domain.number(), **id)).copied().collect();
        for id in dead {
            if let Some(mut member) = self.members.remove(&id) {
                self.note_death(id, &mut member);
                self.unlist(id, &member);
                self.epoch = None;
            }
        }
    }

    /// Whether the entity is local, or this is the best of the participants that announce it.
    fn is_used(&self, teller: Option<u64>, origin: &Origin, gid: Gid) -> bool {
        let best = self.told.get(&origin.tag).and_then(|tellers| tellers.first());
        teller.is_none() || best.is_none_or(|(_, best)| *best == gid)
    }

    /// Records the normal end of a publisher, if this participant announces remote endpoints.
    fn note_ended(&mut self, tag: u64) {
        if self.is_teller {
            let now = Instant::now();
            let is_over = |(since, _): &(Instant, u64)| now.duration_since(*since) >= ENDED_TIME;
            while self.ended.len() >= MOST_ENDED || self.ended.front().is_some_and(is_over) {
                self.ended.pop_front();
            }
            self.ended.push_back((now, tag));
        }
    }

    /// Reads the last entries of a participant that has left: they may contain the normal end of its publishers.
    fn read_last_entries(&mut self, id: u64, member: &mut ParticipantRecord) {
        let Some(peer) = member.peer.as_ref().filter(|_| self.is_teller) else { return };
        // A damaged record does not end anything.
        let Some(update) = member.reader.read(peer).ok().filter(|update| !update.is_damaged) else { return };
        let of_kind = |is_it: fn(EntryKind) -> bool| {
            let entries = update.entries.iter().filter(move |(entry, _)| is_it(entry.kind));
            entries.map(|(entry, _)| entry.number).collect::<BTreeSet<u64>>()
        };
        let ended = of_kind(|kind| matches!(kind, EntryKind::Gone | EntryKind::Ended));
        let still = of_kind(|kind| kind == EntryKind::Port);
        for (number, port) in &member.ports {
            if ended.contains(number) || update.anew && !still.contains(number) {
                self.note_gone(id, member.is_relay, *number, port);
            }
        }
    }

    /// Records the death of a participant that has left: one that ends normally removes all its entries before.
    fn note_death(&mut self, id: u64, member: &mut ParticipantRecord) {
        if self.own != VISITOR {
            return;
        }
        // If the last entries cannot be read, those that were read before are used.
        let _ = self.read(id, member);
        let has_ports = member.ports.values().any(|port| !port.observer);
        if let Some(peer) = member.peer.as_ref().filter(|_| has_ports || !member.nodes.is_empty())
            && self.deaths.len() < MOST_ENDED
        {
            let own = |node: &NodeRecord| (!member.is_relay).then(|| node.name.clone());
            let nodes = member.nodes.values().filter_map(own).collect();
            self.deaths.push(Death { pid: peer.pid(), nodes });
        }
    }

    /// Handles that a participant has removed or ended the port `number`: if it is a topic's publisher, it ended normally.
    fn note_gone(&mut self, id: u64, is_relay: bool, number: u64, port: &PortRecord) {
        if port.kind == PortKind::Publisher && !is_relay && !is_of_service(&port.topic) {
            self.note_ended(Gid::of(id, number).tag());
        }
    }

    /// The least rank of each tag among the other announcers; empty if this participant announces nothing.
    fn rivals(&self) -> HashMap<u64, Rank> {
        if !self.is_teller {
            return HashMap::new();
        }
        let of_others = |(tag, tellers): (&u64, &Vec<(Rank, Gid)>)| {
            let (rank, _) = tellers.iter().find(|(rank, _)| rank.teller != u128::from(self.own))?;
            Some((*tag, *rank))
        };
        self.told.iter().filter_map(of_others).collect()
    }

    /// Reads the new entries of a participant's record.
    fn update(&mut self, domain: u32, id: u64, generation: u64) -> Result<(), TransportError> {
        let known = self.members.remove(&id);
        let mut member = match known {
            Some(member) => member,
            None if self.own == VISITOR && !Peer::is_alive(domain, id) => return Ok(()),
            None => match Peer::open(domain, id) {
                Ok(Some(peer)) => ParticipantRecord::new(Some(peer)),
                // Its file was removed: the participant is ending.
                Ok(None) => return Ok(()),
                Err(error) if error.is_passing() => return Err(error),
                Err(error) => {
                    log_skipped(&error);
                    ParticipantRecord::new(None)
                }
            },
        };
        let read = self.read(id, &mut member);
        if read.is_ok() {
            member.generation = generation;
        }
        self.members.insert(id, member);
        read
    }

    fn read(&mut self, id: u64, member: &mut ParticipantRecord) -> Result<(), TransportError> {
        let Some(peer) = &member.peer else { return Ok(()) };
        let update = member.reader.read(peer)?;
        let mut former = BTreeMap::new();
        if update.anew {
            self.unlist(id, member);
            former = std::mem::take(&mut member.ports);
            *member = ParticipantRecord {
                reader: std::mem::take(&mut member.reader),
                ..ParticipantRecord::new(member.peer.take())
            };
        }
        for (entry, _) in &update.entries {
            match entry.kind {
                EntryKind::Gone | EntryKind::Ended => {
                    if let Some(port) = member.ports.get(&entry.number) {
                        self.note_gone(id, member.is_relay, entry.number, port);
                    }
                    self.change(id, member, entry.number, false);
                    member.remove(entry.number);
                }
                EntryKind::Relay => {
                    self.is_teller |= id == self.own;
                    self.unlist(id, member);
                    member.is_relay = true;
                    member.numbers().into_iter().for_each(|number| self.change(id, member, number, true));
                }
                // This participant's own announcement.
                EntryKind::RemoteEnded if id == self.own => {}
                EntryKind::RemoteEnded => self.note_ended(entry.hash),
                _ => {
                    former.remove(&entry.number);
                    member.add(entry);
                    self.change(id, member, entry.number, true);
                }
            }
        }
        // Ports that the record had before it was rewritten, and no longer has.
        for (number, port) in former {
            if !update.is_damaged && !member.ports.contains_key(&number) {
                self.note_gone(id, member.is_relay, number, &port);
            }
        }
        if update.is_damaged {
            // Before the file is given up: what is listed has its process.
            self.unlist(id, member);
            if let Some(peer) = &member.peer {
                log_skipped(&TransportError::Damaged { path: peer.path().to_owned() });
            }
            *member = ParticipantRecord::new(None);
        }
        Ok(())
    }

    fn unlist(&mut self, id: u64, member: &ParticipantRecord) {
        member.numbers().into_iter().for_each(|number| self.change(id, member, number, false));
    }

    /// Adds the entity of a participant's entry to the lists, or removes it from them.
    fn change(&mut self, id: u64, member: &ParticipantRecord, number: u64, is_listed: bool) {
        let gid = Gid::of(id, number);
        let listed = member.listed(self.own, id, number);
        if let Some((origin, Some(teller))) = listed.as_ref().map(Listed::origin)
            && origin.tag != 0
        {
            let told = (origin.rank(teller.into()), gid);
            // Almost always one announcer: no capacity for more is reserved.
            let tellers = self.told.entry(origin.tag).or_insert_with(|| Vec::with_capacity(1));
            match (tellers.binary_search(&told), is_listed) {
                (Err(place), true) => tellers.insert(place, told),
                (Ok(place), false) => drop(tellers.remove(place)),
                _ => {}
            }
            if tellers.is_empty() {
                self.told.remove(&origin.tag);
            }
        }
        match listed {
            None => {}
            Some(Listed::Node(node)) => {
                let key = (Arc::new(node), gid);
                let _ = if is_listed { self.nodes.insert(key) } else { self.nodes.remove(&key) };
            }
            Some(Listed::Topic(end)) => {
                let key = (end.topic.clone(), end.kind, end.gid, gid);
                match is_listed {
                    true => drop(self.endpoints.insert(key, Arc::new(end))),
                    false => drop(self.endpoints.remove(&key)),
                }
            }
            Some(Listed::Service(end)) => {
                let key = (end.name.clone(), end.kind, end.gid, gid);
                match is_listed {
                    true => drop(self.services.insert(key, Arc::new(end))),
                    false => drop(self.services.remove(&key)),
                }
            }
        }
    }
}
