// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pending requests to a service of the far side, and the servers that may still answer each of them.

use super::routes::ServerId;
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};
use tautline_transport::{Gid, RequestId};

/// After this time a pending request may be dropped to make room.
const SILENT_TIME: Duration = Duration::from_secs(30);

/// Pending requests by an increasing number, each with a `Q` that the far side needs as long as the request is pending.
pub struct Pending<Q = ()> {
    asked: BTreeMap<i64, PendingRequest<Q>>,
    most: usize,
}

struct PendingRequest<Q> {
    id: RequestId,
    /// Servers that received the request and may still exist.
    servers: BTreeSet<ServerId>,
    since: Instant,
    _query: Q,
}

impl<Q> Pending<Q> {
    /// Creates a table with room for `most` requests.
    pub fn new(most: usize) -> Self {
        Pending { asked: BTreeMap::new(), most }
    }

    fn is_full(&self) -> bool {
        self.asked.len() >= self.most
    }

    /// Adds a request that was sent.
    pub fn add(&mut self, number: i64, id: RequestId, servers: BTreeSet<ServerId>, since: Instant, query: Q) {
        self.asked.insert(number, PendingRequest { id, servers, since, _query: query });
    }

    /// Removes an answered request. Of several servers, the first response counts.
    pub fn remove(&mut self, number: i64) -> Option<RequestId> {
        self.asked.remove(&number).map(|asked| asked.id)
    }

    /// Drops all requests. Returns their number.
    pub fn clear(&mut self) -> usize {
        std::mem::take(&mut self.asked).len()
    }

    /// Makes room for one more request: drops those of ended clients, and then the oldest one if it is older than a time-out, because
    /// its server is silent or its response was lost. Returns whether there is room, and the oldest request if it was dropped.
    pub fn make_room(
        &mut self,
        is_waited_for: impl Fn(Gid) -> bool,
        now: Instant,
    ) -> (bool, Option<RequestId>) {
        if self.is_full() {
            self.asked.retain(|_, asked| is_waited_for(asked.id.client));
        }
        let silent = if self.is_full() { self.take_silent(now) } else { None };
        (!self.is_full(), silent)
    }

    /// Sets the present servers. Removes and returns requests that no server can answer any more.
    pub fn set_servers(&mut self, servers: &BTreeSet<ServerId>) -> Vec<RequestId> {
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

    /// Removes the oldest request if it is older than the time-out.
    fn take_silent(&mut self, now: Instant) -> Option<RequestId> {
        let oldest = self.asked.first_entry()?;
        (now.saturating_duration_since(oldest.get().since) >= SILENT_TIME).then(|| oldest.remove().id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tautline_transport::NodeName;

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
        pending.add(1, id(1), [server(1)].into(), now, ());
        pending.add(2, id(2), [server(1), server(2)].into(), now, ());
        assert!(pending.set_servers(&[server(1), server(2)].into()).is_empty());
        // As many as before, but different ones; the second may still answer.
        assert_eq!(pending.set_servers(&[server(2), server(3)].into()), [id(1)]);
        assert_eq!(pending.remove(2), Some(id(2)));
        assert_eq!(pending.clear(), 0);
    }

    #[test]
    fn a_server_that_is_told_late_is_the_same() {
        let mut pending = Pending::new(10);
        pending.add(1, id(1), [server(0)].into(), Instant::now(), ());
        assert!(pending.set_servers(&[server(1)].into()).is_empty());
        assert_eq!(pending.set_servers(&[server(2)].into()), [id(1)]);
    }

    #[test]
    fn who_is_silent_makes_way_in_the_end() {
        let start = Instant::now();
        let mut pending = Pending::new(2);
        let is_waited_for = |_| true;
        pending.add(1, id(1), [server(1)].into(), start, ());
        assert_eq!(pending.make_room(|_| false, start), (true, None), "there is room");
        pending.add(2, id(2), [server(1)].into(), start + SILENT_TIME, ());
        assert_eq!(pending.make_room(is_waited_for, start + SILENT_TIME / 2), (false, None));
        assert_eq!(pending.make_room(is_waited_for, start + SILENT_TIME), (true, Some(id(1))));
        pending.add(3, id(3), [server(1)].into(), start + SILENT_TIME, ());
        assert_eq!(pending.make_room(is_waited_for, start + SILENT_TIME), (false, None));
        assert_eq!(pending.make_room(|_| false, start + SILENT_TIME), (true, None), "nobody waits");
        assert_eq!(pending.clear(), 0);
    }
}
