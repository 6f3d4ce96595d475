// SPDX-License-Identifier: MIT OR Apache-2.0
//! Servers of bytes: requests, and a publisher of responses for each client. What is done for each request is in `hot.rs`.

use super::hot::no_answer;
use super::{ServiceType, request_topic, response_limits, response_topic};
use crate::doorbell::Slot;
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
use std::sync::mpsc::{Receiver, Sender, channel};
use std::task::{Context, Poll};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long the end of a server waits for clients that have not taken their answers. They lose them only if they have taken
/// nothing of this server before, not even the greeting, or if an answer was longer than all before.
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

/// The service's clients, each with the publisher of its responses.
pub struct Responders {
    participant: Participant,
    pub(super) service: Arc<str>,
    response_type: TopicType,
    limits: Limits,
    pub(super) list: Vec<Responder>,
    /// Clients that are there, and whose publisher could not be made when that was last tried.
    pub(super) unreachable: Vec<Gid>,
    /// Publishers that are being made, and where they come from.
    opening: Vec<Opening>,
    made: (Sender<Made>, Receiver<Made>),
    /// Rung when one of them is there.
    slot: Arc<Slot>,
    /// The epoch of the request topic's ports whose clients `list` and `opening` show.
    epoch: u32,
    _registration: Option<ServiceRegistration>,
}

pub(super) struct Responder {
    pub(super) client: Gid,
    pub(super) publisher: RawPublisher,
    /// Whether the client was sent something to take, so that it maps this publisher's memory before there is an answer.
    is_greeted: bool,
}

struct Opening {
    client: Gid,
    /// False if the client has gone meanwhile.
    is_wanted: bool,
    thread: Option<JoinHandle<()>>,
}

type Made = (Gid, Result<RawPublisher, TransportError>);

impl Responder {
    fn greet(&mut self) {
        if !self.is_greeted
            && self.publisher.subscription_count() > 0
            && let Ok(loan) = self.publisher.loan(0)
        {
            self.is_greeted = loan.publish_as(no_answer(0, self.client)).is_ok();
        }
    }

    /// Whether the client has taken its answers.
    fn is_done(&self) -> bool {
        self.publisher.sent() <= u64::from(self.is_greeted) || self.publisher.is_taken()
    }
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
            unreachable: Vec::new(),
            opening: Vec::new(),
            made: channel(),
            slot: requests.place().1.clone(),
            // Not the present one: there may be clients already.
            epoch: requests.ports_epoch().wrapping_sub(1),
            _registration: participant.register(ServiceKind::Server, service, service_type)?,
        })
    }

    /// Meets clients that have appeared, so that they can be answered when they ask, and forgets those that have gone. Only
    /// then: allocates, starts threads that end soon.
    ///
    /// # Real-time
    /// Wait-free otherwise; no syscall.
    pub(super) fn attend(&mut self, requests: &RawSubscription) {
        let epoch = requests.ports_epoch();
        if epoch != self.epoch {
            self.epoch = epoch;
            self.meet(&requests.publisher_gids());
        }
        if !self.opening.is_empty() {
            self.welcome(None);
        }
    }

    /// Makes sure that the client of a request that was taken from `requests` can be answered, unless it has gone. Waits only for
    /// one that has appeared just before it asked.
    pub(super) fn admit(&mut self, requests: &RawSubscription, client: Gid) {
        self.attend(requests);
        if !self.list.iter().any(|responder| responder.client == client)
            && requests.publisher_gids().contains(&client)
        {
            self.open(client);
            self.welcome(Some(client));
        }
    }

    #[cold]
    fn meet(&mut self, clients: &[Gid]) {
        self.list.retain(|responder| clients.contains(&responder.client));
        self.unreachable.retain(|client| clients.contains(client));
        self.list.iter_mut().for_each(Responder::greet);
        for opening in &mut self.opening {
            opening.is_wanted = clients.contains(&opening.client);
        }
        for &client in clients {
            if !self.list.iter().any(|responder| responder.client == client) {
                self.open(client);
            }
        }
    }

    /// Begins to make the publisher of responses to `client`, unless that was begun.
    #[cold]
    fn open(&mut self, client: Gid) {
        if self.opening.iter().any(|opening| opening.client == client) {
            return;
        }
        let (participant, response_type, limits) =
            (self.participant.clone(), self.response_type.clone(), self.limits);
        let (made, slot) = (self.made.0.clone(), self.slot.clone());
        let create = move || {
            let (topic, qos) = (response_topic(client), Qos::keep_all(1));
            let publisher = participant.create_raw_publisher(&topic, &response_type, qos, limits);
            // Ignored: the server has ended.
            let _ = made.send((client, publisher));
            slot.ring();
        };
        // iceoryx2 needs more stack for it than callback threads have. The thread has the policy of this one.
        let builder = std::thread::Builder::new().name("responder".into()).stack_size(OPENING_STACK_BYTES);
        match builder.spawn(create) {
            Ok(thread) => self.opening.push(Opening { client, is_wanted: true, thread: Some(thread) }),
            Err(error) => self.miss(client, &error),
        }
    }

    /// Takes the publishers that were made meanwhile, and waits for that of `client`.
    #[cold]
    fn welcome(&mut self, client: Option<Gid>) {
        let awaited = self.opening.iter_mut().find(|opening| Some(opening.client) == client);
        if let Some(Err(_)) = awaited.and_then(|opening| opening.thread.take()).map(JoinHandle::join) {
            self.opening.retain(|opening| Some(opening.client) != client);
            if let Some(client) = client {
                self.miss(client, &"making its publisher panicked");
            }
        }
        while let Ok((client, publisher)) = self.made.1.try_recv() {
            let opening = self.opening.iter().position(|opening| opening.client == client);
            let opening = opening.map(|index| self.opening.swap_remove(index));
            match publisher {
                Ok(publisher) if opening.is_some_and(|opening| opening.is_wanted) => {
                    let mut responder = Responder { client, publisher, is_greeted: false };
                    responder.greet();
                    self.unreachable.retain(|missed| *missed != client);
                    self.list.push(responder);
                }
                Ok(_) => {}
                Err(error) => self.miss(client, &error),
            }
        }
    }

    /// Answering it is an error, too, unless it can be reached by then: its next request tries again.
    fn miss(&mut self, client: Gid, error: &dyn fmt::Display) {
        if !self.unreachable.contains(&client) {
            self.unreachable.push(client);
        }
        tracing::warn!("service '{}': a client cannot be answered: {error}", self.service);
    }

    /// Whether `client` was there when clients last appeared or went, and can be answered.
    pub fn contains(&self, client: Gid) -> bool {
        self.list.iter().any(|responder| responder.client == client)
    }

    /// Number of clients that this server could answer.
    pub fn len(&self) -> usize {
        self.list.len()
    }

    /// Whether there is no client.
    pub fn is_empty(&self) -> bool {
        self.list.is_empty()
    }
}

impl Drop for Responders {
    /// Waits up to 100 ms for clients that have not taken their answers.
    fn drop(&mut self) {
        for Opening { thread, .. } in self.opening.drain(..) {
            // Ignored: what it made goes with the channel.
            let _ = thread.map(JoinHandle::join);
        }
        let end = Instant::now() + FAREWELL;
        while !self.list.iter().all(Responder::is_done) && Instant::now() < end {
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
    /// As [`RawSubscription::try_take_valid`]. When clients have appeared or gone: allocates, starts a thread for each that makes a
    /// publisher, and waits for that if the request is of a client that has only just appeared.
    ///
    /// # Errors
    /// [`TakeError`].
    pub fn try_take(&mut self) -> Result<Option<RawSample>, TakeError> {
        self.responders.attend(&self.requests);
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
        self.responders.attend(&self.requests);
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
