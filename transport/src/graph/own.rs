// SPDX-License-Identifier: MIT OR Apache-2.0
//! A participant's own record: its nodes and ports, and what it knows about other hosts.

use crate::error::TransportError;
use crate::graph::domain::Domain;
use crate::graph::entities::NodeName;
use crate::graph::log;
use crate::graph::log::{EntryKind, Log, hash_of};
use crate::graph::record::{NodeRecord, PortRecord, is_enclave, to_body};
use crate::graph::remote::{RemoteGraph, RemoteNode};
use crate::memory::file::OwnMemory;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock, Weak};
use tautline_doorbell::Slot;
use tautline_rt::PiMutex;

pub(crate) struct OwnRecord {
    domain: Arc<Domain>,
    memory: Arc<OwnMemory>,
    /// This participant's index among the members.
    place: OnceLock<usize>,
    /// Locked by set-up and tear-down, never by publish or take.
    state: PiMutex<OwnRecordState>,
}

struct OwnRecordState {
    log: Log,
    remote: Remote,
}

/// The announced entities of other hosts: the numbers of their entries, by topic hash and content.
#[derive(Default)]
struct Remote {
    marker: Option<u64>,
    nodes: RemoteNodes,
    entries: RemoteEntries,
}

/// The numbers of the entries of nodes: two nodes may have the same name.
type RemoteNodes = BTreeMap<RemoteNode, Vec<u64>>;

type RemoteEntries = HashMap<(EntryKind, u64, Vec<u8>), Vec<u64>>;

impl OwnRecord {
    pub(crate) fn new(domain: &Arc<Domain>, memory: &Arc<OwnMemory>) -> Arc<Self> {
        let state = OwnRecordState { log: Log::new(memory.clone()), remote: Remote::default() };
        let (domain, memory) = (domain.clone(), memory.clone());
        Arc::new(OwnRecord { domain, memory, place: OnceLock::new(), state: PiMutex::new(state) })
    }

    /// Publishes the record as that of the member at `place`.
    pub(crate) fn publish(&self, place: usize) {
        let _ = self.place.set(place);
        self.changed();
    }

    pub(crate) fn place(&self) -> Option<usize> {
        self.place.get().copied()
    }

    fn changed(&self) {
        if let Some(place) = self.place.get() {
            self.domain.changed(*place);
        }
    }

    /// Announces that a publisher has added or removed a segment of samples.
    pub(crate) fn grew(&self) {
        if let Some(place) = self.place.get() {
            self.domain.grew(*place);
        }
    }

    fn failed(&self) -> impl Fn(io::Error) -> TransportError + use<> {
        let path = self.memory.path().to_owned();
        move |source| TransportError::File { path: path.clone(), source }
    }

    /// A number for a new port, which is part of its gid. Other processes do not see the port yet.
    pub(crate) fn number(&self) -> u64 {
        self.state.lock().log.number()
    }

    /// Makes a port known to others.
    pub(crate) fn add_port(&self, number: u64, port: &PortRecord) -> Result<(), TransportError> {
        let hash = hash_of(&port.topic);
        let entry = log::LogEntry { kind: EntryKind::Port, number, hash, body: to_body(port) };
        self.state.lock().log.add(&entry).map_err(self.failed())?;
        self.changed();
        Ok(())
    }

    /// Removes an entry. A failure is logged.
    pub(crate) fn remove(&self, number: u64) {
        self.take_back(|log| log.remove(number));
    }

    /// Marks the publisher with this number as ended; its samples can still be found. A failure is logged, as by [`remove`](Self::remove).
    pub(crate) fn end(&self, number: u64) {
        self.take_back(|log| log.end(number));
    }

    /// Removes the entry of an ended publisher, whose samples are no longer needed, if the record has it.
    pub(crate) fn forget(&self, number: u64) {
        let is_said = self.state.lock().log.has(number);
        if is_said {
            self.remove(number);
        }
    }

    fn take_back(&self, change: impl FnOnce(&mut Log) -> io::Result<()>) {
        if self.domain.check_process().is_err() {
            return;
        }
        if let Err(error) = change(&mut self.state.lock().log) {
            tracing::warn!("others see what has ended, until something else changes: {error}");
        }
        self.changed();
    }

    pub(crate) fn add_node(
        self: &Arc<Self>,
        node: NodeName,
        enclave: &str,
    ) -> Result<Arc<NodeEntry>, TransportError> {
        if !node.is_valid() {
            return Err(TransportError::NodeName { name: node.full_name() });
        }
        if !is_enclave(enclave) {
            return Err(TransportError::Enclave { enclave: enclave.to_owned() });
        }
        let number = {
            let mut state = self.state.lock();
            let number = state.log.number();
            let hash = hash_of(&node.full_name());
            let body = to_body(&NodeRecord { name: node.clone(), enclave: enclave.to_owned(), origin: None });
            let entry = log::LogEntry { kind: EntryKind::Node, number, hash, body };
            state.log.add(&entry).map_err(self.failed())?;
            number
        };
        self.changed();
        let (record, has_ended, slots) = (self.clone(), AtomicBool::new(false), PiMutex::default());
        Ok(Arc::new(NodeEntry { record, number, node, has_ended, slots }))
    }

    /// The number of nodes in the record whose name has this hash.
    pub(crate) fn nodes(&self, hash: u64) -> usize {
        self.state.lock().log.count(EntryKind::Node, hash)
    }

    /// Whether this participant announces, or has announced, entities of other hosts.
    pub(crate) fn is_relay(&self) -> bool {
        self.state.lock().remote.marker.is_some()
    }

    /// Replaces the announced entities of other hosts; entries that are there already stay as they are. Adds the hashes of the topics
    /// that have changed to `topics`.
    pub(crate) fn set_remote(
        &self,
        remote: &RemoteGraph,
        topics: &mut BTreeSet<u64>,
    ) -> Result<(), TransportError> {
        let mut changed = false;
        let mut state = self.state.lock();
        let said = state.set_remote(remote, topics, &mut changed).map_err(self.failed());
        drop(state);
        // Only then: a relay that calls this after each change of the graph would otherwise never stop, also if each call fails.
        if changed {
            self.changed();
        }
        said
    }
}

impl OwnRecordState {
    fn add(&mut self, kind: EntryKind, hash: u64, body: Vec<u8>) -> io::Result<u64> {
        let number = self.log.number();
        self.log.add(&log::LogEntry { kind, number, hash, body })?;
        Ok(number)
    }

    /// Replaces the announced entities. Sets `changed` if anything has changed, also before an error.
    fn set_remote(
        &mut self,
        remote: &RemoteGraph,
        topics: &mut BTreeSet<u64>,
        changed: &mut bool,
    ) -> io::Result<()> {
        if self.remote.marker.is_none() {
            self.remote.marker = Some(self.add(EntryKind::Relay, 0, Vec::new())?);
            *changed = true;
        }
        let mut former = (std::mem::take(&mut self.remote.nodes), std::mem::take(&mut self.remote.entries));
        let said = self.write_remote(remote, topics, changed, &mut former);
        // After an error, entries that should have been removed are still in the record: the next call removes them.
        for (node, numbers) in former.0 {
            self.remote.nodes.entry(node).or_default().extend(numbers);
        }
        for (key, numbers) in former.1 {
            self.remote.entries.entry(key).or_default().extend(numbers);
        }
        said
    }

    /// Adds the new entries, then removes the former ones that are no longer wanted.
    fn write_remote(
        &mut self,
        remote: &RemoteGraph,
        topics: &mut BTreeSet<u64>,
        changed: &mut bool,
        (nodes, entries): &mut (RemoteNodes, RemoteEntries),
    ) -> io::Result<()> {
        // By name: the endpoints refer to the first of several nodes with one name.
        let mut numbers = HashMap::new();
        for node in remote.all_nodes() {
            let number = match nodes.get_mut(&node).and_then(Vec::pop) {
                Some(number) => number,
                None => {
                    let RemoteNode { name, enclave, origin } = node.clone();
                    let hash = hash_of(&name.full_name());
                    let body = to_body(&NodeRecord { name, enclave, origin: Some(origin) });
                    let number = self.add(EntryKind::Node, hash, body)?;
                    *changed = true;
                    number
                }
            };
            numbers.entry(node.name.clone()).or_insert(number);
            self.remote.nodes.entry(node).or_default().push(number);
        }
        nodes.retain(|_, numbers| !numbers.is_empty());
        for (kind, hash, body) in wanted(remote, &numbers) {
            let key = (kind, hash, body);
            let number = match entries.get_mut(&key).and_then(Vec::pop) {
                Some(number) => number,
                None => {
                    let number = self.add(kind, hash, key.2.clone())?;
                    topics.insert(hash);
                    *changed = true;
                    number
                }
            };
            self.remote.entries.entry(key).or_default().push(number);
        }
        entries.retain(|_, numbers| !numbers.is_empty());
        topics.extend(entries.keys().map(|(_, hash, _)| hash));
        // Nodes are removed after their endpoints, and all of them, also if there is no room to record one: the next change for which there
        // is room records all, and the fewer entries are left the less room that needs.
        let mut said = Ok(());
        for number in entries.values_mut().chain(nodes.values_mut()).flat_map(|numbers| numbers.drain(..)) {
            *changed = true;
            said = self.log.remove(number);
        }
        said
    }
}

/// The entries to be announced for endpoints, with the hashes of their names; `nodes` are the numbers of their nodes' entries.
fn wanted(remote: &RemoteGraph, nodes: &HashMap<NodeName, u64>) -> Vec<(EntryKind, u64, Vec<u8>)> {
    let (ports, services) = remote.records(nodes);
    let ports = ports.iter().map(|port| (EntryKind::RemotePort, hash_of(&port.topic), to_body(port)));
    let services = services.iter().map(|end| (EntryKind::RemoteService, hash_of(&end.name), to_body(end)));
    let ended = remote.ended.iter().map(|tag| (EntryKind::RemoteEnded, *tag, Vec::new()));
    // The normal ends come before the entries of ended publishers are removed.
    ended.chain(ports).chain(services).collect()
}

/// A node that exists until this is dropped.
pub(crate) struct NodeEntry {
    record: Arc<OwnRecord>,
    pub(crate) number: u64,
    pub(crate) node: NodeName,
    has_ended: AtomicBool,
    /// The slots of the objects that end with it.
    slots: PiMutex<Vec<Weak<Slot>>>,
}

impl NodeEntry {
    pub(crate) fn adopt(&self, slot: &Arc<Slot>) {
        let mut slots = self.slots.lock();
        if self.has_ended() {
            return slot.retire();
        }
        if slots.len() == slots.capacity() {
            slots.retain(|slot| slot.strong_count() != 0);
        }
        slots.push(Arc::downgrade(slot));
    }

    pub(crate) fn end(&self) {
        let slots = {
            let mut slots = self.slots.lock();
            // Stored before the wakes, so that woken tasks see it.
            self.has_ended.store(true, Ordering::Release);
            std::mem::take(&mut *slots)
        };
        slots.iter().filter_map(Weak::upgrade).for_each(|slot| slot.retire());
    }

    pub(crate) fn has_ended(&self) -> bool {
        self.has_ended.load(Ordering::Acquire)
    }
}

impl Drop for NodeEntry {
    fn drop(&mut self) {
        self.record.remove(self.number);
    }
}

/// A node that other processes see until this handle, its clones and everything that was created for the node
/// are dropped.
#[derive(Clone)]
pub struct NodeHandle {
    pub(crate) entry: Arc<NodeEntry>,
}

impl NodeHandle {
    /// The node's name.
    pub fn name(&self) -> &NodeName {
        &self.entry.node
    }

    /// Ends everything that was created for the node, or is created for it from now on: streams end after they have delivered
    /// what had arrived, and publishing and requests return errors. Other processes see the node until all of this is dropped.
    ///
    /// # Real-time
    /// Not for real-time threads: waits for a lock; O(objects created for the node), one syscall for each thread that waits for
    /// one of them.
    pub fn end(&self) {
        self.entry.end();
    }

    /// Whether it was [ended](Self::end).
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn has_ended(&self) -> bool {
        self.entry.has_ended()
    }

    /// Makes the owner of this slot end with the node.
    ///
    /// # Real-time
    /// Setup only.
    pub fn adopt(&self, slot: &Arc<Slot>) {
        self.entry.adopt(slot);
    }
}

tautline_rt::debug_fields!(NodeHandle, |this| name = this.entry.node);
