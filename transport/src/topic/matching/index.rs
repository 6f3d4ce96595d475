// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ports of other participants, by the hash of their topics' names. A port's properties stay in its participant's record until they
//! are needed.

use crate::error::TransportError;
use crate::graph::domain::{Domain, Seen};
use crate::graph::entities::NodeName;
use crate::graph::log::{EntryKind, Reader};
use crate::graph::origin::Rank;
use crate::graph::record::{PortKind, PortRecord, RemotePortRecord};
use crate::memory::file::{Peer, Peers};
use crate::memory::header::Gid;
use crate::topic::declaration::Topic;
use std::collections::hash_map::Entry;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use tautline_rt::fork::ProcessMutex;

/// The maximum number of endpoints on other hosts that a port reports to its monitors: it bounds what other hosts' endpoints cost a port.
const MOST_REMOTE: usize = 256;

pub(super) struct Index {
    pub(super) own: u64,
    epoch: Option<u32>,
    members: HashMap<u64, IndexedParticipant>,
    /// The members whose records were read to the end, by index, with their state at that time.
    last: Vec<Seen>,
    by_topic: HashMap<u64, TopicPorts>,
    /// Topics whose remote endpoints have changed.
    remote_changes: BTreeSet<u64>,
    retries: Vec<PortKey>,
    /// Participants whose records cannot be read: logged once.
    refused: HashSet<u64>,
}

/// The entries of the records that describe a topic's ports, by gid: the participant and the number of the entry.
#[derive(Default)]
struct TopicPorts {
    ports: Positions,
    remote: Positions,
}

/// The positions of endpoints' entries in the records, in the order of the gids. Most topics have few endpoints, and there are many topics:
/// a map would take ten times the memory.
#[derive(Default)]
struct Positions(Vec<(Gid, usize)>);

impl Positions {
    fn find(&self, gid: Gid) -> Result<usize, usize> {
        self.0.binary_search_by(|(other, _)| other.cmp(&gid))
    }

    fn get(&self, gid: Gid) -> Option<usize> {
        self.find(gid).ok().map(|place| self.0[place].1)
    }

    fn insert(&mut self, gid: Gid, position: usize) {
        match self.find(gid) {
            Ok(place) => self.0[place].1 = position,
            Err(place) => self.0.insert(place, (gid, position)),
        }
    }

    fn remove(&mut self, gid: Gid) {
        if let Ok(place) = self.find(gid) {
            self.0.remove(place);
        }
    }

    fn gids(&self) -> impl Iterator<Item = Gid> + '_ {
        self.0.iter().map(|(gid, _)| *gid)
    }
}

struct IndexedParticipant {
    generation: u64,
    grown: u32,
    peer: Arc<Peer>,
    reader: Reader,
    /// The topics of its ports, and of the remote ports that it announces.
    ports: HashMap<u64, u64>,
    remote: HashMap<u64, u64>,
    /// The tags of remote publishers whose end it announces.
    ended: HashMap<u64, u64>,
    /// The names of its nodes, hashed.
    nodes: HashMap<u64, u64>,
}

/// A port: its identifier, and the hash of its topic.
pub(super) type PortKey = (Gid, u64);

/// What has changed since the last update.
#[derive(Debug, Default)]
pub(super) struct IndexUpdate {
    pub(super) added: Vec<PortKey>,
    /// Publishers that ended before they were seen, but whose samples still exist; with the content of their ports'
    /// entries.
    pub(super) ended: Vec<(PortKey, Vec<u8>)>,
    /// Ports that have disappeared: identifier, topic, and whether together with their process.
    pub(super) removed: Vec<(Gid, u64, bool)>,
    pub(super) gone: bool,
    /// A record could not be read because of an error that may pass.
    pub(super) is_refused: bool,
    /// Participants whose publishers have other segments of samples than before.
    pub(super) grown: BTreeSet<u64>,
}

impl Index {
    pub(super) fn new(own: u64) -> Self {
        Index {
            own,
            epoch: None,
            members: HashMap::new(),
            last: Vec::new(),
            by_topic: HashMap::new(),
            remote_changes: BTreeSet::new(),
            retries: Vec::new(),
            refused: HashSet::new(),
        }
    }

    /// Reads the new entries of the records that have changed.
    pub(super) fn refresh(&mut self, domain: &Domain, peers: &mut Peers) -> IndexUpdate {
        let mut update = IndexUpdate { added: std::mem::take(&mut self.retries), ..IndexUpdate::default() };
        let epoch = domain.epoch();
        let is_same = self.epoch == Some(epoch);
        let own = self.own;
        let members: Vec<Seen> = domain.members().filter(|member| member.id != own).collect();
        let mut before = std::mem::take(&mut self.last).into_iter().peekable();
        let mut gone = Vec::new();
        for &member in &members {
            while let Some(former) = before.next_if(|former| former.place < member.place) {
                gone.push(former.id);
            }
            match before.next_if(|former| former.place == member.place) {
                Some(same) if same == member => {
                    self.last.push(member);
                    continue;
                }
                Some(former) if former.id != member.id => gone.push(former.id),
                _ => {}
            }
            if let Some(known) = self.members.get_mut(&member.id) {
                if known.grown != member.grown {
                    known.grown = member.grown;
                    update.grown.insert(member.id);
                }
                if known.generation == member.generation {
                    self.last.push(member);
                    continue;
                }
            } else if is_same && self.refused.contains(&member.id) {
                continue;
            }
            match self.read(domain.number(), member.id, peers, &mut update) {
                Ok(()) => {
                    self.refused.remove(&member.id);
                    if let Some(known) = self.members.get_mut(&member.id) {
                        (known.generation, known.grown) = (member.generation, member.grown);
                        self.last.push(member);
                    }
                }
                Err(error) => {
                    update.is_refused |= error.is_passing();
                    if self.refused.insert(member.id) {
                        warn_once(&error);
                    }
                }
            }
        }
        gone.extend(before.map(|former| former.id));
        let is_there = |id: u64| members.iter().any(|member| member.id == id);
        gone.extend(self.refused.extract_if(|id| !is_there(*id)));
        for id in gone {
            update.gone |= self.members.contains_key(&id);
            self.forget(id, &mut update);
        }
        self.epoch = Some(epoch).filter(|_| !update.is_refused);
        update
    }

    /// How many nodes of other participants have the name that has this hash.
    pub(super) fn nodes(&self, hash: u64) -> usize {
        self.members.values().flat_map(|member| member.nodes.values()).filter(|of| **of == hash).count()
    }

    fn read(
        &mut self,
        domain: u32,
        id: u64,
        peers: &mut Peers,
        update: &mut IndexUpdate,
    ) -> Result<(), TransportError> {
        let member = match self.members.entry(id) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(place) => {
                let Some(peer) = peers.get(domain, id)? else { return Ok(()) };
                let (generation, grown, reader) = Default::default();
                let (ports, remote, ended, nodes) = Default::default();
                place.insert(IndexedParticipant {
                    generation,
                    grown,
                    peer,
                    reader,
                    ports,
                    remote,
                    ended,
                    nodes,
                })
            }
        };
        let peer = member.peer.clone();
        let read = member.reader.read(&peer)?;
        let mut former = (HashMap::new(), HashMap::new());
        if read.anew {
            former = (std::mem::take(&mut member.ports), std::mem::take(&mut member.remote));
            member.nodes.clear();
            member.ended.clear();
        }
        for (entry, position) in read.entries {
            let (number, hash, gid) = (entry.number, entry.hash, Gid::of(id, entry.number));
            match entry.kind {
                EntryKind::Port => {
                    member.ports.insert(number, hash);
                    self.by_topic.entry(hash).or_default().ports.insert(gid, position);
                    if former.0.remove(&number).is_none() {
                        update.added.push((gid, hash));
                    }
                }
                EntryKind::RemotePort => {
                    member.remote.insert(number, hash);
                    self.by_topic.entry(hash).or_default().remote.insert(gid, position);
                    if former.1.remove(&number).is_none() {
                        self.remote_changes.insert(hash);
                    }
                }
                EntryKind::Gone => {
                    // A port that was added and removed between two refreshes is not reported.
                    update.added.retain(|(added, ..)| *added != gid);
                    if let Some(hash) = member.ports.remove(&number) {
                        remove(&mut self.by_topic, hash, |topic| topic.ports.remove(gid));
                        update.removed.push((gid, hash, false));
                    }
                    member.nodes.remove(&number);
                    member.ended.remove(&number);
                    if let Some(hash) = member.remote.remove(&number) {
                        remove(&mut self.by_topic, hash, |topic| topic.remote.remove(gid));
                        self.remote_changes.insert(hash);
                    }
                }
                EntryKind::Ended => {
                    let known = member.ports.remove(&number).or_else(|| former.0.remove(&number));
                    if known.is_some() {
                        remove(&mut self.by_topic, hash, |topic| topic.ports.remove(gid));
                    }
                    let is_new = |(added, _): &PortKey| *added == gid;
                    if known.is_none() || update.added.extract_if(.., |added| is_new(added)).next().is_some()
                    {
                        update.ended.push(((gid, hash), entry.body));
                    } else {
                        update.removed.push((gid, hash, false));
                    }
                }
                EntryKind::Node => drop(member.nodes.insert(number, hash)),
                EntryKind::RemoteEnded => drop(member.ended.insert(number, hash)),
                EntryKind::RemoteService | EntryKind::Relay => {}
            }
        }
        // Entries that the record had before it was written anew, and has no longer.
        for (number, hash) in former.0 {
            let gid = Gid::of(id, number);
            remove(&mut self.by_topic, hash, |topic| topic.ports.remove(gid));
            update.removed.push((gid, hash, false));
        }
        for (number, hash) in former.1 {
            remove(&mut self.by_topic, hash, |topic| topic.remote.remove(Gid::of(id, number)));
            self.remote_changes.insert(hash);
        }
        if read.is_damaged {
            return Err(TransportError::Damaged { path: peer.path().to_owned() });
        }
        Ok(())
    }

    /// Removes a participant that has gone, with all its ports.
    fn forget(&mut self, id: u64, update: &mut IndexUpdate) {
        let Some(member) = self.members.remove(&id) else { return };
        for (number, hash) in member.ports {
            let gid = Gid::of(id, number);
            remove(&mut self.by_topic, hash, |topic| topic.ports.remove(gid));
            update.removed.push((gid, hash, true));
        }
        for (number, hash) in member.remote {
            remove(&mut self.by_topic, hash, |topic| topic.remote.remove(Gid::of(id, number)));
            self.remote_changes.insert(hash);
        }
    }

    /// The participants whose records could not be read.
    pub(super) fn refused(&self) -> impl Iterator<Item = u64> + '_ {
        self.refused.iter().copied()
    }

    /// Makes the next refresh report this port as added again.
    pub(super) fn retry(&mut self, found: PortKey) {
        self.retries.push(found);
    }

    /// Whether the next refresh finds something even if nothing changes until then.
    pub(super) fn has_retries(&self) -> bool {
        !self.retries.is_empty() || !self.remote_changes.is_empty()
    }

    /// The record of a port. `None` if it has gone, or cannot be read before the next refresh, which reports the port again.
    pub(super) fn port(&mut self, (gid, hash): PortKey) -> Option<PortRecord> {
        let position = self.by_topic.get(&hash)?.ports.get(gid)?;
        let member = self.members.get(&gid.participant())?;
        let Some(entry) = member.reader.entry(member.peer.head(), position) else {
            // The participant's record was written anew since the last refresh.
            self.retries.push((gid, hash));
            return None;
        };
        (entry.kind == EntryKind::Port && Gid::of(gid.participant(), entry.number) == gid)
            .then(|| PortRecord::parse(&entry.body))?
    }

    /// The ports of this kind that other participants have on a topic; the next refresh may report more of them.
    pub(super) fn ports(&mut self, hash: u64, kind: PortKind) -> Vec<(Gid, PortRecord)> {
        let ports = self.by_topic.get(&hash).into_iter().flat_map(|topic| topic.ports.gids());
        let gids: Vec<Gid> = ports.collect();
        let ports = gids.into_iter().filter_map(|gid| Some((gid, self.port((gid, hash))?)));
        ports.filter(|(_, port)| port.kind == kind).collect()
    }

    /// Whether the port existed at the last refresh.
    pub(super) fn has(&self, gid: Gid, hash: u64) -> bool {
        self.by_topic.get(&hash).is_some_and(|topic| topic.ports.get(gid).is_some())
    }

    /// The participants that have ports on a topic.
    pub(super) fn participants(&self, hash: u64) -> BTreeSet<u64> {
        let ports = self.by_topic.get(&hash).into_iter().flat_map(|topic| topic.ports.gids());
        ports.map(|gid| gid.participant()).collect()
    }

    /// The endpoints of this kind that other hosts have on a topic, and that can match: sorted by gid, each once, with its tag. `None`:
    /// they cannot be read before the next refresh.
    pub(super) fn remote(&mut self, hash: u64, kind: PortKind, topic: &Topic) -> Option<Vec<(Gid, u64)>> {
        let ports = self.by_topic.get(&hash).into_iter().flat_map(|topic| &topic.remote.0);
        let nobody = NodeName { namespace: "/".into(), name: "_".into() };
        let mut is_moved = false;
        let end = |(gid, position): &(Gid, usize)| {
            let member = self.members.get(&gid.participant())?;
            let Some(entry) = member.reader.entry(member.peer.head(), *position) else {
                // As in `port`.
                is_moved = true;
                return None;
            };
            let end = RemotePortRecord::parse(&entry.body)?.endpoint(&nobody, Some(gid.participant()));
            let fits =
                end.kind == kind && end.topic == topic.name && topic.topic_type.agrees_with(&end.topic_type);
            // Each endpoint once, by the announcement with the best rank.
            let rank = end.origin.rank(gid.participant().into());
            fits.then_some((end.origin.tag, rank, end.gid))
        };
        let mut told: Vec<(u64, Rank, Gid)> = ports.filter_map(end).collect();
        if is_moved {
            self.remote_changes.insert(hash);
            return None;
        }
        told.sort_unstable();
        told.dedup_by_key(|(tag, ..)| *tag);
        let mut gids: Vec<(Gid, u64)> = told.into_iter().map(|(tag, _, gid)| (gid, tag)).collect();
        gids.sort_unstable();
        gids.dedup_by_key(|(gid, _)| *gid);
        gids.truncate(MOST_REMOTE);
        Some(gids)
    }

    /// The tags of publishers on other hosts that are announced to have ended by themselves.
    pub(super) fn ended(&self) -> HashSet<u64> {
        self.members.values().flat_map(|member| member.ended.values().copied()).collect()
    }

    pub(super) fn take_remote_changes(&mut self) -> BTreeSet<u64> {
        std::mem::take(&mut self.remote_changes)
    }
}

fn remove(by_topic: &mut HashMap<u64, TopicPorts>, hash: u64, remove: impl FnOnce(&mut TopicPorts)) {
    if let Some(topic) = by_topic.get_mut(&hash) {
        remove(topic);
        if topic.ports.0.is_empty() && topic.remote.0.is_empty() {
            by_topic.remove(&hash);
        }
    }
}

/// Logs an error once for each of the first 64 distinct texts, because what failed is retried.
pub(super) fn warn_once(error: &TransportError) {
    static SAID: ProcessMutex<BTreeSet<String>> = ProcessMutex::new(BTreeSet::new(), BTreeSet::new);
    let text = error.to_string();
    let mut said = SAID.lock();
    if said.len() < 64 && said.insert(text.clone()) {
        tracing::warn!(
            "an endpoint of this process and one of another process are not connected, retrying: {text} (logged once)"
        );
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::graph::log::hash_of;
    use crate::graph::own::OwnRecord;
    use crate::graph::record::QosRecord;
    use crate::memory::file::OwnMemory;
    use crate::qos::Qos;
    use crate::tests::isolated;

    fn port(topic: &str) -> PortRecord {
        PortRecord {
            node: None,
            kind: PortKind::Subscription,
            topic: topic.into(),
            type_name: "a/msg/B".into(),
            hash: None,
            body_bytes: None,
            qos: QosRecord::from(&Qos::default()),
            relay: false,
            observer: false,
            slot: 0,
            at: 1,
            partner: None,
        }
    }

    #[test]
    fn what_moves_between_two_looks_is_found_by_the_next_one() {
        isolated();
        let domain = Domain::join(217).unwrap();
        let memory = Arc::new(OwnMemory::create(217).unwrap());
        memory.create_arena();
        let record = OwnRecord::new(&domain, &memory);
        record.publish(domain.add(memory.id()).unwrap());
        let add = |topic: &str| record.add_port(record.number(), &port(topic)).unwrap();
        add("/a");
        let (mut index, mut peers) = (Index::new(1), Peers::default());
        let added = index.refresh(&domain, &mut peers).added;
        let [found] = added[..] else { panic!("{added:?}") };
        assert_eq!((index.port(found), index.has_retries()), (Some(port("/a")), false));
        // Its record is written anew, as it gets longer than a page.
        let more = tautline_rt::shm::page_bytes() / 40;
        (0..more).for_each(|n| add(&format!("/b{n}")));
        assert_eq!((index.port(found), index.has_retries()), (None, true));
        let added = index.refresh(&domain, &mut peers).added;
        assert!(added.contains(&found) && added.len() == more + 1, "{added:?}");
        assert_eq!((index.port(found), index.has_retries()), (Some(port("/a")), false));
        assert_eq!(index.ports(hash_of("/a"), PortKind::Subscription), [(found.0, port("/a"))]);
        record.remove(found.0.number());
        let update = index.refresh(&domain, &mut peers);
        assert_eq!((update.added, update.removed), (vec![], vec![(found.0, found.1, false)]));
        assert_eq!((index.port(found), index.has_retries()), (None, false), "it has gone");
        memory.retire();
    }
}
