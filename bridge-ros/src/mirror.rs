// SPDX-License-Identifier: MIT OR Apache-2.0
//! What is to be bridged: decided here from what exists on both sides, done elsewhere.
//!
//! A pure state machine: what exists goes in, the [`Action`]s that follow from it come out, in the order in which they
//! are to be done.
//!
//! - *To ROS.* Each publisher here has a publisher of its own in ROS, with its QoS, so that ROS sees and matches it by
//!   itself. Samples are taken from shared memory while ROS has a subscription.
//! - *From ROS.* Publishers there are told apart by what they offer ([`Class`]): each class has a subscription in ROS that
//!   requests just that, and a port here that offers just that. So every subscription here gets what it would get in
//!   ROS: what it is compatible with. While there are no publishers, a subscription of the default class shows in ROS that
//!   somebody listens.
//!
//! **Nothing goes in circles, or twice.** What this bridge itself tells of on either side is not looked at; what gateways and other
//! bridges tell of is, with where it was first, and whoever calls [`Mirror::update`] leaves out what comes another way: see
//! [`Transit`](tautline_relay::Transit).

use crate::rules::{Choice, Direction, Rules};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tautline_relay::RELAYED_DEPTH;
use tautline_transport::{Durability, EndpointKind, Gid, History, Limits, Qos, Reliability, TopicEndpoint};

/// A topic on both sides.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct TopicKey {
    /// Tautline's name of it.
    pub topic: String,
    /// ROS's name of it.
    pub ros_topic: String,
    /// What it carries.
    #[serde(rename = "type")]
    pub type_name: String,
}

impl TopicKey {
    /// Whether it is an action's feedback or status. A client may send its first goal, and should be told of it, before its
    /// subscriptions are seen here: these topics go to ROS whether or not it is known that somebody listens.
    pub(crate) fn is_of_action(&self) -> bool {
        self.topic.contains("/_action/")
    }
}

/// What publishers in ROS offer, as far as it decides who gets their messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Class {
    /// Whether reliable.
    pub is_reliable: bool,
    /// Whether late joiners are served.
    pub is_kept: bool,
}

impl Class {
    /// That of a publisher that offers `qos`.
    pub fn of(qos: &Qos) -> Self {
        Class {
            is_reliable: qos.reliability == Reliability::Reliable,
            is_kept: qos.durability == Durability::TransientLocal,
        }
    }

    fn qos(self, depth: usize) -> Qos {
        Qos {
            reliability: if self.is_reliable { Reliability::Reliable } else { Reliability::BestEffort },
            durability: if self.is_kept { Durability::TransientLocal } else { Durability::Volatile },
            ..Qos::keep_last(depth)
        }
    }
}

/// A topic that comes from ROS, of publishers of one class.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InKey {
    /// The topic.
    pub topic: TopicKey,
    /// The class.
    pub class: Class,
}

/// How messages of a class are taken from ROS.
#[derive(Clone, Debug, PartialEq)]
pub struct Inward {
    /// What the subscription in ROS requests.
    pub qos: Qos,
    /// What the port here offers.
    pub offered: Qos,
    /// Of publishers of the class: what others send is left to the subscriptions of their classes. None yet, if the
    /// subscription is there for ROS to see.
    pub publishers: BTreeSet<Gid>,
    /// See [`Choice::min_period`].
    pub min_period: Option<Duration>,
    /// What the topic says of its type.
    pub type_hash: Option<String>,
}

impl Inward {
    /// What may change while it runs.
    fn is_same_subscription(&self, other: &Inward) -> bool {
        (self.qos, self.offered, &self.type_hash) == (other.qos, other.offered, &other.type_hash)
    }
}

/// How messages are taken from shared memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Outward {
    /// Length of the bridge's queue, per publisher.
    pub depth: usize,
    /// Whether any publisher serves late joiners.
    pub is_kept: bool,
    /// See [`Choice::min_period`].
    pub min_period: Option<Duration>,
    /// What the topic says of its type.
    pub type_hash: Option<String>,
}

/// Something to do.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Make a publisher in ROS that stands for this one.
    OpenWriter(TopicKey, Gid, Qos, Option<String>),
    /// It has gone.
    CloseWriter(TopicKey, Gid),
    /// Begin to take a topic's samples from shared memory.
    StartOut(TopicKey, Outward),
    /// Stop it.
    StopOut(TopicKey),
    /// Begin to take a class's messages from ROS; of one that is being taken, begin anew.
    StartIn(InKey, Inward),
    /// These are its publishers now, and this the rate.
    ChangeIn(InKey, Inward),
    /// Stop it.
    StopIn(InKey),
}

impl Action {
    /// Whether `failed`, which could not be done before, is not to be tried again after this: it would undo it.
    pub(crate) fn replaces(&self, failed: &Action) -> bool {
        use Action::*;
        match (self, failed) {
            (OpenWriter(key, gid, ..) | CloseWriter(key, gid), OpenWriter(other, port, ..)) => {
                (key, gid) == (other, port)
            }
            (StartOut(key, _) | StopOut(key), StartOut(other, _)) => key == other,
            (StartIn(key, _) | StopIn(key), StartIn(other, _) | ChangeIn(other, _)) => key == other,
            (ChangeIn(key, _), ChangeIn(other, _)) => key == other,
            _ => false,
        }
    }

    pub(crate) fn topic(&self) -> &TopicKey {
        match self {
            Action::OpenWriter(key, ..) | Action::CloseWriter(key, _) => key,
            Action::StartOut(key, _) | Action::StopOut(key) => key,
            Action::StartIn(key, _) | Action::ChangeIn(key, _) | Action::StopIn(key) => &key.topic,
        }
    }
}

/// Depth of the RMW's queue of what comes from ROS at least: publishers there do not tell theirs.
pub const MIN_DEPTH_IN: usize = 1000;
/// What is kept of a class from ROS for late joiners at least; more is twice as much, and so on. A change costs those who listen
/// already what they get twice, so a few publishers more must not be one.
pub const MIN_KEPT: usize = 32;

/// The state: what is being bridged.
pub struct Mirror {
    rules: Rules,
    writers: BTreeMap<(TopicKey, Gid), Qos>,
    out: BTreeMap<TopicKey, Outward>,
    inward: BTreeMap<InKey, Inward>,
    problems: BTreeMap<String, String>,
}

/// What there should be.
#[derive(Default)]
struct Wanted {
    writers: BTreeMap<(TopicKey, Gid), (Qos, Option<String>)>,
    out: BTreeMap<TopicKey, Outward>,
    inward: BTreeMap<InKey, Inward>,
    problems: BTreeMap<String, String>,
}

impl Mirror {
    /// Nothing exists yet.
    pub fn new(rules: Rules) -> Self {
        let (writers, out, inward) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
        Mirror { rules, writers, out, inward, problems: BTreeMap::new() }
    }

    /// What the rules say.
    pub fn rules(&self) -> &Rules {
        &self.rules
    }

    /// Publishers in ROS of a class.
    pub fn publishers(&self, key: &InKey) -> Option<&BTreeSet<Gid>> {
        self.inward.get(key).map(|inward| &inward.publishers)
    }

    /// Topics that cannot be bridged, and why.
    pub fn problems(&self) -> &BTreeMap<String, String> {
        &self.problems
    }

    /// What exists now: `here` in Tautline, `there` in ROS, both without what this bridge made, and of publishers those
    /// alone whose messages it carries.
    pub fn update<'e>(
        &mut self,
        here: impl IntoIterator<Item = &'e TopicEndpoint>,
        there: &[TopicEndpoint],
    ) -> Vec<Action> {
        let wanted = self.wanted(here, there);
        let mut actions = Vec::new();
        // Ends before beginnings.
        for key in self.out.keys().filter(|key| !wanted.out.contains_key(*key)) {
            actions.push(Action::StopOut(key.clone()));
        }
        for (key, gid) in self.writers.keys().filter(|key| !wanted.writers.contains_key(*key)) {
            actions.push(Action::CloseWriter(key.clone(), *gid));
        }
        for key in self.inward.keys().filter(|key| !wanted.inward.contains_key(*key)) {
            actions.push(Action::StopIn(key.clone()));
        }
        for (writer, (qos, hash)) in &wanted.writers {
            if self.writers.get(writer) != Some(qos) {
                let (key, gid) = writer.clone();
                if self.writers.contains_key(writer) {
                    actions.push(Action::CloseWriter(key.clone(), gid));
                }
                actions.push(Action::OpenWriter(key, gid, *qos, hash.clone()));
            }
        }
        let mut out = BTreeMap::new();
        for (key, mut outward) in wanted.out {
            let running = self.out.get(&key);
            if let Some(running) = running {
                // What runs only grows, for a change costs samples or has them come twice.
                outward.depth = outward.depth.max(running.depth);
                outward.is_kept |= running.is_kept;
            }
            if running != Some(&outward) {
                actions.push(Action::StartOut(key.clone(), outward.clone()));
            }
            out.insert(key, outward);
        }
        let mut inward = BTreeMap::new();
        for (key, mut now) in wanted.inward {
            match self.inward.get(&key) {
                None => actions.push(Action::StartIn(key.clone(), now.clone())),
                Some(running) => {
                    now.qos.depth = now.qos.depth.max(running.qos.depth);
                    now.offered.depth = now.offered.depth.max(running.offered.depth);
                    if !now.is_same_subscription(running) {
                        actions.push(Action::StartIn(key.clone(), now.clone()));
                    } else if now != *running {
                        actions.push(Action::ChangeIn(key.clone(), now.clone()));
                    }
                }
            }
            inward.insert(key, now);
        }
        self.writers = wanted.writers.into_iter().map(|(writer, (qos, _))| (writer, qos)).collect();
        (self.out, self.inward) = (out, inward);
        self.problems = wanted.problems;
        actions
    }

    fn wanted<'e>(
        &self,
        here: impl IntoIterator<Item = &'e TopicEndpoint>,
        there: &[TopicEndpoint],
    ) -> Wanted {
        let mut wanted = Wanted::default();
        let mut topics: BTreeMap<&str, Vec<&TopicEndpoint>> = BTreeMap::new();
        for end in here {
            topics.entry(&end.topic).or_default().push(end);
        }
        let mut of_ros: BTreeMap<&str, Vec<&TopicEndpoint>> = BTreeMap::new();
        for end in there {
            of_ros.entry(&end.topic).or_default().push(end);
        }
        for (topic, ends) in topics {
            let Some(choice) = self.rules.choice(topic) else { continue };
            let others = of_ros.get(&*choice.ros_topic).map_or(&[][..], |ends| ends);
            let is_bridged = |type_name: &str| self.is_bridged(topic, type_name);
            if let Err(reason) = wanted.topic(topic, &ends, others, &choice, is_bridged) {
                wanted.problems.insert(topic.to_owned(), reason);
            }
        }
        wanted
    }

    /// Whether a topic exists in ROS for the ends here with this type.
    fn is_bridged(&self, topic: &str, type_name: &str) -> bool {
        let keys = self.writers.keys().map(|(key, _)| key).chain(self.inward.keys().map(|key| &key.topic));
        keys.filter(|key| key.topic == topic).any(|key| key.type_name == type_name)
    }
}

impl Wanted {
    /// Adds what is to be done of a topic, of which `here` and `there` are the ends.
    fn topic(
        &mut self,
        topic: &str,
        here: &[&TopicEndpoint],
        there: &[&TopicEndpoint],
        choice: &Choice,
        is_bridged: impl Fn(&str) -> bool,
    ) -> Result<(), String> {
        let types: BTreeSet<&str> = here.iter().map(|end| &*end.topic_type.name).collect();
        let is_there = |name: &&str| there.iter().any(|end| end.topic_type.name == **name);
        // A process has one type of a topic in ROS: of several here it is one that is there too, and stays the same.
        let rank = |name: &&str| (types.len() > 1).then(|| (is_there(name), is_bridged(name)));
        let is_allowed = |name: &&str| choice.type_name.as_deref().is_none_or(|expected| expected == *name);
        let allowed = types.iter().copied().filter(is_allowed);
        let Some(type_name) = allowed.max_by_key(rank) else {
            return Err(format!(
                "it carries {}, but the configuration says {}: correct 'type', or leave it out",
                types.into_iter().collect::<Vec<_>>().join(" and "),
                choice.type_name.as_deref().unwrap_or_default()
            ));
        };
        let (here, others): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            here.iter().copied().partition(|end| end.topic_type.name == type_name);
        let (same, other): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            there.iter().copied().partition(|end| end.topic_type.name == type_name);
        let hash = definition(&here, &same);
        let (same, changed): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            same.into_iter().partition(|end| is_of(end, hash));
        let here: Vec<&TopicEndpoint> = here.into_iter().filter(|end| is_of(end, hash)).collect();
        let key = TopicKey {
            topic: topic.to_owned(),
            ros_topic: choice.ros_topic.clone(),
            type_name: type_name.to_owned(),
        };
        if choice.goes(Direction::ToRos) {
            self.out(&key, &here, &same, choice, hash);
        }
        if choice.goes(Direction::FromRos) {
            self.inward(&key, &here, &same, choice, hash);
        }
        // Of the types that ROS has, this is one: those that nobody has here are none of ours.
        let also = others.iter().map(|end| &*end.topic_type.name).find(is_there);
        match (same.is_empty(), changed.first(), other.first()) {
            (true, Some(changed), _) => Err(format!(
                "{type_name} is defined differently in ROS ({}) and here ({}): rebuild one of them with the other's definition",
                changed.topic_type.hash.as_deref().unwrap_or("no hash"),
                hash.unwrap_or("no hash"),
            )),
            (true, None, Some(other)) => Err(format!(
                "it carries {type_name}, in ROS {}: rename one of them, or use the same type",
                other.topic_type.name
            )),
            _ => also.map_or(Ok(()), |also| {
                Err(format!(
                    "both sides have it with {type_name}, which is bridged, and with {also}, which is not: a process has one type of a \
                     topic in ROS, so rename one of them"
                ))
            }),
        }
    }

    fn out(
        &mut self,
        key: &TopicKey,
        here: &[&TopicEndpoint],
        there: &[&TopicEndpoint],
        choice: &Choice,
        hash: Option<&str>,
    ) {
        let hash = hash.map(str::to_owned);
        let writers = || here.iter().filter(|end| end.kind == EndpointKind::Publisher);
        for end in writers() {
            let qos = choice.qos.applied_to(Qos {
                // Its lease is renewed by means that are not seen here.
                liveliness: tautline_transport::Liveliness::Automatic,
                liveliness_lease_duration: None,
                ..end.qos
            });
            self.writers.insert((key.clone(), end.gid), (qos, hash.clone()));
        }
        let is_read = key.is_of_action() || there.iter().any(|end| end.kind == EndpointKind::Subscription);
        let depth =
            |end: &&&TopicEndpoint| end.qos.depth.max(if end.origin.is_here() { 1 } else { RELAYED_DEPTH });
        if let (true, Some(depth)) = (is_read, writers().map(|end| depth(&end)).max()) {
            let is_kept = writers().any(|end| end.qos.durability == Durability::TransientLocal);
            let outward = Outward { depth, is_kept, min_period: choice.min_period, type_hash: hash };
            self.out.insert(key.clone(), outward);
        }
    }

    fn inward(
        &mut self,
        key: &TopicKey,
        here: &[&TopicEndpoint],
        there: &[&TopicEndpoint],
        choice: &Choice,
        hash: Option<&str>,
    ) {
        let readers = || here.iter().filter(|end| end.kind == EndpointKind::Subscription);
        let Some(deepest) = readers().map(|end| end.qos.depth).max() else { return };
        let mut classes: BTreeMap<Class, Vec<&TopicEndpoint>> = BTreeMap::new();
        for end in there.iter().filter(|end| end.kind == EndpointKind::Publisher) {
            classes.entry(Class::of(&choice.qos.applied_to(end.qos))).or_default().push(end);
        }
        // A publisher that is yet to come finds somebody at once, if it offers the default. One that offers less would be told
        // that it does not fit.
        if classes.is_empty() && readers().any(|end| end.qos.reliability == Reliability::Reliable) {
            let default = Class { is_reliable: true, is_kept: false };
            classes.insert(Class::of(&choice.qos.applied_to(default.qos(1))), Vec::new());
        }
        for (class, publishers) in classes {
            // What others elsewhere ask for is a claim.
            let late = readers().filter(|end| end.origin.is_here());
            let late = late.filter(|end| end.qos.durability == Durability::TransientLocal);
            let kept = publishers.iter().map(|end| depth_in_ros(&end.qos)).fold(0, usize::saturating_add);
            let deepest_late = late.map(|end| end.qos.depth).max().unwrap_or(1);
            let qos = choice.qos.applied_to(class.qos(deepest.max(MIN_DEPTH_IN)));
            let inward = Inward {
                qos,
                offered: Qos {
                    deadline: longest(publishers.iter().map(|end| end.qos.deadline)),
                    liveliness_lease_duration: longest(
                        publishers.iter().map(|end| end.qos.liveliness_lease_duration),
                    ),
                    ..Class::of(&qos).qos(match class.is_kept {
                        true => choice.qos.depth.unwrap_or_else(|| kept_depth(kept.max(deepest_late))),
                        false => 1,
                    })
                },
                publishers: publishers.iter().map(|end| end.gid).collect(),
                min_period: choice.min_period,
                type_hash: hash.map(str::to_owned),
            };
            // Only what the configuration says can ask for more than there is.
            if let Some(policy) = publishers.iter().find_map(|end| end.qos.incompatibility(&qos)) {
                let reason = format!(
                    "a publisher in ROS does not offer what `qos` requests ({policy:?}): leave that out of the configuration"
                );
                self.problems.insert(key.topic.clone(), reason);
            }
            self.inward.insert(InKey { topic: key.clone(), class }, inward);
        }
    }
}

/// What all of them keep; `None` is without a limit.
fn longest(times: impl Iterator<Item = Option<Duration>>) -> Option<Duration> {
    times.reduce(|one, other| Some(one?.max(other?))).flatten()
}

/// The hash of the definition that the ends of a type go by, of those that are stated: one that both sides have, if there is one.
fn definition<'e>(here: &[&'e TopicEndpoint], there: &[&TopicEndpoint]) -> Option<&'e str> {
    let mut stated = here.iter().filter_map(|end| end.topic_type.hash.as_deref());
    let is_there = |hash: &&str| there.iter().any(|end| end.topic_type.hash.as_deref() == Some(hash));
    stated.clone().find(is_there).or_else(|| stated.next())
}

/// What is not known agrees with everything.
fn is_of(end: &TopicEndpoint, hash: Option<&str>) -> bool {
    end.topic_type.hash.as_deref().is_none_or(|stated| hash.is_none_or(|hash| hash == stated))
}

fn kept_depth(wanted: usize) -> usize {
    let depth = wanted.max(MIN_KEPT).checked_next_power_of_two().unwrap_or(wanted);
    depth.min(Limits::MAX_DEPTH)
}

/// Samples that a publisher in ROS keeps; keep-all has no number there and gets a large one.
fn depth_in_ros(qos: &Qos) -> usize {
    const KEEP_ALL: usize = 1000;
    if qos.history == History::KeepAll { qos.depth.max(KEEP_ALL) } else { qos.depth.max(1) }
}

#[cfg(test)]
mod tests;
