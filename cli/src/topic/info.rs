// SPDX-License-Identifier: MIT OR Apache-2.0
//! `taut topic list` and `taut topic info`: the publishers and subscriptions of topics, on this host and on others.

use crate::table::{place, places, write_table};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::time::Duration;
use tautline_transport::{
    Durability, EndpointKind, GraphSnapshot, History, Liveliness, Qos, Reliability, TopicEndpoint,
};

/// A topic of one type, and its endpoints.
pub struct Topic<'g> {
    pub name: &'g str,
    pub type_name: &'g str,
    ends: Vec<&'g TopicEndpoint>,
}

/// Groups endpoints by name and type. Endpoints of one name and different types are not connected.
pub fn topics(graph: &GraphSnapshot) -> Vec<Topic<'_>> {
    let mut found: BTreeMap<(&str, &str), Vec<_>> = BTreeMap::new();
    for end in &graph.endpoints {
        found.entry((&end.topic, &end.topic_type.name)).or_default().push(&**end);
    }
    found.into_iter().map(|((name, type_name), ends)| Topic { name, type_name, ends }).collect()
}

/// Prints the topics, one on each line.
pub fn list(topics: &[Topic<'_>], json: bool, out: &mut impl Write) -> io::Result<()> {
    if json {
        return writeln!(out, "{}", Value::from_iter(topics.iter().map(Topic::to_json)));
    }
    let head = ["topic", "type", "where", "publishers", "subscriptions"];
    write_table(&head, 3, topics.iter().map(Topic::row).collect(), out)
}

impl<'g> Topic<'g> {
    fn of(&self, kind: EndpointKind) -> impl Iterator<Item = &'g TopicEndpoint> {
        self.ends.iter().copied().filter(move |end| end.kind == kind)
    }

    fn hash(&self) -> Option<&str> {
        self.ends.iter().find_map(|end| end.topic_type.hash.as_deref())
    }

    fn row(&self) -> (bool, Vec<String>) {
        let places = places(self.ends.iter().map(|end| &end.origin));
        let counts = [EndpointKind::Publisher, EndpointKind::Subscription]
            .map(|kind| self.of(kind).count().to_string());
        (true, [vec![self.name.into(), self.type_name.into(), places], counts.to_vec()].concat())
    }

    fn to_json(&self) -> Value {
        let remote = |kind| self.of(kind).filter(|end| end.is_remote).count();
        let places: BTreeSet<_> = self.ends.iter().filter_map(|end| place(&end.origin)).collect();
        json!({
            "topic": self.name,
            "type": self.type_name,
            "hash": self.hash(),
            "publishers": self.of(EndpointKind::Publisher).count(),
            "subscriptions": self.of(EndpointKind::Subscription).count(),
            "remote_publishers": remote(EndpointKind::Publisher),
            "remote_subscriptions": remote(EndpointKind::Subscription),
            "places": places,
        })
    }

    /// The endpoints of a topic, with the node and the QoS of each.
    pub fn info_json(&self) -> Value {
        let ends = |kind| self.of(kind).map(end_json).collect::<Value>();
        json!({
            "topic": self.name,
            "type": self.type_name,
            "hash": self.hash(),
            "publishers": ends(EndpointKind::Publisher),
            "subscriptions": ends(EndpointKind::Subscription),
        })
    }

    /// Prints in the format of `ros2 topic info`.
    pub fn print(&self, verbose: bool, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "Type: {}", self.type_name)?;
        let kinds = [("Publisher", EndpointKind::Publisher), ("Subscription", EndpointKind::Subscription)];
        for (what, kind) in kinds {
            let count = self.of(kind).count();
            let remote = self.of(kind).filter(|end| end.is_remote).count();
            let there = if remote > 0 { format!(", {remote} elsewhere") } else { String::new() };
            if verbose {
                writeln!(out)?;
            }
            writeln!(out, "{what} count: {count}{there}")?;
            if verbose {
                self.of(kind).try_for_each(|end| print_end(end, out))?;
            }
        }
        Ok(())
    }
}

fn print_end(end: &TopicEndpoint, out: &mut impl Write) -> io::Result<()> {
    let [reliability, history, durability, liveliness] = words(&end.qos);
    let node = end.node.as_ref();
    let (name, namespace) = node.map_or(("(none)", "(none)"), |node| (&*node.name, &*node.namespace));
    writeln!(out, "\nNode name: {name}\nNode namespace: {namespace}")?;
    match (end.pid, place(&end.origin)) {
        (Some(pid), _) => writeln!(out, "Process: {pid}")?,
        (None, Some(place)) => writeln!(out, "Process: on {place}")?,
        (None, None) => {}
    }
    writeln!(out, "Topic type: {}", end.topic_type.name)?;
    writeln!(out, "Topic type hash: {}", end.topic_type.hash.as_deref().unwrap_or("unknown"))?;
    writeln!(out, "GID: {:?}\nQoS profile:", end.gid)?;
    writeln!(out, "  Reliability: {reliability}\n  History (Depth): {history} ({})", end.qos.depth)?;
    writeln!(out, "  Durability: {durability}\n  Deadline: {}", duration(end.qos.deadline))?;
    writeln!(out, "  Lifespan: {}\n  Liveliness: {liveliness}", duration(end.qos.lifespan))?;
    writeln!(out, "  Liveliness lease duration: {}", duration(end.qos.liveliness_lease_duration))
}

fn end_json(end: &TopicEndpoint) -> Value {
    let [reliability, history, durability, liveliness] = words(&end.qos);
    let ns = |duration: Option<Duration>| duration.map(|duration| duration.as_nanos() as u64);
    json!({
        "node": end.node.as_ref().map(|node| node.full_name()),
        "pid": end.pid,
        "remote": end.is_remote,
        "place": place(&end.origin),
        "gid": format!("{:?}", end.gid),
        "hash": end.topic_type.hash,
        "qos": {
            "reliability": reliability,
            "history": history,
            "depth": end.qos.depth,
            "durability": durability,
            "deadline_ns": ns(end.qos.deadline),
            "lifespan_ns": ns(end.qos.lifespan),
            "liveliness": liveliness,
            "liveliness_lease_ns": ns(end.qos.liveliness_lease_duration),
        },
    })
}

/// Reliability, history, durability and liveliness in the words of ROS 2's tools.
fn words(qos: &Qos) -> [&'static str; 4] {
    let reliability = match qos.reliability {
        Reliability::Reliable => "RELIABLE",
        Reliability::BestEffort => "BEST_EFFORT",
    };
    let history = match qos.history {
        History::KeepLast => "KEEP_LAST",
        History::KeepAll => "KEEP_ALL",
    };
    let durability = match qos.durability {
        Durability::Volatile => "VOLATILE",
        Durability::TransientLocal => "TRANSIENT_LOCAL",
    };
    let liveliness = match qos.liveliness {
        Liveliness::Automatic => "AUTOMATIC",
        Liveliness::ManualByTopic => "MANUAL_BY_TOPIC",
    };
    [reliability, history, durability, liveliness]
}

/// The QoS in one line.
pub fn qos_line(qos: &Qos) -> String {
    let [reliability, history, durability, _] = words(qos);
    let depth = if qos.history == History::KeepLast { format!(" {}", qos.depth) } else { String::new() };
    let deadline = qos.deadline.map_or_else(String::new, |deadline| format!(", deadline {deadline:?}"));
    format!("{reliability}, {durability}, {history}{depth}{deadline}")
}

fn duration(duration: Option<Duration>) -> String {
    duration.map_or("Infinite".into(), |duration| format!("{duration:?}"))
}
