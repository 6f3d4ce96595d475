// SPDX-License-Identifier: MIT OR Apache-2.0
//! What happens to a publisher or a subscription besides its messages, as streams.

mod event;
mod publisher;
mod subscription;

pub use event::{DeadlineMissed, LivelinessLost, PublisherEvent, SubscriptionEvent};
pub use publisher::PublisherEvents;
pub use subscription::SubscriptionEvents;

use crate::error::Result;
use crate::node::Node;
use std::time::Duration;
use tautline_transport::{RawPublisher, RawSubscription};

/// Shorter deadlines and leases are watched as if they were this long. No thread could keep one, and each that is missed again and
/// again would keep the sampler, which nothing may wait for, busy with nothing else.
const SHORTEST: Duration = Duration::from_micros(50);

/// How long a deadline or a lease is watched for.
fn watched(period: Duration) -> Duration {
    period.max(SHORTEST)
}

impl Node {
    /// What happens to a publisher: subscriptions that come, go or do not fit, its deadline missed, its liveliness lost. A stream
    /// of its own, for any task, that ends with the publisher. The sampler wakes it; the publisher does nothing more for it than
    /// to store a time. There is one for each publisher: a second one takes the first one's place.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`Error::Transport`](crate::Error::Transport) if the context has no slot left; it takes up to three.
    pub fn publisher_events(&self, publisher: &impl AsRef<RawPublisher>) -> Result<PublisherEvents> {
        PublisherEvents::new(self.context.events(), publisher.as_ref())
    }

    /// What happens to a subscription: publishers that come, go or do not fit, that come to life or die; its deadline missed;
    /// messages lost. As [`publisher_events`](Self::publisher_events).
    ///
    /// ```
    /// # use futures::{StreamExt, executor::block_on};
    /// # use tautline::{Context, Message, Node, QosProfile, Realtime, SubscriptionEvent};
    /// # #[derive(Message, Clone, Copy)] #[repr(C)] #[message(name = "demo_msgs/msg/Speed")] struct Speed { v: f64 }
    /// # let ctx = Context::builder().domain(200).realtime(Realtime::Off).build()?;
    /// # let mut node = Node::create(ctx, "example", "")?;
    /// let speeds = node.subscribe_loaned::<Speed>("/speed", QosProfile::default())?;
    /// let mut events = node.subscription_events(&speeds)?;
    /// let _publisher = node.create_publisher::<Speed>("/speed", QosProfile::default())?;
    /// let Some(SubscriptionEvent::Matched(matched)) = block_on(events.next()) else { panic!() };
    /// assert_eq!(matched.current_count, 1);
    /// # Ok::<(), tautline::Error>(())
    /// ```
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`publisher_events`](Self::publisher_events); it takes up to two.
    pub fn subscription_events(
        &self,
        subscription: &impl AsRef<RawSubscription>,
    ) -> Result<SubscriptionEvents> {
        SubscriptionEvents::new(self.context.events(), subscription.as_ref())
    }
}
