// SPDX-License-Identifier: MIT OR Apache-2.0
//! Nodes of the domain that ROS's tools list.

use crate::rcl::Node;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};
use tautline_transport::NodeName;

#[derive(Default)]
pub(crate) struct ShownNodes {
    /// `None`: the node could not be created in ROS, which is logged once.
    nodes: BTreeMap<NodeName, Option<Arc<Node>>>,
    /// Nodes that have ended here but are still held by a service.
    gone: Vec<(NodeName, Weak<Node>)>,
}

impl ShownNodes {
    /// Shows the `wanted` nodes, and others only while services hold them. `own` is the bridge's node.
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

    /// The nodes in ROS that mirror present nodes of Tautline.
    pub(crate) fn by_name(&self) -> BTreeMap<NodeName, Arc<Node>> {
        self.nodes.iter().filter_map(|(name, node)| Some((name.clone(), node.clone()?))).collect()
    }

    /// Whether one of these nodes has this name in ROS.
    pub(crate) fn has(&self, name: &NodeName) -> bool {
        self.nodes.contains_key(name) || self.held().any(|held| held == name)
    }

    /// The names of all these nodes in ROS.
    pub(crate) fn in_ros(&self) -> Vec<NodeName> {
        let made = self.nodes.iter().filter(|(_, node)| node.is_some()).map(|(name, _)| name);
        made.chain(self.held()).cloned().collect()
    }

    /// Nodes that have ended here and remain in ROS until their services have ended.
    fn held(&self) -> impl Iterator<Item = &NodeName> {
        self.gone.iter().filter(|(_, node)| node.strong_count() > 0).map(|(name, _)| name)
    }
}
