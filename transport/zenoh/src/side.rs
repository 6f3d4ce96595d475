// SPDX-License-Identifier: MIT OR Apache-2.0
//! The network as the far side of a mirror.

use crate::descriptions::Descriptions;
use crate::events::{Events, NetworkEvent, Resyncs, cut};
use crate::graph::Graph;
use crate::incoming::{self, Incoming};
use crate::locals::{self, wire_key, wire_node, wire_qos};
use crate::options::Options;
use crate::origin::ended;
use crate::outgoing::{Identity, Network, NetworkSender, Writer};
use crate::services::NetworkServices;
use crate::stats::{GatewayState, ServiceNames, Stats, TopicNames};
use crate::tokens::{TokenChange, Tokens};
use crate::types::Types;
use crate::unclaimed::ClaimThread;
use crate::wire::{Token, TopicKey, token_wildcard};
use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{
    Delivery, FarGraph, FarSide, FoundType, InKey, Ingress, IngressUpdate, Inward, LocalGraph, Publisher,
    Report, Side, Transit, Writers,
};
use tautline_schema::Packages;
use tautline_transport::{Participant, SchemaStore, TopicType};
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Reply;
use zenoh::{Session, Wait};

/// Time-out of a request for all tokens.
const RESYNC_TIMEOUT: Duration = Duration::from_secs(2);

/// How long, and for how many publishers, a normal end is announced.
const ENDED_TIME: Duration = Duration::from_secs(10);
const MOST_ENDED: usize = 4096;

/// How long an incoming topic without publishers is still taken: its last samples may wait in a link behind the ends of their publishers,
/// which Zenoh sends first.
const LINGER_TIME: Duration = Duration::from_secs(1);

pub(crate) struct NetworkSide {
    incoming: BTreeMap<InKey, Incoming>,
    /// Stopped ones, and when they were stopped.
    lingering: Vec<(Instant, InKey, Incoming)>,
    claims: ClaimThread,
    declared: HashMap<String, LivelinessToken>,
    /// Announcements of publishers' ends, kept until other hosts have received them.
    ended: VecDeque<(Instant, LivelinessToken)>,
    resyncs: Resyncs,
    events: Events,
    options: Options,
    participant: Participant,
    session: Session,
    state: Arc<GatewayState>,
    graph: Graph,
    /// Whether the graph differs from the one in `state.remote`.
    is_unseen: bool,
    tokens: Tokens,
    /// The token changes to make next.
    changes: Vec<TokenChange>,
    types: Types,
    descriptions: Descriptions,
    /// Incoming topics whose type's definition is unknown on this host.
    undescribed: BTreeSet<TopicKey>,
}

impl NetworkSide {
    /// Creates the side, and the transit between both sides.
    pub(crate) fn new(
        options: Options,
        participant: Participant,
        session: Session,
        descriptions: Descriptions,
        claims: ClaimThread,
        state: Arc<GatewayState>,
        events: Events,
    ) -> (Self, Transit) {
        let domain = options.domain_there();
        let zid = u128::from_le_bytes(session.zid().to_le_bytes());
        let host = tautline_rt::host::name();
        let transit = Transit::to_network(participant.domain_id(), participant.id(), zid, &host);
        let transit = transit.going_on(options.transit);
        let (incoming, lingering, declared, ended, resyncs, changes, undescribed) = Default::default();
        let side = NetworkSide {
            incoming,
            lingering,
            claims,
            declared,
            ended,
            resyncs,
            events,
            graph: Graph::new(domain, zid, options.limits),
            is_unseen: true,
            tokens: Tokens::new(domain, zid),
            options,
            participant,
            session,
            state,
            changes,
            types: Types::new(SchemaStore::of_user(), Packages::from_env()),
            descriptions,
            undescribed,
        };
        (side, transit)
    }

    fn wire_key(&self, key: &tautline_relay::TopicKey) -> Result<TopicKey, String> {
        wire_key(self.options.domain_there(), key)
    }

    fn apply(&mut self, change: TokenChange, writers: &Writers<Writer>) {
        match change {
            TokenChange::Declare(token) => {
                let text = token.to_string();
                match self.session.liveliness().declare_token(text.clone()).wait() {
                    Ok(declared) => drop(self.declared.insert(text, declared)),
                    Err(error) => tracing::warn!("token {text} is not declared: {error}"),
                }
            }
            TokenChange::Withdraw(token) => {
                if let Some(declared) = self.declared.remove(&token.to_string()).map(Arc::new) {
                    writers.settling().for_each(|writer| writer.hold(&token, &declared));
                }
            }
            TokenChange::Ended(tag) => {
                if self.ended.len() >= MOST_ENDED {
                    self.ended.pop_front();
                }
                let zid = u128::from_le_bytes(self.session.zid().to_le_bytes());
                let key = ended(self.options.domain_there(), zid, tag);
                let token = self.session.liveliness().declare_token(key).wait();
                // Without it the end counts as a death.
                self.ended.extend(token.ok().map(|token| (Instant::now(), token)));
            }
        }
    }

    /// Requests unknown types of incoming topics from nodes that were not asked yet. Messages of those that are known by now are checked.
    fn request_types(&mut self) {
        let (types, incoming, domain) = (&mut self.types, &self.incoming, self.options.domain_there());
        self.undescribed.retain(|key| {
            let Some(schema) = types.schema(&key.type_id) else { return true };
            let of_topic = incoming.iter().filter(|(of, _)| wire_key(domain, &of.topic).as_ref() == Ok(key));
            of_topic.for_each(|(_, incoming)| incoming.describe(&schema));
            false
        });
        for key in &self.undescribed {
            self.descriptions.request(&self.session, key, &self.graph);
        }
    }

    /// Requests kept samples again from publishers in the graph that have not answered.
    fn retry_kept(&mut self) {
        if !self.incoming.values().any(Incoming::is_kept) {
            return;
        }
        let keeping = self.graph.keeping();
        let (none, domain) = (BTreeMap::new(), self.options.domain_there());
        for (key, incoming) in &mut self.incoming {
            if let Ok(TopicKey { topic, type_id, .. }) = wire_key(domain, &key.topic) {
                incoming.retry(keeping.get(&(&*topic, &type_id)).unwrap_or(&none));
            }
        }
    }

    /// Requests all tokens again, after some were dropped or refused.
    fn resync(&mut self) {
        let wildcard = token_wildcard(self.options.domain_there());
        // Room for this session's tokens and twice the graph's capacity: most further tokens would be refused. Not Zenoh's own channel,
        // which is short: the replies for this session's own tokens would wait for this thread, which is still sending the request.
        let (answers, keys) = mpsc::channel();
        let most = self.options.limits.tokens.saturating_mul(2).saturating_add(self.declared.len());
        let (room, is_late) = (Arc::new(AtomicUsize::new(most)), Arc::new(AtomicBool::new(false)));
        let answer = {
            let (room, is_late) = (room.clone(), is_late.clone());
            move |reply: Reply| {
                // The time-out is an error.
                let Ok(sample) = reply.result() else { return is_late.store(true, Ordering::Relaxed) };
                let count = |room: usize| room.checked_sub(1);
                if room.fetch_update(Ordering::Relaxed, Ordering::Relaxed, count).is_ok() {
                    let _ = answers.send(cut(sample.key_expr().as_str()));
                }
            }
        };
        let get = self.session.liveliness().get(wildcard).timeout(RESYNC_TIMEOUT).callback(answer);
        if let Err(error) = get.wait() {
            self.resyncs.done(true);
            return tracing::warn!("the tokens of other hosts cannot be requested: {error}");
        }
        // Ends when Zenoh drops the sender, at the latest after the time-out.
        let there: BTreeSet<String> = keys.iter().collect();
        // In a flood, tokens of honest peers may be missing for lack of room, and behind a slow link for lack of time: then no token is
        // removed from the graph.
        let is_late = is_late.load(Ordering::Relaxed);
        let is_complete = !is_late && room.load(Ordering::Relaxed) > 0;
        self.resyncs.done(is_late);
        let gone = self.graph.keys().filter(|key| is_complete && !there.contains(*key));
        for key in gone.map(String::from).collect::<Vec<_>>() {
            self.graph.remove(&key);
        }
        for key in &there {
            self.graph.insert(key);
        }
        self.is_unseen = true;
    }
}

impl FarSide for NetworkSide {
    const SIDE: Side = Side::Network;
    const DELIVERY: Delivery = incoming::DELIVERY;
    type Event = NetworkEvent;
    type Egress = Network;
    type Writer = Writer;
    type Services = NetworkServices;
    const PATIENCE: Option<Duration> = Some(Duration::from_secs(1));

    fn handle(&mut self, event: NetworkEvent) -> bool {
        let is_changed = match event {
            NetworkEvent::TokenUp(key) => self.graph.insert(&key),
            NetworkEvent::TokenDown(key) => {
                let was_there = self.graph.remove(&key);
                if self.graph.wants_resync() {
                    // Not at once, because a resync takes a while.
                    self.state.has_missed.store(true, Ordering::Relaxed);
                }
                was_there
            }
            NetworkEvent::Ended(tag) => {
                self.graph.note_ended(tag);
                false
            }
            NetworkEvent::Resync => {
                self.resync();
                true
            }
            NetworkEvent::Described(id, payload) => {
                self.descriptions.learn(&id, payload.as_deref());
                false
            }
            NetworkEvent::Asked(query) => {
                self.descriptions.answer(&query, &mut self.types);
                false
            }
        };
        self.is_unseen |= is_changed;
        is_changed
    }

    fn read_graph(&mut self, _: &LocalGraph) -> Result<FarGraph, String> {
        if std::mem::take(&mut self.is_unseen) {
            let remote: Vec<Token> = self.graph.tokens().cloned().collect();
            self.state.remote.set(remote);
        }
        let mut there = self.graph.far_graph();
        // The gateway's own publishers count as known, so that their messages are ignored if they return.
        for (topic, gid) in self.tokens.publishers() {
            if let Some(publishers) = there.publishers.get_mut(topic) {
                publishers.insert(gid);
            }
        }
        Ok(there)
    }

    fn prepare(&mut self, here: &mut LocalGraph, transit: &Transit) {
        let (graph, types) = (&self.graph, &mut self.types);
        let hash_of = |topic: &str, name: &_| types.hash_of(name).or_else(|| graph.hash_of(topic, name));
        let mut ends = locals::list(here, hash_of);
        // The gateway itself serves type descriptions: for local nodes without such a server, and for nodes that relays announce
        // here, because no local client would call their servers.
        let descriptions = &self.descriptions;
        ends.retain(|end| end.origin.is_here() || !descriptions.is_theirs(end));
        here.services.retain(|end| end.origin.is_here() || !descriptions.answers_for(end));
        let nodes: Vec<_> = here
            .nodes
            .iter()
            .map(|node| (wire_node(&node.name, &node.enclave), node.origin.clone()))
            .collect();
        let names = nodes.iter().map(|(name, _)| name).chain(ends.iter().map(|end| &end.node));
        let mut offered = descriptions.offered(names, &ends);
        let filter = &self.options.filter;
        offered.retain(|end| filter.allows(&end.topic));
        let services = offered.iter().map(|end| end.topic.clone()).collect();
        self.descriptions.answer_at(&self.session, self.options.domain_there(), services);
        ends.append(&mut offered);
        ends.retain_mut(|end| {
            let announced = transit.announced(&end.origin).filter(|_| filter.allows(&end.topic));
            let is_announced = announced.is_some();
            end.origin = announced.unwrap_or_default();
            is_announced
        });
        let nodes: Vec<_> = nodes
            .into_iter()
            .filter_map(|(name, origin)| Some((name, transit.announced(&origin)?)))
            .collect();
        let ended = here.ended.iter().copied().collect();
        self.changes.append(&mut self.tokens.update(&nodes, ends, &ended));
    }

    fn update_services(&mut self, _: &LocalGraph, _: &Transit) {}

    fn service_context(&self) {}

    fn announce(&mut self, _: &LocalGraph, _: &Transit, writers: &Writers<Writer>) {
        for change in std::mem::take(&mut self.changes) {
            self.apply(change, writers);
        }
    }

    fn tick(&mut self, _: &mut Writers<Writer>) -> bool {
        self.resyncs.queue_if_due(&self.events, &self.state.has_missed);
        self.ended.retain(|(since, _)| since.elapsed() < ENDED_TIME);
        self.lingering.retain(|(since, ..)| since.elapsed() < LINGER_TIME);
        self.request_types();
        self.retry_kept();
        false
    }

    fn find_type(&mut self, key: &tautline_relay::TopicKey, _: Option<&str>) -> Result<FoundType, String> {
        let wire_key = self.wire_key(key)?;
        let known = TopicType::new(key.type_name.clone()).with_hash(wire_key.type_id.hash.to_string());
        let graph = self.participant.graph().map_err(|error| error.to_string())?;
        let here = graph.endpoints.iter().filter(|end| !end.is_remote && end.topic == key.topic);
        let topic_type = here.fold(known, |known, end| known.clone().join(&end.topic_type).unwrap_or(known));
        Ok(FoundType { topic_type, schema: self.types.schema(&wire_key.type_id) })
    }

    fn open_writer(
        &mut self,
        key: &tautline_relay::TopicKey,
        publisher: &Publisher,
    ) -> Result<Writer, String> {
        let wire_gid = self.tokens.wire_gid(&publisher.gid);
        let wire_gid = wire_gid.ok_or("its publisher is not announced yet")?;
        let identity = Identity { wire_gid, qos: wire_qos(&publisher.qos) };
        Ok(Writer::new(identity, &self.session, self.wire_key(key)?))
    }

    fn is_current(&self, publisher: &tautline_transport::Gid, writer: &Writer) -> bool {
        self.tokens.wire_gid(publisher) == Some(writer.identity.wire_gid)
    }

    fn sender(&mut self, key: &tautline_relay::TopicKey, writer: &Writer) -> Result<NetworkSender, String> {
        let sender = NetworkSender::declare(
            &self.session,
            &self.wire_key(key)?,
            &writer.identity,
            &self.options.rules,
        );
        sender.map_err(|error| error.to_string())
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward, ingress: Ingress) -> Result<(), String> {
        let wire_key = self.wire_key(&key.topic)?;
        // After a restart, kept samples are requested again, so that the new port has them for local late joiners.
        let lingering = self.lingering.iter().position(|(_, of, _)| of == key);
        let lingering = lingering.map(|at| self.lingering.remove(at).2);
        let old = self.incoming.remove(key).or(lingering);
        if self.types.schema(&wire_key.type_id).is_none() {
            self.undescribed.insert(wire_key.clone());
            self.descriptions.request(&self.session, &wire_key, &self.graph);
        }
        let max_bytes = self.options.max_message_bytes;
        let claims = self.claims.queue.clone();
        let started = Incoming::start(&self.session, &wire_key, inward, ingress, old, max_bytes, claims);
        self.incoming.insert(key.clone(), started.map_err(|error| error.to_string())?);
        Ok(())
    }

    fn is_taking(&self, key: &InKey) -> bool {
        self.incoming.contains_key(key)
    }

    fn change_in(&mut self, key: &InKey, change: IngressUpdate) {
        if let Some(incoming) = self.incoming.get(key) {
            incoming.change(change);
        }
    }

    fn stop_in(&mut self, key: &InKey) {
        if let Ok(wire_key) = self.wire_key(&key.topic)
            && self.undescribed.remove(&wire_key)
        {
            self.descriptions.forget(&wire_key.type_id);
        }
        if let Some(incoming) = self.incoming.remove(key)
            && incoming.close(&self.graph.publishers(&key.topic.far_topic))
        {
            self.lingering.push((Instant::now(), key.clone(), incoming));
        }
    }

    fn report(&mut self, report: Report, _: &Writers<Writer>) {
        let before = self.state.stats.get();
        let remote_nodes = self.graph.tokens().filter(|token| token.endpoint.is_none()).count();
        let not_mirrored = report.problems.into_iter().chain(report.service_problems);
        let topics = report.topics.into_iter().map(|topic| topic.named(TopicNames::of, |way| way));
        let services = report.services.into_iter().map(|service| service.named(ServiceNames::of, |way| way));
        self.state.stats.set(Stats {
            domain: before.domain,
            network_domain: before.network_domain,
            zid: before.zid.clone(),
            uptime_s: report.uptime_s,
            remote_nodes,
            remote_endpoints: self.graph.tokens().count() - remote_nodes,
            refused_tokens: self.graph.refused.clone(),
            not_mirrored: not_mirrored.collect(),
            type_descriptions: self.descriptions.counts.clone(),
            unauthorized: crate::access::refused(),
            topics: topics.collect(),
            services: services.collect(),
            ..Stats::default()
        });
    }
}
