// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::Expiry;
use std::collections::VecDeque;
use tautline_transport::{IncompatibleQos, IncompatibleType, LivelinessChanged, Matched, MessageLost};

/// A QoS event of a publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PublisherEvent {
    /// Subscriptions appeared or disappeared.
    Matched(Matched),
    /// Subscriptions request what the publisher does not offer: they get nothing from it.
    OfferedIncompatibleQos(IncompatibleQos),
    /// Subscriptions of the topic are of another type: they get nothing from the publisher.
    IncompatibleType(IncompatibleType),
    /// Nothing was published in time.
    OfferedDeadlineMissed(DeadlineMissed),
    /// The publisher, whose liveliness is manual, did not assert its liveliness in time.
    LivelinessLost(LivelinessLost),
}

/// A QoS event of a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SubscriptionEvent {
    /// Publishers appeared or disappeared.
    Matched(Matched),
    /// Publishers do not offer what the subscription requests: it gets nothing from them.
    RequestedIncompatibleQos(IncompatibleQos),
    /// Publishers of the topic are of another type: the subscription gets nothing from them.
    IncompatibleType(IncompatibleType),
    /// No message arrived in time.
    RequestedDeadlineMissed(DeadlineMissed),
    /// Publishers became alive, or died.
    LivelinessChanged(LivelinessChanged),
    /// Messages were overwritten before they were taken.
    MessageLost(MessageLost),
}

/// Deadlines passed without a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeadlineMissed {
    /// Missed deadlines so far.
    pub total_count: u64,
    /// Missed deadlines since the last event.
    pub total_count_change: u64,
    /// Time of the last missed deadline, in `CLOCK_MONOTONIC` nanoseconds.
    pub due_ns: u64,
}

/// Leases expired without an assertion of liveliness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LivelinessLost {
    /// Expired leases so far.
    pub total_count: u64,
    /// Expired leases since the last event.
    pub total_count_change: u64,
}

impl From<Expiry> for DeadlineMissed {
    fn from(Expiry { due_ns, count, change }: Expiry) -> Self {
        DeadlineMissed { total_count: count, total_count_change: change, due_ns }
    }
}

/// Events that were found by one check and are returned one by one.
pub(super) struct Ready<E>(VecDeque<E>);

/// One check finds at most one event of each kind.
const KINDS: usize = 6;

impl<E> Ready<E> {
    pub(super) fn new() -> Self {
        Ready(VecDeque::with_capacity(KINDS))
    }

    /// Adds an event, if there is a status. Never grows: all events are returned before the next check.
    pub(super) fn add<S>(&mut self, event: impl FnOnce(S) -> E, status: Option<S>) {
        self.0.extend(status.map(event));
    }

    pub(super) fn next(&mut self) -> Option<E> {
        self.0.pop_front()
    }
}
