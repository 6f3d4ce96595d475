// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long verbs take to answer in a domain with a thousand topics, from the start of the process to its end.

use crate::{DOMAIN, Result, Taut};
use std::process::Stdio;
use tautline_harness::Distribution;
use tautline_harness::readings::Reading;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Limits, Participant, Qos, ServiceType, TopicType};

const TOPICS: usize = 1000;
const NODES: usize = 50;
/// What a shell asks at the tab key.
const TAB: &str = "the tab key";
/// Of whose answers the median, which a busy machine changes least, is at most so many ms.
const GOALS_MS: [(&str, f64); 2] = [("a list", 20.0), (TAB, 100.0)];
/// The first one is the floor: a start that looks at nothing. The second one looks twice at every publisher's counts.
const VERBS: [(&str, &[&str]); 11] = [
    ("a start", &["--version"]),
    ("a start", &["top", "--once", "--json", "--every", "1ms"]),
    ("a list", &["topic", "list"]),
    ("a list", &["topic", "info", "/topic7", "-v"]),
    ("a list", &["node", "list"]),
    ("a list", &["service", "list"]),
    ("a list", &["action", "list"]),
    ("a list", &["lifecycle", "nodes"]),
    (TAB, &["--", "taut", "topic", "echo", "/topic7"]),
    (TAB, &["--", "taut", "node", "info", "/bench/"]),
    (TAB, &["--", "taut", "topic", "pub", "/topic7", ""]),
];

pub fn measure(taut: &Taut, quick: bool) -> Result<Vec<Reading>> {
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
    let unfit = cfg!(debug_assertions).then_some("what is not optimised says nothing of how long verbs take");
    let mut readings = Vec::new();
    for (experiment, verb) in VERBS {
        let mut times = Distribution::new();
        for _ in 0..if quick { 20 } else { 200 } {
            let before_ns = monotonic_ns();
            let mut command = taut.command(verb);
            if experiment == TAB {
                command.env("COMPLETE", "bash");
            }
            let status = command.stdout(Stdio::null()).status()?;
            times.record(monotonic_ns() - before_ns);
            if !status.success() {
                return Err(format!("taut {} has failed", verb.join(" ")).into());
            }
        }
        let what = verb.strip_prefix(&["--"]).unwrap_or(verb).join(" ");
        let goal_ms = GOALS_MS.iter().find(|(of, _)| *of == experiment).map(|(_, ms)| *ms);
        let one = Reading::of(experiment, TOPICS, what, "ms").times_in(&times, 1e3);
        readings.push(one.at_most(goal_ms).unfit(unfit));
    }
    Ok(readings)
}
