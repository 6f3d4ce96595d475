// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic as one endpoint declares it.

use crate::error::TransportError;
use crate::graph::log::hash_of;
use crate::graph::record::{PortKind, PortRecord, QosRecord};
use crate::graph::schema_store;
use crate::graph::topic_type::TopicType;
use crate::names::{MAX_NAME_BYTES, is_topic};
use crate::qos::{Limits, Qos};
use crate::topic::endpoints::Mismatch;

/// A topic as one endpoint sees it.
#[derive(Clone, Debug)]
pub(crate) struct Topic {
    pub(crate) name: String,
    /// What this endpoint knows about the topic's type.
    pub(crate) topic_type: TopicType,
}

impl Topic {
    /// Checks the declaration of an endpoint, and stores the definition of its type.
    pub(crate) fn check(
        name: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
    ) -> Result<Self, TransportError> {
        if !is_topic(name) {
            return Err(TransportError::TopicName {
                topic: name.escape_default().to_string(),
                reason: format!("it has 1 to {MAX_NAME_BYTES} bytes, no control characters and no ':'"),
            });
        }
        qos.check(name)?;
        limits.check(name)?;
        topic_type.check(name)?;
        let message_bytes = topic_type.body_bytes.map_or(limits.message_bytes, |bytes| bytes.max(1));
        Limits { message_bytes, ..limits }.check(name)?;
        // Stored only if the endpoint knows both the hash and the definition.
        schema_store::keep(topic_type);
        Ok(Topic { name: name.to_owned(), topic_type: topic_type.clone() })
    }

    /// The name in messages to users: for the topic of a service's requests, the service.
    pub(crate) fn named(&self) -> String {
        crate::error::named(&self.name)
    }

    pub(crate) fn hash(&self) -> u64 {
        hash_of(&self.name)
    }

    /// The record of an endpoint: its topic, type and QoS; the rest is unset.
    pub(crate) fn record(&self, kind: PortKind, qos: &Qos) -> PortRecord {
        PortRecord {
            node: None,
            kind,
            topic: self.name.clone(),
            type_name: self.topic_type.name.to_string(),
            hash: self.topic_type.hash.as_ref().map(ToString::to_string),
            body_bytes: self.topic_type.body_bytes.map(|bytes| bytes as u64),
            qos: QosRecord::from(qos),
            relay: false,
            observer: false,
            slot: 0,
            at: 0,
            partner: None,
        }
    }

    /// Warns, when an endpoint is created or discovered, that two endpoints exchange no messages, and why.
    pub(crate) fn warn_of_mismatch(&self, mismatch: Mismatch, here: &str, there: &str, port: &PortRecord) {
        match mismatch {
            Mismatch::Qos(policy) => tracing::warn!(
                "{}: this {here} and a {there} are QoS-incompatible: the offered {policy} does not meet the requested one \
                 (docs/qos.md)",
                self.named()
            ),
            Mismatch::Type => tracing::warn!(
                "{}: this {here} and a {there} have different types, '{}' and '{}': rename one of them, or use the same type",
                self.named(),
                self.topic_type.describe(),
                port.topic_type().describe()
            ),
        }
    }
}
