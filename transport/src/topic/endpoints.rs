// SPDX-License-Identifier: MIT OR Apache-2.0
//! The endpoints of a topic that concern a publisher or a subscription: those that it matches, and those that it cannot match.
//!
//! The matching code maintains them; a monitor gets a copy when something has changed, without a lock.

use crate::memory::connection::Connection;
use crate::memory::header::Gid;
use crate::qos::Qos;
use crate::topic::compatibility::QosPolicyKind;
use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tautline_rt::{LatestReader, LatestWriter, latest};

/// Why two endpoints of a topic do not match.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mismatch {
    Qos(QosPolicyKind),
    Type,
}

/// An endpoint as the other kind of endpoint sees it.
#[derive(Clone)]
pub(crate) struct Endpoint {
    pub(crate) gid: Gid,
    /// `None`: they match.
    pub(crate) mismatch: Option<Mismatch>,
    pub(crate) qos: Qos,
    /// The endpoint is a gateway's or a bridge's: it stands for endpoints on other hosts, which are listed themselves.
    pub(crate) is_relay: bool,
    /// The endpoint is an observer.
    pub(crate) is_observer: bool,
    /// For an endpoint on another host: its tag.
    pub(crate) remote: Option<u64>,
    /// For the endpoint that carries a service's responses: the number of the same client's or server's endpoint for requests.
    pub(crate) partner: Option<u64>,
    /// For a matched publisher with manual liveliness and a lease: where its assertions are read.
    pub(crate) liveliness: Option<LivelinessSource>,
}

impl Endpoint {
    /// A matching endpoint of this host.
    pub(crate) fn new(gid: Gid, qos: Qos) -> Self {
        let (mismatch, remote, partner, liveliness) = Default::default();
        Endpoint { gid, mismatch, qos, is_relay: false, is_observer: false, remote, partner, liveliness }
    }

    fn is_matched_here(&self) -> bool {
        self.mismatch.is_none() && self.remote.is_none() && !self.is_observer
    }

    /// Whether it is an endpoint of the topic itself: not one that stands for others, which are listed, and no observer.
    pub(crate) fn is_itself(&self) -> bool {
        !self.is_relay && !self.is_observer
    }
}

/// The endpoints in the order of their gids, as a monitor reads them.
#[derive(Clone, Default)]
pub(crate) struct EndpointList {
    pub(crate) endpoints: Vec<Endpoint>,
    /// The number of matched endpoints, so far, that disappeared without having ended.
    pub(crate) killed: u64,
}

/// The endpoints as the matching code maintains them.
#[derive(Default)]
pub(crate) struct Endpoints {
    list: BTreeMap<Gid, Endpoint>,
    /// The number of matched endpoints on this host.
    matched: usize,
    killed: u64,
    monitors: Vec<LatestWriter<Arc<EndpointList>>>,
    has_changed: bool,
}

impl Endpoints {
    pub(crate) fn contains(&self, gid: Gid) -> bool {
        self.list.contains_key(&gid)
    }

    /// Adds an endpoint, or replaces its entry.
    pub(crate) fn set(&mut self, endpoint: Endpoint) {
        self.matched += usize::from(endpoint.is_matched_here());
        let former = self.list.insert(endpoint.gid, endpoint);
        self.matched -= usize::from(former.is_some_and(|former| former.is_matched_here()));
        self.has_changed = true;
    }

    /// Removes an endpoint. Returns whether it matched.
    pub(crate) fn remove(&mut self, gid: Gid, was_killed: bool) -> bool {
        let Some(endpoint) = self.list.remove(&gid) else { return false };
        self.has_changed = true;
        self.matched -= usize::from(endpoint.is_matched_here());
        let matched = endpoint.mismatch.is_none();
        self.killed += u64::from(matched && was_killed && endpoint.is_itself());
        matched
    }

    /// Replaces the endpoints on other hosts by `told`, sorted, with tags. Removed ones count as killed, unless their tags are in `ended`.
    pub(crate) fn set_remote(&mut self, told: &[(Gid, u64)], ended: &HashSet<u64>) {
        let is_told = |gid: Gid| told.binary_search_by(|(other, _)| other.cmp(&gid)).is_ok();
        let remote = self.list.values().filter_map(|endpoint| Some((endpoint.gid, endpoint.remote?)));
        let gone: Vec<_> = remote.filter(|(gid, _)| !is_told(*gid)).collect();
        for (gid, tag) in gone {
            // It still exists if another participant announces it now.
            let lives = told.iter().any(|(_, other)| *other == tag);
            self.remove(gid, !lives && !ended.contains(&tag));
        }
        for &(gid, tag) in told {
            if !self.list.contains_key(&gid) {
                self.set(Endpoint { remote: Some(tag), ..Endpoint::new(gid, Qos::default()) });
            }
        }
    }

    /// Updates the matched count and the monitors, if anything changed since the last call. Returns whether it did.
    pub(crate) fn notify(&mut self, matched: &AtomicUsize) -> bool {
        if !std::mem::take(&mut self.has_changed) {
            return false;
        }
        matched.store(self.matched, Ordering::Release);
        self.monitors.retain(|monitor| !monitor.is_abandoned());
        if !self.monitors.is_empty() {
            let list = Arc::new(self.to_list());
            self.monitors.iter_mut().for_each(|monitor| monitor.write(list.clone()));
        }
        true
    }

    fn to_list(&self) -> EndpointList {
        EndpointList { endpoints: self.list.values().cloned().collect(), killed: self.killed }
    }

    /// Adds a monitor. Returns its end, which reads the list.
    pub(crate) fn monitor(&mut self) -> LatestReader<Arc<EndpointList>> {
        let (writer, reader) = latest(Arc::new(self.to_list()));
        self.monitors.push(writer);
        reader
    }
}

/// The number of endpoints that match an endpoint of a topic: a count that any thread may read.
#[derive(Clone)]
pub struct MatchedCount(pub(crate) Arc<AtomicUsize>);

impl MatchedCount {
    /// The count.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn get(&self) -> usize {
        self.0.load(Ordering::Acquire)
    }
}

impl std::fmt::Debug for MatchedCount {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("MatchedCount").field(&self.get()).finish()
    }
}

/// Where a publisher's assertions of its liveliness are read.
#[derive(Clone)]
pub(crate) struct LivelinessSource(Arc<Connection>);

impl LivelinessSource {
    pub(crate) fn new(connection: Arc<Connection>) -> Self {
        LivelinessSource(connection)
    }

    /// The time of the last assertion.
    pub(crate) fn alive_ns(&self) -> u64 {
        self.0.block().out.alive_ns.load(Ordering::Relaxed)
    }
}
