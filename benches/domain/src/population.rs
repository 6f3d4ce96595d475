// SPDX-License-Identifier: MIT OR Apache-2.0
//! Processes with a node each: their cost when idle, the cost of reading the graph and of joining them, and the time until a
//! killed one is cleaned up.

use crate::job::{DOMAIN, Job, Said, say, wait_for_end, wait_until};
use crate::place::Gate;
use crate::process::{self, Process};
use crate::report::Row;
use crate::ros_node::{self, ENDPOINTS, RosNode, seldom};
use crate::{Bench, Experiment, Result};
use futures::StreamExt;
use std::hint::black_box;
use std::path::PathBuf;
use std::thread::{sleep, yield_now};
use std::time::Duration;
use tautline::rcl_interfaces::msg::ParameterEvent;
use tautline::std_msgs::msg::UInt64;
use tautline::{CallbackOptions, Node};
use tautline_benches::Distribution;
use tautline_rt::clock::monotonic_ns;
use tautline_transport::{Limits, Participant, Publisher, Qos, Subscription, graph_of};

/// Time-out of a process's job.
pub const PATIENCE: Duration = Duration::from_secs(180);
/// Time-out of steps that take microseconds.
const SHORT: Duration = Duration::from_secs(10);
/// Until the domain is idle.
const SETTLING: Duration = Duration::from_secs(1);
const MIB: f64 = 1048576.0;
/// Processes and ports for the aims of reading the graph.
const LOOKED_AT: [usize; 2] = [64, 20];

fn row(size: usize, what: impl Into<String>, unit: &'static str) -> Row {
    Row::of(Experiment::Processes, size, what, unit)
}

pub fn measure(bench: &Bench<'_>) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for &size in &bench.processes {
        rows.extend(population(bench, size)?);
    }
    rows.extend(looked_at(bench)?);
    Ok(rows)
}

fn population(bench: &Bench<'_>, size: usize) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    let start_ns = monotonic_ns();
    let node = |index, processes| Job::Node { index, gate: None, processes };
    let mut processes: Vec<Process<'_, Said>> =
        (0..size).map(|index| bench.start(&node(index, Some(size)))).collect::<Result<_>>()?;
    let mut matched_ns = start_ns;
    for process in &mut processes {
        matched_ns = matched_ns.max(matched(process)?);
    }
    let started = (matched_ns - start_ns) as f64 / 1e9;
    rows.push(row(size, "from the first process's start until all are matched", "s").value(started));

    sleep(SETTLING);
    let pids: Vec<u32> = processes.iter().map(Process::id).collect();
    let idle = process::cpu_percent(&pids, Duration::from_secs(if bench.quick { 3 } else { 10 }));
    let idle = row(size, "CPU of all when idle", "% of a core").value(idle);
    rows.push(match size {
        60 => idle.at_most(1.0),
        300 => idle.at_most(3.0),
        _ => idle,
    });
    rows.extend(memory_of(bench, Experiment::Processes, size, &pids));
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
    for process in &mut processes {
        process.finish()?;
    }
    Ok(rows)
}

/// The memory of a number of processes.
pub fn memory_of(bench: &Bench<'_>, experiment: Experiment, size: usize, pids: &[u32]) -> Vec<Row> {
    let memory: Vec<_> = pids.iter().map(|&pid| process::memory(pid)).collect();
    let row = |what: &str, bytes: f64| Row::of(experiment, size, what, "MiB").value(bytes / MIB);
    let sum = |of: fn(&process::Memory) -> u64| memory.iter().map(of).sum::<u64>() as f64;
    vec![
        row("resident memory of a process (RSS), mean", sum(|memory| memory.rss) / pids.len() as f64),
        row("memory of all processes (PSS), shared parts counted once", sum(|memory| memory.pss)),
        row("of it in /dev/shm, whether it is mapped or not", bench.place.shared_bytes() as f64),
    ]
}

pub fn matched(process: &mut Process<'_, Said>) -> Result<u64> {
    process.expect(PATIENCE, |said| if let Said::Matched { at_ns } = said { Some(at_ns) } else { None })
}

pub fn made(process: &mut Process<'_, Said>) -> Result<u64> {
    process.expect(PATIENCE, |said| if let Said::Made { ns } = said { Some(ns) } else { None })
}

/// The times that a process measured, by kind.
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

/// Kills processes one by one, finally the warden.
fn deaths(bench: &Bench<'_>, size: usize, processes: &mut Vec<Process<'_, Said>>) -> Result<Vec<Row>> {
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
        deaths.push(death(bench, &participant, &publisher, &mut victim)?);
    }
    let mut rows = rows_of(size, "a killed process", &deaths);
    if processes.len() > 3 {
        let mut of_wardens = Vec::new();
        for _ in 0..3 {
            let folder = bench.place.folder();
            let mut index = None;
            // After a kill, the next warden takes over when it is scheduled.
            look_until("there is a warden", || {
                index = processes.iter().position(|process| process::is_warden(process.id(), &folder));
                Ok(index.is_some() || process::is_warden(std::process::id(), &folder))
            })?;
            // It may be this one.
            let Some(index) = index else { break };
            let mut victim = processes.swap_remove(index);
            of_wardens.push(death(bench, &participant, &publisher, &mut victim)?);
        }
        rows.extend(rows_of(size, "a killed warden, which buries the others,", &of_wardens));
    }
    Ok(rows)
}

fn rows_of(size: usize, who: &str, deaths: &[Death]) -> Vec<Row> {
    if deaths.is_empty() {
        return Vec::new();
    }
    let times = |what: &str, of: fn(&Death) -> u64| {
        let mut times = Distribution::new();
        deaths.iter().for_each(|death| times.record(of(death)));
        row(size, format!("{who} {what}"), "ms").times_in(&times, 1000.0)
    };
    vec![
        times("is out of the graph", |death| death.graph),
        times("is counted by no peer", |death| death.peer),
        times("has no files", |death| death.files),
        times("is cleaned up: all of that", |death| death.all()).max_at_most(50.0),
    ]
}

/// Times after a kill, in nanoseconds.
#[derive(Clone, Copy, Debug)]
struct Death {
    /// Until it has left the graph.
    graph: u64,
    /// Until a peer's publisher no longer counts its subscription.
    peer: u64,
    /// Until its files are removed.
    files: u64,
}

impl Death {
    fn all(self) -> u64 {
        self.graph.max(self.peer).max(self.files)
    }
}

/// Kills a process and waits until nothing of it is left.
fn death(
    bench: &Bench<'_>,
    participant: &Participant,
    publisher: &Publisher<ParameterEvent>,
    victim: &mut Process<'_, Said>,
) -> Result<Death> {
    let files = process::records(victim.id(), &bench.place.folder());
    if files.is_empty() {
        return Err("the process to be killed has no file in shared memory".into());
    }
    let (pid, before) = (victim.id(), publisher.subscription_count());
    let mut death = [None; 3];
    let start_ns = monotonic_ns();
    victim.kill();
    let buried = look_until("a killed process is buried", || {
        let is_so = |part: usize| -> Result<bool> {
            Ok(match part {
                0 => !participant.graph()?.nodes.iter().any(|node| node.pid == Some(pid)),
                1 => publisher.subscription_count() < before,
                _ => !files.iter().any(|file| file.exists()),
            })
        };
        for (part, at) in death.iter_mut().enumerate() {
            if at.is_none() && is_so(part)? {
                *at = Some(monotonic_ns() - start_ns);
            }
        }
        Ok(death.iter().all(Option::is_some))
    });
    if let Err(error) = buried {
        let left =
            std::iter::zip(["a node in the graph", "a subscription that a peer counts", "a file"], death);
        let left: Vec<&str> = left.filter(|(_, at)| at.is_none()).map(|(what, _)| what).collect();
        return Err(format!("{error}: what is left of it is {}", left.join(", ")).into());
    }
    let [graph, peer, files] = death.map(Option::unwrap_or_default);
    Ok(Death { graph, peer, files })
}

/// Polls every 100 µs.
fn look_until(what: &str, is_so: impl FnMut() -> Result<bool>) -> Result<()> {
    wait_until(what, SHORT, || sleep(Duration::from_micros(100)), is_so)
}

/// The domain for the aims of reading the graph.
fn looked_at(bench: &Bench<'_>) -> Result<Vec<Row>> {
    let [processes, ports] = LOOKED_AT;
    let start = |index| bench.start(&Job::Ports { index, pairs: ports / 2 });
    let mut all: Vec<Process<'_, Said>> = (0..processes).map(start).collect::<Result<_>>()?;
    for process in &mut all {
        made(process)?;
    }
    let mut look = bench.start(&Job::Look { quick: bench.quick })?;
    let rows = times(&mut look)?.into_iter().map(|(what, times)| {
        let aim = match what.as_str() {
            CHANGED => Some(200.0),
            UNCHANGED => Some(5.0),
            _ => None,
        };
        let row = row(processes, format!("{what}, {ports} ports each"), "µs").times(&times);
        match aim {
            Some(aim) => row.p99_at_most(aim),
            None => row,
        }
    });
    let rows = rows.collect();
    look.finish()?;
    for process in &mut all {
        process.finish()?;
    }
    Ok(rows)
}

// The jobs of the processes.

pub fn node(index: usize, gate: Option<PathBuf>, processes: Option<usize>) -> Result<()> {
    if let Some(gate) = gate {
        Gate::pass(&gate)?;
    }
    let start_ns = monotonic_ns();
    let context = ros_node::context()?;
    let (node, answers) = RosNode::create(&context, &format!("node_{index}"))?;
    let _callback = node.serve(answers)?;
    ros_node::spin_while(&context, || {
        say(&Said::Made { ns: monotonic_ns() - start_ns })?;
        if let Some(processes) = processes {
            say(&Said::Matched { at_ns: node.wait_until_matched(processes)? })?;
        }
        wait_for_end();
        Ok(())
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
    say(&Said::Made { ns: monotonic_ns() - start_ns })?;
    wait_for_end();
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
    ros_node::spin_while(&context, || {
        say(&Said::Made { ns: 0 })?;
        wait_for_end();
        Ok(())
    })
}

const FRESH: &str = "a look by who has not looked before";
const UNCHANGED: &str = "a look when nothing has changed";
const CHANGED: &str = "a look after one change";

type Times = Vec<(String, Vec<(u64, u64)>)>;

fn add(all: &mut Times, what: impl Into<String>, times: &Distribution) {
    all.push((what.into(), times.counts()));
}

fn timed<T>(times: &mut Distribution, what: impl FnOnce() -> T) -> T {
    let start_ns = monotonic_ns();
    let result = what();
    times.record(monotonic_ns() - start_ns);
    result
}

/// Times of reading the graph.
pub fn looks(quick: bool) -> Result<Times> {
    let rounds = if quick { 100 } else { 1000 };
    let mut all = Times::new();
    let mut fresh = Distribution::new();
    for _ in 0..rounds / 5 {
        black_box(timed(&mut fresh, || graph_of(DOMAIN))?);
    }
    add(&mut all, FRESH, &fresh);
    let (looking, changing) = (Participant::new(DOMAIN)?, Participant::new(DOMAIN)?);
    // Changes that come with the two are over.
    sleep(Duration::from_millis(100));
    let (mut unchanged, mut changed) = (Distribution::new(), Distribution::new());
    looking.graph()?;
    for _ in 0..rounds * 10 {
        black_box(timed(&mut unchanged, || looking.graph())?);
    }
    for _ in 0..rounds / 2 {
        let port = changing.create_publisher::<UInt64>("/look", Qos::default(), Limits::default())?;
        let graph = timed(&mut changed, || looking.graph())?;
        if !graph.endpoints.iter().any(|end| end.topic == "/look") {
            return Err("a new port is not in the graph".into());
        }
        drop((graph, port));
        black_box(timed(&mut changed, || looking.graph())?);
    }
    add(&mut all, UNCHANGED, &unchanged);
    add(&mut all, CHANGED, &changed);
    Ok(all)
}

pub fn look(quick: bool) -> Result<()> {
    say(&Said::Times(looks(quick)?))?;
    wait_for_end();
    Ok(())
}

pub fn probe(processes: usize, quick: bool) -> Result<()> {
    let rounds = if quick { 20 } else { 200 };
    let mut all = looks(quick)?;
    let participant = Participant::new(DOMAIN)?;
    let limits = Limits::default();
    let (mut publishers, mut subscriptions) = (Distribution::new(), Distribution::new());
    for _ in 0..rounds {
        drop(timed(&mut publishers, || {
            participant.create_publisher::<UInt64>("/alone", Qos::default(), limits)
        })?);
        drop(timed(&mut subscriptions, || {
            participant.create_subscription::<UInt64>("/alone", Qos::default(), limits)
        })?);
    }
    add(&mut all, "making a publisher that nobody listens to", &publishers);
    add(&mut all, "making a subscription that nobody publishes to", &subscriptions);
    let (matched, answered) = echoed(&participant, rounds)?;
    add(&mut all, "making a subscription and matching it with one in another process", &matched);
    add(&mut all, "making a publisher and having its first message taken in another process", &answered);
    let (publishers, subscriptions) = in_the_crowd(&participant, processes, rounds / 5)?;
    add(&mut all, "making a publisher of /parameter_events, connected to all", &publishers);
    add(&mut all, "making a subscription of /parameter_events, connected to all", &subscriptions);
    let mut nodes = Distribution::new();
    for index in 0..rounds / 4 {
        let context = ros_node::context()?;
        let made = timed(&mut nodes, || RosNode::create(&context, &format!("probe_{index}")))?;
        // Until the next one comes, it has ended everywhere.
        drop(made);
    }
    add(&mut all, format!("making a node with its {ENDPOINTS} endpoints"), &nodes);
    say(&Said::Times(all))?;
    wait_for_end();
    Ok(())
}

fn spin_until(what: &str, mut is_so: impl FnMut() -> bool) -> Result<()> {
    wait_until(what, SHORT, yield_now, || Ok(is_so()))
}

/// Time until a new subscription has its publisher, and until a new publisher's first message is taken.
fn echoed(participant: &Participant, rounds: usize) -> Result<(Distribution, Distribution)> {
    let (qos, limits) = (Qos::default(), Limits::default());
    let (mut matched, mut taken) = (Distribution::new(), Distribution::new());
    for _ in 0..rounds {
        let subscription: Subscription<UInt64> = timed(&mut matched, || {
            let subscription = participant.create_subscription(FROM, qos, limits)?;
            spin_until("a subscription is matched", || subscription.publisher_count() == 1)?;
            Ok::<_, Box<dyn std::error::Error>>(subscription)
        })?;
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
        taken.record(taken_ns.saturating_sub(start_ns));
    }
    Ok((matched, taken))
}

/// Time to create endpoints that are matched with all processes.
fn in_the_crowd(
    participant: &Participant,
    processes: usize,
    rounds: usize,
) -> Result<(Distribution, Distribution)> {
    let qos = Qos::keep_last(Qos::parameter_events().depth);
    let (mut publishers, mut subscriptions) = (Distribution::new(), Distribution::new());
    for _ in 0..rounds {
        let publisher: Publisher<ParameterEvent> = timed(&mut publishers, || {
            let publisher = participant.create_publisher("/parameter_events", qos, seldom())?;
            spin_until("a publisher is matched with all", || publisher.subscription_count() >= processes)?;
            Ok::<_, Box<dyn std::error::Error>>(publisher)
        })?;
        drop(publisher);
        let subscription: Subscription<ParameterEvent> = timed(&mut subscriptions, || {
            let subscription = participant.create_subscription("/parameter_events", qos, seldom())?;
            spin_until("a subscription is matched with all", || subscription.publisher_count() >= processes)?;
            Ok::<_, Box<dyn std::error::Error>>(subscription)
        })?;
        drop(subscription);
    }
    Ok((publishers, subscriptions))
}
