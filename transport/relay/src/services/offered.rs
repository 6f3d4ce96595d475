// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of the domain's that the far side may ask.

use super::limits;
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

/// Requests taken of one service before the next one has its turn.
pub(super) const TURN: usize = 16;
/// Requests of a service that wait for room at its server, or for the server; more are refused and counted.
const MOST_WAITING: usize = 1024;
const MOST_WAITING_BYTES: usize = 16 << 20;
/// How long requests wait for a server.
const SERVER_TIME: Duration = Duration::from_secs(10);
/// Clients here of one service on behalf of the far side, when each has as many requests pending as it can.
const MOST_CLIENTS: usize = 16;

/// By which an answer finds who asked, and the body; or why it cannot be passed on.
pub type TakenRequest<R> = Result<(R, Vec<u8>), String>;

/// What takes requests on the far side for a service of the domain. Dropped when there is no such service any more.
pub trait FarServer: Send {
    /// By which an answer finds who asked.
    type Request: Send + 'static;

    /// A request, with its body; `None`: there is none.
    ///
    /// # Errors
    /// One came that cannot be passed on, and why.
    fn take(&mut self) -> Option<TakenRequest<Self::Request>>;

    /// The answer to a request, or why there is none.
    ///
    /// # Errors
    /// Why it is not sent.
    fn answer(&mut self, request: Self::Request, answer: Result<&[u8], &str>) -> Result<(), String>;
}

pub(super) struct Offered<S: FarServer> {
    /// One, and more while many requests wait for answers.
    clients: Vec<RawClient>,
    far: S,
    flag: Arc<Flag>,
    key: TopicKey,
    service_type: ServiceType,
    participant: Participant,
    /// Bodies that are not passed on yet, for want of a server or of room at it.
    waiting: VecDeque<(S::Request, Vec<u8>, Instant)>,
    waiting_bytes: usize,
    /// For a server here: who tells of one, another mirror, makes it when somebody asks.
    availability: Option<Availability>,
    pending: FuturesUnordered<BoxFuture<'static, Answer<S::Request>>>,
    /// Requests, the oldest first, with what lives as long as they are pending.
    asked: VecDeque<(AbortHandle, Weak<()>)>,
    counters: Arc<ServiceCounters>,
}

type Answer<R> = (R, Result<Result<RawSample, ServiceError>, Aborted>);

impl<S: FarServer> Offered<S> {
    /// `open` makes the far end: last, for it is asked from then on.
    pub(super) fn open(
        key: &TopicKey,
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
        let (key, participant) = (key.clone(), participant.clone());
        Ok(Offered {
            clients,
            far,
            flag,
            key,
            service_type,
            participant,
            waiting,
            waiting_bytes,
            availability,
            pending,
            asked,
            counters,
        })
    }

    /// Whether requests wait for a server here, or for room at it.
    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    pub(super) fn far(&self) -> &S {
        &self.far
    }

    /// The far side has requests: takes them, at most a turn of them. What is left ends the next wait.
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
        if self.waiting.len() >= MOST_WAITING || self.waiting_bytes + body.len() > MOST_WAITING_BYTES {
            return self.refuse(request, "too many requests wait for the server here");
        }
        self.waiting_bytes += body.len();
        self.waiting.push_back((request, body, Instant::now()));
    }

    fn refuse(&mut self, request: S::Request, reason: &str) {
        self.counters.failed(reason);
        // Ignored: whoever asked has gone.
        let _ = self.far.answer(request, Err(reason));
    }

    /// Asks here what was asked there, in order, as long as there is room for it.
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
                            // Until something is answered.
                            Err(_) => return,
                        }
                        continue;
                    }
                    // The oldest makes way, whose asker may have gone long ago; until it has, it has its place.
                    self.asked.retain(|(_, life)| life.strong_count() != 0);
                    if let Some((oldest, _)) = self.asked.pop_front() {
                        oldest.abort();
                    }
                    return;
                }
                // Until something is answered.
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

    /// The oldest that waits; there is one.
    fn next(&mut self) -> (S::Request, Vec<u8>, Instant) {
        let next = self.waiting.pop_front().unwrap_or_else(|| unreachable!("it was looked at"));
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

    /// Carries on with what happened here, if something did or it is time to look: answers go to whoever asked there.
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

/// Sends a request through the first client that has room for one more.
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
    // There is one at least.
    Err(refused.unwrap_or(ServiceError::NoServer { service: "".into() }))
}

impl<S: FarServer> Drop for Offered<S> {
    fn drop(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.pending.len() + self.waiting.len(), "its server here has gone");
    }
}
