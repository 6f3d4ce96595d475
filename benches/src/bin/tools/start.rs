// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long verbs take to answer in a domain with a thousand topics, from the start of the process to its end.

use crate::{DOMAIN, Result, Taut};
use serde::Serialize;
use std::process::Stdio;
use tautline_benches::cells;
use tautline_benches::rows::extent;
use tautline_benches::table::Column::{Number, Words};
use tautline_benches::table::Table;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Limits, Participant, Qos, ServiceType, TopicType};

const TOPICS: usize = 1000;
const NODES: usize = 50;
/// How long a list may take: the median, which a busy machine changes least.
const MOST_MS: f64 = 20.0;

/// The first one is the floor: a start that looks at nothing. The last one is no list, and has no limit: it looks twice at every publisher's counts.
const VERBS: [&[&str]; 8] = [
    &["--version"],
    &["topic", "list"],
    &["topic", "info", "/topic7", "-v"],
    &["node", "list"],
    &["service", "list"],
    &["action", "list"],
    &["lifecycle", "nodes"],
    &["top", "--once", "--json", "--every", "1ms"],
];
/// What a shell asks at the tab key.
const COMPLETED: [&[&str]; 3] = [
    &["--", "taut", "topic", "echo", "/topic7"],
    &["--", "taut", "node", "info", "/bench/"],
    &["--", "taut", "topic", "pub", "/topic7", ""],
];
/// How long that may take.
const MOST_COMPLETED_MS: f64 = 100.0;

#[derive(Serialize)]
pub struct Start {
    verb: String,
    n: usize,
    p50_ms: f64,
    max_ms: f64,
}

/// Prints the times, and adds what does not hold to `broken`.
pub fn measure(taut: &Taut, quick: bool, broken: &mut Vec<String>) -> Result<Vec<Start>> {
    let participant = Participant::new(DOMAIN)?;
    let (small, topic_type) =
        (Limits { message_bytes: 64, ..Limits::default() }, TopicType::new("bench_msgs/msg/Small"));
    let service_type = ServiceType {
        request: TopicType::new("bench_msgs/srv/Ask"),
        response: TopicType::new("bench_msgs/srv/Ask"),
    };
    let (mut ends, mut servers) = (Vec::new(), Vec::new());
    for node in 0..NODES {
        let name = format!("node{node}");
        let owner = participant.create_node(&name, "/bench")?;
        let of_node = participant.for_node(&owner);
        for topic in (node..TOPICS).step_by(NODES) {
            let (topic, qos) = (format!("/topic{topic}"), Qos::keep_last(1));
            ends.push(of_node.create_raw_publisher(&topic, &topic_type, qos, small)?);
        }
        servers.push(of_node.create_raw_server(&format!("/bench/{name}/ask"), &service_type, 1, small)?);
    }
    println!("\nfrom start to end of a verb, in ms: {TOPICS} topics, {NODES} nodes, {NODES} services\n");
    let mut table = Table::new(0, [Words("taut"), Number("n"), Number("p50"), Number("max")]);
    let mut all = Vec::new();
    for verb in VERBS.into_iter().chain(COMPLETED) {
        let n = if quick { 20 } else { 200 };
        let mut times = Vec::new();
        for _ in 0..n {
            let before_ns = monotonic_ns();
            let mut command = taut.command(verb);
            if verb[0] == "--" {
                command.env("COMPLETE", "bash");
            }
            let status = command.stdout(Stdio::null()).status()?;
            times.push((monotonic_ns() - before_ns) as f64 / 1e6);
            if !status.success() {
                return Err(format!("taut {} has failed", verb.join(" ")).into());
            }
        }
        let verb = if verb[0] == "--" { format!("tab: {}", verb[1..].join(" ")) } else { verb.join(" ") };
        let [_, p50_ms, max_ms] = extent(times);
        table.add(cells![&verb, n, format!("{p50_ms:.2}"), format!("{max_ms:.2}")]);
        all.push(Start { verb, n, p50_ms, max_ms });
    }
    println!("{table}");
    let lists = all[..VERBS.len() - 1].iter().map(|start| (start, MOST_MS));
    let completed = all[VERBS.len()..].iter().map(|start| (start, MOST_COMPLETED_MS));
    for (Start { verb, p50_ms, .. }, most) in lists.chain(completed) {
        // What is not optimised says nothing of how long verbs take.
        if !cfg!(debug_assertions) && *p50_ms > most {
            broken.push(format!("taut {verb} takes {p50_ms:.1} ms, {most} at most"));
        }
    }
    Ok(all)
}
