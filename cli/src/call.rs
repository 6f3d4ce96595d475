// SPDX-License-Identifier: MIT OR Apache-2.0
//! Calls services and actions by the names that users type, through a temporary node, with a time limit.

use crate::arguments::full_name;
use crate::verb::{CommonArgs, End, Failure, Outcome, Waited};
use futures::StreamExt;
use futures::stream::FuturesUnordered;
use std::collections::BTreeSet;
use std::future::Future;
use std::sync::Arc;
use std::task::{Context as Polled, Wake, Waker};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;
use tautline::{Client, Context, Error, Node, Realtime};
use tautline_msgs::Service;
use tautline_transport::{GraphSnapshot, NodeInfo, ServiceKind, graph_of};

/// The time limit for the answer of a node.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// The node of a container without a given name.
pub const MANAGER: &str = "/ComponentManager";

/// The response, or why there is none.
pub type Response<T> = Result<<T as Service>::Response, Error>;

/// A temporary node that calls services, and its sampler thread, which receives the responses.
pub struct Caller {
    pub node: Node,
    pub end: End,
    context: Context,
    sampler: Option<JoinHandle<Result<(), Error>>>,
}

impl Caller {
    /// Joins the domain.
    pub fn new(domain: u32, end: End) -> Outcome<Self> {
        let context = Context::builder().domain(domain).realtime(Realtime::Off).build()?;
        let node = Node::create(context.clone(), &format!("taut_{}", std::process::id()), "")?;
        let spun = context.clone();
        let sampler = std::thread::spawn(move || spun.spin());
        Ok(Caller { node, end, context, sampler: Some(sampler) })
    }

    pub fn call<T: Service>(&mut self, service: &str, request: T::Request) -> Outcome<T::Response> {
        let response = self.call_all::<T>(vec![(service.to_owned(), request)])?.remove(0);
        response.map_err(|error| Failure::no(no_response(&error)))
    }

    /// Calls several services at once. The result of a service that does not respond in time is [`Error::ServiceTimeout`].
    pub fn call_all<T: Service>(&mut self, requests: Vec<(String, T::Request)>) -> Outcome<Vec<Response<T>>> {
        let timeout = self.end.timeout().unwrap_or_default();
        let graph = self.context.as_ref().graph()?;
        let silent = |service: &String| Err(Error::ServiceTimeout { service: service.clone(), timeout });
        let mut responses: Vec<_> = requests.iter().map(|(service, _)| silent(service)).collect();
        let (mut waiting, mut calls) = (Vec::new(), FuturesUnordered::new());
        for (index, (service, request)) in requests.into_iter().enumerate() {
            let client = self.node.create_client::<T>(&service)?;
            let is_known = has_server(&graph, &service);
            waiting.push(Some(service));
            calls.push(async move { (index, exchange(client, is_known, request).await) });
        }
        // Creating clients for hundreds of nodes takes time, which does not count against the nodes.
        self.end.restart();
        while !calls.is_empty() {
            let what = || {
                let names: Vec<&str> = waiting.iter().flatten().map(String::as_str).collect();
                format!("responses of {}", names.join(", "))
            };
            match self.end.try_wait(what, poll_future(calls.next()))? {
                Waited::Ready(Some((index, response))) => {
                    (waiting[index], responses[index]) = (None, response)
                }
                Waited::Ready(None) | Waited::TimedOut => break,
                Waited::Interrupted => return Err(Failure::interrupted()),
            }
        }
        Ok(responses)
    }

    pub fn wait<T>(&self, what: impl Fn() -> String, future: impl Future<Output = T>) -> Outcome<T> {
        self.end.wait(what, poll_future(future))
    }
}

impl Drop for Caller {
    fn drop(&mut self) {
        self.context.shutdown();
        if let Some(sampler) = self.sampler.take() {
            let _ = sampler.join();
        }
    }
}

/// A node whose services are called.
pub struct NodeCaller {
    pub name: String,
    pub caller: Caller,
}

impl NodeCaller {
    /// The node of this name, which must serve `service` (otherwise the error says `what` of it), and must answer within [`PATIENCE`]
    /// unless `--timeout` states another time.
    pub fn find(common: &CommonArgs, node: &str, service: &str, what: &str) -> Outcome<Self> {
        let (end, domain) = (End::within(PATIENCE, common)?, common.domain()?);
        let name = node_serving(domain, node, service, what)?;
        Ok(NodeCaller { name, caller: Caller::new(domain, end)? })
    }

    pub fn call<T: Service>(&mut self, service: &str, request: T::Request) -> Outcome<T::Response> {
        self.caller.call::<T>(&format!("{}/{service}", self.name), request)
    }
}

async fn exchange<T: Service>(client: Client<T>, is_known: bool, request: T::Request) -> Response<T> {
    // A gateway or bridge creates its proxy of the server only when a client appears.
    if is_known {
        client.wait_for_service()?.await?;
    }
    client.request(&request)?.await
}

/// The name and type of the action whose `send_goal` this service is; `None` for other services. Each action has exactly one `send_goal`.
pub fn action_of<'a>(service: &'a str, type_name: &'a str) -> Option<(&'a str, &'a str)> {
    service.strip_suffix("/_action/send_goal").zip(type_name.strip_suffix("_SendGoal"))
}

/// The error text for a service that did not respond.
pub fn no_response(error: &Error) -> String {
    match error {
        Error::ServiceTimeout { .. } => format!("{error}: its node is stopped, or does not spin"),
        error => error.to_string(),
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}

/// Adapts a future to [`End::wait`]: waking the future unparks this thread.
pub fn poll_future<T>(future: impl Future<Output = T>) -> impl FnMut() -> Outcome<Option<T>> {
    let waker = Waker::from(Arc::new(Unpark(std::thread::current())));
    let mut future = Box::pin(future);
    move || match future.as_mut().poll(&mut Polled::from_waker(&waker)) {
        std::task::Poll::Ready(output) => Ok(Some(output)),
        std::task::Poll::Pending => Ok(None),
    }
}

/// Whether the service has a server, on any host.
fn has_server(graph: &GraphSnapshot, service: &str) -> bool {
    graph.services.iter().any(|end| end.kind == ServiceKind::Server && end.name == service)
}

/// The nodes that serve `<node>/<service>`.
pub fn nodes_serving(domain: u32, service: &str) -> Outcome<Vec<String>> {
    let graph = graph_of(domain)?;
    let servers = graph.services.iter().filter(|end| end.kind == ServiceKind::Server);
    let nodes = servers.filter_map(|end| end.name.strip_suffix(service)?.strip_suffix('/'));
    let nodes: BTreeSet<&str> = nodes.collect();
    Ok(nodes.into_iter().map(str::to_owned).collect())
}

/// The node of this name; otherwise the error suggests the nearest name.
pub fn node_named<'g>(graph: &'g GraphSnapshot, name: &str) -> Outcome<&'g NodeInfo> {
    let names: Vec<String> = graph.nodes.iter().map(|node| node.name.full_name()).collect();
    match names.iter().position(|there| there == name) {
        Some(place) => Ok(&graph.nodes[place]),
        None => Err(Failure::unknown("node", name, names.iter().map(String::as_str), "node list")),
    }
}

/// The full name of a node that serves `<node>/<service>`. For a node without this service, the error says `what` of the node.
pub fn node_serving(domain: u32, node: &str, service: &str, what: &str) -> Outcome<String> {
    let (graph, node) = (graph_of(domain)?, full_name(node));
    if has_server(&graph, &format!("{node}/{service}")) {
        return Ok(node);
    }
    node_named(&graph, &node)?;
    Err(Failure::no(format!("node '{node}' {what}: there is no service {node}/{service}")))
}
