// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services: a request goes to every server, the first answer comes back to the client that asked.
//!
//! A service is a topic of requests, which all its clients publish and all its servers subscribe to, and a topic of responses
//! for each client, of which each server has a publisher as long as both are there: an answer wakes only who asked. A
//! request carries its client's identifier and number in its header, as any sample does; the response repeats both, as on
//! the ROS 2 wire. Queues keep all: a full one is an error, nothing is lost.
//!
//! Who serves is seen from the request topic's subscriptions, the janitor of whose clients notices processes that died: a
//! request whose servers have all gone ends with [`ServiceError::ServerGone`].

mod client;
mod hot;
mod pending;
mod server;
mod typed;

pub use client::{Availability, RawClient, RawPending, Unsent};
pub use pending::MAX_PENDING_REQUESTS;
pub use server::{RawResponse, RawServer, RequestId, Responders};
pub use typed::{Client, PendingResponse, Request, Response, Server, UnwrittenResponse};

use crate::error::{LoanError, TransportError};
use crate::header::Gid;
use crate::nodes::{NodeHandle, ServiceKind, ServiceRegistration};
use crate::participant::Participant;
use crate::qos::Limits;
use crate::topic_type::TopicType;
use crate::topics::{EndpointInfo, REQUESTS, RESPONSES};
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

impl Limits {
    /// What a service has unless whoever opens it first says otherwise: `publishers` are its clients, `subscribers` its
    /// servers; `message_bytes` holds for requests and responses.
    pub const SERVICE: Limits = Limits {
        publishers: 32,
        subscribers: 4,
        depth: 100,
        held: 4,
        loans: 4,
        message_bytes: 4096,
        may_grow: true,
    };
}

/// The queue of a client's responses: those that it waits for, and as many that it no longer does.
const RESPONSES_DEPTH: usize = 2 * MAX_PENDING_REQUESTS;
/// Responses that a client's user can hold besides those that nobody has looked at yet.
const HELD_RESPONSES: usize = 8;

/// The limits of the topic of one client's responses.
fn response_limits(limits: Limits) -> Limits {
    Limits {
        publishers: limits.subscribers,
        subscribers: 1,
        depth: RESPONSES_DEPTH,
        held: MAX_PENDING_REQUESTS + HELD_RESPONSES,
        ..limits
    }
}

fn request_topic(service: &str) -> String {
    format!("{REQUESTS}{service}")
}

fn response_topic(client: Gid) -> String {
    format!("{RESPONSES}{client:?}")
}

/// A service of a domain.
#[derive(Clone, Debug)]
pub struct ServiceInfo {
    /// The fully qualified name.
    pub name: String,
    /// The service's type: its name and hash as far as whoever made it knew them.
    pub service_type: TopicType,
    /// Who answers.
    pub servers: Vec<EndpointInfo>,
    /// Who asks.
    pub clients: Vec<EndpointInfo>,
}

impl Participant {
    /// Says which node has this end of the service, if this participant is a node's.
    fn register(
        &self,
        kind: ServiceKind,
        service: &str,
        service_type: &ServiceType,
    ) -> Result<Option<ServiceRegistration>, TransportError> {
        let Some(entry) = &self.node else { return Ok(None) };
        let (node, TopicType { name, hash, .. }) =
            (NodeHandle { entry: entry.clone() }, &service_type.request);
        let register = match kind {
            ServiceKind::Server => NodeHandle::register_service,
            ServiceKind::Client => NodeHandle::register_client,
        };
        register(&node, service, name, hash.as_deref()).map(Some)
    }

    /// The services of the domain, sorted by name, with their servers and clients.
    ///
    /// # Real-time
    /// Not for real-time threads: opens each service, with files and allocations.
    ///
    /// # Errors
    /// [`TransportError::Node`] if the list cannot be read.
    pub fn services(&self) -> Result<Vec<ServiceInfo>, TransportError> {
        let requests = self.list_topics(|name| name.starts_with(REQUESTS))?;
        let service = |topic: crate::topics::TopicInfo| ServiceInfo {
            name: topic.name[REQUESTS.len()..].to_owned(),
            service_type: topic.topic_type,
            servers: topic.subscriptions,
            clients: topic.publishers,
        };
        Ok(requests.into_iter().map(service).collect())
    }

    /// The type of a service, as far as whoever made it knew it; `None` if it has neither server nor client.
    ///
    /// # Real-time
    /// Not for real-time threads: opens the service, with files and allocations.
    pub fn service_type(&self, service: &str) -> Option<TopicType> {
        self.topic_type(&request_topic(service))
    }
}

/// Why a request was not answered, or an answer not sent. It names the service.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// Nobody serves it. Nothing was sent.
    #[error("service '{service}' has no server: start one, or wait with `Node::is_available` before asking")]
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
    #[error("service '{service}': the client takes no responses, its queue of {RESPONSES_DEPTH} is full")]
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
    /// The client is there and waits, and its responses cannot be reached: the server's log says why.
    #[error(
        "service '{service}': the client that asked cannot be reached, and waits; is the process at its limit of open files (ulimit -n), or are there more servers than `Limits::subscribers`?"
    )]
    ClientUnreachable {
        /// The service.
        service: Arc<str>,
    },
    /// iceoryx2 could not deliver.
    #[error(
        "service '{service}': the message could not be delivered; is the process at its limit of open files (ulimit -n), or /dev/shm full? then ask again"
    )]
    Incomplete {
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
