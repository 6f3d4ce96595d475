// SPDX-License-Identifier: MIT OR Apache-2.0
//! The topics that are recorded, and an observer for each.

use super::args::RecordArgs;
use super::choice::Choice;
use super::event::{EVENTS, Events, Part};
use crate::definitions;
use crate::offered_qos;
use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use taut_cli::topic::tap;
use taut_cli::verb::Outcome;
use tautline_bag::{Definition, Topic};
use tautline_definitions::find_schema;
use tautline_transport::{
    Durability, EndpointKind, Gid, GraphSnapshot, Limits, Participant, Qos, RawSubscription, ServiceEndpoint,
    ServiceType, TopicEndpoint, TopicType,
};

/// The most messages of a queue for the recorder, which has at most [`QUEUE_BYTES`] unless the QoS requires more.
const DEEP: usize = 1000;
const QUEUE_BYTES: usize = 1 << 20;
/// The depth of queues for requests, responses and an action's topics. A goal's states arrive together.
const SERVICE_DEPTH: usize = 16;

/// The subscription of a topic, for the reader. It replaces the subscription of an earlier observer of the same number.
pub struct Observer {
    pub number: usize,
    pub part: Part,
    pub subscription: RawSubscription,
    /// The least time between two messages that are kept.
    pub throttle_ns: Option<u64>,
    pub counts: Arc<Counts>,
    /// The messages left in the subscription that this one replaces arrived while the recorder was paused.
    pub is_renewed: bool,
}

/// The counts of a topic so far, for the display.
#[derive(Default)]
pub struct Counts {
    pub messages: AtomicU64,
    pub bytes: AtomicU64,
    pub lost: AtomicU64,
}

/// The announcements to the writer: of observers, in the order of their numbers, and of publishers.
pub enum Announced {
    /// An observer's messages are in the bag as they are. The QoS is that of publishers that keep nothing for late joiners.
    Topic(Topic),
    /// An observer's messages are requests, which the writer makes events.
    Requests(Topic, Events),
    /// An observer's messages are responses, which the reader has made events of the topic of this observer.
    Responses(usize),
    /// A publisher of an observer's topic.
    Publisher { number: usize, gid: Gid, qos: Qos },
}

/// A topic that is recorded, or one half of a service's events.
pub struct RecordedTopic {
    pub topic: Topic,
    pub part: Part,
    pub depth: usize,
    topic_type: TopicType,
    is_fetched: bool,
    counts: Arc<Counts>,
}

impl RecordedTopic {
    /// The observer's name. Only the observers of one topic with two types have the same name.
    pub fn name(&self) -> String {
        match self.part {
            Part::Message => self.topic.name.clone(),
            part => format!("{} {}", self.topic.name, part.name()),
        }
    }
}

pub struct Observers {
    participant: Participant,
    choice: Choice,
    depth: Option<usize>,
    is_fetching: bool,
    throttle: Vec<(String, f64)>,
    epoch: Option<u32>,
    /// The system refused to let the graph be read, and the user was warned.
    is_refused: bool,
    /// The processes that have endpoints in the domain.
    processes: BTreeSet<u32>,
    topics: Vec<RecordedTopic>,
    /// The observers of each topic; more than one if its publishers have different types.
    numbers: HashMap<String, Vec<usize>>,
    /// Topics that cannot be recorded.
    refused: BTreeSet<String>,
    before: Before,
    /// Types without a known definition, of which the user was warned.
    unknown: HashSet<String>,
    /// Topics whose publishers are on other hosts, of which the user was warned.
    elsewhere: HashSet<String>,
    to_taker: Sender<Observer>,
    to_writer: Sender<Announced>,
    /// Publishers that were announced to the writer.
    announced: HashSet<(usize, Gid)>,
}

/// Publishers that may have sent messages before the recording began, which are not missed.
pub struct Before {
    publishers: HashSet<Gid>,
    /// Participants that carry other hosts' topics, through ports that the graph does not list.
    relays: HashSet<u64>,
}

impl Before {
    pub fn contains(&self, publisher: Gid) -> bool {
        self.publishers.contains(&publisher) || self.relays.contains(&publisher.participant())
    }
}

/// The other threads' ends of the channels. A topic is announced to the writer before the reader gets the observer of the same number.
pub struct NewObservers {
    pub observers: Receiver<Observer>,
    pub announced: Receiver<Announced>,
}

impl Observers {
    /// Begins the recording: from now on each message of a new publisher of this host is recorded, or counted as missed.
    pub fn new(participant: Participant, choice: Choice, args: &RecordArgs) -> Outcome<(Self, NewObservers)> {
        let graph = participant.graph()?;
        let publishers = graph.endpoints.iter().filter(|end| end.kind == EndpointKind::Publisher);
        // Clients publish requests.
        let clients = graph.services.iter().map(|end| end.gid);
        let publishers = publishers.map(|end| end.gid).chain(clients).collect();
        let before = Before { publishers, relays: HashSet::new() };
        let ((to_taker, observers), (to_writer, announced)) = (channel(), channel());
        let here = Observers {
            participant,
            choice,
            depth: args.depth.map(|depth| depth as usize),
            is_fetching: args.fetch,
            throttle: args.throttle.clone(),
            epoch: None,
            is_refused: false,
            processes: BTreeSet::new(),
            topics: Vec::new(),
            numbers: HashMap::new(),
            refused: BTreeSet::new(),
            before,
            unknown: HashSet::new(),
            elsewhere: HashSet::new(),
            to_taker,
            to_writer,
            announced: HashSet::new(),
        };
        Ok((here, NewObservers { observers, announced }))
    }

    /// The processes that have endpoints in the domain, except this one.
    pub fn processes(&self) -> &BTreeSet<u32> {
        &self.processes
    }

    /// Adds observers for new topics and services, and announces new publishers, if the graph has changed.
    pub fn look(&mut self, tell: impl Fn(&str)) -> Outcome {
        let epoch = Some(self.participant.graph_epoch());
        if epoch == self.epoch {
            return Ok(());
        }
        let graph = match self.participant.graph() {
            Err(error) if error.is_passing() => {
                if !std::mem::replace(&mut self.is_refused, true) {
                    tell(&format!(
                        "warning: new topics are recorded only when the system permits it: {error}"
                    ));
                }
                return Ok(());
            }
            graph => graph?,
        };
        (self.epoch, self.is_refused) = (epoch, false);
        let of_topics = graph.endpoints.iter().filter_map(|end| end.pid);
        self.processes = of_topics.chain(graph.services.iter().filter_map(|end| end.pid)).collect();
        self.processes.remove(&std::process::id());
        let relays = graph.endpoints.iter().map(|end| end.teller);
        self.before.relays.extend(relays.chain(graph.services.iter().map(|end| end.teller)).flatten());
        let mut topics: BTreeMap<&str, Vec<&TopicEndpoint>> = BTreeMap::new();
        graph.endpoints.iter().for_each(|end| topics.entry(&end.topic).or_default().push(end));
        for (topic, ends) in topics {
            for end in publishers(&ends) {
                if !self.choice.takes(topic, &end.topic_type.name) {
                    continue;
                }
                match self.observe(&graph, &ends, end, &tell) {
                    Ok(number) => self.announce(number, end),
                    Err(failure) => {
                        tell(&format!("warning: {topic} cannot be recorded: {failure}"));
                        self.refused.insert(topic.to_owned());
                    }
                }
            }
        }
        for service in &graph.services {
            if let Err(failure) = self.seat_service(service, &tell) {
                tell(&format!("warning: {} cannot be recorded: {failure}", service.name));
                self.refused.insert(format!("{}{EVENTS}", service.name));
            }
        }
        Ok(())
    }

    /// Adds two observers for a service's events, of its requests and its responses, unless it has them.
    fn seat_service(&mut self, service: &ServiceEndpoint, tell: &impl Fn(&str)) -> Outcome {
        let name = format!("{}{EVENTS}", service.name);
        if !self.choice.takes(&name, &service.type_name) || self.refused.contains(&name) {
            return Ok(());
        }
        let service_type = ServiceType::new(&service.type_name, service.type_hash.as_deref());
        let of_name = self.numbers.get(&name).map_or(&[][..], Vec::as_slice);
        if of_name.iter().any(|number| self.topics[*number].topic_type.agrees_with(&service_type.request)) {
            return Ok(());
        }
        let Some(events) = Events::of(service) else {
            tell(&format!(
                "warning: {} cannot be recorded: the definition of {} is not known; source the ROS 2 that has it",
                service.name, service.type_name
            ));
            self.refused.insert(name);
            return Ok(());
        };
        let limits = Limits { held: 1, ..Limits::default() };
        let depth = self.depth.unwrap_or(SERVICE_DEPTH);
        let [requests, responses] =
            self.participant.create_service_observer(&service.name, &service_type, depth, limits)?;
        let (topic, number) = (events.topic(&service.name), self.topics.len());
        let recorded = |part| RecordedTopic {
            topic: topic.clone(),
            part,
            depth,
            topic_type: service_type.request.clone(),
            is_fetched: false,
            counts: Arc::default(),
        };
        self.add(recorded(Part::Request), Announced::Requests(topic.clone(), events));
        self.add(recorded(Part::Response), Announced::Responses(number));
        self.take_place(number, requests, false);
        self.take_place(number + 1, responses, false);
        Ok(())
    }

    /// Announces each publisher of a topic to the writer once.
    fn announce(&mut self, number: Option<usize>, publisher: &TopicEndpoint) {
        let (gid, qos) = (publisher.gid, publisher.qos);
        if let Some(number) = number.filter(|number| self.announced.insert((*number, gid))) {
            let _ = self.to_writer.send(Announced::Publisher { number, gid, qos });
        }
    }

    fn add(&mut self, topic: RecordedTopic, announced: Announced) {
        // The writer ends before this only with an error, which it reports itself.
        let _ = self.to_writer.send(announced);
        self.numbers.entry(topic.topic.name.clone()).or_default().push(self.topics.len());
        self.topics.push(topic);
    }

    /// Makes the reader take the messages of this observer from the subscription from now on.
    fn take_place(&self, number: usize, subscription: RawSubscription, is_renewed: bool) {
        let RecordedTopic { topic, part, counts, .. } = &self.topics[number];
        let hz = self.throttle.iter().find(|(name, _)| *name == topic.name).map(|(_, hz)| *hz);
        let throttle_ns = hz.map(|hz| (1e9 / hz) as u64);
        let (part, counts) = (*part, counts.clone());
        let observer = Observer { number, part, subscription, throttle_ns, counts, is_renewed };
        let _ = self.to_taker.send(observer);
    }

    /// Subscribes again after a pause, to the topics whose publishers keep messages for late joiners.
    pub fn renew(&self, tell: impl Fn(&str)) -> Outcome {
        let graph = match self.participant.graph() {
            Err(error) if error.is_passing() => {
                tell(&format!("warning: what publishers keep for late joiners is not recorded: {error}"));
                return Ok(());
            }
            graph => graph?,
        };
        let keeps = |topic: &RecordedTopic| {
            graph.endpoints.iter().any(|end| {
                end.kind == EndpointKind::Publisher
                    && end.topic == topic.topic.name
                    && end.qos.durability == Durability::TransientLocal
            })
        };
        for (number, topic) in self.topics.iter().enumerate() {
            if topic.part != Part::Message || !keeps(topic) {
                continue;
            }
            let RecordedTopic { topic: Topic { name, .. }, topic_type, depth, is_fetched, .. } = topic;
            match self.subscription(&graph, name, topic_type, *depth, *is_fetched) {
                Ok(subscription) => self.take_place(number, subscription, true),
                Err(failure) => tell(&format!(
                    "warning: {name}: what its publishers keep for late joiners is not recorded: {failure}"
                )),
            }
        }
        Ok(())
    }

    fn subscription(
        &self,
        graph: &GraphSnapshot,
        name: &str,
        topic_type: &TopicType,
        depth: usize,
        is_fetched: bool,
    ) -> Outcome<RawSubscription> {
        if is_fetched {
            return tap::subscribe(&self.participant, graph, name, topic_type, depth);
        }
        let limits = Limits { held: 1, ..Limits::default() };
        Ok(self.participant.create_observer(name, topic_type, depth, limits)?)
    }

    /// Observes the topic of the publisher `end`; `ends` are the topic's endpoints. Returns the observer's number, if there is one.
    fn observe(
        &mut self,
        graph: &GraphSnapshot,
        ends: &[&TopicEndpoint],
        end: &TopicEndpoint,
        tell: &impl Fn(&str),
    ) -> Outcome<Option<usize>> {
        let of_topic = self.numbers.get(&end.topic).map_or(&[][..], Vec::as_slice);
        let agrees = |number: &&usize| self.topics[**number].topic_type.agrees_with(&end.topic_type);
        let known = of_topic.iter().find(agrees).copied();
        let is_fetched = end.is_remote && self.is_fetching;
        if end.is_remote && !is_fetched && self.elsewhere.insert(end.topic.clone()) {
            tell(&format!(
                "warning: {} has publishers on another host or in ROS: what they send is recorded while somebody here subscribes to it, \
                 or with --fetch",
                end.topic
            ));
        }
        let is_observed = known.is_some_and(|known| self.topics[known].is_fetched || !is_fetched);
        if is_observed || self.refused.contains(&end.topic) {
            return Ok(known);
        }
        let topic_type = TopicType { definition: None, body_bytes: None, ..end.topic_type.clone() };
        let depth = self.depth.unwrap_or_else(|| depth(ends, end));
        let subscription = self.subscription(graph, &end.topic, &topic_type, depth, is_fetched)?;
        let number = known.unwrap_or(self.topics.len());
        if known.is_none() {
            let (topic, part, counts) =
                (described(ends, end, &mut self.unknown, tell), Part::Message, Arc::default());
            let announced = Announced::Topic(topic.clone());
            self.add(RecordedTopic { topic, part, depth, topic_type, is_fetched, counts }, announced);
        }
        self.topics[number].is_fetched = is_fetched;
        self.take_place(number, subscription, false);
        Ok(Some(number))
    }

    /// The number, the name and the count of messages of each topic.
    pub fn heard(&self) -> impl Iterator<Item = (usize, &str, u64)> {
        let topics = self.topics.iter().enumerate().filter(|(_, topic)| topic.part == Part::Message);
        topics.map(|(number, topic)| {
            (number, &*topic.topic.name, topic.counts.messages.load(Ordering::Relaxed))
        })
    }

    pub fn is_empty(&self) -> bool {
        self.topics.is_empty()
    }

    pub fn progress(&self) -> String {
        let sum = |of: fn(&Counts) -> &AtomicU64| -> u64 {
            self.topics.iter().map(|topic| of(&topic.counts).load(Ordering::Relaxed)).sum()
        };
        let (topics, messages) = (self.topics.len(), sum(|counts| &counts.messages));
        let (megabytes, lost) = (sum(|counts| &counts.bytes) as f64 / 1e6, sum(|counts| &counts.lost));
        format!("{topics} topics, {messages} messages, {megabytes:.1} MB, {lost} lost")
    }

    /// Topics in the order of their numbers; publishers that may have been there before; names of chosen topics that were not recorded.
    pub fn end(self) -> (Vec<RecordedTopic>, Before, Vec<String>) {
        let named = self.choice.named().iter().filter(|name| !self.numbers.contains_key(*name));
        let absent = named.chain(&self.refused).cloned().collect::<BTreeSet<_>>();
        (self.topics, self.before, absent.into_iter().collect())
    }
}

fn publishers<'e>(ends: &'e [&'e TopicEndpoint]) -> impl Iterator<Item = &'e TopicEndpoint> {
    ends.iter().copied().filter(|end| end.kind == EndpointKind::Publisher)
}

/// The depth of a topic's queue for the recorder. A deeper queue than that of the topic's endpoints costs its publishers the memory of a
/// message for each place, which is known only for types of fixed size.
fn depth(ends: &[&TopicEndpoint], end: &TopicEndpoint) -> usize {
    let least = if end.topic.contains("/_action/") { SERVICE_DEPTH } else { 1 };
    let own = ends.iter().map(|end| end.qos.depth).max().unwrap_or(1).clamp(least, DEEP);
    end.topic_type.body_bytes.map_or(own, |bytes| own.max((QUEUE_BYTES / (bytes + 64)).min(DEEP)))
}

fn described(
    ends: &[&TopicEndpoint],
    end: &TopicEndpoint,
    unknown: &mut HashSet<String>,
    tell: &impl Fn(&str),
) -> Topic {
    let name = end.topic_type.name.parse().ok();
    let schema = name.and_then(|name| find_schema(&end.topic, &name, Some(&end.topic_type)).ok());
    if schema.is_none() && unknown.insert(end.topic_type.name.to_string()) {
        tell(&format!(
            "warning: the definition of {} is not known: what reads the bag needs it from elsewhere",
            end.topic_type.name
        ));
    }
    Topic {
        name: end.topic.clone(),
        type_name: end.topic_type.name.to_string(),
        type_hash: end.topic_type.hash.as_deref().unwrap_or_default().to_owned(),
        definition: schema.map(|schema| Definition::ros2msg(definitions::for_bag(&schema))),
        qos: publishers(ends)
            .filter(|publisher| publisher.qos.durability == Durability::Volatile)
            .map(|publisher| offered_qos::write(&publisher.qos))
            .collect(),
        ..Topic::default()
    }
}
