// SPDX-License-Identifier: MIT OR Apache-2.0
//! Decides from both graphs what is mirrored between a domain and a network or ROS 2 graph.
//! [`MirrorControl`](crate::MirrorControl) executes it.
//!
//! A pure state machine: its input is graphs, its output is [`Action`]s, in the order of execution.
//!
//! - *Out.* Each publisher here (in the domain) has a writer there (on the far side), with its QoS. Samples are taken from shared
//!   memory while there is a subscription there; those of transient-local publishers always go to a network, because Zenoh keeps them.
//! - *In.* Messages come in while there are a subscription here and a publisher there. ROS matches endpoints by QoS, so
//!   publishers there are grouped by the QoS that they offer ([`Class`]); each class has a subscription there that requests exactly
//!   this QoS and a port here that offers it. So each subscription here gets the messages that it would get in ROS. Without publishers,
//!   a subscription of the default class shows in ROS that there is one here. A network has one port for all publishers.
//!
//! **No loops, no duplicates.** The input excludes this mirror's own announcements. It includes those of others, with their origins,
//! and the caller of [`Mirror::update`] marks publishers whose messages arrive by another path: see [`Transit`](crate::Transit).

use crate::rules::{Choice, Direction, Rules};
use crate::transit::RELAYED_DEPTH;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tautline_transport::{Durability, EndpointKind, Gid, History, Limits, Qos, Reliability, TopicEndpoint};

/// The kind of far side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// A ROS 2 graph: a process has one type per topic, and endpoints match by QoS.
    Ros,
    /// A network like rmw_zenoh's: each type of a topic, by name and hash, is a separate topic, and publishers reach every
    /// subscription.
    Network,
}

impl Side {
    fn place(self) -> &'static str {
        match self {
            Side::Ros => "in ROS",
            Side::Network => "on another host",
        }
    }
}

/// A topic on both sides.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicKey {
    /// Its name in the domain.
    pub topic: String,
    /// Its name on the far side.
    pub far_topic: String,
    /// Its type.
    pub type_name: String,
    /// The type's hash, on a network.
    pub type_hash: Option<String>,
}

impl TopicKey {
    /// The key of the domain's `topic`, with its far name from `choice`.
    pub(crate) fn of(topic: &str, choice: &Choice, type_name: &str, type_hash: Option<&str>) -> Self {
        TopicKey {
            topic: topic.to_owned(),
            far_topic: choice.far_topic.clone(),
            type_name: type_name.to_owned(),
            type_hash: type_hash.map(str::to_owned),
        }
    }

    /// Whether this is the feedback or status topic of an action. A client may send its first goal before its subscriptions are
    /// discovered, so these topics are sent to ROS even without a known subscription.
    pub fn is_of_action(&self) -> bool {
        self.topic.contains("/_action/")
    }
}

/// The QoS policies of publishers in ROS that decide about matching.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Class {
    /// Whether reliability is reliable.
    pub is_reliable: bool,
    /// Whether durability is transient local.
    pub is_kept: bool,
}

impl Class {
    /// The class of a publisher that offers `qos`.
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

/// An incoming topic, from publishers of one class.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct InKey {
    /// The topic.
    pub topic: TopicKey,
    /// The class; `None`: all publishers.
    pub class: Option<Class>,
}

impl InKey {
    /// Whether the class is transient local: new subscriptions get kept samples again.
    pub fn is_kept(&self) -> bool {
        self.class.is_some_and(|class| class.is_kept)
    }
}

/// How messages of a class come in.
#[derive(Clone, Debug, PartialEq)]
pub struct Inward {
    /// The QoS of the subscription on the far side.
    pub qos: Qos,
    /// The QoS that the port in the domain offers.
    pub offered: Qos,
    /// The publishers of the class whose messages this mirror carries, each with its lifespan. Empty if the subscription only shows
    /// in ROS that there is a subscription in the domain.
    pub publishers: BTreeMap<Gid, Option<Duration>>,
    /// Publishers of the class whose messages another relay carries.
    pub passed_over: BTreeSet<Gid>,
    /// See [`Rule::min_period`](crate::Rule::min_period).
    pub min_period: Option<Duration>,
    /// The type hash that the topic states.
    pub type_hash: Option<String>,
}

impl Inward {
    /// Whether the two differ only in values that may change without a restart.
    fn is_same_subscription(&self, other: &Inward) -> bool {
        (self.qos, self.offered, &self.type_hash) == (other.qos, other.offered, &other.type_hash)
    }

    /// Keeps values at least as large as those of `running`, because a restart loses or repeats samples.
    fn grow_from(&mut self, running: &Inward, side: Side) {
        let depth = self.offered.depth.max(running.offered.depth);
        match side {
            Side::Ros => {
                self.offered.depth = depth;
                self.qos.depth = self.qos.depth.max(running.qos.depth);
                // Without publishers, nothing is offered yet. Without kept samples, a restart repeats none.
                if self.offered.durability == Durability::TransientLocal && !running.publishers.is_empty() {
                    let (one, other) = (self.offered, running.offered);
                    self.offered.deadline = longest([one.deadline, other.deadline]);
                    self.offered.liveliness_lease_duration =
                        longest([one.liveliness_lease_duration, other.liveliness_lease_duration]);
                }
            }
            Side::Network => {
                let (was, is) = (Class::of(&running.offered), Class::of(&self.offered));
                let is_kept = was.is_kept || is.is_kept;
                // A volatile port is not upgraded to reliable: the restart would interrupt the publishers that it already serves.
                let is_reliable = was.is_reliable || (is_kept && is.is_reliable);
                self.offered = Class { is_reliable, is_kept }.qos(depth);
                self.qos = self.offered;
            }
        }
    }
}

/// How samples are taken from shared memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Outward {
    /// Queue depth, per publisher.
    pub depth: usize,
    /// Whether any publisher is transient local.
    pub is_kept: bool,
    /// Whether publishers wait for samples to be taken: a publisher and a subscription on a network are keep-all.
    pub keeps_all: bool,
    /// See [`Rule::min_period`](crate::Rule::min_period).
    pub min_period: Option<Duration>,
    /// The type hash that the topic states.
    pub type_hash: Option<String>,
}

/// An action to execute.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Create the writer on the far side that mirrors this publisher.
    OpenWriter(TopicKey, Gid, Qos, Option<String>),
    CloseWriter(TopicKey, Gid),
    /// Start taking a topic's samples from shared memory, or restart with changed values: kept samples come again.
    StartOut(TopicKey, Outward),
    StopOut(TopicKey),
    /// Start or restart taking a class's messages.
    StartIn(InKey, Inward),
    /// Restart unchanged, to receive kept samples of publishers whose messages another relay carried so far.
    AskAgain(InKey, Inward),
    /// Change the publishers and the rate of a class.
    ChangeIn(InKey, Inward),
    StopIn(InKey),
}

impl Action {
    /// Whether a retry of `failed` after this action would undo it.
    pub(crate) fn replaces(&self, failed: &Action) -> bool {
        use Action::*;
        match (self, failed) {
            (OpenWriter(key, gid, ..) | CloseWriter(key, gid), OpenWriter(other, port, ..)) => {
                (key, gid) == (other, port)
            }
            (StartOut(key, _) | StopOut(key), StartOut(other, _)) => key == other,
            (
                StartIn(key, _) | AskAgain(key, _) | StopIn(key),
                StartIn(other, _) | AskAgain(other, _) | ChangeIn(other, _),
            ) => key == other,
            (ChangeIn(key, _), ChangeIn(other, _)) => key == other,
            _ => false,
        }
    }

    pub(crate) fn topic(&self) -> &TopicKey {
        match self {
            Action::OpenWriter(key, ..) | Action::CloseWriter(key, _) => key,
            Action::StartOut(key, _) | Action::StopOut(key) => key,
            Action::StartIn(key, _) | Action::AskAgain(key, _) => &key.topic,
            Action::ChangeIn(key, _) | Action::StopIn(key) => &key.topic,
        }
    }
}

/// Minimum depth of the RMW's queue from ROS: DDS does not announce publishers' depth.
pub const MIN_DEPTH_IN: usize = 1000;
/// Minimum of kept samples of a class from ROS; the number doubles as needed. A change repeats samples for existing
/// subscriptions, so a few additional publishers must not cause one.
pub const MIN_KEPT: usize = 32;

/// An endpoint on the far side, and for a publisher whether this mirror carries its messages.
pub type Far<'e> = (&'e TopicEndpoint, bool);

/// The state: everything mirrored now.
pub struct Mirror {
    side: Side,
    pub(crate) rules: Rules,
    writers: BTreeMap<(TopicKey, Gid), Qos>,
    out: BTreeMap<TopicKey, Outward>,
    inward: BTreeMap<InKey, Inward>,
    /// Topics of which a writer, with its kept samples, was ended by [`forget_writer`](Self::forget_writer).
    forgotten: BTreeSet<TopicKey>,
    problems: BTreeMap<String, String>,
}

#[derive(Default)]
struct MirrorPlan {
    writers: BTreeMap<(TopicKey, Gid), WantedWriter>,
    out: BTreeMap<TopicKey, Outward>,
    inward: BTreeMap<InKey, Inward>,
    problems: BTreeMap<String, String>,
}

struct WantedWriter {
    qos: Qos,
    hash: Option<String>,
    /// Whether the writer mirrors a publisher of this host.
    is_here: bool,
}

impl Mirror {
    /// An empty mirror.
    pub fn new(side: Side, rules: Rules) -> Self {
        let (writers, out, inward, forgotten, problems) = Default::default();
        Mirror { side, rules, writers, out, inward, forgotten, problems }
    }

    /// Topics that cannot be mirrored, and why.
    pub fn problems(&self) -> &BTreeMap<String, String> {
        &self.problems
    }

    /// The actions for both graphs, which exclude this mirror's endpoints. `here` has only the publishers that this mirror announces.
    pub fn update<'e>(
        &mut self,
        here: impl IntoIterator<Item = &'e TopicEndpoint>,
        there: &[Far<'e>],
    ) -> Vec<Action> {
        let wanted = self.wanted(here, there);
        let mut actions = Vec::new();
        // Topics and writers end before others start.
        for key in self.out.keys().filter(|key| !wanted.out.contains_key(*key)) {
            actions.push(Action::StopOut(key.clone()));
        }
        for (key, gid) in self.writers.keys().filter(|key| !wanted.writers.contains_key(*key)) {
            actions.push(Action::CloseWriter(key.clone(), *gid));
        }
        for key in self.inward.keys().filter(|key| !wanted.inward.contains_key(*key)) {
            actions.push(Action::StopIn(key.clone()));
        }
        // Topics with a transient-local publisher that another relay may have carried before, or whose writer ended with its samples.
        let mut regained = BTreeSet::new();
        let forgotten = std::mem::take(&mut self.forgotten);
        for (writer, WantedWriter { qos, hash, is_here }) in &wanted.writers {
            if self.writers.get(writer) != Some(qos) {
                let (key, gid) = writer.clone();
                let is_made_anew = self.writers.contains_key(writer);
                if is_made_anew {
                    actions.push(Action::CloseWriter(key.clone(), gid));
                }
                let is_again = is_made_anew || forgotten.contains(&key) || !is_here;
                if is_again && qos.durability == Durability::TransientLocal {
                    regained.insert(key.clone());
                }
                actions.push(Action::OpenWriter(key, gid, *qos, hash.clone()));
            }
        }
        let mut out = BTreeMap::new();
        for (key, mut outward) in wanted.out {
            let running = self.out.get(&key);
            if let Some(running) = running {
                // Values only grow, because a restart loses or repeats samples.
                outward.depth = outward.depth.max(running.depth);
                outward.is_kept |= running.is_kept;
                outward.keeps_all |= running.keeps_all;
            }
            if running != Some(&outward) || regained.contains(&key) {
                actions.push(Action::StartOut(key.clone(), outward.clone()));
            }
            out.insert(key, outward);
        }
        let mut inward = BTreeMap::new();
        for (key, mut now) in wanted.inward {
            match self.inward.get(&key) {
                None => actions.push(Action::StartIn(key.clone(), now.clone())),
                Some(running) => {
                    now.grow_from(running, self.side);
                    // Samples kept by a publisher that this mirror now carries are requested again.
                    let is_regained = now.offered.durability == Durability::TransientLocal
                        && now.publishers.keys().any(|gid| running.passed_over.contains(gid));
                    if !now.is_same_subscription(running) {
                        actions.push(Action::StartIn(key.clone(), now.clone()));
                    } else if is_regained {
                        actions.push(Action::AskAgain(key.clone(), now.clone()));
                    } else if now != *running {
                        actions.push(Action::ChangeIn(key.clone(), now.clone()));
                    }
                }
            }
            inward.insert(key, now);
        }
        self.writers = wanted.writers.into_iter().map(|(writer, wanted)| (writer, wanted.qos)).collect();
        (self.out, self.inward) = (out, inward);
        self.problems = wanted.problems;
        actions
    }

    fn wanted<'e>(&self, here: impl IntoIterator<Item = &'e TopicEndpoint>, there: &[Far<'e>]) -> MirrorPlan {
        let mut wanted = MirrorPlan::default();
        let far = grouped(there.iter().copied(), |(end, _)| &*end.topic);
        for (topic, ends) in grouped(here, |end| &*end.topic) {
            let Some(choice) = self.rules.choice(topic) else { continue };
            let others = far.get(&*choice.far_topic).map_or(&[][..], |ends| ends);
            let topic_wanted = match self.side {
                Side::Ros => {
                    let is_bridged = |type_name: &str| self.is_bridged(topic, type_name);
                    wanted.of_one_type(topic, &ends, others, &choice, is_bridged)
                }
                Side::Network => wanted.of_each_type(topic, &ends, others, &choice),
            };
            if let Err(reason) = topic_wanted {
                wanted.problems.insert(topic.to_owned(), reason);
            }
        }
        wanted
    }

    /// Marks a writer as ended: it is created again, if still needed.
    pub fn forget_writer(&mut self, key: &TopicKey, gid: Gid) {
        self.writers.remove(&(key.clone(), gid));
        self.forgotten.insert(key.clone());
    }

    /// The publishers of a class that this mirror carries, each with its lifespan.
    pub fn publishers(&self, key: &InKey) -> Option<&BTreeMap<Gid, Option<Duration>>> {
        self.inward.get(key).map(|inward| &inward.publishers)
    }

    /// Whether a topic with this type is already mirrored into ROS.
    fn is_bridged(&self, topic: &str, type_name: &str) -> bool {
        let keys = self.writers.keys().map(|(key, _)| key).chain(self.inward.keys().map(|key| &key.topic));
        keys.filter(|key| key.topic == topic).any(|key| key.type_name == type_name)
    }
}

/// The endpoints of one type of a topic, on both sides.
struct Ends<'e> {
    key: &'e TopicKey,
    here: &'e [&'e TopicEndpoint],
    there: &'e [Far<'e>],
    choice: &'e Choice,
    /// The hash of the type's definition, if stated.
    hash: Option<&'e str>,
}

impl MirrorPlan {
    /// Adds a topic with endpoints `here` and `there`, where each type is a separate topic.
    fn of_each_type(
        &mut self,
        topic: &str,
        here: &[&TopicEndpoint],
        there: &[Far],
        choice: &Choice,
    ) -> Result<(), String> {
        let types = grouped(here.iter().copied(), type_of);
        for ((type_name, hash), here) in &types {
            let key = TopicKey::of(topic, choice, type_name, *hash);
            let same: Vec<Far> =
                there.iter().copied().filter(|(end, _)| type_of(end) == (type_name, *hash)).collect();
            self.both_ways(Side::Network, &Ends { key: &key, here, there: &same, choice, hash: *hash });
        }
        let other = there.iter().map(|(end, _)| type_of(end)).find(|other| !types.contains_key(other));
        let (Some((there, their_hash)), Some((here, _))) = (other, types.keys().next()) else {
            return Ok(());
        };
        let place = Side::Network.place();
        Err(match here == &there {
            true => {
                let hash = their_hash.unwrap_or("unknown");
                format!(
                    "{there} is defined differently {place} (hash {hash}): rebuild one side with the other's definition"
                )
            }
            false => format!("its type is {here}, {place} {there}: rename one topic, or use the same type"),
        })
    }

    fn both_ways(&mut self, side: Side, ends: &Ends) {
        if ends.choice.allows(Direction::Out) {
            self.out(side, ends);
        }
        if ends.choice.allows(Direction::In) {
            match side {
                Side::Ros => self.by_class(ends),
                Side::Network => self.all_in_one(ends),
            }
        }
    }

    /// Adds a topic with endpoints `here` and `there`, of which one type is mirrored.
    fn of_one_type(
        &mut self,
        topic: &str,
        here: &[&TopicEndpoint],
        there: &[Far],
        choice: &Choice,
        is_bridged: impl Fn(&str) -> bool,
    ) -> Result<(), String> {
        let types: BTreeSet<&str> = here.iter().map(|end| &*end.topic_type.name).collect();
        let place = Side::Ros.place();
        let is_there = |name: &&str| there.iter().any(|(end, _)| end.topic_type.name == **name);
        // ROS has one type per topic and process: of several types here, prefers one that exists in ROS, then the one mirrored now.
        let rank = |name: &&str| (types.len() > 1).then(|| (is_there(name), is_bridged(name)));
        let is_allowed = |name: &&str| choice.type_name.as_deref().is_none_or(|expected| expected == *name);
        let allowed = types.iter().copied().filter(is_allowed);
        let Some(type_name) = allowed.max_by_key(rank) else {
            return Err(format!(
                "its type is {}, but the configuration says {}: correct or remove 'type'",
                types.into_iter().collect::<Vec<_>>().join(" and "),
                choice.type_name.as_deref().unwrap_or_default()
            ));
        };
        let (here, others): (Vec<&TopicEndpoint>, Vec<&TopicEndpoint>) =
            here.iter().copied().partition(|end| end.topic_type.name == type_name);
        let (same, other): (Vec<Far>, Vec<Far>) =
            there.iter().copied().partition(|(end, _)| end.topic_type.name == type_name);
        let hash = definition(&here, &same);
        let (same, changed): (Vec<Far>, Vec<Far>) = same.into_iter().partition(|(end, _)| is_of(end, hash));
        let here: Vec<&TopicEndpoint> = here.into_iter().filter(|end| is_of(end, hash)).collect();
        let key = TopicKey::of(topic, choice, type_name, None);
        self.both_ways(Side::Ros, &Ends { key: &key, here: &here, there: &same, choice, hash });
        // Types that exist only in ROS are no problem.
        let also = others.iter().map(|end| &*end.topic_type.name).find(is_there);
        match (same.is_empty(), changed.first(), other.first()) {
            (true, Some((changed, _)), _) => Err(format!(
                "{type_name} is defined differently {place} ({}) and here ({}): rebuild one side with the other's definition",
                changed.topic_type.hash.as_deref().unwrap_or("no hash"),
                hash.unwrap_or("no hash"),
            )),
            (true, None, Some((other, _))) => Err(format!(
                "its type is {type_name}, {place} {}: rename one topic, or use the same type",
                other.topic_type.name
            )),
            _ => also.map_or(Ok(()), |also| {
                Err(format!(
                    "both sides have types {type_name}, which is bridged, and {also}, which is not: ROS permits one type of a topic per \
                     process, so rename one of them"
                ))
            }),
        }
    }

    fn out(&mut self, side: Side, ends: &Ends) {
        let Ends { key, here, there, choice, hash } = *ends;
        let hash = hash.map(str::to_owned);
        let writers = || here.iter().filter(|end| end.kind == EndpointKind::Publisher);
        for end in writers() {
            let qos = choice.qos.applied_to(Qos {
                // The mirror is not notified of assertions of liveliness.
                liveliness: tautline_transport::Liveliness::Automatic,
                liveliness_lease_duration: None,
                // In ROS, a writer that keeps all waits for its readers, and all topics wait with it.
                history: if side == Side::Ros { History::KeepLast } else { end.qos.history },
                ..end.qos
            });
            let wanted = WantedWriter { qos, hash: hash.clone(), is_here: end.origin.is_here() };
            self.writers.insert((key.clone(), end.gid), wanted);
        }
        let is_kept = writers().any(|end| end.qos.durability == Durability::TransientLocal);
        let is_read = there.iter().any(|(end, _)| end.kind == EndpointKind::Subscription);
        let is_read = match side {
            Side::Ros => is_read || key.is_of_action(),
            Side::Network => is_read || is_kept,
        };
        let depth =
            |end: &&&TopicEndpoint| end.qos.depth.max(if end.origin.is_here() { 1 } else { RELAYED_DEPTH });
        let keeps_all = |end: &TopicEndpoint| {
            end.qos.history == History::KeepAll && end.qos.reliability == Reliability::Reliable
        };
        let keeps_all = side == Side::Network
            && writers().any(|end| keeps_all(end))
            && there.iter().any(|(end, _)| end.kind == EndpointKind::Subscription && keeps_all(end));
        if let (true, Some(depth)) = (is_read, writers().map(|end| depth(&end)).max()) {
            let outward =
                Outward { depth, is_kept, keeps_all, min_period: choice.min_period, type_hash: hash };
            self.out.insert(key.clone(), outward);
        }
    }

    /// Adds one entry for all publishers.
    fn all_in_one(&mut self, ends: &Ends) {
        let Ends { key, here, there, choice, hash } = *ends;
        let publishers = || there.iter().filter(|(end, _)| end.kind == EndpointKind::Publisher);
        let carried = || publishers().filter(|(_, comes_in)| *comes_in).map(|(end, _)| *end);
        let mut readers = here.iter().filter(|end| end.kind == EndpointKind::Subscription).peekable();
        if readers.peek().is_none() || carried().next().is_none() {
            return;
        }
        let is_kept = |end: &&&TopicEndpoint| end.qos.durability == Durability::TransientLocal;
        // No subscription gets more than its depth, so the number of samples that publishers keep does not matter. Publishers come and
        // go, and a change of the port repeats samples. Depths of other hosts are bounded, because they are untrusted.
        let most = |end: &TopicEndpoint| if end.origin.is_here() { usize::MAX } else { RELAYED_DEPTH };
        let asked = readers.filter(is_kept).map(|end| end.qos.depth.min(most(end))).max();
        let kept = asked.filter(|_| carried().any(|end| is_kept(&&end)));
        let is_reliable = carried().any(|end| end.qos.reliability == Reliability::Reliable);
        let class = Class { is_reliable, is_kept: kept.is_some() };
        let qos = class.qos(kept.unwrap_or(1).clamp(1, Limits::MAX_DEPTH));
        let inward = Inward {
            qos,
            offered: qos,
            publishers: carried().map(|end| (end.gid, end.qos.lifespan)).collect(),
            passed_over: publishers().filter(|(_, comes_in)| !comes_in).map(|(end, _)| end.gid).collect(),
            min_period: choice.min_period,
            type_hash: hash.map(str::to_owned),
        };
        self.inward.insert(InKey { topic: key.clone(), class: None }, inward);
    }

    /// Adds one entry per class of publishers.
    fn by_class(&mut self, ends: &Ends) {
        let Ends { key, here, there, choice, hash } = *ends;
        let readers = || here.iter().filter(|end| end.kind == EndpointKind::Subscription);
        let Some(deepest) = readers().map(|end| end.qos.depth).max() else { return };
        let mut classes: BTreeMap<Class, Vec<&TopicEndpoint>> = BTreeMap::new();
        let mut passed_over: BTreeMap<Class, BTreeSet<Gid>> = BTreeMap::new();
        for (end, comes_in) in there.iter().filter(|(end, _)| end.kind == EndpointKind::Publisher) {
            let class = Class::of(&choice.qos.applied_to(end.qos));
            match comes_in {
                true => classes.entry(class).or_default().push(end),
                false => drop(passed_over.entry(class).or_default().insert(end.gid)),
            }
        }
        // So a future publisher with default QoS matches at once. With best-effort readers only, a reliable one would cause QoS warnings.
        if classes.is_empty() && readers().any(|end| end.qos.reliability == Reliability::Reliable) {
            let default = Class { is_reliable: true, is_kept: false };
            classes.insert(Class::of(&choice.qos.applied_to(default.qos(1))), Vec::new());
        }
        for (class, publishers) in classes {
            // Depths requested on other hosts are untrusted.
            let late = readers().filter(|end| end.origin.is_here());
            let late = late.filter(|end| end.qos.durability == Durability::TransientLocal);
            let kept = publishers.iter().map(|end| kept_there(&end.qos)).fold(0, usize::saturating_add);
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
                // ROS itself drops expired messages.
                publishers: publishers.iter().map(|end| (end.gid, None)).collect(),
                passed_over: passed_over.remove(&class).unwrap_or_default(),
                min_period: choice.min_period,
                type_hash: hash.map(str::to_owned),
            };
            // Only a `qos` in the configuration can cause this.
            if let Some(policy) = publishers.iter().find_map(|end| end.qos.incompatibility(&qos)) {
                let reason = format!(
                    "a publisher in ROS is QoS-incompatible with `qos` of the configuration ({policy:?}): remove that policy"
                );
                self.problems.insert(key.topic.clone(), reason);
            }
            self.inward.insert(InKey { topic: key.clone(), class: Some(class) }, inward);
        }
    }
}

pub(crate) fn grouped<T: Copy, K: Ord>(
    all: impl IntoIterator<Item = T>,
    key: impl Fn(T) -> K,
) -> BTreeMap<K, Vec<T>> {
    let mut groups = BTreeMap::<K, Vec<T>>::new();
    for one in all {
        groups.entry(key(one)).or_default().push(one);
    }
    groups
}

/// The longest time; `None`: no limit.
fn longest(times: impl IntoIterator<Item = Option<Duration>>) -> Option<Duration> {
    times.into_iter().reduce(|one, other| Some(one?.max(other?))).flatten()
}

/// The hash that the endpoints of a type use: preferably one stated on both sides.
fn definition<'e>(here: &[&'e TopicEndpoint], there: &[Far]) -> Option<&'e str> {
    let mut stated = here.iter().filter_map(|end| end.topic_type.hash.as_deref());
    let is_there = |hash: &&str| there.iter().any(|(end, _)| end.topic_type.hash.as_deref() == Some(hash));
    stated.clone().find(is_there).or_else(|| stated.next())
}

fn type_of(end: &TopicEndpoint) -> (&str, Option<&str>) {
    (&end.topic_type.name, end.topic_type.hash.as_deref())
}

/// Whether the endpoint's type has this hash; an unknown hash matches any.
fn is_of(end: &TopicEndpoint, hash: Option<&str>) -> bool {
    end.topic_type.hash.as_deref().is_none_or(|stated| hash.is_none_or(|hash| hash == stated))
}

fn kept_depth(wanted: usize) -> usize {
    let depth = wanted.max(MIN_KEPT).checked_next_power_of_two().unwrap_or(wanted);
    depth.min(Limits::MAX_DEPTH)
}

/// Number of samples that a publisher on the far side keeps; keep-all counts as a large number.
fn kept_there(qos: &Qos) -> usize {
    const KEEP_ALL: usize = 1000;
    if qos.history == History::KeepAll { qos.depth.max(KEEP_ALL) } else { qos.depth.max(1) }
}

#[cfg(test)]
mod tests;
