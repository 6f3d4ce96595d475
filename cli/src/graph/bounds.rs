// SPDX-License-Identifier: MIT OR Apache-2.0
//! Bounds of the running nodes from a system file.

use super::picture::{Bound, Chain, EdgeKind, Picture};
use std::collections::{BTreeMap, BTreeSet};
use tautline_analysis::file::{CheckedCallback, CheckedSystem};
use tautline_transport::GraphSnapshot;

/// Everything that runs, including nodes that are not shown.
pub struct Running {
    nodes: BTreeSet<String>,
    topics: BTreeSet<String>,
    /// The processes that run a callback of this name.
    callbacks: BTreeMap<String, BTreeSet<u32>>,
}

impl Running {
    pub fn new(graph: &GraphSnapshot, callbacks: BTreeMap<String, BTreeSet<u32>>) -> Self {
        let nodes = graph.nodes.iter().map(|node| node.name.full_name()).collect();
        let topics = graph.endpoints.iter().map(|end| bare(&end.topic).to_owned()).collect();
        Running { nodes, topics, callbacks }
    }

    fn has_node(&self, name: &str) -> bool {
        self.nodes.iter().any(|full| is_called(full, name))
    }

    /// Whether a callback belongs to this node: by the node's name, or by the process that runs it if no node has the name in the file,
    /// because a file's nodes are processes.
    fn is_of(&self, callback: &CheckedCallback, name: Option<&str>, pid: Option<u32>) -> bool {
        let entry = &callback.entry;
        match self.has_node(&entry.node) {
            true => name.is_some_and(|name| is_called(name, &entry.node)),
            false => pid.zip(self.callbacks.get(&entry.name)).is_some_and(|(pid, pids)| pids.contains(&pid)),
        }
    }
}

fn bare(name: &str) -> &str {
    name.trim_start_matches('/')
}

/// Whether a name, with or without a namespace, is that of a node.
fn is_called(full: &str, name: &str) -> bool {
    bare(full) == bare(name) || full.rsplit('/').next() == Some(name)
}

/// Adds bounds to the edges that trigger callbacks, and chains to the caption. Lists nodes and topics of the file that do not run.
pub fn add(picture: &mut Picture, checked: &CheckedSystem, running: &Running) -> Vec<String> {
    let (nodes, topics) = (&picture.nodes, &picture.topics);
    for edge in picture.edges.iter_mut().filter(|edge| edge.kind == EdgeKind::Subscribes) {
        let (node, topic) = (&nodes[edge.node], bare(&topics[edge.topic].name));
        let triggered = checked.callbacks.iter().filter(|callback| {
            let mut triggers = callback.entry.topics.iter();
            triggers.any(|trigger| bare(trigger) == topic)
                && running.is_of(callback, node.name.as_deref(), node.pid)
        });
        edge.bound = worst(&triggered.collect::<Vec<_>>());
    }
    picture.chains = checked
        .chains
        .iter()
        .map(|chain| Chain {
            name: chain.name.clone(),
            latency_ns: chain.latency_ns,
            deadline_ns: chain.deadline_ns,
            met: chain.met,
        })
        .collect();
    absent(checked, running)
}

fn worst(callbacks: &[&CheckedCallback]) -> Option<Bound> {
    let worst = callbacks.iter().max_by_key(|callback| {
        let response = callback.response_overhead_ns;
        (!callback.met, response.is_none(), response)
    })?;
    Some(Bound {
        callbacks: callbacks.iter().map(|callback| callback.entry.name.clone()).collect(),
        response_ns: worst.response_overhead_ns,
        deadline_ns: worst.entry.deadline_ns,
        met: worst.met,
    })
}

fn absent(checked: &CheckedSystem, running: &Running) -> Vec<String> {
    let mut found = BTreeSet::new();
    for callback in &checked.callbacks {
        let entry = &callback.entry;
        let of_node = checked.callbacks.iter().filter(|other| other.entry.node == entry.node);
        let mut of_node = of_node.map(|other| &other.entry.name);
        if !running.has_node(&entry.node) && !of_node.any(|name| running.callbacks.contains_key(name)) {
            found.insert(format!("node '{}' of the system file does not run", entry.node));
        }
        for topic in entry.topics.iter().filter(|topic| !running.topics.contains(bare(topic))) {
            found
                .insert(format!("topic '{topic}', which triggers callback '{}', does not exist", entry.name));
        }
    }
    found.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::super::picture::{Edge, Node, Rate, Topic, TopicKind};
    use super::*;
    use tautline_analysis::file::SystemFile;

    /// Two nodes in two processes that subscribe to one topic.
    fn picture() -> Picture {
        let node = |name: &str, pid| Node { name: Some(name.into()), pid: Some(pid), place: None };
        let scan =
            Topic { kind: TopicKind::Topic, name: "/scan".into(), types: Vec::new(), rate: Rate::None };
        let edge = |node| Edge {
            kind: EdgeKind::Subscribes,
            node,
            topic: 0,
            count: 1,
            qos: String::new(),
            rate: Rate::None,
            problem: None,
            bound: None,
        };
        let nodes = vec![node("/robot/slam", 7), node("/robot/other", 8)];
        Picture { nodes, topics: vec![scan], edges: vec![edge(0), edge(1)], ..Picture::default() }
    }

    fn running(nodes: &[&str]) -> Running {
        Running {
            nodes: nodes.iter().map(|node| (*node).to_owned()).collect(),
            topics: ["scan".to_owned()].into(),
            callbacks: [("map".to_owned(), [7].into())].into(),
        }
    }

    fn bounds(node: &str, wcet: &str, nodes: &[&str]) -> (Vec<Option<String>>, Vec<String>) {
        let text = format!(
            "[hosts.a]\ncores = 1\n[nodes.{node}]\n[topics]\nscan = {{ period = \"10ms\" }}\n[callbacks]\n\
             map = {{ topic = \"scan\", wcet = \"{wcet}\" }}\nlocate = {{ topic = \"scan\", wcet = \"1ms\" }}\n\
             [[chains]]\nname = \"all\"\npath = [\"map\"]\ndeadline = \"10ms\"\n"
        );
        let (mut picture, checked) = (picture(), SystemFile::parse(&text).unwrap().check());
        let absent = add(&mut picture, &checked, &running(nodes));
        assert_eq!(picture.chains.len(), 1);
        (picture.edges.iter().map(|edge| Some(edge.bound.as_ref()?.text())).collect(), absent)
    }

    #[test]
    fn the_worst_callback_of_the_node_counts() {
        let all = ["/robot/slam", "/robot/other"];
        let (by_name, absent) = bounds("slam", "2ms", &all);
        assert!(by_name[0].as_ref().is_some_and(|text| text.starts_with("≤ 3.")), "{by_name:?}");
        assert!(by_name[1].is_none() && absent.is_empty());
        // No node has this name, so the process that runs the callback decides.
        let (by_process, absent) = bounds("robot", "2ms", &all);
        assert!(by_process[0].as_ref().is_some_and(|text| text.starts_with("≤ ")), "{by_process:?}");
        assert!(by_process[1].is_none() && absent.is_empty());
        let (too_much, _) = bounds("slam", "9500us", &all);
        assert_eq!(too_much[0].as_deref(), Some("no bound"));
    }
}
