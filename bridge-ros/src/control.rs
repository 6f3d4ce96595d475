// SPDX-License-Identifier: MIT OR Apache-2.0
//! Does what the mirror decides: one thread, told when either graph changes, that makes and ends everything.

use crate::bridge::{Options, Shared};
use crate::incoming::{Incoming, Inlet, Port, Senders};
use crate::mirror::{Action, InKey, Inward, Mirror, Outward, TopicKey};
use crate::outgoing::{Last, Outgoing, Writer};
use crate::rate::Limiter;
use crate::rcl::{Node, RosNode, RosPublisher, RosSubscription};
use crate::ros_graph::{self, RosGraph};
use crate::rules::{Direction, Rules};
use crate::services::{Routes, Services};
use crate::stats::{Book, IncompatibleQos};
use crate::types::{BridgedType, Types};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError, Weak, mpsc};
use std::time::{Duration, Instant};
use tautline_transport::{
    Durability, Gid, GraphSnapshot, Limits, NodeName, Participant, Qos, RawPublisher, RawSubscription,
    ServiceEndpoint, ServiceKind, TransportError,
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
/// How long it is looked often whether a publisher in ROS has found its subscriptions; afterwards, with each tick.
const MATCH_TIME: Duration = Duration::from_secs(3);
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
    /// Whether the last look at what exists failed.
    is_stale: bool,
    book: Book,
    writers: HashMap<(TopicKey, Gid), Counterpart>,
    out: BTreeMap<TopicKey, Outward>,
    /// Topics whose samples are not taken before their publishers in ROS have found somebody.
    waiting: BTreeMap<TopicKey, (Outward, Instant)>,
    inward: BTreeMap<InKey, Taken>,
    /// Tautline's nodes, for ROS to see.
    nodes: BTreeMap<NodeName, Option<Arc<Node>>>,
    /// Those of nodes that have gone, as long as a service holds them.
    gone: Vec<(NodeName, Weak<Node>)>,
    /// What could not be done, and why: it is tried again.
    failed: Vec<(Action, String)>,
    started: Instant,
}

/// A publisher in ROS that stands for one here.
struct Counterpart {
    writer: Writer,
    opened: Instant,
    /// Whether samples go through it.
    is_open: bool,
    incompatible: Option<Incompatible>,
}

/// Ends in ROS that do not fit a publisher's QoS.
#[derive(Clone, Copy)]
struct Incompatible {
    count: u64,
    last_policy: &'static str,
    since: Instant,
}

/// A class that is being taken from ROS.
struct Taken {
    inward: Inward,
    /// Once there is somebody who sends.
    port: Option<Offer>,
    /// As the thread that takes was told.
    senders: Senders,
}

/// What a port offers, and how deep it could.
#[derive(Clone, Copy)]
struct Offer {
    qos: Qos,
    most_depth: usize,
}

impl Offer {
    /// Whether a new port would offer no more.
    fn is_as_good(&self, wanted: Qos) -> bool {
        Qos { depth: wanted.depth.clamp(1, self.most_depth), ..wanted } == self.qos
    }
}

impl Control {
    pub(crate) fn new(
        options: &Options,
        participant: Participant,
        node: Arc<Node>,
        outgoing: Outgoing,
        incoming: Incoming,
        services: Services,
        shared: Arc<Shared>,
    ) -> Self {
        Control {
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
            writers: HashMap::new(),
            out: BTreeMap::new(),
            waiting: BTreeMap::new(),
            inward: BTreeMap::new(),
            nodes: BTreeMap::new(),
            gone: Vec::new(),
            failed: Vec::new(),
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
                self.services.try_again(|| shown(&self.nodes));
                self.look_for_incompatible();
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
        let read = here.and_then(|here| match self.graph.read(&self.node) {
            Ok(()) => Ok(here),
            Err(error) => Err(error.to_string()),
        });
        // Looked at again with the next tick.
        self.is_stale = read.is_err();
        let here = match read {
            Ok(here) => here,
            Err(error) => return tracing::warn!("what exists is not known: {error}"),
        };
        let relays = here.relays.iter().copied().collect();
        *self.outgoing.relays().lock().unwrap_or_else(PoisonError::into_inner) = relays;
        let ends: Vec<_> = here.endpoints.iter().filter(|end| !end.is_remote).cloned().collect();
        for action in self.mirror.update(&ends, &self.graph.endpoints) {
            self.act(action);
        }
        self.renew_senders();
        self.show_nodes(&here);
        // After the topics: an action's feedback has its way before goals have.
        let services = self.read_services();
        self.route_services(&here, &services);
        self.show_ros(services);
    }

    /// Those of ROS, but for bridges' and for what stands there for Tautline's.
    fn read_services(&self) -> Vec<ServiceEndpoint> {
        let gone = self.still_shown();
        let is_shown =
            |node: &RosNode| self.nodes.contains_key(&ros_graph::node_name(node)) || gone.contains(node);
        ros_graph::services(&self.node, self.graph.nodes.iter().filter(|node| !is_shown(node)))
    }

    fn route_services(&mut self, here: &GraphSnapshot, there: &[ServiceEndpoint]) {
        let ends: Vec<_> = here.services.iter().filter(|end| !end.is_remote).cloned().collect();
        let mut there = there.to_vec();
        let asked = ends.iter().filter(|end| end.kind == ServiceKind::Client).map(|end| &*end.name);
        for service in asked.collect::<BTreeSet<_>>() {
            if let Some(choice) = self.service_rules.choice(service) {
                // Without it a server is known by its node's name alone.
                let found = self.node.servers(&choice.ros_topic).unwrap_or_default();
                ros_graph::identify(&mut there, &choice.ros_topic, &found);
            }
        }
        let routes = Routes::of(&self.service_rules, &ends, &there, self.services.routes());
        self.services.set_routes(routes, shown(&self.nodes));
    }

    /// Publishers in ROS come and go that a subscription matches though they are not of its class.
    fn renew_senders(&mut self) {
        for (key, taken) in &mut self.inward {
            let Some(publishers) = self.mirror.publishers(key) else { continue };
            let senders = senders(&self.graph, key, publishers, taken.port.is_some());
            if senders != taken.senders {
                taken.senders = senders.clone();
                let limiter = Limiter::new(taken.inward.min_period);
                self.incoming.change(key.clone(), senders, limiter, None);
            }
        }
    }

    fn act(&mut self, action: Action) {
        if let Err(reason) = self.try_to(&action) {
            let topic = &topic_of(&action).topic;
            tracing::warn!("topic '{topic}' is not bridged: {reason}");
            self.failed.push((action, reason));
        }
    }

    /// What failed may be possible now: a limit, memory, a package that was installed.
    fn try_again(&mut self) {
        for (action, before) in std::mem::take(&mut self.failed) {
            if let Err(reason) = self.try_to(&action) {
                if reason != before {
                    tracing::warn!("topic '{}' is not bridged: {reason}", topic_of(&action).topic);
                }
                self.failed.push((action, reason));
            }
        }
    }

    fn try_to(&mut self, action: &Action) -> Result<(), String> {
        // What is not wanted any more is not tried again.
        self.failed.retain(|(failed, _)| !action.replaces(failed));
        match action {
            Action::OpenWriter(key, gid, qos, hash) => self.open_writer(key, *gid, qos, hash.as_deref())?,
            Action::CloseWriter(key, gid) => {
                self.outgoing.close(key.clone(), *gid);
                self.writers.remove(&(key.clone(), *gid));
            }
            Action::StartOut(key, outward)
                if key.is_of_action() || self.out.contains_key(key) || self.is_matched(key) =>
            {
                self.start_out(key, outward)?;
            }
            Action::StartOut(key, outward) => {
                self.waiting.insert(key.clone(), (outward.clone(), Instant::now()));
            }
            Action::StopOut(key) => {
                self.waiting.remove(key);
                self.out.remove(key);
                let of_topic = self.writers.iter_mut().filter(|((topic, _), _)| topic == key);
                of_topic.for_each(|(_, writer)| writer.is_open = false);
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
        for (failed, _) in &mut self.failed {
            if let Action::StartIn(other, wanted) = failed
                && other == key
            {
                *wanted = inward.clone();
                return Ok(());
            }
        }
        let before = self.inward.get(key).and_then(|taken| taken.port);
        let port = if before.is_none() {
            let found = self.find_type(&key.topic, inward.type_hash.as_deref())?;
            self.port(&key.topic, &found, inward)?
        } else {
            None
        };
        let offer = before.or(port.as_ref().map(|(_, offer)| *offer));
        let senders = senders(&self.graph, key, &inward.publishers, offer.is_some());
        let limiter = Limiter::new(inward.min_period);
        self.incoming.change(key.clone(), senders.clone(), limiter, port.map(|(port, _)| port));
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), port: offer, senders });
        Ok(())
    }

    fn open_writer(&mut self, key: &TopicKey, gid: Gid, qos: &Qos, hash: Option<&str>) -> Result<(), String> {
        let found = self.find_type(key, hash)?;
        let publisher = RosPublisher::new(&self.node, &key.ros_topic, &found.support, qos);
        let publisher = Arc::new(publisher.map_err(|error| error.to_string())?);
        let writer = Writer { publisher, last: Last::default() };
        let counterpart = Counterpart { writer, opened: Instant::now(), is_open: false, incompatible: None };
        self.writers.insert((key.clone(), gid), counterpart);
        Ok(())
    }

    fn find_type(&mut self, key: &TopicKey, hash: Option<&str>) -> Result<BridgedType, String> {
        self.types.find(&key.type_name, hash).map_err(|error| error.to_string())
    }

    /// Whether subscriptions in ROS are about to be found.
    fn is_matching(&self) -> bool {
        let now = Instant::now();
        let is_new = |since: Instant| now < since + MATCH_TIME;
        self.waiting.values().any(|(_, since)| is_new(*since))
            || self.writers.iter().any(|((key, _), writer)| !writer.is_open && self.out.contains_key(key))
    }

    /// Samples are taken once a publisher in ROS has somebody to send them to: what it sent before would be lost. One that finds
    /// nobody, while others do, does not keep its samples waiting for ever.
    fn look_for_matches(&mut self) {
        let now = Instant::now();
        for (key, (outward, since)) in std::mem::take(&mut self.waiting) {
            if !self.is_matched(&key) {
                self.waiting.insert(key, (outward, since));
            } else if let Err(reason) = self.start_out(&key, &outward) {
                self.failed.push((Action::StartOut(key, outward), reason));
            }
        }
        for ((key, gid), counterpart) in &mut self.writers {
            let is_matched = || counterpart.writer.publisher.subscription_count() > 0;
            let is_ready = || is_matched() || now >= counterpart.opened + MATCH_TIME;
            if !counterpart.is_open && self.out.contains_key(key) && is_ready() {
                counterpart.is_open = true;
                self.outgoing.open(key.clone(), *gid, counterpart.writer.clone());
            }
        }
    }

    /// Whether a publisher in ROS has somebody to send to.
    fn is_matched(&self, key: &TopicKey) -> bool {
        let mut writers = self.writers.iter().filter(|((topic, _), _)| topic == key);
        writers.any(|(_, counterpart)| counterpart.writer.publisher.subscription_count() > 0)
    }

    fn start_out(&mut self, key: &TopicKey, outward: &Outward) -> Result<(), String> {
        let subscription = self.subscribe(key, outward).map_err(|error| error.to_string())?;
        let counters = self.counters(key, Direction::ToRos);
        let limiter = Limiter::new(outward.min_period);
        self.outgoing.start_topic(key.clone(), subscription, counters, limiter);
        self.out.insert(key.clone(), outward.clone());
        Ok(())
    }

    fn subscribe(&mut self, key: &TopicKey, outward: &Outward) -> Result<RawSubscription, TransportError> {
        let stated = self.participant.topic_type(&key.topic);
        let topic_type = stated.unwrap_or_else(|| tautline_transport::TopicType::new(key.type_name.clone()));
        let durability = if outward.is_kept { Durability::TransientLocal } else { Durability::Volatile };
        let mut wanted = Qos { durability, ..Qos::keep_last(outward.depth.min(Limits::MAX_DEPTH)) };
        loop {
            let limits = Limits::default();
            match self.participant.create_relay_subscription(&key.topic, &topic_type, wanted, limits) {
                // A queue as long as the topic allows.
                Err(TransportError::Limit { limit: "depth", existing, .. }) if existing < wanted.depth => {
                    wanted.depth = existing;
                }
                outcome => return outcome,
            }
        }
    }

    fn start_in(&mut self, key: &InKey, inward: &Inward) -> Result<(), String> {
        // What the port keeps for late joiners is not to be lost without need.
        let before = self.inward.get(key).filter(|taken| taken.inward.type_hash == inward.type_hash);
        let same = before
            .and_then(|taken| Some((taken.port?, taken.inward.qos)))
            .filter(|(port, _)| port.is_as_good(inward.offered));
        if same.is_some_and(|(_, qos)| qos == inward.qos) {
            return self.change_in(key, inward);
        }
        let found = self.find_type(&key.topic, inward.type_hash.as_deref())?;
        let (port, offer) = match same {
            Some((offer, _)) => (Port::Same, Some(offer)),
            None => match self.port(&key.topic, &found, inward)? {
                Some((port, offer)) => (Port::New(Box::new(port)), Some(offer)),
                None => (Port::None, None),
            },
        };
        let senders = senders(&self.graph, key, &inward.publishers, offer.is_some());
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
        self.inward.insert(key.clone(), Taken { inward: inward.clone(), port: offer, senders });
        Ok(())
    }

    /// The port that messages of the class come through here, once there is somebody who sends them.
    fn port(
        &self,
        key: &TopicKey,
        found: &BridgedType,
        inward: &Inward,
    ) -> Result<Option<(RawPublisher, Offer)>, String> {
        if inward.publishers.is_empty() {
            return Ok(None);
        }
        let depth = inward.offered.depth.clamp(1, Limits::MAX_DEPTH);
        let mut qos = Qos { depth, ..inward.offered };
        let port = loop {
            let limits = Limits::default();
            match self.participant.create_raw_publisher(&key.topic, &found.topic_type(), qos, limits) {
                Err(TransportError::Limit { limit: "depth", existing, .. }) if existing < qos.depth => {
                    qos.depth = existing;
                }
                outcome => break outcome.map_err(|error| error.to_string())?,
            }
        };
        self.outgoing.relays().lock().unwrap_or_else(PoisonError::into_inner).insert(port.gid());
        let most_depth = port.limits().depth;
        Ok(Some((port, Offer { qos, most_depth })))
    }

    fn counters(&mut self, key: &TopicKey, direction: Direction) -> Arc<crate::stats::Counters> {
        let (out, inward) = (&self.out, &self.inward);
        self.book.counters(key, direction, |key, direction| is_active(out, inward, key, direction))
    }

    /// ROS's tools list Tautline's nodes.
    fn show_nodes(&mut self, here: &GraphSnapshot) {
        let wanted: BTreeSet<&NodeName> =
            here.nodes.iter().filter(|node| !node.is_remote).map(|node| &node.name).collect();
        self.gone.retain(|(_, node)| node.strong_count() > 0);
        self.nodes.retain(|name, node| {
            let stays = wanted.contains(name);
            if let (false, Some(node)) = (stays, node) {
                self.gone.push((name.clone(), Arc::downgrade(node)));
            }
            stays
        });
        for name in wanted {
            if !self.nodes.contains_key(name) {
                let node = Node::new(self.node.context(), &name.name, &name.namespace);
                let node =
                    node.inspect_err(|error| tracing::warn!("node {name} is not shown in ROS: {error}"));
                self.nodes.insert(name.clone(), node.ok());
            }
        }
    }

    /// Nodes that have gone here and stand in ROS until their services have ended.
    fn still_shown(&self) -> Vec<RosNode> {
        let gone = self.gone.iter().filter(|(_, node)| node.strong_count() > 0);
        gone.map(|(name, _)| RosNode { name: name.name.clone(), namespace: name.namespace.clone() }).collect()
    }

    /// Tautline's tools list what is in ROS.
    fn show_ros(&self, services: Vec<ServiceEndpoint>) {
        let own: Vec<RosNode> = self
            .nodes
            .values()
            .flatten()
            .map(|node| RosNode { name: node.name().into(), namespace: node.namespace().into() })
            .chain(self.still_shown())
            .collect();
        let mut remote = ros_graph::as_remote(&self.graph, &own, self.mirror.rules());
        remote.services = services;
        remote.services.retain_mut(|end| {
            let name = self.service_rules.tautline_name(&end.name);
            name.map(|name| end.name = name).is_some()
        });
        if let Err(error) = self.participant.set_remote(&remote) {
            tracing::warn!("nodes and tools of this host do not see what ROS has: {error}");
        }
    }

    /// As ROS does: an event for each end that does not fit, which is counted and said.
    fn look_for_incompatible(&mut self) {
        for ((key, _), counterpart) in &mut self.writers {
            let Some((count, policy)) = counterpart.writer.publisher.incompatible() else { continue };
            tracing::warn!(
                "topic '{}': an end in ROS does not fit the QoS of one here (last policy: {policy}): no messages go between them; \
                 change one of them, or set qos.{policy} of the topic in the configuration",
                key.ros_topic
            );
            let since = Instant::now();
            counterpart.incompatible = Some(Incompatible { count, last_policy: policy, since });
        }
    }

    fn read_numbers(&mut self, elapsed: Duration) {
        let mut stats = self.shared.stats();
        stats.uptime_s = self.started.elapsed().as_secs_f64();
        stats.ros_nodes = self.graph.nodes.len();
        stats.ros_endpoints = self.graph.endpoints.len();
        stats.not_bridged = self.mirror.problems().clone();
        let failed =
            self.failed.iter().map(|(action, reason)| (topic_of(action).topic.clone(), reason.clone()));
        stats.not_bridged.extend(failed);
        stats.services_not_bridged = self.services.problems();
        stats.services = self.services.stats();
        let ends = self.writers.iter();
        let ends = ends.filter_map(|((key, _), end)| Some((&*key.topic, end.incompatible?)));
        stats.incompatible_qos = incompatible_by_topic(ends);
        let (out, inward) = (&self.out, &self.inward);
        stats.topics =
            self.book.read(&stats.topics, elapsed, |key, direction| is_active(out, inward, key, direction));
    }
}

/// Those of all publishers of a topic that are there now.
fn incompatible_by_topic<'t>(
    ends: impl Iterator<Item = (&'t str, Incompatible)>,
) -> BTreeMap<String, IncompatibleQos> {
    let mut topics: BTreeMap<&str, Incompatible> = BTreeMap::new();
    for (topic, end) in ends {
        let all = topics.entry(topic).or_insert(Incompatible { count: 0, ..end });
        let count = all.count + end.count;
        let last = if end.since > all.since { end } else { *all };
        *all = Incompatible { count, ..last };
    }
    let told = |(topic, all): (&str, Incompatible)| {
        (topic.to_owned(), IncompatibleQos { count: all.count, last_policy: all.last_policy.to_owned() })
    };
    topics.into_iter().map(told).collect()
}

/// Of the publishers in ROS that are known.
fn senders(graph: &RosGraph, key: &InKey, publishers: &BTreeSet<Gid>, has_port: bool) -> Senders {
    let none = BTreeSet::new();
    Senders::of(graph.publishers.get(&key.topic.ros_topic).unwrap_or(&none), publishers, has_port)
}

/// Those that stand in ROS for Tautline's.
fn shown(nodes: &BTreeMap<NodeName, Option<Arc<Node>>>) -> BTreeMap<NodeName, Arc<Node>> {
    nodes.iter().filter_map(|(name, node)| Some((name.clone(), node.clone()?))).collect()
}

fn topic_of(action: &Action) -> &TopicKey {
    match action {
        Action::OpenWriter(key, ..) | Action::CloseWriter(key, _) => key,
        Action::StartOut(key, _) | Action::StopOut(key) => key,
        Action::StartIn(key, _) | Action::ChangeIn(key, _) | Action::StopIn(key) => &key.topic,
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ends_that_do_not_fit_are_those_of_all_publishers_of_a_topic() {
        let start = Instant::now();
        let end = |count, last_policy, after_s| Incompatible {
            count,
            last_policy,
            since: start + Duration::from_secs(after_s),
        };
        let ends =
            [("/x", end(2, "reliability", 5)), ("/x", end(3, "deadline", 1)), ("/y", end(1, "deadline", 2))];
        let told = incompatible_by_topic(ends.into_iter());
        let of = |topic: &str| (told[topic].count, &*told[topic].last_policy);
        assert_eq!((of("/x"), of("/y")), ((5, "reliability"), (1, "deadline")));
    }
}
