// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is told on either side of what is on the other one: other bridges, the domain; and what others tell.

use super::Control;
use crate::ros_graph;
use crate::rules::Direction;
use crate::table::Table;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use tautline_relay::process_node;
use tautline_transport::{
    EndpointKind, Gid, GraphSnapshot, NodeName, RemoteGraph, RemoteNode, ServiceEndpoint, ServiceKind,
    TopicEndpoint,
};

impl Control {
    /// Takes in what others tell of, on both sides.
    pub(super) fn weigh(
        &mut self,
        here: &GraphSnapshot,
        nodes: &[(RemoteNode, u128)],
        services: &[(ServiceEndpoint, u128)],
    ) {
        let transit = &mut self.transit;
        transit.set_rivals(&here.rivals);
        transit.clear();
        nodes.iter().for_each(|(node, teller)| transit.insert(&node.origin, *teller));
        self.graph.endpoints.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
        services.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
    }

    /// Those of ROS, but for this bridge's, with who tells of them.
    pub(super) fn read_services(&mut self, here: &GraphSnapshot) -> Vec<(ServiceEndpoint, u128)> {
        let others = self.graph.nodes.iter().filter(|node| !self.shown.has(node));
        let mut ends = ros_graph::services(&self.node, others, &self.place);
        let tables = &self.graph.tables;
        let told = || {
            let of = |table: &Arc<Table>| u128::from(table.bridge);
            tables.iter().flat_map(move |table| table.graph.services.iter().map(move |end| (end, of(table))))
        };
        // Servers of other bridges bear the names of the nodes that they stand for.
        let servers = told().filter(|(end, _)| end.kind == ServiceKind::Server);
        let servers: BTreeSet<_> = servers.map(|(end, _)| (&*end.name, end.node.as_ref())).collect();
        ends.retain(|end| !servers.contains(&(&*end.name, end.node.as_ref())));
        let names: BTreeSet<String> = match tables.is_empty() {
            // Other bridges know a server by where it takes requests.
            false => ends.iter().map(|end| end.name.clone()).collect(),
            // And without it one is known by its node's name alone.
            true => {
                let asked = here.services.iter().filter(|end| end.kind == ServiceKind::Client);
                let asked = asked.filter_map(|end| Some(self.service_rules.choice(&end.name)?.ros_topic));
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
        ros_graph::mark(&mut ends, self.participant.domain_id(), self.graph.tables.is_empty());
        let told = told().map(|(end, bridge)| (end.clone(), bridge));
        ends.into_iter().map(|end| (end, 0)).chain(told).collect()
    }

    /// Other bridges of the ROS domain are told what this one's ends stand for.
    pub(super) fn tell_bridges(&mut self, here: &GraphSnapshot) {
        let own = Some(self.participant.id());
        let announced = |origin| self.transit.announced(origin);
        let mut processes = HashMap::new();
        let mut of_node = |node: &Option<NodeName>, pid: Option<u32>| {
            let process = || processes.entry(pid).or_insert_with(|| process_node(pid)).clone();
            Some(node.clone().unwrap_or_else(process))
        };
        let stand_ins: BTreeMap<Gid, Gid> = self.counterparts.gids().collect();
        let mut graph = RemoteGraph::default();
        let nodes = here.nodes.iter().filter(|node| node.teller != own);
        graph.nodes.extend(nodes.filter_map(|node| {
            Some(RemoteNode { name: node.name.clone(), origin: announced(&node.origin)? })
        }));
        for end in here.endpoints.iter().filter(|end| end.teller != own) {
            let (gid, way) = match end.kind {
                EndpointKind::Publisher => (stand_ins.get(&end.gid).copied(), Direction::ToRos),
                EndpointKind::Subscription => (Some(end.gid), Direction::FromRos),
            };
            let choice = self.mirror.rules().choice(&end.topic).filter(|choice| choice.goes(way));
            let (Some(origin), Some(gid), Some(choice)) = (announced(&end.origin), gid, choice) else {
                continue;
            };
            let (topic, node) = (choice.ros_topic, of_node(&end.node, end.pid));
            graph.endpoints.push(TopicEndpoint { topic, gid, node, origin, ..(**end).clone() });
        }
        for end in here.services.iter().filter(|end| end.teller != own) {
            let way = match end.kind {
                ServiceKind::Server => Direction::ToRos,
                ServiceKind::Client => Direction::FromRos,
            };
            let choice = self.service_rules.choice(&end.name).filter(|choice| choice.goes(way));
            let (Some(origin), Some(choice)) = (announced(&end.origin), choice) else { continue };
            let (name, node) = (choice.ros_topic, of_node(&end.node, end.pid));
            graph.services.push(ServiceEndpoint { name, node, origin, ..(**end).clone() });
        }
        if let Err(reason) = self.own_table.say(Table { bridge: self.participant.id(), graph }) {
            tracing::warn!("other bridges of this ROS domain are not told what this one carries: {reason}");
        }
    }

    /// Tautline's tools list what is in ROS.
    pub(super) fn show_ros(&self, nodes: &[(RemoteNode, u128)], services: Vec<(ServiceEndpoint, u128)>) {
        let mut remote = ros_graph::as_remote(&self.graph, nodes, self.mirror.rules(), &self.transit);
        let told = |(end, teller): (ServiceEndpoint, u128)| {
            let name = self.service_rules.tautline_name(&end.name)?;
            let origin = self.transit.told(&end.origin, teller)?;
            Some(ServiceEndpoint { name, gid: ros_graph::told_gid(origin.tag), origin, ..end })
        };
        remote.services = services.into_iter().filter_map(told).collect();
        if let Err(error) = self.participant.set_remote(&remote) {
            tracing::warn!("nodes and tools of this host do not see what ROS has: {error}");
        }
    }
}
