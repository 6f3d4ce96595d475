// SPDX-License-Identifier: MIT OR Apache-2.0

use super::event::{DeadlineMissed, LivelinessLost, PublisherEvent, Ready};
use crate::watchdog::{Watchdog, monitored};
use crate::{Alarm, Events};
use futures::Stream;
use std::pin::Pin;
use std::task::{Context, Poll};
use tautline_transport::{PublisherMonitor, RawPublisher, TransportError};

/// The QoS events of a publisher: subscriptions that appear, disappear or are incompatible, a missed deadline, lost liveliness. A
/// stream for any task, which ends with the publisher. The sampler wakes it; the publisher only stores a time for it.
#[must_use = "no events are reported unless it is polled"]
pub struct PublisherEvents {
    // Dropped before the alarm, whose slot it rings.
    monitor: PublisherMonitor,
    alarm: Alarm,
    deadline: Option<Watchdog>,
    lease: Option<Lease>,
    ready: Ready<PublisherEvent>,
}

/// A liveliness lease that the publisher has to keep.
struct Lease {
    watchdog: Watchdog,
    /// The time of the last reported expiry, and the number of expiries by then.
    told: Option<(u64, u64)>,
    period_ns: u64,
    lost: u64,
}

impl Lease {
    /// Reports a lost lease once, however long the silence lasts, until there was another sign of life.
    fn poll_lost(&mut self, context: &mut Context<'_>) -> Option<LivelinessLost> {
        let Poll::Ready(expiry) = self.watchdog.poll_expired(context) else { return None };
        let silent = self.told.is_some_and(|(due_ns, count)| {
            expiry.due_ns.saturating_sub(due_ns) == (expiry.count - count).saturating_mul(self.period_ns)
        });
        self.told = Some((expiry.due_ns, expiry.count));
        if silent {
            return None;
        }
        self.lost += 1;
        Some(LivelinessLost { total_count: self.lost, total_count_change: 1 })
    }
}

impl PublisherEvents {
    /// The events of `publisher`. A publisher has one such stream: a second one replaces the first.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError::Doorbell`] if there is no memory for its slots, at most three.
    pub fn new(events: &Events, publisher: &RawPublisher) -> Result<Self, TransportError> {
        let alarm = Alarm::new(events)?;
        let monitor = publisher.monitor(alarm.slot());
        let watchdog = |(activity, period)| Watchdog::new(events, activity, monitored(period));
        let deadline = monitor.deadline().map(watchdog).transpose()?;
        let lease = match monitor.lease() {
            Some((activity, period)) => {
                let period = monitored(period);
                let period_ns = tautline_rt::clock::nanoseconds(period);
                let watchdog = Watchdog::new(events, activity, period)?;
                Some(Lease { watchdog, told: None, period_ns, lost: 0 })
            }
            None => None,
        };
        Ok(PublisherEvents { monitor, alarm, deadline, lease, ready: Ready::new() })
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.monitor.topic()
    }

    fn poll_changes(&mut self, context: &mut Context<'_>) {
        let changes = self.monitor.changes();
        self.ready.add(PublisherEvent::Matched, changes.matched);
        self.ready.add(PublisherEvent::OfferedIncompatibleQos, changes.incompatible_qos);
        self.ready.add(PublisherEvent::IncompatibleType, changes.incompatible_type);
        if let Some(Poll::Ready(expiry)) =
            self.deadline.as_mut().map(|watchdog| watchdog.poll_expired(context))
        {
            self.ready.add(PublisherEvent::OfferedDeadlineMissed, Some(DeadlineMissed::from(expiry)));
        }
        let lost = self.lease.as_mut().and_then(|lease| lease.poll_lost(context));
        self.ready.add(PublisherEvent::LivelinessLost, lost);
    }
}

impl Stream for PublisherEvents {
    type Item = PublisherEvent;

    /// # Real-time
    /// No allocation; no syscall. When subscriptions came or went: O(subscriptions), allocates. Ends with the publisher.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<PublisherEvent>> {
        if let Some(event) = self.ready.next() {
            return Poll::Ready(Some(event));
        }
        // Registers for a ring before the check for changes. The alarm has no time.
        let _ = self.alarm.poll(context);
        if self.monitor.has_ended() {
            return Poll::Ready(None);
        }
        self.poll_changes(context);
        self.ready.next().map_or(Poll::Pending, |event| Poll::Ready(Some(event)))
    }
}

tautline_rt::debug_fields!(PublisherEvents, |this| topic = this.topic());
