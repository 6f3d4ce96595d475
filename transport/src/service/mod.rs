// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services: a request goes to every server, and the first response comes back to the requesting client.
//!
//! A service consists of two topics: one for requests, which all its clients publish and all its servers subscribe to, and one for
//! responses, the other way round. A server's publisher sends each response to the subscription of one client, so a response wakes
//! only the requesting client. A request carries its client's identifier and its number in its header, like every sample; the
//! response repeats both, as on the ROS 2 wire. Queues keep all: a full queue is an error, and nothing is lost.
//!
//! A client creates its subscription to responses before its publisher of requests, and counts a server only when both of the
//! server's endpoints are connected. So every server that gets a request can respond. A request whose servers have all ended
//! fails with [`ServiceError::ServerGone`].

mod client;
mod hot;
mod pending;
mod queued;
mod server;
mod typed;

pub use client::{Availability, RawClient, RawPending};
pub use pending::MAX_PENDING_REQUESTS;
pub use queued::QueuedClient;
pub use server::{RawResponse, RawServer, RequestId};
pub use typed::{Client, PendingResponse, Request, Response, Server, ServiceCodec, UnwrittenResponse};

use crate::error::{LoanError, TransportError};
use crate::graph::record::{REQUESTS, RESPONSES, is_absolute};
use crate::participant::Participant;
use crate::qos::Limits;
use crate::topic::subscription::RawSubscription;
use crate::topic::topic_type::TopicType;
use std::sync::Arc;
use tautline_msgs::cdr::{DecodeError, EncodeError};
use tautline_msgs::{Definition, Message, Service};

/// The type of a service, on which clients and servers must agree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceType {
    /// The service: its name `package/srv/Name`, its hash, the size of its requests, its definition.
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

/// The queue of a client's responses: those that it waits for, and as many that it no longer does.
const RESPONSES_DEPTH: usize = 2 * MAX_PENDING_REQUESTS;
/// Responses that a client's user can hold besides those that nobody has looked at yet.
const HELD_RESPONSES: usize = 8;

/// The limits of a client's subscription to responses.
fn response_limits(limits: Limits) -> Limits {
    Limits { held: MAX_PENDING_REQUESTS + HELD_RESPONSES, ..limits }
}

/// The topics of a service's requests and responses.
fn topics(service: &str) -> Result<[String; 2], TransportError> {
    if is_absolute(service) {
        return Ok([REQUESTS, RESPONSES].map(|kind| format!("{kind}{service}")));
    }
    let reason = "its name begins with '/' and has tokens of letters, digits and '_'";
    Err(TransportError::ServiceName { service: service.escape_default().to_string(), reason })
}

impl Participant {
    /// Two [observers](Self::create_observer) of a service, for a tool: of the requests that clients on this host send to servers on it,
    /// and of the responses. A request and its response have the same [`RequestId::of`] their message information. At most `depth`
    /// messages of each endpoint are queued. Lost responses are counted only when the next response is taken.
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

/// Why a request got no response, or a response was not sent. Each variant names the service.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The service has no server. Nothing was sent.
    #[error("service '{service}' has no server: start one, or wait for one with `wait_for_service`")]
    NoServer {
        /// The service.
        service: Arc<str>,
    },
    /// Every server that got the request has ended or was killed without a response; or the request was relayed to another
    /// host, and no server there responded.
    #[error("service '{service}': its server ended without a response; request again when there is a server")]
    ServerGone {
        /// The service.
        service: Arc<str>,
    },
    /// The queue of a server for this client's requests is full. Nothing was sent.
    #[error(
        "service '{service}': a server's queue of this client's requests is full; wait for a response, or give the server a deeper queue"
    )]
    RequestsFull {
        /// The service.
        service: Arc<str>,
    },
    /// The client's queue of responses is full. Nothing was sent.
    #[error("service '{service}': the client takes no responses, and its queue of responses is full")]
    ResponsesFull {
        /// The service.
        service: Arc<str>,
    },
    /// The client has its maximum number of pending requests. Nothing was sent.
    #[error(
        "service '{service}': {MAX_PENDING_REQUESTS} requests of this client wait already; await or drop one, or make a second client"
    )]
    TooManyPending {
        /// The service.
        service: Arc<str>,
    },
    /// The client has ended.
    #[error("service '{service}': the requesting client has ended")]
    ClientGone {
        /// The service.
        service: Arc<str>,
    },
    /// The client exists and waits, but its subscription to responses cannot be reached: its process's log
    /// has the reason.
    #[error(
        "service '{service}': the client that asked cannot be reached, and waits; is /dev/shm full, or its process stopped or at its limit of open files (ulimit -n)?"
    )]
    ClientUnreachable {
        /// The service.
        service: Arc<str>,
    },
    /// No memory could be loaned.
    #[error("service '{service}': {source}")]
    Loan {
        /// The service.
        service: Arc<str>,
        /// Why.
        source: LoanError,
    },
    /// The message cannot be written: a string or sequence is longer than its bound.
    #[error("service '{service}': {source}")]
    Encode {
        /// The service.
        service: Arc<str>,
        /// Why.
        source: Box<EncodeError>,
    },
    /// The response is not valid for the service's type.
    #[error("service '{service}': the response is not valid: {source}")]
    Invalid {
        /// The service.
        service: Arc<str>,
        /// Why.
        source: Box<DecodeError>,
    },
}
