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
        self.list.insert(endpoint.gid, endpoint);
        self.has_changed = true;
    }

    /// Removes an endpoint. Returns whether it matched.
    pub(crate) fn remove(&mut self, gid: Gid, was_killed: bool) -> bool {
        let Some(endpoint) = self.list.remove(&gid) else { return false };
        self.has_changed = true;
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

    /// Updates the matched counts and the monitors, if anything changed since the last call. Returns whether it did.
    pub(crate) fn notify(&mut self, counts: &MatchCounts) -> bool {
        if !std::mem::take(&mut self.has_changed) {
            return false;
        }
        let matched = || {
            let matches = |endpoint: &&Endpoint| endpoint.mismatch.is_none() && !endpoint.is_observer;
            self.list.values().filter(matches)
        };
        let here = matched().filter(|endpoint| endpoint.remote.is_none()).count();
        let everywhere = match matched().filter(|endpoint| endpoint.is_relay).count() {
            0 => here,
            relays => (matched().count() - relays).max(1),
        };
        counts.here.store(here, Ordering::Release);
        counts.everywhere.store(everywhere, Ordering::Release);
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

/// How many endpoints match an endpoint of a topic.
#[derive(Default)]
pub(crate) struct MatchCounts {
    /// On this host, relays included.
    pub(crate) here: AtomicUsize,
    /// On all hosts, as [`MatchedCount`] says.
    everywhere: AtomicUsize,
}

/// The number of endpoints that match an endpoint of a topic, on all hosts: a count that any thread may read. Endpoints on other hosts
/// count while a gateway or bridge is connected, which itself counts as one until an endpoint is announced, since messages already pass.
#[derive(Clone)]
pub struct MatchedCount(pub(crate) Arc<MatchCounts>);

impl MatchedCount {
    /// The count.
    ///
    /// # Real-time
    /// Wait-free: one load.
    pub fn get(&self) -> usize {
        self.0.everywhere.load(Ordering::Acquire)
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

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn endpoints_on_other_hosts_count_while_a_relay_is_matched() {
        let gid = |n: u8| Gid([n; 16]);
        let (mut endpoints, counts) = (Endpoints::default(), MatchCounts::default());
        let counted = |endpoints: &mut Endpoints| {
            endpoints.notify(&counts);
            [&counts.here, &counts.everywhere].map(|count| count.load(Ordering::Acquire))
        };
        let told = [(gid(11), 1), (gid(12), 2), (gid(13), 3)];
        endpoints.set_remote(&told, &HashSet::new());
        assert_eq!(counted(&mut endpoints), [0, 0], "messages do not pass yet");
        let relay = |n: u8| Endpoint { is_relay: true, ..Endpoint::new(gid(n), Qos::default()) };
        endpoints.set(relay(1));
        assert_eq!(counted(&mut endpoints), [1, 3]);
        endpoints.set(relay(2));
        endpoints.set(Endpoint::new(gid(3), Qos::default()));
        endpoints.set(Endpoint { is_observer: true, ..Endpoint::new(gid(4), Qos::default()) });
        endpoints.set(Endpoint { mismatch: Some(Mismatch::Type), ..Endpoint::new(gid(5), Qos::default()) });
        assert_eq!(counted(&mut endpoints), [3, 4]);
        endpoints.set_remote(&[], &HashSet::new());
        assert_eq!(counted(&mut endpoints), [3, 1]);
        endpoints.remove(gid(3), false);
        assert_eq!(counted(&mut endpoints), [2, 1], "messages pass, for whomever");
        endpoints.remove(gid(1), false);
        endpoints.remove(gid(2), false);
        assert_eq!(counted(&mut endpoints), [0, 0]);
    }
}
