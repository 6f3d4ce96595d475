// SPDX-License-Identifier: MIT OR Apache-2.0
//! A service of ROS's that clients here ask.

use super::routes::ServiceKey;
use super::stats::Counters;
use super::types::{BridgedService, NotBridged, from_body, to_body};
use crate::rcl::{Node, RosClient, RosStruct, SerializedMessage};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_transport::{Limits, Participant, RawSample, RawServer, RequestId, TransportError};

/// Requests taken of one service before the next one has its turn.
const TURN: usize = 16;
/// Requests of one client here that wait to be passed on.
const DEPTH: usize = 100;
/// Requests that ROS has not answered: what the queue of a server in ROS holds by default, which forgets the oldest of more. With
/// as many none is taken: what waits here fills its queue, and who asks then is told so.
const MOST_PENDING: usize = 10;
/// The same of what an action's server answers when a goal has ended: it takes them at once.
const MOST_PENDING_RESULTS: usize = 1024;

pub(super) struct Sought {
    client: RosClient,
    /// While requests reach the one in ROS.
    server: Option<RawServer>,
    types: BridgedService,
    request: RosStruct,
    response: RosStruct,
    pending: BTreeMap<i64, Pending>,
    most_pending: usize,
    /// How many servers ROS has.
    servers: usize,
    service: String,
    participant: Participant,
    counters: Arc<Counters>,
}

/// A request that ROS has.
struct Pending {
    id: RequestId,
    /// How many of the servers that got it may still be there.
    servers: usize,
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
            pending: BTreeMap::new(),
            most_pending: match key.service.ends_with("/_action/get_result") {
                true => MOST_PENDING_RESULTS,
                false => MOST_PENDING,
            },
            servers: 0,
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

    /// ROS has so many servers now. A request that only those got who have gone will not be answered: all that wait end
    /// with an error then, for a server here cannot let go of a single one.
    pub(super) fn set_servers(&mut self, servers: usize) {
        let gone = self.servers.saturating_sub(servers);
        self.servers = servers;
        let mut is_lost = false;
        for pending in self.pending.values_mut() {
            pending.servers = pending.servers.saturating_sub(gone);
            is_lost |= pending.servers == 0;
        }
        if is_lost {
            self.let_go();
        }
    }

    /// Whoever waits for an answer gets an error.
    fn let_go(&mut self) {
        self.counters.set_active(false);
        self.counters.failed_times(self.pending.len(), "its server in ROS has gone");
        self.server = None;
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
            let server =
                self.participant.create_raw_server(service, &service_type, DEPTH, Limits::SERVICE)?;
            self.server = Some(server);
            self.counters.set_active(true);
        }
        for _ in 0..TURN {
            if self.pending.len() >= self.most_pending {
                self.forget_gone();
                if self.pending.len() >= self.most_pending {
                    return Ok(false);
                }
            }
            let Some(Poll::Ready(request)) = self.server.as_mut().map(|server| server.poll_take(context))
            else {
                return Ok(false);
            };
            if let Err(reason) = self.pass_on(&request, buffer) {
                self.counters.failed(reason);
                // It would wait for ever.
                self.let_go();
            }
        }
        Ok(true)
    }

    fn pass_on(&mut self, request: &RawSample, buffer: &mut SerializedMessage) -> Result<(), String> {
        let id = RequestId::of(request.info());
        from_body(request.body(), &self.types.request, &mut self.request, buffer)
            .map_err(|error| error.to_string())?;
        let number = self.client.send(&self.request).map_err(|error| error.reason)?;
        self.pending.insert(number, Pending { id, servers: self.servers.max(1) });
        Ok(())
    }

    /// Requests whose clients have gone.
    fn forget_gone(&mut self) {
        if let Some(server) = &self.server {
            self.pending.retain(|_, pending| server.responders().loan(pending.id, 0).is_ok());
        }
    }

    /// ROS has responses: passes them on, at most a turn of them. What is left wakes the wait again.
    pub(super) fn serve(&mut self, buffer: &mut SerializedMessage) {
        for _ in 0..TURN {
            match self.client.take(&mut self.response) {
                Ok(Some(number)) => {
                    // Of several servers, the first one's counts.
                    let Some(Pending { id, .. }) = self.pending.remove(&number) else { continue };
                    match self.answer(id, buffer) {
                        Ok(()) => self.counters.answered(),
                        Err(reason) => self.counters.failed(reason),
                    }
                }
                Ok(None) => break,
                Err(error) => return self.counters.failed(error.reason),
            }
        }
    }

    fn answer(&mut self, id: RequestId, buffer: &mut SerializedMessage) -> Result<(), String> {
        let body =
            to_body(&self.response, &self.types.response, buffer).map_err(|error| error.to_string())?;
        let Some(server) = &self.server else { return Err("its server here has gone".to_owned()) };
        let mut loan = server.responders().loan(id, body.len()).map_err(|error| error.to_string())?;
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
