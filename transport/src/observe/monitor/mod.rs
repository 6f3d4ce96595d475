// SPDX-License-Identifier: MIT OR Apache-2.0
//! Changes of a publisher's or a subscription's matches, of liveliness, and lost messages: a monitor compares the present state
//! with the state that it saw before.
//!
//! A monitor may be used in any thread, and does not affect the publisher or subscription. The slot that it was created with is rung
//! when it must check: when the other endpoints of the topic change, when messages are lost, and when the publisher or subscription
//! ends. The sampler reports what is due at a certain time, from an [`Activity`](crate::Activity).
//!
//! A gateway's ports are not endpoints of the topic; the remote endpoints that they represent are.

pub(crate) mod publisher;
pub(crate) mod subscription;

use crate::memory::header::Gid;
use crate::topic::compatibility::QosPolicyKind;
use crate::topic::endpoints::{Endpoint, EndpointList, Mismatch};
use std::sync::Arc;
use tautline_doorbell::Slot;
use tautline_rt::LatestReader;

/// How many endpoints of the topic match this one: `total_count` have appeared so far, `current_count` exist
/// now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Matched {
    /// All endpoints that ever matched.
    pub total_count: u64,
    /// Endpoints that appeared since the last event.
    pub total_count_change: u64,
    /// Endpoints that match now.
    pub current_count: u64,
    /// The change of `current_count` since the last event.
    pub current_count_change: i64,
}

/// Incompatible endpoints of the topic were found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IncompatibleQos {
    /// All incompatible endpoints that were found.
    pub total_count: u64,
    /// Incompatible endpoints found since the last event.
    pub total_count_change: u64,
    /// The incompatible policy of the last one.
    pub last_policy_kind: QosPolicyKind,
}

/// Endpoints of the topic with another type were found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct IncompatibleType {
    /// All incompatible endpoints that were found.
    pub total_count: u64,
    /// Incompatible endpoints found since the last event.
    pub total_count_change: u64,
}

/// How many of the matched publishers are alive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LivelinessChanged {
    /// Publishers that are alive.
    pub alive_count: u64,
    /// Publishers that let their lease expire, and publishers that were killed or, on other hosts, are no longer
    /// announced, since the last event.
    pub not_alive_count: u64,
    /// The change since the last event.
    pub alive_count_change: i64,
    /// The change since the last event.
    pub not_alive_count_change: i64,
}

/// Messages were overwritten before they were taken: see [`SubscriptionCounters::lost`](crate::SubscriptionCounters::lost).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MessageLost {
    /// All lost messages so far.
    pub total_count: u64,
    /// Messages lost since the last event.
    pub total_count_change: u64,
}

/// The slot that is rung for the events of a publisher or subscription, as long as its monitor lives.
struct Events {
    watched: Arc<Slot>,
    events: usize,
}

impl Events {
    fn new(watched: &Arc<Slot>, events: &Slot) -> Self {
        watched.doorbell().arena().set_events(watched.index(), events.index());
        Events { watched: watched.clone(), events: events.index() }
    }
}

impl Drop for Events {
    fn drop(&mut self) {
        self.watched.doorbell().arena().clear_events(self.watched.index(), self.events);
    }
}

/// Compares the endpoints of the topic with those of the last check.
struct EndpointTracker {
    list: LatestReader<Arc<EndpointList>>,
    is_first: bool,
    /// The endpoints at the last check, in the order of their gids.
    known: Vec<KnownEndpoint>,
    former: Vec<KnownEndpoint>,
    matched: u64,
    total: u64,
    incompatible_qos: u64,
    incompatible_type: u64,
    killed: u64,
}

#[derive(Clone, Copy)]
struct KnownEndpoint {
    gid: Gid,
    mismatch: Option<Mismatch>,
}

#[derive(Default)]
struct Changes {
    matched: Option<Matched>,
    incompatible_qos: Option<IncompatibleQos>,
    incompatible_type: Option<IncompatibleType>,
    /// Number of endpoints that disappeared without a normal end.
    killed: u64,
}

impl EndpointTracker {
    fn new(list: LatestReader<Arc<EndpointList>>) -> Self {
        let (known, former) = Default::default();
        let (matched, total, incompatible_qos, incompatible_type, killed) = Default::default();
        EndpointTracker {
            list,
            is_first: true,
            known,
            former,
            matched,
            total,
            incompatible_qos,
            incompatible_type,
            killed,
        }
    }

    /// The endpoints of the topic, as of the last update, without relays and observers.
    fn iter(&self) -> impl Iterator<Item = &Endpoint> {
        self.list.current().endpoints.iter().filter(|endpoint| endpoint.is_itself())
    }

    /// Checks for changes since the last update.
    ///
    /// # Real-time
    /// One load if nothing changed; else O(endpoints), and allocates if there are more than ever before.
    fn update(&mut self) -> Changes {
        if !std::mem::take(&mut self.is_first) && !self.list.is_fresh() {
            return Changes::default();
        }
        let (matched, total) = (self.matched, self.total);
        let (qos, types) = (self.incompatible_qos, self.incompatible_type);
        std::mem::swap(&mut self.known, &mut self.former);
        self.known.clear();
        self.matched = 0;
        let (list, mut last_policy) = (self.list.read(), None);
        // Both lists are in order of their GIDs.
        let mut former = self.former.iter().peekable();
        for endpoint in list.endpoints.iter().filter(|endpoint| endpoint.is_itself()) {
            while former.next_if(|known| known.gid < endpoint.gid).is_some() {}
            let is_new = former
                .peek()
                .is_none_or(|known| known.gid != endpoint.gid || known.mismatch != endpoint.mismatch);
            match endpoint.mismatch {
                None => {
                    self.matched += 1;
                    self.total += u64::from(is_new);
                }
                Some(Mismatch::Qos(policy)) if is_new => {
                    self.incompatible_qos += 1;
                    last_policy = Some(policy);
                }
                Some(Mismatch::Type) if is_new => self.incompatible_type += 1,
                Some(_) => {}
            }
            self.known.push(KnownEndpoint { gid: endpoint.gid, mismatch: endpoint.mismatch });
        }
        let killed = list.killed - self.killed;
        self.killed = list.killed;
        let came = self.total - total;
        // If none appeared, the number of matches differs only if some disappeared.
        let has_changed = came > 0 || self.matched != matched;
        Changes {
            matched: has_changed.then_some(Matched {
                total_count: self.total,
                total_count_change: came,
                current_count: self.matched,
                current_count_change: self.matched as i64 - matched as i64,
            }),
            incompatible_qos: last_policy.map(|last_policy_kind| IncompatibleQos {
                total_count: self.incompatible_qos,
                total_count_change: self.incompatible_qos - qos,
                last_policy_kind,
            }),
            incompatible_type: (self.incompatible_type > types).then_some(IncompatibleType {
                total_count: self.incompatible_type,
                total_count_change: self.incompatible_type - types,
            }),
            killed,
        }
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;
    use crate::qos::Qos;
    use tautline_rt::latest;

    fn endpoint(n: u8, mismatch: Option<Mismatch>) -> Endpoint {
        Endpoint { mismatch, is_relay: n > 100, ..Endpoint::new(Gid([n; 16]), Qos::default()) }
    }

    #[test]
    fn ends_come_and_go() {
        let (mut writer, reader) = latest(Arc::<EndpointList>::default());
        let mut endpoints = EndpointTracker::new(reader);
        let deadline = Some(Mismatch::Qos(QosPolicyKind::Deadline));
        let mut update = |list: &[(u8, Option<Mismatch>)], killed: u64| {
            let listed = list.iter().map(|(n, mismatch)| endpoint(*n, *mismatch)).collect();
            writer.write(Arc::new(EndpointList { endpoints: listed, killed }));
            let changes = endpoints.update();
            (
                changes
                    .matched
                    .map(|m| (m.total_count, m.total_count_change, m.current_count, m.current_count_change)),
                changes.incompatible_qos.map(|i| (i.total_count, i.total_count_change, i.last_policy_kind)),
                changes.incompatible_type.map(|i| (i.total_count, i.total_count_change)),
                changes.killed,
            )
        };
        assert_eq!(update(&[], 0), (None, None, None, 0));
        assert_eq!(
            update(&[(1, None), (2, deadline), (101, None)], 0),
            (Some((1, 1, 1, 1)), Some((1, 1, QosPolicyKind::Deadline)), None, 0),
            "and one that stands for others"
        );
        assert_eq!(update(&[(1, None), (2, deadline)], 0), (None, None, None, 0), "nothing new");
        assert_eq!(update(&[(3, None)], 1), (Some((2, 1, 1, 0)), None, None, 1), "one for another");
        assert_eq!(update(&[], 1), (Some((2, 0, 0, -1)), None, None, 0));
        assert_eq!(update(&[(2, deadline)], 1).1, Some((2, 1, QosPolicyKind::Deadline)), "it came again");
        assert_eq!(
            update(&[(2, None), (5, Some(Mismatch::Type))], 1),
            (Some((3, 1, 1, 1)), None, Some((1, 1)), 0)
        );
        assert!(endpoints.update().matched.is_none(), "nobody wrote");
        assert_eq!(endpoints.iter().count(), 2);
    }
}
