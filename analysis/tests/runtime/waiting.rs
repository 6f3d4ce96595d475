// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a join keeps, and which sets the synchronizers' own policies make of it.

use std::time::Duration;

use tautline_join::{ApproximateEpsilonTime, ApproximateTime, Arrival, ExactTime, LatestTime, Policy};

use super::machine::{Message, Tag};
use super::made_up::{Matching, Model, age_penalty};

enum Decider {
    Newest,
    Rates(Box<LatestTime>),
    Stamps(Box<dyn Policy>),
}

pub struct Waiting {
    decider: Decider,
    topics: Vec<usize>,
    queues: Vec<Vec<Message>>,
    /// By which ways nothing has come yet.
    missing: Vec<u64>,
    /// From when all send.
    pub since: Option<u64>,
    /// When the last of all messages that it took had come.
    latest: u64,
    /// Of each topic, when the first message had come since the last set.
    firsts: Vec<Option<u64>>,
    /// The topic whose turn is next.
    turn: usize,
    pub waits: Vec<u64>,
    pub most: usize,
    /// Of each topic: how many it dropped, and how many it refused.
    pub unused: Vec<[u64; 2]>,
}

pub struct Set {
    pub activation: u64,
    pub stamp: u64,
    pub numbers: Vec<u64>,
    pub tags: Vec<Tag>,
}

impl Waiting {
    pub fn new(model: &Model, callback: usize, size: usize) -> Option<Waiting> {
        let (matching, _) = model.callbacks[callback].join?;
        let topics = model.callbacks[callback].triggers.clone();
        let started = |mut policy: Box<dyn Policy>| {
            policy.start(topics.len());
            Decider::Stamps(policy)
        };
        let decider = match matching {
            Matching::Newest => Decider::Newest,
            Matching::LatestTime => Decider::Rates(Box::default()),
            Matching::Exact => started(Box::new(ExactTime::new(size))),
            Matching::Approximate(window) => {
                let policy = ApproximateTime::new(size).max_interval(Duration::from_nanos(window));
                started(Box::new(policy.age_penalty(age_penalty(window))))
            }
            Matching::Epsilon(window) => {
                started(Box::new(ApproximateEpsilonTime::new(size, Duration::from_nanos(window))))
            }
        };
        let count = topics.len();
        Some(Waiting {
            decider,
            topics,
            queues: vec![Vec::new(); count],
            missing: model.taken(callback),
            since: None,
            latest: 0,
            firsts: vec![None; count],
            turn: 0,
            waits: vec![0; count],
            most: 0,
            unused: vec![[0; 2]; count],
        })
    }

    /// A message has come, and is still to be taken.
    pub fn came(&mut self, message: &Message) {
        self.missing.retain(|way| *way != message.way);
        if self.missing.is_empty() {
            self.since = self.since.or(Some(message.base));
        }
    }

    /// Which topic it takes a message of next, of those that have one: all in turn.
    pub fn turn(&self, has: impl Fn(usize) -> bool) -> usize {
        let mut topics = self.topics.iter().cycle().skip(self.turn).take(self.topics.len());
        *topics.find(|topic| has(**topic)).unwrap_or(&self.topics[0])
    }

    /// The sets that a message completes, which is taken now; with `more`, of the newest of each.
    pub fn take(&mut self, model: &Model, message: &Message, more: &[Message], now: u64) -> Vec<Set> {
        let mut found = Vec::new();
        for message in [message].into_iter().chain(more) {
            let input = self.topics.iter().position(|topic| *topic == message.topic).unwrap_or(0);
            self.turn = input + 1;
            self.latest = self.latest.max(message.base);
            self.firsts[input] = self.firsts[input].or(Some(message.base));
            found = self.decide(input, message.clone(), now);
        }
        self.most = self.queues.iter().map(Vec::len).max().unwrap_or(0).max(self.most);
        found.into_iter().map(|set| self.pass_on(model, message.base, &set)).collect()
    }

    fn decide(&mut self, input: usize, message: Message, now: u64) -> Vec<Vec<Message>> {
        let queues = &mut self.queues;
        let take = |queues: &mut Vec<Vec<Message>>| queues.iter_mut().map(|queue| queue.remove(0)).collect();
        let is_full = |queues: &[Vec<Message>]| queues.iter().all(|queue| !queue.is_empty());
        let stamp = message.stamp as i64;
        let policy = match &mut self.decider {
            Decider::Newest => {
                self.unused[input][0] += queues[input].len() as u64;
                queues[input] = vec![message];
                return if is_full(queues) { vec![queues.concat()] } else { Vec::new() };
            }
            Decider::Rates(policy) => {
                queues[input] = vec![message];
                let is_pace = policy.arrived(input, now as i64);
                return if is_pace && is_full(queues) { vec![queues.concat()] } else { Vec::new() };
            }
            Decider::Stamps(policy) => policy,
        };
        match policy.arrived(input, stamp) {
            Arrival::Wait(place) | Arrival::WaitTooClose(place) => queues[input].insert(place, message),
            Arrival::Refuse => {
                self.unused[input][1] += 1;
                return Vec::new();
            }
        }
        let mut sets = Vec::new();
        let unused = &mut self.unused;
        while policy.decide(&mut |input| {
            unused[input][0] += 1;
            queues[input].remove(0);
        }) {
            sets.push(take(queues));
        }
        sets
    }

    /// `last` had come when the message did that completes it. What others of no use here took longer to come is part of the thread's response.
    fn pass_on(&mut self, model: &Model, last: u64, set: &[Message]) -> Set {
        let (activation, response_from) = match self.decider {
            Decider::Newest => {
                self.queues.iter_mut().for_each(Vec::clear);
                let firsts = self.firsts.iter_mut().filter_map(Option::take);
                let activation = firsts.max().unwrap_or(last);
                (activation, activation)
            }
            Decider::Rates(_) => (last, last),
            Decider::Stamps(_) => {
                (set.iter().map(|message| message.base).max().unwrap_or(0).max(last), self.latest)
            }
        };
        for (wait, message) in self.waits.iter_mut().zip(set) {
            if self.since.is_some_and(|since| message.base >= since) {
                *wait = activation.saturating_sub(message.base).max(*wait);
            }
        }
        let tag = |chain: usize| set.iter().find_map(|message| message.tags[chain]);
        let tags = (0..model.chains.len()).map(tag).collect();
        let numbers = set.iter().map(|message| message.number).collect();
        Set { activation: response_from, stamp: set[0].stamp, numbers, tags }
    }
}
