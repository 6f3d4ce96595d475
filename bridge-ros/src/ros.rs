// SPDX-License-Identifier: MIT OR Apache-2.0
//! The ROS 2 graph as the other side of a mirror.

use crate::incoming::{self, Incoming};
use crate::options::Options;
use crate::outgoing::{Ros, Writer};
use crate::rcl::{Node, RosPublisher, RosSubscription};
use crate::ros_graph::{self, RosGraph};
use crate::services::{Nodes, RosServices};
use crate::shown::ShownNodes;
use crate::stats::{BridgeState, IncompatibleQos, ServiceNames, Stats, TopicNames};
use crate::table::{OriginTable, OwnTable, Tables};
use crate::types::Types;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_relay::{
    Delivery, Direction, FarGraph, FarSide, FarWriter, FoundType, InKey, Ingress, IngressUpdate, Inward,
    LocalGraph, Publisher, Report, Rules, Side, TopicKey, Transit, Writers, process_node,
};
use tautline_transport::{
    Claim, EndpointKind, Gid, Limits, NodeName, Participant, Qos, RawPublisher, RemoteGraph, RemoteNode,
    ServiceEndpoint, ServiceKind, TopicEndpoint, TopicType, TransportError,
};

/// Maximum of nodes of other hosts that are shown in ROS: a network can announce any number.
const MOST_SHOWN: usize = 1024;

pub(crate) struct RosSide {
    /// Tautline's domain, for tags.
    domain: u64,
    node: Arc<Node>,
    types: Types,
    incoming: Incoming,
    rules: Rules,
    service_rules: Rules,
    state: Arc<BridgeState>,
    graph: RosGraph,
    endpoint_count: usize,
    tables: Tables,
    own_table: OwnTable,
    /// The ROS domain's name for users.
    place: String,
    shown: ShownNodes,
}

/// A publisher in ROS that mirrors one of the domain.
pub(crate) struct ProxyPublisher {
    writer: Writer,
    incompatible: Option<Incompatible>,
}

impl FarWriter for ProxyPublisher {
    fn is_matched(&self) -> bool {
        self.writer.publisher.subscription_count() > 0
    }

    /// False while the relay's thread may still publish through it.
    fn is_settled(&self) -> bool {
        Arc::strong_count(&self.writer.publisher) == 1 && self.writer.publisher.are_all_acknowledged()
    }
}

/// Endpoints in ROS that are QoS-incompatible with a publisher.
#[derive(Clone, Copy)]
struct Incompatible {
    count: u64,
    last_policy: &'static str,
    since: Instant,
}

impl RosSide {
    /// Creates the side, and the transit between both sides.
    pub(crate) fn new(
        options: &Options,
        participant: &Participant,
        node: Arc<Node>,
        incoming: Incoming,
        (tables, own_table): (Tables, OwnTable),
        state: Arc<BridgeState>,
    ) -> (Self, Transit) {
        let (domain, own) = (participant.domain_id(), participant.id());
        let host = tautline_rt::host::name();
        let place = format!("ros{}_{host}", node.context().domain());
        let transit = Transit::to_ros(domain, own, own.into(), &host).going_on(options.transit);
        let side = RosSide {
            domain,
            node,
            types: Types::new(),
            incoming,
            rules: options.rules.clone(),
            service_rules: options.services.clone(),
            state,
            graph: RosGraph::default(),
            endpoint_count: 0,
            tables,
            own_table,
            place,
            shown: ShownNodes::default(),
        };
        (side, transit)
    }

    /// Services and clients in ROS, without this bridge's, each with its announcer.
    fn read_services(&mut self, here: &LocalGraph) -> Vec<(ServiceEndpoint, u128)> {
        let others = self.graph.nodes.iter().map(|(node, _)| node).filter(|node| !self.shown.has(node));
        let mut ends = ros_graph::services(&self.node, others, &self.place);
        let tables = &self.graph.tables;
        let told = || {
            let of = |table: &Arc<OriginTable>| u128::from(table.bridge);
            tables.iter().flat_map(move |table| table.graph.services.iter().map(move |end| (end, of(table))))
        };
        // Servers of other bridges have the names of the nodes that they mirror.
        let servers = told().filter(|(end, _)| end.kind == ServiceKind::Server);
        let servers: BTreeSet<_> = servers.map(|(end, _)| (&*end.name, end.node.as_ref())).collect();
        ends.retain(|end| !servers.contains(&(&*end.name, end.node.as_ref())));
        let names: BTreeSet<String> = match tables.is_empty() {
            // Other bridges identify a server by the GID of its request endpoint.
            false => ends.iter().map(|end| end.name.clone()).collect(),
            // Without other bridges, the node's name identifies a server.
            true => {
                let asked = here.services.iter().filter(|end| end.kind == ServiceKind::Client);
                let asked = asked.filter_map(|end| Some(self.service_rules.choice(&end.name)?.far_topic));
                asked.collect()
            }
        };
        for name in names {
            let found = self.node.servers(&name).unwrap_or_default();
            ros_graph::identify(&mut ends, &name, &found);
        }
        for end in &mut ends {
            end.type_hash = self.types.service_hash(&end.type_name);
        }
        ros_graph::mark(&mut ends, self.domain, self.graph.tables.is_empty());
        let told = told().map(|(end, bridge)| (end.clone(), bridge));
        ends.into_iter().map(|end| (end, 0)).chain(told).collect()
    }
}

impl FarSide for RosSide {
    const SIDE: Side = Side::Ros;
    const DELIVERY: Delivery = incoming::DELIVERY;
    type Event = ();
    type Egress = Ros;
    type Writer = ProxyPublisher;
    type Services = RosServices;
    const PATIENCE: Option<Duration> = None;

    fn handle(&mut self, (): ()) -> bool {
        true
    }

    fn read_graph(&mut self, here: &LocalGraph) -> Result<FarGraph, String> {
        self.graph.read(&self.node, &self.place, &self.tables).map_err(|error| error.to_string())?;
        self.endpoint_count = self.graph.endpoints.len();
        Ok(FarGraph {
            nodes: self.graph.others(&self.shown.in_ros(), self.domain, &self.place),
            services: self.read_services(here),
            endpoints: std::mem::take(&mut self.graph.endpoints),
            publishers: std::mem::take(&mut self.graph.publishers),
            ended: BTreeSet::new(),
        })
    }

    fn prepare(&mut self, _: &mut LocalGraph, _: &Transit) {}

    fn update_services(&mut self, here: &LocalGraph, transit: &Transit) -> Nodes {
        let announced = here.nodes.iter().filter(|node| transit.announced(&node.origin).is_some());
        let (own, others): (Vec<_>, Vec<_>) = announced.partition(|node| node.origin.is_here());
        let shown = own.into_iter().chain(others.into_iter().take(MOST_SHOWN));
        self.shown.update(&self.node, shown.map(|node| &node.name));
        self.service_context()
    }

    fn service_context(&self) -> Nodes {
        self.shown.by_name()
    }

    /// Announces to other bridges of the ROS domain what this bridge's endpoints mirror.
    fn announce(&mut self, here: &LocalGraph, transit: &Transit, writers: &Writers<ProxyPublisher>) {
        let announced = |origin| transit.announced(origin);
        let mut processes = HashMap::new();
        let mut of_node = |node: &Option<NodeName>, pid: Option<u32>| {
            let process = || processes.entry(pid).or_insert_with(|| process_node(pid)).clone();
            Some(node.clone().unwrap_or_else(process))
        };
        let stand_ins: BTreeMap<Gid, Gid> =
            writers.iter().map(|(_, gid, proxy)| (gid, proxy.writer.publisher.gid())).collect();
        let mut graph = RemoteGraph::default();
        graph.nodes.extend(here.nodes.iter().filter_map(|node| {
            let (name, enclave) = (node.name.clone(), node.enclave.clone());
            Some(RemoteNode { name, enclave, origin: announced(&node.origin)? })
        }));
        for end in &here.endpoints {
            let (gid, way) = match end.kind {
                EndpointKind::Publisher => (stand_ins.get(&end.gid).copied(), Direction::Out),
                EndpointKind::Subscription => (Some(end.gid), Direction::In),
            };
            let choice = self.rules.choice(&end.topic).filter(|choice| choice.allows(way));
            let (Some(origin), Some(gid), Some(choice)) = (announced(&end.origin), gid, choice) else {
                continue;
            };
            let (topic, node) = (choice.far_topic, of_node(&end.node, end.pid));
            graph.endpoints.push(TopicEndpoint { topic, gid, node, origin, ..(**end).clone() });
        }
        for end in &here.services {
            let way = match end.kind {
                ServiceKind::Server => Direction::Out,
                ServiceKind::Client => Direction::In,
            };
            let choice = self.service_rules.choice(&end.name).filter(|choice| choice.allows(way));
            let (Some(origin), Some(choice)) = (announced(&end.origin), choice) else { continue };
            let (name, node) = (choice.far_topic, of_node(&end.node, end.pid));
            graph.services.push(ServiceEndpoint { name, node, origin, ..(**end).clone() });
        }
        if let Err(reason) = self.own_table.publish(OriginTable { bridge: here.own, graph }) {
            tracing::warn!("endpoints are not announced to other bridges of the ROS domain: {reason}");
        }
    }

    fn tick(&mut self, writers: &mut Writers<ProxyPublisher>) -> bool {
        look_for_incompatible(writers);
        self.graph.has_unknown()
    }

    fn find_type(&mut self, key: &TopicKey, hash: Option<&str>) -> Result<FoundType, String> {
        let found = self.types.find(&key.type_name, hash).map_err(|error| error.to_string())?;
        Ok(FoundType { topic_type: found.topic_type(), schema: Some(found.schema) })
    }

    fn open_writer(&mut self, key: &TopicKey, publisher: &Publisher) -> Result<ProxyPublisher, String> {
        let found = self.types.find(&key.type_name, publisher.type_hash.as_deref());
        let found = found.map_err(|error| error.to_string())?;
        let made = RosPublisher::new(&self.node, &key.far_topic, &found.support, &publisher.qos);
        let publisher = Arc::new(made.map_err(|error| error.to_string())?);
        Ok(ProxyPublisher { writer: Writer { publisher, last: Arc::default() }, incompatible: None })
    }

    fn sender(&mut self, _: &TopicKey, proxy: &ProxyPublisher) -> Result<Writer, String> {
        Ok(proxy.writer.clone())
    }

    fn port(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        offered: Qos,
    ) -> Result<RawPublisher, TransportError> {
        // Messages of other types have no known length before they arrive, so memory claimed ahead would be a guess.
        let claim = if topic_type.body_bytes.is_some() { Claim::Ahead } else { Claim::OnUse };
        participant.create_raw_publisher(topic, topic_type, offered, Limits { claim, ..Limits::default() })
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward, ingress: Ingress) -> Result<(), String> {
        let found = self.types.find(&key.topic.type_name, inward.type_hash.as_deref());
        let support = found.map_err(|error| error.to_string())?.support;
        let subscription = RosSubscription::new(&self.node, &key.topic.far_topic, &support, &inward.qos);
        self.incoming.open(key.clone(), subscription.map_err(|error| error.to_string())?, ingress);
        Ok(())
    }

    fn change_in(&mut self, key: &InKey, change: IngressUpdate) {
        self.incoming.change(key.clone(), change);
    }

    fn stop_in(&mut self, key: &InKey) {
        self.incoming.close(key.clone());
    }

    fn announced_gid(end: &ServiceEndpoint) -> Gid {
        ros_graph::announced_gid(end.origin.tag)
    }

    fn report(&mut self, report: Report, writers: &Writers<ProxyPublisher>) {
        let before = self.state.stats.get();
        let services = report.services.into_iter().map(|service| service.named(ServiceNames::of, Into::into));
        let incompatible = writers.iter().filter_map(|(key, _, end)| Some((&*key.topic, end.incompatible?)));
        let topics = report.topics.into_iter().map(|topic| topic.named(TopicNames::of, Into::into));
        self.state.stats.set(Stats {
            domain: before.domain,
            ros_domain: before.ros_domain,
            rmw: before.rmw.clone(),
            uptime_s: report.uptime_s,
            ros_nodes: self.graph.nodes.len(),
            ros_endpoints: self.endpoint_count,
            not_bridged: report.problems,
            incompatible_qos: by_topic(incompatible),
            topics: topics.collect(),
            services_not_bridged: report.service_problems,
            services: services.collect(),
            ..Stats::default()
        });
    }
}

/// Stores and logs the event that ROS raises for each QoS-incompatible endpoint.
fn look_for_incompatible(writers: &mut Writers<ProxyPublisher>) {
    for (key, proxy) in writers.iter_mut() {
        let Some((count, policy)) = proxy.writer.publisher.incompatible() else { continue };
        tracing::warn!(
            "topic '{}': QoS-incompatible endpoints in ROS and Tautline (last policy: {policy}) exchange no messages: \
             change one of them, or set qos.{policy} of the topic in the configuration",
            key.far_topic
        );
        let since = Instant::now();
        proxy.incompatible = Some(Incompatible { count, last_policy: policy, since });
    }
}

/// Sums up the incompatible endpoints of all present publishers of a topic.
fn by_topic<'t>(ends: impl Iterator<Item = (&'t str, Incompatible)>) -> BTreeMap<String, IncompatibleQos> {
    let mut topics: BTreeMap<&str, Incompatible> = BTreeMap::new();
    for (topic, end) in ends {
        let all = topics.entry(topic).or_insert(Incompatible { count: 0, ..end });
        let count = all.count + end.count;
        let last = if end.since > all.since { end } else { *all };
        *all = Incompatible { count, ..last };
    }
    let told = |(topic, all): (&str, Incompatible)| {
        (topic.to_owned(), IncompatibleQos { count: all.count, last_policy: all.last_policy.to_owned() })
    };
    topics.into_iter().map(told).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_that_do_not_fit_are_those_of_all_publishers_of_a_topic() {
        let start = Instant::now();
        let end = |count, last_policy, after_s| Incompatible {
            count,
            last_policy,
            since: start + Duration::from_secs(after_s),
        };
        let ends =
            [("/x", end(2, "reliability", 5)), ("/x", end(3, "deadline", 1)), ("/y", end(1, "deadline", 2))];
        let told = by_topic(ends.into_iter());
        let of = |topic: &str| (told[topic].count, &*told[topic].last_policy);
        assert_eq!((of("/x"), of("/y")), ((5, "reliability"), (1, "deadline")));
    }
}
