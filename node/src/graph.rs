// SPDX-License-Identifier: MIT OR Apache-2.0
//! The graph as a node sees it: nodes, topics, services and actions of its domain, on this host and on other hosts. The
//! functions have the names of rclcpp and rclpy.

use crate::error::Result;
use crate::node::Node;
use futures::StreamExt;
use std::collections::HashMap;
use std::future::Future;
use std::sync::Arc;
use tautline_transport::{
    EndpointKind, GraphEvents, GraphSnapshot, NodeInfo, NodeName, Participant, Qos, ServiceKind,
    TopicEndpoint,
};

/// ROS 2's placeholder for the node of an endpoint that has none.
const UNKNOWN_NAME: &str = "_NODE_NAME_UNKNOWN_";
const UNKNOWN_NAMESPACE: &str = "_NODE_NAMESPACE_UNKNOWN_";

/// A publisher or a subscription of a topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicEndpointInfo {
    /// Its node's name.
    pub node_name: String,
    /// Its node's namespace.
    pub node_namespace: String,
    /// The topic's type, `package/msg/Name`.
    pub topic_type: String,
    /// The type's hash, if it is known.
    pub topic_type_hash: Option<String>,
    /// Its identifier; for a publisher this is the identifier in its messages.
    pub endpoint_gid: [u8; 16],
    /// The quality of service that it offers or requests.
    pub qos: Qos,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Whether it is on another host.
    pub is_remote: bool,
}

/// Queries of the graph. They are for setup: each allocates, and first reads the changes of the domain since the context's last
/// query.
///
/// # Errors
/// [`Error::Name`](crate::Error::Name): the name of a topic or a service is not valid. [`Error::Transport`](crate::Error::Transport): the
/// domain's topics cannot be listed, or the thread of [`graph_events`](Self::graph_events), one for all of a context, cannot be started.
///
/// ```
/// use futures::executor::block_on;
/// use tautline::{Context, Node, Qos, Realtime, std_msgs::msg::String as Text};
///
/// let ctx = Context::builder().domain(108).realtime(Realtime::Off).build()?;
/// let mut talker = Node::create(ctx.clone(), "talker", "/robot")?;
/// let listener = Node::create(ctx, "listener", "/robot")?;
/// let found = listener.wait_for_publishers("chatter", 1)?;
/// let _publisher = talker.create_publisher::<Text>("chatter", Qos::default())?;
/// block_on(found)?;
///
/// assert_eq!(listener.get_node_names()?, ["/robot/listener", "/robot/talker"]);
/// assert_eq!(listener.get_topic_names_and_types()?["/robot/chatter"], ["std_msgs/msg/String"]);
/// let publishers = listener.get_publishers_info_by_topic("chatter")?;
/// assert_eq!(publishers[0].node_name, "talker");
/// # Ok::<(), tautline::Error>(())
/// ```
impl Node {
    pub(crate) fn graph(&self) -> Result<Arc<GraphSnapshot>> {
        Ok(self.participant.graph()?)
    }

    /// The fully qualified names of the domain's nodes, sorted by namespace. A name of two nodes is listed twice.
    pub fn get_node_names(&self) -> Result<Vec<String>> {
        Ok(self.graph()?.nodes.iter().map(|node| node.name.full_name()).collect())
    }

    /// The names of the domain's nodes with their namespaces, sorted by namespace.
    pub fn get_node_names_and_namespaces(&self) -> Result<Vec<(String, String)>> {
        let names = |node: &Arc<NodeInfo>| (node.name.name.clone(), node.name.namespace.clone());
        Ok(self.graph()?.nodes.iter().map(names).collect())
    }

    /// The domain's topics with their types.
    pub fn get_topic_names_and_types(&self) -> Result<HashMap<String, Vec<String>>> {
        Ok(topics(&*self.graph()?, |_| true))
    }

    /// The domain's services that have a server, with their types.
    pub fn get_service_names_and_types(&self) -> Result<HashMap<String, Vec<String>>> {
        Ok(services(&*self.graph()?, ServiceKind::Server, |_| true))
    }

    /// The domain's actions that have a server, with their types.
    pub fn get_action_names_and_types(&self) -> Result<HashMap<String, Vec<String>>> {
        let mut found: HashMap<String, Vec<String>> = HashMap::new();
        for (service, types) in self.get_service_names_and_types()? {
            let Some(action) = service.strip_suffix("/_action/send_goal") else { continue };
            let types = types.iter().filter_map(|name| name.strip_suffix("_SendGoal"));
            found.insert(action.into(), types.map(Into::into).collect());
        }
        Ok(found)
    }

    /// The topics that a node publishes, with their types.
    pub fn get_publisher_names_and_types_by_node(
        &self,
        node_name: &str,
        node_namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        self.topics_of(EndpointKind::Publisher, node_name, node_namespace)
    }

    /// The topics that a node subscribes to, with their types.
    pub fn get_subscriber_names_and_types_by_node(
        &self,
        node_name: &str,
        node_namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        self.topics_of(EndpointKind::Subscription, node_name, node_namespace)
    }

    /// The services of which a node has a server, with their types.
    pub fn get_service_names_and_types_by_node(
        &self,
        node_name: &str,
        node_namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        self.services_of(ServiceKind::Server, node_name, node_namespace)
    }

    /// The services of which a node has a client, with their types.
    pub fn get_client_names_and_types_by_node(
        &self,
        node_name: &str,
        node_namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        self.services_of(ServiceKind::Client, node_name, node_namespace)
    }

    fn topics_of(
        &self,
        kind: EndpointKind,
        name: &str,
        namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        let node = NodeName { namespace: namespace.into(), name: name.into() };
        Ok(topics(&*self.graph()?, |end| end.kind == kind && end.node.as_ref() == Some(&node)))
    }

    fn services_of(
        &self,
        kind: ServiceKind,
        name: &str,
        namespace: &str,
    ) -> Result<HashMap<String, Vec<String>>> {
        let node = NodeName { namespace: namespace.into(), name: name.into() };
        Ok(services(&*self.graph()?, kind, |of| of == Some(&node)))
    }

    /// The publishers of a topic.
    pub fn get_publishers_info_by_topic(&self, topic_name: &str) -> Result<Vec<TopicEndpointInfo>> {
        self.ends(topic_name, EndpointKind::Publisher)
    }

    /// The subscriptions of a topic.
    pub fn get_subscriptions_info_by_topic(&self, topic_name: &str) -> Result<Vec<TopicEndpointInfo>> {
        self.ends(topic_name, EndpointKind::Subscription)
    }

    fn ends(&self, topic: &str, kind: EndpointKind) -> Result<Vec<TopicEndpointInfo>> {
        let topic = self.resolve_topic_name(topic)?;
        let graph = self.graph()?;
        let ends = graph.endpoints.iter().filter(|end| end.topic == topic && end.kind == kind);
        Ok(ends.map(|end| TopicEndpointInfo::from(&**end)).collect())
    }

    /// The number of publishers of a topic.
    pub fn count_publishers(&self, topic_name: &str) -> Result<usize> {
        Ok(count(&*self.graph()?, &self.resolve_topic_name(topic_name)?, EndpointKind::Publisher))
    }

    /// The number of subscriptions of a topic.
    pub fn count_subscribers(&self, topic_name: &str) -> Result<usize> {
        Ok(count(&*self.graph()?, &self.resolve_topic_name(topic_name)?, EndpointKind::Subscription))
    }

    /// A stream that yields an item when something in the domain has appeared or disappeared since its last item,
    /// or since the stream was created, and when an endpoint of this context has been connected or disconnected.
    pub fn graph_events(&self) -> Result<GraphEvents> {
        Ok(self.participant.graph_events()?)
    }

    /// Waits until there is a node with this fully qualified name. Like the other waiting futures, it checks only when the
    /// graph changes, borrows nothing from the node, and stops waiting when it is dropped. The check allocates: it is not for
    /// callbacks with deadlines.
    pub fn wait_for_node(
        &self,
        fully_qualified_node_name: &str,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        let wanted = fully_qualified_node_name.to_owned();
        self.wait_until(move |graph| graph.nodes.iter().any(|node| node.name.full_name() == wanted))
    }

    /// Waits until the service has a server.
    pub fn wait_for_service(
        &self,
        service_name: &str,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        let wanted = self.resolve_service_name(service_name)?;
        let is_wanted = move |graph: &GraphSnapshot| {
            graph.services.iter().any(|end| end.kind == ServiceKind::Server && end.name == wanted)
        };
        self.wait_until(is_wanted)
    }

    /// Waits until a topic has at least `count` publishers.
    pub fn wait_for_publishers(
        &self,
        topic_name: &str,
        count: usize,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        let topic = self.resolve_topic_name(topic_name)?;
        self.wait_until(move |graph| self::count(graph, &topic, EndpointKind::Publisher) >= count)
    }

    /// Waits until a topic has at least `count` subscriptions.
    pub fn wait_for_subscribers(
        &self,
        topic_name: &str,
        count: usize,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<>> {
        let topic = self.resolve_topic_name(topic_name)?;
        self.wait_until(move |graph| self::count(graph, &topic, EndpointKind::Subscription) >= count)
    }

    fn wait_until<F: Fn(&GraphSnapshot) -> bool + Send>(
        &self,
        is_it: F,
    ) -> Result<impl Future<Output = Result<()>> + Send + use<F>> {
        let participant = self.participant.clone();
        // Created before the first check, so that no later change is missed.
        let events = self.graph_events()?;
        Ok(wait(participant, events, is_it))
    }
}

async fn wait(
    participant: Participant,
    mut events: GraphEvents,
    is_it: impl Fn(&GraphSnapshot) -> bool + Send,
) -> Result<()> {
    while !is_it(&*participant.graph()?) {
        // The stream does not end, because the participant is alive.
        events.next().await;
    }
    Ok(())
}

impl From<&TopicEndpoint> for TopicEndpointInfo {
    fn from(end: &TopicEndpoint) -> Self {
        let unknown = || NodeName { namespace: UNKNOWN_NAMESPACE.into(), name: UNKNOWN_NAME.into() };
        let node = end.node.clone().unwrap_or_else(unknown);
        TopicEndpointInfo {
            node_name: node.name,
            node_namespace: node.namespace,
            topic_type: end.topic_type.name.to_string(),
            topic_type_hash: end.topic_type.hash.as_deref().map(Into::into),
            endpoint_gid: end.gid.0,
            qos: end.qos,
            pid: end.pid,
            is_remote: end.is_remote,
        }
    }
}

fn topics(graph: &GraphSnapshot, is_meant: impl Fn(&TopicEndpoint) -> bool) -> HashMap<String, Vec<String>> {
    let ends = graph.endpoints.iter().filter(|end| is_meant(end));
    names_and_types(ends.map(|end| (&*end.topic, &*end.topic_type.name)))
}

fn services(
    graph: &GraphSnapshot,
    kind: ServiceKind,
    is_meant: impl Fn(Option<&NodeName>) -> bool,
) -> HashMap<String, Vec<String>> {
    let ends = graph.services.iter().filter(|end| end.kind == kind && is_meant(end.node.as_ref()));
    names_and_types(ends.map(|end| (&*end.name, &*end.type_name)))
}

fn names_and_types<'a>(found: impl Iterator<Item = (&'a str, &'a str)>) -> HashMap<String, Vec<String>> {
    let mut map: HashMap<String, Vec<String>> = HashMap::new();
    for (name, type_name) in found {
        let types = map.entry(name.into()).or_default();
        if !types.iter().any(|known| known == type_name) {
            types.push(type_name.into());
        }
    }
    map
}

fn count(graph: &GraphSnapshot, topic: &str, kind: EndpointKind) -> usize {
    graph.endpoints.iter().filter(|end| end.topic == topic && end.kind == kind).count()
}
