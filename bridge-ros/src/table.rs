// SPDX-License-Identifier: MIT OR Apache-2.0
//! What bridges of one ROS domain tell each other: what each of their ends in ROS stands for, and where that was first. ROS's graph
//! has no room for it, so each bridge publishes one table on a hidden topic, kept for bridges that come later.

use crate::outgoing::ENCAPSULATION;
use crate::rcl::{Node, RclError, RosPublisher, RosSubscription, SerializedMessage};
use crate::ros_graph::NAME_TIME;
use crate::types::Types;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;
use tautline_transport::{
    Durability, EndpointKind, Gid, History, Limits, NodeName, Origin, Qos, Reliability, ServiceEndpoint,
    ServiceKind, TopicEndpoint, TopicType,
};

/// Hidden from ROS's tools by its underscore.
pub(crate) const TOPIC: &str = "/_tautline/ends";
const TYPE: &str = "std_msgs/msg/String";
/// Longer ones are not read.
const MAX_BYTES: usize = 4 << 20;
/// Ends and nodes of one table that are looked at.
const MAX_ENDS: usize = 8192;
/// Bridges of one ROS domain that are listened to.
const MAX_TABLES: usize = 64;
/// Tables taken before the next look at the graph.
const TURN: usize = 16;

/// One bridge's table. Names are ROS's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Table {
    /// By which equals are told apart.
    pub(crate) bridge: u64,
    pub(crate) nodes: Vec<TableNode>,
    pub(crate) ends: Vec<TableEnd>,
}

/// A node that the bridge shows in ROS.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct TableNode {
    pub(crate) name: NodeName,
    pub(crate) origin: Origin,
}

/// Which end of what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Kind {
    Publisher,
    Subscription,
    Server,
    Client,
}

/// An end that the bridge stands for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct TableEnd {
    pub(crate) kind: Kind,
    pub(crate) name: String,
    #[serde(rename = "type")]
    pub(crate) type_name: String,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) hash: Option<String>,
    /// Of a publisher: the one in ROS that stands for it. Else any that no other has.
    pub(crate) gid: Gid,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub(crate) node: Option<NodeName>,
    /// What decides who fits whom, and how much is kept.
    pub(crate) depth: u64,
    #[serde(default)]
    pub(crate) keep_all: bool,
    #[serde(default)]
    pub(crate) best_effort: bool,
    #[serde(default)]
    pub(crate) transient_local: bool,
    pub(crate) origin: Origin,
}

impl TableEnd {
    /// An end of Tautline's topic as ROS calls it.
    pub(crate) fn of_topic(end: &TopicEndpoint, name: &str, gid: Gid, origin: Origin) -> Self {
        TableEnd {
            kind: match end.kind {
                EndpointKind::Publisher => Kind::Publisher,
                EndpointKind::Subscription => Kind::Subscription,
            },
            name: name.to_owned(),
            type_name: end.topic_type.name.to_string(),
            hash: end.topic_type.hash.as_ref().map(ToString::to_string),
            gid,
            node: end.node.clone(),
            depth: end.qos.depth as u64,
            keep_all: end.qos.history == History::KeepAll,
            best_effort: end.qos.reliability == Reliability::BestEffort,
            transient_local: end.qos.durability == Durability::TransientLocal,
            origin,
        }
    }

    /// An end of Tautline's service as ROS calls it.
    pub(crate) fn of_service(end: &ServiceEndpoint, name: &str, origin: Origin) -> Self {
        TableEnd {
            kind: match end.kind {
                ServiceKind::Server => Kind::Server,
                ServiceKind::Client => Kind::Client,
            },
            name: name.to_owned(),
            type_name: end.type_name.clone(),
            hash: end.type_hash.clone(),
            gid: end.gid,
            node: end.node.clone(),
            depth: 10,
            keep_all: false,
            best_effort: false,
            transient_local: false,
            origin,
        }
    }

    /// As an end in ROS, if it is one of a topic.
    pub(crate) fn topic(&self) -> Option<TopicEndpoint> {
        let kind = match self.kind {
            Kind::Publisher => EndpointKind::Publisher,
            Kind::Subscription => EndpointKind::Subscription,
            Kind::Server | Kind::Client => return None,
        };
        let topic_type = TopicType::new(self.type_name.clone());
        let depth = usize::try_from(self.depth).unwrap_or(usize::MAX).clamp(1, Limits::MAX_DEPTH);
        Some(TopicEndpoint {
            kind,
            topic: self.name.clone(),
            topic_type: TopicType { hash: self.hash.clone().map(Into::into), ..topic_type },
            gid: self.gid,
            qos: Qos {
                history: if self.keep_all { History::KeepAll } else { History::KeepLast },
                reliability: if self.best_effort { Reliability::BestEffort } else { Reliability::Reliable },
                durability: match self.transient_local {
                    true => Durability::TransientLocal,
                    false => Durability::Volatile,
                },
                ..Qos::keep_last(depth)
            },
            node: self.node.clone(),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: self.origin.clone(),
            teller: None,
        })
    }

    /// As an end in ROS, if it is one of a service.
    pub(crate) fn service(&self) -> Option<ServiceEndpoint> {
        let kind = match self.kind {
            Kind::Server => ServiceKind::Server,
            Kind::Client => ServiceKind::Client,
            Kind::Publisher | Kind::Subscription => return None,
        };
        Some(ServiceEndpoint {
            kind,
            name: self.name.clone(),
            type_name: self.type_name.clone(),
            type_hash: self.hash.clone(),
            gid: self.gid,
            node: self.node.clone(),
            pid: None,
            is_remote: true,
            origin: self.origin.clone(),
            teller: None,
        })
    }
}

/// Others' tables, by who publishes them.
#[derive(Clone, Default)]
pub(crate) struct Tables(Arc<Mutex<BTreeMap<Gid, Heard>>>);

struct Heard {
    table: Arc<Table>,
    /// Whether its publisher was seen in ROS's graph: it may be heard before, or last after it has gone.
    is_seen: bool,
    since: Instant,
}

impl Tables {
    fn all(&self) -> MutexGuard<'_, BTreeMap<Gid, Heard>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes what came, at most a turn of it: what is left wakes the wait again.
    pub(crate) fn take(
        &self,
        from: &mut RosSubscription,
        buffer: &mut SerializedMessage,
    ) -> Result<(), RclError> {
        for _ in 0..TURN {
            let Some(info) = from.take(buffer)? else { break };
            if info.is_own {
                continue;
            }
            match parse(buffer.bytes()) {
                Some(table) => {
                    let mut all = self.all();
                    let known = all.get(&info.gid).map(|heard| heard.is_seen);
                    if known.is_some() || all.len() < MAX_TABLES {
                        let (table, is_seen) = (Arc::new(table), known.unwrap_or(false));
                        all.insert(info.gid, Heard { table, is_seen, since: Instant::now() });
                    }
                }
                None => tracing::warn!(
                    "what another bridge tells on {TOPIC} is not understood: run the same version of Tautline for all bridges of a ROS \
                     domain"
                ),
            }
        }
        Ok(())
    }

    /// Those whose publishers are there, of all that are on the topic now.
    pub(crate) fn of(&self, publishers: &BTreeSet<Gid>) -> Vec<Arc<Table>> {
        let mut all = self.all();
        all.retain(|gid, heard| {
            let is_there = publishers.contains(gid);
            let stays = is_there || (!heard.is_seen && heard.since.elapsed() < NAME_TIME);
            heard.is_seen |= is_there;
            stays
        });
        all.values().map(|heard| heard.table.clone()).collect()
    }
}

/// The text in a message; a claim.
fn parse(bytes: &[u8]) -> Option<Table> {
    let (head, body) = bytes.split_at_checked(ENCAPSULATION.len())?;
    let (len, text) = body.split_at_checked(4)?;
    let len = usize::try_from(u32::from_le_bytes(len.try_into().ok()?)).ok()?;
    if head[..2] != ENCAPSULATION[..2] || len > MAX_BYTES {
        return None;
    }
    let mut table: Table = serde_json::from_slice(text.get(..len.checked_sub(1)?)?).ok()?;
    table.nodes.truncate(MAX_ENDS);
    table.nodes.retain(|node| node.name.is_valid() && node.origin.is_valid());
    table.ends.truncate(MAX_ENDS);
    table.ends.retain(|end| {
        end.topic().is_none_or(|end| end.is_valid()) && end.service().is_none_or(|end| end.is_valid())
    });
    Some(table)
}

/// The bridge's own table in ROS.
pub(crate) struct OwnTable {
    publisher: RosPublisher,
    buffer: SerializedMessage,
    said: Option<Table>,
}

fn qos() -> Qos {
    Qos::keep_last(1).transient_local()
}

impl OwnTable {
    pub(crate) fn new(node: &Arc<Node>) -> Result<Self, String> {
        let support = Types::new().find(TYPE, None).map_err(|error| error.to_string())?.support;
        let publisher =
            RosPublisher::new(node, TOPIC, &support, &qos()).map_err(|error| error.to_string())?;
        let buffer = SerializedMessage::new().map_err(|error| error.to_string())?;
        Ok(OwnTable { publisher, buffer, said: None })
    }

    /// Publishes what is otherwise than before.
    pub(crate) fn say(&mut self, table: Table) -> Result<(), String> {
        if self.said.as_ref() == Some(&table) {
            return Ok(());
        }
        let text = serde_json::to_vec(&table).map_err(|error| error.to_string())?;
        let (ends, bytes) = (table.ends.len().max(table.nodes.len()), text.len());
        if bytes >= MAX_BYTES || ends > MAX_ENDS {
            return Err(format!(
                "{ends} ends in {bytes} bytes are more than the {MAX_ENDS} and {MAX_BYTES} that a table can have: leave some out (--deny)"
            ));
        }
        let len = bytes as u32 + 1;
        let body = [&len.to_le_bytes()[..], &text, &[0]].concat();
        let sent =
            self.buffer.assign(&ENCAPSULATION, &body).and_then(|()| self.publisher.publish(&self.buffer));
        sent.map_err(|error| error.reason)?;
        self.said = Some(table);
        Ok(())
    }
}

/// By which others' tables are heard.
pub(crate) fn subscription(node: &Arc<Node>) -> Result<RosSubscription, String> {
    let support = Types::new().find(TYPE, None).map_err(|error| error.to_string())?.support;
    // Of each of them the last.
    RosSubscription::new(node, TOPIC, &support, &Qos { depth: 100, ..qos() })
        .map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let name = NodeName { namespace: "/a".into(), name: "n".into() };
        let origin = Origin::here(Gid([1; 16]), "host").told_by(7);
        let end = TopicEndpoint {
            kind: EndpointKind::Subscription,
            topic: "/x".into(),
            topic_type: TopicType::new("a/msg/B").with_hash(format!("RIHS01_{:064x}", 7)),
            gid: Gid([2; 16]),
            qos: Qos::keep_last(7).transient_local().best_effort(),
            node: Some(name.clone()),
            pid: None,
            is_remote: true,
            is_own: false,
            origin: origin.clone(),
            teller: None,
        };
        let told = TableEnd::of_topic(&end, "/x", end.gid, origin.clone());
        assert_eq!(told.topic(), Some(end));
        assert_eq!(told.service(), None);
        Table { bridge: 3, nodes: vec![TableNode { name, origin }], ends: vec![told] }
    }

    fn message(text: &[u8]) -> Vec<u8> {
        [&ENCAPSULATION[..], &(text.len() as u32 + 1).to_le_bytes(), text, &[0]].concat()
    }

    #[test]
    fn what_is_said_is_read_and_nothing_else() {
        let text = serde_json::to_vec(&table()).unwrap();
        assert_eq!(parse(&message(&text)), Some(table()));
        for end in 0..text.len() + 8 {
            assert_eq!(parse(&message(&text)[..end]), None, "{end}");
        }
        let mut hostile = table();
        hostile.ends[0].name = "/x\u{1b}[2J".into();
        hostile.nodes[0].origin.path = vec![1; 100];
        let text = serde_json::to_vec(&hostile).unwrap();
        assert_eq!(parse(&message(&text)), Some(Table { bridge: 3, ..Table::default() }));
        assert_eq!(parse(&message(b"[]")), None);
        assert_eq!(parse(&[&[0, 0, 0, 0, 255, 255, 255, 255][..], &text].concat()), None);
    }

    #[test]
    fn a_table_goes_with_its_publisher() {
        let tables = Tables::default();
        let gid = Gid([9; 16]);
        let hear =
            |since| tables.all().insert(gid, Heard { table: Arc::new(table()), is_seen: false, since });
        let none = BTreeSet::new();
        hear(Instant::now());
        assert_eq!(tables.of(&none).len(), 1, "heard before it is seen");
        assert_eq!(tables.of(&BTreeSet::from([gid])).len(), 1);
        assert_eq!(tables.of(&none).len(), 0);
        // Its last word may come after it has gone.
        hear(Instant::now().checked_sub(NAME_TIME).unwrap());
        assert_eq!(tables.of(&none).len(), 0);
    }
}
