// SPDX-License-Identifier: MIT OR Apache-2.0
//! How long nodes take to find each other: each in a process of its own, with the ends that rclpy gives it.

use crate::FAST_DDS;
use crate::bindings::*;
use crate::rmw::{Node, checked};
use crate::system::{PATIENCE, Starter, System, Task, measured, ready};
use crate::types;
use std::time::{Duration, Instant};
use tautline_exchange::{Exchange, Job, Line, Measured, Result, Role, Way, say, until_told};
use tautline_harness::Distribution;
use tautline_harness::rows::{Row, Tally};
use tautline_rt::clock::process_cpu_ns;

/// How often a node looks whether it has found the others.
const LOOK: Duration = Duration::from_millis(10);

/// Of each.
pub const MODE: &str = "rclpy's ends";

/// What it is called among the rows.
pub fn experiment(nodes: usize) -> String {
    format!("{nodes} nodes")
}

/// From the start of the first process until the last one has found all others.
pub fn measure(starter: &Starter<'_>, system: &System, nodes: usize) -> Result<Row> {
    let job = starter.job(system, Role::Near, Exchange::RoundTrips, Duration::ZERO);
    let way = Way { topics: nodes, ..job.way.clone() };
    let job = Job { core: None, realtime: false, way, ..job };
    let started = Instant::now();
    let all: Result<Vec<_>> = (0..nodes).map(|_| starter.start(system, &job, Task::Node)).collect();
    let mut all = all?;
    for process in &mut all {
        ready(process, PATIENCE)?;
    }
    let mut time = Distribution::new();
    time.record(started.elapsed().as_nanos() as u64);
    // Of all processes until then, and what they take to hear of it.
    let mut cpu_ns = 0;
    for process in &mut all {
        process.tell("stop")?;
    }
    for process in &mut all {
        cpu_ns += measured(process, PATIENCE)?.cpu_ns;
    }
    let mut note = format!("{:.2} s of CPU time", cpu_ns as f64 / 1e9);
    match all.iter_mut().try_for_each(|process| process.finish()) {
        // Now and then Fast DDS hangs at its end, when all has been measured.
        Err(error) if system.name == FAST_DDS => note += &format!("; {error}"),
        ended => ended?,
    }
    let mut tally = Tally::default();
    tally.add(1, &time);
    Ok(Row { note, ..tally.row(experiment(nodes), system.name, MODE, 0) })
}

type CountPublishers = unsafe extern "C" fn(*const rmw_subscription_t, *mut usize) -> rmw_ret_t;
type CountSubscriptions = unsafe extern "C" fn(*const rmw_publisher_t, *mut usize) -> rmw_ret_t;
type NodeNames = unsafe extern "C" fn(
    *const rmw_node_t,
    *mut rcutils_string_array_t,
    *mut rcutils_string_array_t,
) -> rmw_ret_t;

/// The services that nodes have for their parameters.
const SERVICES: [&str; 6] = [
    "DescribeParameters",
    "GetParameterTypes",
    "GetParameters",
    "ListParameters",
    "SetParameters",
    "SetParametersAtomically",
];

/// One node: says that it is ready once all publishers, subscriptions and nodes have been found.
pub fn run(job: &Job) -> Result<()> {
    let name = format!("node_{}", std::process::id());
    // As shipped: Fast DDS has 32 nodes on a host at most that look for others there only.
    let node = Node::within(RMW_AUTOMATIC_DISCOVERY_RANGE_SUBNET, job, &name)?;
    node.publisher(types::message("rcl_interfaces", "Log")?, "/rosout")?;
    node.publisher(types::message("rcl_interfaces", "ParameterEvent")?, "/parameter_events")?;
    for service in SERVICES {
        let support = types::service("rcl_interfaces", service)?;
        node.service(support, &format!("/{name}/{}", service.to_lowercase()))?;
    }
    let support = types::message("geometry_msgs", "Twist")?;
    let (publisher, subscription) =
        (node.publisher(support, &job.topic)?, node.subscription(support, &job.topic)?);
    // SAFETY: rmw's functions; its protocol.
    let found = || unsafe {
        let (mut publishers, mut subscriptions) = (0, 0);
        let count: CountPublishers = node.function("rmw_subscription_count_matched_publishers")?;
        checked(count(subscription, &mut publishers), "matched publishers")?;
        let count: CountSubscriptions = node.function("rmw_publisher_count_matched_subscriptions")?;
        checked(count(publisher, &mut subscriptions), "matched subscriptions")?;
        if publishers.min(subscriptions) < job.way.topics {
            return Ok(false);
        }
        let [mut names, mut spaces] = [rcutils_string_array_t::default(); 2];
        let list: NodeNames = node.function("rmw_get_node_names")?;
        checked(list(node.node, &mut names, &mut spaces), "node names")?;
        let count = names.size;
        rcutils_string_array_fini(&mut names);
        rcutils_string_array_fini(&mut spaces);
        Result::Ok(count >= job.way.topics)
    };
    while !found()? {
        std::thread::sleep(LOOK);
    }
    say(&Line::Ready(None));
    // All have found each other once it is told to stop.
    until_told();
    say(&Line::Measured(Measured { cpu_ns: process_cpu_ns(), ..Measured::default() }));
    Ok(())
}
