// SPDX-License-Identifier: MIT OR Apache-2.0

use crate::action::{ActionClient, ActionClientUntyped, ActionServerGoalRequest};
use crate::client::{Client, ClientUntyped, IsAvailablePollable};
use crate::publisher::{Publisher, PublisherUntyped};
use crate::qos::QosProfile;
use crate::time::{Clock, TimeSource, Timer};
use futures::{Stream, StreamExt};
use indexmap::IndexMap;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tautline::{
    Action, Context, Message, Parameter, ParameterValue, Result, RosParams, Service, ServiceRequest,
};

/// A node with r2r's API; it wraps a [`tautline::Node`].
#[derive(Debug)]
pub struct Node {
    inner: tautline::Node,
    ros_clock: Arc<Mutex<Clock>>,
    /// The parameters that were declared, or set by the command line. Values that are inserted here directly are neither checked
    /// nor seen by readers: see [`set_parameter`](tautline::Node::set_parameter).
    pub params: Arc<Mutex<IndexMap<String, Parameter>>>,
}

impl Node {
    /// As [`tautline::Node::create`].
    pub fn create(ctx: Context, name: &str, namespace: &str) -> Result<Node> {
        Ok(tautline::Node::create(ctx, name, namespace)?.into())
    }

    /// The node's name.
    ///
    /// # Errors
    /// None.
    pub fn name(&self) -> Result<String> {
        Ok(self.inner.name().to_owned())
    }

    /// The node's namespace.
    ///
    /// # Errors
    /// None.
    pub fn namespace(&self) -> Result<String> {
        Ok(self.inner.namespace().to_owned())
    }

    /// The node's name with its namespace.
    ///
    /// # Errors
    /// None.
    pub fn fully_qualified_name(&self) -> Result<String> {
        Ok(self.inner.fully_qualified_name().to_owned())
    }

    /// As [`tautline::Node::subscribe`].
    pub fn subscribe<T: Message>(
        &mut self,
        topic: &str,
        qos_profile: QosProfile,
    ) -> Result<impl Stream<Item = T> + Unpin + Send + use<T>> {
        Ok(self.inner.subscribe::<T>(topic, qos_profile.into())?.owned())
    }

    /// As [`tautline::Node::subscribe_untyped`].
    pub fn subscribe_untyped(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos_profile: QosProfile,
    ) -> Result<impl Stream<Item = Result<serde_json::Value>> + Unpin + Send + use<>> {
        Ok(self.inner.subscribe_untyped(topic, topic_type, qos_profile.into())?.owned())
    }

    /// As [`tautline::Node::subscribe_raw`].
    pub fn subscribe_raw(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos_profile: QosProfile,
    ) -> Result<impl Stream<Item = Vec<u8>> + Unpin + Send + use<>> {
        Ok(self.inner.subscribe_raw(topic, topic_type, qos_profile.into())?.owned())
    }

    /// As [`tautline::Node::create_publisher`].
    pub fn create_publisher<T: Message>(
        &mut self,
        topic: &str,
        qos_profile: QosProfile,
    ) -> Result<Publisher<T>> {
        Ok(self.inner.create_publisher(topic, qos_profile.into())?.into())
    }

    /// As [`tautline::Node::create_publisher_untyped`].
    pub fn create_publisher_untyped(
        &mut self,
        topic: &str,
        topic_type: &str,
        qos_profile: QosProfile,
    ) -> Result<PublisherUntyped> {
        Ok(self.inner.create_publisher_untyped(topic, topic_type, qos_profile.into())?.into())
    }

    /// Ends a publisher. Dropping it does the same.
    pub fn destroy_publisher<T: Message>(&mut self, p: Publisher<T>) {
        drop(p);
    }

    /// Ends a publisher. Dropping it does the same.
    pub fn destroy_publisher_untyped(&mut self, p: PublisherUntyped) {
        drop(p);
    }

    /// As [`tautline::Node::create_service`].
    pub fn create_service<T: Service>(
        &mut self,
        service_name: &str,
        qos_profile: QosProfile,
    ) -> Result<impl Stream<Item = ServiceRequest<T>> + Unpin + Send + use<T>> {
        Ok(self.inner.create_service(service_name, qos_profile.into())?.owned())
    }

    /// As [`tautline::Node::create_client`]: requests are reliable whatever the profile says.
    pub fn create_client<T: Service>(&mut self, service_name: &str, _: QosProfile) -> Result<Client<T>> {
        Ok(self.inner.create_client(service_name)?.into())
    }

    /// As [`tautline::Node::create_client_untyped`]: see [`create_client`](Self::create_client).
    pub fn create_client_untyped(
        &mut self,
        service_name: &str,
        service_type: &str,
        _: QosProfile,
    ) -> Result<ClientUntyped> {
        let client = self.inner.create_client_untyped(service_name, service_type)?;
        Ok(ClientUntyped(client.into()))
    }

    /// As [`tautline::Client::wait_for_service`] and [`tautline::ActionClient::wait_for_action_server`].
    pub fn is_available(
        client: &dyn IsAvailablePollable,
    ) -> Result<impl Future<Output = Result<()>> + Unpin + Send + use<>> {
        client.wait()
    }

    /// As [`tautline::Node::make_parameter_handler`], for a struct whose fields are the parameters. It takes the values from the
    /// command line now, and values that other nodes set later.
    ///
    /// # Errors
    /// As there, and as [`tautline::Parameters::declare_struct`].
    pub fn make_derived_parameter_handler(
        &mut self,
        params_struct: Arc<Mutex<dyn RosParams + Send>>,
    ) -> Result<(
        impl Future<Output = ()> + Send + use<>,
        impl Stream<Item = (String, ParameterValue)> + Send + Unpin + use<>,
    )> {
        self.inner.parameters().declare_struct(params_struct)?;
        self.inner.make_parameter_handler()
    }

    /// As [`tautline::Node::create_action_client`].
    pub fn create_action_client<T: Action>(&mut self, action_name: &str) -> Result<ActionClient<T>> {
        Ok(self.inner.create_action_client(action_name)?.into())
    }

    /// As [`tautline::Node::create_action_client_untyped`].
    pub fn create_action_client_untyped(
        &mut self,
        action_name: &str,
        action_type: &str,
    ) -> Result<ActionClientUntyped> {
        Ok(self.inner.create_action_client_untyped(action_name, action_type)?.into())
    }

    /// As [`tautline::Node::create_action_server`].
    pub fn create_action_server<T: Action>(
        &mut self,
        action_name: &str,
    ) -> Result<impl Stream<Item = ActionServerGoalRequest<T>> + Unpin + Send + use<T>> {
        Ok(self.inner.create_action_server(action_name)?.map(ActionServerGoalRequest::from))
    }

    /// The publishers of a topic. Nothing is mangled in Tautline, so `no_mangle` changes nothing.
    ///
    /// # Errors
    /// As [`tautline::Node::get_publishers_info_by_topic`].
    pub fn get_publishers_info_by_topic(
        &self,
        topic_name: &str,
        no_mangle: bool,
    ) -> Result<Vec<TopicEndpointInfo>> {
        let _ = no_mangle;
        let found = self.inner.get_publishers_info_by_topic(topic_name)?;
        Ok(found.into_iter().map(TopicEndpointInfo::from).collect())
    }

    /// As [`tautline::Node::create_wall_timer`].
    pub fn create_wall_timer(&mut self, period: Duration) -> Result<Timer> {
        Ok(self.inner.create_wall_timer(period)?.into())
    }

    /// As [`tautline::Node::create_timer`].
    pub fn create_timer(&mut self, period: Duration) -> Result<Timer> {
        Ok(self.inner.create_timer(period)?.into())
    }

    /// The node's ROS clock: the system's time or, with `use_sim_time`, that of `/clock`.
    pub fn get_ros_clock(&self) -> Arc<Mutex<Clock>> {
        self.ros_clock.clone()
    }

    /// The time source of the node's ROS clock.
    pub fn get_time_source(&self) -> TimeSource {
        self.inner.time_source().into()
    }
}

impl TimeSource {
    /// Shows the time of `/clock`, for `node`, whose time source this is.
    ///
    /// # Errors
    /// As [`tautline::TimeSource::enable_sim_time`].
    pub fn enable_sim_time(&self, _node: &mut Node) -> Result<()> {
        (**self).enable_sim_time()
    }
}

impl From<tautline::Node> for Node {
    fn from(inner: tautline::Node) -> Self {
        let params = tautline::__private::parameter_map(&inner);
        let ros_clock = Arc::new(Mutex::new(inner.clock().into()));
        Node { inner, ros_clock, params }
    }
}

impl Deref for Node {
    type Target = tautline::Node;

    fn deref(&self) -> &tautline::Node {
        &self.inner
    }
}

impl DerefMut for Node {
    fn deref_mut(&mut self) -> &mut tautline::Node {
        &mut self.inner
    }
}

/// A publisher of a topic, as r2r describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicEndpointInfo {
    /// Its node's name.
    pub node_name: String,
    /// Its node's namespace.
    pub node_namespace: String,
    /// The topic's type, `package/msg/Name`.
    pub topic_type: String,
    /// Its identifier, which is also in its messages.
    pub endpoint_gid: [u8; 16],
    /// The quality of service that it offers.
    pub qos_profile: QosProfile,
}

impl From<tautline::TopicEndpointInfo> for TopicEndpointInfo {
    fn from(info: tautline::TopicEndpointInfo) -> Self {
        TopicEndpointInfo {
            node_name: info.node_name,
            node_namespace: info.node_namespace,
            topic_type: info.topic_type,
            endpoint_gid: info.endpoint_gid,
            qos_profile: info.qos.into(),
        }
    }
}
