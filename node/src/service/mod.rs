// SPDX-License-Identifier: MIT OR Apache-2.0
//! Services: of types with which the program was built, and of types that are known only at run time.

mod client;
mod server;
#[cfg(feature = "untyped")]
mod untyped;

pub use client::{Client, ResponseFuture};
#[cfg(feature = "action_msgs")]
pub(crate) use server::Reply;
pub use server::{Server, ServiceRequest};

#[allow(unused_imports, reason = "for the documentation")]
use crate::error::Error;
use crate::error::Result;
use crate::node::Node;
use tautline_msgs::Service;
use tautline_transport::{Limits, Qos};

/// A service's queues are keep-all: of the QoS only the depth is used, as the number of requests of one client that can
/// wait at a server.
///
/// A request goes to every server, as in ROS 2, and the first response counts. Without a server it is an error: wait with [`Client::wait_for_service`] first. If all servers that got it end or are
/// killed, it ends with an error as well.
impl Node {
    /// Creates a service: a stream of requests, read in shared memory, with functions to respond there. [`Server::owned`] converts
    /// it into a stream of owned requests; respond to each with [`respond`](ServiceRequest::respond), in any thread.
    ///
    /// ```
    /// # #[cfg(feature = "example_interfaces")] {
    /// use futures::{StreamExt, executor::LocalPool, task::LocalSpawnExt};
    /// use tautline::example_interfaces::srv::AddTwoInts;
    /// # use tautline::{Context, Node, Qos, Realtime};
    /// # use std::time::Duration;
    /// # let ctx = Context::builder().domain(129).realtime(Realtime::Off).build()?;
    /// # let mut node = Node::create(ctx.clone(), "example", "")?;
    /// let requests = node.create_service::<AddTwoInts::Service>("/add", Qos::default())?.owned();
    /// let client = node.create_client::<AddTwoInts::Service>("/add")?;
    /// let mut pool = LocalPool::new();
    /// pool.spawner().spawn_local(requests.for_each(|request| async move {
    ///     let sum = request.message.a + request.message.b;
    ///     request.respond(AddTwoInts::Response { sum }).expect("the client waits");
    /// })).unwrap();
    /// pool.spawner().spawn_local(async move {
    ///     let response = client.request(&AddTwoInts::Request { a: 1, b: 2 }).unwrap().await.unwrap();
    ///     assert_eq!(response.sum, 3);
    ///     ctx.shutdown();
    /// }).unwrap();
    /// while node.context().is_valid() {
    ///     node.spin_once(Duration::from_millis(100));
    ///     pool.run_until_stalled();
    /// }
    /// # }
    /// # Ok::<(), tautline::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Name`]; [`Error::Transport`]: no memory left in /dev/shm.
    pub fn create_service<T: Service>(&mut self, service_name: &str, qos: Qos) -> Result<Server<T>> {
        let (name, limits) = self.resolve_service(service_name)?;
        let _node = tautline_trace::in_node(self.trace.id());
        Ok(Server::new(self.participant.create_server(&name, qos.depth, limits)?))
    }

    /// Creates a client of a service. Requests are always reliable, and [`Limits`] state for how many there is
    /// room.
    ///
    /// # Errors
    /// As [`create_service`](Self::create_service).
    pub fn create_client<T: Service>(&mut self, service_name: &str) -> Result<Client<T>> {
        let (name, limits) = self.resolve_service(service_name)?;
        let _node = tautline_trace::in_node(self.trace.id());
        Ok(Client::new(self.participant.create_client(&name, limits)?, self.context.events()))
    }

    /// Sets the limits of the servers and clients of a service that this node creates from now on: `message_bytes` applies to
    /// the messages that each sends, responses or requests.
    ///
    /// # Errors
    /// [`Error::Name`].
    pub fn set_service_limits(&mut self, service_name: &str, limits: Limits) -> Result<()> {
        let name = self.resolve_service_name(service_name)?;
        self.service_limits.insert(name, limits);
        Ok(())
    }

    pub(crate) fn resolve_service(&self, service_name: &str) -> Result<(String, Limits)> {
        let name = self.resolve_service_name(service_name)?;
        let limits = self.service_limits.get(&name).copied().unwrap_or_default();
        Ok((name, limits))
    }
}
