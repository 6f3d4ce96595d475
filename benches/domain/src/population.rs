// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes with a node each: what they cost when nothing happens, what it costs to look at them and to come to them, and how soon
//! they are cleaned up after.

use crate::job::{DOMAIN, Job, Said, say_and_stay, wait_until};
use crate::place::{Gate, shared_bytes};
use crate::process::{self, Process};
use crate::ros_node::{self, ENDPOINTS, RosNode, seldom};
use crate::stopwatch::Stopwatch;
use crate::{Bench, Experiment, Result};
use futures::StreamExt;
use std::hint::black_box;
use std::path::PathBuf;
use std::thread::{sleep, yield_now};
use std::time::Duration;
use tautline::rcl_interfaces::msg::ParameterEvent;
use tautline::std_msgs::msg::UInt64;
use tautline::{CallbackOptions, Node};
use tautline_exchange::say;
use tautline_harness::Distribution;
use tautline_harness::readings::{Column, Reading};
use tautline_rt::clock::monotonic_ns;
use tautline_rt::domain::shared_path;
use tautline_transport::{Limits, Participant, Publisher, Qos, Subscription, graph_of};

/// How long a process may take to do its job.
pub const PATIENCE: Duration = Duration::from_secs(180);
/// How long something that takes microseconds may take.
const SHORT: Duration = Duration::from_secs(10);
/// Until nothing happens any more.
const SETTLING: Duration = Duration::from_secs(1);
const MIB: f64 = 1048576.0;
/// What the goals of a look are about.
const LOOKED_AT: [usize; 2] = [64, 20];
const GOALS_US: [(&str, f64); 2] = [(UNCHANGED, 5.0), (CHANGED, 200.0)];

fn row(size: usize, what: impl Into<String>, unit: &'static str) -> Reading {
    Reading::of(Experiment::Processes, size, what, unit)
}

pub fn measure(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let mut rows = Vec::new();
    for &size in &bench.processes {
        rows.extend(population(bench, size)?);
    }
    rows.extend(looked_at(bench)?);
    Ok(rows)
}

fn population(bench: &Bench<'_>, size: usize) -> Result<Vec<Reading>> {
    let mut rows = Vec::new();
    let start_ns = monotonic_ns();
    let node = |index, processes| Job::Node { index, gate: None, processes };
    let mut processes: Vec<Process<'_, Said>> =
        (0..size).map(|index| bench.start(&node(index, Some(size)))).collect::<Result<_>>()?;
    let started = all_matched(&mut processes)?.saturating_sub(start_ns) as f64 / 1e9;
    rows.push(row(size, "from the first process's start until all are matched", "s").value(started));

    sleep(SETTLING);
    let pids: Vec<u32> = processes.iter().map(Process::id).collect();
    let idle = process::cpu_percent(&pids, Duration::from_secs(if bench.quick { 3 } else { 10 }));
    let goal = match size {
        60 => Some(1.0),
        300 => Some(3.0),
        _ => None,
    };
    rows.push(row(size, "CPU of all when idle", "% of a core").value(idle).at_most(goal));
    rows.extend(memory_of(Experiment::Processes, size, &pids));
    let descriptors = pids.iter().map(|&pid| process::descriptors(pid).len()).max().unwrap_or(0);
    rows.push(
        row(size, format!("descriptors of a process with {ENDPOINTS} endpoints, at most"), "files")
            .value(descriptors as f64),
    );

    let mut echo = bench.start(&Job::Echo)?;
    made(&mut echo)?;
    let mut probe = bench.start(&Job::Probe { processes: size, quick: bench.quick })?;
    rows.extend(times(&mut probe)?.into_iter().map(|(what, times)| row(size, what, "µs").times(&times)));
    probe.finish()?;
    echo.finish()?;

    rows.extend(deaths(bench, size, &mut processes)?);
    processes.iter_mut().try_for_each(Process::finish)?;
    Ok(rows)
}

pub fn memory_of(experiment: Experiment, size: usize, pids: &[u32]) -> Vec<Reading> {
    let memory: Vec<_> = pids.iter().map(|&pid| process::memory(pid)).collect();
    let row = |what: &str, bytes: f64| Reading::of(experiment, size, what, "MiB").value(bytes / MIB);
    let sum = |of: fn(&process::Memory) -> u64| memory.iter().map(of).sum::<u64>() as f64;
    vec![
        row("resident memory of a process (RSS), mean", sum(|memory| memory.rss) / pids.len() as f64),
        row("memory of all processes (PSS), shared parts counted once", sum(|memory| memory.pss)),
        row("of it in /dev/shm, whether it is mapped or not", shared_bytes() as f64),
    ]
}

pub fn matched(process: &mut Process<'_, Said>) -> Result<u64> {
    process.expect(PATIENCE, |said| if let Said::Matched { at_ns } = said { Some(at_ns) } else { None })
}

pub fn all_matched(processes: &mut [Process<'_, Said>]) -> Result<u64> {
    processes.iter_mut().try_fold(0, |last_ns, process| Ok(last_ns.max(matched(process)?)))
}

pub fn made(process: &mut Process<'_, Said>) -> Result<u64> {
    process.expect(PATIENCE, |said| if let Said::Made { ns } = said { Some(ns) } else { None })
}

/// The times that a process took, by what they are of.
pub fn times(process: &mut Process<'_, Said>) -> Result<Vec<(String, Distribution)>> {
    let times =
        process.expect(PATIENCE, |said| if let Said::Times(times) = said { Some(times) } else { None })?;
    let distribution = |counts: Vec<(u64, u64)>| {
        let mut distribution = Distribution::new();
        distribution.add(&counts);
        distribution
    };
    Ok(times.into_iter().map(|(what, counts)| (what, distribution(counts))).collect())
}

/// Kills processes one by one, at last the warden.
fn deaths(bench: &Bench<'_>, size: usize, processes: &mut Vec<Process<'_, Said>>) -> Result<Vec<Reading>> {
    let rounds = if bench.quick { 3 } else { 20 };
    let participant = Participant::new(DOMAIN)?;
    let qos = Qos::parameter_events();
    let publisher = participant.create_publisher::<ParameterEvent>(
        "/parameter_events",
        Qos::keep_last(qos.depth),
        seldom(),
    )?;
    let survivors =
        |count: usize| look_until("all are matched", || Ok(publisher.subscription_count() == count));
    survivors(processes.len())?;
    let mut deaths = Vec::new();
    for index in 0..rounds {
        let mut victim = bench.start(&Job::Node { index: size + index, gate: None, processes: None })?;
        made(&mut victim)?;
        survivors(processes.len() + 1)?;
        deaths.push(death(&participant, &publisher, &mut victim)?);
    }
    let mut rows = rows_of(size, "a killed process", &deaths);
    if processes.len() > 3 {
        let mut of_wardens = Vec::new();
        for _ in 0..3 {
            let folder = shared_path(DOMAIN);
            let mut index = None;
            // Who becomes it after one was killed does so when it is scheduled.
            look_until("there is a warden", || {
                index = processes.iter().position(|process| process::is_warden(process.id(), &folder));
                Ok(index.is_some() || process::is_warden(std::process::id(), &folder))
            })?;
            // It may be this one.
            let Some(index) = index else { break };
            let mut victim = processes.swap_remove(index);
            of_wardens.push(death(&participant, &publisher, &mut victim)?);
        }
        rows.extend(rows_of(size, "a killed warden, which cleans up after the others,", &of_wardens));
    }
    Ok(rows)
}

/// What is to go of a killed process.
const TRACES: [&str; 3] = ["a node in the graph", "a subscription that a peer counts", "a file"];
const HAVE_GONE: [&str; 3] = ["is out of the graph", "is counted by no peer", "has no files"];

fn rows_of(size: usize, who: &str, deaths: &[[u64; TRACES.len()]]) -> Vec<Reading> {
    if deaths.is_empty() {
        return Vec::new();
    }
    let times = |what: &str, of: &dyn Fn(&[u64; TRACES.len()]) -> u64| {
        let mut times = Distribution::new();
        deaths.iter().for_each(|death| times.record(of(death)));
        row(size, format!("{who} {what}"), "ms").times_in(&times, 1000.0)
    };
    let of_trace = |(trace, what)| times(what, &|death| death[trace]);
    let mut rows: Vec<Reading> = HAVE_GONE.into_iter().enumerate().map(of_trace).collect();
    let last = |death: &[u64; TRACES.len()]| death.iter().copied().max().unwrap_or(0);
    rows.push(times("is cleaned up: all of that", &last).at_most_of(Column::Max, 50.0));
    rows
}

/// Kills a process and waits until nothing of it is left: how long that took for each trace, in nanoseconds.
fn death(
    participant: &Participant,
    publisher: &Publisher<ParameterEvent>,
    victim: &mut Process<'_, Said>,
) -> Result<[u64; TRACES.len()]> {
    let files = process::records(victim.id(), &shared_path(DOMAIN));
    if files.is_empty() {
        return Err("the process to be killed has no file in shared memory".into());
    }
    let (pid, before) = (victim.id(), publisher.subscription_count());
    let mut death = [None; TRACES.len()];
    let start_ns = monotonic_ns();
    victim.kill();
    let cleaned = look_until("a killed process is cleaned up after", || {
        let has_gone = |trace: usize| -> Result<bool> {
            Ok(match trace {
                0 => !participant.graph()?.nodes.iter().any(|node| node.pid == Some(pid)),
                1 => publisher.subscription_count() < before,
                _ => !files.iter().any(|file| file.exists()),
            })
        };
        for (trace, at) in death.iter_mut().enumerate() {
            if at.is_none() && has_gone(trace)? {
                *at = Some(monotonic_ns() - start_ns);
            }
        }
        Ok(death.iter().all(Option::is_some))
    });
    if let Err(error) = cleaned {
        let left = std::iter::zip(TRACES, death).filter(|(_, at)| at.is_none());
        let left: Vec<&str> = left.map(|(what, _)| what).collect();
        return Err(format!("{error}: what is left of it is {}", left.join(", ")).into());
    }
    Ok(death.map(Option::unwrap_or_default))
}

fn look_until(what: &str, is_so: impl FnMut() -> Result<bool>) -> Result<()> {
    wait_until(what, SHORT, || sleep(Duration::from_micros(100)), is_so)
}

/// The domain that the goals of a look are about.
fn looked_at(bench: &Bench<'_>) -> Result<Vec<Reading>> {
    let [processes, ports] = LOOKED_AT;
    let start = |index| bench.start(&Job::Ports { index, pairs: ports / 2 });
    let mut all: Vec<Process<'_, Said>> = (0..processes).map(start).collect::<Result<_>>()?;
    for process in &mut all {
        made(process)?;
    }
    let mut look = bench.start(&Job::Look { quick: bench.quick })?;
    let of_look = |(what, times): (String, Distribution)| {
        let goal_us = GOALS_US.iter().find(|(of, _)| **of == what).map(|(_, us)| *us);
        let row = row(processes, format!("{what}, {ports} ports each"), "µs").times(&times);
        row.at_most_of(Column::P99, goal_us)
    };
    let rows = times(&mut look)?.into_iter().map(of_look).collect();
    look.finish()?;
    all.iter_mut().try_for_each(Process::finish)?;
    Ok(rows)
}

// What the processes do.

pub fn node(index: usize, gate: Option<PathBuf>, processes: Option<usize>) -> Result<()> {
    if let Some(gate) = gate {
        Gate::pass(&gate)?;
    }
    let start_ns = monotonic_ns();
    let context = ros_node::context()?;
    let (node, answers) = RosNode::create(&context, &format!("node_{index}"))?;
    let _callback = node.serve(answers)?;
    ros_node::spin_while(&context, || {
        let made = Said::Made { ns: monotonic_ns() - start_ns };
        let Some(processes) = processes else { return say_and_stay(&made) };
        say(&made);
        say_and_stay(&Said::Matched { at_ns: node.wait_until_matched(processes)? })
    })
}

pub fn ports(index: usize, pairs: usize) -> Result<()> {
    let start_ns = monotonic_ns();
    let participant = Participant::new(DOMAIN)?;
    let name = |kind: &str, pair| format!("/ports/process_{index}/{kind}_{pair}");
    let publisher =
        |pair| participant.create_publisher::<UInt64>(&name("out", pair), Qos::default(), Limits::default());
    let publishers: Vec<_> = (0..pairs).map(publisher).collect::<std::result::Result<_, _>>()?;
    let subscription = |pair| {
        participant.create_subscription::<UInt64>(&name("in", pair), Qos::default(), Limits::default())
    };
    let subscriptions: Vec<_> = (0..pairs).map(subscription).collect::<std::result::Result<_, _>>()?;
    say_and_stay(&Said::Made { ns: monotonic_ns() - start_ns })?;
    drop((publishers, subscriptions));
    Ok(())
}

const TO: &str = "/echo/to";
const FROM: &str = "/echo/from";

/// Sends back the time at which each message was taken.
pub fn echo() -> Result<()> {
    let context = ros_node::context()?;
    let mut node = Node::create(context.clone(), "echo", "")?;
    let publisher = node.create_publisher::<UInt64>(FROM, Qos::default())?;
    let mut messages = node.subscribe::<UInt64>(TO, Qos::default())?;
    let options = CallbackOptions::fifo(tautline_exchange::APPLICATION_PRIORITY).name("echo");
    let _callback = node.spawn_callback(options, async move {
        while let Some(message) = messages.next().await {
            drop(message);
            if publisher.publish(&UInt64 { data: monotonic_ns() }).is_err() {
                return;
            }
        }
    })?;
    ros_node::spin_while(&context, || say_and_stay(&Said::Made { ns: 0 }))
}

const FRESH: &str = "a look by who has not looked before";
const UNCHANGED: &str = "a look when nothing has changed";
const CHANGED: &str = "a look after one change";

pub fn time_looks(times: &mut Stopwatch, quick: bool) -> Result<()> {
    let rounds = if quick { 100 } else { 1000 };
    for _ in 0..rounds / 5 {
        black_box(times.time(FRESH, || graph_of(DOMAIN))?);
    }
    let (looking, changing) = (Participant::new(DOMAIN)?, Participant::new(DOMAIN)?);
    // What comes with the two is over.
    sleep(Duration::from_millis(100));
    looking.graph()?;
    for _ in 0..rounds * 10 {
        black_box(times.time(UNCHANGED, || looking.graph())?);
    }
    for _ in 0..rounds / 2 {
        let port = changing.create_publisher::<UInt64>("/look", Qos::default(), Limits::default())?;
        let graph = times.time(CHANGED, || looking.graph())?;
        if !graph.endpoints.iter().any(|end| end.topic == "/look") {
            return Err("a new port is not in the graph".into());
        }
        drop((graph, port));
        black_box(times.time(CHANGED, || looking.graph())?);
    }
    Ok(())
}

pub fn look(quick: bool) -> Result<()> {
    let mut times = Stopwatch::default();
    time_looks(&mut times, quick)?;
    times.say_and_stay()
}

pub fn probe(processes: usize, quick: bool) -> Result<()> {
    let rounds = if quick { 20 } else { 200 };
    let mut times = Stopwatch::default();
    time_looks(&mut times, quick)?;
    let participant = Participant::new(DOMAIN)?;
    let (qos, limits) = (Qos::default(), Limits::default());
    for _ in 0..rounds {
        let publisher = || participant.create_publisher::<UInt64>("/alone", qos, limits);
        drop(times.time("making a publisher that nobody listens to", publisher)?);
        let subscription = || participant.create_subscription::<UInt64>("/alone", qos, limits);
        drop(times.time("making a subscription that nobody publishes to", subscription)?);
    }
    time_echoes(&mut times, &participant, rounds)?;
    time_the_crowd(&mut times, &participant, processes, rounds / 5)?;
    for index in 0..rounds / 4 {
        let context = ros_node::context()?;
        let node = || RosNode::create(&context, &format!("probe_{index}"));
        // Until the next one comes it is gone for all.
        drop(times.time(&format!("making a node with its {ENDPOINTS} endpoints"), node)?);
    }
    times.say_and_stay()
}

fn spin_until(what: &str, mut is_so: impl FnMut() -> bool) -> Result<()> {
    wait_until(what, SHORT, yield_now, || Ok(is_so()))
}

/// How long it takes until a new subscription has its publisher, and until a new publisher's first message is taken.
fn time_echoes(times: &mut Stopwatch, participant: &Participant, rounds: usize) -> Result<()> {
    let (qos, limits) = (Qos::default(), Limits::default());
    for _ in 0..rounds {
        let matched = || -> Result<Subscription<UInt64>> {
            let subscription = participant.create_subscription(FROM, qos, limits)?;
            spin_until("a subscription is matched", || subscription.publisher_count() == 1)?;
            Ok(subscription)
        };
        let what = "making a subscription and matching it with one in another process";
        let subscription = times.time(what, matched)?;
        let start_ns = monotonic_ns();
        let publisher = participant.create_publisher::<UInt64>(TO, qos, limits)?;
        spin_until("a publisher is matched", || publisher.subscription_count() == 1)?;
        publisher.publish(&UInt64 { data: 0 })?;
        let mut taken_ns = 0;
        spin_until("an answer comes", || {
            let answer = subscription.try_take().ok().flatten();
            answer.is_some_and(|answer| {
                taken_ns = answer.data;
                true
            })
        })?;
        let what = "making a publisher and having its first message taken in another process";
        times.note(what, taken_ns.saturating_sub(start_ns));
    }
    Ok(())
}

/// How long it takes to make ends that are matched with all processes.
fn time_the_crowd(
    times: &mut Stopwatch,
    participant: &Participant,
    processes: usize,
    rounds: usize,
) -> Result<()> {
    let qos = Qos::keep_last(Qos::parameter_events().depth);
    for _ in 0..rounds {
        let publisher = || -> Result<Publisher<ParameterEvent>> {
            let publisher = participant.create_publisher("/parameter_events", qos, seldom())?;
            spin_until("a publisher is matched with all", || publisher.subscription_count() >= processes)?;
            Ok(publisher)
        };
        drop(times.time("making a publisher of /parameter_events, connected to all", publisher)?);
        let subscription = || -> Result<Subscription<ParameterEvent>> {
            let subscription = participant.create_subscription("/parameter_events", qos, seldom())?;
            spin_until("a subscription is matched with all", || subscription.publisher_count() >= processes)?;
            Ok(subscription)
        };
        drop(times.time("making a subscription of /parameter_events, connected to all", subscription)?);
    }
    Ok(())
}
