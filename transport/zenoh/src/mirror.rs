// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is to be mirrored: decided here from what exists on this host and on others, done elsewhere.
//!
//! A pure state machine: events go in, the [`Action`]s that follow from them come out, in the order in which they are
//! to be done. Data flows only where both ends exist:
//!
//! - *out* (shared memory to network) while a publisher is here and a subscription elsewhere. Of a transient-local
//!   publisher samples are also taken, and kept for late joiners, while nobody elsewhere listens; they cost no packet.
//! - *in* (network to shared memory) while a subscription is here and a publisher elsewhere.
//!
//! What a bridge or another gateway tells of here is announced as this host's own is: with where it was first. By that nothing goes
//! in circles, or twice: see [`Transit`](tautline_relay::Transit). The gateway's own ports are no local endpoints (whoever calls
//! [`Mirror::set_locals`] leaves them out), the session's own tokens are no remote ones.

use crate::graph::{Change, Graph, RemoteEndpoint};
use crate::origin::named;
use crate::wire::{
    CPU_BACKEND, Endpoint, EndpointKind, NodeName, Token, TopicKey, TypeId, WireQos, endpoint_gid,
};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use tautline_relay::{Filter, RELAYED_DEPTH};
use tautline_transport::{Durability, Gid, History, Origin, Rank, Reliability};

/// A node on this host, or one that others tell of here.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LocalNode {
    /// Its names.
    pub name: NodeName,
    /// Where it was first.
    pub origin: Origin,
}

/// A publisher, subscription, service or client on this host, or one that others tell of here.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LocalEndpoint {
    /// Identifies it on this host; of a publisher, the gid in its samples.
    pub gid: Gid,
    /// Which of these.
    pub kind: EndpointKind,
    /// Fully qualified name.
    pub topic: String,
    /// What it carries.
    pub type_id: TypeId,
    /// Quality of service.
    pub qos: WireQos,
    /// The node it belongs to.
    pub node: NodeName,
    /// Where it was first.
    pub origin: Origin,
}

/// A publisher whose samples go out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Writer {
    /// Its gid on this host.
    pub local_gid: Gid,
    /// Its gid on the network.
    pub wire_gid: Gid,
    /// Quality of service.
    pub qos: WireQos,
}

/// How samples are taken from shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OutQos {
    /// Length of the gateway's queue, per publisher.
    pub depth: u64,
    /// Whether a publisher of the topic serves late joiners.
    pub durability: Durability,
}

impl OutQos {
    /// What runs only grows, for a change costs samples or has them come twice.
    fn grown(self, wanted: Self) -> Self {
        let is_kept = [self, wanted].iter().any(|qos| qos.durability == Durability::TransientLocal);
        let durability = if is_kept { Durability::TransientLocal } else { Durability::Volatile };
        OutQos { depth: self.depth.max(wanted.depth), durability }
    }
}

/// How samples are taken from the network and published here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InQos {
    /// Samples that late joiners on this host are to get.
    pub depth: u64,
    /// Whether any publisher elsewhere serves late joiners and any subscription here is one.
    pub durability: Durability,
    /// Whether any publisher elsewhere is reliable.
    pub reliability: Reliability,
}

impl InQos {
    /// As [`OutQos::grown`]. The depth of what is kept doubles at least, so that changes are few.
    fn grown(self, wanted: Self) -> Self {
        let either = [self, wanted];
        let is_kept = either.iter().any(|qos| qos.durability == Durability::TransientLocal);
        let is_reliable = either.iter().any(|qos| qos.reliability == Reliability::Reliable);
        let was_kept = self.durability == Durability::TransientLocal;
        InQos {
            depth: match wanted.depth > self.depth {
                true if was_kept => wanted.depth.max(self.depth.saturating_mul(2)),
                true => wanted.depth,
                false => self.depth,
            },
            durability: if is_kept { Durability::TransientLocal } else { Durability::Volatile },
            // Of what is not kept, whoever is already heard stays so without an interruption.
            reliability: if is_kept && is_reliable { Reliability::Reliable } else { self.reliability },
        }
    }
}

/// Something to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action {
    /// Declare a liveliness token.
    Declare(Token),
    /// Withdraw it.
    Undeclare(Token),
    /// Say that the publisher with this tag has ended by itself, whose token is withdrawn next.
    SayEnded(u64),
    /// Begin to take a topic's samples from shared memory; of one that is being taken, do so with more from now on, its
    /// writers stay. Followed by the new `OpenWriter`s.
    StartOut(TopicKey, OutQos),
    /// Send this publisher's samples.
    OpenWriter(TopicKey, Writer),
    /// No longer.
    CloseWriter(TopicKey, Gid),
    /// Stop taking, and close what writers are left.
    StopOut(TopicKey),
    /// Begin to take a topic's samples from the network; of one that is being taken, begin anew: what is kept comes again.
    StartIn(TopicKey, InQos),
    /// Stop.
    StopIn(TopicKey),
    /// Others of a topic's publishers do not come in here than before: [`Mirror::passed_over_of`].
    PassOver(TopicKey),
    /// Ask for all tokens again: some were refused and there is room now.
    Resync,
}

/// The state: what exists, and what is being mirrored.
pub struct Mirror {
    graph: Graph,
    filter: Filter,
    zid: u128,
    domain: u32,
    next_id: u64,
    nodes: BTreeMap<NodeName, Token>,
    locals: BTreeMap<Gid, Local>,
    /// As it was said last: announced or not may change with what others announce.
    said: (Vec<LocalNode>, Vec<LocalEndpoint>),
    /// Of what others tell of here.
    tags: HashSet<u64>,
    /// Tags of publishers of the domain that have ended by themselves.
    ended: HashSet<u64>,
    /// Whether one of these is announced otherwise than before.
    is_stale: bool,
    /// Publishers of the domain that others announce better, and whether they are others than were asked for last.
    passed_over: (HashSet<Gid>, bool),
    out: BTreeMap<TopicKey, (OutQos, BTreeSet<Gid>)>,
    inward: BTreeMap<TopicKey, (InQos, BTreeSet<Gid>)>,
}

struct Local {
    endpoint: LocalEndpoint,
    key: TopicKey,
    announced: Option<Announced>,
}

/// By which an end finds its node's token: the full name, and where both were first and how word of them came, without a tag.
type NodeKey = (String, Origin);

fn node_key(name: &NodeName, origin: &Origin) -> NodeKey {
    (name.full_name(), Origin { tag: 0, ..origin.clone() })
}

/// How the network is told of an end.
struct Announced {
    origin: Origin,
    token: Token,
    wire_gid: Gid,
}

impl Local {
    fn is_of_topic(&self) -> bool {
        matches!(self.endpoint.kind, EndpointKind::Publisher | EndpointKind::Subscription)
    }
}

impl Mirror {
    /// Nothing exists yet. `graph` is of the same domain and session.
    pub fn new(domain: u32, zid: u128, graph: Graph, filter: Filter) -> Self {
        Mirror {
            graph,
            filter,
            zid,
            domain,
            next_id: 0,
            said: Default::default(),
            tags: HashSet::new(),
            ended: HashSet::new(),
            is_stale: false,
            passed_over: Default::default(),
            nodes: BTreeMap::new(),
            locals: BTreeMap::new(),
            out: BTreeMap::new(),
            inward: BTreeMap::new(),
        }
    }

    /// What is known of other hosts.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// Topics of this host that others have under the same name with another type or hash, and what it is there.
    pub fn mismatches(&self) -> BTreeMap<String, String> {
        let mut found = BTreeMap::new();
        let mut here = BTreeMap::<&str, BTreeSet<&TypeId>>::new();
        for local in self.locals.values().filter(|local| local.is_of_topic()) {
            here.entry(&local.key.topic).or_default().insert(&local.key.type_id);
        }
        for key in self.graph.topics() {
            let here = here.get(&*key.topic).filter(|here| !here.contains(&key.type_id));
            if let Some(type_id) = here.and_then(BTreeSet::first) {
                let (here, there) = (&type_id.name, &key.type_id.name);
                let reason = if here == there {
                    format!("another host has {there} with another definition (hash {})", key.type_id.hash)
                } else {
                    format!("it carries {here}, on another host {there}")
                };
                found.insert(key.topic.clone(), reason);
            }
        }
        found
    }

    /// A token appeared on the network.
    pub fn token_up(&mut self, key: &str) -> Vec<Action> {
        let change = self.graph.insert(key);
        self.after(change)
    }

    /// A token is gone.
    pub fn token_down(&mut self, key: &str) -> Vec<Action> {
        let change = self.graph.remove(key);
        let mut actions = self.after(change);
        if self.graph.wants_resync() {
            actions.push(Action::Resync);
        }
        actions
    }

    fn after(&mut self, change: Change) -> Vec<Action> {
        let mut actions = Vec::new();
        if let Change::Topic(key) = change {
            self.reconcile(&key, &mut actions);
        }
        // Of what the domain has from elsewhere, others announce it too, or do so no longer.
        let touched = self.graph.take_touched();
        self.is_stale |= touched.iter().any(|tag| self.tags.contains(tag));
        actions
    }

    /// What follows from what others announce of what the domain has from elsewhere. To be called after changes of the network, once for
    /// several.
    pub fn settle(&mut self) -> Vec<Action> {
        if !self.is_stale {
            return Vec::new();
        }
        let (nodes, endpoints) = std::mem::take(&mut self.said);
        self.set_locals(nodes, endpoints)
    }

    /// What others tell of here. To be followed by [`set_locals`](Self::set_locals).
    pub fn set_rivals(&mut self, rivals: &HashMap<u64, Rank>) -> Vec<Action> {
        let mut actions = Vec::new();
        let tags = self.graph.set_rivals(rivals);
        if tags.is_empty() {
            return actions;
        }
        for key in self.graph.topics_of(&tags) {
            self.reconcile_in(&key, &mut actions);
        }
        actions
    }

    /// Tags of publishers of the domain that have ended by themselves, the last ones. To be followed by
    /// [`set_locals`](Self::set_locals).
    pub fn set_ended(&mut self, ended: &[u64]) {
        self.ended = ended.iter().copied().collect();
    }

    /// A gateway says that a publisher elsewhere has ended by itself, whose token goes next.
    pub fn note_ended(&mut self, tag: u64) {
        self.graph.note_ended(tag);
    }

    /// What nodes and endpoints the domain has now, but for those that this gateway tells it of.
    pub fn set_locals(&mut self, nodes: Vec<LocalNode>, endpoints: Vec<LocalEndpoint>) -> Vec<Action> {
        let mut actions = Vec::new();
        let mut touched = BTreeSet::new();
        let now: BTreeMap<Gid, (&LocalEndpoint, Option<Origin>)> = (endpoints.iter())
            .filter(|end| self.filter.allows(&end.topic))
            .map(|end| (end.gid, (end, self.graph.announced(&end.origin))))
            .collect();
        // By name, and by how word of them came: ends say of their nodes no more.
        let mut named_nodes = BTreeMap::<NodeKey, BTreeSet<NodeName>>::new();
        for LocalNode { name, origin } in &nodes {
            if let Some(origin) = self.graph.announced(origin) {
                named_nodes.entry(node_key(name, &origin)).or_default().insert(named(name, &origin));
            }
        }
        for (end, origin) in now.values() {
            let Some(origin) = origin else { continue };
            let key = node_key(&end.node, origin);
            let tag = Origin::tag_of(&format!("{:x?} {}", key.1.path.first(), key.0));
            let unlisted = || BTreeSet::from([named(&end.node, &Origin { tag, ..origin.clone() })]);
            named_nodes.entry(key).or_insert_with(unlisted);
        }
        let used: BTreeSet<NodeName> = named_nodes.values().flatten().cloned().collect();

        for node in &used {
            if !self.nodes.contains_key(node) {
                let token = self.node_token(node);
                actions.push(Action::Declare(token.clone()));
                self.nodes.insert(node.clone(), token);
            }
        }
        // Of several it is the oldest that has them.
        let oldest = |names: &BTreeSet<NodeName>| {
            names.iter().filter_map(|name| self.nodes.get(name)).map(|token| token.node_id).min()
        };
        let node_ids: BTreeMap<NodeKey, u64> =
            named_nodes.iter().filter_map(|(key, names)| Some((key.clone(), oldest(names)?))).collect();
        let is_same = |gid: &Gid, local: &Local| {
            now.get(gid).is_some_and(|(end, origin)| match &local.announced {
                _ if **end != local.endpoint => false,
                None => origin.is_none(),
                Some(said) => {
                    let node_id = node_ids.get(&node_key(&end.node, &said.origin));
                    origin.as_ref() == Some(&said.origin) && Some(&said.token.node_id) == node_id
                }
            })
        };
        let gone: Vec<Gid> =
            self.locals.iter().filter(|(gid, local)| !is_same(gid, local)).map(|(gid, _)| *gid).collect();
        // Ends before beginnings: an endpoint that changed is one that ended and one that began. But its former token goes last, so that
        // others have it all the time.
        let (mut withdrawn, mut replaced) = (Vec::new(), Vec::new());
        for gid in gone {
            if let Some(local) = self.locals.remove(&gid) {
                let tag = local.announced.as_ref().map(|announced| announced.origin.tag);
                let tokens = if now.contains_key(&gid) {
                    &mut replaced
                } else {
                    withdrawn.extend(tag.filter(|tag| self.ended.contains(tag)).map(Action::SayEnded));
                    &mut withdrawn
                };
                tokens.extend(local.announced.map(|announced| Action::Undeclare(announced.token)));
                touched.insert(local.key);
            }
        }
        for key in &touched {
            self.reconcile(key, &mut actions);
        }
        actions.append(&mut withdrawn);
        for (gid, (endpoint, origin)) in now {
            if !self.locals.contains_key(&gid) {
                let local = self.local(endpoint.clone(), origin, &node_ids);
                actions.extend(local.announced.iter().map(|said| Action::Declare(said.token.clone())));
                touched.insert(local.key.clone());
                self.locals.insert(gid, local);
            }
        }
        for key in &touched {
            self.reconcile(key, &mut actions);
        }
        actions.append(&mut replaced);
        let unused: Vec<NodeName> = self.nodes.keys().filter(|node| !used.contains(node)).cloned().collect();
        actions.extend(unused.into_iter().filter_map(|node| self.nodes.remove(&node).map(Action::Undeclare)));
        let origins = nodes.iter().map(|node| &node.origin).chain(endpoints.iter().map(|end| &end.origin));
        // What is here first comes back by no other way than through here, which is known by its path.
        self.tags = origins.filter(|origin| !origin.is_here()).map(|origin| origin.tag).collect();
        self.said = (nodes, endpoints);
        self.is_stale = false;
        let publishers = self.locals.values().filter(|local| local.endpoint.kind == EndpointKind::Publisher);
        let passed_over: HashSet<Gid> =
            publishers.filter(|local| local.announced.is_none()).map(|local| local.endpoint.gid).collect();
        if passed_over != self.passed_over.0 {
            self.passed_over = (passed_over, true);
        }
        actions
    }

    /// Publishers of the domain that others announce better: their samples are left to those. `None`: as before.
    pub fn take_passed_over(&mut self) -> Option<HashSet<Gid>> {
        std::mem::take(&mut self.passed_over.1).then(|| self.passed_over.0.clone())
    }

    /// Publishers of a topic elsewhere whose samples come into the domain another way.
    pub fn passed_over_of(&self, key: &TopicKey) -> Option<&BTreeSet<Gid>> {
        self.inward.get(key).map(|(_, passed_over)| passed_over)
    }

    /// Whether the network is told of this end of the domain.
    pub fn is_announced(&self, gid: &Gid) -> bool {
        self.locals.get(gid).is_some_and(|local| local.announced.is_some())
    }

    /// Stops everything and withdraws every token.
    pub fn close(&mut self) -> Vec<Action> {
        self.set_locals(Vec::new(), Vec::new())
    }

    fn id(&mut self) -> u64 {
        self.next_id += 1;
        self.next_id - 1
    }

    fn node_token(&mut self, node: &NodeName) -> Token {
        Token { domain: self.domain, zid: self.zid, node_id: self.id(), node: node.clone(), endpoint: None }
    }

    fn local(
        &mut self,
        endpoint: LocalEndpoint,
        origin: Option<Origin>,
        node_ids: &BTreeMap<NodeKey, u64>,
    ) -> Local {
        let LocalEndpoint { kind, topic, type_id, qos, node, .. } = endpoint.clone();
        let key = TopicKey { domain: self.domain, topic: topic.clone(), type_id: type_id.clone() };
        let announced = origin.map(|origin| {
            let node_id = node_ids.get(&node_key(&node, &origin)).copied().unwrap_or_default();
            // So newer nodes know on which key to send: see `TopicKey::cpu_group`.
            let is_volatile = kind == EndpointKind::Subscription && qos.durability == Durability::Volatile;
            let suffix = if is_volatile { CPU_BACKEND.to_owned() } else { String::new() };
            let described = Endpoint { id: self.id(), kind, name: topic, type_id, qos, suffix };
            let (node, endpoint) = (named(&node, &origin), Some(described));
            let token = Token { domain: self.domain, zid: self.zid, node_id, node, endpoint };
            Announced { origin, wire_gid: endpoint_gid(&token), token }
        });
        Local { endpoint, key, announced }
    }

    fn local_ends<'a>(&'a self, key: &'a TopicKey, kind: EndpointKind) -> impl Iterator<Item = &'a Local> {
        self.locals.values().filter(move |local| local.endpoint.kind == kind && local.key == *key)
    }

    /// Brings what is mirrored of a topic in line with what exists.
    fn reconcile(&mut self, key: &TopicKey, actions: &mut Vec<Action>) {
        self.reconcile_out(key, actions);
        self.reconcile_in(key, actions);
    }

    fn reconcile_out(&mut self, key: &TopicKey, actions: &mut Vec<Action>) {
        let writers: BTreeMap<Gid, Writer> = (self.local_ends(key, EndpointKind::Publisher))
            .filter_map(|local| {
                let (local_gid, qos) = (local.endpoint.gid, local.endpoint.qos);
                let wire_gid = local.announced.as_ref()?.wire_gid;
                Some((local_gid, Writer { local_gid, wire_gid, qos }))
            })
            .collect();
        let are_here =
            writers.keys().all(|gid| self.locals.get(gid).is_some_and(|l| l.endpoint.origin.is_here()));
        let relayed = if are_here { 1 } else { RELAYED_DEPTH as u64 };
        let is_read = self.graph.subscriptions(key).next().is_some();
        let is_kept = writers.values().any(|writer| writer.qos.durability == Durability::TransientLocal);
        let wanted = (!writers.is_empty() && (is_kept || is_read)).then(|| OutQos {
            depth: writers.values().map(|writer| writer.qos.depth).max().unwrap_or(1).max(relayed),
            durability: if is_kept { Durability::TransientLocal } else { Durability::Volatile },
        });
        let running = self.out.get(key).map(|(qos, _)| *qos);
        let Some(wanted) = wanted else {
            if self.out.remove(key).is_some() {
                actions.push(Action::StopOut(key.clone()));
            }
            return;
        };
        let qos = running.map_or(wanted, |running| running.grown(wanted));
        if running != Some(qos) {
            actions.push(Action::StartOut(key.clone(), qos));
        }
        let (now, open) = self.out.entry(key.clone()).or_insert_with(|| (qos, BTreeSet::new()));
        *now = qos;
        open.retain(|gid| {
            let stays = writers.contains_key(gid);
            if !stays {
                actions.push(Action::CloseWriter(key.clone(), *gid));
            }
            stays
        });
        // One that is announced anew has what is kept taken again.
        let is_elsewhere = |gid: &Gid| self.locals.get(gid).is_some_and(|l| !l.endpoint.origin.is_here());
        let is_anew = |(gid, writer): (&Gid, &Writer)| {
            writer.qos.durability == Durability::TransientLocal && !open.contains(gid) && is_elsewhere(gid)
        };
        if running == Some(qos) && writers.iter().any(is_anew) {
            actions.push(Action::StartOut(key.clone(), qos));
        }
        for (gid, writer) in writers {
            if open.insert(gid) {
                actions.push(Action::OpenWriter(key.clone(), writer));
            }
        }
    }

    fn reconcile_in(&mut self, key: &TopicKey, actions: &mut Vec<Action>) {
        let (publishers, passed_over): (Vec<&RemoteEndpoint>, Vec<&RemoteEndpoint>) =
            self.graph.publishers(key).iter().partition(|publisher| self.graph.is_carried(publisher));
        let passed_over: BTreeSet<Gid> = passed_over.into_iter().map(|publisher| publisher.gid).collect();
        let has_readers = self.local_ends(key, EndpointKind::Subscription).next().is_some();
        let is_kept = |qos: &&WireQos| qos.durability == Durability::TransientLocal;
        let subscriptions = self.local_ends(key, EndpointKind::Subscription).map(|local| &local.endpoint.qos);
        let asked = subscriptions.filter(is_kept).map(|qos| qos.depth).max();
        let keepers = publishers.iter().map(|publisher| &publisher.endpoint.qos).filter(is_kept);
        let kept = keepers.map(kept_samples).reduce(u64::saturating_add);
        // None of the subscriptions here gets more than its depth, whatever others claim to keep.
        let kept = asked.zip(kept).map(|(asked, kept)| asked.min(kept));
        let is_reliable = publishers.iter().any(|p| p.endpoint.qos.reliability == Reliability::Reliable);
        let wanted = (has_readers && !publishers.is_empty()).then(|| InQos {
            depth: kept.unwrap_or(1),
            durability: if kept.is_some() { Durability::TransientLocal } else { Durability::Volatile },
            reliability: if is_reliable { Reliability::Reliable } else { Reliability::BestEffort },
        });
        let running = self.inward.get(key);
        let Some(wanted) = wanted else {
            if self.inward.remove(key).is_some() {
                actions.push(Action::StopIn(key.clone()));
            }
            return;
        };
        let qos = running.map_or(wanted, |(running, _)| running.grown(wanted));
        let is_regained = |before: &BTreeSet<Gid>| {
            let keeps = |end: &&RemoteEndpoint| is_kept(&&end.endpoint.qos) && before.contains(&end.gid);
            publishers.iter().copied().any(|end| keeps(&end))
        };
        match running {
            // What is kept by a publisher that comes in here from now on is asked for.
            Some((running, before)) if *running == qos && !is_regained(before) => {
                if passed_over != *before {
                    actions.push(Action::PassOver(key.clone()));
                }
            }
            _ => actions.push(Action::StartIn(key.clone(), qos)),
        }
        self.inward.insert(key.clone(), (qos, passed_over));
    }
}

/// Samples that a publisher elsewhere keeps; keep-all has no number there and gets a large one.
fn kept_samples(qos: &WireQos) -> u64 {
    const KEEP_ALL: u64 = 1000;
    if qos.history == History::KeepAll { qos.depth.max(KEEP_ALL) } else { qos.depth.max(1) }
}

#[cfg(test)]
mod tests;
