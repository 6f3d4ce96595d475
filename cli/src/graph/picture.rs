// SPDX-License-Identifier: MIT OR Apache-2.0
//! The content of a drawing, independent of its format: nodes, topics and the edges between them.

use crate::table::{count, ms};

/// A domain, or a part of it.
#[derive(Clone, Debug, Default)]
pub struct Picture {
    pub domain: u32,
    /// The time over which rates were measured; `None` without rates.
    pub seconds: Option<f64>,
    pub nodes: Vec<Node>,
    /// Topics, and services and actions if they are drawn.
    pub topics: Vec<Topic>,
    pub edges: Vec<Edge>,
    pub mismatches: Vec<Mismatch>,
    /// Chains of the system file.
    pub chains: Vec<Chain>,
    /// The number of omitted topics, services and actions, which every node has or which are parts of an action.
    pub left_out: usize,
}

/// A node, or a group of endpoints without a node.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Node {
    /// `None` if these endpoints were created without a node.
    pub name: Option<String>,
    /// Its process, if it is on this host.
    pub pid: Option<u32>,
    /// Its place, if it is on another host.
    pub place: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TopicKind {
    Topic,
    Service,
    Action,
}

tautline_rt::names!(TopicKind: pub const fn word(self) -> &'static str {
    Topic: "topic", Service: "service", Action: "action",
});

#[derive(Clone, Debug)]
pub struct Topic {
    pub kind: TopicKind,
    pub name: String,
    /// More than one if its endpoints disagree.
    pub types: Vec<String>,
    pub rate: Rate,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rate {
    /// Not counted, or nothing to count.
    None,
    /// Unknown, because some publishers are on other hosts or have just appeared.
    Unknown,
    Hz(f64),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EdgeKind {
    Publishes,
    Subscribes,
    /// A client sends requests.
    Asks,
    /// A server responds.
    Serves,
}

tautline_rt::names!(EdgeKind: pub const fn word(self) -> &'static str {
    Publishes: "publisher", Subscribes: "subscription", Asks: "client", Serves: "server",
});

/// A connection between a node and a topic, a service or an action, by their indices.
#[derive(Clone, Debug)]
pub struct Edge {
    pub kind: EdgeKind,
    pub node: usize,
    pub topic: usize,
    /// The number of equal endpoints.
    pub count: usize,
    /// The quality of service; empty for services.
    pub qos: String,
    pub rate: Rate,
    /// Why publishers of the topic do not reach this subscription, in a few words.
    pub problem: Option<String>,
    /// The bounds of the node's callbacks that the topic triggers, from the system file.
    pub bound: Option<Bound>,
}

/// Incompatible publishers and subscriptions.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Mismatch {
    pub topic: String,
    pub publisher: String,
    pub subscription: String,
    pub reason: String,
}

/// The bound of the slowest of these callbacks.
#[derive(Clone, Debug)]
pub struct Bound {
    pub callbacks: Vec<String>,
    pub response_ns: Option<u64>,
    pub deadline_ns: u64,
    pub met: bool,
}

#[derive(Clone, Debug)]
pub struct Chain {
    pub name: String,
    pub latency_ns: Option<u64>,
    pub deadline_ns: u64,
    pub met: bool,
}

impl Node {
    pub fn label(&self) -> &str {
        self.name.as_deref().unwrap_or("(no node)")
    }

    /// Its process, or its place on another host.
    pub fn whereabouts(&self) -> String {
        match (self.pid, &self.place) {
            (Some(pid), _) => format!("pid {pid}"),
            (None, place) => format!("on {}", place.as_deref().unwrap_or("this host")),
        }
    }

    /// Its name, and the text below.
    pub fn text(&self) -> Vec<String> {
        vec![self.label().to_owned(), self.whereabouts()]
    }
}

impl Topic {
    /// Its name, and the text below.
    pub fn text(&self) -> Vec<String> {
        [vec![self.name.clone()], self.lines()].concat()
    }

    /// The text below its name.
    pub fn lines(&self) -> Vec<String> {
        let types = self.types.join(" and ");
        let types =
            if self.kind == TopicKind::Topic { types } else { format!("{} {types}", self.kind.word()) };
        [Some(types), self.rate.text()].into_iter().flatten().collect()
    }
}

impl Rate {
    pub fn text(self) -> Option<String> {
        match self {
            Rate::None => None,
            Rate::Unknown => Some("? Hz".into()),
            Rate::Hz(hz) if hz >= 10_000.0 => Some(format!("{:.1} kHz", hz / 1e3)),
            Rate::Hz(hz) => Some(format!("{hz:.1} Hz")),
        }
    }

    /// The sum of two rates.
    pub fn plus(self, other: Rate) -> Rate {
        match (self, other) {
            (Rate::None, rate) | (rate, Rate::None) => rate,
            (Rate::Hz(one), Rate::Hz(other)) => Rate::Hz(one + other),
            _ => Rate::Unknown,
        }
    }
}

impl Edge {
    /// The node's end and the topic's end in the direction of messages, or of requests.
    pub fn directed<T>(&self, node: T, topic: T) -> (T, T) {
        match self.kind {
            EdgeKind::Subscribes | EdgeKind::Serves => (topic, node),
            EdgeKind::Publishes | EdgeKind::Asks => (node, topic),
        }
    }

    /// Whether it belongs to a service or an action.
    pub fn is_service(&self) -> bool {
        matches!(self.kind, EdgeKind::Asks | EdgeKind::Serves)
    }

    pub fn is_bad(&self) -> bool {
        self.problem.is_some() || self.bound.as_ref().is_some_and(|bound| !bound.met)
    }

    pub fn lines(&self) -> Vec<String> {
        let count = (self.count > 1).then(|| format!("{} {}s", self.count, self.kind.word()));
        [count, self.problem.clone(), self.bound.as_ref().map(Bound::text)].into_iter().flatten().collect()
    }
}

impl Bound {
    pub fn text(&self) -> String {
        bound_text(self.response_ns, self.deadline_ns, self.met)
    }
}

/// A bound as text; with the deadline if that is missed.
fn bound_text(ns: Option<u64>, deadline_ns: u64, met: bool) -> String {
    match ns {
        None => "no bound".into(),
        Some(_) if met => format!("≤ {} ms", ms(ns)),
        Some(_) => format!("≤ {} ms, deadline {} ms", ms(ns), ms(Some(deadline_ns))),
    }
}

impl Picture {
    /// The lines above the picture, each with whether it is free of faults.
    pub fn caption(&self) -> Vec<(bool, String)> {
        let of = |kind| self.topics.iter().filter(|topic| topic.kind == kind).count();
        let mut first = format!(
            "Domain {}: {}, {}",
            self.domain,
            count(self.nodes.iter().filter(|node| node.name.is_some()).count(), "node"),
            count(of(TopicKind::Topic), "topic")
        );
        for kind in [TopicKind::Service, TopicKind::Action] {
            if of(kind) > 0 {
                first.push_str(&format!(", {}", count(of(kind), kind.word())));
            }
        }
        if let Some(seconds) = self.seconds {
            first.push_str(&format!("; rates of {seconds:.1} s"));
        }
        if self.left_out > 0 {
            first.push_str(&format!("; {} left out, --all shows them", self.left_out));
        }
        let chain = |chain: &Chain| {
            let bound = bound_text(chain.latency_ns, chain.deadline_ns, chain.met);
            let latency = if chain.latency_ns.is_some() { "latency " } else { "" };
            (chain.met, format!("Chain {}: {latency}{bound}", chain.name))
        };
        let mismatch = |found: &Mismatch| {
            let Mismatch { topic, publisher, subscription, reason } = found;
            (false, format!("{topic}: no message gets from {publisher} to {subscription}: {reason}"))
        };
        let chains = self.chains.iter().map(chain);
        std::iter::once((true, first)).chain(chains).chain(self.mismatches.iter().map(mismatch)).collect()
    }
}

/// One line of text, without control characters and characters that change the direction of text.
pub fn clean(text: &str) -> String {
    let is_kept = |c: char| {
        !c.is_control()
            && !matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{fffe}' | '\u{ffff}')
    };
    text.chars().map(|c| if is_kept(c) { c } else { '\u{fffd}' }).collect()
}
