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

/// What keeps two endpoints of a topic apart.
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
    /// It is a gateway's or a bridge's, and stands for endpoints on other hosts, which are listed themselves.
    pub(crate) is_relay: bool,
    /// It only looks on.
    pub(crate) is_observer: bool,
    /// On another host: its tag.
    pub(crate) remote: Option<u64>,
    /// Of the endpoint of a service that carries responses: the endpoint of the same client or server that carries requests.
    pub(crate) partner: Option<u64>,
    /// Of a matched publisher that has to show that it is alive: where it does.
    pub(crate) liveliness: Option<LivelinessSource>,
}

impl Endpoint {
    /// One of this host that matches.
    pub(crate) fn new(gid: Gid, qos: Qos) -> Self {
        let (mismatch, remote, partner, liveliness) = Default::default();
        Endpoint { gid, mismatch, qos, is_relay: false, is_observer: false, remote, partner, liveliness }
    }

    fn is_matched_here(&self) -> bool {
        self.mismatch.is_none() && self.remote.is_none() && !self.is_observer
    }

    /// Whether it is an endpoint of the topic itself: not one that stands for others, which are listed, nor one that only looks on.
    pub(crate) fn is_itself(&self) -> bool {
        !self.is_relay && !self.is_observer
    }
}

/// All of them in the order of their gids, as a monitor gets them.
#[derive(Clone, Default)]
pub(crate) struct EndpointList {
    pub(crate) endpoints: Vec<Endpoint>,
    /// How many went without a word, so far.
    pub(crate) killed: u64,
}

/// The list that is kept.
#[derive(Default)]
pub(crate) struct Endpoints {
    list: BTreeMap<Gid, Endpoint>,
    /// Endpoints of this host.
    matched: usize,
    killed: u64,
    monitors: Vec<LatestWriter<Arc<EndpointList>>>,
    has_changed: bool,
}

impl Endpoints {
    pub(crate) fn contains(&self, gid: Gid) -> bool {
        self.list.contains_key(&gid)
    }

    /// Adds an endpoint, or what has become of it.
    pub(crate) fn set(&mut self, endpoint: Endpoint) {
        self.matched += usize::from(endpoint.is_matched_here());
        let former = self.list.insert(endpoint.gid, endpoint);
        self.matched -= usize::from(former.is_some_and(|former| former.is_matched_here()));
        self.has_changed = true;
    }

    /// Takes an endpoint from the list. True if it matched.
    pub(crate) fn remove(&mut self, gid: Gid, was_killed: bool) -> bool {
        let Some(endpoint) = self.list.remove(&gid) else { return false };
        self.has_changed = true;
        self.matched -= usize::from(endpoint.is_matched_here());
        let matched = endpoint.mismatch.is_none();
        self.killed += u64::from(matched && was_killed && endpoint.is_itself());
        matched
    }

    /// Endpoints on other hosts, sorted, with their tags, in place of those before. Of those that are gone these have `ended` by themselves.
    pub(crate) fn set_remote(&mut self, told: &[(Gid, u64)], ended: &HashSet<u64>) {
        let is_told = |gid: Gid| told.binary_search_by(|(other, _)| other.cmp(&gid)).is_ok();
        let remote = self.list.values().filter_map(|endpoint| Some((endpoint.gid, endpoint.remote?)));
        let gone: Vec<_> = remote.filter(|(gid, _)| !is_told(*gid)).collect();
        for (gid, tag) in gone {
            // Or somebody else tells of it now.
            let lives = told.iter().any(|(_, other)| *other == tag);
            self.remove(gid, !lives && !ended.contains(&tag));
        }
        for &(gid, tag) in told {
            if !self.list.contains_key(&gid) {
                self.set(Endpoint { remote: Some(tag), ..Endpoint::new(gid, Qos::default()) });
            }
        }
    }

    /// Tells monitors, if anything changed since this was last called, and says whether it did.
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

    /// What a new monitor reads.
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

/// Where a publisher shows that it is alive.
#[derive(Clone)]
pub(crate) struct LivelinessSource(Arc<Connection>);

impl LivelinessSource {
    pub(crate) fn new(connection: Arc<Connection>) -> Self {
        LivelinessSource(connection)
    }

    /// When it last did.
    pub(crate) fn alive_ns(&self) -> u64 {
        self.0.block().out.alive_ns.load(Ordering::Relaxed)
    }
}
