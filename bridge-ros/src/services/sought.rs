// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of ROS's that clients here ask.

use super::pending::Pending;
use super::routes::{ServerId, ServiceKey};
use super::stats::Counters;
use super::types::{BridgedService, NotBridged, from_body, limits, to_body};
use crate::rcl::{Node, RosClient, RosStruct, SerializedMessage};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;
use tautline_transport::{Participant, RawSample, RawServer, RequestId, ServiceError, TransportError};

/// Requests taken of one service before the next one has its turn.
const TURN: usize = 16;
/// Requests of one client here that wait to be passed on.
const DEPTH: usize = 100;
/// Requests that ROS has not answered: what the queue of a server in ROS holds by default, which forgets the oldest of more. With
/// as many none is taken: what waits here fills its queue, and who asks then is told so.
const MOST_PENDING: usize = 10;
/// The same of what an action's server answers when a goal has ended: it takes them at once.
const MOST_PENDING_RESULTS: usize = 1024;

const SERVER_GONE: &str = "its server in ROS has gone";

pub(super) struct Sought {
    client: RosClient,
    /// While requests reach the one in ROS.
    server: Option<RawServer>,
    types: BridgedService,
    request: RosStruct,
    response: RosStruct,
    pending: Pending,
    /// A request that has no place among them.
    next: Option<RawSample>,
    /// What ROS has.
    servers: BTreeSet<ServerId>,
    service: String,
    participant: Participant,
    counters: Arc<Counters>,
}

impl Sought {
    pub(super) fn open(
        key: &ServiceKey,
        types: &BridgedService,
        participant: &Participant,
        node: &Arc<Node>,
        counters: Arc<Counters>,
    ) -> Result<Self, NotBridged> {
        Ok(Sought {
            client: RosClient::new(node, &key.ros_service, &types.support)?,
            server: None,
            types: types.clone(),
            request: types.support.new_request()?,
            response: types.support.new_response()?,
            pending: Pending::new(match key.service.ends_with("/_action/get_result") {
                true => MOST_PENDING_RESULTS,
                false => MOST_PENDING,
            }),
            next: None,
            servers: BTreeSet::new(),
            service: key.service.clone(),
            participant: participant.clone(),
            counters,
        })
    }

    pub(super) fn client(&self) -> &RosClient {
        &self.client
    }

    /// Whether the server in ROS is not reached yet: nothing tells when it is.
    pub(super) fn is_seeking(&self) -> bool {
        self.server.is_none()
    }

    /// ROS has these servers now. A request that only those got who have gone will not be answered.
    pub(super) fn set_servers(&mut self, servers: &BTreeSet<ServerId>) {
        for id in self.pending.set_servers(servers) {
            self.refuse(id, SERVER_GONE);
        }
        self.servers = servers.clone();
    }

    /// Who asked gets an error instead of an answer.
    fn refuse(&mut self, id: RequestId, reason: impl ToString) {
        self.counters.failed(reason);
        let Some(server) = &self.server else { return };
        match server.refuse(id) {
            Ok(()) | Err(ServiceError::ClientGone { .. }) => {}
            // With its server it ends in any case.
            Err(_) => self.let_go(),
        }
    }

    /// Whoever waits for an answer gets an error: its server here has gone.
    fn let_go(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.pending.len(), SERVER_GONE);
        (self.server, self.next) = (None, None);
        self.pending.clear();
    }

    /// Passes requests of clients here on, at most a turn of them. Says whether there may be more.
    pub(super) fn poll(
        &mut self,
        context: &mut Context<'_>,
        buffer: &mut SerializedMessage,
    ) -> Result<bool, TransportError> {
        let is_available = self.client.is_available().unwrap_or(false);
        if !is_available {
            self.let_go();
        }
        if is_available && self.server.is_none() {
            let (service, service_type) = (&self.service, self.types.service_type());
            self.server =
                Some(self.participant.create_raw_server(service, &service_type, DEPTH, limits())?);
            self.counters.set_active(true);
        }
        for _ in 0..TURN {
            let Some(request) = self.next.take().or_else(|| self.take(context)) else { return Ok(false) };
            if !self.make_room() {
                self.next = Some(request);
                return Ok(false);
            }
            if let Err(reason) = self.pass_on(&request, buffer) {
                self.refuse(RequestId::of(request.info()), reason);
            }
        }
        Ok(true)
    }

    fn take(&mut self, context: &mut Context<'_>) -> Option<RawSample> {
        match self.server.as_ref()?.poll_take(context) {
            Poll::Ready(request) => Some(request),
            Poll::Pending => None,
        }
    }

    /// Whether there is a place for one more: whose client has gone makes way, and in the end the oldest, whose answer may have
    /// been lost.
    fn make_room(&mut self) -> bool {
        if self.pending.is_full() {
            self.forget_gone();
        }
        if self.pending.is_full()
            && let Some(id) = self.pending.take_silent(Instant::now())
        {
            self.refuse(id, "its server in ROS is silent");
        }
        !self.pending.is_full()
    }

    fn pass_on(&mut self, request: &RawSample, buffer: &mut SerializedMessage) -> Result<(), String> {
        let id = RequestId::of(request.info());
        from_body(request.body(), &self.types.request, &mut self.request, buffer)
            .map_err(|error| error.to_string())?;
        let number = self.client.send(&self.request).map_err(|error| error.reason)?;
        self.pending.add(number, id, self.servers.clone(), Instant::now());
        Ok(())
    }

    /// Requests whose clients have gone.
    fn forget_gone(&mut self) {
        if let Some(server) = &self.server {
            self.pending.retain(|id| server.can_answer(id.client));
        }
    }

    /// ROS has responses: passes them on, at most a turn of them. What is left wakes the wait again.
    pub(super) fn serve(&mut self, buffer: &mut SerializedMessage) {
        for _ in 0..TURN {
            match self.client.take(&mut self.response) {
                Ok(Some(number)) => {
                    let Some(id) = self.pending.remove(number) else { continue };
                    match self.answer(id, buffer) {
                        Ok(()) => self.counters.answered(),
                        Err(reason) => self.refuse(id, reason),
                    }
                }
                Ok(None) => break,
                // Which request it answered is not told: that one makes way when its place is needed.
                Err(error) => return self.counters.failed(error.reason),
            }
        }
    }

    fn answer(&mut self, id: RequestId, buffer: &mut SerializedMessage) -> Result<(), String> {
        let body =
            to_body(&self.response, &self.types.response, buffer).map_err(|error| error.to_string())?;
        let Some(server) = &self.server else { return Err("its server here has gone".to_owned()) };
        let mut loan = server.loan(id, body.len()).map_err(|error| error.to_string())?;
        loan.copy_from_slice(body);
        loan.send().map_err(|unsent| unsent.to_string())?;
        Ok(())
    }
}

impl Drop for Sought {
    fn drop(&mut self) {
        self.let_go();
    }
}
