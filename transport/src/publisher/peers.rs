// SPDX-License-Identifier: MIT OR Apache-2.0
//! The subscriptions that a publisher rings, brought up to date when the topic's epoch changes.

use crate::address::Address;
use crate::doorbell::{ArenaId, Flags, Link, NONE_FOR_IT, Owner, Pulse, PulseOf, Sleeper, Slot, THREADS};
use crate::header::Gid;
use crate::ports::{self, Reached};
use crate::sync::{Ordering, fence};
use crate::topic::Topic;

pub(crate) struct Peers {
    domain: u32,
    /// This publisher's own: subscriptions that do not fit it are none of its.
    address: Address,
    /// The epoch whose ports `matched` shows.
    pub(crate) epoch: Option<u32>,
    /// Sequence number of the sample published last.
    pub(crate) sequence_number: u64,
    pub(crate) matched: Vec<Matched>,
    /// Subscriptions that this publisher does not fit: they are told that nothing is for them, once.
    apart: Vec<Matched>,
    /// Doorbells that are of no use, now and later: the janitor has said so.
    refused: Vec<ArenaId>,
}

pub(crate) struct Matched {
    id: u128,
    pub(crate) reached: Reached,
    pub(crate) slot: usize,
    pub(crate) depth: u64,
    link: Option<usize>,
    /// Who is to be woken for the sample that is being published.
    sleeper: Option<Sleeper>,
}

impl Matched {
    /// What this publisher and the subscription tell each other; none if the subscription's links are all taken.
    pub(crate) fn link(&self) -> Option<&Link> {
        self.reached.arena().links(self.slot).get(self.link?)
    }

    fn flags(&self) -> Option<&Flags> {
        self.reached.arena().flags(self.slot)
    }

    pub(crate) fn keeps_all(&self) -> bool {
        self.flags().is_some_and(|flags| flags.has(Flags::KEEP_ALL))
    }

    /// Tells a subscription that has a deadline that a sample comes now.
    ///
    /// # Real-time
    /// Wait-free; no syscall.
    pub(crate) fn note_sample(&self, now_ns: u64) {
        if self.flags().is_some_and(|flags| flags.has(Flags::DEADLINE)) {
            self.reached.arena().set_pulse(Pulse { slot: self.slot, of: PulseOf::Sample }, now_ns);
        }
    }
}

impl Peers {
    pub(crate) fn new(domain: u32, address: Address, capacity: usize) -> Self {
        Peers {
            domain,
            address,
            epoch: None,
            sequence_number: 0,
            matched: Vec::with_capacity(capacity),
            apart: Vec::new(),
            refused: Vec::new(),
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.matched.len()
    }

    #[inline]
    pub(crate) fn refresh_if_changed(&mut self, topic: &Topic, slot: &Slot, gid: Gid) {
        if self.epoch != Some(slot.epoch()) {
            self.refresh(topic, slot, gid);
        }
    }

    /// Lists the topic's subscriptions, maps the doorbells of new ones and claims a link in each. Only when ports
    /// appeared or went: allocates, opens files. Where a doorbell cannot be mapped, the janitor goes on: samples are queued there
    /// all the same, and nobody would ever be woken for them.
    #[cold]
    pub(crate) fn refresh(&mut self, topic: &Topic, slot: &Slot, gid: Gid) {
        // Before listing: what changes after this load changes the epoch again.
        self.epoch = Some(slot.epoch());
        let ports = ports::subscriptions(&topic.factory);
        let stays = |matched: &Matched| {
            let stays = ports.iter().any(|port| port.id == matched.id);
            if !stays && let Some(link) = matched.link() {
                link.release(Owner::of(gid));
            }
            stays
        };
        self.matched.retain(stays);
        self.apart.retain(stays);
        self.refused.retain(|arena| ports.iter().any(|port| port.address.arena == *arena));
        for port in ports {
            let (own, arena) = (slot.doorbell(), port.address.arena);
            if self.all().any(|matched| matched.id == port.id) || self.refused.contains(&arena) {
                continue;
            }
            let known = self.all().find(|matched| matched.reached.arena().id() == arena);
            let reached = match known {
                Some(matched) => Ok(Some(matched.reached.clone())),
                None => Reached::reach(self.domain, own, arena),
            };
            let reached = match reached {
                Ok(Some(reached)) => reached,
                // Gone already: its end changes the epoch again.
                Ok(None) => continue,
                Err(error) => {
                    slot.leave_to_janitor();
                    if !ports::may_pass(&error) {
                        self.refused.push(arena);
                    }
                    continue;
                }
            };
            let waiter = (own.arena().id(), slot.index());
            let fits = self.address.incompatibility(&port.address).is_none();
            let start = if fits { self.sequence_number + 1 } else { NONE_FOR_IT };
            let link = reached.arena().claim_link(port.address.slot, gid, start, waiter);
            let depth = port.depth as u64;
            let (id, slot) = (port.id, port.address.slot);
            let matched = Matched { id, reached, slot, depth, link, sleeper: None };
            if fits { &mut self.matched } else { &mut self.apart }.push(matched);
        }
        // As `ring` wants them, those of an arena next to each other: stable, for within a process the oldest comes first.
        self.matched.sort_by_key(|matched| matched.reached.arena().id().0);
    }

    fn all(&self) -> impl Iterator<Item = &Matched> {
        self.matched.iter().chain(&self.apart)
    }

    /// Rings every subscription, but for those that poll by themselves and those that are still taking what they were rung for.
    /// All are marked before anybody is woken: whoever sleeps for several wakes once.
    ///
    /// # Real-time
    /// Wait-free, O(subscriptions); no allocation; at most one futex wake per sampler that sleeps, and per callback thread that
    /// sleeps and is woken directly.
    pub(crate) fn ring(&mut self) {
        for matched in &mut self.matched {
            matched.sleeper = matched.reached.arena().mark_sample(matched.slot);
        }
        fence(Ordering::SeqCst);
        let (mut last, mut woken) = (None, Woken::default());
        for matched in &self.matched {
            let Some(sleeper) = matched.sleeper else { continue };
            let arena = matched.reached.arena();
            // Those of an arena are next to each other; which bells they lead to, their threads say at any time.
            if last.replace(arena.id()) != Some(arena.id()) {
                woken = Woken::default();
            }
            if woken.add(sleeper) {
                arena.wake(sleeper);
            }
        }
    }

    /// The publisher `gid` ends: subscriptions settle what they did not get.
    pub(crate) fn end(&mut self, gid: Gid) {
        for matched in self.all() {
            if let Some(link) = matched.link() {
                link.release(Owner::of(gid));
            }
            matched.reached.arena().advance_epoch(matched.slot);
        }
        self.ring();
    }
}

/// Which sleepers of an arena were woken for a sample.
#[derive(Default)]
struct Woken {
    sampler: bool,
    /// A bit for each.
    threads: u128,
}

const _: () = assert!(THREADS <= u128::BITS as usize);

impl Woken {
    /// True if it was not among them.
    fn add(&mut self, sleeper: Sleeper) -> bool {
        match sleeper {
            Sleeper::Sampler => !std::mem::replace(&mut self.sampler, true),
            Sleeper::Thread(thread) => {
                let (bit, before) = (1u128 << (thread % THREADS), self.threads);
                self.threads |= bit;
                before & bit == 0
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::{Limits, Participant, Qos, TopicType};

    #[test]
    fn a_message_wakes_a_sampler_once_whatever_the_number_of_its_subscriptions() {
        const DOMAIN: u32 = 98;
        let participants = [(), ()].map(|()| Participant::new(DOMAIN).unwrap());
        let string = TopicType::new("std_msgs/msg/String".to_owned());
        let (qos, limits) = (Qos::keep_last(4), Limits::default());
        let subscribe = |one: &Participant| one.create_raw_subscription("/x", &string, qos, limits).unwrap();
        // Taking turns, so that those of a participant are not created one after the other.
        let _all: Vec<_> = (0..4).flat_map(|_| participants.each_ref().map(subscribe)).collect();
        let publisher = participants[0].create_raw_publisher("/x", &string, qos, limits).unwrap();
        let [one, other] = participants.each_ref().map(Participant::doorbell);
        let mut of_other = 0;
        let of_one = one.arena().bell().wakes(|| {
            of_other = other.arena().bell().wakes(|| publisher.publish(&[0; 8]).unwrap());
        });
        assert_eq!((of_one, of_other), (1, 1));
    }

    #[test]
    fn a_message_wakes_each_directly_woken_thread_once_and_the_sampler_once() {
        let participant = Participant::new(98).unwrap();
        let string = TopicType::new("std_msgs/msg/String".to_owned());
        let (qos, limits) = (Qos::keep_last(4), Limits::default());
        let bells = [(); 2].map(|()| participant.doorbell().claim_thread_bell().unwrap());
        // The sampler's, one thread's, the other's, and again.
        let _all: Vec<_> = [None, Some(&bells[0]), Some(&bells[1])]
            .repeat(2)
            .into_iter()
            .map(|bell| {
                let one = participant.create_raw_subscription("/direct", &string, qos, limits).unwrap();
                one.wake_thread(bell);
                one
            })
            .collect();
        let publisher = participant.create_raw_publisher("/direct", &string, qos, limits).unwrap();
        let arena = participant.doorbell().arena();
        let [mut first, mut second] = [0; 2];
        let sampler = arena.bell().wakes(|| {
            first = arena.thread_bell(0).unwrap().wakes(|| {
                second = arena.thread_bell(1).unwrap().wakes(|| publisher.publish(&[0; 8]).unwrap());
            });
        });
        assert_eq!((sampler, first, second), (1, 1, 1));
    }
}
