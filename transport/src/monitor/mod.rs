// SPDX-License-Identifier: MIT OR Apache-2.0
//! What becomes of a publisher's or a subscription's matches, of their liveliness and of lost messages: a monitor compares what
//! is there with what it saw before.
//!
//! A monitor belongs to whoever wants to know, in any thread; the publisher or subscription goes on without noticing it. It is
//! told when to look by a ring of the slot it was made with: when the topic's participants change, when messages are lost, and
//! when the publisher or subscription ends. What is due at a time is told by the sampler, from a [`Pulse`](crate::Pulse).
//!
//! A gateway's ports are no ends of the topic: the ends on other hosts are, for which they stand.

mod publisher;
mod remote;
mod subscription;

pub use publisher::{PublisherChanges, PublisherMonitor};
pub(crate) use remote::RemoteWatch;
pub use subscription::{SubscriptionChanges, SubscriptionMonitor};

use crate::address::Address;
use crate::compatibility::QosPolicyKind;
use crate::doorbell::Slot;
use crate::topic::Topic;
use std::sync::Arc;

/// How many ends of the topic fit this one: `total_count` have come so far, `current_count` are there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Matched {
    /// All that ever matched.
    pub total_count: u64,
    /// Those that came since the last event.
    pub total_count_change: u64,
    /// Those that are there.
    pub current_count: u64,
    /// How many more, or fewer, than at the last event.
    pub current_count_change: i64,
}

/// Ends of the topic were found that do not fit this one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IncompatibleQos {
    /// All that were found.
    pub total_count: u64,
    /// Those found since the last event.
    pub total_count_change: u64,
    /// What kept the last of them apart.
    pub last_policy_kind: QosPolicyKind,
}

/// How many of the matched publishers are alive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LivelinessChanged {
    /// Those that are alive.
    pub alive_count: u64,
    /// Those that let their lease pass, and those found killed, or on other hosts no longer found, since the last event.
    pub not_alive_count: u64,
    /// The difference from the last event.
    pub alive_count_change: i64,
    /// The difference from the last event.
    pub not_alive_count_change: i64,
}

/// Messages were overwritten before they were taken: see [`Counters::lost`](crate::Counters::lost).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MessageLost {
    /// All so far.
    pub total_count: u64,
    /// Those since the last event.
    pub total_count_change: u64,
}

/// A publisher or subscription as its monitor sees it.
struct Watched {
    topic: Arc<Topic>,
    slot: Arc<Slot>,
    address: Address,
    /// The slot that is rung for its events.
    events: usize,
    epoch: Option<u32>,
}

impl Watched {
    fn new(topic: &Arc<Topic>, slot: &Arc<Slot>, address: Address, events: &Slot) -> Self {
        slot.doorbell().arena().set_events(slot.index(), events.index());
        Watched { topic: topic.clone(), slot: slot.clone(), address, events: events.index(), epoch: None }
    }

    /// Whether the topic's participants changed since this was last asked.
    fn has_changed(&mut self) -> bool {
        let epoch = Some(self.slot.epoch());
        std::mem::replace(&mut self.epoch, epoch) != epoch
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.slot.doorbell().arena().clear_events(self.slot.index(), self.events);
    }
}

/// The ends of a topic that are there, each with what is known of it. Room for as many as the topic can have here.
struct Ends<K, V> {
    known: Vec<End<K, V>>,
    total: u64,
    incompatible: Vec<End<K, ()>>,
    incompatible_total: u64,
}

struct End<K, V> {
    key: K,
    is_there: bool,
    value: V,
}

impl<K: PartialEq + Copy, V> Ends<K, V> {
    fn new(capacity: usize) -> Self {
        let (known, incompatible) = (Vec::with_capacity(capacity), Vec::with_capacity(capacity));
        Ends { known, total: 0, incompatible, incompatible_total: 0 }
    }

    /// Brings the list up to date: `list` calls what it is given for each end that is there.
    fn update(
        &mut self,
        list: impl FnOnce(&mut dyn FnMut(K, Option<QosPolicyKind>, V)),
        mut gone: impl FnMut(&K, &V),
    ) -> (Option<Matched>, Option<IncompatibleQos>) {
        let (before, total, incompatible_total) = (self.known.len(), self.total, self.incompatible_total);
        self.known.iter_mut().for_each(|end| end.is_there = false);
        self.incompatible.iter_mut().for_each(|end| end.is_there = false);
        let mut last_policy = None;
        list(&mut |key, policy, value| match policy {
            None if note(&mut self.known, key, value) => self.total += 1,
            Some(policy) if note(&mut self.incompatible, key, ()) => {
                self.incompatible_total += 1;
                last_policy = Some(policy);
            }
            _ => {}
        });
        let mut left = 0;
        self.known.retain(|end| {
            if !end.is_there {
                gone(&end.key, &end.value);
                left += 1;
            }
            end.is_there
        });
        self.incompatible.retain(|end| end.is_there);
        let matched = Matched {
            total_count: self.total,
            total_count_change: self.total - total,
            current_count: self.known.len() as u64,
            current_count_change: self.known.len() as i64 - before as i64,
        };
        let incompatible = last_policy.map(|last_policy_kind| IncompatibleQos {
            total_count: self.incompatible_total,
            total_count_change: self.incompatible_total - incompatible_total,
            last_policy_kind,
        });
        ((left > 0 || self.total != total).then_some(matched), incompatible)
    }
}

/// Notes that an end is there. True if it was not known.
fn note<K: PartialEq, V>(ends: &mut Vec<End<K, V>>, key: K, value: V) -> bool {
    let known = ends.iter_mut().find(|end| end.key == key);
    let is_new = known.is_none();
    match known {
        Some(end) => end.is_there = true,
        None => ends.push(End { key, is_there: true, value }),
    }
    is_new
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn ends_come_and_go() {
        let mut ends = Ends::<u32, ()>::new(4);
        let mut update = |list: &[(u32, Option<QosPolicyKind>)]| {
            let mut gone = Vec::new();
            let each = |each: &mut dyn FnMut(u32, Option<QosPolicyKind>, ())| {
                list.iter().for_each(|(key, policy)| each(*key, *policy, ()));
            };
            let (matched, incompatible) = ends.update(each, |key, ()| gone.push(*key));
            (
                matched
                    .map(|m| (m.total_count, m.total_count_change, m.current_count, m.current_count_change)),
                incompatible.map(|i| (i.total_count, i.total_count_change, i.last_policy_kind)),
                gone,
            )
        };
        let deadline = Some(QosPolicyKind::Deadline);
        assert_eq!(update(&[]), (None, None, vec![]));
        assert_eq!(
            update(&[(1, None), (2, deadline)]),
            (Some((1, 1, 1, 1)), Some((1, 1, QosPolicyKind::Deadline)), vec![])
        );
        assert_eq!(update(&[(1, None), (2, deadline)]), (None, None, vec![]), "nothing new");
        assert_eq!(update(&[(3, None)]), (Some((2, 1, 1, 0)), None, vec![1]), "one for another");
        assert_eq!(update(&[]), (Some((2, 0, 0, -1)), None, vec![3]));
        assert_eq!(update(&[(2, deadline)]).1, Some((2, 1, QosPolicyKind::Deadline)), "it came again");
    }
}
