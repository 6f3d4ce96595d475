// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic: one iceoryx2 service whose attributes name the message type.

use crate::error::TransportError;
use crate::header::SampleHeader;
use crate::qos::{Durability, Limits, Qos};
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::*;
use iceoryx2::service::attribute::{AttributeKey, AttributeValue};
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeCreateError, PublishSubscribeOpenError};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory as TopicFactory;
use tautline_msgs::{Message, Plain};

pub(crate) type IoxNode = Node<ipc::Service>;
pub(crate) type IoxPublisher = iceoryx2::port::publisher::Publisher<ipc::Service, [u8], SampleHeader>;
pub(crate) type IoxSubscriber = iceoryx2::port::subscriber::Subscriber<ipc::Service, [u8], SampleHeader>;
pub(crate) type IoxSample = iceoryx2::sample::Sample<ipc::Service, [u8], SampleHeader>;
pub(crate) type IoxLoan = iceoryx2::sample_mut::SampleMut<ipc::Service, [u8], SampleHeader>;
pub(crate) type Factory = TopicFactory<ipc::Service, [u8], SampleHeader>;

/// Bodies are CDR, whose alignment is at most 8.
pub(crate) const BODY_ALIGNMENT: usize = 8;
/// Attribute keys of a topic's service.
const TYPE: &str = "ros.type";
const SIZE: &str = "ros.size";

/// What a topic carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TypeInfo {
    pub(crate) name: &'static str,
    /// Size of a body in memory, in bytes.
    pub(crate) len_bytes: usize,
}

impl TypeInfo {
    fn describe(self) -> String {
        format!("{} ({} bytes)", self.name, self.len_bytes)
    }
}

/// An open topic.
pub(crate) struct Topic {
    pub(crate) name: String,
    pub(crate) factory: Factory,
    pub(crate) type_info: TypeInfo,
    pub(crate) limits: Limits,
    /// Where late joiners get what they missed; only for topics with a transient-local end in this process.
    pub(crate) history: Option<Factory>,
}

impl Topic {
    /// Opens or creates the topic for messages of type `T`.
    pub(crate) fn open_for<T: Message + Plain>(
        node: &IoxNode,
        name: &str,
        qos: Qos,
        limits: Limits,
        is_queue: bool,
    ) -> Result<Self, TransportError> {
        qos.check(name)?;
        let transient_local = qos.durability == Durability::TransientLocal;
        let type_info = TypeInfo { name: T::TYPE_NAME, len_bytes: size_of::<T>() };
        // Only a subscription's depth is a queue; a transient-local publisher's keeper is one as well.
        let depth = if is_queue || transient_local { qos.depth } else { 1 };
        Self::open(node, name, type_info, limits, depth, transient_local)
    }

    /// Opens or creates the topic. `depth` is what the caller will ask for, which a new topic's limit must allow.
    fn open(
        node: &IoxNode,
        name: &str,
        type_info: TypeInfo,
        limits: Limits,
        depth: usize,
        transient_local: bool,
    ) -> Result<Self, TransportError> {
        limits.check(name)?;
        let wanted = Limits { depth: limits.depth.max(depth), ..limits };
        let factory = open_service(node, name, name, type_info, wanted)?;
        let config = factory.static_config();
        let limits = Limits {
            publishers: config.max_publishers(),
            subscribers: config.max_subscribers().saturating_sub(config.max_publishers()),
            depth: config.subscriber_max_buffer_size(),
            held: config.subscriber_max_borrowed_samples(),
            loans: limits.loans,
        };
        let history = transient_local
            .then(|| {
                // As the topic's, whoever opens it, and one more than the depth: the mark that ends a history.
                // ':' cannot be in a topic's name.
                let limits = Limits { depth: limits.depth + 1, ..limits };
                open_service(node, name, &format!("history:{name}"), type_info, limits)
            })
            .transpose()?;
        if limits.depth < depth {
            return Err(TransportError::Limit {
                topic: name.into(),
                limit: "depth",
                existing: limits.depth,
                requested: depth,
            });
        }
        Ok(Topic { name: name.into(), factory, type_info, limits, history })
    }

    /// What a port does when iceoryx2 cannot connect it to another one: go on without, but not silently.
    pub(crate) fn warn_of_degradation(
        &self,
    ) -> impl Fn(DegradationCause, &DegradationInfo) -> DegradationAction + Send + use<> {
        let topic = self.name.clone();
        move |_, _| {
            tracing::warn!(
                "topic '{topic}': a publisher and a subscription cannot be connected, so nothing goes from one to the \
                 other; is the process at its limit of open files (ulimit -n)?"
            );
            DegradationAction::Ignore
        }
    }

    pub(crate) fn iceoryx_error(&self, what: &'static str, reason: impl std::fmt::Debug) -> TransportError {
        TransportError::Iceoryx { topic: self.name.clone(), what, reason: format!("{reason:?}") }
    }
}

fn open_service(
    node: &IoxNode,
    topic: &str,
    service: &str,
    type_info: TypeInfo,
    limits: Limits,
) -> Result<Factory, TransportError> {
    let refuse = |what, reason: String| TransportError::Iceoryx { topic: topic.into(), what, reason };
    let service_name = ServiceName::new(service).map_err(|error| TransportError::TopicName {
        topic: topic.into(),
        reason: format!("iceoryx2 does not accept it ({error:?})"),
    })?;
    let builder = || {
        let builder =
            node.service_builder(&service_name).publish_subscribe::<[u8]>().user_header::<SampleHeader>();
        match Alignment::new(BODY_ALIGNMENT) {
            Some(alignment) => builder.payload_alignment(alignment),
            None => builder,
        }
    };
    // Another process may create or remove the service between two of these steps: try again a few times.
    for _ in 0..100 {
        match builder().open() {
            Ok(factory) => return check_type(topic, type_info, factory),
            Err(
                PublishSubscribeOpenError::DoesNotExist | PublishSubscribeOpenError::IsMarkedForDestruction,
            ) => {}
            Err(PublishSubscribeOpenError::IncompatibleTypes) => {
                return Err(TransportError::TypeMismatch {
                    topic: topic.into(),
                    existing: "something that is not a Tautline message".into(),
                    requested: type_info.describe(),
                });
            }
            Err(PublishSubscribeOpenError::ExceedsMaxNumberOfNodes) => {
                return Err(TransportError::Limit {
                    topic: topic.into(),
                    limit: "subscribers",
                    existing: nodes(limits),
                    requested: nodes(limits) + 1,
                });
            }
            Err(error) => return Err(refuse("opening", format!("{error:?}"))),
        }
        let attributes = attributes(type_info).map_err(|reason| refuse("describing the type", reason))?;
        let created = builder()
            .enable_safe_overflow(true)
            .history_size(0)
            .max_publishers(limits.publishers)
            // A transient-local publisher's keeper is a subscriber as well.
            .max_subscribers(limits.subscribers + limits.publishers)
            .max_nodes(nodes(limits))
            .subscriber_max_buffer_size(limits.depth)
            .subscriber_max_borrowed_samples(limits.held)
            .create_with_attributes(&attributes);
        match created {
            Ok(factory) => return Ok(factory),
            Err(
                PublishSubscribeCreateError::AlreadyExists
                | PublishSubscribeCreateError::IsBeingCreatedByAnotherInstance,
            ) => {}
            Err(error) => return Err(refuse("creating", format!("{error:?}"))),
        }
    }
    Err(refuse("opening", "other processes kept creating and removing it".into()))
}

fn nodes(limits: Limits) -> usize {
    (limits.publishers + limits.subscribers).max(20)
}

fn attributes(type_info: TypeInfo) -> Result<AttributeSpecifier, String> {
    let define = |specifier: AttributeSpecifier, name: &str, value: &str| {
        let value = AttributeValue::try_from(value).map_err(|error| format!("{error:?}"))?;
        specifier.define(&key(name)?, &value).map_err(|error| format!("{error:?}"))
    };
    let specifier = define(AttributeSpecifier::new(), TYPE, type_info.name)?;
    define(specifier, SIZE, &type_info.len_bytes.to_string())
}

fn key(name: &str) -> Result<AttributeKey, String> {
    AttributeKey::try_from(name).map_err(|error| format!("{error:?}"))
}

fn check_type(topic: &str, type_info: TypeInfo, factory: Factory) -> Result<Factory, TransportError> {
    let attribute = |name| {
        let value = factory.attributes().key_value(&key(name).ok()?, 0)?;
        Some(value.to_string())
    };
    let (name, size) = (attribute(TYPE), attribute(SIZE));
    if name.as_deref() == Some(type_info.name) && size == Some(type_info.len_bytes.to_string()) {
        return Ok(factory);
    }
    Err(TransportError::TypeMismatch {
        topic: topic.into(),
        existing: format!("{} ({} bytes)", name.as_deref().unwrap_or("?"), size.as_deref().unwrap_or("?")),
        requested: type_info.describe(),
    })
}
