// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a participant's file says, as JSON. Read from another process's file: claims, each checked before it is used.

use super::{EndpointKind, NodeName, ServiceEndpoint, ServiceKind, TopicEndpoint};
use crate::header::Gid;
use crate::qos::{Durability, History, Liveliness, Qos, Reliability};
use crate::topic_type::TopicType;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// ROS 2's limit of names.
const MAX_NAME_BYTES: usize = 255;

/// All that a participant says of its nodes; or, if it relays other hosts, of theirs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) pid: u32,
    /// Its doorbell's, by which its ports are known.
    pub(super) arena: u64,
    /// Its ports stand for those of other hosts, which `endpoints` describes.
    pub(super) is_relay: bool,
    pub(super) nodes: BTreeMap<u64, NodeName>,
    /// Publishers and subscriptions, by their gid, and the node of each.
    pub(super) owners: BTreeMap<Gid, u64>,
    pub(super) services: BTreeMap<u64, ServiceRecord>,
    pub(super) endpoints: Vec<EndpointRecord>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct ServiceRecord {
    node: u64,
    is_server: bool,
    name: String,
    type_name: String,
    type_hash: Option<String>,
    gid: Gid,
}

/// A publisher or subscription of another host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct EndpointRecord {
    node: u64,
    is_publisher: bool,
    topic: String,
    type_name: String,
    type_hash: Option<String>,
    gid: Gid,
    reliable: bool,
    transient_local: bool,
    keep_all: bool,
    depth: u64,
    deadline: Option<Duration>,
    lifespan: Option<Duration>,
    is_manual: bool,
    lease: Option<Duration>,
}

impl Record {
    /// A text from another process, without what no honest one says. `None` if it is no record.
    pub(super) fn parse(text: &[u8]) -> Option<Record> {
        let mut record: Record = serde_json::from_slice(text).ok()?;
        record.nodes.retain(|_, node| node.is_valid());
        let Record { nodes, owners, services, endpoints, .. } = &mut record;
        owners.retain(|_, node| nodes.contains_key(node));
        services.retain(|_, service| {
            let ServiceRecord { node, name, type_name, type_hash, .. } = service;
            nodes.contains_key(node) && is_absolute(name) && is_type(type_name, type_hash.as_deref())
        });
        endpoints.retain(|end| {
            let is_named = nodes.contains_key(&end.node) && is_absolute(&end.topic);
            is_named && is_type(&end.type_name, end.type_hash.as_deref())
        });
        Some(record)
    }

    pub(super) fn service(&self, record: &ServiceRecord) -> Option<ServiceEndpoint> {
        Some(ServiceEndpoint {
            kind: if record.is_server { ServiceKind::Server } else { ServiceKind::Client },
            name: record.name.clone(),
            type_name: record.type_name.clone(),
            type_hash: record.type_hash.clone(),
            gid: record.gid,
            node: self.nodes.get(&record.node)?.clone(),
            pid: (!self.is_relay).then_some(self.pid),
            is_remote: self.is_relay,
        })
    }

    pub(super) fn endpoint(&self, record: &EndpointRecord) -> Option<TopicEndpoint> {
        let mut topic_type = TopicType::new(record.type_name.clone());
        topic_type.hash = record.type_hash.clone().map(Into::into);
        Some(TopicEndpoint {
            kind: if record.is_publisher { EndpointKind::Publisher } else { EndpointKind::Subscription },
            topic: record.topic.clone(),
            topic_type,
            gid: record.gid,
            qos: Qos {
                history: if record.keep_all { History::KeepAll } else { History::KeepLast },
                depth: usize::try_from(record.depth).unwrap_or(usize::MAX),
                reliability: if record.reliable { Reliability::Reliable } else { Reliability::BestEffort },
                durability: match record.transient_local {
                    true => Durability::TransientLocal,
                    false => Durability::Volatile,
                },
                deadline: record.deadline,
                lifespan: record.lifespan,
                liveliness: if record.is_manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
                liveliness_lease_duration: record.lease,
            },
            node: Some(self.nodes.get(&record.node)?.clone()),
            pid: None,
            is_remote: true,
            is_own: false,
        })
    }
}

impl ServiceRecord {
    pub(super) fn new(node: u64, end: &ServiceEndpoint) -> Self {
        ServiceRecord {
            node,
            is_server: end.kind == ServiceKind::Server,
            name: end.name.clone(),
            type_name: end.type_name.clone(),
            type_hash: end.type_hash.clone(),
            gid: end.gid,
        }
    }

    /// What no reader would believe.
    pub(super) fn fault(&self) -> Option<&'static str> {
        if !is_absolute(&self.name) {
            return Some("it is no fully qualified name of ROS 2");
        }
        let is_type = is_type(&self.type_name, self.type_hash.as_deref());
        (!is_type).then_some("its type's name or hash cannot be one")
    }
}

impl EndpointRecord {
    pub(super) fn new(node: u64, end: &TopicEndpoint) -> Self {
        EndpointRecord {
            node,
            is_publisher: end.kind == EndpointKind::Publisher,
            topic: end.topic.clone(),
            type_name: end.topic_type.name.to_string(),
            type_hash: end.topic_type.hash.as_ref().map(ToString::to_string),
            gid: end.gid,
            reliable: end.qos.reliability == Reliability::Reliable,
            transient_local: end.qos.durability == Durability::TransientLocal,
            keep_all: end.qos.history == History::KeepAll,
            depth: end.qos.depth as u64,
            deadline: end.qos.deadline,
            lifespan: end.qos.lifespan,
            is_manual: end.qos.liveliness == Liveliness::ManualByTopic,
            lease: end.qos.liveliness_lease_duration,
        }
    }
}

impl NodeName {
    pub(super) fn is_valid(&self) -> bool {
        self.name.len() <= MAX_NAME_BYTES
            && is_token(&self.name)
            && (self.namespace == "/" || is_absolute(&self.namespace))
    }
}

/// Whether this is `/a/b`, of ROS tokens.
fn is_absolute(name: &str) -> bool {
    name.len() <= MAX_NAME_BYTES && name.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_token))
}

fn is_token(token: &str) -> bool {
    !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

/// Names of types are not ROS 2's alone.
fn is_type(name: &str, hash: Option<&str>) -> bool {
    let is_name =
        (1..=MAX_NAME_BYTES).contains(&name.len()) && name.bytes().all(|byte| byte.is_ascii_graphic());
    is_name && hash.is_none_or(crate::topic_type::is_hash)
}

/// As 32 hexadecimal digits, in the order of the bytes.
impl Serialize for Gid {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&format_args!("{self:?}"))
    }
}

impl<'de> Deserialize<'de> for Gid {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = std::borrow::Cow::<str>::deserialize(deserializer)?;
        let value = u128::from_str_radix(&text, 16).map_err(serde::de::Error::custom)?;
        Ok(Gid(value.to_be_bytes()))
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    fn record() -> Record {
        let node = NodeName { namespace: "/robot".into(), name: "n".into() };
        let service = ServiceEndpoint {
            kind: ServiceKind::Server,
            name: "/robot/add".into(),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid([5; 16]),
            node: node.clone(),
            pid: None,
            is_remote: true,
        };
        let service = ServiceRecord::new(1, &service);
        let end = TopicEndpoint {
            kind: EndpointKind::Subscription,
            topic: "/x".into(),
            topic_type: TopicType::new("a/msg/B").with_hash(format!("RIHS01_{:064x}", 7)),
            gid: Gid([9; 16]),
            qos: Qos {
                liveliness: Liveliness::ManualByTopic,
                liveliness_lease_duration: Some(Duration::from_nanos(5)),
                ..Qos::keep_all(3).transient_local().best_effort()
            },
            node: Some(node.clone()),
            pid: None,
            is_remote: true,
            is_own: false,
        };
        Record {
            pid: 7,
            arena: u64::MAX,
            is_relay: true,
            nodes: [(1, node)].into(),
            owners: [(Gid([1; 16]), 1)].into(),
            services: [(2, service)].into(),
            endpoints: vec![EndpointRecord::new(1, &end)],
        }
    }

    #[test]
    fn round_trip() {
        let record = record();
        let text = serde_json::to_vec(&record).unwrap();
        assert_eq!(Record::parse(&text).unwrap(), record);
        let end = record.endpoint(&record.endpoints[0]).unwrap();
        assert_eq!(EndpointRecord::new(1, &end), record.endpoints[0]);
        assert_eq!((end.qos.depth, end.qos.liveliness), (3, Liveliness::ManualByTopic));
        let service = record.service(&record.services[&2]).unwrap();
        assert_eq!((service.kind, &*service.name, service.pid), (ServiceKind::Server, "/robot/add", None));
    }

    #[test]
    fn what_no_honest_process_says_is_left_out() {
        let text = String::from_utf8(serde_json::to_vec(&record()).unwrap()).unwrap();
        let read = |from: &str, to: &str| {
            assert!(text.contains(from), "{from}");
            Record::parse(text.replace(from, to).as_bytes())
        };
        let left = |record: Option<Record>| {
            let record = record.unwrap();
            [record.nodes.len(), record.owners.len(), record.services.len(), record.endpoints.len()]
        };
        let long = format!("\"/{}\"", "x".repeat(300));
        assert_eq!(left(read("\"n\"", "\"a b\"")), [0, 0, 0, 0]);
        assert_eq!(left(read("\"/robot\"", "\"\"")), [0, 0, 0, 0]);
        assert_eq!(left(read("\"/x\"", "\"/x\\u001b[2J\"")), [1, 1, 1, 0]);
        assert_eq!(left(read("\"/x\"", &long)), [1, 1, 1, 0]);
        assert_eq!(left(read("RIHS01_0", "RIHS01_x")), [1, 1, 1, 0]);
        assert_eq!(left(read("a/srv/B", "a srv")), [1, 1, 0, 1]);
        assert_eq!(left(read("{\"node\":1,\"is_server\"", "{\"node\":3,\"is_server\"")), [1, 1, 0, 1]);
        assert_eq!(left(read("\"is_relay\":true", "\"is_relay\":false")), [1, 1, 1, 1]);
        for (from, to) in
            [("\"pid\":7", "\"pid\":-1"), ("0909", "xyz"), ("{", "["), ("01010101", "0101010101")]
        {
            assert!(read(from, to).is_none(), "{to}");
        }
        for end in 0..text.len() {
            assert!(Record::parse(&text.as_bytes()[..end]).is_none());
        }
    }

    /// Whatever the bytes are: a record or none, without a panic.
    #[test]
    fn changed_texts() {
        use rand::{RngExt, SeedableRng};
        let seed = rand::random();
        println!("seed {seed}");
        let mut random = rand::rngs::SmallRng::seed_from_u64(seed);
        let text = serde_json::to_vec(&record()).unwrap();
        let mut read = 0;
        for _ in 0..20_000 {
            let mut text = text.clone();
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(0..text.len());
                text[at] = random.random();
            }
            if let Some(record) = Record::parse(&text) {
                read += 1;
                record.endpoints.iter().for_each(|end| drop(record.endpoint(end).unwrap()));
                record.services.values().for_each(|service| drop(record.service(service).unwrap()));
            }
        }
        assert!(read > 0 && read < 20_000);
    }
}
