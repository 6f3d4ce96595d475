// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is known of other hosts: their nodes and endpoints, from their liveliness tokens. Bounded, however many tokens
//! a hostile peer declares.

use crate::lifespans::Lifespans;
use crate::origin::origin;
use crate::wire::{Endpoint, EndpointKind, Malformed, NodeName, Token, TopicKey, endpoint_gid};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_relay::Transit;
use tautline_rt::clock::nanoseconds;
use tautline_transport::{Gid, Origin, Rank};

/// How long, and of how many publishers, it is known that they have ended.
const ENDED_TIME: Duration = Duration::from_secs(10);
const MOST_ENDED: usize = 4096;

/// Limits of what is kept of other hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GraphLimits {
    /// Most tokens in all: nodes and endpoints. 8192 by default.
    pub tokens: usize,
    /// Most tokens of one session, as far as tokens can be believed about whose they are. 4096 by default.
    pub tokens_per_session: usize,
}

impl Default for GraphLimits {
    fn default() -> Self {
        GraphLimits { tokens: 8192, tokens_per_session: 4096 }
    }
}

/// What a token changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// Nothing that topics depend on: a node, a service, a token known already, one of this session's own.
    None,
    /// The endpoints of this topic.
    Topic(TopicKey),
    /// Refused: the limit is reached.
    Full,
}

/// How many tokens were refused, by reason.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    /// Over a limit of [`GraphLimits`].
    pub full: u64,
    /// Not what rmw_zenoh writes.
    pub malformed: BTreeMap<Malformed, u64>,
}

/// An endpoint of another host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteEndpoint {
    /// Zenoh's id of its session.
    pub zid: u128,
    /// Its identifier in attachments.
    pub gid: Gid,
    /// Its node.
    pub node: NodeName,
    /// What it is.
    pub endpoint: Endpoint,
    /// Where it was first.
    pub origin: Origin,
}

/// The endpoints of one topic on other hosts.
#[derive(Clone, Debug, Default)]
struct Topic {
    publishers: Vec<RemoteEndpoint>,
    subscriptions: Vec<RemoteEndpoint>,
}

/// Nodes and endpoints of other hosts.
pub struct Graph {
    domain: u32,
    own_zid: u128,
    limits: GraphLimits,
    /// By the token's text as it came, which is how its end is announced.
    tokens: HashMap<String, Token>,
    per_session: HashMap<u128, usize>,
    topics: BTreeMap<TopicKey, Topic>,
    lifespans: Arc<Lifespans>,
    transit: Transit,
    /// Tags of what came or went since they were taken last.
    touched: Vec<u64>,
    /// Tags of publishers that have ended by themselves, and since when that is known.
    ended: VecDeque<(Instant, u64)>,
    refused: Refused,
    /// Whether a token was refused for lack of room since the last look.
    is_incomplete: bool,
}

impl Graph {
    /// An empty graph of `domain`, seen from the session `own_zid`; `transit` is of the same session.
    pub fn new(domain: u32, own_zid: u128, limits: GraphLimits, transit: Transit) -> Self {
        Graph {
            domain,
            own_zid,
            limits,
            tokens: HashMap::new(),
            per_session: HashMap::new(),
            topics: BTreeMap::new(),
            lifespans: Arc::default(),
            transit,
            touched: Vec::new(),
            ended: VecDeque::new(),
            refused: Refused::default(),
            is_incomplete: false,
        }
    }

    /// A token appeared.
    pub fn insert(&mut self, key: &str) -> Change {
        let token = match Token::parse(key) {
            Ok(token) => token,
            Err(reason) => {
                *self.refused.malformed.entry(reason).or_default() += 1;
                return Change::None;
            }
        };
        if token.zid == self.own_zid || token.domain != self.domain || self.tokens.contains_key(key) {
            return Change::None;
        }
        let of_session = self.per_session.get(&token.zid).copied().unwrap_or(0);
        if self.tokens.len() >= self.limits.tokens || of_session >= self.limits.tokens_per_session {
            self.refused.full += 1;
            self.is_incomplete = true;
            return Change::Full;
        }
        *self.per_session.entry(token.zid).or_default() += 1;
        let change = match remote_endpoint(&token) {
            Some((key, endpoint)) => {
                self.note_lifespan(&endpoint, true);
                let topic = self.topics.entry(key.clone()).or_default();
                topic.side(endpoint.endpoint.kind).push(endpoint);
                Change::Topic(key)
            }
            None => Change::None,
        };
        let origin = origin(&token);
        self.transit.insert(&origin, token.zid);
        self.touched.push(origin.tag);
        self.tokens.insert(key.into(), token);
        change
    }

    /// A token is gone.
    pub fn remove(&mut self, key: &str) -> Change {
        let Some(token) = self.tokens.remove(key) else { return Change::None };
        if let Some(count) = self.per_session.get_mut(&token.zid) {
            *count -= 1;
            if *count == 0 {
                self.per_session.remove(&token.zid);
            }
        }
        let origin = origin(&token);
        self.transit.remove(&origin, token.zid);
        self.touched.push(origin.tag);
        let Some((key, gone)) = remote_endpoint(&token) else { return Change::None };
        self.note_lifespan(&gone, false);
        if let Some(topic) = self.topics.get_mut(&key) {
            let side = topic.side(gone.endpoint.kind);
            // One: two tokens may differ in spelling only.
            if let Some(at) = side.iter().position(|endpoint| *endpoint == gone) {
                side.remove(at);
            }
            if topic.publishers.is_empty() && topic.subscriptions.is_empty() {
                self.topics.remove(&key);
            }
        }
        Change::Topic(key)
    }

    fn note_lifespan(&self, end: &RemoteEndpoint, is_there: bool) {
        if end.endpoint.kind != EndpointKind::Publisher {
            return;
        }
        if let Some(lifespan) = end.endpoint.qos.lifespan.to_duration() {
            let lifespan_ns = nanoseconds(lifespan);
            self.lifespans.set(end.gid, is_there.then_some(lifespan_ns));
        }
    }

    /// A gateway says that a publisher has ended by itself, whose token goes next.
    pub(crate) fn note_ended(&mut self, tag: u64) {
        if self.ended.len() >= MOST_ENDED {
            self.ended.pop_front();
        }
        self.ended.push_back((Instant::now(), tag));
    }

    /// The tags of publishers that have ended by themselves, as far as that is said and not long ago.
    pub(crate) fn ended(&self) -> BTreeSet<u64> {
        let recent = self.ended.iter().filter(|(since, _)| since.elapsed() < ENDED_TIME);
        recent.map(|(_, tag)| *tag).collect()
    }

    /// The lifespans of publishers on other hosts, kept up to date.
    pub(crate) fn lifespans(&self) -> &Arc<Lifespans> {
        &self.lifespans
    }

    /// Whether tokens were refused for lack of room, and there is room now: time to ask for all tokens again.
    pub fn wants_resync(&mut self) -> bool {
        let wants = self.is_incomplete && self.tokens.len() < self.limits.tokens / 4 * 3;
        self.is_incomplete &= !wants;
        wants
    }

    /// Publishers of a topic on other hosts.
    pub fn publishers(&self, key: &TopicKey) -> &[RemoteEndpoint] {
        self.topics.get(key).map_or(&[], |topic| &topic.publishers)
    }

    /// Whether what a publisher sends comes into the domain through this gateway.
    pub fn is_carried(&self, publisher: &RemoteEndpoint) -> bool {
        self.transit.carries(&publisher.origin, publisher.zid)
    }

    /// Subscriptions of a topic on other hosts, that are not the domain's own seen through others.
    pub fn subscriptions(&self, key: &TopicKey) -> impl Iterator<Item = &RemoteEndpoint> {
        let all = self.topics.get(key).into_iter().flat_map(|topic| &topic.subscriptions);
        all.filter(|end| self.transit.told(&end.origin, end.zid).is_some())
    }

    /// Whether what a token stands for comes into the domain through this gateway.
    pub(crate) fn carries(&self, token: &Token) -> bool {
        self.transit.carries(&origin(token), token.zid)
    }

    /// How the domain is told of what a token stands for; `None`: not at all.
    pub(crate) fn told(&self, token: &Token) -> Option<Origin> {
        self.transit.told(&origin(token), token.zid)
    }

    /// How the network is told of what the domain has; `None`: not at all.
    pub(crate) fn announced(&self, origin: &Origin) -> Option<Origin> {
        self.transit.announced(origin)
    }

    /// What others tell of in the domain. The tags of which that is otherwise than before.
    pub(crate) fn set_rivals(&mut self, rivals: &HashMap<u64, Rank>) -> HashSet<u64> {
        self.transit.set_rivals(rivals)
    }

    /// The tags of what came or went since the last call.
    pub(crate) fn take_touched(&mut self) -> Vec<u64> {
        std::mem::take(&mut self.touched)
    }

    /// Topics with a publisher of one of these tags.
    pub(crate) fn topics_of(&self, tags: &HashSet<u64>) -> Vec<TopicKey> {
        let has = |topic: &Topic| topic.publishers.iter().any(|end| tags.contains(&end.origin.tag));
        self.topics.iter().filter(|(_, topic)| has(topic)).map(|(key, _)| key.clone()).collect()
    }

    /// All topics with an endpoint on another host.
    pub fn topics(&self) -> impl Iterator<Item = &TopicKey> {
        self.topics.keys()
    }

    /// All nodes and endpoints of other hosts.
    pub fn tokens(&self) -> impl Iterator<Item = &Token> {
        self.tokens.values()
    }

    /// How many tokens are kept.
    pub(crate) fn len(&self) -> usize {
        self.tokens.len()
    }

    /// The texts of all tokens that are kept.
    pub(crate) fn keys(&self) -> impl Iterator<Item = &str> {
        self.tokens.keys().map(String::as_str)
    }

    /// How many tokens were refused.
    pub fn refused(&self) -> &Refused {
        &self.refused
    }
}

impl Topic {
    fn side(&mut self, kind: EndpointKind) -> &mut Vec<RemoteEndpoint> {
        match kind {
            EndpointKind::Publisher => &mut self.publishers,
            _ => &mut self.subscriptions,
        }
    }
}

/// `None` for a node and for services, which are no topics.
fn remote_endpoint(token: &Token) -> Option<(TopicKey, RemoteEndpoint)> {
    let endpoint = token.endpoint.clone()?;
    if !matches!(endpoint.kind, EndpointKind::Publisher | EndpointKind::Subscription) {
        return None;
    }
    let key =
        TopicKey { domain: token.domain, topic: endpoint.name.clone(), type_id: endpoint.type_id.clone() };
    Some((
        key,
        RemoteEndpoint {
            zid: token.zid,
            gid: endpoint_gid(token),
            node: token.node.clone(),
            endpoint,
            origin: origin(token),
        },
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    fn graph(limits: GraphLimits) -> Graph {
        Graph::new(5, 0xAA, limits, Transit::to_network(1, 2, 0xAA, "host"))
    }

    fn token(zid: u128, id: u64, kind: &str, topic: &str) -> String {
        format!(
            "@ros2_lv/5/{zid:x}/0/{id}/{kind}/%/%/n/%{topic}/std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
        )
    }

    fn key(topic: &str) -> TopicKey {
        TopicKey::parse(&format!("5/{topic}/std_msgs::msg::dds_::String_/{HASH}")).unwrap()
    }

    #[test]
    fn endpoints_come_and_go() {
        let mut graph = graph(GraphLimits::default());
        assert_eq!(graph.insert("@ros2_lv/5/1/0/0/NN/%/%/n"), Change::None);
        assert_eq!(graph.insert(&token(1, 1, "MP", "x")), Change::Topic(key("x")));
        assert_eq!(graph.insert(&token(1, 1, "MP", "x")), Change::None, "known");
        assert_eq!(graph.insert(&token(2, 1, "MS", "x")), Change::Topic(key("x")));
        assert_eq!(graph.insert(&token(0xAA, 1, "MS", "x")), Change::None, "own");
        assert_eq!(graph.insert(&token(1, 2, "SS", "service")), Change::None);
        assert_eq!(
            graph.insert(&token(1, 1, "MP", "x").replace("/5/", "/6/")),
            Change::None,
            "another domain"
        );
        assert_eq!((graph.publishers(&key("x")).len(), graph.subscriptions(&key("x")).count()), (1, 1));
        assert_eq!((graph.topics().count(), graph.tokens().count()), (1, 4));

        assert_eq!(graph.remove(&token(9, 9, "MP", "x")), Change::None, "never seen");
        assert_eq!(graph.remove(&token(1, 1, "MP", "x")), Change::Topic(key("x")));
        assert_eq!(graph.remove(&token(2, 1, "MS", "x")), Change::Topic(key("x")));
        assert_eq!((graph.topics().count(), graph.tokens().count()), (0, 2));
    }

    #[test]
    fn spellings_of_one_endpoint_go_one_by_one() {
        let mut graph = graph(GraphLimits::default());
        let (short, long) = (token(1, 1, "MP", "x"), token(1, 1, "MP", "x").replace("/::,10", "/1:2:1,10"));
        graph.insert(&short);
        graph.insert(&long);
        graph.remove(&short);
        assert_eq!(graph.publishers(&key("x")).len(), 1);
        graph.remove(&long);
        assert_eq!(graph.publishers(&key("x")).len(), 0);
    }

    #[test]
    fn memory_is_bounded_and_refusals_are_counted() {
        let limits = GraphLimits { tokens: 100, tokens_per_session: 60 };
        let mut graph = graph(limits);
        for n in 0..10_000 {
            graph.insert(&token(1, n, "MP", &format!("t{n}")));
        }
        assert_eq!((graph.tokens().count(), graph.topics().count()), (60, 60));
        assert_eq!(
            graph.insert(&token(2, 0, "MP", "other")),
            Change::Topic(key("other")),
            "others still get in"
        );
        for zid in 3..10_000 {
            graph.insert(&token(zid, 0, "MS", "x"));
        }
        assert_eq!(graph.tokens().count(), 100);
        for n in 0..1000 {
            graph.insert(&format!("@ros2_lv/5/garbage/{n}"));
        }
        assert_eq!(graph.refused().malformed, BTreeMap::from([(Malformed::Zid, 1000)]));
        assert_eq!(graph.refused().full, 9_940 + 9_996 - 39); // 0xAA is our own

        assert!(!graph.wants_resync(), "no room yet");
        for n in 0..60 {
            graph.remove(&token(1, n, "MP", &format!("t{n}")));
        }
        assert!(graph.wants_resync() && !graph.wants_resync());
    }
}
