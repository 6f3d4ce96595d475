// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does what the mirror decides: one thread, told when either side changes, that makes and ends everything.

mod failed;

use crate::ingress::{Delivery, Ingress, IngressUpdate, Port, Senders};
use crate::limiter::Limiter;
use crate::mirror::{Action, Far, InKey, Inward, Mirror, Outward, Side, TopicKey};
use crate::relay::Relay;
use crate::route::{Egress, Outbound};
use crate::rules::{Direction, Rules};
use crate::services::{FarServices, Routes, ServiceStats, Services};
use crate::stats::{TopicStats, TopicStatsTable};
use crate::transit::Transit;
use crate::writers::{FarWriter, MATCH_TIME, Writers};
use failed::Failed;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};
use tautline_schema::Schema;
use tautline_transport::{
    Durability, EndpointKind, Gid, GraphSnapshot, Limits, NodeInfo, Participant, Qos, RawPublisher,
    RawSubscription, RemoteGraph, RemoteNode, ServiceEndpoint, TopicEndpoint, TopicType, TransportError,
};

/// What a mirror mirrors a domain with: a network, or a ROS 2 graph. [`Control`] calls it, from one thread.
pub trait FarSide: Sized {
    /// What it is.
    const SIDE: Side;
    /// What is known of the order of its messages, and of their publishers.
    const DELIVERY: Delivery;
    /// What it is told of by others than this thread.
    type Event: Send;
    /// What takes samples from here.
    type Egress: Egress<Key = TopicKey, Topic = Outbound>;
    /// What stands there for a publisher here.
    type Writer: FarWriter;
    /// Its part in services.
    type Services: FarServices;
    /// How long others are told of nothing new until services can be asked; `None`: clients there look for them anyway.
    const PATIENCE: Option<Duration>;

    /// Something happened. Whether what exists there is otherwise.
    fn hear(&mut self, event: Self::Event) -> bool;

    /// What exists there, but for what this one made; `here` exists in the domain. An error is said, and tried again.
    ///
    /// # Errors
    /// Why that is not known.
    fn look(&mut self, here: &LocalGraph) -> Result<FarGraph, String>;

    /// Before anything is done: `here` is in terms of the domain, and some of it can perhaps not be told there.
    fn prepare(&mut self, here: &mut LocalGraph, transit: &Transit);

    /// After topics are in line with what exists: what services are made with there.
    fn show(&mut self, here: &LocalGraph, transit: &Transit) -> <Self::Services as FarServices>::With;

    /// The same again, as it was last.
    fn shown(&self) -> <Self::Services as FarServices>::With;

    /// After services, too: others there are told of what is here.
    fn tell(&mut self, here: &LocalGraph, transit: &Transit, writers: &Writers<Self::Writer>);

    /// A second has gone by. Whether it is to be looked anew what exists.
    fn tick(&mut self, writers: &mut Writers<Self::Writer>) -> bool;

    /// What is known of a topic's type, for messages that come in.
    ///
    /// # Errors
    /// Why it cannot be mirrored.
    fn find_type(&mut self, key: &TopicKey, hash: Option<&str>) -> Result<FoundType, String>;

    /// Makes what stands there for a publisher.
    ///
    /// # Errors
    /// Why that is not possible.
    fn open_writer(&mut self, key: &TopicKey, publisher: &Publisher) -> Result<Self::Writer, String>;

    /// Whether this is what stands there for it now: if not, another one is made.
    fn is_current(&self, publisher: &Gid, writer: &Self::Writer) -> bool {
        let _ = (publisher, writer);
        true
    }

    /// What passes a publisher's samples on.
    ///
    /// # Errors
    /// Why that is not possible.
    fn sender(
        &mut self,
        key: &TopicKey,
        writer: &Self::Writer,
    ) -> Result<<Self::Egress as Egress>::Sender, String>;

    /// A port of the domain for messages from there.
    ///
    /// # Errors
    /// As [`Participant::create_raw_publisher`].
    fn port(
        participant: &Participant,
        topic: &str,
        topic_type: &TopicType,
        offered: Qos,
    ) -> Result<RawPublisher, TransportError>;

    /// Takes messages of a class from now on; in place of what takes them, if there is such.
    ///
    /// # Errors
    /// Why that is not possible.
    fn start_in(&mut self, key: &InKey, inward: &Inward, ingress: Ingress) -> Result<(), String>;

    /// Whether messages of a class are being taken: one that could not be begun anew may have ended.
    fn takes(&self, key: &InKey) -> bool {
        let _ = key;
        true
    }

    /// What is otherwise with one that is being taken.
    fn change_in(&mut self, key: &InKey, change: IngressUpdate);

    /// No longer.
    fn stop_in(&mut self, key: &InKey);

    /// By which the domain is told of a service's end there.
    fn told_gid(end: &ServiceEndpoint) -> Gid {
        end.gid
    }

    /// What there is to be known now, for whoever asks.
    fn report(&mut self, report: Report, writers: &Writers<Self::Writer>);
}

/// A publisher of the domain, for which something is to stand elsewhere.
pub struct Publisher {
    /// Its gid here.
    pub gid: Gid,
    /// What it offers.
    pub qos: Qos,
    /// What the topic says of its type.
    pub type_hash: Option<String>,
}

/// What is known of a type.
pub struct FoundType {
    /// As topics state it.
    pub topic_type: TopicType,
    /// The definition, which what comes in is checked against.
    pub schema: Option<Arc<Schema>>,
}

/// What the domain has, but for what this mirror tells it of.
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
    /// The tags of the publishers that have ended by themselves, the last few of them.
    pub ended: Vec<u64>,
    /// Topics and services that cannot be told there, and why.
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

/// What exists on the far side, each with who tells of it there; see [`Transit`].
#[derive(Default)]
pub struct FarGraph {
    /// Nodes.
    pub nodes: Vec<(RemoteNode, u128)>,
    /// Publishers and subscriptions.
    pub endpoints: Vec<(TopicEndpoint, u128)>,
    /// Services and clients.
    pub services: Vec<(ServiceEndpoint, u128)>,
    /// By topic, all publishers that it is known of what they are.
    pub publishers: HashMap<String, BTreeSet<Gid>>,
    /// The tags of publishers that have ended by themselves, as far as that is told.
    pub ended: BTreeSet<u64>,
}

/// What there is to be known of a mirror.
pub struct Report {
    /// Since it started.
    pub uptime_s: f64,
    /// Topics that cannot be mirrored, and why.
    pub problems: BTreeMap<String, String>,
    /// Every topic that is or was mirrored.
    pub topics: Vec<TopicStats<TopicKey, Direction>>,
    /// Services that cannot be mirrored, and why.
    pub service_problems: BTreeMap<String, String>,
    /// Every service that is or was mirrored.
    pub services: Vec<ServiceStats<TopicKey, Direction>>,
}

/// What the control thread is told.
pub enum Event<E> {
    /// What exists in the domain changed.
    LocalChange,
    /// Something happened on the far side.
    FarChange(E),
    /// The end.
    Stop,
}

/// Tells the control thread when what exists in the domain changed, until `stop`.
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
            // The control thread has much to do, at this thread's priority: let it.
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// How often numbers are read, and what failed is tried again.
const TICK: Duration = Duration::from_secs(1);
/// Between two looks at what exists at least: what comes with one another is seen together, and a look costs as much as there is.
const PAUSE: Duration = Duration::from_millis(2);
/// The same for each time that a look took: however much changes, most of the time is left to others.
const PAUSE_PER_LOOK: u32 = 4;
/// Events that are heard before anything else has its turn.
const EVENTS_AT_ONCE: usize = 1024;
/// Between two looks whether a writer has found its subscriptions.
const MATCH_LOOK: Duration = Duration::from_millis(2);

/// What a mirror consists of.
pub struct Parts<F: FarSide> {
    /// The domain.
    pub participant: Participant,
    /// The other side.
    pub far: F,
    /// The thread that takes samples.
    pub relay: Relay<F::Egress>,
    /// The thread that carries requests and responses.
    pub services: Services<F::Services>,
    /// What is told and carried.
    pub transit: Transit,
    /// Which topics.
    pub rules: Rules,
    /// Which services.
    pub service_rules: Rules,
}

/// Keeps both sides of a mirror in line.
pub struct Control<F: FarSide> {
    services: Services<F::Services>,
    relay: Relay<F::Egress>,
    writers: Writers<F::Writer>,
    far: F,
    participant: Participant,
    transit: Transit,
    mirror: Mirror,
    service_rules: Rules,
    /// Whether the last look at what exists failed.
    is_stale: bool,
    stats: TopicStatsTable<TopicKey, Direction>,
    out: BTreeMap<TopicKey, Outward>,
    /// Topics whose samples are not taken before their writers have found somebody.
    waiting: BTreeMap<TopicKey, (Outward, Instant)>,
    inward: BTreeMap<InKey, Taken>,
    failed: Failed,
    /// As they were told last.
    publishers: HashMap<String, BTreeSet<Gid>>,
    problems: BTreeMap<String, String>,
    started: Instant,
}

/// A class that is being taken.
struct Taken {
    inward: Inward,
    /// Whether there is a port, which offers what `inward` says: once there is somebody who sends.
    has_port: bool,
    /// As who takes was told.
    senders: Senders,
}

impl<F: FarSide> Control<F> {
    /// Of these parts; nothing is done yet.
    pub fn new(parts: Parts<F>) -> Self {
        let Parts { participant, far, relay, services, transit, rules, service_rules } = parts;
        let (stats, out, waiting, inward) = Default::default();
        let (failed, publishers, problems) = Default::default();
        Control {
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

    /// Until it is told to stop.
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
            let first = events.recv_timeout(until.saturating_duration_since(Instant::now()));
            if matches!(first, Err(mpsc::RecvTimeoutError::Disconnected)) {
                break;
            }
            // One look for all that changed at once.
            for event in first.into_iter().chain(events.try_iter()).take(EVENTS_AT_ONCE) {
                is_changed |= match event {
                    Event::LocalChange => true,
                    Event::FarChange(event) => self.far.hear(event),
                    Event::Stop => false,
                };
            }
            // One, however long an update took.
            let elapsed = last_tick.elapsed();
            if elapsed >= TICK {
                last_tick += elapsed;
                is_changed |= self.far.tick(&mut self.writers) || self.is_stale;
                self.try_again();
                self.services.try_again(|| self.far.shown());
                self.report(elapsed);
            }
            if is_changed && Instant::now() >= next_update {
                is_changed = false;
                let start = Instant::now();
                self.update();
                next_update = Instant::now() + PAUSE + start.elapsed() * PAUSE_PER_LOOK;
            }
            self.look_for_matches();
        }
        if is_changed {
            self.update();
        }
        // What was published still goes out.
        self.out.keys().for_each(|key| self.relay.stop_topic(key.clone()));
    }

    /// Brings everything in line with what exists.
    fn update(&mut self) {
        let seen = self.participant.graph().map_err(|error| error.to_string()).and_then(|snapshot| {
            let here = LocalGraph::of(self.participant.id(), &snapshot);
            Ok((self.far.look(&here)?, here, snapshot))
        });
        // Looked at again with the next tick.
        self.is_stale = seen.is_err();
        let (there, mut here, snapshot) = match seen {
            Ok(seen) => seen,
            Err(error) => return tracing::warn!("what exists is not known: {error}"),
        };
        let transit = &mut self.transit;
        transit.look_anew(&snapshot.rivals);
        there.nodes.iter().for_each(|(node, teller)| transit.insert(&node.origin, *teller));
        there.endpoints.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
        there.services.iter().for_each(|(end, teller)| transit.insert(&end.origin, *teller));
        self.far.prepare(&mut here, &self.transit);
        for (key, gid) in self.writers.others(|gid, writer| self.far.is_current(gid, writer)) {
            self.mirror.forget_writer(&key, gid);
            self.relay.close(key.clone(), gid);
            self.writers.remove(&key, gid);
        }
        self.mirror_topics(&here, &there);
        // After the topics: an action's feedback has its way before goals have.
        self.route_services(&here, &there);
        self.far.tell(&here, &self.transit, &self.writers);
        if let Err(error) = self.participant.set_remote(&self.remote(there)) {
            tracing::warn!("nodes and tools of this host do not see what is elsewhere: {error}");
        }
        self.problems = here.problems;
    }

    fn mirror_topics(&mut self, here: &LocalGraph, there: &FarGraph) {
        let transit = &self.transit;
        let is_publisher = |end: &TopicEndpoint| end.kind == EndpointKind::Publisher;
        let is_left = |end: &TopicEndpoint| is_publisher(end) && transit.announced(&end.origin).is_none();
        let (left, told): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            here.endpoints.iter().map(AsRef::as_ref).partition(|end| is_left(end));
        // Left to somebody else who tells of the same there.
        let mut passed_over: HashSet<Gid> = left.into_iter().map(|end| end.gid).collect();
        let mut before = self.relay.passed_over().lock();
        // What was there before is dropped after the lock: the thread that sends may wait for it.
        std::mem::swap(&mut *before, &mut passed_over);
        drop(before);
        let far = there.endpoints.iter().filter_map(|(end, teller)| match end.kind {
            EndpointKind::Publisher => Some((end, transit.carries(&end.origin, *teller))),
            EndpointKind::Subscription => transit.told(&end.origin, *teller).map(|_| (end, true)),
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
        let with = self.far.show(here, &self.transit);
        let transit = &self.transit;
        let there = there.services.iter().filter(|(end, teller)| transit.carries(&end.origin, *teller));
        let there: Vec<ServiceEndpoint> = there.map(|(end, _)| end.clone()).collect();
        let announced = |end: &ServiceEndpoint| transit.announced(&end.origin).is_some();
        let (ends, before) = (here.services.iter().map(AsRef::as_ref), self.services.routes());
        let routes = Routes::of(F::SIDE, &self.service_rules, ends, &there, before, announced);
        let applied = self.services.set_routes(routes, with);
        // Who hears of a service may ask at once.
        if F::PATIENCE.is_some_and(|patience| !applied.wait(patience)) {
            tracing::warn!("services change slowly: some are announced before they can be asked");
        }
    }

    /// What the domain is told of, by its own names. The same graph is the same list.
    fn remote(&self, there: FarGraph) -> RemoteGraph {
        let rules = &self.mirror.rules;
        let mut remote = RemoteGraph { ended: there.ended, ..RemoteGraph::default() };
        for (RemoteNode { name, origin }, teller) in there.nodes {
            let told = self.transit.told(&origin, teller);
            remote.nodes.extend(told.map(|origin| RemoteNode { name, origin }));
        }
        for (end, teller) in there.endpoints {
            let Some(topic) = rules.here_name(&end.topic) else { continue };
            // What is not let through is not told: somebody else may have a way.
            let way = match end.kind {
                EndpointKind::Publisher => Direction::In,
                EndpointKind::Subscription => Direction::Out,
            };
            let goes = rules.choice(&topic).is_some_and(|choice| choice.goes(way));
            let told = self.transit.told(&end.origin, teller).filter(|_| goes);
            remote.endpoints.extend(told.map(|origin| TopicEndpoint { topic, origin, ..end }));
        }
        for (end, teller) in there.services {
            let Some(name) = self.service_rules.here_name(&end.name) else { continue };
            let told = self.transit.told(&end.origin, teller);
            let gid = F::told_gid(&end);
            remote.services.extend(told.map(|origin| ServiceEndpoint { name, gid, origin, ..end }));
        }
        remote.nodes.sort();
        remote.endpoints.sort_by(|one, other| (&one.topic, one.gid).cmp(&(&other.topic, other.gid)));
        remote.services.sort_by(|one, other| {
            (&one.name, one.kind, &one.node, one.gid).cmp(&(&other.name, other.kind, &other.node, other.gid))
        });
        remote
    }

    /// Publishers there come and go that a subscription gets messages of though they are none of its class.
    fn renew_senders(&mut self) {
        for (key, taken) in &mut self.inward {
            // Also of one that goes on as it was, for it could not be begun anew.
            let Some(publishers) = self.mirror.publishers(key) else { continue };
            let senders = senders(&self.publishers, key, publishers, taken.has_port);
            if senders != taken.senders {
                taken.senders = senders.clone();
                let limiter = Limiter::new(taken.inward.min_period);
                self.far.change_in(key, IngressUpdate { senders, limiter, port: None });
            }
        }
    }

    /// What failed may be possible now: there is memory, a package was installed.
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
                // The type may be the one that is known whatever the topic stated before and states now.
                let is_same = |taken: &Taken| {
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
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    /// Whether writers are about to find their subscriptions.
    fn is_matching(&self) -> bool {
        let now = Instant::now();
        self.waiting.values().any(|(_, since)| now < *since + MATCH_TIME) || self.writers.is_opening()
    }

    /// Samples are taken once a writer has somebody to send them to.
    fn look_for_matches(&mut self) {
        for (key, (outward, since)) in std::mem::take(&mut self.waiting) {
            if !self.writers.is_matched(&key) {
                self.waiting.insert(key, (outward, since));
                continue;
            }
            // Made ahead, so that what is kept finds them.
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
            self.writers.look_later(is_taken);
        }
    }

    fn start_out(
        &mut self,
        key: &TopicKey,
        outward: &Outward,
        made: Vec<(Gid, <F::Egress as Egress>::Sender)>,
    ) -> Result<(), String> {
        let subscription = self.subscribe(key, outward).map_err(|error| error.to_string())?;
        let counters = self.stats.counters(key.clone(), Direction::Out);
        let limiter = Limiter::new(outward.min_period);
        self.relay.start_topic(key.clone(), subscription, Outbound { counters, limiter }, made);
        self.out.insert(key.clone(), outward.clone());
        self.writers.take();
        Ok(())
    }

    fn subscribe(&self, key: &TopicKey, outward: &Outward) -> Result<RawSubscription, TransportError> {
        let hash = outward.type_hash.clone().map(Into::into);
        let topic_type = TopicType { hash, ..TopicType::new(key.type_name.clone()) };
        let durability = if outward.is_kept { Durability::TransientLocal } else { Durability::Volatile };
        let depth = outward.depth.clamp(1, Limits::MAX_DEPTH);
        let qos = Qos { durability, ..Qos::keep_last(depth) };
        self.participant.create_relay_subscription(&key.topic, &topic_type, qos, Limits::default())
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        // What the port keeps for late joiners is not to be lost without need.
        let has_same = |taken: &Taken| taken.has_port && taken.inward.offered == inward.offered;
        let keeps_port = self.inward.get(key).is_some_and(has_same);
        let (port, schema) = match keeps_port {
            true => {
                let found = self.far.find_type(&key.topic, inward.type_hash.as_deref())?;
                (Port::Same, found.schema)
            }
            false => {
                let (port, schema) = self.port(key, inward)?;
                (port.map_or(Port::None, |port| Port::New(Box::new(port))), schema)
            }
        };
        let has_port = !matches!(port, Port::None);
        let senders = senders(&self.publishers, key, &inward.publishers, has_port);
        let counters = self.stats.counters(key.topic.clone(), Direction::In);
        let limiter = Limiter::new(inward.min_period);
        let ingress = Ingress::new(port, schema, counters, limiter, senders.clone(), F::DELIVERY);
        if let Err(reason) = self.far.start_in(key, inward, ingress) {
            if !self.far.takes(key) {
                // Begun without what it had, the next time.
                self.inward.remove(key);
            }
            return Err(reason);
        }
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    /// The port that messages of the class come through here, once there is somebody who sends them; and their definition.
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
            topics: self.stats.read(elapsed),
            service_problems: self.services.problems(),
            services: self.services.read(),
        };
        self.far.report(report, &self.writers);
    }
}

/// What passes on the samples of a writer's publisher, if it can be made.
fn sender<F: FarSide>(
    far: &mut F,
    key: &TopicKey,
    writer: &F::Writer,
) -> Option<<F::Egress as Egress>::Sender> {
    let made = far.sender(key, writer).map_err(|reason| {
        tracing::warn!("topic '{}' is not sent, which is tried again: {reason}", key.topic);
    });
    made.ok()
}

/// Of the publishers that are known.
fn senders(
    known: &HashMap<String, BTreeSet<Gid>>,
    key: &InKey,
    publishers: &BTreeMap<Gid, Option<Duration>>,
    has_port: bool,
) -> Senders {
    let none = BTreeSet::new();
    Senders::of(known.get(&key.topic.far_topic).unwrap_or(&none), publishers, has_port)
}
