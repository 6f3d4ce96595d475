// SPDX-License-Identifier: MIT OR Apache-2.0
//! The nodes and endpoints of other hosts, from their liveliness tokens. Bounded, however many tokens a hostile peer declares.

use crate::kept::SessionId;
use crate::origin::origin;
use crate::remote::{RemoteEntity, entity};
use crate::wire::{EndpointKind, NodeName, Token, TopicKey, TypeId};
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::time::{Duration, Instant};
use tautline_relay::FarGraph;
use tautline_schema::{TypeHash, TypeName};
use tautline_transport::{Durability, EndpointKind::Publisher, Gid, RemoteNode};

/// How long, and for how many publishers, a normal end is remembered.
const ENDED_TIME: Duration = Duration::from_secs(10);
const MOST_ENDED: usize = 4096;

/// Limits of what is stored about other hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GraphLimits {
    /// Maximum of tokens: nodes and endpoints. 8192 by default.
    pub tokens: usize,
    /// Maximum of tokens per session; a token may state a false session id. 4096 by default.
    pub tokens_per_session: usize,
}

impl Default for GraphLimits {
    fn default() -> Self {
        GraphLimits { tokens: 8192, tokens_per_session: 4096 }
    }
}

/// Nodes and endpoints of other hosts.
pub(crate) struct Graph {
    domain: u32,
    own_zid: u128,
    limits: GraphLimits,
    /// Tokens with their entities, by key expression, which also identifies a token when it disappears.
    tokens: HashMap<String, (Token, RemoteEntity)>,
    per_session: HashMap<u128, OfSession>,
    /// Tags of publishers that ended normally, and when that was announced.
    ended: VecDeque<(Instant, u64)>,
    /// Refused tokens, by reason.
    pub(crate) refused: BTreeMap<String, u64>,
    /// Whether a token was refused for lack of room for any.
    is_incomplete: bool,
    /// Whether a session of which a token was refused has room now.
    has_room: bool,
}

/// The tokens of a session.
#[derive(Default)]
struct OfSession {
    tokens: usize,
    /// Whether others were refused for lack of room for this session's.
    is_incomplete: bool,
}

impl Graph {
    pub(crate) fn new(domain: u32, own_zid: u128, limits: GraphLimits) -> Self {
        let (tokens, per_session, ended, refused, is_incomplete, has_room) = Default::default();
        Graph { domain, own_zid, limits, tokens, per_session, ended, refused, is_incomplete, has_room }
    }

    /// Adds a token that appeared. Returns whether the graph changed.
    pub(crate) fn insert(&mut self, key: &str) -> bool {
        let token = match Token::parse(key) {
            Ok(token) => token,
            Err(reason) => {
                *self.refused.entry(reason.to_string()).or_default() += 1;
                return false;
            }
        };
        if token.zid == self.own_zid || token.domain != self.domain || self.tokens.contains_key(key) {
            return false;
        }
        let of_session = self.per_session.get_mut(&token.zid);
        let is_full = of_session.as_ref().map_or(0, |of| of.tokens) >= self.limits.tokens_per_session;
        if is_full || self.tokens.len() >= self.limits.tokens {
            *self.refused.entry("over the limit".into()).or_default() += 1;
            match of_session.filter(|_| is_full) {
                Some(of_session) => of_session.is_incomplete = true,
                None => self.is_incomplete = true,
            }
            return false;
        }
        self.per_session.entry(token.zid).or_default().tokens += 1;
        let entity = entity(&token);
        self.tokens.insert(key.into(), (token, entity));
        true
    }

    /// Removes a token that disappeared. Returns whether the graph changed.
    pub(crate) fn remove(&mut self, key: &str) -> bool {
        let Some((token, _)) = self.tokens.remove(key) else { return false };
        if let Some(of_session) = self.per_session.get_mut(&token.zid) {
            of_session.tokens -= 1;
            self.has_room |= std::mem::take(&mut of_session.is_incomplete);
            if of_session.tokens == 0 {
                self.per_session.remove(&token.zid);
            }
        }
        true
    }

    pub(crate) fn far_graph(&self) -> FarGraph {
        let mut there = FarGraph { ended: self.ended(), ..FarGraph::default() };
        for (token, entity) in self.tokens.values() {
            match entity {
                RemoteEntity::Node(name) => {
                    let (name, enclave) = (name.clone(), token.node.enclave.clone());
                    let node = RemoteNode { name, enclave, origin: origin(token) };
                    there.nodes.push((node, token.zid));
                }
                RemoteEntity::Topic(end) => {
                    if end.kind == Publisher {
                        there.publishers.entry(end.topic.clone()).or_default().insert(end.gid);
                    }
                    there.endpoints.push((end.clone(), token.zid));
                }
                RemoteEntity::Service(end) => there.services.push((end.clone(), token.zid)),
            }
        }
        there
    }

    pub(crate) fn publishers(&self, topic: &str) -> BTreeSet<Gid> {
        let topics = self.tokens.values().filter_map(|(_, entity)| match entity {
            RemoteEntity::Topic(end) if end.kind == Publisher && end.topic == topic => Some(end.gid),
            _ => None,
        });
        topics.collect()
    }

    /// Stores that a gateway announced the normal end of a publisher, whose token disappears next.
    pub(crate) fn note_ended(&mut self, tag: u64) {
        if self.ended.len() >= MOST_ENDED {
            self.ended.pop_front();
        }
        self.ended.push_back((Instant::now(), tag));
    }

    /// Tags of publishers with a recent announcement of a normal end.
    pub(crate) fn ended(&self) -> BTreeSet<u64> {
        let recent = self.ended.iter().filter(|(since, _)| since.elapsed() < ENDED_TIME);
        recent.map(|(_, tag)| *tag).collect()
    }

    /// Whether all tokens must be requested again: some were refused for lack of room, and there is room now.
    pub(crate) fn wants_resync(&mut self) -> bool {
        let wants = self.is_incomplete && self.tokens.len() < self.limits.tokens / 4 * 3;
        self.is_incomplete &= !wants;
        std::mem::take(&mut self.has_room) || wants
    }

    pub(crate) fn publishing_nodes(&self, key: &TopicKey) -> impl Iterator<Item = &NodeName> {
        self.tokens()
            .filter(|token| {
                token.endpoint.as_ref().is_some_and(|end| {
                    end.kind == EndpointKind::Publisher && end.name == key.topic && end.type_id == key.type_id
                })
            })
            .map(|token| &token.node)
    }

    /// The number of each session's publishers that keep samples for late joiners, by topic.
    pub(crate) fn keeping(&self) -> HashMap<(&str, &TypeId), BTreeMap<SessionId, usize>> {
        let mut keeping = HashMap::<_, BTreeMap<_, _>>::new();
        for token in self.tokens() {
            let Some(end) = &token.endpoint else { continue };
            if end.kind == EndpointKind::Publisher && end.qos.durability == Durability::TransientLocal {
                let of_topic = keeping.entry((&*end.name, &end.type_id)).or_default();
                *of_topic.entry(token.zid.to_le_bytes()).or_default() += 1;
            }
        }
        keeping
    }

    /// The hash that other hosts state for a topic's type, if they agree.
    pub(crate) fn hash_of(&self, topic: &str, name: &TypeName) -> Option<TypeHash> {
        let ends = self.tokens().filter_map(|token| token.endpoint.as_ref());
        let mut hashes = ends
            .filter(|end| matches!(end.kind, EndpointKind::Publisher | EndpointKind::Subscription))
            .filter(|end| end.name == topic && end.type_id.name == *name)
            .map(|end| end.type_id.hash);
        let hash = hashes.next()?;
        // If the hashes differ, none is reliable.
        hashes.all(|other| other == hash).then_some(hash)
    }

    /// All nodes and endpoints of other hosts.
    pub(crate) fn tokens(&self) -> impl Iterator<Item = &Token> {
        self.tokens.values().map(|(token, _)| token)
    }

    pub(crate) fn keys(&self) -> impl Iterator<Item = &str> {
        self.tokens.keys().map(String::as_str)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Malformed;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    fn graph(limits: GraphLimits) -> Graph {
        Graph::new(5, 0xAA, limits)
    }

    fn token(zid: u128, id: u64, kind: &str, topic: &str) -> String {
        format!(
            "@ros2_lv/5/{zid:x}/0/{id}/{kind}/%/%/n/%{topic}/std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
        )
    }

    #[test]
    fn endpoints_come_and_go() {
        let mut graph = graph(GraphLimits::default());
        let counts = |graph: &Graph| {
            let there = graph.far_graph();
            [there.nodes.len(), there.endpoints.len(), there.services.len(), there.publishers.len()]
        };
        assert!(graph.insert("@ros2_lv/5/1/0/0/NN/%/%/n"));
        assert!(graph.insert(&token(1, 1, "MP", "x")));
        assert!(!graph.insert(&token(1, 1, "MP", "x")), "known");
        assert!(graph.insert(&token(2, 1, "MS", "x")));
        assert!(!graph.insert(&token(0xAA, 1, "MS", "x")), "own");
        assert!(graph.insert(&token(1, 2, "SS", "service")));
        assert!(!graph.insert(&token(1, 1, "MP", "x").replace("/5/", "/6/")), "another domain");
        assert_eq!(counts(&graph), [1, 2, 1, 1]);

        assert!(!graph.remove(&token(9, 9, "MP", "x")), "never seen");
        assert!(graph.remove(&token(1, 1, "MP", "x")) && graph.remove(&token(2, 1, "MS", "x")));
        assert_eq!(counts(&graph), [1, 0, 1, 0]);
    }

    #[test]
    fn spellings_of_one_endpoint_go_one_by_one() {
        let mut graph = graph(GraphLimits::default());
        let (short, long) = (token(1, 1, "MP", "x"), token(1, 1, "MP", "x").replace("/::,10", "/1:2:1,10"));
        graph.insert(&short);
        graph.insert(&long);
        graph.remove(&short);
        assert_eq!(graph.far_graph().endpoints.len(), 1);
        graph.remove(&long);
        assert_eq!(graph.far_graph().endpoints.len(), 0);
    }

    #[test]
    fn memory_is_bounded_and_refusals_are_counted() {
        let limits = GraphLimits { tokens: 100, tokens_per_session: 60 };
        let mut graph = graph(limits);
        for n in 0..10_000 {
            graph.insert(&token(1, n, "MP", &format!("t{n}")));
        }
        assert_eq!(graph.tokens().count(), 60);
        assert!(graph.insert(&token(2, 0, "MP", "other")), "others still get in");
        for zid in 3..10_000 {
            graph.insert(&token(zid, 0, "MS", "x"));
        }
        assert_eq!(graph.tokens().count(), 100);
        for n in 0..1000 {
            graph.insert(&format!("@ros2_lv/5/garbage/{n}"));
        }
        let over = 9_940 + 9_996 - 39; // 0xAA is our own
        let refused = [(Malformed::Zid.to_string(), 1000), ("over the limit".into(), over)];
        assert_eq!(graph.refused, BTreeMap::from(refused));

        assert!(!graph.wants_resync(), "no room yet");
        for n in 0..60 {
            graph.remove(&token(1, n, "MP", &format!("t{n}")));
        }
        assert!(graph.wants_resync() && !graph.wants_resync());
    }

    /// It goes on announcing them, so a resync would find no room for them either.
    #[test]
    fn a_session_over_its_limit_causes_no_resync_before_it_has_room() {
        let mut graph = graph(GraphLimits { tokens: 100, tokens_per_session: 8 });
        for n in 0..9 {
            graph.insert(&token(1, n, "MP", "x"));
            graph.insert(&token(2, n, "MS", "x"));
        }
        graph.insert(&token(3, 0, "MP", "x"));
        assert!(graph.remove(&token(3, 0, "MP", "x")) && !graph.wants_resync(), "another session's");
        assert!(graph.remove(&token(1, 0, "MP", "x")));
        assert!(graph.wants_resync() && !graph.wants_resync());
    }
}
