// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::error::Result;
use crate::subscription::Samples;
use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_msgs::HEADER;
use tautline_schema::{DynamicMessage, Endian, Schema};
use tautline_transport::{RawSubscription, SubscriptionCounters};

/// Receives messages of a type that is known by its definition: a stream of JSON. Each message is a job on a callback thread,
/// as with [`Subscription`](crate::Subscription).
///
/// Not for real-time callbacks: each message allocates.
#[must_use = "nothing is received unless it is polled; dropping it ends it"]
pub struct SubscriptionUntyped {
    samples: Samples<RawSubscription>,
    schema: Arc<Schema>,
}

impl SubscriptionUntyped {
    pub(super) fn new(raw: RawSubscription, schema: Arc<Schema>) -> Self {
        SubscriptionUntyped { samples: Samples::new(raw), schema }
    }

    /// The type's definition.
    pub fn schema(&self) -> &Arc<Schema> {
        &self.schema
    }

    /// Received, lost, highest queue fill: to be read from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.samples.counters()
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.samples.source().topic()
    }
}

impl Stream for SubscriptionUntyped {
    type Item = Result<serde_json::Value>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let sample = self.samples.poll_next(context);
        sample.map(|sample| {
            let message = DynamicMessage::from_body(&self.schema, sample?.body(), Endian::Little);
            Some(message.map(|message| message.to_json_value()).map_err(Into::into))
        })
    }
}

/// Receives messages as CDR, each with the 4 bytes of the encapsulation header: a stream of bytes. Each message is a job on a
/// callback thread, as with [`Subscription`](crate::Subscription).
///
/// Not for real-time callbacks: each message is copied into an allocation of its own.
#[must_use = "nothing is received unless it is polled; dropping it ends it"]
pub struct SubscriptionRaw {
    samples: Samples<RawSubscription>,
}

impl SubscriptionRaw {
    pub(super) fn new(raw: RawSubscription) -> Self {
        SubscriptionRaw { samples: Samples::new(raw) }
    }

    /// Received, lost, highest queue fill: to be read from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.samples.counters()
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.samples.source().topic()
    }
}

impl Stream for SubscriptionRaw {
    type Item = Vec<u8>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Vec<u8>>> {
        self.samples.poll_next(context).map(|sample| Some([&HEADER[..], sample?.body()].concat()))
    }
}

impl AsRef<RawSubscription> for SubscriptionUntyped {
    fn as_ref(&self) -> &RawSubscription {
        self.samples.source()
    }
}

impl AsRef<RawSubscription> for SubscriptionRaw {
    fn as_ref(&self) -> &RawSubscription {
        self.samples.source()
    }
}

impl std::fmt::Debug for SubscriptionUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SubscriptionUntyped").field("topic", &self.topic()).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for SubscriptionRaw {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SubscriptionRaw").field("topic", &self.topic()).finish_non_exhaustive()
    }
}
