// SPDX-License-Identifier: MIT OR Apache-2.0

use super::remote::RemoteEnds;
use super::{Ends, IncompatibleQos, LivelinessChanged, Matched, MessageLost, Watched};
use crate::address::Address;
use crate::doorbell::{KILLED, Link, Pulse, PulseOf, Slot};
use crate::header::Gid;
use crate::nodes::EndpointKind;
use crate::ports;
use crate::qos::{Liveliness, Qos, nanoseconds};
use crate::subscription::{Counters, RawSubscription};
use crate::sync::Ordering;
use std::sync::Arc;
use std::time::Duration;

/// Tells what becomes of a subscription's publishers and of what they send. See [`RawSubscription::monitor`].
pub struct SubscriptionMonitor {
    watched: Watched,
    counters: Arc<Counters>,
    ends: Ends<Gid, Life>,
    remote: RemoteEnds,
    /// As at the last event.
    lost: u64,
    alive: u64,
    not_alive: u64,
    /// Of those not alive.
    killed: u64,
}

/// What changed since a subscription's monitor last looked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriptionChanges {
    /// Publishers came or went.
    pub matched: Option<Matched>,
    /// Publishers came that do not offer what the subscription requests.
    pub incompatible_qos: Option<IncompatibleQos>,
    /// Publishers came to life or died.
    pub liveliness: Option<LivelinessChanged>,
    /// Messages were lost.
    pub message_lost: Option<MessageLost>,
    /// When to look again though nothing rings: when the next lease of a publisher ends.
    pub look_again_ns: Option<u64>,
}

/// A publisher that is not alive is looked for this often at most.
const SHORTEST_NS: u64 = 1_000_000;

/// What is known of a publisher's liveliness.
struct Life {
    /// Of one that has to show that it is alive, the time within which it has to.
    lease_ns: Option<u64>,
    since_ns: u64,
    /// On another host: it lives as long as that host's gateway is heard to say so.
    is_remote: bool,
}

impl RawSubscription {
    /// What tells of this subscription's publishers, when `events` is rung. There is one at a time: a second one takes the first
    /// one's place.
    ///
    /// # Real-time
    /// Setup only.
    pub fn monitor(&self, events: &Slot) -> SubscriptionMonitor {
        let (topic, slot, address) = self.place();
        SubscriptionMonitor {
            watched: Watched::new(topic, slot, address, events),
            counters: self.counters(),
            ends: Ends::new(topic.limits.publishers),
            remote: RemoteEnds::watch(self.shared(), topic, EndpointKind::Publisher, events),
            lost: 0,
            alive: 0,
            not_alive: 0,
            killed: 0,
        }
    }
}

impl SubscriptionMonitor {
    /// What changed by `now_ns`, on `CLOCK_MONOTONIC`. The first time: since there was nothing.
    ///
    /// # Real-time
    /// O(publishers); no syscall; no allocation, unless the topic's participants have changed: iceoryx2's list allocates.
    pub fn look(&mut self, now_ns: u64) -> SubscriptionChanges {
        let mut changes = SubscriptionChanges::default();
        let mut killed = 0;
        // Not the one or the other: each is looked at.
        let has_changed = self.watched.has_changed() | self.remote.have_changed();
        let Watched { topic, slot, address, .. } = &self.watched;
        let links = slot.doorbell().arena().links(slot.index());
        if has_changed {
            let remote = self.remote.look();
            (changes.matched, changes.incompatible_qos) = self.ends.update(
                |each| {
                    ports::each_publisher(&topic.factory, |port| {
                        let lease_ns = lease_ns(&port.address);
                        let life = Life { lease_ns, since_ns: now_ns, is_remote: false };
                        if !port.address.is_relay {
                            each(port.gid, address.incompatibility(&port.address), life);
                        }
                    });
                    // What they send is passed on whatever is requested; that they end and that they die look alike from here.
                    for gid in remote {
                        each(*gid, None, Life { lease_ns: None, since_ns: now_ns, is_remote: true });
                    }
                },
                |gid, life| killed += u64::from(life.is_remote || was_killed(links, *gid)),
            );
        }
        let (mut alive, mut not_alive) = (0, 0);
        for end in &self.ends.known {
            // Without a link, which it may get later, it lives.
            let Some(lease_ns) = end.value.lease_ns else {
                alive += 1;
                continue;
            };
            let last_ns = alive_ns(links, end.key).unwrap_or(end.value.since_ns);
            let due_ns = last_ns.saturating_add(lease_ns);
            let is_alive = due_ns > now_ns;
            *if is_alive { &mut alive } else { &mut not_alive } += 1;
            // One that comes to life again rings nobody: it is looked for once in each lease. Leases are what others ask for: a
            // very short one is no reason to look all the time.
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
        // Those killed before are forgotten now.
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

    /// Whether the subscription has gone.
    pub fn has_ended(&self) -> bool {
        self.watched.slot.is_retired()
    }

    /// The quality of service that the subscription requests.
    pub fn qos(&self) -> &Qos {
        &self.watched.address.qos
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        &self.watched.topic.name
    }

    /// When a sample last came, taken or not, and how long the next one may take, if the subscription has a deadline.
    pub fn deadline(&self) -> Option<(Pulse, Duration)> {
        Some((self.watched.slot.pulse(PulseOf::Sample), self.qos().deadline?))
    }
}

fn lease_ns(address: &Address) -> Option<u64> {
    let lease = address.qos.liveliness_lease_duration?;
    (address.qos.liveliness == Liveliness::ManualByTopic).then(|| nanoseconds(lease))
}

/// Whether a publisher that is no longer there went without a word: it would have released its link.
fn was_killed(links: &[Link], gid: Gid) -> bool {
    let link = links.iter().find(|link| link.gid() == gid);
    link.is_some_and(|link| link.is_claimed() || link.out.alive_ns.load(Ordering::Relaxed) == KILLED)
}

/// When a publisher that has a link, or had one, last showed that it is alive.
fn alive_ns(links: &[Link], gid: Gid) -> Option<u64> {
    links.iter().find(|link| link.gid() == gid).map(|link| link.out.alive_ns.load(Ordering::Relaxed))
}

impl std::fmt::Debug for SubscriptionMonitor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SubscriptionMonitor").field("topic", &self.topic()).finish_non_exhaustive()
    }
}
