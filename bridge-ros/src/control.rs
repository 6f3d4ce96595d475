// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does what the mirror decides: one thread, told when either graph changes, that makes and ends everything.

mod counterparts;
mod failed;
mod shown;
mod told;

use crate::bridge::{Options, Shared};
use crate::incoming::{Incoming, Inlet, Port, Senders};
use crate::mirror::{Action, InKey, Inward, Mirror, Outward, TopicKey};
use crate::outgoing::{Outbound, Outgoing};
use crate::rate::Limiter;
use crate::rcl::{Node, RosPublisher, RosSubscription};
use crate::ros_graph::RosGraph;
use crate::rules::{Direction, Rules};
use crate::services::{Routes, Services};
use crate::table::{OwnTable, Tables};
use crate::types::{BridgedType, Types};
use counterparts::{Counterparts, MATCH_TIME};
use failed::Failed;
use shown::ShownNodes;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError, mpsc};
use std::time::{Duration, Instant};
use tautline_relay::{Book, Counters, Transit};
use tautline_transport::{
    Claim, Durability, EndpointKind, Gid, GraphSnapshot, Limits, NodeInfo, Participant, Qos, RawPublisher,
    RawSubscription, ServiceEndpoint, TopicEndpoint, TopicType, TransportError,
};

/// What the control thread is told.
pub(crate) enum Event {
    /// What exists in Tautline changed.
    Here,
    /// What exists in ROS changed.
    There,
    /// The end.
    Stop,
}

/// How often numbers are read, and what failed is tried again.
const TICK: Duration = Duration::from_secs(1);
/// Between two looks at what exists, for each millisecond that the first one took.
const PAUSE: Duration = Duration::from_millis(4);
/// Nodes of elsewhere that are shown in ROS: a network can claim to have many.
const MOST_SHOWN: usize = 1024;
/// Between two looks whether a publisher in ROS has found its subscriptions.
const MATCH_LOOK: Duration = Duration::from_millis(2);

pub(crate) struct Control {
    participant: Participant,
    node: Arc<Node>,
    mirror: Mirror,
    types: Types,
    outgoing: Outgoing,
    incoming: Incoming,
    services: Services,
    service_rules: Rules,
    shared: Arc<Shared>,
    graph: RosGraph,
    tables: Tables,
    own_table: OwnTable,
    transit: Transit,
    /// What the ROS domain is called where people read it.
    place: String,
    /// Whether the last look at what exists failed.
    is_stale: bool,
    book: Book<TopicKey, Direction>,
    counterparts: Counterparts,
    out: BTreeMap<TopicKey, Outward>,
    /// Topics whose samples are not taken before their publishers in ROS have found somebody.
    waiting: BTreeMap<TopicKey, (Outward, Instant)>,
    inward: BTreeMap<InKey, Taken>,
    shown: ShownNodes,
    failed: Failed,
    started: Instant,
}

/// The threads that carry messages, requests and responses.
pub(crate) struct Carriers {
    pub(crate) outgoing: Outgoing,
    pub(crate) incoming: Incoming,
    pub(crate) services: Services,
}

/// A class that is being taken from ROS.
struct Taken {
    inward: Inward,
    /// Whether there is a port, which offers what `inward` says: once there is somebody who sends.
    has_port: bool,
    /// As the thread that takes was told.
    senders: Senders,
}

impl Control {
    pub(crate) fn new(
        options: &Options,
        participant: Participant,
        node: Arc<Node>,
        carriers: Carriers,
        tables: (Tables, OwnTable),
        shared: Arc<Shared>,
    ) -> Self {
        let Carriers { outgoing, incoming, services } = carriers;
        let (domain, own) = (participant.domain_id(), participant.id());
        let host = tautline_rt::host::name();
        let place = format!("ros{}_{host}", node.context().domain());
        let (tables, own_table) = tables;
        Control {
            tables,
            own_table,
            transit: Transit::to_ros(domain, own, own.into(), &host).going_on(options.transit),
            place,
            participant,
            node,
            mirror: Mirror::new(options.rules.clone()),
            types: Types::new(),
            outgoing,
            incoming,
            services,
            service_rules: options.services.clone(),
            shared,
            graph: RosGraph::default(),
            is_stale: false,
            book: Book::default(),
            counterparts: Counterparts::default(),
            out: BTreeMap::new(),
            waiting: BTreeMap::new(),
            inward: BTreeMap::new(),
            shown: ShownNodes::default(),
            failed: Failed::default(),
            started: Instant::now(),
        }
    }

    /// Until it is told to stop.
    pub(crate) fn run(mut self, events: &mpsc::Receiver<Event>) {
        let (mut last_tick, mut next_update) = (Instant::now(), Instant::now());
        let mut is_changed = true;
        while !self.shared.stop.load(Ordering::Acquire) {
            let mut until = last_tick + TICK;
            if is_changed {
                until = until.min(next_update);
            }
            if self.is_matching() {
                until = until.min(Instant::now() + MATCH_LOOK);
            }
            match events.recv_timeout(until.saturating_duration_since(Instant::now())) {
                Ok(Event::Stop) | Err(mpsc::RecvTimeoutError::Disconnected) => break,
                Ok(Event::Here | Event::There) => is_changed = true,
                Err(mpsc::RecvTimeoutError::Timeout) => {}
            }
            // One look for all that changed at once.
            while let Ok(event) = events.try_recv() {
                is_changed |= !matches!(event, Event::Stop);
            }
            // One, however long an update took.
            let elapsed = last_tick.elapsed();
            if elapsed >= TICK {
                last_tick += elapsed;
                is_changed |= self.is_stale || self.graph.has_unknown();
                self.try_again();
                self.services.try_again(|| self.shown.by_name());
                self.counterparts.look_for_incompatible();
                self.read_numbers(elapsed);
            }
            if is_changed && Instant::now() >= next_update {
                is_changed = false;
                let start = Instant::now();
                self.update();
                // However much changes, most of the time is left to others.
                next_update =
                    Instant::now() + PAUSE * start.elapsed().as_millis().try_into().unwrap_or(u32::MAX);
            }
            self.look_for_matches();
        }
    }

    /// Brings everything in line with what exists.
    fn update(&mut self) {
        let here = self.participant.graph().map_err(|error| error.to_string());
        let read = here.and_then(|here| match self.graph.read(&self.node, &self.place, &self.tables) {
            Ok(()) => Ok(here),
            Err(error) => Err(error.to_string()),
        });
        // Looked at again with the next tick.
        self.is_stale = read.is_err();
        let here = match read {
            Ok(here) => here,
            Err(error) => return tracing::warn!("what exists is not known: {error}"),
        };
        let nodes = self.graph.others(&self.shown.in_ros(), self.participant.domain_id(), &self.place);
        let services = self.read_services(&here);
        self.weigh(&here, &nodes, &services);
        let own = Some(self.participant.id());
        let ends = here.endpoints.iter().map(AsRef::as_ref).filter(|end: &&TopicEndpoint| end.teller != own);
        let is_publisher = |end: &TopicEndpoint| end.kind == EndpointKind::Publisher;
        let is_announced = |end: &TopicEndpoint| self.transit.announced(&end.origin).is_some();
        // Left to somebody else who tells ROS of the same.
        let passed_over = ends.clone().filter(|end| is_publisher(end) && !is_announced(end));
        let mut passed_over: HashSet<Gid> = passed_over.map(|end| end.gid).collect();
        let mut before = self.outgoing.passed_over().lock().unwrap_or_else(PoisonError::into_inner);
        // What was there before is dropped after the lock: the thread that sends may wait for it.
        std::mem::swap(&mut *before, &mut passed_over);
        drop(before);
        let told = ends.clone().filter(|end| !is_publisher(end) || is_announced(end));
        let there = self.graph.endpoints.iter().filter(|(end, teller)| match end.kind {
            EndpointKind::Publisher => self.transit.carries(&end.origin, *teller),
            EndpointKind::Subscription => self.transit.told(&end.origin, *teller).is_some(),
        });
        let there: Vec<TopicEndpoint> = there.map(|(end, _)| end.clone()).collect();
        let told: Vec<&TopicEndpoint> = told.collect();
        for action in self.mirror.update(told, &there) {
            self.act(action);
        }
        self.renew_senders();
        let transit = &self.transit;
        let is_announced = |node: &NodeInfo| transit.announced(&node.origin).is_some();
        let shown = here.nodes.iter().filter(|node| node.teller != own && is_announced(node));
        let (own_nodes, others): (Vec<_>, Vec<_>) = shown.partition(|node| node.origin.is_here());
        let shown = own_nodes.into_iter().chain(others.into_iter().take(MOST_SHOWN));
        self.shown.update(&self.node, shown.map(|node| &node.name));
        // After the topics: an action's feedback has its way before goals have.
        self.route_services(&here, &services);
        self.tell_bridges(&here);
        self.show_ros(&nodes, services);
    }

    fn route_services(&mut self, here: &GraphSnapshot, there: &[(ServiceEndpoint, u128)]) {
        let own = Some(self.participant.id());
        let ends = here.services.iter().map(AsRef::as_ref).filter(|end: &&ServiceEndpoint| end.teller != own);
        let there = there.iter().filter(|(end, teller)| self.transit.carries(&end.origin, *teller));
        let there: Vec<ServiceEndpoint> = there.map(|(end, _)| end.clone()).collect();
        let announced = |end: &ServiceEndpoint| self.transit.announced(&end.origin).is_some();
        let routes = Routes::of(&self.service_rules, ends, &there, self.services.routes(), announced);
        self.services.set_routes(routes, self.shown.by_name());
    }

    /// Publishers in ROS come and go that a subscription matches though they are not of its class.
    fn renew_senders(&mut self) {
        for (key, taken) in &mut self.inward {
            let Some(publishers) = self.mirror.publishers(key) else { continue };
            let senders = senders(&self.graph, key, publishers, taken.has_port);
            if senders != taken.senders {
                taken.senders = senders.clone();
                let limiter = Limiter::new(taken.inward.min_period);
                self.incoming.change(key.clone(), senders, limiter, None);
            }
        }
    }

    fn act(&mut self, action: Action) {
        if let Err(reason) = self.try_to(&action) {
            self.failed.note(action, reason, None);
        }
    }

    /// What failed may be possible now: there is memory, a package was installed.
    fn try_again(&mut self) {
        for (action, before) in self.failed.take() {
            if let Err(reason) = self.try_to(&action) {
                self.failed.note(action, reason, Some(&before));
            }
        }
    }

    fn try_to(&mut self, action: &Action) -> Result<(), String> {
        self.failed.forget_replaced(action);
        match action {
            Action::OpenWriter(key, gid, qos, hash) => self.open_writer(key, *gid, qos, hash.as_deref())?,
            Action::CloseWriter(key, gid) => {
                self.outgoing.close(key.clone(), *gid);
                self.counterparts.remove(key, *gid);
            }
            Action::StartOut(key, outward)
                if key.is_of_action() || self.out.contains_key(key) || self.counterparts.is_matched(key) =>
            {
                self.start_out(key, outward)?;
            }
            Action::StartOut(key, outward) => {
                self.waiting.insert(key.clone(), (outward.clone(), Instant::now()));
            }
            Action::StopOut(key) => {
                self.waiting.remove(key);
                self.out.remove(key);
                self.counterparts.close(key);
                self.outgoing.stop_topic(key.clone());
            }
            Action::StartIn(key, inward) => self.start_in(key, inward)?,
            Action::ChangeIn(key, inward) => self.change_in(key, inward)?,
            Action::StopIn(key) => {
                self.inward.remove(key);
                self.incoming.close(key.clone());
            }
        }
        Ok(())
    }

    fn change_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        if self.failed.change_start(key, inward) {
            return Ok(());
        }
        let had_port = self.inward.get(key).is_some_and(|taken| taken.has_port);
        let port = if had_port {
            None
        } else {
            let found = self.find_type(&key.topic, inward.type_hash.as_deref())?;
            self.port(&key.topic, &found, inward)?
        };
        let has_port = had_port || port.is_some();
        let senders = senders(&self.graph, key, &inward.publishers, has_port);
        self.incoming.change(key.clone(), senders.clone(), Limiter::new(inward.min_period), port);
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    fn open_writer(&mut self, key: &TopicKey, gid: Gid, qos: &Qos, hash: Option<&str>) -> Result<(), String> {
        let found = self.find_type(key, hash)?;
        let publisher = RosPublisher::new(&self.node, &key.ros_topic, &found.support, qos);
        self.counterparts.insert(key, gid, publisher.map_err(|error| error.to_string())?);
        Ok(())
    }

    fn find_type(&mut self, key: &TopicKey, hash: Option<&str>) -> Result<BridgedType, String> {
        self.types.find(&key.type_name, hash).map_err(|error| error.to_string())
    }

    /// Whether subscriptions in ROS are about to be found.
    fn is_matching(&self) -> bool {
        let now = Instant::now();
        self.waiting.values().any(|(_, since)| now < *since + MATCH_TIME)
            || self.counterparts.is_opening(|key| self.out.contains_key(key))
    }

    /// Samples are taken once a publisher in ROS has somebody to send them to.
    fn look_for_matches(&mut self) {
        for (key, (outward, since)) in std::mem::take(&mut self.waiting) {
            if !self.counterparts.is_matched(&key) {
                self.waiting.insert(key, (outward, since));
            } else if let Err(reason) = self.start_out(&key, &outward) {
                self.failed.note(Action::StartOut(key, outward), reason, None);
            }
        }
        self.counterparts.open_matched(
            |key| self.out.contains_key(key),
            |key, gid, writer| self.outgoing.open(key.clone(), gid, writer),
        );
    }

    fn start_out(&mut self, key: &TopicKey, outward: &Outward) -> Result<(), String> {
        let subscription = self.subscribe(key, outward).map_err(|error| error.to_string())?;
        let counters = self.counters(key, Direction::ToRos);
        let limiter = Limiter::new(outward.min_period);
        self.outgoing.start_topic(key.clone(), subscription, Outbound { counters, limiter });
        self.out.insert(key.clone(), outward.clone());
        Ok(())
    }

    fn subscribe(&mut self, key: &TopicKey, outward: &Outward) -> Result<RawSubscription, TransportError> {
        let hash = outward.type_hash.clone().map(Into::into);
        let topic_type = TopicType { hash, ..TopicType::new(key.type_name.clone()) };
        let durability = if outward.is_kept { Durability::TransientLocal } else { Durability::Volatile };
        let qos = Qos { durability, ..Qos::keep_last(outward.depth) };
        self.participant.create_relay_subscription(&key.topic, &topic_type, qos, Limits::default())
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        // The type is the one that ROS has installed, whatever the topic stated before and states now.
        let found = self.find_type(&key.topic, inward.type_hash.as_deref())?;
        let before = self.inward.get(key);
        // What the port keeps for late joiners is not to be lost without need; nor what a subscription gets that ROS knows.
        let has_same = |taken: &Taken| taken.has_port && taken.inward.offered == inward.offered;
        let has_same_or_none = |taken: &Taken| !taken.has_port || has_same(taken);
        if before.is_some_and(|taken| taken.inward.qos == inward.qos && has_same_or_none(taken)) {
            return self.change_in(key, inward);
        }
        let port = match before.is_some_and(has_same) {
            true => Port::Same,
            false => {
                self.port(&key.topic, &found, inward)?.map_or(Port::None, |port| Port::New(Box::new(port)))
            }
        };
        let has_port = !matches!(port, Port::None);
        let senders = senders(&self.graph, key, &inward.publishers, has_port);
        let subscription =
            RosSubscription::new(&self.node, &key.topic.ros_topic, &found.support, &inward.qos);
        let inlet = Inlet {
            subscription: subscription.map_err(|error| error.to_string())?,
            port,
            schema: found.schema,
            counters: self.counters(&key.topic, Direction::FromRos),
            limiter: Limiter::new(inward.min_period),
            senders: senders.clone(),
        };
        self.incoming.open(key.clone(), inlet);
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), has_port, senders });
        Ok(())
    }

    /// The port that messages of the class come through here, once there is somebody who sends them.
    fn port(
        &self,
        key: &TopicKey,
        found: &BridgedType,
        inward: &Inward,
    ) -> Result<Option<RawPublisher>, String> {
        if inward.publishers.is_empty() {
            return Ok(None);
        }
        let topic_type = found.topic_type();
        // How long other messages are is not known before they come: what would be claimed ahead is a guess.
        let claim = if topic_type.body_bytes.is_some() { Claim::Ahead } else { Claim::OnUse };
        let limits = Limits { claim, ..Limits::default() };
        let port = self.participant.create_raw_publisher(&key.topic, &topic_type, inward.offered, limits);
        let port = port.map_err(|error| error.to_string())?;
        Ok(Some(port))
    }

    fn counters(&mut self, key: &TopicKey, direction: Direction) -> Arc<Counters> {
        let (out, inward) = (&self.out, &self.inward);
        self.book.counters(key.clone(), direction, |key, direction| is_active(out, inward, key, direction))
    }

    fn read_numbers(&mut self, elapsed: Duration) {
        let mut stats = self.shared.stats();
        stats.uptime_s = self.started.elapsed().as_secs_f64();
        stats.ros_nodes = self.graph.nodes.len();
        stats.ros_endpoints = self.graph.endpoints.len();
        stats.not_bridged = self.mirror.problems().clone();
        stats.not_bridged.extend(self.failed.reasons());
        stats.services_not_bridged = self.services.problems();
        stats.services = self.services.stats();
        stats.incompatible_qos = self.counterparts.incompatible();
        let (out, inward) = (&self.out, &self.inward);
        stats.topics =
            self.book.read(elapsed, TopicKey::clone, |key, direction| is_active(out, inward, key, direction));
    }
}

/// Of the publishers in ROS that are known.
fn senders(graph: &RosGraph, key: &InKey, publishers: &BTreeSet<Gid>, has_port: bool) -> Senders {
    let none = BTreeSet::new();
    Senders::of(graph.publishers.get(&key.topic.ros_topic).unwrap_or(&none), publishers, has_port)
}

fn is_active(
    out: &BTreeMap<TopicKey, Outward>,
    inward: &BTreeMap<InKey, Taken>,
    key: &TopicKey,
    direction: Direction,
) -> bool {
    match direction {
        Direction::ToRos => out.contains_key(key),
        Direction::FromRos => inward.keys().any(|other| other.topic == *key),
    }
}
