// SPDX-License-Identifier: MIT OR Apache-2.0
//! Output as JSON for scripts. Names and units do not change.

use super::picture::{Bound, Chain, Edge, Mismatch, Node, Picture, Rate, Topic};
use crate::times::ms;
use serde_json::{Value, json};

impl Picture {
    /// Edges name their endpoints, and give the node by its index, because several nodes may have the same name.
    pub fn to_json(&self) -> Value {
        let node = |(id, node): (usize, &Node)| json!({ "id": id, "name": node.name, "pid": node.pid, "place": node.place });
        let topic = |topic: &Topic| {
            json!({
                "name": topic.name,
                "kind": topic.kind.word(),
                "types": topic.types,
                "rate_hz": hz(topic.rate),
            })
        };
        let bound = |bound: &Bound| {
            json!({
                "callbacks": bound.callbacks,
                "response_ms": bound.response_ns.map(ms),
                "deadline_ms": ms(bound.deadline_ns),
                "met": bound.met,
            })
        };
        let edge = |edge: &Edge| {
            json!({
                "kind": edge.kind.word(),
                "node": edge.node,
                "node_name": self.nodes[edge.node].name,
                "topic": self.topics[edge.topic].name,
                "count": edge.count,
                "qos": (!edge.is_service()).then_some(&edge.qos),
                "rate_hz": hz(edge.rate),
                "problem": edge.problem,
                "bound": edge.bound.as_ref().map(bound),
            })
        };
        let mismatch = |found: &Mismatch| {
            let Mismatch { topic, publisher, subscription, reason } = found;
            json!({ "topic": topic, "publisher": publisher, "subscription": subscription, "reason": reason })
        };
        let chain = |chain: &Chain| {
            let (latency, deadline) = (chain.latency_ns.map(ms), ms(chain.deadline_ns));
            json!({ "name": chain.name, "latency_ms": latency, "deadline_ms": deadline, "met": chain.met })
        };
        json!({
            "domain": self.domain,
            "seconds": self.seconds,
            "nodes": self.nodes.iter().enumerate().map(node).collect::<Value>(),
            "topics": self.topics.iter().map(topic).collect::<Value>(),
            "edges": self.edges.iter().map(edge).collect::<Value>(),
            "mismatches": self.mismatches.iter().map(mismatch).collect::<Value>(),
            "chains": self.chains.iter().map(chain).collect::<Value>(),
            "left_out": self.left_out,
        })
    }
}

fn hz(rate: Rate) -> Option<f64> {
    if let Rate::Hz(hz) = rate { Some(hz) } else { None }
}
