// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of the far side, with clients in the domain.

use super::limits::{TURN, limits};
use super::routes::ServerId;
use super::stats::ServiceCounters;
use crate::mirror::TopicKey;
use crate::waker::Flag;
use std::collections::{BTreeSet, VecDeque};
use std::iter::from_fn;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_transport::{
    Gid, Participant, RawSample, RawServer, RequestId, ServiceError, ServiceType, TransportError,
};

/// Queue depth of requests, per client in the domain.
const DEPTH: usize = 100;

/// Maximum of pending error responses per service.
const MOST_UNSENT_ERRORS: usize = 1024;

/// Maximum of queued requests that are counted when the server ends, because clients may go on asking.
const MOST_COUNTED: usize = 1024;

const SERVER_GONE: &str = "its server has gone";

/// The client on the far side, for clients in the domain.
pub trait FarClient: Send {
    /// Whether a server on the far side is available.
    fn is_available(&mut self) -> bool;

    /// Whether changes of [`is_available`](Self::is_available) are not signalled, and must be polled.
    const IS_POLLED: bool;

    /// Sets the present servers. Returns the requests that no server can answer any more.
    fn set_servers(&mut self, servers: &BTreeSet<ServerId>) -> Vec<RequestId>;

    /// Whether one more request can be sent, and a request that was dropped for it. `is_waited_for` tells whether a client still exists.
    fn make_room(&mut self, is_waited_for: &dyn Fn(Gid) -> bool) -> (bool, Option<RequestId>);

    /// Sends a request.
    ///
    /// # Errors
    /// Why that failed.
    fn send(&mut self, id: RequestId, request: &RawSample) -> Result<(), String>;

    /// Takes a response; `None` if there is none.
    fn take(&mut self) -> Option<Response>;

    /// Drops all pending requests. Returns their number.
    fn forget(&mut self) -> usize;
}

/// The outcome of a request.
pub enum Response {
    /// The response's body.
    Answer(RequestId, Vec<u8>),
    /// No response, and why.
    None(RequestId, String),
    /// An error of an unknown request.
    Wrong(String),
}

pub(super) struct Sought<C: FarClient> {
    pub(super) far: C,
    flag: Arc<Flag>,
    /// Exists while the far server is available.
    server: Option<RawServer>,
    /// A request that waits for room on the far side.
    next: Option<RawSample>,
    /// Requests whose error response could not be sent yet.
    unsent_errors: VecDeque<RequestId>,
    service: String,
    service_type: ServiceType,
    participant: Participant,
    counters: Arc<ServiceCounters>,
}

impl<C: FarClient> Sought<C> {
    pub(super) fn new(
        key: &TopicKey,
        service_type: ServiceType,
        far: C,
        participant: &Participant,
        counters: Arc<ServiceCounters>,
        flag: Arc<Flag>,
    ) -> Self {
        Sought {
            far,
            server: None,
            next: None,
            unsent_errors: VecDeque::new(),
            flag,
            service: key.topic.clone(),
            service_type,
            participant: participant.clone(),
            counters,
        }
    }

    /// Whether the far server is not available yet.
    pub(super) fn is_seeking(&self) -> bool {
        self.server.is_none()
    }

    /// Sets the present servers of the far side. Requests that only ended servers received get an error.
    pub(super) fn set_servers(&mut self, servers: &BTreeSet<ServerId>) {
        for id in self.far.set_servers(servers) {
            self.refuse(id, SERVER_GONE);
        }
    }

    /// Answers the client with an error.
    fn refuse(&mut self, id: RequestId, reason: impl ToString) {
        self.counters.failed(reason);
        self.send_error(id);
    }

    fn send_error(&mut self, id: RequestId) {
        let Some(server) = &self.server else { return };
        match server.refuse(id) {
            Ok(()) | Err(ServiceError::ClientGone { .. }) => {}
            // The client's queue is full, or memory is exhausted: retried later.
            Err(_) if self.unsent_errors.len() < MOST_UNSENT_ERRORS => self.unsent_errors.push_back(id),
            // Ending the server ends its requests.
            Err(_) => self.close_server(),
        }
    }

    /// Whether a request waits for room, or error responses wait to be sent.
    pub(super) fn is_waiting(&self) -> bool {
        self.next.is_some() || !self.unsent_errors.is_empty()
    }

    /// Ends the server in the domain, so that all pending requests get an error.
    fn close_server(&mut self) {
        self.counters.set_active(false);
        // Those that were not sent yet end with the others.
        let queued = self.server.iter().flat_map(|server| from_fn(move || server.try_take().ok().flatten()));
        let unsent = usize::from(self.next.is_some()) + queued.take(MOST_COUNTED).count();
        self.counters.failed_times(self.far.forget() + unsent, SERVER_GONE);
        (self.server, self.next) = (None, None);
        self.unsent_errors.clear();
    }

    /// If the flag is set or `is_time`, forwards at most one turn of requests. Returns whether there may be more.
    ///
    /// # Errors
    /// The server in the domain cannot be created.
    pub(super) fn poll(&mut self, is_time: bool) -> Result<bool, TransportError> {
        if !self.flag.take() && !is_time {
            return Ok(false);
        }
        let waker = self.flag.waker();
        let context = &mut Context::from_waker(&waker);
        let is_available = self.far.is_available();
        if !is_available {
            self.close_server();
        }
        if is_available && self.server.is_none() {
            let (service, service_type) = (&self.service, &self.service_type);
            self.server = Some(self.participant.create_raw_server(service, service_type, DEPTH, limits())?);
            self.counters.set_active(true);
        }
        for _ in 0..self.unsent_errors.len() {
            let id = self.unsent_errors.pop_front();
            id.into_iter().for_each(|id| self.send_error(id));
        }
        for _ in 0..TURN {
            let Some(request) = self.next.take().or_else(|| self.take(context)) else { return Ok(false) };
            if !self.make_room() {
                self.next = Some(request);
                return Ok(false);
            }
            let id = RequestId::of(request.info());
            if let Err(reason) = self.far.send(id, &request) {
                self.refuse(id, reason);
            }
        }
        self.flag.set();
        Ok(true)
    }

    fn take(&mut self, context: &mut Context<'_>) -> Option<RawSample> {
        match self.server.as_ref()?.poll_take(context) {
            Poll::Ready(request) => request,
            Poll::Pending => None,
        }
    }

    fn make_room(&mut self) -> bool {
        let server = &self.server;
        let is_waited_for = |client| server.as_ref().is_some_and(|server| server.can_answer(client));
        let (has_room, silent) = self.far.make_room(&is_waited_for);
        if let Some(id) = silent {
            self.refuse(id, "its server is silent");
        }
        has_room
    }

    /// Takes at most one turn of responses from the far side. Further responses end the next wait.
    pub(super) fn serve(&mut self) {
        // There may be room for requests now.
        self.flag.set();
        for _ in 0..TURN {
            match self.far.take() {
                Some(Response::Answer(id, body)) => match self.answer(id, &body) {
                    Ok(()) => self.counters.answered(),
                    Err(reason) => self.refuse(id, reason),
                },
                Some(Response::None(id, reason)) => self.refuse(id, reason),
                Some(Response::Wrong(reason)) => self.counters.failed(reason),
                None => return,
            }
        }
    }

    fn answer(&mut self, id: RequestId, body: &[u8]) -> Result<(), String> {
        let Some(server) = &self.server else { return Err(SERVER_GONE.to_owned()) };
        let mut loan = server.loan(id, body.len()).map_err(|error| error.to_string())?;
        loan.copy_from_slice(body);
        loan.send().map_err(|unsent| unsent.to_string())
    }
}

impl<C: FarClient> Drop for Sought<C> {
    fn drop(&mut self) {
        self.close_server();
    }
}
