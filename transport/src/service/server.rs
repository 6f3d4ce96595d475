// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers of bytes: requests, and a publisher of responses for each client. What is done for each request is in `hot.rs`.

use super::{ServiceType, request_topic, response_limits, response_topic};
use crate::error::{TakeError, TransportError};
use crate::header::{Gid, MessageInfo};
use crate::nodes::{ServiceKind, ServiceRegistration};
use crate::participant::Participant;
use crate::publisher::{RawLoan, RawPublisher};
use crate::qos::{Limits, Qos};
use crate::subscription::{RawSample, RawSubscription};
use crate::topic_type::TopicType;
use std::fmt;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

/// How long the end of a server waits for clients that have not taken their answers, of which they could then not learn.
const FAREWELL: Duration = Duration::from_millis(100);
/// How often it looks.
const FAREWELL_PERIOD: Duration = Duration::from_micros(200);
/// The stack on which a publisher is made: what the main thread of a test has.
const OPENING_STACK_BYTES: usize = 2 << 20;

/// Which request of which client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct RequestId {
    /// The client.
    pub client: Gid,
    /// Counts the client's requests, from 1.
    pub sequence_number: u64,
}

impl RequestId {
    /// The request that this is the information of.
    pub fn of(info: MessageInfo) -> Self {
        RequestId { client: info.publisher_gid, sequence_number: info.sequence_number }
    }
}

/// Takes requests of bytes and answers them. What is above knows the type.
///
/// May be moved to another thread, and is used by one at a time.
pub struct RawServer {
    requests: RawSubscription,
    responders: Responders,
}

/// The clients that have asked, each with the publisher of its responses.
pub struct Responders {
    participant: Participant,
    pub(super) service: Arc<str>,
    response_type: TopicType,
    limits: Limits,
    pub(super) list: Vec<Responder>,
    /// The epoch of the request topic's ports up to which clients that went were forgotten.
    epoch: u32,
    _registration: Option<ServiceRegistration>,
}

pub(super) struct Responder {
    pub(super) client: Gid,
    pub(super) publisher: RawPublisher,
}

/// Memory for a response. Dropping it gives it back unsent.
#[must_use = "nothing is sent before it is sent"]
pub struct RawResponse<'s> {
    pub(super) responders: &'s Responders,
    pub(super) loan: RawLoan<'s>,
    pub(super) id: RequestId,
}

impl Participant {
    /// Creates a server of `service`, a fully qualified name. `depth` is how many requests of one client can wait here.
    ///
    /// # Real-time
    /// Setup only.
    ///
    /// # Errors
    /// [`TransportError`]: another type, a limit.
    pub fn create_raw_server(
        &self,
        service: &str,
        service_type: &ServiceType,
        depth: usize,
        limits: Limits,
    ) -> Result<RawServer, TransportError> {
        let requests = self.create_raw_subscription(
            &request_topic(service),
            &service_type.request,
            Qos::keep_all(depth),
            limits,
        )?;
        let responders = Responders::new(self, service, service_type, limits, &requests)?;
        Ok(RawServer { requests, responders })
    }
}

impl Responders {
    pub(super) fn new(
        participant: &Participant,
        service: &str,
        service_type: &ServiceType,
        limits: Limits,
        requests: &RawSubscription,
    ) -> Result<Self, TransportError> {
        // Those of the service as it is, but this server's own sizes.
        let of_service = requests.limits();
        let (publishers, subscribers) = (of_service.publishers, of_service.subscribers);
        let limits = Limits { publishers, subscribers, ..limits };
        Ok(Responders {
            participant: participant.clone(),
            service: service.into(),
            response_type: service_type.response.clone(),
            limits: response_limits(limits),
            list: Vec::with_capacity(limits.publishers),
            epoch: requests.ports_epoch(),
            _registration: participant.register(ServiceKind::Server, service, service_type)?,
        })
    }

    /// Makes sure that the client of a request that was taken from `requests` can be answered. Only the first time for each
    /// client, and when clients have gone: allocates, opens files, starts a thread that ends at once.
    pub(super) fn admit(&mut self, requests: &RawSubscription, client: Gid) {
        self.forget_gone(requests);
        if !self.list.iter().any(|responder| responder.client == client) {
            self.open(client);
        }
    }

    pub(super) fn forget_gone(&mut self, requests: &RawSubscription) {
        let epoch = requests.ports_epoch();
        if epoch != self.epoch {
            self.epoch = epoch;
            self.list.retain(|responder| responder.publisher.subscription_count() > 0);
        }
    }

    #[cold]
    fn open(&mut self, client: Gid) {
        let topic = response_topic(client);
        let (participant, response_type, limits) = (&self.participant, &self.response_type, self.limits);
        let create = || participant.create_raw_publisher(&topic, response_type, Qos::keep_all(1), limits);
        // iceoryx2 needs more stack for it than callback threads have. The thread has the policy of this one.
        let publisher = std::thread::scope(|scope| {
            let builder =
                std::thread::Builder::new().name("responder".into()).stack_size(OPENING_STACK_BYTES);
            let thread = builder.spawn_scoped(scope, create).map_err(|error| error.to_string())?;
            thread.join().map_err(|_| "it panicked".to_owned())?.map_err(|error| error.to_string())
        });
        match publisher {
            Ok(publisher) => self.list.push(Responder { client, publisher }),
            // Answering it is an error, too.
            Err(error) => tracing::warn!("service '{}': a client cannot be answered: {error}", self.service),
        }
    }

    /// Number of clients that this server has answered or could answer.
    pub fn len(&self) -> usize {
        self.list.len()
    }

    /// Whether nobody has asked yet.
    pub fn is_empty(&self) -> bool {
        self.list.is_empty()
    }
}

impl Drop for Responders {
    /// Waits up to 100 ms for clients that have not taken their answers.
    fn drop(&mut self) {
        let end = Instant::now() + FAREWELL;
        while !self.list.iter().all(|responder| responder.publisher.is_taken()) && Instant::now() < end {
            std::thread::sleep(FAREWELL_PERIOD);
        }
    }
}

impl RawServer {
    /// The service's fully qualified name.
    pub fn service(&self) -> &str {
        &self.responders.service
    }

    /// Those who can be answered.
    pub fn responders(&self) -> &Responders {
        &self.responders
    }

    /// The subscription to the requests.
    pub fn requests(&self) -> &RawSubscription {
        &self.requests
    }

    /// Takes the oldest request, if there is one.
    ///
    /// # Real-time
    /// As [`RawSubscription::try_take_valid`]. The first request of a client allocates and opens files.
    ///
    /// # Errors
    /// [`TakeError`].
    pub fn try_take(&mut self) -> Result<Option<RawSample>, TakeError> {
        self.responders.forget_gone(&self.requests);
        let request = self.requests.try_take_valid()?;
        if let Some(request) = &request {
            self.responders.admit(&self.requests, request.info().publisher_gid);
        }
        Ok(request)
    }

    /// Polls for a request.
    ///
    /// # Real-time
    /// As [`try_take`](Self::try_take).
    pub fn poll_take(&mut self, context: &mut Context<'_>) -> Poll<RawSample> {
        let request = self.requests.poll_take(context);
        self.responders.forget_gone(&self.requests);
        request.map(|request| {
            self.responders.admit(&self.requests, request.info().publisher_gid);
            request
        })
    }
}

impl fmt::Debug for RawServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RawServer")
            .field("service", &self.service())
            .field("clients", &self.responders.len())
            .finish_non_exhaustive()
    }
}

impl fmt::Debug for Responders {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Responders").field("service", &self.service).finish_non_exhaustive()
    }
}

impl fmt::Debug for RawResponse<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RawResponse").field("id", &self.id).finish_non_exhaustive()
    }
}
