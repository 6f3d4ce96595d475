// SPDX-License-Identifier: MIT OR Apache-2.0
//! What a join keeps, and which sets the synchronizers' own policies make of it.

use std::time::Duration;

use rand::RngExt;
use rand::rngs::StdRng;
use tautline_join::{ApproximateEpsilonTime, ApproximateTime, Arrival, ExactTime, LatestTime, Policy};

use super::machine::{Message, Tag};
use super::made_up::{Matching, Model};

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
    activation: u64,
    pub waits: Vec<u64>,
    pub most: usize,
}

pub struct Set {
    pub activation: u64,
    pub stamp: u64,
    pub tags: Vec<Tag>,
}

impl Waiting {
    pub fn new(model: &Model, callback: usize, size: usize, rng: &mut StdRng) -> Option<Waiting> {
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
                let penalty = if rng.random_bool(0.5) { 0.1 } else { rng.random_range(0.0..2.0) };
                started(Box::new(policy.age_penalty(penalty)))
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
            activation: 0,
            waits: vec![0; count],
            most: 0,
        })
    }

    /// A message has come, and is still to be taken.
    pub fn came(&mut self, message: &Message) {
        self.missing.retain(|way| *way != message.way);
        if self.missing.is_empty() {
            self.since = self.since.or(Some(message.base));
        }
    }

    /// The sets that a message completes, which is taken now.
    pub fn take(&mut self, model: &Model, message: &Message, now: u64) -> Vec<Set> {
        let input = self.topics.iter().position(|topic| *topic == message.topic).unwrap_or(0);
        self.activation = self.activation.max(message.base);
        let sets = self.decide(input, message.clone(), now);
        self.most = self.queues.iter().map(Vec::len).max().unwrap_or(0).max(self.most);
        sets.into_iter().map(|set| self.pass_on(model, &set)).collect()
    }

    fn decide(&mut self, input: usize, message: Message, now: u64) -> Vec<Vec<Message>> {
        let queues = &mut self.queues;
        let take = |queues: &mut Vec<Vec<Message>>| queues.iter_mut().map(|queue| queue.remove(0)).collect();
        let is_full = |queues: &[Vec<Message>]| queues.iter().all(|queue| !queue.is_empty());
        let stamp = message.stamp as i64;
        let policy = match &mut self.decider {
            Decider::Newest => {
                queues[input] = vec![message];
                return if is_full(queues) { vec![take(queues)] } else { Vec::new() };
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
            Arrival::Refuse => return Vec::new(),
        }
        let mut sets = Vec::new();
        while policy.decide(&mut |input| drop(queues[input].remove(0))) {
            sets.push(take(queues));
        }
        sets
    }

    fn pass_on(&mut self, model: &Model, set: &[Message]) -> Set {
        let activation = self.activation;
        for (wait, message) in self.waits.iter_mut().zip(set) {
            if self.since.is_some_and(|since| message.base >= since) {
                *wait = (activation - message.base).max(*wait);
            }
        }
        let tag = |chain: usize| set.iter().find_map(|message| message.tags[chain]);
        let tags = (0..model.chains.len()).map(tag).collect();
        Set { activation, stamp: set[0].stamp, tags }
    }
}
