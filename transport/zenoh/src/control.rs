// SPDX-License-Identifier: MIT OR Apache-2.0
//! The control thread: hears of changes here and elsewhere, asks the mirror what follows, and does it.

use crate::descriptions::Descriptions;
use crate::gateway::{Options, Shared};
use crate::graph::Graph;
use crate::incoming::{Checks, Incoming, Inlet, OwnGids, port_qos};
use crate::locals;
use crate::mirror::{Action, InQos, Mirror, OutQos, Writer};
use crate::origin::{ended, ended_tag};
use crate::outgoing::{Outgoing, Sender};
use crate::remote::remote_graph;
use crate::services::{Routes, Services};
use crate::stats::{Direction, TopicNames, refused_by_reason};
use crate::types::Types;
use crate::wire::{EndpointKind, MAX_KEY_BYTES, Token, TopicKey, TypeId, token_wildcard};
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError, RwLock, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{Book, Counters, Filter, Numbers, Transit};
use tautline_schema::{Packages, TypeHash, TypeName};
use tautline_transport::{Gid, Limits, Participant, Qos, SchemaStore, TopicType, TransportError};
use zenoh::liveliness::LivelinessToken;
use zenoh::query::{Query, Reply};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

/// What the control thread is told.
pub(crate) enum Event {
    TokenUp(String),
    TokenDown(String),
    /// A publisher of another host has ended by itself.
    Ended(u64),
    /// Publishers or subscriptions of this host appeared or went.
    Locals,
    /// A node elsewhere answered what this type is; `None` if it says too much.
    Described(TypeId, Option<Vec<u8>>),
    /// A node elsewhere asks a node here for a type.
    Asked(Query),
    Stop,
}

/// Takes tokens in Zenoh's thread and leaves them to the control thread. What does not fit makes room for nothing: all
/// tokens are asked for again later.
pub(crate) fn tokens_to(events: mpsc::SyncSender<Event>) -> impl Fn(Sample) + Send + Sync + 'static {
    move |sample| {
        let key = sample.key_expr().as_str();
        let key = cut(key);
        let event = match sample.kind() {
            SampleKind::Put => Event::TokenUp(key),
            SampleKind::Delete => Event::TokenDown(key),
        };
        if events.try_send(event).is_err() {
            MISSED.store(true, Ordering::Relaxed);
        }
    }
}

/// The same for the words that publishers have ended, but for those of this session.
pub(crate) fn ends_to(
    events: mpsc::SyncSender<Event>,
    own_zid: u128,
) -> impl Fn(Sample) + Send + Sync + 'static {
    move |sample| {
        let said = ended_tag(sample.key_expr().as_str()).filter(|_| sample.kind() == SampleKind::Put);
        if let Some((_, tag)) = said.filter(|(zid, _)| *zid != own_zid) {
            // What does not fit is taken for a death.
            let _ = events.try_send(Event::Ended(tag));
        }
    }
}

/// What is too long for any honest key is cut, so that it is refused for its length without being kept.
fn cut(key: &str) -> String {
    let mut end = key.len().min(MAX_KEY_BYTES + 1);
    while !key.is_char_boundary(end) {
        end += 1;
    }
    key[..end].to_owned()
}

/// Whether an event found no room. Of whichever gateway of the process: looking once too often does no harm.
static MISSED: AtomicBool = AtomicBool::new(false);

/// How often numbers are read, what failed is tried again, and missed tokens are asked for.
const PERIOD: Duration = Duration::from_secs(1);
/// Changes of the graph are shown together, this long after one another at least.
const BATCH: Duration = Duration::from_millis(20);
/// And this much longer for each token, for all are written anew.
const BATCH_PER_TOKEN: Duration = Duration::from_micros(100);
/// How long others are waited for when all tokens are asked for.
const RESYNC_TIMEOUT: Duration = Duration::from_secs(2);

/// How long it is said that a publisher has ended, and of how many.
const ENDED_TIME: Duration = Duration::from_secs(10);
const MOST_ENDED: usize = 4096;

pub(crate) struct Control {
    options: Options,
    participant: Participant,
    session: Session,
    outgoing: Outgoing,
    shared: Arc<Shared>,
    mirror: Mirror,
    own: OwnGids,
    /// Own gids by the local publisher's, with its topic.
    gids: HashMap<Gid, (TopicKey, Gid)>,
    tokens: HashMap<String, LivelinessToken>,
    /// The words that publishers have ended, for as long as it takes until they are heard everywhere.
    ended: VecDeque<(Instant, LivelinessToken)>,
    incoming: BTreeMap<TopicKey, Inward>,
    book: Book<TopicKey, Direction>,
    active: BTreeSet<(TopicKey, Direction)>,
    /// Topics that could not be started, with what is to be done and why it failed.
    failed: BTreeMap<(TopicKey, Direction), (Vec<Action>, String)>,
    /// What is being tried again, and why it failed the last time.
    retried: Option<((TopicKey, Direction), String)>,
    refused: BTreeMap<String, String>,
    types: Types,
    descriptions: Descriptions,
    /// Topics that come in and whose type is not known here.
    undescribed: BTreeSet<TopicKey>,
    /// Servers and clients of services in the domain, but for those that this gateway tells it of.
    local_services: Vec<(EndpointKind, TopicKey, Gid)>,
    services: Option<Services>,
    /// Whether what this host has could not be read when it changed.
    is_unlisted: bool,
    /// Whether the graph changed since it was last shown.
    is_unseen: bool,
    shown: Instant,
    started: Instant,
}

/// A topic that comes in.
struct Inward {
    _incoming: Incoming,
    /// Publishers whose samples come into the domain another way.
    passed_over: OwnGids,
    /// What has come.
    numbers: Arc<Mutex<Numbers>>,
}

impl Control {
    pub(crate) fn new(
        options: Options,
        participant: Participant,
        session: Session,
        outgoing: Outgoing,
        shared: Arc<Shared>,
        zid: u128,
        descriptions: Descriptions,
    ) -> Self {
        let domain = options.network_domain.unwrap_or(options.domain);
        let filter: Filter = options.filter.clone();
        let host = tautline_rt::host::name();
        let transit = Transit::to_network(participant.domain_id(), participant.id(), zid, &host);
        let transit = transit.going_on(options.transit);
        let graph = Graph::new(domain, zid, options.limits, transit);
        let mirror = Mirror::new(domain, zid, graph, filter);
        Control {
            options,
            participant,
            session,
            outgoing,
            shared,
            mirror,
            own: OwnGids::default(),
            gids: HashMap::new(),
            tokens: HashMap::new(),
            ended: VecDeque::new(),
            incoming: BTreeMap::new(),
            book: Book::default(),
            active: BTreeSet::new(),
            failed: BTreeMap::new(),
            retried: None,
            refused: BTreeMap::new(),
            types: Types::new(SchemaStore::of_user(), Packages::from_env()),
            descriptions,
            undescribed: BTreeSet::new(),
            local_services: Vec::new(),
            services: None,
            is_unlisted: false,
            is_unseen: false,
            shown: Instant::now(),
            started: Instant::now(),
        }
    }

    pub(crate) fn run(mut self, events: &mpsc::Receiver<Event>, services: Services) {
        self.services = Some(services);
        let mut next = Instant::now() + PERIOD;
        while !self.shared.stop.load(Ordering::Acquire) {
            let soon = self.is_unseen.then(|| self.shown + self.batch()).map_or(next, |at| at.min(next));
            let event = events.recv_timeout(soon.saturating_duration_since(Instant::now()));
            match event {
                Ok(Event::TokenUp(key)) => self.remote_changed(|mirror| mirror.token_up(&key)),
                Ok(Event::Ended(tag)) => self.mirror.note_ended(tag),
                Ok(Event::TokenDown(key)) => self.remote_changed(|mirror| mirror.token_down(&key)),
                Ok(Event::Locals) => self.list_locals(),
                Ok(Event::Described(id, payload)) => self.descriptions.learn(&id, payload.as_deref()),
                Ok(Event::Asked(query)) => self.descriptions.answer(&query, &mut self.types),
                Ok(Event::Stop) | Err(mpsc::RecvTimeoutError::Disconnected) => break,
                Err(mpsc::RecvTimeoutError::Timeout) => {}
            }
            if self.is_unseen && self.shown.elapsed() >= self.batch() {
                self.settle();
            }
            if Instant::now() >= next {
                next = Instant::now() + PERIOD;
                if MISSED.swap(false, Ordering::Relaxed) {
                    self.resync();
                }
                if self.is_unlisted {
                    self.list_locals();
                }
                self.try_again();
                if let Some(services) = &self.services {
                    services.look();
                }
                self.ended.retain(|(since, _)| since.elapsed() < ENDED_TIME);
                self.forget_numbers();
                self.ask_for_types();
                self.read_numbers(PERIOD);
            }
        }
        self.services = None;
        let last = self.mirror.close();
        self.act(last);
    }

    fn batch(&self) -> Duration {
        let tokens = u32::try_from(self.mirror.graph().len()).unwrap_or(u32::MAX);
        BATCH + BATCH_PER_TOKEN * tokens
    }

    fn remote_changed(&mut self, change: impl FnOnce(&mut Mirror) -> Vec<Action>) {
        let actions = change(&mut self.mirror);
        self.is_unseen = true;
        self.act(actions);
    }

    fn list_locals(&mut self) {
        let here = match self.participant.graph() {
            Ok(here) => here,
            Err(error) => {
                self.is_unlisted = true;
                return tracing::warn!("what this host has cannot be read, and that is tried again: {error}");
            }
        };
        self.is_unlisted = false;
        let graph = self.mirror.graph();
        let types = &mut self.types;
        let hash_of =
            |topic: &str, name: &TypeName| types.hash_of(name).or_else(|| adopted_hash(graph, topic, name));
        let locals = locals::list(&here, self.participant.id(), hash_of);
        self.refused = locals.refused;
        let mut endpoints = locals.endpoints;
        let domain = self.network_domain();
        // What the gateway itself answers: for nodes of this host that do not, and for those elsewhere, who would be asked in vain, for
        // nobody here does.
        endpoints.retain(|end| end.origin.is_here() || !self.descriptions.is_theirs(end));
        let nodes = locals.nodes.iter().map(|node| &node.name);
        let ends = endpoints.iter().map(|end| &end.node);
        let mut offered = self.descriptions.offered(nodes.chain(ends), &endpoints);
        offered.retain(|end| self.options.filter.allows(&end.topic));
        let services = offered.iter().map(|end| end.topic.clone()).collect();
        self.descriptions.answer_at(&self.session, domain, services);
        let is_service = |kind| matches!(kind, EndpointKind::Service | EndpointKind::Client);
        self.local_services = (endpoints.iter())
            .filter(|end| is_service(end.kind) && self.options.filter.allows(&end.topic))
            .map(|end| {
                let (topic, type_id) = (end.topic.clone(), end.type_id.clone());
                (end.kind, TopicKey { domain, topic, type_id }, end.gid)
            })
            .collect();
        endpoints.append(&mut offered);
        self.mirror.set_ended(&here.ended);
        let mut actions = self.mirror.set_rivals(&here.rivals);
        actions.append(&mut self.mirror.set_locals(locals.nodes, endpoints));
        // Before they are announced: who hears of a service may ask at once.
        self.route_services();
        self.act(actions);
    }

    fn network_domain(&self) -> u32 {
        self.options.network_domain.unwrap_or(self.options.domain)
    }

    /// The types of topics that come in and are not known here, of whoever has not been asked yet.
    fn ask_for_types(&mut self) {
        let types = &mut self.types;
        self.undescribed.retain(|key| types.schema(&key.type_id).is_none());
        for key in &self.undescribed {
            self.descriptions.ask(&self.session, key, self.mirror.graph());
        }
    }

    fn act(&mut self, actions: Vec<Action>) {
        if let Some(mut passed_over) = self.mirror.take_passed_over() {
            let mut before = self.outgoing.passed_over().lock().unwrap_or_else(PoisonError::into_inner);
            // What was there before is dropped after the lock: the thread that sends may wait for it.
            std::mem::swap(&mut *before, &mut passed_over);
            drop(before);
        }
        for action in actions {
            self.act_once(action);
        }
    }

    fn act_once(&mut self, action: Action) {
        match action {
            Action::Declare(token) => self.declare(&token),
            Action::SayEnded(tag) => self.say_ended(tag),
            Action::Undeclare(token) => drop(self.tokens.remove(&token.to_string())),
            Action::StartOut(key, qos) => {
                let id = (key, Direction::Out);
                if let Some(first) = self.failed.get_mut(&id).and_then(|(actions, _)| actions.first_mut()) {
                    *first = Action::StartOut(id.0, qos);
                } else if let Err(error) = self.start_out(&id.0, qos) {
                    self.fail(id.0.clone(), Direction::Out, Action::StartOut(id.0, qos), error.to_string());
                }
            }
            Action::OpenWriter(key, writer) => {
                self.own.write().unwrap_or_else(PoisonError::into_inner).insert(writer.wire_gid);
                self.gids.insert(writer.local_gid, (key.clone(), writer.wire_gid));
                let id = (key, Direction::Out);
                match self.failed.get_mut(&id) {
                    Some((actions, _)) => actions.push(Action::OpenWriter(id.0, writer)),
                    None => self.open_writer(id.0, &writer),
                }
            }
            Action::CloseWriter(key, gid) => {
                self.forget(gid);
                self.drop_failed_writer(&key, gid);
                self.outgoing.close(key, gid);
            }
            Action::StopOut(key) => {
                self.active.remove(&(key.clone(), Direction::Out));
                self.failed.remove(&(key.clone(), Direction::Out));
                let of_topic = self.gids.iter().filter(|(_, (topic, _))| *topic == key).map(|(gid, _)| *gid);
                for gid in of_topic.collect::<Vec<_>>() {
                    self.forget(gid);
                }
                self.outgoing.stop_topic(key);
            }
            Action::StartIn(key, qos) => {
                if let Err(error) = self.start_in(&key, qos) {
                    self.fail(key.clone(), Direction::In, Action::StartIn(key, qos), error);
                }
            }
            Action::StopIn(key) => {
                self.failed.remove(&(key.clone(), Direction::In));
                self.stop_in(&key);
            }
            Action::PassOver(key) => {
                let gids = self.passed_over_of(&key);
                if let Some(inward) = self.incoming.get(&key) {
                    *inward.passed_over.write().unwrap_or_else(PoisonError::into_inner) = gids;
                }
            }
            Action::Resync => self.resync(),
        }
    }

    fn passed_over_of(&self, key: &TopicKey) -> HashSet<Gid> {
        self.mirror.passed_over_of(key).into_iter().flatten().copied().collect()
    }

    fn declare(&mut self, token: &Token) {
        let text = token.to_string();
        match self.session.liveliness().declare_token(text.clone()).wait() {
            Ok(declared) => drop(self.tokens.insert(text, declared)),
            Err(error) => tracing::warn!("{text} is not announced: {error}"),
        }
    }

    /// Those of publishers that have gone: another one may come with the same gid, and begin anew.
    fn forget_numbers(&self) {
        for (key, inward) in &self.incoming {
            let there: HashSet<Gid> = self.mirror.graph().publishers(key).iter().map(|end| end.gid).collect();
            let mut numbers = inward.numbers.lock().unwrap_or_else(PoisonError::into_inner);
            numbers.forget(|gid| !there.contains(gid));
        }
    }

    fn say_ended(&mut self, tag: u64) {
        if self.ended.len() >= MOST_ENDED {
            self.ended.pop_front();
        }
        let zid = u128::from_le_bytes(self.session.zid().to_le_bytes());
        let word = self.session.liveliness().declare_token(ended(self.network_domain(), zid, tag)).wait();
        // Without it the end is taken for a death.
        self.ended.extend(word.ok().map(|word| (Instant::now(), word)));
    }

    fn start_out(&mut self, key: &TopicKey, qos: OutQos) -> Result<(), TransportError> {
        let depth = usize::try_from(qos.depth).unwrap_or(usize::MAX);
        let wanted = Qos { durability: qos.durability, ..Qos::keep_last(depth.clamp(1, Limits::MAX_DEPTH)) };
        let (topic_type, limits) = (self.topic_type(key)?, Limits::default());
        let subscription =
            self.participant.create_relay_subscription(&key.topic, &topic_type, wanted, limits)?;
        let counters = self.counters(key, Direction::Out);
        self.outgoing.start_topic(key.clone(), subscription, counters);
        self.active.insert((key.clone(), Direction::Out));
        Ok(())
    }

    fn open_writer(&mut self, key: TopicKey, writer: &Writer) {
        let body_bytes = None;
        match Sender::declare(&self.session, &key, writer, &self.options.rules, body_bytes) {
            Ok(sender) => self.outgoing.open(key, writer.local_gid, sender),
            Err(error) => tracing::warn!("topic '{}' is not sent: {error}", key.topic),
        }
    }

    /// What this host knows of the type of a topic.
    fn topic_type(&self, key: &TopicKey) -> Result<TopicType, TransportError> {
        let id = &key.type_id;
        let known = TopicType::new(id.name.to_string()).with_hash(id.hash.to_string());
        let graph = self.participant.graph()?;
        let here = graph.endpoints.iter().filter(|end| !end.is_remote && end.topic == key.topic);
        Ok(here.fold(known, |known, end| known.clone().join(&end.topic_type).unwrap_or(known)))
    }

    fn start_in(&mut self, key: &TopicKey, qos: InQos) -> Result<(), String> {
        // Of one that runs: what is kept is asked for again, so that the new port has it for late joiners on this host.
        let numbers = self.incoming.get(key).map(|inward| inward.numbers.clone()).unwrap_or_default();
        self.stop_in(key);
        let topic_type = self.topic_type(key).map_err(|error| error.to_string())?;
        let (offered, limits) = (port_qos(qos), Limits::default());
        let publisher = self
            .participant
            .create_relay_publisher(&key.topic, &topic_type, offered, limits)
            .map_err(|error| error.to_string())?;
        let counters = self.counters(key, Direction::In);
        let schema = self.types.schema(&key.type_id);
        if schema.is_none() {
            self.undescribed.insert(key.clone());
            self.descriptions.ask(&self.session, key, self.mirror.graph());
        }
        let lifespans = self.mirror.graph().lifespans().clone();
        let max_bytes = self.options.max_message_bytes;
        let own = self.own.clone();
        let passed_over: OwnGids = Arc::new(RwLock::new(self.passed_over_of(key)));
        let checks = Checks { own, passed_over: passed_over.clone(), lifespans, max_bytes, schema };
        let inlet = Inlet::new(publisher, counters, numbers.clone(), checks);
        let incoming = Incoming::start(&self.session, key, qos, inlet).map_err(|error| error.to_string())?;
        self.incoming.insert(key.clone(), Inward { _incoming: incoming, passed_over, numbers });
        self.active.insert((key.clone(), Direction::In));
        Ok(())
    }

    fn stop_in(&mut self, key: &TopicKey) {
        self.active.remove(&(key.clone(), Direction::In));
        if self.undescribed.remove(key) {
            self.descriptions.forget(&key.type_id);
        }
        self.incoming.remove(key);
    }

    fn counters(&mut self, key: &TopicKey, direction: Direction) -> Arc<Counters> {
        let active = &self.active;
        let is_active = |key: &TopicKey, direction| active.contains(&(key.clone(), direction));
        self.book.counters(key.clone(), direction, is_active)
    }

    fn fail(&mut self, key: TopicKey, direction: Direction, action: Action, reason: String) {
        let id = (key, direction);
        if self.active.contains(&id) {
            // It goes on as it was.
            return tracing::warn!("topic '{}': what is kept of it does not grow: {reason}", id.0.topic);
        }
        if self.retried.as_ref().is_none_or(|(retried, before)| (retried, before) != (&id, &reason)) {
            tracing::warn!("topic '{}' is not mirrored: {reason}", id.0.topic);
        }
        self.failed.insert(id, (vec![action], reason));
    }

    fn drop_failed_writer(&mut self, key: &TopicKey, gid: Gid) {
        if let Some((actions, _)) = self.failed.get_mut(&(key.clone(), Direction::Out)) {
            actions
                .retain(|action| !matches!(action, Action::OpenWriter(_, writer) if writer.local_gid == gid));
        }
    }

    fn forget(&mut self, local: Gid) {
        if let Some((_, wire)) = self.gids.remove(&local) {
            self.own.write().unwrap_or_else(PoisonError::into_inner).remove(&wire);
        }
    }

    /// What failed may be possible now: there is memory.
    fn try_again(&mut self) {
        for (id, (actions, reason)) in std::mem::take(&mut self.failed) {
            self.retried = Some((id, reason));
            self.act(actions);
            self.retried = None;
        }
    }

    /// Asks for all tokens, for some were missed or refused.
    fn resync(&mut self) {
        let wildcard = token_wildcard(self.network_domain());
        // This session's own, and twice as many as the graph can hold: most of the rest would be refused. Not Zenoh's own
        // queue, which is short and would have the answers that this session gives itself wait for their reader, who is
        // still asking.
        let (answers, keys) = mpsc::channel();
        let most = self.options.limits.tokens.saturating_mul(2).saturating_add(self.tokens.len());
        let room = Arc::new(AtomicUsize::new(most));
        let answer = {
            let room = room.clone();
            move |reply: Reply| {
                let Ok(sample) = reply.result() else { return };
                let count = |room: usize| room.checked_sub(1);
                if room.fetch_update(Ordering::Relaxed, Ordering::Relaxed, count).is_ok() {
                    let _ = answers.send(cut(sample.key_expr().as_str()));
                }
            }
        };
        let get = self.session.liveliness().get(wildcard).timeout(RESYNC_TIMEOUT).callback(answer);
        if let Err(error) = get.wait() {
            return tracing::warn!("other hosts cannot be asked what they have: {error}");
        }
        // Ends when Zenoh lets go of the other end, after the timeout at the latest.
        let there: BTreeSet<String> = keys.iter().collect();
        // In a flood an honest peer's may be among those without room: nothing of what is known is taken for gone then.
        let is_complete = room.load(Ordering::Relaxed) > 0;
        let gone = self.mirror.graph().keys().filter(|key| is_complete && !there.contains(*key));
        for key in gone.map(String::from).collect::<Vec<_>>() {
            let actions = self.mirror.token_down(&key);
            // Not again, from within itself.
            self.act(actions.into_iter().filter(|action| *action != Action::Resync).collect());
        }
        self.is_unseen = true;
        for key in there {
            let actions = self.mirror.token_up(&key);
            self.act(actions);
        }
    }

    fn read_numbers(&mut self, elapsed: Duration) {
        let graph = self.mirror.graph();
        let mut stats = self.shared.stats.lock().unwrap_or_else(PoisonError::into_inner);
        stats.uptime_s = self.started.elapsed().as_secs_f64();
        stats.remote_nodes = graph.tokens().filter(|token| token.endpoint.is_none()).count();
        stats.remote_endpoints = graph.tokens().count() - stats.remote_nodes;
        stats.refused_tokens = refused_by_reason(graph.refused());
        stats.type_descriptions = self.descriptions.counts().clone();
        stats.unauthorized = crate::access::refused();
        stats.not_mirrored = self.refused.clone();
        let failed = self.failed.iter().map(|((key, _), (_, reason))| (key.topic.clone(), reason.clone()));
        stats.not_mirrored.extend(failed);
        stats.not_mirrored.extend(self.mirror.mismatches());
        let active = &self.active;
        let is_active = |key: &TopicKey, direction| active.contains(&(key.clone(), direction));
        stats.topics = self.book.read(elapsed, TopicNames::of, is_active);
    }

    /// The graph of other hosts changed a while ago: shows it, and looks for the hashes of types that only others know.
    fn settle(&mut self) {
        (self.is_unseen, self.shown) = (false, Instant::now());
        let actions = self.mirror.settle();
        self.act(actions);
        let remote: Vec<Token> = self.mirror.graph().tokens().cloned().collect();
        let (graph, filter) = (self.mirror.graph(), &self.options.filter);
        // What is not let through is not told: somebody else may have a way.
        let told = |token: &Token| {
            let is_allowed = token.endpoint.as_ref().is_none_or(|end| filter.allows(&end.name));
            graph.told(token).filter(|_| is_allowed)
        };
        if let Err(error) = self.participant.set_remote(&remote_graph(&remote, told, graph.ended())) {
            tracing::warn!("nodes and tools of this host do not see what others have: {error}");
        }
        *self.shared.remote.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(remote);
        if self.refused.is_empty() {
            self.route_services();
        } else {
            self.list_locals();
        }
    }

    fn route_services(&mut self) {
        let graph = self.mirror.graph();
        let server = |token: &Token| {
            let end = token.endpoint.as_ref().filter(|end| end.kind == EndpointKind::Service)?;
            graph.carries(token).then_some(())?;
            Some(TopicKey { domain: token.domain, topic: end.name.clone(), type_id: end.type_id.clone() })
        };
        let elsewhere = graph.tokens().filter_map(server).collect();
        let mirror = &self.mirror;
        let here = self.local_services.iter().map(|(kind, key, gid)| (*kind, key, mirror.is_announced(gid)));
        if let Some(services) = &mut self.services {
            services.set_routes(Routes::of(here, &elsewhere));
        }
    }
}

/// Where this host knows a type by its name only, the hash that another host states for the same name on the same topic.
fn adopted_hash(graph: &Graph, topic: &str, name: &TypeName) -> Option<TypeHash> {
    let mut keys = graph.topics().filter(|key| key.topic == topic && key.type_id.name == *name);
    let hash = keys.next()?.type_id.hash;
    // Of two that differ, neither can be believed.
    keys.all(|key| key.type_id.hash == hash).then_some(hash)
}
