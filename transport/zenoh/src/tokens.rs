// SPDX-License-Identifier: MIT OR Apache-2.0
//! The domain's liveliness tokens on the network: one for each node and endpoint. [`Tokens`] decides; the caller declares them.

use crate::origin::note;
use crate::wire::{CPU_BACKEND, Endpoint, EndpointKind, NodeName, Token, TypeId, WireQos, endpoint_gid};
use std::collections::{BTreeMap, BTreeSet, HashSet};
use tautline_transport::{Durability, Gid, Origin};

/// A publisher, subscription, server or client of this host, or one that a bridge announces here.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct LocalEndpoint {
    /// Identifies the endpoint on this host; for a publisher, the GID in its samples.
    pub(crate) gid: Gid,
    pub(crate) kind: EndpointKind,
    /// Fully qualified name.
    pub(crate) topic: String,
    pub(crate) type_id: TypeId,
    /// Quality of service.
    pub(crate) qos: WireQos,
    pub(crate) node: NodeName,
    /// Its origin, as announced on the network.
    pub(crate) origin: Origin,
}

/// A change to make on the network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum TokenChange {
    Declare(Token),
    Withdraw(Token),
    /// The publisher with this tag ended normally; its token is withdrawn next.
    Ended(u64),
}

pub(crate) struct Tokens {
    zid: u128,
    domain: u32,
    next_id: u64,
    nodes: BTreeMap<(NodeName, Origin), Token>,
    ends: BTreeMap<Gid, DeclaredEndpoint>,
}

struct DeclaredEndpoint {
    end: LocalEndpoint,
    token: Token,
    wire_gid: Gid,
}

/// Identifies the node of an endpoint: the node's full name, and the origin of both, without its tag.
type NodeKey = (String, Origin);

fn node_key(name: &NodeName, origin: &Origin) -> NodeKey {
    (name.full_name(), Origin { tag: 0, ..origin.clone() })
}

impl Tokens {
    /// No tokens yet.
    pub(crate) fn new(domain: u32, zid: u128) -> Self {
        Tokens { zid, domain, next_id: 0, nodes: BTreeMap::new(), ends: BTreeMap::new() }
    }

    /// The publisher's GID on the network, if announced.
    pub(crate) fn wire_gid(&self, gid: &Gid) -> Option<Gid> {
        self.ends.get(gid).map(|declared| declared.wire_gid)
    }

    /// The announced publishers: their topics and GIDs on the network.
    pub(crate) fn publishers(&self) -> impl Iterator<Item = (&str, Gid)> {
        let publishers = self.ends.values().filter(|declared| declared.end.kind == EndpointKind::Publisher);
        publishers.map(|declared| (&*declared.end.topic, declared.wire_gid))
    }

    /// The changes, in order, that announce exactly these nodes and endpoints, and that publishers with tags in `ended` ended normally.
    pub(crate) fn update(
        &mut self,
        nodes: &[(NodeName, Origin)],
        ends: Vec<LocalEndpoint>,
        ended: &HashSet<u64>,
    ) -> Vec<TokenChange> {
        let mut changes = Vec::new();
        // By name and path: an endpoint states nothing else about its node.
        let mut wanted = BTreeMap::<NodeKey, BTreeSet<(NodeName, Origin)>>::new();
        for (name, origin) in nodes {
            wanted.entry(node_key(name, origin)).or_default().insert((name.clone(), origin.clone()));
        }
        for end in &ends {
            let key = node_key(&end.node, &end.origin);
            let tag = Origin::tag_of(&format!("{:x?} {}", key.1.path.first(), key.0));
            let unlisted = || BTreeSet::from([(end.node.clone(), Origin { tag, ..end.origin.clone() })]);
            wanted.entry(key).or_insert_with(unlisted);
        }
        let used: BTreeSet<(NodeName, Origin)> = wanted.values().flatten().cloned().collect();
        for key in &used {
            if !self.nodes.contains_key(key) {
                let (domain, zid, node_id) = (self.domain, self.zid, self.id());
                let (node, note) = (key.0.clone(), note(&key.1));
                let token = Token { domain, zid, node_id, node, endpoint: None, note };
                changes.push(TokenChange::Declare(token.clone()));
                self.nodes.insert(key.clone(), token);
            }
        }
        // Of several nodes with one key, the oldest gets the endpoints.
        let oldest = |nodes: &BTreeSet<(NodeName, Origin)>| {
            nodes.iter().filter_map(|node| self.nodes.get(node)).map(|token| token.node_id).min()
        };
        let node_ids: BTreeMap<NodeKey, u64> =
            wanted.iter().filter_map(|(key, nodes)| Some((key.clone(), oldest(nodes)?))).collect();
        let node_of = |end: &LocalEndpoint| node_ids.get(&node_key(&end.node, &end.origin)).copied();
        let now: BTreeMap<Gid, LocalEndpoint> = ends.into_iter().map(|end| (end.gid, end)).collect();
        // A changed endpoint gets a new token. Its old token is withdrawn last, so that other hosts always see one.
        let mut replaced = Vec::new();
        self.ends.retain(|gid, declared| match now.get(gid) {
            Some(end) if *end == declared.end && node_of(end) == Some(declared.token.node_id) => true,
            Some(_) => {
                replaced.push(TokenChange::Withdraw(declared.token.clone()));
                false
            }
            None => {
                let tag = declared.end.origin.tag;
                let has_ended = declared.end.kind == EndpointKind::Publisher && ended.contains(&tag);
                changes.extend(has_ended.then_some(TokenChange::Ended(tag)));
                changes.push(TokenChange::Withdraw(declared.token.clone()));
                false
            }
        });
        for (gid, end) in now {
            if !self.ends.contains_key(&gid) {
                let token = self.token(&end, node_of(&end).unwrap_or_default());
                changes.push(TokenChange::Declare(token.clone()));
                self.ends.insert(gid, DeclaredEndpoint { end, wire_gid: endpoint_gid(&token), token });
            }
        }
        changes.append(&mut replaced);
        self.nodes.retain(|node, token| {
            let is_used = used.contains(node);
            changes.extend((!is_used).then(|| TokenChange::Withdraw(token.clone())));
            is_used
        });
        changes
    }

    fn id(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }

    fn token(&mut self, end: &LocalEndpoint, node_id: u64) -> Token {
        let LocalEndpoint { kind, topic, type_id, qos, node, origin, .. } = end.clone();
        // Tells publishers of newer nodes on which key to send: see `TopicKey::cpu_group`.
        let is_volatile = kind == EndpointKind::Subscription && qos.durability == Durability::Volatile;
        let suffix = if is_volatile { CPU_BACKEND.to_owned() } else { String::new() };
        let endpoint = Endpoint { id: self.id(), kind, name: topic, type_id, qos, suffix };
        let note = note(&origin);
        Token { domain: self.domain, zid: self.zid, node_id, node, endpoint: Some(endpoint), note }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::TopicKey;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    fn end(gid: u8, kind: EndpointKind, topic: &str) -> LocalEndpoint {
        let key = TopicKey::parse(&format!("5/{topic}/std_msgs::msg::dds_::String_/{HASH}")).unwrap();
        LocalEndpoint {
            gid: Gid([gid; 16]),
            kind,
            topic: key.topic,
            type_id: key.type_id,
            qos: WireQos { depth: 10, ..WireQos::default() },
            node: NodeName::new("/", "n"),
            origin: Origin { tag: gid.into(), ..Origin::default() },
        }
    }

    fn publisher(gid: u8) -> LocalEndpoint {
        end(gid, EndpointKind::Publisher, "x")
    }

    /// Changes in short: `+ Publisher /x`.
    fn declared(changes: &[TokenChange]) -> Vec<String> {
        let token = |token: &Token| match &token.endpoint {
            None => format!("node {}", token.node.full_name()),
            Some(end) => format!("{:?} {}", end.kind, end.name),
        };
        let one = |change: &TokenChange| match change {
            TokenChange::Declare(declared) => format!("+ {}", token(declared)),
            TokenChange::Withdraw(withdrawn) => format!("- {}", token(withdrawn)),
            TokenChange::Ended(tag) => format!("ended {tag}"),
        };
        changes.iter().map(one).collect()
    }

    const NONE: [&str; 0] = [];

    fn tell(tokens: &mut Tokens, ends: &[LocalEndpoint]) -> Vec<String> {
        declared(&tokens.update(&[], ends.to_vec(), &HashSet::new()))
    }

    #[test]
    fn nodes_and_ends_of_all_kinds_are_told() {
        let mut tokens = Tokens::new(5, 1);
        let (service, client) = (end(1, EndpointKind::Service, "add"), end(2, EndpointKind::Client, "add"));
        let all = [service, client.clone()];
        assert_eq!(tell(&mut tokens, &all), ["+ node /n", "+ Service /add", "+ Client /add"]);
        assert_eq!(tell(&mut tokens, &all), NONE);
        assert_eq!(tell(&mut tokens, &[client]), ["- Service /add"]);
        assert_eq!(tell(&mut tokens, &[]), ["- Client /add", "- node /n"]);
        // A node without endpoints.
        let node = [(NodeName::new("/a", "m"), Origin { tag: 99, ..Origin::default() })];
        let mut changes = |ends| declared(&tokens.update(&node, ends, &HashSet::new()));
        assert_eq!(changes(vec![]), ["+ node /a/m"]);
        assert_eq!(changes(vec![publisher(1)]), ["+ node /n", "+ Publisher /x"]);
        assert_eq!(changes(vec![]), ["- Publisher /x", "- node /n"]);
    }

    #[test]
    fn of_a_publisher_that_ended_that_is_said_before_its_token_goes() {
        let mut tokens = Tokens::new(5, 1);
        tell(&mut tokens, &[publisher(1), publisher(2), end(3, EndpointKind::Subscription, "x")]);
        // Its tag is its GID's here; only publishers' ends are announced.
        let changes = tokens.update(&[], vec![], &HashSet::from([1, 3, 9]));
        let expected = ["ended 1", "- Publisher /x", "- Publisher /x", "- Subscription /x", "- node /n"];
        assert_eq!(declared(&changes), expected);
    }

    #[test]
    fn what_is_told_anew_is_there_all_the_time() {
        let mut tokens = Tokens::new(5, 1);
        tell(&mut tokens, &[publisher(1)]);
        let before = tokens.wire_gid(&Gid([1; 16]));
        let farther = Origin { path: vec![3], ..publisher(1).origin };
        let changed = LocalEndpoint { origin: farther, ..publisher(1) };
        let expected = ["+ node /n", "+ Publisher /x", "- Publisher /x", "- node /n"];
        assert_eq!(tell(&mut tokens, &[changed]), expected);
        assert_ne!(tokens.wire_gid(&Gid([1; 16])), before);
        assert_eq!(tokens.publishers().collect::<Vec<_>>().len(), 1);
    }

    #[test]
    fn ids_are_never_used_twice() {
        let mut tokens = Tokens::new(5, 1);
        let mut ids = BTreeSet::new();
        for n in 0..100 {
            for change in tokens.update(&[], vec![publisher(n)], &HashSet::new()) {
                if let TokenChange::Declare(token) = change {
                    assert!(ids.insert(token.endpoint.map_or(token.node_id, |endpoint| endpoint.id)));
                }
            }
        }
    }
}
