// SPDX-License-Identifier: MIT OR Apache-2.0
//! Publishers and subscriptions of one topic that are incompatible.

use tautline_transport::{EndpointKind, GraphSnapshot, QosPolicyKind, TopicEndpoint};

/// A publisher and a subscription of its topic whose QoS or types are incompatible.
pub struct Mismatch<'g> {
    pub publisher: &'g TopicEndpoint,
    pub subscription: &'g TopicEndpoint,
    /// The policy whose offer does not meet the request.
    policy: Option<QosPolicyKind>,
    types_differ: bool,
}

impl Mismatch<'_> {
    pub fn reason(&self) -> String {
        let policy =
            self.policy.map(|policy| format!("the offered {policy} does not meet the requested one"));
        let types = self.types_differ.then(|| "their types differ".to_owned());
        policy.into_iter().chain(types).collect::<Vec<_>>().join(", and ")
    }

    /// The reason in a few words.
    pub fn words(&self) -> String {
        let policy = self.policy.map(|policy| format!("QoS: {policy}"));
        let types = self.types_differ.then(|| "other type".to_owned());
        policy.into_iter().chain(types).collect::<Vec<_>>().join(", ")
    }
}

/// All incompatible pairs of a domain. Pairs whose endpoints are both on other hosts are checked there.
pub fn mismatches(graph: &GraphSnapshot) -> Vec<Mismatch<'_>> {
    let mut found = Vec::new();
    for topic in graph.endpoints.chunk_by(|one, other| one.topic == other.topic) {
        let of = |kind| topic.iter().filter(move |end| end.kind == kind);
        for publisher in of(EndpointKind::Publisher) {
            for subscription in of(EndpointKind::Subscription) {
                if publisher.is_remote && subscription.is_remote {
                    continue;
                }
                let policy = publisher.qos.incompatibility(&subscription.qos);
                let types_differ = !publisher.topic_type.agrees_with(&subscription.topic_type);
                if policy.is_some() || types_differ {
                    found.push(Mismatch { publisher, subscription, policy, types_differ });
                }
            }
        }
    }
    found
}

/// The name of the endpoint's node, or the endpoint's identifier if it has no node.
pub fn label(end: &TopicEndpoint) -> String {
    end.node.as_ref().map_or_else(|| format!("{:?}", end.gid), |node| node.full_name())
}
