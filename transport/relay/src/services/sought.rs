// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of the far side's that clients here ask.

use super::limits;
use super::offered::TURN;
use super::routes::ServerId;
use super::stats::ServiceCounters;
use crate::mirror::TopicKey;
use crate::waker::Flag;
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_transport::{
    Gid, Participant, RawSample, RawServer, RequestId, ServiceError, ServiceType, TransportError,
};

/// Requests of one client here that wait to be passed on.
const DEPTH: usize = 100;

/// Clients of one service that wait to be told that there is no answer.
const MOST_UNTOLD: usize = 1024;

const SERVER_GONE: &str = "its server has gone";

/// What asks on the far side for clients here.
pub trait FarClient: Send {
    /// Whether requests reach a server there.
    fn is_available(&mut self) -> bool;

    /// Whether nothing tells when that changes, so that it has to be looked now and then.
    const IS_LOOKED_AT: bool;

    /// These are the servers there. Returns the requests that nobody can answer any more.
    fn set_servers(&mut self, servers: &BTreeSet<ServerId>) -> Vec<RequestId>;

    /// Whether one more request can be passed on; and one that made way for it. `is_waited_for` says whether a client is still there.
    fn make_room(&mut self, is_waited_for: &dyn Fn(Gid) -> bool) -> (bool, Option<RequestId>);

    /// Passes a request on.
    ///
    /// # Errors
    /// Why that is not possible.
    fn ask(&mut self, id: RequestId, request: &RawSample) -> Result<(), String>;

    /// A response; `None`: there is none.
    fn take(&mut self) -> Option<Response>;

    /// Nobody waits for answers any more. How many did.
    fn forget(&mut self) -> usize;
}

/// What came of a request.
pub enum Response {
    /// Its answer's body.
    Answer(RequestId, Vec<u8>),
    /// There is none, and why.
    None(RequestId, String),
    /// Something is wrong, nobody knows with which; and what.
    Wrong(String),
}

pub(super) struct Sought<C: FarClient> {
    far: C,
    flag: Arc<Flag>,
    /// While requests reach the one there.
    server: Option<RawServer>,
    /// A request that has no place there yet.
    next: Option<RawSample>,
    /// Clients that could not be told yet that there is no answer.
    untold: VecDeque<RequestId>,
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
        let (service, participant) = (key.topic.clone(), participant.clone());
        Sought {
            far,
            server: None,
            next: None,
            untold: VecDeque::new(),
            flag,
            service,
            service_type,
            participant,
            counters,
        }
    }

    pub(super) fn far(&self) -> &C {
        &self.far
    }

    /// Whether the server there is not reached yet.
    pub(super) fn is_seeking(&self) -> bool {
        self.server.is_none()
    }

    /// There are these servers there now. A request that only those got who have gone will not be answered.
    pub(super) fn set_servers(&mut self, servers: &BTreeSet<ServerId>) {
        for id in self.far.set_servers(servers) {
            self.refuse(id, SERVER_GONE);
        }
    }

    /// Who asked gets an error instead of an answer.
    fn refuse(&mut self, id: RequestId, reason: impl ToString) {
        self.counters.failed(reason);
        self.tell(id);
    }

    fn tell(&mut self, id: RequestId) {
        let Some(server) = &self.server else { return };
        match server.refuse(id) {
            Ok(()) | Err(ServiceError::ClientGone { .. }) => {}
            // Its queue is full, or there is no memory: later.
            Err(_) if self.untold.len() < MOST_UNTOLD => self.untold.push_back(id),
            // With its server it ends in any case.
            Err(_) => self.let_go(),
        }
    }

    /// Whether clients wait to be told.
    pub(super) fn is_waiting(&self) -> bool {
        !self.untold.is_empty()
    }

    /// Whoever waits for an answer gets an error: its server here has gone.
    fn let_go(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.far.forget(), SERVER_GONE);
        (self.server, self.next) = (None, None);
        self.untold.clear();
    }

    /// Passes requests of clients here on, at most a turn of them, if something happened or it is time to look. Says whether there may be
    /// more.
    ///
    /// # Errors
    /// The server here cannot be made.
    pub(super) fn poll(&mut self, is_time: bool) -> Result<bool, TransportError> {
        if !self.flag.take() && !is_time {
            return Ok(false);
        }
        let waker = self.flag.waker();
        let context = &mut Context::from_waker(&waker);
        let is_available = self.far.is_available();
        if !is_available {
            self.let_go();
        }
        if is_available && self.server.is_none() {
            let (service, service_type) = (&self.service, &self.service_type);
            self.server = Some(self.participant.create_raw_server(service, service_type, DEPTH, limits())?);
            self.counters.set_active(true);
        }
        for _ in 0..self.untold.len() {
            let id = self.untold.pop_front();
            id.into_iter().for_each(|id| self.tell(id));
        }
        for _ in 0..TURN {
            let Some(request) = self.next.take().or_else(|| self.take(context)) else { return Ok(false) };
            if !self.make_room() {
                self.next = Some(request);
                return Ok(false);
            }
            let id = RequestId::of(request.info());
            if let Err(reason) = self.far.ask(id, &request) {
                self.refuse(id, reason);
            }
        }
        self.flag.set();
        Ok(true)
    }

    fn take(&mut self, context: &mut Context<'_>) -> Option<RawSample> {
        match self.server.as_ref()?.poll_take(context) {
            Poll::Ready(request) => Some(request),
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

    /// The far side has responses: passes them on, at most a turn of them. What is left ends the next wait.
    pub(super) fn serve(&mut self) {
        // There may be room for requests.
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
        self.let_go();
    }
}
