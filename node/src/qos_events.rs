// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS events of a publisher or a subscription, as streams.

pub use tautline_sampler::{DeadlineMissed, LivelinessLost, PublisherEvent, SubscriptionEvent};

use crate::error::Result;
use crate::node::Node;
use crate::subscription::Subscription;
use futures::{Stream, StreamExt};
use std::pin::Pin;
use std::task::{Context, Poll};
use tautline_executor::stop_requested;
use tautline_transport::{Codec, Decode, Publisher};

/// The QoS events of a publisher: a stream. See [`Node::publisher_events`].
#[must_use = "no events are reported unless it is polled"]
#[derive(Debug)]
pub struct PublisherEvents(tautline_sampler::PublisherEvents);

/// The QoS events of a subscription: a stream. See [`Node::subscription_events`].
#[must_use = "no events are reported unless it is polled"]
#[derive(Debug)]
pub struct SubscriptionEvents(tautline_sampler::SubscriptionEvents);

impl PublisherEvents {
    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.0.topic()
    }
}

impl SubscriptionEvents {
    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.0.topic()
    }
}

/// Polls the stream, which yields nothing more once the callback is to stop.
fn unless_stopped<S: Stream + Unpin>(stream: &mut S, context: &mut Context<'_>) -> Poll<Option<S::Item>> {
    if stop_requested() { Poll::Pending } else { stream.poll_next_unpin(context) }
}

impl Stream for PublisherEvents {
    type Item = PublisherEvent;

    /// # Real-time
    /// As [`tautline_sampler::PublisherEvents`].
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<PublisherEvent>> {
        unless_stopped(&mut self.0, context)
    }
}

impl Stream for SubscriptionEvents {
    type Item = SubscriptionEvent;

    /// # Real-time
    /// As [`tautline_sampler::SubscriptionEvents`].
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<SubscriptionEvent>> {
        unless_stopped(&mut self.0, context)
    }
}

impl Node {
    /// The QoS events of a publisher: subscriptions that appear, disappear or are incompatible, a missed deadline, lost
    /// liveliness. A separate stream, for any task, which ends with the publisher. The sampler wakes it; the publisher only
    /// stores a time for it. Each publisher has one such stream: a second one replaces the first.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`Error::Transport`](crate::Error::Transport) if the context has no slot left; the stream needs up to
    /// three.
    pub fn publisher_events(&self, publisher: &Publisher<impl Codec>) -> Result<PublisherEvents> {
        Ok(PublisherEvents(tautline_sampler::PublisherEvents::new(
            self.context.events(),
            publisher.as_ref(),
        )?))
    }

    /// The QoS events of a subscription: publishers that appear, disappear or are incompatible, that become alive or die; a
    /// missed deadline; lost messages. Otherwise like [`publisher_events`](Self::publisher_events).
    ///
    /// ```
    /// # use futures::{StreamExt, executor::block_on};
    /// # use tautline::{Context, Message, Node, Qos, Realtime, SubscriptionEvent};
    /// # #[derive(Message, Clone, Copy)] #[repr(C)] #[message(name = "demo_msgs/msg/Speed")] struct Speed { v: f64 }
    /// # let ctx = Context::builder().domain(200).realtime(Realtime::Off).build()?;
    /// # let mut node = Node::create(ctx, "example", "")?;
    /// let speeds = node.subscribe::<Speed>("/speed", Qos::default())?;
    /// let mut events = node.subscription_events(&speeds)?;
    /// let _publisher = node.create_publisher::<Speed>("/speed", Qos::default())?;
    /// let Some(SubscriptionEvent::Matched(matched)) = block_on(events.next()) else { panic!() };
    /// assert_eq!(matched.current_count, 1);
    /// # Ok::<(), tautline::Error>(())
    /// ```
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`publisher_events`](Self::publisher_events); the stream needs up to two slots.
    pub fn subscription_events(
        &self,
        subscription: &Subscription<impl Decode>,
    ) -> Result<SubscriptionEvents> {
        Ok(SubscriptionEvents(tautline_sampler::SubscriptionEvents::new(
            self.context.events(),
            subscription.as_ref(),
        )?))
    }
}
