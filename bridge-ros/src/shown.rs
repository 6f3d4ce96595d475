// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of the domain, for ROS's tools to list.

use crate::rcl::Node;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};
use tautline_transport::NodeName;

#[derive(Default)]
pub(crate) struct ShownNodes {
    /// Those that could not be made in ROS too, which is said once.
    nodes: BTreeMap<NodeName, Option<Arc<Node>>>,
    /// Those of nodes that have gone, as long as a service holds them.
    gone: Vec<(NodeName, Weak<Node>)>,
}

impl ShownNodes {
    /// Shows these nodes, and no others any longer than their services last. `own` is the bridge's.
    pub(crate) fn update<'n>(&mut self, own: &Node, wanted: impl Iterator<Item = &'n NodeName>) {
        let wanted: BTreeSet<&NodeName> = wanted.collect();
        self.gone.retain(|(_, node)| node.strong_count() > 0);
        self.nodes.retain(|name, node| {
            let stays = wanted.contains(name);
            if let (false, Some(node)) = (stays, node) {
                self.gone.push((name.clone(), Arc::downgrade(node)));
            }
            stays
        });
        for name in wanted {
            if !self.nodes.contains_key(name) {
                let node = Node::new(own.context(), &name.name, &name.namespace);
                let node =
                    node.inspect_err(|error| tracing::warn!("node {name} is not shown in ROS: {error}"));
                self.nodes.insert(name.clone(), node.ok());
            }
        }
    }

    /// Those that stand in ROS for Tautline's that are there.
    pub(crate) fn by_name(&self) -> BTreeMap<NodeName, Arc<Node>> {
        self.nodes.iter().filter_map(|(name, node)| Some((name.clone(), node.clone()?))).collect()
    }

    /// Whether a node in ROS bears the name of one of them.
    pub(crate) fn has(&self, name: &NodeName) -> bool {
        self.nodes.contains_key(name) || self.held().any(|held| held == name)
    }

    /// What they are in ROS.
    pub(crate) fn in_ros(&self) -> Vec<NodeName> {
        let made = self.nodes.iter().filter(|(_, node)| node.is_some()).map(|(name, _)| name);
        made.chain(self.held()).cloned().collect()
    }

    /// Nodes that have gone here and stand in ROS until their services have ended.
    fn held(&self) -> impl Iterator<Item = &NodeName> {
        self.gone.iter().filter(|(_, node)| node.strong_count() > 0).map(|(name, _)| name)
    }
}
