// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Expiry;
use std::collections::VecDeque;
use tautline_transport::{IncompatibleQos, IncompatibleType, LivelinessChanged, Matched, MessageLost};

/// What happens to a publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PublisherEvent {
    /// Subscriptions came or went.
    Matched(Matched),
    /// Subscriptions request what the publisher does not offer: they get nothing from it.
    OfferedIncompatibleQos(IncompatibleQos),
    /// Subscriptions of the topic are of another type: they get nothing from the publisher.
    IncompatibleType(IncompatibleType),
    /// Nothing was published in time.
    OfferedDeadlineMissed(DeadlineMissed),
    /// The publisher, whose liveliness is manual, did not show in time that it is alive.
    LivelinessLost(LivelinessLost),
}

/// What happens to a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SubscriptionEvent {
    /// Publishers came or went.
    Matched(Matched),
    /// Publishers do not offer what the subscription requests: it gets nothing from them.
    RequestedIncompatibleQos(IncompatibleQos),
    /// Publishers of the topic are of another type: the subscription gets nothing from them.
    IncompatibleType(IncompatibleType),
    /// Nothing came in time.
    RequestedDeadlineMissed(DeadlineMissed),
    /// Publishers came to life, or died.
    LivelinessChanged(LivelinessChanged),
    /// Messages were overwritten before they were taken.
    MessageLost(MessageLost),
}

/// Deadlines passed without a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeadlineMissed {
    /// All so far.
    pub total_count: u64,
    /// Those since the last event.
    pub total_count_change: u64,
    /// When the last one passed, in `CLOCK_MONOTONIC` nanoseconds.
    pub due_ns: u64,
}

/// Leases passed without a sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LivelinessLost {
    /// How often so far.
    pub total_count: u64,
    /// How often since the last event.
    pub total_count_change: u64,
}

impl From<Expiry> for DeadlineMissed {
    fn from(Expiry { due_ns, count, change }: Expiry) -> Self {
        DeadlineMissed { total_count: count, total_count_change: change, due_ns }
    }
}

/// Events that were found at one look and are given out one by one.
pub(super) struct Ready<E>(VecDeque<E>);

/// A look finds one of each kind at most.
const KINDS: usize = 6;

impl<E> Ready<E> {
    pub(super) fn new() -> Self {
        Ready(VecDeque::with_capacity(KINDS))
    }

    /// Never grows: they are given out before there is another look.
    pub(super) fn add<S>(&mut self, event: impl FnOnce(S) -> E, status: Option<S>) {
        self.0.extend(status.map(event));
    }

    pub(super) fn next(&mut self) -> Option<E> {
        self.0.pop_front()
    }
}
