// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pending requests to a service in ROS, and which servers may still answer each.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};
use tautline_relay::ServerId;
use tautline_transport::RequestId;

/// After this time a pending request may be dropped to make room.
pub(super) const SILENT_TIME: Duration = Duration::from_secs(30);

/// By ROS's sequence number, which increases.
pub(super) struct Pending {
    asked: BTreeMap<i64, PendingRequest>,
    most: usize,
}

struct PendingRequest {
    id: RequestId,
    /// Servers that received it and may still exist.
    servers: BTreeSet<ServerId>,
    since: Instant,
}

impl Pending {
    /// With room for `most` requests.
    pub(super) fn new(most: usize) -> Self {
        Pending { asked: BTreeMap::new(), most }
    }

    pub(super) fn len(&self) -> usize {
        self.asked.len()
    }

    pub(super) fn is_full(&self) -> bool {
        self.asked.len() >= self.most
    }

    pub(super) fn add(&mut self, number: i64, id: RequestId, servers: BTreeSet<ServerId>, since: Instant) {
        self.asked.insert(number, PendingRequest { id, servers, since });
    }

    /// Removes an answered request. Of several servers, the first response counts.
    pub(super) fn remove(&mut self, number: i64) -> Option<RequestId> {
        self.asked.remove(&number).map(|asked| asked.id)
    }

    pub(super) fn clear(&mut self) {
        self.asked.clear();
    }

    /// Keeps only requests that a client waits for.
    pub(super) fn retain(&mut self, is_waiting: impl Fn(RequestId) -> bool) {
        self.asked.retain(|_, asked| is_waiting(asked.id));
    }

    /// Sets the present servers. Removes and returns requests that no server can answer any more.
    pub(super) fn set_servers(&mut self, servers: &BTreeSet<ServerId>) -> Vec<RequestId> {
        let mut lost = Vec::new();
        self.asked.retain(|_, asked| {
            let still = asked.servers.iter().filter_map(|had| servers.iter().find(|has| had.is(has)));
            asked.servers = still.cloned().collect();
            if asked.servers.is_empty() {
                lost.push(asked.id);
            }
            !asked.servers.is_empty()
        });
        lost
    }

    /// Removes the oldest request, if it is older than the time-out.
    pub(super) fn take_silent(&mut self, now: Instant) -> Option<RequestId> {
        let oldest = self.asked.first_entry()?;
        (now.saturating_duration_since(oldest.get().since) >= SILENT_TIME).then(|| oldest.remove().id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::{Gid, NodeName};

    fn id(sequence_number: u64) -> RequestId {
        RequestId { client: Gid([1; 16]), sequence_number }
    }

    fn server(gid: u8) -> ServerId {
        ServerId { node: Some(NodeName { namespace: "/".into(), name: "node".into() }), gid: Gid([gid; 16]) }
    }

    #[test]
    fn a_server_that_was_replaced_between_two_looks_does_not_answer() {
        let now = Instant::now();
        let mut pending = Pending::new(10);
        pending.add(1, id(1), [server(1)].into(), now);
        pending.add(2, id(2), [server(1), server(2)].into(), now);
        assert!(pending.set_servers(&[server(1), server(2)].into()).is_empty());
        // As many as before, but different ones; the second may still answer.
        assert_eq!(pending.set_servers(&[server(2), server(3)].into()), [id(1)]);
        assert_eq!(pending.remove(2), Some(id(2)));
        assert_eq!(pending.len(), 0);
    }

    #[test]
    fn a_server_that_is_told_late_is_the_same() {
        let mut pending = Pending::new(10);
        pending.add(1, id(1), [server(0)].into(), Instant::now());
        assert!(pending.set_servers(&[server(1)].into()).is_empty());
        assert_eq!(pending.set_servers(&[server(2)].into()), [id(1)]);
    }

    #[test]
    fn who_is_silent_makes_way_in_the_end() {
        let start = Instant::now();
        let mut pending = Pending::new(2);
        pending.add(1, id(1), [server(1)].into(), start);
        assert!(!pending.is_full());
        pending.add(2, id(2), [server(1)].into(), start + SILENT_TIME);
        assert!(pending.is_full());
        assert_eq!(pending.take_silent(start + SILENT_TIME / 2), None);
        assert_eq!(pending.take_silent(start + SILENT_TIME), Some(id(1)));
        assert_eq!(pending.take_silent(start + SILENT_TIME), None);
    }
}
