// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::error::{Error, Result};
use futures::TryFutureExt;
use std::future::Future;
use std::sync::Arc;
use tautline_msgs::cdr::Endian;
use tautline_msgs::split_header;
use tautline_schema::{DynamicMessage, Schema};
use tautline_transport::{Gid, PublisherCounters, RawPublisher};

/// Publishes messages of a type that is known by its definition, as JSON or CDR. Nothing is sent that is not a message of
/// the type.
///
/// May be moved to another thread, and is used by one at a time.
pub struct PublisherUntyped {
    raw: RawPublisher,
    schema: Arc<Schema>,
}

impl PublisherUntyped {
    pub(super) fn new(raw: RawPublisher, schema: Arc<Schema>) -> Self {
        PublisherUntyped { raw, schema }
    }

    /// Sends while `gate` is open.
    #[cfg(feature = "lifecycle_msgs")]
    pub(crate) fn with_gate(self, gate: tautline_transport::Gate) -> Self {
        PublisherUntyped { raw: self.raw.with_gate(gate), ..self }
    }

    /// Publishes a message: an object of its fields, those left out having their defaults.
    ///
    /// # Real-time
    /// Not for real-time threads: allocates.
    ///
    /// # Errors
    /// [`Error::Message`](crate::Error::Message) with the field if it is not a message of the type;
    /// [`Error::Publish`](crate::Error::Publish).
    pub fn publish(&self, msg: serde_json::Value) -> Result<()> {
        let message = DynamicMessage::from_json_value(&self.schema, msg)?;
        Ok(self.raw.publish(&message.to_body())?)
    }

    /// Publishes the CDR of a message as it is on the ROS 2 wire and in bags: the encapsulation header of 4 bytes, then the
    /// body. It is decoded once to check it. Little-endian bytes are then copied as they are, without what other
    /// middleware appended; big-endian ones are written anew.
    ///
    /// # Real-time
    /// Not for real-time threads: allocates.
    ///
    /// # Errors
    /// [`Error::Message`](crate::Error::Message) with field and byte if it is not a message of the type;
    /// [`Error::Publish`](crate::Error::Publish).
    pub fn publish_raw(&self, data: &[u8]) -> Result<()> {
        let message = DynamicMessage::from_cdr(&self.schema, data)?;
        let published = match split_header(data) {
            Ok((Endian::Little, body)) => {
                let len = body.len().saturating_sub(message.trailing_bytes());
                self.raw.publish(body.get(..len).unwrap_or_default())
            }
            _ => self.raw.publish(&message.to_body()),
        };
        Ok(published?)
    }

    /// The type's definition.
    pub fn schema(&self) -> &Arc<Schema> {
        &self.schema
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.raw.topic()
    }

    /// This publisher's identifier.
    pub fn gid(&self) -> Gid {
        self.raw.gid()
    }

    /// The counters, to be read from any thread.
    pub fn counters(&self) -> Arc<PublisherCounters> {
        self.raw.counters()
    }

    /// Number of subscriptions that the next message goes to.
    pub fn subscription_count(&self) -> usize {
        self.raw.subscription_count()
    }

    /// Waits for a matching subscription: see [`RawPublisher::wait_for_subscriptions`].
    ///
    /// # Errors
    /// As there.
    pub fn wait_for_subscriptions(&self) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        Ok(self.raw.wait_for_subscriptions()?.map_err(Error::from))
    }
}

impl AsRef<RawPublisher> for PublisherUntyped {
    fn as_ref(&self) -> &RawPublisher {
        &self.raw
    }
}

impl std::fmt::Debug for PublisherUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PublisherUntyped")
            .field("topic", &self.topic())
            .field("type", &self.schema.name().as_str())
            .finish_non_exhaustive()
    }
}
