// SPDX-License-Identifier: MIT OR Apache-2.0
//! Checks the domain as a newcomer: reads the graph, joins, creates topics, receives messages as a late joiner.

use crate::Result;
use crate::process::{PATIENCE, Said, answer, say, told};
use crate::survivors::{KEPT, KEPT_DEPTH, KEPT_PERIOD, PING, PONG};
use serde::{Deserialize, Serialize};
use std::thread;
use std::time::{Duration, Instant};
use tautline::std_msgs::msg::UInt64;
use tautline::{Context, Limits};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Participant, Qos, Subscription, graph_of};

/// The graph as a visitor reads it.
#[derive(Debug, Serialize, Deserialize)]
pub struct Graph {
    pub took: Duration,
    pub nodes: usize,
    pub ends: usize,
    /// Nodes and endpoints of the requested process.
    pub of_process: usize,
}

/// The times that a new participant took from its start to each step, until it had created a topic and received an answer.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Met {
    pub joined: Duration,
    pub made: Duration,
    pub matched: Duration,
    pub answered: Duration,
}

/// The messages that a late joiner received.
#[derive(Debug, Serialize, Deserialize)]
pub struct Late {
    pub took: Duration,
    /// Received messages that were published before it began to join.
    pub kept: usize,
    /// The minimum of messages that it had to receive.
    pub expected: usize,
    pub lost: u64,
    /// Sequence numbers that are missing between the received ones.
    pub missing: u64,
}

pub fn play() -> Result<()> {
    let domain = Context::domain_of_environment()?;
    say(&Said::Ready);
    for command in told() {
        let (what, argument) = command.split_once(' ').unwrap_or((&command, ""));
        let answered = match what {
            "graph" => graph(domain, argument.parse().unwrap_or(0)).map(|graph| answer(&graph)),
            "meet" => meet(domain).map(|met| answer(&met)),
            "late" => late(domain).map(|late| answer(&late)),
            _ => Err(format!("it is told '{command}'").into()),
        };
        if let Err(error) = answered {
            say(&Said::Failed(error.to_string()));
        }
    }
    Ok(())
}

fn graph(domain: u32, pid: u32) -> Result<Graph> {
    let start = Instant::now();
    let graph = graph_of(domain)?;
    let took = start.elapsed();
    let is_of = |of: Option<u32>| usize::from(of == Some(pid));
    let of_process = graph.nodes.iter().map(|node| is_of(node.pid)).sum::<usize>()
        + graph.endpoints.iter().map(|end| is_of(end.pid)).sum::<usize>()
        + graph.services.iter().map(|end| is_of(end.pid)).sum::<usize>();
    let ends = graph.endpoints.len() + graph.services.len();
    Ok(Graph { took, nodes: graph.nodes.len(), ends, of_process })
}

fn meet(domain: u32) -> Result<Met> {
    let (start, mut met) = (Instant::now(), Met::default());
    let participant = Participant::new(domain)?;
    met.joined = start.elapsed();
    let pongs: Subscription<UInt64> =
        participant.create_subscription(PONG, Qos::keep_last(1000), Limits::default())?;
    let pings = participant.create_publisher(PING, Qos::default(), Limits::default())?;
    met.made = start.elapsed();
    let token = monotonic_ns();
    let mut next = Instant::now();
    loop {
        while let Some(pong) = pongs.try_take()? {
            if pong.data == token {
                met.answered = start.elapsed();
                return Ok(met);
            }
        }
        if pings.subscription_count() > 0 {
            if met.matched.is_zero() {
                met.matched = start.elapsed();
            }
            // Repeated, because the process that was to answer may have been killed.
            if next <= Instant::now() {
                pings.publish(&UInt64 { data: token })?;
                next = Instant::now() + Duration::from_millis(5);
            }
        }
        if start.elapsed() > PATIENCE / 2 {
            return Err(format!(
                "a new participant gets no answer: {met:?}; {} subscriptions, {} publishers",
                pings.subscription_count(),
                pongs.publisher_count()
            )
            .into());
        }
        thread::sleep(Duration::from_micros(200));
    }
}

fn late(domain: u32) -> Result<Late> {
    let participant = Participant::new(domain)?;
    let (start, start_ns) = (Instant::now(), monotonic_ns());
    let qos = Qos::keep_last(1000).transient_local();
    let subscription: Subscription<UInt64> = participant.create_subscription(KEPT, qos, Limits::default())?;
    let (mut kept, mut missing, mut last) = (0, 0, None);
    loop {
        while let Some(sample) = subscription.try_take()? {
            let info = sample.info();
            if info.released_ns >= start_ns {
                // All earlier messages have arrived.
                let took = start.elapsed();
                let meanwhile = (info.released_ns - start_ns) / KEPT_PERIOD.as_nanos() as u64;
                let connecting = took.as_nanos() as u64 / KEPT_PERIOD.as_nanos() as u64;
                let expected = (KEPT_DEPTH as u64).saturating_sub(meanwhile.max(connecting) + 1) as usize;
                let lost = subscription.counters().lost();
                return Ok(Late { took, kept, expected, lost, missing });
            }
            kept += 1;
            let number = info.sequence_number;
            missing += last.map_or(0, |last| number - last - 1);
            last = Some(number);
        }
        if start.elapsed() > PATIENCE / 2 {
            let publishers = subscription.publisher_count();
            return Err(format!("a late joiner of {publishers} publishers gets nothing new, and {kept} messages that were kept").into());
        }
        thread::sleep(Duration::from_micros(200));
    }
}
