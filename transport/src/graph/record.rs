// SPDX-License-Identifier: MIT OR Apache-2.0
//! The content of a record's entries, as JSON. Content read from another participant's record is untrusted: each value is
//! checked before it is used.

pub(crate) use crate::graph::entities::EndpointKind as PortKind;
use crate::graph::entities::{NodeName, ServiceEndpoint, ServiceKind, TopicEndpoint};
use crate::graph::origin::Origin;
use crate::graph::topic_type::TopicType;
use crate::memory::connection::Shape;
use crate::memory::header::Gid;
use crate::names::{MAX_NAME_BYTES, is_absolute, is_token, is_topic, is_type};
use crate::qos::{Durability, History, Limits, Liveliness, Qos, Reliability};
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// A publisher or a subscription, as its participant describes it. Its gid is made of its participant's id and its entry's number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct PortRecord {
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) node: Option<u64>,
    pub(crate) kind: PortKind,
    pub(crate) topic: String,
    #[serde(rename = "type")]
    pub(crate) type_name: String,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) hash: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) body_bytes: Option<u64>,
    pub(crate) qos: QosRecord,
    /// A relay's port, which forwards messages, and matches whatever the other endpoint's quality of service.
    #[serde(skip_serializing_if = "is_false", default)]
    pub(crate) relay: bool,
    /// A tool's subscription, which takes what is published anyway, and is not an endpoint of the graph.
    #[serde(skip_serializing_if = "is_false", default)]
    pub(crate) observer: bool,
    /// The doorbell slot that is rung for it.
    pub(crate) slot: u32,
    /// Of a subscription, the maximum number of samples that it holds; of a publisher, the position of its memory.
    pub(crate) at: u64,
    /// Of a port for a service's responses: the number of the port for requests of the same client or server.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) partner: Option<u64>,
}

fn is_false(value: &bool) -> bool {
    !value
}

/// A quality of service. Fields that are not present have ROS 2's default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct QosRecord {
    depth: u64,
    #[serde(skip_serializing_if = "is_false", default)]
    keep_all: bool,
    #[serde(skip_serializing_if = "is_false", default)]
    best_effort: bool,
    #[serde(skip_serializing_if = "is_false", default)]
    transient_local: bool,
    #[serde(skip_serializing_if = "is_false", default)]
    manual: bool,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    deadline: Option<Duration>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    lifespan: Option<Duration>,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    lease: Option<Duration>,
}

impl From<&Qos> for QosRecord {
    fn from(qos: &Qos) -> Self {
        QosRecord {
            depth: qos.depth as u64,
            keep_all: qos.history == History::KeepAll,
            best_effort: qos.reliability == Reliability::BestEffort,
            transient_local: qos.durability == Durability::TransientLocal,
            manual: qos.liveliness == Liveliness::ManualByTopic,
            deadline: qos.deadline,
            lifespan: qos.lifespan,
            lease: qos.liveliness_lease_duration,
        }
    }
}

impl QosRecord {
    fn is_valid(&self) -> bool {
        (1..=Limits::MAX_DEPTH as u64).contains(&self.depth)
    }

    pub(crate) fn qos(&self) -> Qos {
        let depth = usize::try_from(self.depth).unwrap_or(usize::MAX);
        Qos {
            history: if self.keep_all { History::KeepAll } else { History::KeepLast },
            depth,
            reliability: if self.best_effort { Reliability::BestEffort } else { Reliability::Reliable },
            durability: if self.transient_local { Durability::TransientLocal } else { Durability::Volatile },
            deadline: self.deadline,
            lifespan: self.lifespan,
            liveliness: if self.manual { Liveliness::ManualByTopic } else { Liveliness::Automatic },
            liveliness_lease_duration: self.lease,
        }
    }
}

/// Deserialises the body of an entry, which is JSON followed by zeros.
fn parse<'de, T: Deserialize<'de>>(body: &'de [u8]) -> Option<T> {
    let end = body.iter().rposition(|byte| *byte != 0)? + 1;
    serde_json::from_slice(&body[..end]).ok()
}

pub(crate) fn to_body(record: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(record).unwrap_or_default()
}

impl PortRecord {
    /// Parses the body of an entry; `None` if it is invalid.
    pub(crate) fn parse(body: &[u8]) -> Option<Self> {
        let record: PortRecord = parse(body)?;
        let is_port = is_topic(&record.topic)
            && is_type(&record.type_name, record.hash.as_deref())
            && record.qos.is_valid()
            && (record.kind == PortKind::Publisher || (1..=Limits::MAX_HELD as u64).contains(&record.at));
        is_port.then_some(record)
    }

    /// The shape of the connection from a publisher that may have `loans` loans to this subscription.
    pub(crate) fn shape(&self, loans: usize) -> Shape {
        Shape { depth: self.qos.qos().depth, held: self.at as usize, loans, is_observer: self.observer }
    }

    pub(crate) fn topic_type(&self) -> TopicType {
        TopicType {
            name: self.type_name.clone().into(),
            hash: self.hash.clone().map(Into::into),
            body_bytes: self.body_bytes.and_then(|bytes| usize::try_from(bytes).ok()),
            definition: None,
        }
    }
}

/// A publisher or subscription of another host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RemotePortRecord {
    pub(crate) node: u64,
    kind: PortKind,
    pub(crate) topic: String,
    #[serde(rename = "type")]
    type_name: String,
    hash: Option<String>,
    gid: Gid,
    qos: QosRecord,
    #[serde(default)]
    origin: Origin,
}

/// A service or client of another host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RemoteServiceRecord {
    pub(crate) node: u64,
    is_server: bool,
    pub(crate) name: String,
    #[serde(rename = "type")]
    type_name: String,
    hash: Option<String>,
    gid: Gid,
    #[serde(default)]
    origin: Origin,
}

/// A node; with its origin if it is on another host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct NodeRecord {
    #[serde(flatten)]
    pub(crate) name: NodeName,
    #[serde(skip_serializing_if = "is_root", default = "root")]
    pub(crate) enclave: String,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) origin: Option<Origin>,
}

/// The enclave of nodes that state none.
pub(crate) fn root() -> String {
    "/".to_owned()
}

fn is_root(enclave: &String) -> bool {
    enclave == "/"
}

pub(crate) fn is_enclave(enclave: &str) -> bool {
    enclave == "/" || is_absolute(enclave)
}

/// The origin, with the tag of `gid` if it has no tag.
fn with_tag(origin: &Origin, gid: Gid) -> Origin {
    let tag = if origin.tag == 0 { gid.tag() } else { origin.tag };
    Origin { tag, ..origin.clone() }
}

impl RemotePortRecord {
    pub(crate) fn new(node: u64, end: &TopicEndpoint) -> Self {
        RemotePortRecord {
            node,
            kind: end.kind,
            topic: end.topic.clone(),
            type_name: end.topic_type.name.to_string(),
            hash: end.topic_type.hash.as_ref().map(ToString::to_string),
            gid: end.gid,
            // ROS 2 does not report the depth of its publishers: it is 0.
            qos: QosRecord::from(&Qos { depth: end.qos.depth.clamp(1, Limits::MAX_DEPTH), ..end.qos }),
            origin: with_tag(&end.origin, end.gid),
        }
    }

    pub(crate) fn parse(body: &[u8]) -> Option<Self> {
        parse(body).filter(Self::is_valid)
    }

    pub(crate) fn is_valid(&self) -> bool {
        is_absolute(&self.topic)
            && is_type(&self.type_name, self.hash.as_deref())
            && self.qos.is_valid()
            && self.origin.is_valid()
    }

    /// The endpoint as `teller`, if that is a participant of this domain, announces it.
    pub(crate) fn endpoint(&self, node: &NodeName, teller: Option<u64>) -> TopicEndpoint {
        let mut topic_type = TopicType::new(self.type_name.clone());
        topic_type.hash = self.hash.clone().map(Into::into);
        TopicEndpoint {
            kind: self.kind,
            topic: self.topic.clone(),
            topic_type,
            gid: self.gid,
            qos: self.qos.qos(),
            node: Some(node.clone()),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: self.origin.clone(),
            teller,
        }
    }
}

impl RemoteServiceRecord {
    pub(crate) fn new(node: u64, end: &ServiceEndpoint) -> Self {
        RemoteServiceRecord {
            node,
            is_server: end.kind == ServiceKind::Server,
            name: end.name.clone(),
            type_name: end.type_name.clone(),
            hash: end.type_hash.clone(),
            gid: end.gid,
            origin: with_tag(&end.origin, end.gid),
        }
    }

    pub(crate) fn parse(body: &[u8]) -> Option<Self> {
        parse(body).filter(Self::is_valid)
    }

    pub(crate) fn is_valid(&self) -> bool {
        is_absolute(&self.name) && is_type(&self.type_name, self.hash.as_deref()) && self.origin.is_valid()
    }

    /// The endpoint as `teller`, if that is a participant of this domain, announces it.
    pub(crate) fn endpoint(&self, node: &NodeName, teller: Option<u64>) -> ServiceEndpoint {
        ServiceEndpoint {
            kind: if self.is_server { ServiceKind::Server } else { ServiceKind::Client },
            name: self.name.clone(),
            type_name: self.type_name.clone(),
            type_hash: self.hash.clone(),
            gid: self.gid,
            node: Some(node.clone()),
            pid: None,
            is_remote: true,
            origin: self.origin.clone(),
            teller,
        }
    }
}

impl NodeRecord {
    pub(crate) fn parse(body: &[u8]) -> Option<Self> {
        parse(body).filter(Self::is_valid)
    }

    pub(crate) fn is_valid(&self) -> bool {
        self.name.is_valid() && is_enclave(&self.enclave) && self.origin.as_ref().is_none_or(Origin::is_valid)
    }
}

impl NodeName {
    /// Whether this is a valid node name.
    pub fn is_valid(&self) -> bool {
        self.name.len() <= MAX_NAME_BYTES
            && is_token(&self.name)
            && (self.namespace == "/" || is_absolute(&self.namespace))
    }
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
        let is_gid = text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let value = u128::from_str_radix(&text, 16).ok().filter(|_| is_gid);
        let value = value.ok_or_else(|| serde::de::Error::custom("not 32 hexadecimal digits"))?;
        Ok(Gid(value.to_be_bytes()))
    }
}

#[cfg(all(test, not(taut_loom)))]
mod tests {
    use super::*;

    fn qos() -> Qos {
        Qos {
            liveliness: Liveliness::ManualByTopic,
            liveliness_lease_duration: Some(Duration::from_nanos(5)),
            deadline: Some(Duration::new(3, 141_592_653)),
            ..Qos::keep_all(3).transient_local().best_effort()
        }
    }

    fn port() -> PortRecord {
        PortRecord {
            node: Some(3),
            kind: PortKind::Subscription,
            topic: "/x".into(),
            type_name: "a/msg/B".into(),
            hash: Some(format!("RIHS01_{:064x}", 7)),
            body_bytes: Some(24),
            qos: QosRecord::from(&qos()),
            relay: true,
            observer: false,
            slot: 70_000,
            at: 4,
            partner: None,
        }
    }

    fn node() -> NodeName {
        NodeName { namespace: "/robot".into(), name: "n".into() }
    }

    fn origin() -> Origin {
        Origin { tag: 5, path: vec![u64::MAX, 2], ros: 1, place: "there".into() }
    }

    #[test]
    fn round_trips() {
        let body = to_body(&port());
        let padded = [body.clone(), vec![0; 7]].concat();
        assert_eq!(PortRecord::parse(&padded), Some(port()));
        assert_eq!(PortRecord::parse(&body).unwrap().qos.qos(), qos());
        assert_eq!(QosRecord::from(&Qos::default()).qos(), Qos::default());
        let record = NodeRecord { name: node(), enclave: root(), origin: None };
        assert_eq!(NodeRecord::parse(&to_body(&record)), Some(record));
        let told = NodeRecord { name: node(), enclave: "/front/left".into(), origin: Some(origin()) };
        assert_eq!(NodeRecord::parse(&to_body(&told)), Some(told));
        let end = TopicEndpoint {
            kind: PortKind::Publisher,
            topic: "/x".into(),
            topic_type: TopicType::new("a/msg/B").with_hash(format!("RIHS01_{:064x}", 7)),
            gid: Gid([9; 16]),
            qos: qos(),
            node: Some(node()),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: origin(),
            teller: Some(4),
        };
        let record = RemotePortRecord::new(1, &end);
        let parsed = RemotePortRecord::parse(&to_body(&record)).unwrap();
        assert_eq!((parsed.node, parsed.endpoint(&node(), Some(4))), (1, end));
        let service = ServiceEndpoint {
            kind: ServiceKind::Server,
            name: "/robot/add".into(),
            type_name: "a/srv/B".into(),
            type_hash: None,
            gid: Gid([5; 16]),
            node: Some(node()),
            pid: None,
            is_remote: true,
            origin: origin(),
            teller: Some(4),
        };
        let record = RemoteServiceRecord::new(1, &service);
        let parsed = RemoteServiceRecord::parse(&to_body(&record)).unwrap();
        assert_eq!(parsed.endpoint(&node(), Some(4)), service);
    }

    #[test]
    fn what_no_honest_participant_says_is_none() {
        let text = String::from_utf8(to_body(&port())).unwrap();
        let long = format!("\"{}\"", "x".repeat(300));
        for (from, to) in [
            ("\"/x\"", "\"/x\\u001b[2J\""),
            ("\"/x\"", "\"\""),
            ("\"/x\"", "\"a:b\""),
            ("\"/x\"", &long),
            ("RIHS01_0", "RIHS01_x"),
            ("a/msg/B", "a msg"),
            ("\"depth\":3", "\"depth\":0"),
            ("\"depth\":3", "\"depth\":65537"),
            ("\"at\":4", "\"at\":0"),
            ("\"slot\":70000", "\"slot\":-1"),
            ("\"sub\"", "\"both\""),
            ("{", "["),
        ] {
            assert!(text.contains(from), "{from} in {text}");
            assert_eq!(PortRecord::parse(text.replace(from, to).as_bytes()), None, "{to}");
        }
        for end in 0..text.len() {
            assert_eq!(PortRecord::parse(&text.as_bytes()[..end]), None);
        }
        for (namespace, name) in [("", "n"), ("/robot", "a b"), ("/robot/", "n"), ("robot", "n"), ("/", "")] {
            let node = NodeName { namespace: namespace.into(), name: name.into() };
            assert_eq!(NodeRecord::parse(&to_body(&node)), None, "{node}");
        }
        for enclave in ["", "front", "/front/", "/fr ont", "/\u{1b}[2J"] {
            let record = NodeRecord { name: node(), enclave: enclave.into(), origin: None };
            assert_eq!(NodeRecord::parse(&to_body(&record)), None, "{enclave:?}");
        }
    }

    /// Whatever the bytes are: a record or none, without a panic.
    #[test]
    fn changed_texts() {
        use rand::RngExt;
        let mut random = tautline_seed::random();
        let text = to_body(&port());
        let mut read = 0;
        for _ in 0..20_000 {
            let mut text = text.clone();
            for _ in 0..random.random_range(1..4) {
                let at = random.random_range(0..text.len());
                text[at] = random.random();
            }
            if let Some(record) = PortRecord::parse(&text) {
                read += 1;
                let _ = (record.topic_type().describe(), record.qos.qos());
            }
        }
        assert!(read > 0 && read < 20_000);
    }
}
