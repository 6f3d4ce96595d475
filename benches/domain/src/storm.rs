// SPDX-License-Identifier: MIT OR Apache-2.0
//! Many that start at once: processes, nodes of a process, endpoints of a topic.

use crate::job::{DOMAIN, Job, Said, say_and_stay, wait_until};
use crate::place::{Gate, shared_bytes};
use crate::population::{PATIENCE, all_matched, made, matched, memory_of};
use crate::process::{self, Process};
use crate::ros_node::{self, ENDPOINTS, RosNode};
use crate::{Bench, Experiment, Result};
use std::path::Path;
use std::thread::sleep;
use std::time::Duration;
use tautline::std_msgs::msg::UInt64;
use tautline_exchange::say;
use tautline_harness::Distribution;
use tautline_harness::readings::{Column, Reading};
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Limits, Participant, Qos};

const MIB: f64 = 1048576.0;
/// Time for processes to reach the gate.
const GATHERING: Duration = Duration::from_millis(500);

/// Processes with a node each that start at the same instant.
pub fn start_at_once(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let (size, rounds) = if bench.quick { (20, 1) } else { (100, 5) };
    let (mut all, mut each) = (Distribution::new(), Distribution::new());
    for _ in 0..rounds {
        let gate = Gate::closed(bench.scratch)?;
        let start = |index| {
            bench.start(&Job::Node { index, gate: Some(gate.path().to_owned()), processes: Some(size) })
        };
        let mut processes: Vec<Process<'_, Said>> = (0..size).map(start).collect::<Result<_>>()?;
        sleep(GATHERING);
        let start_ns = monotonic_ns();
        gate.open()?;
        let mut last_ns = start_ns;
        for process in &mut processes {
            let at_ns = matched(process)?;
            each.record(at_ns - start_ns);
            last_ns = last_ns.max(at_ns);
        }
        all.record(last_ns - start_ns);
        processes.iter_mut().try_for_each(Process::finish)?;
    }
    let row = |what: &str| Reading::of(Experiment::Storm, size, what, "ms");
    Ok(vec![
        row("until all processes are matched with all others")
            .times_in(&all, 1000.0)
            .at_most_of(Column::Max, 2000.0),
        row("until a process is matched with all others").times_in(&each, 1000.0),
    ])
}

pub fn many_nodes(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let size = 100;
    let mut process = bench.start(&Job::Nodes { nodes: size })?;
    let row = |what: &str, unit| Reading::of(Experiment::Nodes, size, what, unit);
    let made_ns = made(&mut process)?;
    let matched_ns = matched(&mut process)?;
    sleep(GATHERING);
    let (pid, memory) = (process.id(), process::memory(process.id()));
    let shared = shared_bytes();
    let idle = process::cpu_percent(&[pid], Duration::from_secs(if bench.quick { 1 } else { 5 }));
    let all = (memory.rss_without_shared + shared) as f64 / MIB;
    let rows = vec![
        row("making the process's nodes", "ms").value(made_ns as f64 / 1e6).at_most(2000.0),
        row("until all are matched", "ms").value(matched_ns as f64 / 1e6).at_most(2000.0),
        row("memory: resident, and all of /dev/shm", "MiB").value(all).at_most(150.0),
        row("of it resident and not in /dev/shm", "MiB").value(memory.rss_without_shared as f64 / MIB),
        row("of it in /dev/shm, whether it is mapped or not", "MiB").value(shared as f64 / MIB),
        row("resident memory (RSS)", "MiB").value(memory.rss as f64 / MIB),
        row("CPU when idle", "% of a core").value(idle),
        row(&format!("descriptors, of {} endpoints", size * ENDPOINTS), "files")
            .value(process::descriptors(pid).len() as f64),
    ];
    process.finish()?;
    Ok(rows)
}

/// Publishers and subscriptions of one topic in several processes.
pub fn crowd(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let (size, processes) = if bench.quick { (100, 5) } else { (1000, 10) };
    let gate = Gate::closed(bench.scratch)?;
    let per_process = size / processes;
    let start = |publishers, subscriptions| {
        bench.start(&Job::Crowd { publishers, subscriptions, of: size, gate: gate.path().to_owned() })
    };
    let mut all: Vec<Process<'_, Said>> = Vec::new();
    for _ in 0..processes {
        all.push(start(per_process, 0)?);
        all.push(start(0, per_process)?);
    }
    sleep(GATHERING);
    let start_ns = monotonic_ns();
    gate.open()?;
    let matched_ms = all_matched(&mut all)?.saturating_sub(start_ns) as f64 / 1e6;
    sleep(GATHERING);
    let pids: Vec<u32> = all.iter().map(Process::id).collect();
    let row = |what: &str, unit| Reading::of(Experiment::Crowd, size, what, unit);
    let descriptors = pids.iter().map(|&pid| process::descriptors(pid).len()).max().unwrap_or(0);
    let mut rows = vec![
        row(&format!("until all are matched, {} pairs", size * size), "ms").value(matched_ms),
        row("descriptors of a process for each of its ends, at most", "files")
            .value(descriptors as f64 / per_process as f64)
            .at_most(1.0),
        row("parts of a process's address space, at most", "mappings")
            .value(pids.iter().map(|&pid| process::mappings(pid)).max().unwrap_or(0) as f64),
    ];
    rows.extend(memory_of(Experiment::Crowd, size, &pids));
    let start_ns = monotonic_ns();
    all.iter_mut().try_for_each(Process::finish)?;
    let gone_ms = (monotonic_ns() - start_ns) as f64 / 1e6;
    rows.push(row("until all have gone, one after the other", "ms").value(gone_ms));
    Ok(rows)
}

// The jobs of the processes.

pub fn nodes(nodes: usize) -> Result<()> {
    let start_ns = monotonic_ns();
    let context = ros_node::context()?;
    let (mut all, mut answers) = (Vec::new(), Vec::new());
    for index in 0..nodes {
        let (node, answer) = RosNode::create(&context, &format!("node_{index}"))?;
        all.push(node);
        answers.push(answer);
    }
    say(&Said::Made { ns: monotonic_ns() - start_ns });
    let answers = futures::future::join_all(answers);
    let Some(first) = all.first() else { return Err("no nodes".into()) };
    let _callback = first.serve(Box::pin(async move { drop(answers.await) }))?;
    ros_node::spin_while(&context, || {
        let mut matched_ns = start_ns;
        for node in &all {
            matched_ns = matched_ns.max(node.wait_until_matched(nodes)?);
        }
        say_and_stay(&Said::Matched { at_ns: matched_ns - start_ns })
    })
}

pub fn join_crowd(publishers: usize, subscriptions: usize, of: usize, gate: &Path) -> Result<()> {
    Gate::pass(gate)?;
    let participant = Participant::new(DOMAIN)?;
    let (qos, limits) = (Qos::default(), Limits::default());
    let publisher = |_| participant.create_publisher::<UInt64>("/crowd", qos, limits);
    let publishers: Vec<_> = (0..publishers).map(publisher).collect::<std::result::Result<_, _>>()?;
    let subscription = |_| participant.create_subscription::<UInt64>("/crowd", qos, limits);
    let subscriptions: Vec<_> =
        (0..subscriptions).map(subscription).collect::<std::result::Result<_, _>>()?;
    wait_until(
        "all are matched",
        PATIENCE,
        || sleep(Duration::from_millis(5)),
        || {
            Ok(publishers.iter().all(|publisher| publisher.subscription_count() == of)
                && subscriptions.iter().all(|subscription| subscription.publisher_count() == of))
        },
    )?;
    say_and_stay(&Said::Matched { at_ns: monotonic_ns() })
}
