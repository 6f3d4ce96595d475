// SPDX-License-Identifier: MIT OR Apache-2.0
//! Executes the mirror's actions: one thread, woken by changes on either side, creates and ends everything.

mod failed;

use crate::ingress::{Delivery, Ingress, IngressPort, IngressUpdate, Senders};
use crate::limiter::Limiter;
use crate::mirror::{Action, Far, InKey, Inward, Mirror, Outward, Side, TopicKey};
use crate::relay::Relay;
use crate::route::{Egress, Outbound};
use crate::rules::{Direction, Rules};
use crate::services::{FarServices, Routes, ServiceStats, Services};
use crate::stats::{TopicStats, TopicStatsTable};
use crate::transit::Transit;
use crate::writers::{FarWriter, MATCH_TIME, SETTLE_TIME, Writers};
use failed::Failed;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_schema::Schema;
use tautline_transport::{
    Durability, EndpointKind, Gid, GraphSnapshot, History, Limits, NodeInfo, Participant, Qos, RawPublisher,
    RawSubscription, RemoteGraph, RemoteNode, ServiceEndpoint, ServiceKind, TopicEndpoint, TopicType,
    TransportError,
};

/// The far side of a mirror: a network or a ROS 2 graph. [`MirrorControl`] calls it from one thread.
pub trait FarSide: Sized {
    /// The kind of far side.
    const SIDE: Side;
    /// Order of its messages, and whether their publishers are announced.
    const DELIVERY: Delivery;
    /// Events from other threads.
    type Event: Send;
    /// Forwards samples of the domain.
    type Egress: Egress<Key = TopicKey, Topic = Outbound>;
    /// Mirrors a publisher of the domain.
    type Writer: FarWriter;
    /// The far side's part in services.
    type Services: FarServices;
    /// How long an announcement waits until services can be called; `None`: remote clients wait for services anyway.
    const PATIENCE: Option<Duration>;

    /// Handles an event. Returns whether the far graph changed.
    fn handle(&mut self, event: Self::Event) -> bool;

    /// Reads the far graph, without this mirror's endpoints; `here` is the domain's. An error is logged and retried.
    ///
    /// # Errors
    /// Why the graph cannot be read.
    fn read_graph(&mut self, here: &LocalGraph) -> Result<FarGraph, String>;

    /// Called first in an update: removes from `here`, which is in terms of the domain, what cannot be announced on the far side.
    fn prepare(&mut self, here: &mut LocalGraph, transit: &Transit);

    /// Called after topics are mirrored. Returns the context for services on the far side.
    fn update_services(
        &mut self,
        here: &LocalGraph,
        transit: &Transit,
    ) -> <Self::Services as FarServices>::With;

    /// The context that [`update_services`](Self::update_services) returned last.
    fn service_context(&self) -> <Self::Services as FarServices>::With;

    /// Called after services are routed. Announces `here` on the far side.
    fn announce(&mut self, here: &LocalGraph, transit: &Transit, writers: &Writers<Self::Writer>);

    /// Called each second. Returns whether the far graph must be read again.
    fn tick(&mut self, writers: &mut Writers<Self::Writer>) -> bool;

    /// The type of an incoming topic.
    ///
    /// # Errors
    /// Why it cannot be mirrored.
    fn find_type(&mut self, key: &TopicKey, hash: Option<&str>) -> Result<FoundType, String>;

    /// Creates the writer that mirrors a publisher.
    ///
    /// # Errors
    /// Why that failed.
    fn open_writer(&mut self, key: &TopicKey, publisher: &Publisher) -> Result<Self::Writer, String>;

    /// Whether the writer is up to date; if not, it is replaced.
    fn is_current(&self, publisher: &Gid, writer: &Self::Writer) -> bool {
        let _ = (publisher, writer);
        true
    }

    /// Creates the sender for a publisher's samples.
    ///
    /// # Errors
    /// Why that failed.
    fn sender(
        &mut self,
        key: &TopicKey,
        writer: &Self::Writer,
    ) -> Result<<Self::Egress as Egress>::Sender, String>;

    /// Creates a port of the domain for messages from the far side; by default, with the default limits.
    ///
    /// # Errors
    /// As [`Participant::create_relay_publisher`].
    fn port(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        offered: Qos,
    ) -> Result<RawPublisher, TransportError> {
        participant.create_relay_publisher(topic, topic_type, offered, Limits::default())
    }

    /// Takes messages of a class from now on, in place of its previous ingress.
    ///
    /// # Errors
    /// Why that failed.
    fn start_in(&mut self, key: &InKey, inward: &Inward, ingress: Ingress) -> Result<(), String>;

    /// Whether messages of a class are being taken; a failed restart may have ended that.
    fn is_taking(&self, key: &InKey) -> bool {
        let _ = key;
        true
    }

    /// Updates the ingress of a class.
    fn change_in(&mut self, key: &InKey, change: IngressUpdate);

    /// Stops taking messages of a class.
    fn stop_in(&mut self, key: &InKey);

    /// The GID that announces a far service or client in the domain.
    fn announced_gid(end: &ServiceEndpoint) -> Gid {
        end.gid
    }

    /// Publishes the statistics.
    fn report(&mut self, report: Report, writers: &Writers<Self::Writer>);
}

/// A publisher of the domain, to be mirrored.
pub struct Publisher {
    /// Its GID here.
    pub gid: Gid,
    /// The offered QoS.
    pub qos: Qos,
    /// The type hash that the topic states.
    pub type_hash: Option<String>,
}

/// A type that was found.
pub struct FoundType {
    /// The type as topics state it.
    pub topic_type: TopicType,
    /// The definition that validates messages from the far side.
    pub schema: Option<Arc<Schema>>,
}

/// The domain's graph, without this mirror's announcements.
#[derive(Default)]
pub struct LocalGraph {
    /// The mirror's participant.
    pub own: u64,
    /// Nodes.
    pub nodes: Vec<Arc<NodeInfo>>,
    /// Publishers and subscriptions.
    pub endpoints: Vec<Arc<TopicEndpoint>>,
    /// Services and clients.
    pub services: Vec<Arc<ServiceEndpoint>>,
    /// Tags of the latest publishers that ended normally.
    pub ended: Vec<u64>,
    /// Topics and services that cannot be announced on the far side, and why.
    pub problems: BTreeMap<String, String>,
}

impl LocalGraph {
    fn of(own: u64, snapshot: &GraphSnapshot) -> Self {
        LocalGraph {
            own,
            nodes: snapshot.nodes.iter().filter(|node| node.teller != Some(own)).cloned().collect(),
            endpoints: snapshot.endpoints.iter().filter(|end| end.teller != Some(own)).cloned().collect(),
            services: snapshot.services.iter().filter(|end| end.teller != Some(own)).cloned().collect(),
            ended: snapshot.ended.clone(),
            problems: BTreeMap::new(),
        }
    }
}

/// The far side's graph, each entity with its announcer; see [`Transit`].
#[derive(Default)]
pub struct FarGraph {
    /// Nodes.
    pub nodes: Vec<(RemoteNode, u128)>,
    /// Publishers and subscriptions.
    pub endpoints: Vec<(TopicEndpoint, u128)>,
    /// Services and clients.
    pub services: Vec<(ServiceEndpoint, u128)>,
    /// All publishers with a known GID, by topic.
    pub publishers: HashMap<String, BTreeSet<Gid>>,
    /// Tags of publishers that ended normally, if the far side announces that.
    pub ended: BTreeSet<u64>,
}

/// Statistics of a mirror.
pub struct Report {
    /// Seconds since start.
    pub uptime_s: f64,
    /// Topics that cannot be mirrored, and why.
    pub problems: BTreeMap<String, String>,
    /// Every topic that is mirrored, or was until a minute ago.
    pub topics: Vec<TopicStats<TopicKey, Direction>>,
    /// Services that cannot be mirrored, and why.
    pub service_problems: BTreeMap<String, String>,
    /// Every service that is mirrored, or was until a minute ago.
    pub services: Vec<ServiceStats<TopicKey, Direction>>,
}

/// Events for the control thread.
pub enum Event<E> {
    /// The domain's graph changed.
    LocalChange,
    /// Something happened on the far side.
    FarChange(E),
    /// Stop.
    Stop,
}

/// Wakes the control thread when the domain's graph changes, until `stop`.
pub fn watch_domain<E>(participant: &Participant, events: &mpsc::SyncSender<Event<E>>, stop: &AtomicBool) {
    const PATIENCE: Duration = Duration::from_millis(250);
    let mut seen = participant.graph_epoch().wrapping_sub(1);
    while !stop.load(Ordering::Acquire) {
        let epoch = participant.wait_for_graph_change(seen, PATIENCE);
        if epoch == seen {
            continue;
        }
        match events.try_send(Event::LocalChange) {
            Ok(()) => seen = epoch,
            // The queue is full: gives way to the control thread, which has this thread's priority.
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// Interval of statistics and retries.
const TICK: Duration = Duration::from_secs(1);
/// Minimum pause between two updates: changes are batched, because an update takes time in proportion to the size of the graph.
const PAUSE: Duration = Duration::from_millis(2);
/// Additional pause, as a multiple of the update's time: leaves most of the time to other threads during constant change.
const PAUSE_PER_LOOK: u32 = 4;
/// Maximum of events handled in a row.
const EVENTS_AT_ONCE: usize = 1024;
/// Interval of the check whether a writer has matched.
const MATCH_LOOK: Duration = Duration::from_millis(2);
/// Interval of the check whether the samples of ended publishers have arrived; longer, because there may be hundreds of publishers.
const SETTLE_LOOK: Duration = Duration::from_millis(20);
/// How long the end of the mirror waits for that: a heartbeat of Fast DDS, and less than the time that supervisors give a process to stop.
const STOP_TIME: Duration = Duration::from_millis(3_500);

/// The parts of a mirror.
pub struct Parts<F: FarSide> {
    /// The domain.
    pub participant: Participant,
    /// The far side.
    pub far: F,
    /// The thread that takes samples.
    pub relay: Relay<F::Egress>,
    /// The thread that carries requests and responses.
    pub services: Services<F::Services>,
    /// Decides which endpoints are announced and carried.
    pub transit: Transit,
    /// Rules for topics.
    pub rules: Rules,
    /// Rules for services.
    pub service_rules: Rules,
}

/// Keeps both sides of a mirror in step.
pub struct MirrorControl<F: FarSide> {
    services: Services<F::Services>,
    relay: Relay<F::Egress>,
    writers: Writers<F::Writer>,
    far: F,
    participant: Participant,
    transit: Transit,
    mirror: Mirror,
    service_rules: Rules,
    /// Whether the last update failed.
    is_stale: bool,
    stats: TopicStatsTable<TopicKey, Direction>,
    out: BTreeMap<TopicKey, Outward>,
    /// Topics whose samples are not taken until a writer has matched.
    waiting: BTreeMap<TopicKey, (Outward, Instant)>,
    inward: BTreeMap<InKey, TakenClass>,
    failed: Failed,
    /// The far side's publishers by topic, as last read.
    publishers: HashMap<String, BTreeSet<Gid>>,
    problems: BTreeMap<String, String>,
    started: Instant,
}

struct TakenClass {
    inward: Inward,
    /// Whether the class has a port, which offers `inward.offered`: as soon as there is a publisher.
    has_port: bool,
    /// The senders, as last passed to the ingress.
    senders: Senders,
}

impl<F: FarSide> MirrorControl<F> {
    /// Creates the control of a mirror from its parts; starts nothing.
    pub fn new(parts: Parts<F>) -> Self {
        let Parts { participant, far, relay, services, transit, rules, service_rules } = parts;
        let (stats, out, waiting, inward) = Default::default();
        let (failed, publishers, problems) = Default::default();
        MirrorControl {
            services,
            relay,
            writers: Writers::default(),
            far,
            participant,
            transit,
            mirror: Mirror::new(F::SIDE, rules),
            service_rules,
            is_stale: false,
            stats,
            out,
            waiting,
            inward,
            failed,
            publishers,
            problems,
            started: Instant::now(),
        }
    }

    /// Runs until stopped.
    pub fn run(mut self, events: &mpsc::Receiver<Event<F::Event>>, stop: &AtomicBool) {
        let (mut last_tick, mut next_update) = (Instant::now(), Instant::now());
        let mut is_changed = true;
        while !stop.load(Ordering::Acquire) {
            let mut until = last_tick + TICK;
            if is_changed {
                until = until.min(next_update);
            }
            if self.is_matching() {
                until = until.min(Instant::now() + MATCH_LOOK);
            }
            if self.writers.is_settling() {
                until = until.min(Instant::now() + SETTLE_LOOK);
            }
            let first = events.recv_timeout(until.saturating_duration_since(Instant::now()));
            if matches!(first, Err(mpsc::RecvTimeoutError::Disconnected)) {
                break;
            }
            // One update for all changes at once.
            for event in first.into_iter().chain(events.try_iter()).take(EVENTS_AT_ONCE) {
                is_changed |= match event {
                    Event::LocalChange => true,
                    Event::FarChange(event) => self.far.handle(event),
                    Event::Stop => false,
                };
            }
            // Only one tick, even if an update took longer than several.
            let elapsed = last_tick.elapsed();
            if elapsed >= TICK {
                last_tick += elapsed;
                is_changed |= self.far.tick(&mut self.writers) || self.is_stale;
                self.try_again();
                self.services.try_again(|| self.far.service_context());
                self.report(elapsed);
            }
            if is_changed && Instant::now() >= next_update {
                is_changed = false;
                let start = Instant::now();
                self.update();
                next_update = Instant::now() + PAUSE + start.elapsed() * PAUSE_PER_LOOK;
            }
            self.open_matched();
            self.writers.drop_settled(SETTLE_TIME);
        }
        if is_changed {
            self.update();
        }
        // Samples that are already published are still sent; this waits until they have arrived.
        self.out.keys().for_each(|key| self.relay.stop_topic(key.clone()));
        self.writers.remove_all();
        while self.writers.drop_settled(STOP_TIME) {
            std::thread::sleep(SETTLE_LOOK);
        }
    }

    /// Brings both sides in step with the graphs.
    fn update(&mut self) {
        let seen = self.participant.graph().map_err(|error| error.to_string()).and_then(|snapshot| {
            let here = LocalGraph::of(self.participant.id(), &snapshot);
            Ok((self.far.read_graph(&here)?, here, snapshot))
        });
        // Retried at the next tick.
        self.is_stale = seen.is_err();
        let (there, mut here, snapshot) = match seen {
            Ok(seen) => seen,
            Err(error) => return tracing::warn!("the graph cannot be read, retrying: {error}"),
        };
        let transit = &mut self.transit;
        transit.reset(&snapshot.rivals);
        there.nodes.iter().for_each(|(node, teller)| transit.insert(&node.origin, *teller));
        there.endpoints.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
        there.services.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
        self.far.prepare(&mut here, &self.transit);
        for (key, gid) in self.writers.outdated(|gid, writer| self.far.is_current(gid, writer)) {
            self.mirror.forget_writer(&key, gid);
            self.relay.close(key.clone(), gid);
            self.writers.remove(&key, gid);
        }
        self.mirror_topics(&here, &there);
        // After the topics, because an action's feedback must have a path before its goals.
        self.route_services(&here, &there);
        self.far.announce(&here, &self.transit, &self.writers);
        if let Err(error) = self.participant.set_remote(&self.remote(there)) {
            self.is_stale = true;
            tracing::warn!(
                "remote endpoints are not announced to nodes and tools of this host, retrying: {error}"
            );
        }
        self.problems = here.problems;
    }

    fn mirror_topics(&mut self, here: &LocalGraph, there: &FarGraph) {
        let transit = &self.transit;
        let is_publisher = |end: &TopicEndpoint| end.kind == EndpointKind::Publisher;
        let is_left = |end: &TopicEndpoint| is_publisher(end) && transit.announced(&end.origin).is_none();
        let (left, told): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            here.endpoints.iter().map(AsRef::as_ref).partition(|end| is_left(end));
        // Publishers that another participant announces.
        let mut passed_over: HashSet<Gid> = left.into_iter().map(|end| end.gid).collect();
        let mut before = self.relay.passed_over().lock();
        // The old set is dropped after the lock is released, because the sending thread may wait for it.
        std::mem::swap(&mut *before, &mut passed_over);
        drop(before);
        let far = there.endpoints.iter().filter_map(|(end, teller)| match end.kind {
            EndpointKind::Publisher => Some((end, transit.carries(&end.origin, *teller))),
            EndpointKind::Subscription => transit.origin_here(&end.origin, *teller).map(|_| (end, true)),
        });
        let far: Vec<Far> = far.collect();
        let actions = self.mirror.update(told, &far);
        self.publishers.clone_from(&there.publishers);
        for action in actions {
            if let Err(reason) = self.act(&action) {
                self.failed.note(action, reason, None);
            }
        }
        self.renew_senders();
    }

    fn route_services(&mut self, here: &LocalGraph, there: &FarGraph) {
        let with = self.far.update_services(here, &self.transit);
        let transit = &self.transit;
        let there = there.services.iter().filter(|(end, teller)| transit.carries(&end.origin, *teller));
        let there: Vec<ServiceEndpoint> = there.map(|(end, _)| end.clone()).collect();
        let announced = |end: &ServiceEndpoint| transit.announced(&end.origin).is_some();
        let (ends, before) = (here.services.iter().map(AsRef::as_ref), self.services.routes());
        let routes = Routes::of(F::SIDE, &self.service_rules, ends, &there, before, announced);
        let applied = self.services.set_routes(routes, with);
        // A client may call a service as soon as it is announced.
        if F::PATIENCE.is_some_and(|patience| !applied.wait(patience)) {
            tracing::warn!("services change slowly: some are announced before they can be called");
        }
    }

    /// The graph to announce in the domain, with the domain's names, and sorted, so that equal graphs are equal lists.
    fn remote(&self, there: FarGraph) -> RemoteGraph {
        let rules = &self.mirror.rules;
        let mut remote = RemoteGraph { ended: there.ended, ..RemoteGraph::default() };
        for (node, teller) in there.nodes {
            let told = self.transit.origin_here(&node.origin, teller);
            remote.nodes.extend(told.map(|origin| RemoteNode { origin, ..node }));
        }
        for (end, teller) in there.endpoints {
            let Some(topic) = rules.here_name(&end.topic) else { continue };
            // Endpoints that the rules exclude are not announced: another relay may carry them.
            let way = match end.kind {
                EndpointKind::Publisher => Direction::In,
                EndpointKind::Subscription => Direction::Out,
            };
            let goes = rules.choice(&topic).is_some_and(|choice| choice.allows(way));
            let told = self.transit.origin_here(&end.origin, teller).filter(|_| goes);
            remote.endpoints.extend(told.map(|origin| TopicEndpoint { topic, origin, ..end }));
        }
        for (end, teller) in there.services {
            let Some(name) = self.service_rules.here_name(&end.name) else { continue };
            let way = match end.kind {
                ServiceKind::Server => Direction::In,
                ServiceKind::Client => Direction::Out,
            };
            let goes = self.service_rules.choice(&name).is_some_and(|choice| choice.allows(way));
            let told = self.transit.origin_here(&end.origin, teller).filter(|_| goes);
            let gid = F::announced_gid(&end);
            remote.services.extend(told.map(|origin| ServiceEndpoint { name, gid, origin, ..end }));
        }
        remote.nodes.sort();
        remote.endpoints.sort_by(|one, other| (&one.topic, one.gid).cmp(&(&other.topic, other.gid)));
        remote.services.sort_by(|one, other| {
            (&one.name, one.kind, &one.node, one.gid).cmp(&(&other.name, other.kind, &other.node, other.gid))
        });
        remote
    }

    /// Updates the senders of each class: its subscription also gets messages of publishers outside the class, which come and go.
    fn renew_senders(&mut self) {
        for (key, taken) in &mut self.inward {
            // Also for a class whose restart failed.
            let Some(publishers) = self.mirror.publishers(key) else { continue };
            let senders = senders(&self.publishers, key, publishers, taken.has_port);
            if senders != taken.senders {
                taken.senders = senders.clone();
                let limiter = Limiter::new(taken.inward.min_period);
                self.far.change_in(key, IngressUpdate { senders, limiter, port: None });
            }
        }
    }

    /// Retries failed actions: memory may be free, or a package installed by now.
    fn try_again(&mut self) {
        for (action, before) in self.failed.take() {
            if let Err(reason) = self.act(&action) {
                self.failed.note(action, reason, Some(&before));
            }
        }
    }

    fn act(&mut self, action: &Action) -> Result<(), String> {
        self.failed.forget_replaced(action);
        match action {
            Action::OpenWriter(key, gid, qos, hash) => {
                let publisher = Publisher { gid: *gid, qos: *qos, type_hash: hash.clone() };
                let writer = self.far.open_writer(key, &publisher)?;
                self.writers.insert(key.clone(), *gid, writer);
            }
            Action::CloseWriter(key, gid) => {
                self.relay.close(key.clone(), *gid);
                self.writers.remove(key, *gid);
            }
            Action::StartOut(key, outward) if key.is_of_action() || self.out.contains_key(key) => {
                self.waiting.remove(key);
                self.start_out(key, outward, Vec::new())?;
            }
            Action::StartOut(key, outward) => {
                self.waiting.insert(key.clone(), (outward.clone(), Instant::now()));
            }
            Action::StopOut(key) => {
                self.waiting.remove(key);
                self.out.remove(key);
                self.writers.close(key);
                self.relay.stop_topic(key.clone());
            }
            Action::StartIn(key, inward) => {
                // The installed type may satisfy both the old and the new hash.
                let is_same = |taken: &TakenClass| {
                    taken.inward.qos == inward.qos
                        && (!taken.has_port || taken.inward.offered == inward.offered)
                };
                if self.inward.get(key).is_some_and(is_same) {
                    self.far.find_type(&key.topic, inward.type_hash.as_deref())?;
                    return self.change_in(key, inward);
                }
                self.start_in(key, inward)?;
            }
            Action::AskAgain(key, inward) => self.start_in(key, inward)?,
            Action::ChangeIn(key, inward) => self.change_in(key, inward)?,
            Action::StopIn(key) => {
                self.inward.remove(key);
                self.far.stop_in(key);
            }
        }
        Ok(())
    }

    fn change_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        if self.failed.change_start(key, inward) {
            return Ok(());
        }
        let had_port = self.inward.get(key).is_some_and(|taken| taken.has_port);
        let port = if had_port { None } else { self.port(key, inward)?.0 };
        let has_port = had_port || port.is_some();
        let senders = senders(&self.publishers, key, &inward.publishers, has_port);
        let change = IngressUpdate {
            senders: senders.clone(),
            limiter: Limiter::new(inward.min_period),
            port: port.map(Box::new),
        };
        self.far.change_in(key, change);
        self.inward.insert(key.clone(), TakenClass { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    /// Whether writers are about to match.
    fn is_matching(&self) -> bool {
        let now = Instant::now();
        self.waiting.values().any(|(_, since)| now < *since + MATCH_TIME) || self.writers.is_opening()
    }

    /// Starts taking samples once a writer has matched.
    fn open_matched(&mut self) {
        for (key, (outward, since)) in std::mem::take(&mut self.waiting) {
            if !self.writers.is_matched(&key) {
                self.waiting.insert(key, (outward, since));
                continue;
            }
            // Senders are created first, so that they exist when kept samples arrive.
            let made = self.writers.open(|of| *of == key, |key, writer| sender(&mut self.far, key, writer));
            let made = made.into_iter().map(|(_, gid, sender)| (gid, sender)).collect();
            if let Err(reason) = self.start_out(&key, &outward, made) {
                self.writers.close(&key);
                self.failed.note(Action::StartOut(key, outward), reason, None);
            }
        }
        if self.writers.is_opening() {
            let is_taken = |key: &TopicKey| self.out.contains_key(key);
            let made = self.writers.open(is_taken, |key, writer| sender(&mut self.far, key, writer));
            made.into_iter().for_each(|(key, gid, sender)| self.relay.open(key, gid, sender));
            self.writers.schedule_check(is_taken);
        }
    }

    fn start_out(
        &mut self,
        key: &TopicKey,
        outward: &Outward,
        made: Vec<(Gid, <F::Egress as Egress>::Sender)>,
    ) -> Result<(), String> {
        let subscription = self.subscribe(key, outward).map_err(|error| error.to_string())?;
        let counters = self.stats.counters((key.clone(), Direction::Out));
        let limiter = Limiter::new(outward.min_period);
        self.relay.start_topic(key.clone(), subscription, Outbound { counters, limiter }, made);
        self.out.insert(key.clone(), outward.clone());
        self.writers.request_check();
        Ok(())
    }

    fn subscribe(&self, key: &TopicKey, outward: &Outward) -> Result<RawSubscription, TransportError> {
        let hash = outward.type_hash.clone().map(Into::into);
        let topic_type = TopicType { hash, ..TopicType::new(key.type_name.clone()) };
        let durability = if outward.is_kept { Durability::TransientLocal } else { Durability::Volatile };
        let depth = outward.depth.clamp(1, Limits::MAX_DEPTH);
        let history = if outward.keeps_all { History::KeepAll } else { History::KeepLast };
        let qos = Qos { durability, history, ..Qos::keep_last(depth) };
        self.participant.create_relay_subscription(&key.topic, &topic_type, qos, Limits::default())
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        // Keeps the port, and thereby its samples for late joiners, if possible.
        let has_same = |taken: &TakenClass| taken.has_port && taken.inward.offered == inward.offered;
        let keeps_port = self.inward.get(key).is_some_and(has_same);
        let (port, schema) = match keeps_port {
            true => {
                let found = self.far.find_type(&key.topic, inward.type_hash.as_deref())?;
                (IngressPort::Same, found.schema)
            }
            false => {
                let (port, schema) = self.port(key, inward)?;
                (port.map_or(IngressPort::None, |port| IngressPort::New(Box::new(port))), schema)
            }
        };
        let has_port = !matches!(port, IngressPort::None);
        let senders = senders(&self.publishers, key, &inward.publishers, has_port);
        let counters = self.stats.counters((key.topic.clone(), Direction::In));
        let limiter = Limiter::new(inward.min_period);
        let ingress = Ingress::new(port, schema, counters, limiter, senders.clone(), F::DELIVERY);
        if let Err(reason) = self.far.start_in(key, inward, ingress) {
            if !self.far.is_taking(key) {
                // The next attempt starts from scratch.
                self.inward.remove(key);
            }
            return Err(reason);
        }
        self.inward.insert(key.clone(), TakenClass { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    /// Creates the port of a class, if there is a publisher. Returns the port and the type's definition.
    fn port(
        &mut self,
        key: &InKey,
        inward: &Inward,
    ) -> Result<(Option<RawPublisher>, Option<Arc<Schema>>), String> {
        let FoundType { topic_type, schema } = self.far.find_type(&key.topic, inward.type_hash.as_deref())?;
        if inward.publishers.is_empty() {
            return Ok((None, schema));
        }
        let port = F::port(&self.participant, &key.topic.topic, &topic_type, inward.offered);
        Ok((Some(port.map_err(|error| error.to_string())?), schema))
    }

    fn report(&mut self, elapsed: Duration) {
        let mut problems = self.problems.clone();
        problems.extend(self.mirror.problems().clone());
        problems.extend(self.failed.reasons());
        let report = Report {
            uptime_s: self.started.elapsed().as_secs_f64(),
            problems,
            topics: self.stats.stats(elapsed),
            service_problems: self.services.problems(),
            services: self.services.read(elapsed),
        };
        self.far.report(report, &self.writers);
    }
}

/// The sender for a writer's publisher, if it can be created.
fn sender<F: FarSide>(
    far: &mut F,
    key: &TopicKey,
    writer: &F::Writer,
) -> Option<<F::Egress as Egress>::Sender> {
    let made = far.sender(key, writer).map_err(|reason| {
        tracing::warn!("topic '{}' is not sent, retrying: {reason}", key.topic);
    });
    made.ok()
}

/// The senders of a class, among the known publishers.
fn senders(
    known: &HashMap<String, BTreeSet<Gid>>,
    key: &InKey,
    publishers: &BTreeMap<Gid, Option<Duration>>,
    has_port: bool,
) -> Senders {
    let none = BTreeSet::new();
    Senders::of(known.get(&key.topic.far_topic).unwrap_or(&none), publishers, has_port)
}
