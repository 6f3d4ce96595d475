// SPDX-License-Identifier: MIT OR Apache-2.0
//! Endpoints of other hosts in terms of the domain, for nodes and tools here.

use crate::origin::origin;
use crate::wire::{Endpoint, EndpointKind, NodeName, Token, WireQos, endpoint_gid};
use tautline_transport::{
    EndpointKind::{Publisher, Subscription},
    Limits, Liveliness, Qos, ServiceEndpoint, ServiceKind, TopicEndpoint, TopicType,
};

#[derive(Clone, Debug)]
pub(crate) enum RemoteEntity {
    Node(tautline_transport::NodeName),
    Topic(TopicEndpoint),
    Service(ServiceEndpoint),
}

/// The entity that a token announces, in terms of the domain.
pub(crate) fn entity(token: &Token) -> RemoteEntity {
    let Some(end) = &token.endpoint else { return RemoteEntity::Node(node(&token.node)) };
    match end.kind {
        EndpointKind::Publisher => RemoteEntity::Topic(topic(Publisher, token, end)),
        EndpointKind::Subscription => RemoteEntity::Topic(topic(Subscription, token, end)),
        EndpointKind::Service => RemoteEntity::Service(service(ServiceKind::Server, token, end)),
        EndpointKind::Client => RemoteEntity::Service(service(ServiceKind::Client, token, end)),
    }
}

fn node(name: &NodeName) -> tautline_transport::NodeName {
    tautline_transport::NodeName { namespace: name.namespace.clone(), name: name.name.clone() }
}

fn topic(kind: tautline_transport::EndpointKind, token: &Token, end: &Endpoint) -> TopicEndpoint {
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
        origin: origin(token),
        teller: None,
    }
}

fn service(kind: ServiceKind, token: &Token, end: &Endpoint) -> ServiceEndpoint {
    ServiceEndpoint {
        kind,
        name: end.name.clone(),
        type_name: end.type_id.name.to_string(),
        type_hash: Some(end.type_id.hash.to_string()),
        gid: endpoint_gid(token),
        node: Some(node(&token.node)),
        pid: None,
        is_remote: true,
        origin: origin(token),
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

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    #[test]
    fn tokens_are_nodes_and_ends() {
        let string = format!("std_msgs::msg::dds_::String_/{HASH}");
        let read = |rest: &str| {
            let token = Token::parse(&format!("@ros2_lv/5/1/0/{rest}")).unwrap();
            (endpoint_gid(&token), entity(&token))
        };
        let (_, RemoteEntity::Node(name)) = read("0/NN/%/%theirs/talker") else { panic!() };
        assert_eq!(name.to_string(), "/theirs/talker");
        let publisher = format!("1/MP/%/%theirs/talker/%chatter/{string}/2:1:,7:1,5:,:3,2,0");
        let (gid, RemoteEntity::Topic(publisher)) = read(&publisher) else { panic!() };
        assert_eq!((publisher.kind, publisher.gid), (Publisher, gid));
        assert_eq!((&*publisher.topic, &*publisher.topic_type.name), ("/chatter", "std_msgs/msg/String"));
        let deadline = Some(std::time::Duration::new(1, 5));
        let qos = Qos {
            deadline,
            liveliness: Liveliness::ManualByTopic,
            liveliness_lease_duration: Some(std::time::Duration::from_secs(2)),
            ..Qos::keep_last(7).best_effort().transient_local()
        };
        assert_eq!(publisher.qos, qos);
        let subscription = format!("2/MS/%/%theirs/talker/%chatter/{string}/::,10:,:,:,,");
        let (_, RemoteEntity::Topic(subscription)) = read(&subscription) else { panic!() };
        assert_eq!(subscription.kind, Subscription);
        for (kind, expected) in [("SS", ServiceKind::Server), ("SC", ServiceKind::Client)] {
            let text = format!("3/{kind}/%/%theirs/talker/%add/a::srv::dds_::Add_/{HASH}/::,10:,:,:,,");
            let (_, RemoteEntity::Service(end)) = read(&text) else { panic!() };
            assert_eq!((end.kind, &*end.name, &*end.type_name), (expected, "/add", "a/srv/Add"));
        }
    }
}
