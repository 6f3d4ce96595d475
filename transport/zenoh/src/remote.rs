// SPDX-License-Identifier: MIT OR Apache-2.0
//! What other hosts have, in this host's terms: for the nodes and tools here.

use crate::wire::{Endpoint, EndpointKind, NodeName, Token, WireQos, endpoint_gid};
use std::collections::BTreeSet;
use tautline_transport::{
    EndpointKind::{Publisher, Subscription},
    Limits, Liveliness, Origin, Qos, RemoteGraph, RemoteNode, ServiceEndpoint, ServiceKind, TopicEndpoint,
    TopicType,
};

/// The same tokens are the same graph, in whatever order they come. `told` is how the domain is told of each, if it is; publishers with
/// one of the tags in `ended` have ended by themselves.
pub(crate) fn remote_graph(
    tokens: &[Token],
    told: impl Fn(&Token) -> Option<Origin>,
    ended: BTreeSet<u64>,
) -> RemoteGraph {
    let mut tokens: Vec<&Token> = tokens.iter().collect();
    tokens.sort_by_cached_key(|token| token.to_string());
    let mut graph = RemoteGraph { ended, ..RemoteGraph::default() };
    for token in tokens {
        let Some(origin) = told(token) else { continue };
        match &token.endpoint {
            None => graph.nodes.push(RemoteNode { name: node(&token.node), origin }),
            Some(end) => match end.kind {
                EndpointKind::Publisher => graph.endpoints.push(topic(Publisher, token, end, origin)),
                EndpointKind::Subscription => graph.endpoints.push(topic(Subscription, token, end, origin)),
                EndpointKind::Service => {
                    graph.services.push(service(ServiceKind::Server, token, end, origin));
                }
                EndpointKind::Client => {
                    graph.services.push(service(ServiceKind::Client, token, end, origin));
                }
            },
        }
    }
    graph
}

fn node(name: &NodeName) -> tautline_transport::NodeName {
    tautline_transport::NodeName { namespace: name.namespace.clone(), name: name.name.clone() }
}

fn topic(
    kind: tautline_transport::EndpointKind,
    token: &Token,
    end: &Endpoint,
    origin: Origin,
) -> TopicEndpoint {
    let topic_type = TopicType::new(end.type_id.name.to_string()).with_hash(end.type_id.hash.to_string());
    TopicEndpoint {
        kind,
        topic: end.name.clone(),
        topic_type,
        gid: endpoint_gid(token),
        qos: qos(&end.qos),
        node: Some(node(&token.node)),
        pid: None,
        is_remote: true,
        is_own: false,
        origin,
        teller: None,
    }
}

fn service(kind: ServiceKind, token: &Token, end: &Endpoint, origin: Origin) -> ServiceEndpoint {
    ServiceEndpoint {
        kind,
        name: end.name.clone(),
        type_name: end.type_id.name.to_string(),
        type_hash: Some(end.type_id.hash.to_string()),
        gid: endpoint_gid(token),
        node: Some(node(&token.node)),
        pid: None,
        is_remote: true,
        origin,
        teller: None,
    }
}

fn qos(wire: &WireQos) -> Qos {
    Qos {
        history: wire.history,
        reliability: wire.reliability,
        durability: wire.durability,
        deadline: wire.deadline.to_duration(),
        lifespan: wire.lifespan.to_duration(),
        liveliness: if wire.manual_liveliness { Liveliness::ManualByTopic } else { Liveliness::Automatic },
        liveliness_lease_duration: wire.lease.to_duration(),
        ..Qos::keep_last(usize::try_from(wire.depth).unwrap_or(usize::MAX).clamp(1, Limits::MAX_DEPTH))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::origin::origin;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    #[test]
    fn tokens_are_a_graph_in_any_order() {
        let string = format!("std_msgs::msg::dds_::String_/{HASH}");
        let texts = [
            "@ros2_lv/5/1/0/0/NN/%/%theirs/talker".to_owned(),
            "@ros2_lv/5/1/9/9/NN/%/%/silent".to_owned(),
            format!("@ros2_lv/5/1/0/1/MP/%/%theirs/talker/%chatter/{string}/2:1:,7:1,5:,:3,2,0"),
            format!("@ros2_lv/5/1/0/2/MS/%/%theirs/talker/%chatter/{string}/::,10:,:,:,,"),
            format!("@ros2_lv/5/1/0/3/SS/%/%theirs/talker/%add/a::srv::dds_::Add_/{HASH}/::,10:,:,:,,"),
            format!("@ros2_lv/5/1/0/4/SC/%/%theirs/talker/%add/a::srv::dds_::Add_/{HASH}/::,10:,:,:,,"),
        ];
        let mut tokens: Vec<Token> = texts.iter().map(|text| Token::parse(text).unwrap()).collect();
        let graph = remote_graph(&tokens, |token| Some(origin(token)), BTreeSet::new());
        let names: Vec<String> = graph.nodes.iter().map(|node| node.name.to_string()).collect();
        assert_eq!(names, ["/theirs/talker", "/silent"]);
        let [publisher, subscription] = &*graph.endpoints else { panic!("{graph:?}") };
        assert_eq!((publisher.kind, subscription.kind), {
            use tautline_transport::EndpointKind::{Publisher, Subscription};
            (Publisher, Subscription)
        });
        assert_eq!((&*publisher.topic, &*publisher.topic_type.name), ("/chatter", "std_msgs/msg/String"));
        assert_eq!(publisher.gid, endpoint_gid(&tokens[2]));
        let deadline = Some(std::time::Duration::new(1, 5));
        let qos = Qos {
            deadline,
            liveliness: Liveliness::ManualByTopic,
            liveliness_lease_duration: Some(std::time::Duration::from_secs(2)),
            ..Qos::keep_last(7).best_effort().transient_local()
        };
        assert_eq!(publisher.qos, qos);
        let kinds: Vec<_> =
            graph.services.iter().map(|end| (end.kind, &*end.name, &*end.type_name)).collect();
        assert_eq!(
            kinds,
            [(ServiceKind::Server, "/add", "a/srv/Add"), (ServiceKind::Client, "/add", "a/srv/Add")]
        );
        tokens.reverse();
        let reversed = remote_graph(&tokens, |token| Some(origin(token)), BTreeSet::new());
        assert_eq!((reversed.endpoints, reversed.services), (graph.endpoints, graph.services));
    }
}
