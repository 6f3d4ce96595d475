// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services of types that the program was not built with: requests and responses as JSON.

use super::client::{IsAvailablePollable, Limit};
use crate::error::{Error, Result};
use crate::node::Node;
use crate::subscription::{Samples, Source};
use crate::untyped::{find_schema, type_of};
use futures::Stream;
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_sampler::Events;
use tautline_schema::{DynamicMessage, Endian, Schema, TypeName};
use tautline_transport::Qos;
use tautline_transport::{
    Availability, RawClient, RawPending, RawSample, RawServer, RawSubscription, RequestId, ServiceError,
    ServiceType, TakeError, TopicType,
};

/// The definitions of a service.
#[derive(Clone)]
struct Definitions {
    service: Arc<Schema>,
    request: Arc<Schema>,
    response: Arc<Schema>,
}

impl Definitions {
    fn service_type(&self) -> ServiceType {
        // Found by the service's hash, which covers both.
        let TopicType { body_bytes, .. } = type_of(&self.request);
        ServiceType {
            request: TopicType { body_bytes, ..type_of(&self.service) },
            response: type_of(&self.response),
        }
    }
}

impl Node {
    /// Creates a client of a service of a type that is known by name, `std_srvs/srv/SetBool`: requests and responses are
    /// JSON.
    ///
    /// # Errors
    /// [`Error::UnknownType`], [`Error::Schema`] and [`Error::StoredDefinition`] for the type's definition; as
    /// [`create_client`](Self::create_client).
    pub fn create_client_untyped(
        &mut self,
        service_name: &str,
        service_type: &str,
        qos: Qos,
    ) -> Result<ClientUntyped> {
        let _ = qos;
        let (name, limits) = self.resolve_service(service_name)?;
        let definitions = self.service_definitions(&name, service_type)?;
        let _node = tautline_trace::in_node(self.trace.id());
        let participant = &self.participant;
        let client = participant.create_raw_client(&name, &definitions.service_type(), limits)?;
        Ok(ClientUntyped { client: Mutex::new(client), definitions, events: self.context.events().clone() })
    }

    /// Creates a service of a type that is known by name: a stream of requests as JSON, to be answered with JSON.
    ///
    /// # Errors
    /// As [`create_client_untyped`](Self::create_client_untyped).
    pub fn create_service_untyped(
        &mut self,
        service_name: &str,
        service_type: &str,
        qos: Qos,
    ) -> Result<impl Stream<Item = ServiceRequestUntyped> + Unpin + Send + use<>> {
        let (name, limits) = self.resolve_service(service_name)?;
        let definitions = self.service_definitions(&name, service_type)?;
        let depth = qos.depth;
        let _node = tautline_trace::in_node(self.trace.id());
        let participant = &self.participant;
        let server = participant.create_raw_server(&name, &definitions.service_type(), depth, limits)?;
        let server = Arc::new(Mutex::new(Samples::new(server)));
        Ok(RequestsUntyped { server, definitions })
    }

    fn service_definitions(&self, service: &str, type_name: &str) -> Result<Definitions> {
        let name: TypeName = type_name.parse()?;
        let existing = self.participant.service_type(service)?;
        let schema = find_schema(service, &name, existing.as_ref())?;
        let part = |suffix: &str| -> Result<Arc<Schema>> {
            Ok(schema.of_part(&format!("{type_name}_{suffix}").parse()?)?.into())
        };
        let (request, response) = (part("Request")?, part("Response")?);
        Ok(Definitions { service: schema, request, response })
    }
}

/// Asks a service of a type that is known by its definition, with JSON. May be used in several threads.
pub struct ClientUntyped {
    client: Mutex<RawClient>,
    definitions: Definitions,
    events: Events,
}

impl ClientUntyped {
    fn client(&self) -> MutexGuard<'_, RawClient> {
        self.client.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sends a request: an object of its fields, those left out having their defaults. The inner result of the future, which
    /// is r2r's, is an error if the response is not of the type.
    ///
    /// # Errors
    /// [`Error::Message`] if it is not a request of the type; as [`Client::request`](crate::Client::request).
    pub fn request(
        &self,
        msg: serde_json::Value,
    ) -> Result<impl Future<Output = Result<Result<serde_json::Value>>> + Unpin + Send + use<>> {
        Ok(ResponseUntyped {
            response: self.send(msg)?,
            schema: self.definitions.response.clone(),
            limit: None,
        })
    }

    /// [`request`](Self::request), whose future ends with an error if the response does not come in time.
    ///
    /// # Errors
    /// As [`Client::request_timeout`](crate::Client::request_timeout).
    pub fn request_timeout(
        &self,
        msg: serde_json::Value,
        timeout: Duration,
    ) -> Result<impl Future<Output = Result<Result<serde_json::Value>>> + Unpin + Send + use<>> {
        let limit = Limit::new(&self.events, timeout, &self.service_name())?;
        let schema = self.definitions.response.clone();
        Ok(ResponseUntyped { response: self.send(msg)?, schema, limit: Some(limit) })
    }

    fn send(&self, msg: serde_json::Value) -> Result<RawPending> {
        let body = DynamicMessage::from_json_value(&self.definitions.request, msg)?.to_body();
        let client = self.client();
        let mut loan = client.loan(body.len())?;
        loan.copy_from_slice(&body);
        Ok(client.send(loan)?)
    }

    /// The service's definition.
    pub fn schema(&self) -> &Arc<Schema> {
        &self.definitions.service
    }

    /// The service's fully qualified name.
    pub fn service_name(&self) -> String {
        self.client().service().to_owned()
    }
}

impl IsAvailablePollable for ClientUntyped {
    fn availability(&self) -> Result<Vec<Availability>> {
        IsAvailablePollable::availability(&*self.client())
    }
}

struct ResponseUntyped {
    response: RawPending,
    schema: Arc<Schema>,
    limit: Option<Limit>,
}

impl Future for ResponseUntyped {
    type Output = Result<Result<serde_json::Value>>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        if let Poll::Ready(response) = Pin::new(&mut self.response).poll(context) {
            let json = response.map(|response| to_json(&self.schema, &response));
            return Poll::Ready(json.map_err(Error::from));
        }
        match &mut self.limit {
            Some(limit) => limit.poll(context).map(Err),
            None => Poll::Pending,
        }
    }
}

fn to_json(schema: &Arc<Schema>, sample: &RawSample) -> Result<serde_json::Value> {
    Ok(DynamicMessage::from_body(schema, sample.body(), Endian::Little)?.to_json_value())
}

impl Source for RawServer {
    type Sample = RawSample;

    fn raw(&self) -> &RawSubscription {
        self.requests()
    }

    fn try_take_valid(&mut self) -> std::result::Result<Option<RawSample>, TakeError> {
        self.try_take()
    }

    fn poll_take(&mut self, context: &mut Context<'_>) -> Poll<RawSample> {
        RawServer::poll_take(self, context)
    }

    fn released_ns(request: &RawSample) -> u64 {
        request.info().released_ns
    }
}

struct RequestsUntyped {
    server: Arc<Mutex<Samples<RawServer>>>,
    definitions: Definitions,
}

impl Stream for RequestsUntyped {
    type Item = ServiceRequestUntyped;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<ServiceRequestUntyped>> {
        let mut server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        server.poll_next(context).map(|request| {
            let request = request?;
            Some(ServiceRequestUntyped {
                message: to_json(&self.definitions.request, &request),
                id: RequestId::of(request.info()),
                response: self.definitions.response.clone(),
                server: self.server.clone(),
            })
        })
    }
}

/// A request as JSON, to be answered with [`respond`](Self::respond).
pub struct ServiceRequestUntyped {
    /// What is asked; an error if it is not a request of the type.
    pub message: Result<serde_json::Value>,
    id: RequestId,
    response: Arc<Schema>,
    server: Arc<Mutex<Samples<RawServer>>>,
}

impl ServiceRequestUntyped {
    /// Answers the request: an object of the response's fields, those left out having their defaults. If its client has gone
    /// meanwhile, nothing happens.
    ///
    /// # Errors
    /// [`Error::Message`] if it is not a response of the type; as [`ServiceRequest::respond`](crate::ServiceRequest::respond).
    pub fn respond(self, msg: serde_json::Value) -> Result<()> {
        let body = DynamicMessage::from_json_value(&self.response, msg)?.to_body();
        let server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        let mut loan = match server.source().loan(self.id, body.len()) {
            Err(ServiceError::ClientGone { .. }) => return Ok(()),
            loan => loan?,
        };
        loan.copy_from_slice(&body);
        Ok(loan.send()?)
    }

    /// Which request of which client this is.
    pub fn id(&self) -> RequestId {
        self.id
    }
}

impl std::fmt::Debug for ClientUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClientUntyped").field("service", &self.service_name()).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for ServiceRequestUntyped {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ServiceRequestUntyped").field("message", &self.message).finish_non_exhaustive()
    }
}
