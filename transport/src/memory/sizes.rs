// SPDX-License-Identifier: MIT OR Apache-2.0
//! How much shared memory a publisher needs.

use crate::memory::header::HEADER_BYTES;
use crate::qos::{Claim, Durability, Limits, Qos};
use tautline_rt::Caches;

/// Samples start at multiples of this.
pub(crate) const SAMPLE_ALIGNMENT: usize = 64;
/// Many shorter samples fit into any cache: of these, the sample that was freed last is used first.
const LEAST_IN_TURN: usize = 16 << 10;
/// Bodies are CDR, whose alignment is at most 8.
pub(crate) const BODY_ALIGNMENT: usize = 8;

/// Bytes of the payload that holds a body of `len_bytes`, which is at most [`Limits::MAX_MESSAGE_BYTES`].
pub(crate) fn padded(len_bytes: usize) -> usize {
    len_bytes.max(1).next_multiple_of(BODY_ALIGNMENT)
}

/// Bytes of a sample with a body of `len_bytes`.
pub(crate) fn sample_bytes(len_bytes: usize) -> usize {
    (HEADER_BYTES + padded(len_bytes)).next_multiple_of(SAMPLE_ALIGNMENT)
}

/// Bytes of a sample after the memory of its publisher was grown for a body of `len_bytes`: a power of two.
pub(crate) fn grown_sample_bytes(len_bytes: usize) -> usize {
    sample_bytes(len_bytes).next_power_of_two()
}

/// What the subscriptions of a publisher require of its memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Demand {
    /// The greatest depth of the subscriptions and of the history for late joiners.
    pub(crate) depth: usize,
    /// Samples that all subscriptions together may hold.
    pub(crate) held: usize,
    /// Samples that are kept for late joiners.
    pub(crate) kept: usize,
    /// For responses, which each go to one client: the greatest depth of the observers, which get all responses.
    pub(crate) observed: usize,
}

impl Demand {
    /// The demand of a publisher with this QoS, before its subscriptions are added.
    pub(crate) fn of_publisher(qos: &Qos) -> Self {
        let kept = if qos.durability == Durability::TransientLocal { qos.depth } else { 0 };
        Demand { depth: kept, kept, ..Demand::default() }
    }

    pub(crate) fn join(&mut self, depth: usize, held: usize) {
        self.depth = self.depth.max(depth);
        self.held = self.held.saturating_add(held);
    }

    /// Samples that a publisher can have in flight, so that no loan fails for want of memory.
    ///
    /// Every queue was given the same samples and keeps the newest of them, so all queues together, and what is kept for late
    /// joiners, hold no more than the newest `depth`. An older sample is one that a subscription holds, or that the publisher has
    /// loaned: while it loans it sends nothing, so meanwhile no sample grows old, and a subscription that gives one back and takes
    /// another takes one of the newest. Only a late joiner that is being connected right now has a queue that the publisher does not
    /// fill yet, with what was kept when that began. A subscription that has gone leaves its queue as it was until its samples are
    /// back, while the others go on: until then it counts its depth as held.
    pub(crate) fn samples(self, loans: usize) -> usize {
        let parts = [self.held, self.kept, self.observed, loans];
        parts.into_iter().fold(self.depth, usize::saturating_add)
    }
}

/// How many samples of a publisher are used in turn, in the order in which they are freed: so few that each has just left the caches of
/// the two cores that touched it when it is used again. The cache that these cores share also serves others: with more samples in turn,
/// samples would have to be fetched from memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Window {
    bytes: usize,
}

impl Window {
    pub(crate) fn of_machine() -> Self {
        Window::of(Caches::of_machine())
    }

    /// Twice the L2 caches of both cores, or a quarter of the shared L3 cache if that is less; 0 if that quarter is not larger than both.
    fn of(Caches { l2_bytes, l3_bytes }: Caches) -> Self {
        Window { bytes: if l3_bytes / 4 > 2 * l2_bytes { (4 * l2_bytes).min(l3_bytes / 4) } else { 0 } }
    }

    pub(crate) fn in_turn(self, sample_bytes: usize) -> usize {
        if sample_bytes < LEAST_IN_TURN { 1 } else { 1 + self.bytes / sample_bytes }
    }

    /// Samples to have beyond those that can be in flight.
    pub(crate) fn spare(
        self,
        Demand { held, .. }: Demand,
        sample_bytes: usize,
        samples: usize,
        limits: &Limits,
    ) -> usize {
        if held == 0 || sample_bytes < LEAST_IN_TURN || limits.claim == Claim::OnUse {
            return 0;
        }
        let wanted = (self.bytes / sample_bytes).saturating_sub(samples);
        wanted.min(limits.spare_bytes / sample_bytes)
    }
}

/// The shared memory of one publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicMemory {
    /// Samples that can be in flight, and spare ones ([`Limits::spare_bytes`]).
    pub samples: usize,
    /// Bytes of one sample.
    pub sample_bytes: usize,
    /// Bytes that are claimed with [`Claim::Ahead`](crate::Claim::Ahead), for all samples. With
    /// [`Claim::OnUse`](crate::Claim::OnUse) this is the maximum that is ever claimed.
    pub claimed_bytes: usize,
}

/// The memory of one publisher of messages of `body_bytes` that offers `qos`, with `subscriptions` subscriptions of depth `depth` at
/// most, each of which may hold `limits.held` samples. The number of spare samples depends on the caches of this machine.
///
/// For a type without a fixed size `body_bytes` is the largest message, and `limits.message_bytes` is at least that. If it
/// is not, the size of a sample doubles until a larger message fits, in a new segment with the same number of samples; the
/// old segment is released when its last sample has been returned.
///
/// ```
/// # use tautline_transport::{Limits, Qos, topic_memory};
/// let limits = Limits { held: 2, loans: 1, ..Limits::default() };
/// let camera = topic_memory(8 << 20, Qos::keep_last(1), limits, 3, 4);
/// assert_eq!((camera.samples, camera.sample_bytes), (4 + 3 * 2 + 1, (8 << 20) + 64));
/// ```
pub fn topic_memory(
    body_bytes: usize,
    qos: Qos,
    limits: Limits,
    subscriptions: usize,
    depth: usize,
) -> TopicMemory {
    let mut demand = Demand::of_publisher(&qos);
    demand.join(depth, subscriptions.saturating_mul(limits.held));
    let (in_flight, sample_bytes) = (demand.samples(limits.loans), sample_bytes(body_bytes));
    let spare = Window::of_machine().spare(demand, sample_bytes, in_flight, &limits);
    let samples = in_flight.saturating_add(spare);
    TopicMemory { samples, sample_bytes, claimed_bytes: samples.saturating_mul(sample_bytes) }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    #[test]
    fn samples_are_used_in_turn_by_the_caches() {
        let (mib, epyc) = (1 << 20, Window::of(Caches { l2_bytes: 1 << 20, l3_bytes: 32 << 20 }));
        // A part of a third level of 480 MiB is what a virtual machine has of it.
        let xeon = Window::of(Caches { l2_bytes: 2 << 20, l3_bytes: 480 << 20 });
        let in_turn = |window: Window| {
            [64, 4 << 10, 16 << 10, 64 << 10, mib, 4 * mib, 8 * mib, 64 * mib]
                .map(|body| window.in_turn(sample_bytes(body)))
        };
        assert_eq!(in_turn(epyc), [1, 1, 256, 64, 4, 1, 1, 1]);
        assert_eq!(in_turn(xeon), [1, 1, 511, 128, 8, 2, 1, 1]);
        // Nothing is shared, or less than the cores have for themselves.
        for l3_bytes in [0, 2 * mib] {
            assert_eq!(
                in_turn(Window::of(Caches { l2_bytes: mib, l3_bytes })),
                [1; 8],
                "last freed, first used"
            );
        }
    }

    #[test]
    fn spare_samples_are_for_long_messages_that_somebody_takes_and_bounded() {
        let window = Window::of(Caches { l2_bytes: 1 << 20, l3_bytes: 32 << 20 });
        let (mut demand, none) =
            (Demand::of_publisher(&Qos::default()), Limits { spare_bytes: 0, ..Limits::default() });
        let spare = |demand: Demand, body, limits: Limits| {
            window.spare(demand, sample_bytes(body), demand.samples(limits.loans), &limits)
        };
        assert_eq!(spare(demand, 64 << 10, Limits::default()), 0, "nobody takes them");
        demand.join(10, 4);
        let bodies = [64, 4 << 10, 16 << 10, 64 << 10, 1 << 20];
        let few = Limits { spare_bytes: 1 << 20, ..Limits::default() };
        let on_use = Limits { claim: Claim::OnUse, ..Limits::default() };
        assert_eq!(bodies.map(|body| spare(demand, body, Limits::default())), [0, 0, 237, 45, 0]);
        assert_eq!(bodies.map(|body| spare(demand, body, few)), [0, 0, 63, 15, 0]);
        assert_eq!([none, on_use].map(|limits| spare(demand, 64 << 10, limits)), [0; 2]);
        let [all, smallest] =
            [Limits::default(), none].map(|limits| topic_memory(64 << 10, Qos::default(), limits, 1, 10));
        let spare =
            Window::of_machine().spare(demand, smallest.sample_bytes, smallest.samples, &Limits::default());
        assert_eq!((smallest.samples, all.samples), (18, 18 + spare));
        assert_eq!(all.claimed_bytes, all.samples * all.sample_bytes);
    }

    #[test]
    fn a_sample_has_room_for_its_body() {
        for len in (0..100_000).step_by(7) {
            assert!(sample_bytes(len) >= HEADER_BYTES + len && sample_bytes(len) < HEADER_BYTES + len + 72);
            assert!(
                grown_sample_bytes(len).is_power_of_two() && grown_sample_bytes(len) >= sample_bytes(len)
            );
        }
        assert_eq!(HEADER_BYTES, 64, "docs/memory.md says so");
    }
}
