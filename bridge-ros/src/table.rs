// SPDX-License-Identifier: MIT OR Apache-2.0
//! The tables that bridges of one ROS domain exchange: what each of their endpoints in ROS mirrors, and its origin. ROS's graph
//! cannot carry this, so each bridge publishes one table on a hidden transient-local topic.

use crate::error::BridgeError;
use crate::outgoing::ENCAPSULATION;
use crate::rcl::{MessageSupport, Node, RclError, RosPublisher, RosSubscription, SerializedMessage};
use crate::types::Types;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tautline_transport::{Gid, Qos, RemoteGraph};

/// DDS announces the node of an endpoint later than the endpoint; without a node for this long, it belongs to no ROS node. Longer
/// than two heartbeats of Fast DDS (3 s), after which it retransmits, so that another bridge's endpoint is not taken for a
/// node's. Also the time-out for another bridge's announcement of what its endpoint mirrors.
pub(crate) const NAME_TIME: Duration = Duration::from_secs(7);

/// The topic of the tables. The underscore hides it from ROS's tools.
pub(crate) const TOPIC: &str = "/_tautline/ends";
const TYPE: &str = "std_msgs/msg/String";
/// Longer tables are refused.
const MAX_BYTES: usize = 4 << 20;
/// Maximum of nodes, of topic endpoints and of service endpoints in one table.
const MAX_ENDS: usize = 8192;
/// Maximum of bridges per ROS domain.
const MAX_TABLES: usize = 64;
/// Tables taken before the graph is read again.
const TURN: usize = 16;

/// One bridge's table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct OriginTable {
    /// The bridge's identifier.
    pub(crate) bridge: u64,
    /// The nodes that it shows in ROS and what its endpoints mirror, with names in ROS, and publishers with their GIDs in ROS.
    pub(crate) graph: RemoteGraph,
}

/// Other bridges' tables, by publisher.
#[derive(Clone, Default)]
pub(crate) struct Tables(Arc<Mutex<BTreeMap<Gid, Heard>>>);

struct Heard {
    /// `None`: it could not be parsed, which is logged once.
    table: Option<Arc<OriginTable>>,
    /// Whether its publisher was seen in ROS's graph: a table may arrive before that, or after the publisher has ended.
    is_seen: bool,
    since: Instant,
}

impl Tables {
    fn all(&self) -> MutexGuard<'_, BTreeMap<Gid, Heard>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the tables that have arrived, at most one turn: the rest wakes the wait again.
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
            let table = parse(buffer.bytes()).map(Arc::new);
            let mut all = self.all();
            let known = all.get(&info.gid);
            if table.is_none() && known.is_none_or(|heard| heard.table.is_some()) {
                tracing::warn!(
                    "the table of another bridge on {TOPIC} is not understood: run the same version of Tautline for all bridges of a ROS \
                     domain"
                );
            }
            let is_seen = known.is_some_and(|heard| heard.is_seen);
            if known.is_some() || all.len() < MAX_TABLES {
                all.insert(info.gid, Heard { table, is_seen, since: Instant::now() });
            }
        }
        Ok(())
    }

    /// The tables of `publishers`, which are all present publishers of the topic.
    pub(crate) fn of(&self, publishers: &BTreeSet<Gid>) -> Vec<Arc<OriginTable>> {
        let mut all = self.all();
        all.retain(|gid, heard| {
            let is_there = publishers.contains(gid);
            let stays = is_there || (!heard.is_seen && heard.since.elapsed() < NAME_TIME);
            heard.is_seen |= is_there;
            stays
        });
        all.values().filter_map(|heard| heard.table.clone()).collect()
    }
}

/// Parses a message, which is untrusted.
fn parse(bytes: &[u8]) -> Option<OriginTable> {
    let (head, body) = bytes.split_at_checked(ENCAPSULATION.len())?;
    let (len, text) = body.split_at_checked(4)?;
    let len = usize::try_from(u32::from_le_bytes(len.try_into().ok()?)).ok()?;
    if head[..2] != ENCAPSULATION[..2] || len > MAX_BYTES {
        return None;
    }
    let mut table: OriginTable = serde_json::from_slice(text.get(..len.checked_sub(1)?)?).ok()?;
    table.graph.nodes.truncate(MAX_ENDS);
    table.graph.endpoints.truncate(MAX_ENDS);
    table.graph.services.truncate(MAX_ENDS);
    Some(table)
}

/// The bridge's own table in ROS.
pub(crate) struct OwnTable {
    publisher: RosPublisher,
    buffer: SerializedMessage,
    said: Option<OriginTable>,
}

fn qos() -> Qos {
    Qos::keep_last(1).transient_local()
}

/// The type support of tables.
pub(crate) fn support() -> Result<MessageSupport, BridgeError> {
    let found = Types::new().find(TYPE, None);
    Ok(found.map_err(|error| BridgeError::Table(error.to_string()))?.support)
}

impl OwnTable {
    pub(crate) fn new(node: &Arc<Node>, support: &MessageSupport) -> Result<Self, RclError> {
        let publisher = RosPublisher::new(node, TOPIC, support, &qos())?;
        Ok(OwnTable { publisher, buffer: SerializedMessage::new()?, said: None })
    }

    /// Publishes the table if it changed.
    ///
    /// # Errors
    /// The reason of the failure; an oversized table is reported once.
    pub(crate) fn publish(&mut self, table: OriginTable) -> Result<(), String> {
        if self.said.as_ref() == Some(&table) {
            return Ok(());
        }
        let text = serde_json::to_vec(&table).map_err(|error| error.to_string())?;
        // Not retried until something else changes.
        let graph = &self.said.insert(table).graph;
        let ends = graph.nodes.len().max(graph.endpoints.len()).max(graph.services.len());
        if text.len() >= MAX_BYTES || ends > MAX_ENDS {
            return Err(format!(
                "{ends} endpoints in {} bytes exceed the limits of a table, {MAX_ENDS} and {MAX_BYTES}: exclude topics (--deny)",
                text.len()
            ));
        }
        let len = text.len() as u32 + 1;
        let body = [&len.to_le_bytes()[..], &text, &[0]].concat();
        let sent = self
            .buffer
            .assign(&ENCAPSULATION, &body)
            .and_then(|()| self.publisher.publish(self.buffer.bytes()));
        sent.map_err(|error| {
            self.said = None;
            error.reason
        })
    }
}

/// The subscription to other bridges' tables.
pub(crate) fn subscription(node: &Arc<Node>, support: &MessageSupport) -> Result<RosSubscription, RclError> {
    // Room for the last table of each bridge.
    RosSubscription::new(node, TOPIC, support, &Qos { depth: 100, ..qos() })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(text: &str) -> Vec<u8> {
        [&ENCAPSULATION[..], &(text.len() as u32 + 1).to_le_bytes(), text.as_bytes(), &[0]].concat()
    }

    #[test]
    fn what_is_said_is_read_and_nothing_else() {
        let table = OriginTable { bridge: 3, graph: RemoteGraph::default() };
        let text = message(&serde_json::to_string(&table).unwrap());
        assert_eq!(parse(&text), Some(table));
        for end in 0..text.len() - 1 {
            assert_eq!(parse(&text[..end]), None, "{end}");
        }
        assert_eq!(parse(&message("[]")), None);
        assert_eq!(parse(&[&[0, 0, 0, 0, 255, 255, 255, 255][..], &text].concat()), None);
    }

    #[test]
    fn a_table_goes_with_its_publisher() {
        let tables = Tables::default();
        let gid = Gid([9; 16]);
        let hear = |since| {
            let table = Some(Arc::<OriginTable>::default());
            tables.all().insert(gid, Heard { table, is_seen: false, since })
        };
        let none = BTreeSet::new();
        hear(Instant::now());
        assert_eq!(tables.of(&none).len(), 1, "heard before it is seen");
        assert_eq!(tables.of(&BTreeSet::from([gid])).len(), 1);
        assert_eq!(tables.of(&none).len(), 0);
        // Its last table may arrive after it has ended.
        hear(Instant::now().checked_sub(NAME_TIME).unwrap());
        assert_eq!(tables.of(&none).len(), 0);
    }
}
