// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS events of a publisher or a subscription, as streams that the sampler wakes.

mod event;
mod publisher;
mod subscription;

pub use event::{DeadlineMissed, LivelinessLost, PublisherEvent, SubscriptionEvent};
pub use publisher::PublisherEvents;
pub use subscription::SubscriptionEvents;

use std::time::Duration;

/// Shorter deadlines and leases are watched as if they were this long. No thread could keep one, and each that is missed again and
/// again would keep the sampler, which nothing may wait for, busy with nothing else.
const SHORTEST: Duration = Duration::from_micros(50);

/// How long a deadline or a lease is watched for.
fn watched(period: Duration) -> Duration {
    period.max(SHORTEST)
}
