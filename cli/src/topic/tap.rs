// SPDX-License-Identifier: MIT OR Apache-2.0
//! Takes a topic's messages for tools: as an observer from publishers on this host; with a subscription from those on other hosts, because
//! a gateway fetches only subscribed topics.

use crate::compatibility;
use crate::verb::{End, Failure, Outcome};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline_definitions::{DefinitionError, find_schema};
use tautline_schema::{Schema, TypeName};
use tautline_transport::{
    Durability, EndpointKind, GraphSnapshot, Limits, Participant, Qos, RawSample, RawSubscription,
    Reliability, TakeError, TopicEndpoint, TopicType, Visitor,
};

/// The interval at which an observer polls, because publishers do not ring for it.
pub const POLL: Duration = Duration::from_millis(1);
/// The maximum depth of an observer. It has the depth of the topic's endpoints, which costs no memory.
const MOST_DEPTH: usize = 1000;
/// The interval at which the graph is checked for publishers on other hosts.
const GRAPH_INTERVAL: Duration = Duration::from_millis(100);

/// Takes what is published on a topic.
pub struct Tap {
    topic: String,
    participant: Participant,
    topic_type: TopicType,
    subscription: RawSubscription,
    /// Whether there are publishers on other hosts, for which the subscription is an ordinary one.
    is_seen: bool,
    epoch: u32,
    refreshed: Instant,
    /// The losses of previous subscriptions.
    lost: u64,
    other_types: OtherTypes,
}

/// The types of a topic whose messages are left out, because they are not of the type that is taken. Each is printed once.
#[derive(Default)]
pub struct OtherTypes(BTreeSet<(String, Option<String>)>);

impl OtherTypes {
    pub fn print_new(&mut self, graph: &GraphSnapshot, topic: &str, taken: &TopicType) {
        let is_other =
            |end: &TopicEndpoint| end.kind == EndpointKind::Publisher && !end.topic_type.agrees_with(taken);
        for end in ends(graph, topic).filter(|end| is_other(end)) {
            let TopicType { name, hash, .. } = &end.topic_type;
            if self.0.insert((name.to_string(), hash.as_deref().map(str::to_owned))) {
                let why = match *name == taken.name {
                    true => format!("its definition of {name} is another one"),
                    false => format!("its type is {name}, not {}", taken.name),
                };
                let node = compatibility::label(end);
                eprintln!("taut: '{topic}': what {node} publishes is left out: {why}");
            }
        }
    }
}

/// The endpoints of a topic.
pub fn ends<'g>(
    graph: &'g GraphSnapshot,
    topic: &'g str,
) -> impl Iterator<Item = &'g Arc<TopicEndpoint>> + Clone {
    graph.endpoints.iter().filter(move |end| end.topic == topic)
}

/// Waits until a topic has an endpoint, and returns its type: that of its publishers, if it has any.
pub fn wait_for_type(domain: u32, topic: &str, end: &End) -> Outcome<TopicType> {
    let mut visitor = Visitor::new(domain)?;
    let waited_for = || format!("topic '{topic}' to exist in domain {domain}");
    end.wait(waited_for, || {
        let graph = visitor.graph()?;
        let publisher = ends(&graph, topic).find(|end| end.kind == EndpointKind::Publisher);
        Ok(publisher.or_else(|| ends(&graph, topic).next()).map(|end| end.topic_type.clone()))
    })
}

impl Tap {
    /// Opens a topic whose type is known, even if it does not exist yet.
    pub fn open(domain: u32, topic: &str, topic_type: TopicType) -> Outcome<Self> {
        let participant = Participant::new(domain)?;
        let (epoch, graph) = (participant.graph_epoch(), participant.graph()?);
        let topic_type = TopicType { definition: None, body_bytes: None, ..topic_type };
        let is_seen = is_elsewhere(&graph, topic, &topic_type);
        let subscription = match is_seen {
            true => subscribe(&participant, &graph, topic, &topic_type, depth(&graph, topic))?,
            // Observes the publishers on this host.
            false => participant.create_observer(topic, &topic_type, depth(&graph, topic), limits())?,
        };
        let mut other_types = OtherTypes::default();
        other_types.print_new(&graph, topic, &topic_type);
        let (topic, refreshed) = (topic.to_owned(), Instant::now());
        Ok(Tap {
            topic,
            participant,
            topic_type,
            subscription,
            is_seen,
            epoch,
            refreshed,
            lost: 0,
            other_types,
        })
    }

    /// The definition of the topic's type. If only nodes of other hosts have it, the gateway requests it for a topic that is subscribed
    /// to here; this waits for it.
    pub fn schema(&self, end: &End) -> Outcome<Arc<Schema>> {
        let name: TypeName = self.topic_type.name.parse()?;
        let find = || find_schema(&self.topic, &name, Some(&self.topic_type));
        let patience = Instant::now() + Duration::from_secs(5);
        end.wait(
            || format!("the definition of {name}, from another host"),
            || match find() {
                Err(DefinitionError::Unknown { .. }) if self.is_seen && Instant::now() < patience => Ok(None),
                found => Ok(Some(found?)),
            },
        )
    }

    /// Takes the oldest message.
    pub fn take(&mut self) -> Outcome<Option<RawSample>> {
        if self.refreshed.elapsed() >= GRAPH_INTERVAL {
            self.refresh()?;
        }
        match self.subscription.try_take() {
            Ok(taken) => Ok(taken),
            // Invalid messages are counted.
            Err(TakeError::Invalid(_)) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// The number of messages that have arrived and can still be taken.
    pub fn waiting(&self) -> u64 {
        self.subscription.waiting().min(self.subscription.qos().depth as u64)
    }

    /// Messages that were overwritten before they were taken.
    pub fn lost(&self) -> u64 {
        self.lost + self.subscription.counters().lost()
    }

    /// Whether publishers are on other hosts, and see a subscription.
    pub fn is_seen(&self) -> bool {
        self.is_seen
    }

    /// Looks for publishers that have appeared, and subscribes if one of them is on another host.
    fn refresh(&mut self) -> Outcome {
        self.refreshed = Instant::now();
        let epoch = self.participant.graph_epoch();
        if epoch == std::mem::replace(&mut self.epoch, epoch) {
            return Ok(());
        }
        let graph = self.participant.graph()?;
        self.other_types.print_new(&graph, &self.topic, &self.topic_type);
        if !self.is_seen && is_elsewhere(&graph, &self.topic, &self.topic_type) {
            let depth = depth(&graph, &self.topic);
            let subscription = subscribe(&self.participant, &graph, &self.topic, &self.topic_type, depth)?;
            self.lost += self.subscription.counters().lost();
            (self.subscription, self.is_seen) = (subscription, true);
        }
        Ok(())
    }
}

fn is_elsewhere(graph: &GraphSnapshot, topic: &str, topic_type: &TopicType) -> bool {
    ends(graph, topic).any(|end| {
        end.is_remote && end.kind == EndpointKind::Publisher && end.topic_type.agrees_with(topic_type)
    })
}

/// Subscribes with the QoS that every publisher offers, so that all are compatible.
pub fn subscribe(
    participant: &Participant,
    graph: &GraphSnapshot,
    topic: &str,
    topic_type: &TopicType,
    depth: usize,
) -> Outcome<RawSubscription> {
    let publishers = ends(graph, topic).filter(|end| end.kind == EndpointKind::Publisher);
    let offered = |policy: fn(&Qos) -> bool| publishers.clone().all(|end| policy(&end.qos));
    let mut qos = Qos::keep_last(depth.max(10));
    if offered(|qos| qos.durability == Durability::TransientLocal) {
        qos = qos.transient_local();
    }
    if !offered(|qos| qos.reliability == Reliability::Reliable) {
        qos = qos.best_effort();
    }
    let node = participant.create_node(&format!("taut_{}", std::process::id()), "/")?;
    Ok(participant.for_node(&node).create_raw_subscription(topic, topic_type, qos, limits())?)
}

fn depth(graph: &GraphSnapshot, topic: &str) -> usize {
    ends(graph, topic).map(|end| end.qos.depth).max().unwrap_or(1).clamp(1, MOST_DEPTH)
}

/// One sample is held at a time.
fn limits() -> Limits {
    Limits { held: 1, ..Limits::default() }
}

pub fn unknown(graph: &GraphSnapshot, topic: &str) -> Failure {
    Failure::unknown("topic", topic, graph.endpoints.iter().map(|end| &*end.topic), "topic list")
}
