// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ROS side of services: rcl's servers and clients, which exchange structs, and their conversion to bodies.
//!
//! Both sides wake the thread: rcl for requests and responses in ROS, a guard condition for those in the domain.

mod types;

use crate::rcl::{
    GuardCondition, Node, RclError, RosClient, RosRequestId, RosServer, RosStruct, SerializedMessage,
    WaitSet, Waitable,
};
use futures::task::{ArcWake, waker};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::Waker;
use std::time::{Duration, Instant};
use tautline_relay::{
    Arrived, FarClient, FarServer, FarServices, OfferedService, Pending, Response, ServerId, SoughtService,
    TopicKey,
};
use tautline_transport::{Gid, NodeName, RawSample, RequestId, ServiceType};
use types::{BridgedService, ServiceTypes, from_body, to_body};

/// Maximum of pending requests to ROS: the default queue depth of a server in ROS, which overwrites the oldest. At this limit no
/// request is taken: they wait in the queue here, and clients get an error when it is full.
const MOST_PENDING: usize = 10;
/// The same maximum for an action's get_result requests, which the server takes at once and answers when the goal has ended.
const MOST_PENDING_RESULTS: usize = 1024;

/// The nodes in ROS that mirror Tautline's: mirrored services belong to them.
pub(crate) type Nodes = BTreeMap<NodeName, Arc<Node>>;

pub(crate) struct RosServices {
    node: Arc<Node>,
    types: ServiceTypes,
    guard: Arc<GuardCondition>,
    wait_set: WaitSet,
}

/// Wakes the thread for events in the domain.
struct GuardWaker(Arc<GuardCondition>);

impl ArcWake for GuardWaker {
    fn wake_by_ref(waker: &Arc<Self>) {
        waker.0.trigger();
    }
}

impl RosServices {
    /// `node` has the services that belong to no mirrored node.
    pub(crate) fn new(node: &Arc<Node>) -> Result<Self, RclError> {
        let (guard, wait_set) = (GuardCondition::new(node.context())?, WaitSet::new(node.context())?);
        Ok(RosServices { node: node.clone(), types: ServiceTypes::new(), guard, wait_set })
    }
}

impl FarServices for RosServices {
    type Server = Server;
    type Client = Client;
    type With = Nodes;

    fn offer<'a>(
        &'a mut self,
        key: &'a TopicKey,
        service: &'a OfferedService,
        nodes: &'a Nodes,
    ) -> Result<(ServiceType, Box<dyn FnOnce() -> Result<Server, String> + 'a>), String> {
        let node = service.node.as_ref().and_then(|name| nodes.get(name)).unwrap_or(&self.node);
        let types = self.types.find(&key.type_name, service.type_hash.as_deref());
        let types = types.map_err(|error| error.to_string())?;
        let service_type = types.service_type();
        let open = || Server::new(node, &key.far_topic, types).map_err(|error| error.to_string());
        Ok((service_type, Box::new(open)))
    }

    fn seek(&mut self, key: &TopicKey, service: &SoughtService) -> Result<(ServiceType, Client), String> {
        let types = self.types.find(&key.type_name, service.type_hash.as_deref());
        let types = types.map_err(|error| error.to_string())?;
        let service_type = types.service_type();
        let client = Client::new(&self.node, key, types).map_err(|error| error.to_string())?;
        Ok((service_type, client))
    }

    fn waker(&self) -> Waker {
        waker(Arc::new(GuardWaker(self.guard.clone())))
    }

    fn wait(
        &mut self,
        servers: &[&Server],
        clients: &[&Client],
        timeout: Option<Duration>,
    ) -> Result<Arrived, String> {
        let requests = servers.iter().map(|server| Waitable::Server(&server.server));
        let responses = clients.iter().map(|client| Waitable::Client(&client.client));
        let all: Vec<_> = requests.chain(responses).chain([Waitable::Guard(&self.guard)]).collect();
        let ready = self.wait_set.wait(&all, timeout).map_err(|error| error.to_string())?;
        let (requests, ready) = ready.split_at(servers.len());
        let responses = ready.get(..clients.len()).unwrap_or_default();
        Ok(Arrived { requests: requests.to_vec(), responses: responses.to_vec() })
    }
}

/// The server in ROS that mirrors one of the domain.
pub(crate) struct Server {
    server: RosServer,
    types: BridgedService,
    request: RosStruct,
    response: RosStruct,
    buffer: SerializedMessage,
}

impl Server {
    fn new(node: &Arc<Node>, service: &str, types: BridgedService) -> Result<Self, RclError> {
        let (request, response) = (types.support.new_request()?, types.support.new_response()?);
        let server = RosServer::new(node, service, &types.support)?;
        Ok(Server { server, types, request, response, buffer: SerializedMessage::new()? })
    }
}

impl FarServer for Server {
    type Request = RosRequestId;

    fn take(&mut self) -> Option<Result<(RosRequestId, Vec<u8>), String>> {
        match self.server.take(&mut self.request) {
            Ok(id) => {
                let body = to_body(&self.request, &self.types.request, &mut self.buffer);
                id.map(|id| Ok((id, body.map_err(|error| error.to_string())?.to_vec())))
            }
            Err(error) => Some(Err(error.reason)),
        }
    }

    /// ROS cannot report that a response will not come.
    fn answer(&mut self, id: RosRequestId, answer: Result<&[u8], &str>) -> Result<(), String> {
        let Ok(body) = answer else { return Ok(()) };
        from_body(body, &self.types.response, &mut self.response, &mut self.buffer)
            .map_err(|error| error.to_string())?;
        self.server.respond(id, &mut self.response).map_err(|error| error.reason)
    }
}

/// The client in ROS for clients of the domain.
pub(crate) struct Client {
    client: RosClient,
    types: BridgedService,
    request: RosStruct,
    response: RosStruct,
    buffer: SerializedMessage,
    pending: Pending,
    /// The servers in ROS.
    servers: BTreeSet<ServerId>,
}

impl Client {
    fn new(node: &Arc<Node>, key: &TopicKey, types: BridgedService) -> Result<Self, RclError> {
        let (request, response) = (types.support.new_request()?, types.support.new_response()?);
        let most = match key.topic.ends_with("/_action/get_result") {
            true => MOST_PENDING_RESULTS,
            false => MOST_PENDING,
        };
        let client = RosClient::new(node, &key.far_topic, &types.support)?;
        let (pending, servers) = (Pending::new(most), BTreeSet::new());
        Ok(Client { client, types, request, response, buffer: SerializedMessage::new()?, pending, servers })
    }
}

impl FarClient for Client {
    const IS_POLLED: bool = true;

    fn is_available(&mut self) -> bool {
        self.client.is_available().unwrap_or(false)
    }

    fn set_servers(&mut self, servers: &BTreeSet<ServerId>) -> Vec<RequestId> {
        self.servers.clone_from(servers);
        self.pending.set_servers(servers)
    }

    fn make_room(&mut self, is_waited_for: &dyn Fn(Gid) -> bool) -> (bool, Option<RequestId>) {
        self.pending.make_room(is_waited_for, Instant::now())
    }

    fn send(&mut self, id: RequestId, request: &RawSample) -> Result<(), String> {
        from_body(request.body(), &self.types.request, &mut self.request, &mut self.buffer)
            .map_err(|error| error.to_string())?;
        let number = self.client.send(&self.request).map_err(|error| error.reason)?;
        self.pending.add(number, id, self.servers.clone(), Instant::now(), ());
        Ok(())
    }

    fn take(&mut self) -> Option<Response> {
        loop {
            match self.client.take(&mut self.response) {
                Ok(Some(number)) => {
                    let Some(id) = self.pending.remove(number) else { continue };
                    let body = to_body(&self.response, &self.types.response, &mut self.buffer);
                    return Some(match body {
                        Ok(body) => Response::Answer(id, body.to_vec()),
                        Err(error) => Response::None(id, error.to_string()),
                    });
                }
                Ok(None) => return None,
                // The response's request is unknown, and is dropped when room is needed.
                Err(error) => return Some(Response::Wrong(error.reason)),
            }
        }
    }

    fn forget(&mut self) -> usize {
        self.pending.clear()
    }
}
