// SPDX-License-Identifier: MIT OR Apache-2.0
//! What happens to a publisher or a subscription besides its messages, as streams.

pub use tautline_sampler::{DeadlineMissed, LivelinessLost, PublisherEvent, SubscriptionEvent};

use crate::error::Result;
use crate::node::Node;
use futures::{Stream, StreamExt};
use std::pin::Pin;
use std::task::{Context, Poll};
use tautline_executor::stop_requested;
use tautline_transport::{RawPublisher, RawSubscription};

/// What happens to a publisher: a stream. See [`Node::publisher_events`].
#[must_use = "no events are reported unless it is polled"]
#[derive(Debug)]
pub struct PublisherEvents(tautline_sampler::PublisherEvents);

/// What happens to a subscription: a stream. See [`Node::subscription_events`].
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

/// Nothing is given out any more once the callback is to stop.
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
        Ok(PublisherEvents(tautline_sampler::PublisherEvents::new(
            self.context.events(),
            publisher.as_ref(),
        )?))
    }

    /// What happens to a subscription: publishers that come, go or do not fit, that come to life or die; its deadline missed;
    /// messages lost. As [`publisher_events`](Self::publisher_events).
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
    /// As [`publisher_events`](Self::publisher_events); it takes up to two.
    pub fn subscription_events(
        &self,
        subscription: &impl AsRef<RawSubscription>,
    ) -> Result<SubscriptionEvents> {
        Ok(SubscriptionEvents(tautline_sampler::SubscriptionEvents::new(
            self.context.events(),
            subscription.as_ref(),
        )?))
    }
}
