// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::observe::monitor::{
    Changes, EndpointTracker, Events, IncompatibleQos, IncompatibleType, LivelinessChanged, Matched,
    MessageLost,
};
use crate::qos::Qos;
use crate::topic::reader::core::SubscriptionCore;
use crate::topic::subscription::{RawSubscription, SubscriptionCounters};
use std::sync::Arc;
use std::time::Duration;
use tautline_doorbell::{Activity, ActivityKind, Slot};
use tautline_rt::clock::nanoseconds;

/// Reports changes of a subscription's publishers, and lost messages. See [`RawSubscription::monitor`].
pub struct SubscriptionMonitor {
    core: Arc<SubscriptionCore>,
    counters: Arc<SubscriptionCounters>,
    endpoints: EndpointTracker,
    /// Numbers as of the last event: of lost messages, of publishers that are alive, and of publishers that are not.
    lost: u64,
    alive: u64,
    not_alive: u64,
    /// How many of the publishers that are not alive were killed.
    killed: u64,
    _events: Events,
}

/// What has changed since a subscription's monitor last checked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriptionChanges {
    /// Publishers appeared or disappeared.
    pub matched: Option<Matched>,
    /// Publishers appeared that do not offer what the subscription requests.
    pub incompatible_qos: Option<IncompatibleQos>,
    /// Publishers of another type appeared.
    pub incompatible_type: Option<IncompatibleType>,
    /// Publishers became alive or died.
    pub liveliness: Option<LivelinessChanged>,
    /// Messages were lost.
    pub message_lost: Option<MessageLost>,
    /// When to check again even if nothing rings: when the next lease of a publisher ends.
    pub look_again_ns: Option<u64>,
}

/// Shortest interval of checks whether a publisher has become alive again.
const SHORTEST_NS: u64 = 1_000_000;

impl RawSubscription {
    /// A monitor that reports changes of this subscription's publishers when `events` is rung. A subscription has one monitor at
    /// a time: a second one replaces the first.
    ///
    /// # Real-time
    /// Setup only.
    pub fn monitor(&self, events: &Slot) -> SubscriptionMonitor {
        let core = self.core().clone();
        // Set before the list is read, so that changes in between ring.
        let _events = Events::new(&core.slot, events);
        let (counters, endpoints) = (self.counters(), EndpointTracker::new(core.monitor()));
        SubscriptionMonitor { core, counters, endpoints, lost: 0, alive: 0, not_alive: 0, killed: 0, _events }
    }
}

impl SubscriptionMonitor {
    /// What has changed since the last call, by the `CLOCK_MONOTONIC` time `now_ns`; the first time, compared
    /// with an empty state.
    ///
    /// # Real-time
    /// O(publishers); no syscall; allocates if there are more publishers than ever before.
    pub fn changes(&mut self, now_ns: u64) -> SubscriptionChanges {
        let Changes { matched, incompatible_qos, incompatible_type, killed } = self.endpoints.update();
        let mut changes = SubscriptionChanges {
            matched,
            incompatible_qos,
            incompatible_type,
            ..SubscriptionChanges::default()
        };
        let (mut alive, mut not_alive) = (0, 0);
        for endpoint in self.endpoints.iter().filter(|endpoint| endpoint.mismatch.is_none()) {
            let lease = endpoint.qos.liveliness_lease_duration.map(nanoseconds);
            let (Some(liveliness), Some(lease_ns)) = (&endpoint.liveliness, lease) else {
                alive += 1;
                continue;
            };
            let due_ns = liveliness.alive_ns().saturating_add(lease_ns);
            let is_alive = due_ns > now_ns;
            *if is_alive { &mut alive } else { &mut not_alive } += 1;
            // A publisher that becomes alive again does not ring: this is checked once per lease. Other processes choose the lease, so a
            // very short lease must not cause constant checks.
            let again_ns = if is_alive { due_ns } else { now_ns.saturating_add(lease_ns.max(SHORTEST_NS)) };
            changes.look_again_ns = Some(changes.look_again_ns.map_or(again_ns, |other| other.min(again_ns)));
        }
        changes.liveliness = self.note_liveliness(alive, not_alive, killed);
        let lost = self.counters.lost();
        if lost != self.lost {
            changes.message_lost =
                Some(MessageLost { total_count: lost, total_count_change: lost.saturating_sub(self.lost) });
            self.lost = lost;
        }
        changes
    }

    fn note_liveliness(&mut self, alive: u64, not_alive: u64, killed: u64) -> Option<LivelinessChanged> {
        if killed == 0 && alive == self.alive && not_alive + self.killed == self.not_alive {
            return None;
        }
        // Publishers that were killed before the last event no longer count.
        self.killed = killed;
        let not_alive = not_alive + killed;
        let changed = LivelinessChanged {
            alive_count: alive,
            not_alive_count: not_alive,
            alive_count_change: alive as i64 - self.alive as i64,
            not_alive_count_change: not_alive as i64 - self.not_alive as i64,
        };
        (self.alive, self.not_alive) = (alive, not_alive);
        Some(changed)
    }

    /// Whether the subscription has ended.
    pub fn has_ended(&self) -> bool {
        self.core.slot.is_retired()
    }

    /// The quality of service that the subscription requests.
    pub fn qos(&self) -> &Qos {
        &self.core.qos
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.core.topic.name
    }

    /// When the last sample arrived, taken or not, and the deadline of the next one, if the subscription has a
    /// deadline.
    pub fn deadline(&self) -> Option<(Activity, Duration)> {
        Some((self.core.slot.activity(ActivityKind::Sample), self.qos().deadline?))
    }
}

tautline_rt::debug_fields!(SubscriptionMonitor, |this| topic = this.topic());
