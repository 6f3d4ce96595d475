// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of Tautline's that ROS may ask.

use super::routes::ServiceKey;
use super::stats::Counters;
use super::types::{BridgedService, NotBridged, from_body, limits, to_body};
use crate::rcl::{Node, RosRequestId, RosServer, RosStruct, SerializedMessage};
use futures::future::BoxFuture;
use futures::stream::FuturesUnordered;
use futures::{FutureExt, StreamExt};
use std::collections::VecDeque;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, Instant};
use tautline_transport::{Availability, Participant, RawClient, RawPending, RawSample, ServiceError};

/// Requests taken of one service before the next one has its turn.
const TURN: usize = 16;
/// Requests that wait for room at the server here; more are refused and counted.
const MOST_WAITING: usize = 1024;
const MOST_WAITING_BYTES: usize = 16 << 20;
/// How long requests wait for a server.
const SERVER_TIME: Duration = Duration::from_secs(10);

pub(super) struct Offered {
    client: RawClient,
    server: RosServer,
    types: BridgedService,
    request: RosStruct,
    response: RosStruct,
    /// Bodies that are not passed on yet, for want of room.
    waiting: VecDeque<(RosRequestId, Vec<u8>, Instant)>,
    waiting_bytes: usize,
    /// For a server here: a gateway that tells of one makes it when somebody asks.
    availability: Option<Availability>,
    /// At most as many as a client can have.
    pending: FuturesUnordered<BoxFuture<'static, Answer>>,
    counters: Arc<Counters>,
}

type Answer = (RosRequestId, Result<RawSample, ServiceError>);

impl Offered {
    pub(super) fn open(
        key: &ServiceKey,
        types: &BridgedService,
        participant: &Participant,
        node: &Arc<Node>,
        counters: Arc<Counters>,
    ) -> Result<Self, NotBridged> {
        let client = participant.create_raw_client(&key.service, &types.service_type(), limits())?;
        let (request, response) = (types.support.new_request()?, types.support.new_response()?);
        // Last, for ROS asks from then on.
        let server = RosServer::new(node, &key.ros_service, &types.support)?;
        let (types, pending) = (types.clone(), FuturesUnordered::new());
        counters.set_active(true);
        Ok(Offered {
            client,
            server,
            types,
            request,
            response,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            availability: None,
            pending,
            counters,
        })
    }

    /// Whether requests wait for a server here.
    pub(super) fn is_waiting(&self) -> bool {
        self.availability.is_some()
    }

    pub(super) fn server(&self) -> &RosServer {
        &self.server
    }

    /// ROS has requests: takes them, at most a turn of them. What is left wakes the wait again.
    pub(super) fn serve(&mut self, buffer: &mut SerializedMessage) {
        for _ in 0..TURN {
            match self.server.take(&mut self.request) {
                Ok(Some(id)) => {
                    if let Err(reason) = self.receive(id, buffer) {
                        self.counters.failed(reason);
                    }
                }
                Ok(None) => break,
                Err(error) => return self.counters.failed(error.reason),
            }
        }
    }

    fn receive(&mut self, id: RosRequestId, buffer: &mut SerializedMessage) -> Result<(), String> {
        let body = to_body(&self.request, &self.types.request, buffer).map_err(|error| error.to_string())?;
        if self.waiting.len() >= MOST_WAITING || self.waiting_bytes + body.len() > MOST_WAITING_BYTES {
            return Err("too many requests wait for the server here".to_owned());
        }
        self.waiting_bytes += body.len();
        self.waiting.push_back((id, body.to_vec(), Instant::now()));
        Ok(())
    }

    /// Asks here what ROS asked, in order, as long as there is room for it.
    fn pass_on(&mut self) {
        while let Some((id, body, since)) = self.waiting.front() {
            match ask(&self.client, body) {
                Ok(response) => {
                    let id = *id;
                    self.pending.push(response.map(move |response| (id, response)).boxed());
                }
                // Until something is answered.
                Err(ServiceError::RequestsFull { .. } | ServiceError::TooManyPending { .. })
                    if !self.pending.is_empty() =>
                {
                    return;
                }
                Err(ServiceError::NoServer { .. }) if since.elapsed() < SERVER_TIME => {
                    if self.availability.is_none() {
                        self.availability = self.client.availability().ok();
                    }
                    return;
                }
                Err(error) => self.counters.failed(error),
            }
            self.waiting_bytes -= body.len();
            self.waiting.pop_front();
        }
        self.availability = None;
    }

    /// Carries on with what happened here: answers go to whoever asked in ROS.
    pub(super) fn poll(&mut self, context: &mut Context<'_>, buffer: &mut SerializedMessage) {
        loop {
            self.pass_on();
            if self.availability.as_mut().is_some_and(|wait| wait.poll_unpin(context).is_ready()) {
                self.availability = None;
                continue;
            }
            let Poll::Ready(Some((id, response))) = self.pending.poll_next_unpin(context) else { return };
            let answer = response.map_err(|error| error.to_string());
            match answer.and_then(|response| self.answer(id, &response, buffer)) {
                Ok(()) => self.counters.answered(),
                Err(reason) => self.counters.failed(reason),
            }
        }
    }

    fn answer(
        &mut self,
        id: RosRequestId,
        response: &RawSample,
        buffer: &mut SerializedMessage,
    ) -> Result<(), String> {
        let body = response.body();
        from_body(body, &self.types.response, &mut self.response, buffer)
            .map_err(|error| error.to_string())?;
        self.server.respond(id, &mut self.response).map_err(|error| error.reason)?;
        Ok(())
    }
}

fn ask(client: &RawClient, body: &[u8]) -> Result<RawPending, ServiceError> {
    let mut loan = client.loan(body.len())?;
    loan.copy_from_slice(body);
    Ok(client.send(loan)?)
}

impl Drop for Offered {
    fn drop(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.pending.len() + self.waiting.len(), "its server here has gone");
    }
}
