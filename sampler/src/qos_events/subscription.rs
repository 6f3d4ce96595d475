// SPDX-License-Identifier: MIT OR Apache-2.0

use super::event::{DeadlineMissed, Ready, SubscriptionEvent};
use crate::watchdog::{Watchdog, monitored};
use crate::{Alarm, Events};
use futures::Stream;
use std::pin::Pin;
use std::task::{Context, Poll};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{RawSubscription, SubscriptionMonitor, TransportError};

/// The QoS events of a subscription: publishers that appear, disappear or are incompatible, that become alive or die; a missed
/// deadline; lost messages. Otherwise like [`PublisherEvents`](crate::PublisherEvents).
#[must_use = "no events are reported unless it is polled"]
pub struct SubscriptionEvents {
    // Dropped before the alarm, whose slot it rings.
    monitor: SubscriptionMonitor,
    /// When the next lease of a publisher ends.
    alarm: Alarm,
    deadline: Option<Watchdog>,
    ready: Ready<SubscriptionEvent>,
}

impl SubscriptionEvents {
    /// The events of `subscription`. A subscription has one such stream: a second one replaces the first.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slots, two at most.
    pub fn new(events: &Events, subscription: &RawSubscription) -> Result<Self, TransportError> {
        let alarm = Alarm::new(events)?;
        let monitor = subscription.monitor(alarm.slot());
        let watchdog = |(activity, period)| Watchdog::new(events, activity, monitored(period));
        let deadline = monitor.deadline().map(watchdog).transpose()?;
        Ok(SubscriptionEvents { monitor, alarm, deadline, ready: Ready::new() })
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.monitor.topic()
    }

    fn poll_changes(&mut self, context: &mut Context<'_>) {
        let changes = self.monitor.changes(monotonic_ns());
        self.ready.add(SubscriptionEvent::Matched, changes.matched);
        self.ready.add(SubscriptionEvent::RequestedIncompatibleQos, changes.incompatible_qos);
        self.ready.add(SubscriptionEvent::IncompatibleType, changes.incompatible_type);
        self.ready.add(SubscriptionEvent::LivelinessChanged, changes.liveliness);
        self.ready.add(SubscriptionEvent::MessageLost, changes.message_lost);
        if let Some(Poll::Ready(expiry)) =
            self.deadline.as_mut().map(|watchdog| watchdog.poll_expired(context))
        {
            self.ready.add(SubscriptionEvent::RequestedDeadlineMissed, Some(DeadlineMissed::from(expiry)));
        }
        self.alarm.set(changes.look_again_ns);
    }
}

impl Stream for SubscriptionEvents {
    type Item = SubscriptionEvent;

    /// # Real-time
    /// O(publishers); no allocation, unless publishers came or went; no syscall, but for at most one futex wake when publishers have
    /// leases. Ends with the subscription.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<SubscriptionEvent>> {
        if let Some(event) = self.ready.next() {
            return Poll::Ready(Some(event));
        }
        loop {
            // Registers for a ring before the check for changes.
            let _ = self.alarm.poll(context);
            if self.monitor.has_ended() {
                return Poll::Ready(None);
            }
            self.poll_changes(context);
            if let Some(event) = self.ready.next() {
                return Poll::Ready(Some(event));
            }
            // Ready if the alarm's time has passed meanwhile: at most once for each lease.
            if self.alarm.poll(context).is_pending() {
                return Poll::Pending;
            }
        }
    }
}

tautline_rt::debug_fields!(SubscriptionEvents, |this| topic = this.topic());
