// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services: a request goes to every server, the first answer comes back to the client that asked.
//!
//! A service is two topics: of requests, which all its clients publish and all its servers subscribe to, and of responses, the other
//! way round. A server's publisher of responses sends each to one client's subscription: an answer wakes only who asked. A
//! request carries its client's identifier and number in its header, as any sample does; the response repeats both, as on
//! the ROS 2 wire. Queues keep all: a full one is an error, nothing is lost.
//!
//! A client has its subscription to responses before it has its publisher of requests, and counts a server once both its ends are
//! connected: whoever is asked can answer. A request whose servers have all gone ends with [`ServiceError::ServerGone`].

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

/// What clients and servers of a service agree on.
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

    /// A service of which only the name, and perhaps the hash, are known.
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
    /// and of the responses. What identifies both is the request's client and number: [`RequestId::of`] their information. At most
    /// `depth` of each end wait. Losses of responses are counted a little late: when the next one is taken.
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

/// Why a request was not answered, or an answer not sent. It names the service.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// Nobody serves it. Nothing was sent.
    #[error("service '{service}' has no server: start one, or wait for one with `wait_for_service`")]
    NoServer {
        /// The service.
        service: Arc<str>,
    },
    /// Every server that got the request has ended or was killed without an answer; or it was passed on to another host, where
    /// nobody gave one.
    #[error("service '{service}': its server has gone without an answer; ask again when there is one")]
    ServerGone {
        /// The service.
        service: Arc<str>,
    },
    /// A server has not taken as many requests of this client as its queue holds. Nothing was sent.
    #[error(
        "service '{service}': a server's queue of this client's requests is full; wait for an answer, or give the server a deeper queue"
    )]
    RequestsFull {
        /// The service.
        service: Arc<str>,
    },
    /// A client has not taken as many responses as its queue holds. Nothing was sent.
    #[error("service '{service}': the client takes no responses, its queue of them is full")]
    ResponsesFull {
        /// The service.
        service: Arc<str>,
    },
    /// As many requests wait for their answers as a client can have. Nothing was sent.
    #[error(
        "service '{service}': {MAX_PENDING_REQUESTS} requests of this client wait already; await or drop one, or make a second client"
    )]
    TooManyPending {
        /// The service.
        service: Arc<str>,
    },
    /// The client has gone.
    #[error("service '{service}': the client that asked has gone")]
    ClientGone {
        /// The service.
        service: Arc<str>,
    },
    /// The client is there and waits, and its responses cannot be reached: its process's log says why.
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
    /// The response is not one of the service's type.
    #[error("service '{service}': the response is not valid: {source}")]
    Invalid {
        /// The service.
        service: Arc<str>,
        /// Why.
        source: Box<DecodeError>,
    },
}
