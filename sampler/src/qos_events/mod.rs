// SPDX-License-Identifier: MIT OR Apache-2.0
//! QoS events of a publisher or a subscription, as streams that the sampler wakes.

mod event;
mod publisher;
mod subscription;

pub use event::{DeadlineMissed, LivelinessLost, PublisherEvent, SubscriptionEvent};
pub use publisher::PublisherEvents;
pub use subscription::SubscriptionEvents;
