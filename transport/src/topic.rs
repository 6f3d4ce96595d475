// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic: one iceoryx2 service whose attributes name the message type.

use crate::error::TransportError;
use crate::header::SampleHeader;
use crate::memory;
use crate::qos::{Durability, Limits, Qos};
use crate::schema_store;
use crate::topic_type::TopicType;
use iceoryx2::port::publisher::PublisherCreateError;
use iceoryx2::port::{DegradationAction, DegradationCause, DegradationInfo};
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::{
    Builder, PublishSubscribeCreateError, PublishSubscribeOpenError,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory as TopicFactory;

pub(crate) type IoxNode = Node<ipc::Service>;
pub(crate) type IoxPublisher = iceoryx2::port::publisher::Publisher<ipc::Service, [Word], SampleHeader>;
pub(crate) type IoxSubscriber = iceoryx2::port::subscriber::Subscriber<ipc::Service, [Word], SampleHeader>;
pub(crate) type IoxSample = iceoryx2::sample::Sample<ipc::Service, [Word], SampleHeader>;
pub(crate) type IoxLoan = iceoryx2::sample_mut::SampleMut<ipc::Service, [Word], SampleHeader>;
pub(crate) type Factory = TopicFactory<ipc::Service, [Word], SampleHeader>;

/// What payloads are made of: bodies are CDR, whose alignment is at most 8. (iceoryx2 can align bytes to 8 as well, but then
/// reserves 8 bytes for each.)
pub(crate) type Word = u64;
pub(crate) const BODY_ALIGNMENT: usize = align_of::<Word>();
/// Starts the names of the services through which late joiners get what they missed. ':' cannot be in a topic's name.
pub(crate) const HISTORY: &str = "history:";

/// The payload that holds a body of `len_bytes`, which is at most [`Limits::MAX_MESSAGE_BYTES`].
pub(crate) fn padded(len_bytes: usize) -> usize {
    len_bytes.max(1).next_multiple_of(BODY_ALIGNMENT)
}

/// The bytes of a payload.
pub(crate) fn bytes(payload: &[Word]) -> &[u8] {
    // SAFETY: the same memory; a Word has no padding, and u8 no alignment.
    unsafe { core::slice::from_raw_parts(payload.as_ptr().cast(), size_of_val(payload)) }
}

/// The bytes of a payload.
pub(crate) fn bytes_mut(payload: &mut [Word]) -> &mut [u8] {
    // SAFETY: as in `bytes`; and any bytes are valid Words.
    unsafe { core::slice::from_raw_parts_mut(payload.as_mut_ptr().cast(), size_of_val(payload)) }
}

/// An open topic.
pub(crate) struct Topic {
    pub(crate) name: String,
    pub(crate) factory: Factory,
    /// What is known of the type here, or was when the topic was made.
    pub(crate) topic_type: TopicType,
    pub(crate) limits: Limits,
    /// Where late joiners get what they missed; only for topics with a transient-local end in this process.
    pub(crate) history: Option<Factory>,
}

impl Topic {
    /// Opens or creates the topic.
    pub(crate) fn open(
        node: &IoxNode,
        name: &str,
        topic_type: &TopicType,
        qos: Qos,
        limits: Limits,
        is_queue: bool,
    ) -> Result<Self, TransportError> {
        qos.check(name)?;
        limits.check(name)?;
        topic_type.check(name)?;
        let transient_local = qos.durability == Durability::TransientLocal;
        // Only a subscription's depth is a queue; a transient-local publisher's keeper is one as well.
        let depth = if is_queue || transient_local { qos.depth } else { 1 };
        let wanted = Limits { depth: limits.depth.max(depth), ..limits };
        let requested = topic_type;
        let (factory, topic_type) = open_service(node, name, name, requested, wanted)?;
        // Known here by now, or by whoever made the topic: a claim, which sizes memory.
        let message_bytes = topic_type.body_bytes.map_or(limits.message_bytes, |bytes| bytes.max(1));
        Limits { message_bytes, ..limits }.check(name)?;
        let config = factory.static_config();
        let limits = Limits {
            publishers: config.max_publishers(),
            subscribers: config.max_subscribers().saturating_sub(config.max_publishers()),
            depth: config.subscriber_max_buffer_size(),
            held: config.subscriber_max_borrowed_samples(),
            loans: limits.loans,
            message_bytes,
            may_grow: limits.may_grow && topic_type.body_bytes.is_none(),
        };
        let history = transient_local
            .then(|| {
                // As the topic's, whoever opens it.
                let limits = history_limits(limits);
                open_service(node, name, &format!("{HISTORY}{name}"), &topic_type, limits)
            })
            .transpose()?
            .map(|(factory, _)| factory);
        if limits.depth < depth {
            return Err(TransportError::Limit {
                topic: name.into(),
                limit: "depth",
                existing: limits.depth,
                requested: depth,
            });
        }
        // Only what its bringer knows the hash of.
        schema_store::keep(requested);
        Ok(Topic { name: name.into(), factory, topic_type, limits, history })
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

    /// Makes a publisher's port, whose memory holds as many samples as can be in flight, and may grow if the
    /// limits say so.
    pub(crate) fn publisher_port(
        &self,
        factory: &Factory,
        name: &PortName,
        limits: Limits,
    ) -> Result<IoxPublisher, PublisherCreateError> {
        let strategy =
            if limits.may_grow { AllocationStrategy::PowerOfTwo } else { AllocationStrategy::Static };
        let samples = memory::samples(limits);
        factory
            .publisher_builder()
            .name(name)
            .initial_max_slice_len(padded(limits.message_bytes) / size_of::<Word>())
            .allocation_strategy(strategy)
            .override_sample_preallocation(move |_| samples)
            .max_loaned_samples(limits.loans)
            // A full queue overwrites its oldest sample; should that ever fail, nothing may spin in publish().
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .set_degradation_handler(self.warn_of_degradation())
            .create()
    }

    /// The port through which a keeper gives late joiners what they missed.
    pub(crate) fn history_port(&self, history: &Factory) -> Result<IoxPublisher, PublisherCreateError> {
        // What it sends was published, by this process: it grows if that did.
        let limits = Limits { loans: 1, ..history_limits(self.limits) };
        self.publisher_port(history, &PortName::new_empty(), limits)
    }

    pub(crate) fn iceoryx_error(&self, what: &'static str, reason: impl std::fmt::Debug) -> TransportError {
        TransportError::Iceoryx { topic: self.name.clone(), what, reason: format!("{reason:?}") }
    }
}

/// Opens a topic that exists, whatever its type. `None` if it does not, or cannot be opened.
pub(crate) fn open_existing(node: &IoxNode, topic: &str) -> Option<Factory> {
    builder(node, &ServiceName::new(topic).ok()?).open().ok()
}

fn builder(node: &IoxNode, service_name: &ServiceName) -> Builder<[Word], SampleHeader, ipc::Service> {
    node.service_builder(service_name).publish_subscribe::<[Word]>().user_header::<SampleHeader>()
}

/// One more than the topic's depth: the mark that ends a history.
fn history_limits(limits: Limits) -> Limits {
    Limits { depth: limits.depth + 1, ..limits }
}

/// Opens or creates a service, and says what is then known of its type.
fn open_service(
    node: &IoxNode,
    topic: &str,
    service: &str,
    topic_type: &TopicType,
    limits: Limits,
) -> Result<(Factory, TopicType), TransportError> {
    let refuse = |what, reason: String| TransportError::Iceoryx { topic: topic.into(), what, reason };
    let service_name = ServiceName::new(service).map_err(|error| TransportError::TopicName {
        topic: topic.into(),
        reason: format!("iceoryx2 does not accept it ({error:?})"),
    })?;
    // Another process may create or remove the service between two of these steps: try again a few times.
    for _ in 0..100 {
        match builder(node, &service_name).open() {
            Ok(factory) => {
                let existing = TopicType::from_attributes(factory.attributes());
                return Ok((factory, topic_type.join(topic, existing)?));
            }
            Err(
                PublishSubscribeOpenError::DoesNotExist | PublishSubscribeOpenError::IsMarkedForDestruction,
            ) => {}
            Err(PublishSubscribeOpenError::IncompatibleTypes) => {
                return Err(topic_type.mismatch(topic, None));
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
        let attributes =
            topic_type.to_attributes().map_err(|reason| refuse("describing the type", reason))?;
        let created = builder(node, &service_name)
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
            Ok(factory) => return Ok((factory, topic_type.clone())),
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
