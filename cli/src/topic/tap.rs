// SPDX-License-Identifier: MIT OR Apache-2.0
//! A topic as tools take from it: unseen, from publishers on this host; from others by a subscription, for a gateway fetches what
//! somebody wants.

use crate::verb::{End, Failure, Outcome};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tautline::{EndpointKind, GraphSnapshot, TopicEndpoint, find_schema};
use tautline_schema::{Schema, TypeName};
use tautline_transport::{
    Durability, Limits, Participant, Qos, RawSample, RawSubscription, Reliability, TakeError, TopicType,
    Visitor,
};

/// How often is looked for messages that nobody rings for.
pub const POLL: Duration = Duration::from_millis(1);
/// An observer's depth is that of the topic's ends, which costs no memory; but no more than this.
const MOST_DEPTH: usize = 1000;
/// How often is looked who is there.
const LOOK: Duration = Duration::from_millis(100);

/// Takes what is published on a topic.
pub struct Tap {
    topic: String,
    participant: Participant,
    topic_type: TopicType,
    subscription: RawSubscription,
    /// There are publishers elsewhere, for which the subscription is an ordinary one.
    is_seen: bool,
    epoch: u32,
    looked: Instant,
    /// Of subscriptions of before.
    lost: u64,
}

/// The ends of a topic.
pub fn ends<'g>(
    graph: &'g GraphSnapshot,
    topic: &'g str,
) -> impl Iterator<Item = &'g Arc<TopicEndpoint>> + Clone {
    graph.endpoints.iter().filter(move |end| end.topic == topic)
}

/// Waits until a topic has an end, and gives its type: that of its publishers, if it has any.
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
    /// Of a topic that is there or comes: whose type is known.
    pub fn open(domain: u32, topic: &str, topic_type: TopicType) -> Outcome<Self> {
        let participant = Participant::new(domain)?;
        let (epoch, graph) = (participant.graph_epoch(), participant.graph()?);
        let topic_type = TopicType { definition: None, body_bytes: None, ..topic_type };
        let is_seen = is_elsewhere(&graph, topic, &topic_type);
        let subscription = match is_seen {
            true => subscribe(&participant, &graph, topic, &topic_type, depth(&graph, topic))?,
            false => observe(&participant, &graph, topic, &topic_type)?,
        };
        let (topic, looked) = (topic.to_owned(), Instant::now());
        Ok(Tap { topic, participant, topic_type, subscription, is_seen, epoch, looked, lost: 0 })
    }

    /// The definition of the topic's type. If only nodes of other hosts know it the gateway asks them, for what somebody here takes,
    /// and is waited for.
    pub fn schema(&self, end: &End) -> Outcome<Arc<Schema>> {
        let name: TypeName = self.topic_type.name.parse()?;
        let find = || find_schema(&self.topic, &name, Some(&self.topic_type));
        let patience = Instant::now() + Duration::from_secs(5);
        end.wait(
            || format!("the definition of {name}, from another host"),
            || match find() {
                Err(tautline::Error::UnknownType { .. }) if self.is_seen && Instant::now() < patience => {
                    Ok(None)
                }
                found => Ok(Some(found?)),
            },
        )
    }

    /// Takes the oldest message.
    pub fn take(&mut self) -> Outcome<Option<RawSample>> {
        if self.looked.elapsed() >= LOOK {
            self.look()?;
        }
        match self.subscription.try_take() {
            Ok(taken) => Ok(taken),
            // Counted.
            Err(TakeError::Invalid(_)) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Messages that came faster than they were taken.
    pub fn lost(&self) -> u64 {
        self.lost + self.subscription.counters().lost()
    }

    /// Whether the topic's publishers are elsewhere, and see a subscription.
    pub fn is_seen(&self) -> bool {
        self.is_seen
    }

    /// Publishers may have come that only a subscription gets anything from.
    fn look(&mut self) -> Outcome {
        self.looked = Instant::now();
        let epoch = self.participant.graph_epoch();
        if epoch == std::mem::replace(&mut self.epoch, epoch) || self.is_seen {
            return Ok(());
        }
        let graph = self.participant.graph()?;
        if is_elsewhere(&graph, &self.topic, &self.topic_type) {
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

/// Sees what publishers on this host send to anybody.
fn observe(
    participant: &Participant,
    graph: &GraphSnapshot,
    topic: &str,
    topic_type: &TopicType,
) -> Outcome<RawSubscription> {
    Ok(participant.create_observer(topic, topic_type, depth(graph, topic), limits())?)
}

/// What every publisher offers is asked for, and no more, so that none is left out.
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

/// Each is read, and given back.
fn limits() -> Limits {
    Limits { held: 1, ..Limits::default() }
}

/// No such topic.
pub fn unknown(graph: &GraphSnapshot, topic: &str) -> Failure {
    Failure::unknown("topic", topic, graph.endpoints.iter().map(|end| &*end.topic), "topic list")
}
