// SPDX-License-Identifier: MIT OR Apache-2.0
//! A participant's own nodes, services and clients, and who owns its ports: written to its file at every change.

use super::file::{TextFile, read};
use super::record::{EndpointRecord, Record, ServiceRecord};
use super::{NodeName, RemoteGraph, ServiceEndpoint, ServiceKind};
use crate::doorbell::ArenaId;
use crate::error::TransportError;
use crate::graph::Graph;
use crate::header::Gid;
use crate::participant::file_prefix;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tautline_rt::{ForeignWords, shm};

pub(crate) struct Registry {
    domain: u32,
    graph: Arc<Graph>,
    state: Mutex<State>,
}

struct State {
    record: Record,
    next_id: u64,
    /// Made with the first entry.
    file: Option<TextFile>,
}

impl Registry {
    pub(crate) fn new(domain: u32, arena: ArenaId, graph: Arc<Graph>) -> Arc<Self> {
        let record = Record { pid: std::process::id(), arena: arena.0, ..Record::default() };
        Arc::new(Registry { domain, graph, state: Mutex::new(State { record, next_id: 0, file: None }) })
    }

    /// Its lock is taken while things are set up and when they end, never by publish or take.
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Makes a change that others see, or none.
    fn change<T>(&self, change: impl FnOnce(&mut Record, u64) -> T) -> Result<T, TransportError> {
        let mut state = self.state();
        let mut record = state.record.clone();
        state.next_id += 1;
        let outcome = change(&mut record, state.next_id);
        if record != state.record {
            state.write(self.domain, &record)?;
            state.record = record;
        }
        Ok(outcome)
    }

    /// Of what ends: nobody can be told that it failed. The file has room, for it had it before.
    fn remove(&self, change: impl FnOnce(&mut Record)) {
        if let Err(error) = self.change(|record, _| change(record)) {
            tracing::warn!("others see what has ended: {error}");
        }
    }

    pub(super) fn add_node(self: &Arc<Self>, node: NodeName) -> Result<Arc<Entry>, TransportError> {
        if !node.is_valid() {
            return Err(TransportError::NodeName { name: node.full_name() });
        }
        let id = self.change(|record, id| {
            record.nodes.insert(id, node.clone());
            id
        })?;
        self.graph.advance();
        Ok(Arc::new(Entry { registry: self.clone(), id, node }))
    }

    /// Replaces what other hosts have. Their ports here are this participant's.
    pub(super) fn set_remote(&self, remote: &RemoteGraph) -> Result<(), TransportError> {
        let mut ids = BTreeMap::new();
        let ends = remote.endpoints.iter().filter_map(|end| end.node.as_ref());
        let named =
            remote.nodes.iter().chain(ends).chain(remote.services.iter().map(|service| &service.node));
        for node in named {
            let id = ids.len() as u64;
            ids.entry(node).or_insert(id);
        }
        let id_of = |node: &NodeName| ids.get(node).copied().unwrap_or_default();
        let has_changed = self.change(|record, _| {
            let before = record.clone();
            record.is_relay = true;
            record.nodes = ids.iter().map(|(node, id)| (*id, (*node).clone())).collect();
            let end = |end: &super::TopicEndpoint| Some(EndpointRecord::new(id_of(end.node.as_ref()?), end));
            record.endpoints = remote.endpoints.iter().filter_map(end).collect();
            let service = |(n, service): (usize, &ServiceEndpoint)| {
                (n as u64, ServiceRecord::new(id_of(&service.node), service))
            };
            record.services = remote.services.iter().enumerate().map(service).collect();
            *record != before
        })?;
        // Not otherwise: who looks again after each change would look for ever.
        if has_changed {
            self.graph.advance();
        }
        Ok(())
    }
}

impl Registry {
    /// What all living participants of the domain say, this one too.
    pub(super) fn records(&self) -> Vec<Record> {
        let (own, path) = {
            let state = self.state();
            (state.record.clone(), state.file.as_ref().map(|file| file.path().to_owned()))
        };
        let files = ForeignWords::list(&prefix(self.domain)).unwrap_or_default();
        let others = files.iter().filter(|file| Some(file.path()) != path.as_deref() && file.is_owned());
        others.filter_map(|file| Record::parse(&read(file)?)).chain([own]).collect()
    }
}

impl Drop for Registry {
    /// What it said of other hosts ends with it, and who watches for that is told after it has.
    fn drop(&mut self) {
        let file = self.state.get_mut().unwrap_or_else(PoisonError::into_inner).file.take();
        if file.is_some() {
            drop(file);
            self.graph.advance();
        }
    }
}

impl State {
    fn write(&mut self, domain: u32, record: &Record) -> Result<(), TransportError> {
        let failed = |path: PathBuf| move |source| TransportError::Graph { path, source };
        let prefix = prefix(domain);
        let path = std::path::Path::new(shm::DIRECTORY).join(&prefix);
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(TextFile::create(&prefix).map_err(failed(path.clone()))?),
        };
        let text = serde_json::to_vec(record).map_err(std::io::Error::from).map_err(failed(path.clone()))?;
        file.write(&text).map_err(failed(path))
    }
}

/// A node that is there until this is dropped.
pub(crate) struct Entry {
    registry: Arc<Registry>,
    id: u64,
    pub(super) node: NodeName,
}

impl Entry {
    /// Says that a port is this node's. Who calls it moves the epoch.
    pub(crate) fn own(self: &Arc<Self>, gid: Gid) -> Result<Ownership, TransportError> {
        self.registry.change(|record, _| record.owners.insert(gid, self.id))?;
        Ok(Ownership { node: self.clone(), gid })
    }

    pub(super) fn add_service(
        self: &Arc<Self>,
        kind: ServiceKind,
        name: &str,
        type_name: &str,
        type_hash: Option<&str>,
    ) -> Result<ServiceRegistration, TransportError> {
        let mut service = ServiceEndpoint {
            kind,
            name: name.into(),
            type_name: type_name.into(),
            type_hash: type_hash.map(Into::into),
            gid: Gid::default(),
            node: self.node.clone(),
            pid: None,
            is_remote: false,
        };
        if let Some(reason) = ServiceRecord::new(self.id, &service).fault() {
            return Err(TransportError::ServiceName { service: name.into(), reason });
        }
        let id = self.registry.change(|record, id| {
            service.gid = Gid::from_words([id, record.arena]);
            record.services.insert(id, ServiceRecord::new(self.id, &service));
            id
        })?;
        self.registry.graph.advance();
        Ok(ServiceRegistration { node: self.clone(), id })
    }
}

impl Drop for Entry {
    fn drop(&mut self) {
        self.registry.remove(|record| drop(record.nodes.remove(&self.id)));
        self.registry.graph.advance();
    }
}

/// Says whose a port is, until this is dropped; who drops it moves the epoch.
pub(crate) struct Ownership {
    node: Arc<Entry>,
    gid: Gid,
}

impl Drop for Ownership {
    fn drop(&mut self) {
        self.node.registry.remove(|record| record.owners.retain(|gid, _| *gid != self.gid));
    }
}

/// A service or client that others see until this is dropped.
#[must_use = "dropping it takes it back"]
pub struct ServiceRegistration {
    node: Arc<Entry>,
    id: u64,
}

impl Drop for ServiceRegistration {
    fn drop(&mut self) {
        self.node.registry.remove(|record| drop(record.services.remove(&self.id)));
        self.node.registry.graph.advance();
    }
}

impl std::fmt::Debug for ServiceRegistration {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServiceRegistration").field("node", &self.node.node).finish_non_exhaustive()
    }
}

/// Removes the files of processes that were killed.
pub(crate) fn remove_dead_files(domain: u32, graph: &Graph) {
    let files = ForeignWords::list(&prefix(domain)).unwrap_or_default();
    let removed = files.iter().filter(|file| !file.is_owned() && file.remove_if_orphaned()).count();
    if removed > 0 {
        graph.advance();
    }
}

fn prefix(domain: u32) -> String {
    format!("{}nodes1_", file_prefix(domain))
}
