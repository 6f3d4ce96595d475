// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of the domain, offered on the far side.

use super::limits::{TURN, limits};
use super::routes::OfferedService;
use super::stats::ServiceCounters;
use crate::mirror::TopicKey;
use crate::waker::Flag;
use futures::future::{AbortHandle, Aborted, BoxFuture, abortable};
use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use std::collections::VecDeque;
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tautline_transport::{
    Availability, MAX_PENDING_REQUESTS, Participant, RawClient, RawPending, RawSample, ServiceError,
    ServiceType,
};

/// Maximum of requests that wait for the server or for room in its queue; further requests are refused and counted.
const MOST_WAITING: usize = 1024;
/// The same for their bytes; a single request may be longer.
const MOST_WAITING_BYTES: usize = 16 << 20;
const SERVER_TIME: Duration = Duration::from_secs(10);
/// Maximum of clients per service; a further client is created when all have their maximum of pending requests.
const MOST_CLIENTS: usize = 16;

/// A request's handle for its response, and its body; or why it cannot be forwarded.
pub type TakenRequest<R> = Result<(R, Vec<u8>), String>;

/// The far side's server for a service of the domain. Dropped when that service ends.
pub trait FarServer: Send {
    /// Identifies a request for its response.
    type Request: Send + 'static;

    /// Takes a request with its body; `None` if there is none.
    ///
    /// # Errors
    /// Why a received request cannot be forwarded.
    fn take(&mut self) -> Option<TakenRequest<Self::Request>>;

    /// Sends the response, or the reason why there is none.
    ///
    /// # Errors
    /// Why the response is not sent.
    fn answer(&mut self, request: Self::Request, answer: Result<&[u8], &str>) -> Result<(), String>;
}

pub(super) struct Offered<S: FarServer> {
    /// One client, and more while many requests are pending.
    clients: Vec<RawClient>,
    pub(super) far: S,
    flag: Arc<Flag>,
    key: TopicKey,
    /// The service, as it was when this was opened.
    pub(super) service: OfferedService,
    service_type: ServiceType,
    participant: Participant,
    /// Requests that are not sent yet, for lack of a server or of room in its queue.
    waiting: VecDeque<(S::Request, Vec<u8>, Instant)>,
    waiting_bytes: usize,
    /// Resolves when there is a server in the domain: another mirror that announces the service creates its server for this client.
    availability: Option<Availability>,
    pending: FuturesUnordered<BoxFuture<'static, Answer<S::Request>>>,
    /// Handles to abort pending requests, the oldest first, each with a token that lives until the response.
    asked: VecDeque<(AbortHandle, Weak<()>)>,
    counters: Arc<ServiceCounters>,
}

type Answer<R> = (R, Result<Result<RawSample, ServiceError>, Aborted>);

impl<S: FarServer> Offered<S> {
    /// Creates a client here, and then the far server with `open`: last, because requests arrive from then on.
    pub(super) fn open(
        (key, service): (&TopicKey, &OfferedService),
        service_type: ServiceType,
        participant: &Participant,
        counters: Arc<ServiceCounters>,
        flag: Arc<Flag>,
        open: impl FnOnce() -> Result<S, String>,
    ) -> Result<Self, String> {
        let client = participant.create_raw_client(&key.topic, &service_type, limits());
        let clients = vec![client.map_err(|error| error.to_string())?];
        let far = open()?;
        counters.set_active(true);
        let (waiting, waiting_bytes, availability, pending, asked) = Default::default();
        Ok(Offered {
            clients,
            far,
            flag,
            key: key.clone(),
            service: service.clone(),
            service_type,
            participant: participant.clone(),
            waiting,
            waiting_bytes,
            availability,
            pending,
            asked,
            counters,
        })
    }

    /// Whether requests wait for a server in the domain or for room in its queue.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes at most one turn of requests from the far side. Further requests end the next wait.
    pub(super) fn serve(&mut self) {
        self.flag.set();
        for _ in 0..TURN {
            match self.far.take() {
                Some(Ok((request, body))) => self.receive(request, body),
                Some(Err(reason)) => self.counters.failed(reason),
                None => return,
            }
        }
    }

    fn receive(&mut self, request: S::Request, body: Vec<u8>) {
        let is_full = self.waiting.len() >= MOST_WAITING
            || (!self.waiting.is_empty() && self.waiting_bytes + body.len() > MOST_WAITING_BYTES);
        if is_full {
            return self.refuse(request, "too many requests wait for the server here");
        }
        self.waiting_bytes += body.len();
        self.waiting.push_back((request, body, Instant::now()));
    }

    fn refuse(&mut self, request: S::Request, reason: &str) {
        self.counters.failed(reason);
        // Ignored: the client has ended.
        let _ = self.far.answer(request, Err(reason));
    }

    /// Sends the waiting requests to the server in the domain, in order, while there is room.
    fn pass_on(&mut self) {
        while let Some((_, body, since)) = self.waiting.front() {
            let refused = match send(&self.clients, body) {
                Ok(response) => {
                    let (request, ..) = self.next();
                    self.pend(request, response);
                    continue;
                }
                Err(error) => error,
            };
            match &refused {
                ServiceError::TooManyPending { .. } => {
                    let make =
                        || self.participant.create_raw_client(&self.key.topic, &self.service_type, limits());
                    if self.clients.len() < MOST_CLIENTS {
                        match make() {
                            Ok(client) => self.clients.push(client),
                            // Retried when a response arrives.
                            Err(_) => return,
                        }
                        continue;
                    }
                    // Aborts the oldest request, whose client may have ended long ago; its place is free once the request is dropped.
                    self.asked.retain(|(_, life)| life.strong_count() != 0);
                    if let Some((oldest, _)) = self.asked.pop_front() {
                        oldest.abort();
                    }
                    return;
                }
                // Retried when a response arrives.
                ServiceError::RequestsFull { .. } if !self.pending.is_empty() => return,
                ServiceError::NoServer { .. } if since.elapsed() < SERVER_TIME => {
                    if self.availability.is_none() {
                        self.availability =
                            self.clients.first().and_then(|client| client.availability().ok());
                    }
                    return;
                }
                error => {
                    let reason = error.to_string();
                    let (request, ..) = self.next();
                    self.refuse(request, &reason);
                }
            }
        }
        self.availability = None;
    }

    /// Removes the oldest waiting request, which must exist.
    fn next(&mut self) -> (S::Request, Vec<u8>, Instant) {
        let next = self.waiting.pop_front().unwrap_or_else(|| unreachable!("the caller has checked it"));
        self.waiting_bytes -= next.1.len();
        next
    }

    fn pend(&mut self, request: S::Request, response: RawPending) {
        let (response, handle) = abortable(response);
        let life = Arc::new(());
        if self.asked.len() >= 2 * MAX_PENDING_REQUESTS * self.clients.len() {
            self.asked.retain(|(_, life)| life.strong_count() != 0);
        }
        self.asked.push_back((handle, Arc::downgrade(&life)));
        let answer = response.map(move |response| {
            drop(life);
            (request, response)
        });
        self.pending.push(answer.boxed());
    }

    /// If the flag is set or `is_time`, sends waiting requests here, and responses to their clients on the far side.
    pub(super) fn poll(&mut self, is_time: bool) {
        if !self.flag.take() && !is_time {
            return;
        }
        let waker = self.flag.waker();
        let context = &mut Context::from_waker(&waker);
        loop {
            self.pass_on();
            if self.availability.as_mut().is_some_and(|wait| wait.poll_unpin(context).is_ready()) {
                self.availability = None;
                continue;
            }
            let Poll::Ready(Some((request, response))) = self.pending.poll_next_unpin(context) else {
                return;
            };
            match response {
                Ok(Ok(response)) => match self.far.answer(request, Ok(response.body())) {
                    Ok(()) => self.counters.answered(),
                    Err(reason) => self.counters.failed(reason),
                },
                Ok(Err(error)) => self.refuse(request, &error.to_string()),
                Err(Aborted) => self.refuse(request, "given up: too many later requests wait for answers"),
            }
        }
    }
}

/// Sends a request through the first client with room for it.
fn send(clients: &[RawClient], body: &[u8]) -> Result<RawPending, ServiceError> {
    let mut refused = None;
    for client in clients {
        let mut loan = client.loan(body.len())?;
        loan.copy_from_slice(body);
        match client.send(loan) {
            Ok(pending) => return Ok(pending),
            Err(unsent) if matches!(unsent.error, ServiceError::TooManyPending { .. }) => {
                refused = Some(unsent.error);
            }
            Err(unsent) => return Err(unsent.error),
        }
    }
    // `refused` is set: there is at least one client.
    Err(refused.unwrap_or(ServiceError::NoServer { service: "".into() }))
}

impl<S: FarServer> Drop for Offered<S> {
    fn drop(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.pending.len() + self.waiting.len(), "its server here has gone");
    }
}
