// SPDX-License-Identifier: MIT OR Apache-2.0
//! The type of a service, and the two topics that it consists of.

use crate::error::TransportError;
use crate::graph::topic_type::TopicType;
use crate::names::{REQUESTS, RESPONSES, is_absolute};
use crate::qos::Limits;
use crate::service::pending::MAX_PENDING_REQUESTS;
use crate::topic::participant::Participant;
use crate::topic::subscription::RawSubscription;
use tautline_msgs::{Definition, Message, Service};

/// The type of a service, on which clients and servers must agree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceType {
    /// The service's name `package/srv/Name`, hash and definition, and the size of its requests.
    pub request: TopicType,
    /// The response message.
    pub response: TopicType,
}

impl ServiceType {
    /// The service `S`.
    pub fn of<S: Service>() -> Self {
        let request = TopicType::new(S::TYPE_NAME).with_hash(S::TYPE_HASH);
        let body_bytes = <S::Request as Message>::FIXED_LEN;
        let definition = S::Event::DEFINITION.map(|event| definition_text(S::TYPE_NAME, event).into());
        let request = TopicType { body_bytes, definition, ..request };
        ServiceType { request, response: TopicType::of::<S::Response>() }
    }

    /// A service type of which only the name, and perhaps the hash, is known.
    pub fn new(name: &str, hash: Option<&str>) -> Self {
        let request = TopicType::new(name.to_owned());
        let request = match hash {
            Some(hash) => request.with_hash(hash.to_owned()),
            None => request,
        };
        ServiceType { request, response: TopicType::new(format!("{name}_Response")) }
    }
}

/// The definition of a service as text, made from that of its event, which contains request and response.
fn definition_text(service: &str, event: &Definition) -> String {
    let fields = [("Request", "request"), ("Response", "response"), ("Event", "event")];
    let fields = fields.map(|(part, field)| format!("{service}_{part} {field}_message\n")).concat();
    format!("{fields}{}\nMSG: {service}_Event\n{}", "=".repeat(80), event.to_text())
}

/// Depth of a client's queue of responses: those that it waits for, and as many that it no longer waits for.
pub(crate) const RESPONSES_DEPTH: usize = 2 * MAX_PENDING_REQUESTS;
/// Responses that a client's user can hold at least, besides those that wait in the table of pending requests.
const HELD_RESPONSES: usize = 8;

/// The limits of a client's subscription to responses.
pub(crate) fn response_limits(limits: Limits) -> Limits {
    let held = limits.held.max(HELD_RESPONSES).saturating_add(MAX_PENDING_REQUESTS);
    Limits { held: held.min(Limits::MAX_HELD), ..limits }
}

pub(crate) fn topics(service: &str) -> Result<[String; 2], TransportError> {
    if is_absolute(service) {
        return Ok([REQUESTS, RESPONSES].map(|kind| format!("{kind}{service}")));
    }
    let reason = "its name begins with '/' and has tokens of letters, digits and '_'";
    Err(TransportError::ServiceName { service: service.escape_default().to_string(), reason })
}

impl Participant {
    /// Two [observers](Self::create_observer) of a service, for a tool: of the requests that clients on this host send to servers on it,
    /// and of the responses. A request and its response have the same [`RequestId::of`](crate::RequestId::of) their message information.
    /// At most `depth` messages of each endpoint are queued. Lost responses are counted only when the next response is taken.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// As [`create_observer`](Self::create_observer).
    pub fn create_service_observer(
        &self,
        service: &str,
        service_type: &ServiceType,
        depth: usize,
        limits: Limits,
    ) -> Result<[RawSubscription; 2], TransportError> {
        let [requests, responses] = topics(service)?;
        let requests = self.create_observer(&requests, &service_type.request, depth, limits)?;
        let responses = self.create_observer(&responses, &service_type.response, depth, limits)?;
        Ok([requests, responses])
    }
}
