// SPDX-License-Identifier: MIT OR Apache-2.0
//! Combines the hops of a message into its path. A gateway or bridge relays the message with another id into another
//! recording, and records both ids. Ids are unique across recordings, because they contain random numbers.

use super::messages::{MessageKey, key};
use super::recording::Recording;
use std::collections::{HashMap, HashSet};
use tautline_trace::{EventKind, ObjectId, ObjectKind, gid_key};

/// A process of one of the recordings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Place {
    pub recording: usize,
    pub process: u32,
}

/// Where and when something happened, by the clock of its recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct At {
    pub place: Place,
    pub time_ns: u64,
}

/// The kinds of hops, in the order in which a message passes them in a domain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum HopKind {
    /// In a gateway or bridge that receives a message.
    ReceiveToPublish,
    PublishToTake,
    /// In a gateway or bridge that sends a message: `send` is the time just before it hands the message to the network.
    TakeToSend,
    /// From one gateway or bridge to the next.
    SendToReceive,
    /// From the first publisher to a subscription that does not relay the message, through at least one network.
    WholeWay,
}

tautline_rt::names!(HopKind: pub const fn name(self) -> &'static str {
    ReceiveToPublish: "receive_to_publish", PublishToTake: "publish_to_take", TakeToSend: "take_to_send",
    SendToReceive: "send_to_receive", WholeWay: "whole_way",
});

impl HopKind {
    /// The missing event if a hop has no beginning.
    pub const fn beginning(self) -> &'static str {
        match self {
            HopKind::ReceiveToPublish => "reception",
            HopKind::PublishToTake | HopKind::WholeWay => "publication",
            HopKind::TakeToSend => "take",
            HopKind::SendToReceive => "sending",
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hop<'r> {
    pub topic: &'r str,
    /// The number of domains that the message passed before this hop; for a whole path, before its end.
    pub domains_before: usize,
    pub kind: HopKind,
    /// `None` if no recording contains it.
    pub from: Option<At>,
    pub to: At,
}

/// More networks than any message passes. Without this limit, a damaged recording could cause an endless loop.
const MAX_DOMAINS: usize = 64;

/// The events of messages in all recordings, by the messages' ids.
#[derive(Default)]
pub struct Ways<'r> {
    published: HashMap<MessageKey, (At, &'r str)>,
    /// The ids on the network of messages that a relay published here.
    let_in: HashMap<MessageKey, LetIn<'r>>,
    /// Messages by their ids on the network; several relays of a domain may each send one.
    sent: HashMap<MessageKey, Vec<Sent<'r>>>,
    taken: Vec<Take<'r>>,
    /// The subscriptions of relays.
    of_mirrors: HashSet<(Place, ObjectId)>,
}

struct LetIn<'r> {
    network: MessageKey,
    place: Place,
    received: Option<At>,
    topic: &'r str,
}

struct Sent<'r> {
    message: MessageKey,
    at: At,
    taken: Option<At>,
    topic: &'r str,
}

struct Take<'r> {
    message: MessageKey,
    at: At,
    subscription: ObjectId,
    topic: &'r str,
}

impl<'r> Ways<'r> {
    pub fn of(recordings: &'r [Recording]) -> Self {
        let mut ways = Ways::default();
        recordings.iter().enumerate().for_each(|(index, recording)| ways.add(index, recording));
        ways
    }

    fn add(&mut self, index: usize, recording: &'r Recording) {
        let mut received: HashMap<(u32, MessageKey), At> = HashMap::new();
        let mut taken: HashMap<(u32, MessageKey), (At, ObjectId)> = HashMap::new();
        for timed in &recording.events {
            let (event, process) = (timed.event, timed.process);
            let place = Place { recording: index, process };
            let at = At { place, time_ns: event.time_ns };
            let object = recording.object(process, event.object);
            let topic = object.map_or("", |object| &*object.name);
            let message = key(event.arguments);
            match event.kind {
                EventKind::Publish => drop(self.published.insert(message, (at, topic))),
                EventKind::Take => {
                    taken.insert((process, message), (at, event.object));
                    self.taken.push(Take { message, at, subscription: event.object, topic });
                }
                EventKind::Receive => drop(received.insert((process, message), at)),
                EventKind::Pass => {
                    // Without this event the message's path is unknown; the user is warned.
                    let Some(through) = object else { continue };
                    let [sequence_number, from_number, from_publisher] = event.arguments;
                    let from = MessageKey { publisher: from_publisher, sequence_number: from_number };
                    let to = MessageKey { publisher: gid_key(through.gid), sequence_number };
                    if through.kind == ObjectKind::Sender {
                        let taken = taken.get(&(process, from));
                        self.of_mirrors.extend(taken.map(|(_, subscription)| (place, *subscription)));
                        let taken = taken.map(|(at, _)| *at);
                        self.sent.entry(to).or_default().push(Sent { message: from, at, taken, topic });
                    } else {
                        let received = received.remove(&(process, from));
                        self.let_in.insert(to, LetIn { network: from, place, received, topic });
                    }
                }
                _ => {}
            }
        }
    }

    /// The sending of a received message: the last one before its reception, as far as `is_before` knows. A sender that does not number its
    /// messages gives all of them 0, so that they cannot be told apart.
    fn sending(&self, let_in: &LetIn<'_>, is_before: &impl Fn(At, At) -> bool) -> Option<&Sent<'r>> {
        let sent = self.sent.get(&let_in.network).filter(|_| let_in.network.sequence_number != 0)?;
        let before = |sent: &&Sent<'_>| let_in.received.is_none_or(|received| is_before(sent.at, received));
        sent.iter().rfind(before).or(sent.first())
    }

    /// The number of domains that a message passed before, its first known id, and its topic there.
    fn source(
        &self,
        message: MessageKey,
        here: &'r str,
        is_before: &impl Fn(At, At) -> bool,
    ) -> (usize, MessageKey, &'r str) {
        let (mut first, mut topic) = (message, here);
        for domains in 0..MAX_DOMAINS {
            topic = self.published.get(&first).map_or(topic, |(_, topic)| topic);
            let sent = self.let_in.get(&first).and_then(|let_in| self.sending(let_in, is_before));
            match sent {
                Some(sent) => (first, topic) = (sent.message, sent.topic),
                None => return (domains, first, topic),
            }
        }
        (MAX_DOMAINS, first, topic)
    }

    /// Passes every hop of every message to `sink`. `is_before` returns whether the first event is known to precede the second.
    pub fn hops(&self, is_before: &impl Fn(At, At) -> bool, sink: &mut impl FnMut(Hop<'r>)) {
        for take in &self.taken {
            // A relay's subscription takes the messages that the relay itself publishes, and ignores them.
            if self.let_in.get(&take.message).is_some_and(|let_in| let_in.place == take.at.place) {
                continue;
            }
            let (domains_before, first, topic) = self.source(take.message, take.topic, is_before);
            let published = |message| self.published.get(message).map(|(at, _)| *at);
            let (from, to) = (published(&take.message), take.at);
            sink(Hop { topic, domains_before, kind: HopKind::PublishToTake, from, to });
            // A message that entered the first known domain through a relay began its path elsewhere.
            let is_whole = domains_before > 0 && !self.let_in.contains_key(&first);
            if is_whole && !self.of_mirrors.contains(&(to.place, take.subscription)) {
                sink(Hop { topic, domains_before, kind: HopKind::WholeWay, from: published(&first), to });
            }
        }
        for sent in self.sent.values().flatten() {
            let (domains_before, _, topic) = self.source(sent.message, sent.topic, is_before);
            sink(Hop { topic, domains_before, kind: HopKind::TakeToSend, from: sent.taken, to: sent.at });
        }
        for (message, let_in) in &self.let_in {
            let (domains_before, _, topic) = self.source(*message, let_in.topic, is_before);
            if let Some((to, _)) = self.published.get(message) {
                let (from, kind) = (let_in.received, HopKind::ReceiveToPublish);
                sink(Hop { topic, domains_before, kind, from, to: *to });
            }
            if let Some(to) = let_in.received {
                let sent = self.sending(let_in, is_before);
                let (from, kind) = (sent.map(|sent| sent.at), HopKind::SendToReceive);
                sink(Hop { topic, domains_before: domains_before.saturating_sub(1), kind, from, to });
            }
        }
    }
}
