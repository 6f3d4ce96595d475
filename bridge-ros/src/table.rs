// SPDX-License-Identifier: MIT OR Apache-2.0
//! What bridges of one ROS domain tell each other: what each of their ends in ROS stands for, and where that was first. ROS's graph
//! has no room for it, so each bridge publishes one table on a hidden topic, kept for bridges that come later.

use crate::bridge::BridgeError;
use crate::outgoing::ENCAPSULATION;
use crate::rcl::{MessageSupport, Node, RclError, RosPublisher, RosSubscription, SerializedMessage};
use crate::ros_graph::NAME_TIME;
use crate::types::Types;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;
use tautline_transport::{Gid, Qos, RemoteGraph};

/// Hidden from ROS's tools by its underscore.
pub(crate) const TOPIC: &str = "/_tautline/ends";
const TYPE: &str = "std_msgs/msg/String";
/// Longer ones are not read.
const MAX_BYTES: usize = 4 << 20;
/// Nodes, ends of topics and ends of services of one table that are looked at.
const MAX_ENDS: usize = 8192;
/// Bridges of one ROS domain that are listened to.
const MAX_TABLES: usize = 64;
/// Tables taken before the next look at the graph.
const TURN: usize = 16;

/// One bridge's table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Table {
    /// By which equals are told apart.
    pub(crate) bridge: u64,
    /// The nodes that it shows in ROS, and what its ends stand for: by ROS's names, and publishers with the gids of those in ROS.
    pub(crate) graph: RemoteGraph,
}

/// Others' tables, by who publishes them.
#[derive(Clone, Default)]
pub(crate) struct Tables(Arc<Mutex<BTreeMap<Gid, Heard>>>);

struct Heard {
    /// `None`: it was not understood, which is said once.
    table: Option<Arc<Table>>,
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
            let table = parse(buffer.bytes()).map(Arc::new);
            let mut all = self.all();
            let known = all.get(&info.gid);
            if table.is_none() && known.is_none_or(|heard| heard.table.is_some()) {
                tracing::warn!(
                    "what another bridge tells on {TOPIC} is not understood: run the same version of Tautline for all bridges of a ROS \
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

    /// Those whose publishers are there, of all that are on the topic now.
    pub(crate) fn of(&self, publishers: &BTreeSet<Gid>) -> Vec<Arc<Table>> {
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

/// The text in a message; a claim.
fn parse(bytes: &[u8]) -> Option<Table> {
    let (head, body) = bytes.split_at_checked(ENCAPSULATION.len())?;
    let (len, text) = body.split_at_checked(4)?;
    let len = usize::try_from(u32::from_le_bytes(len.try_into().ok()?)).ok()?;
    if head[..2] != ENCAPSULATION[..2] || len > MAX_BYTES {
        return None;
    }
    let mut table: Table = serde_json::from_slice(text.get(..len.checked_sub(1)?)?).ok()?;
    table.graph.nodes.truncate(MAX_ENDS);
    table.graph.endpoints.truncate(MAX_ENDS);
    table.graph.services.truncate(MAX_ENDS);
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

/// What tables are written in.
pub(crate) fn support() -> Result<MessageSupport, BridgeError> {
    let found = Types::new().find(TYPE, None);
    Ok(found.map_err(|error| BridgeError::Table(error.to_string()))?.support)
}

impl OwnTable {
    pub(crate) fn new(node: &Arc<Node>, support: &MessageSupport) -> Result<Self, RclError> {
        let publisher = RosPublisher::new(node, TOPIC, support, &qos())?;
        Ok(OwnTable { publisher, buffer: SerializedMessage::new()?, said: None })
    }

    /// Publishes what is otherwise than before.
    ///
    /// # Errors
    /// Why that is not possible, said once.
    pub(crate) fn say(&mut self, table: Table) -> Result<(), String> {
        if self.said.as_ref() == Some(&table) {
            return Ok(());
        }
        let text = serde_json::to_vec(&table).map_err(|error| error.to_string())?;
        // Not again as long as nothing else changes.
        let graph = &self.said.insert(table).graph;
        let ends = graph.nodes.len().max(graph.endpoints.len()).max(graph.services.len());
        if text.len() >= MAX_BYTES || ends > MAX_ENDS {
            return Err(format!(
                "{ends} ends in {} bytes are more than the {MAX_ENDS} and {MAX_BYTES} that a table can have: leave some out (--deny)",
                text.len()
            ));
        }
        let len = text.len() as u32 + 1;
        let body = [&len.to_le_bytes()[..], &text, &[0]].concat();
        let sent =
            self.buffer.assign(&ENCAPSULATION, &body).and_then(|()| self.publisher.publish(&self.buffer));
        sent.map_err(|error| {
            self.said = None;
            error.reason
        })
    }
}

/// By which others' tables are heard.
pub(crate) fn subscription(node: &Arc<Node>, support: &MessageSupport) -> Result<RosSubscription, RclError> {
    // Of each of them the last.
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
        let table = Table { bridge: 3, graph: RemoteGraph::default() };
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
            let table = Some(Arc::<Table>::default());
            tables.all().insert(gid, Heard { table, is_seen: false, since })
        };
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
