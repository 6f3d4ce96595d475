// SPDX-License-Identifier: MIT OR Apache-2.0
//! `rmw_wait` and take of messages that are there: of one subscription among many, and under a system file.

use crate::rmw::{Node, Publish, STRUCT_BYTES, Take, Twist, Waiting, checked};
use crate::system::{Case, PATIENCE, Starter, System, Task, measured};
use crate::trips::Client;
use crate::types;
use std::ptr::null_mut;
use std::time::{Duration, Instant};
use tautline_exchange::{APPLICATION_PRIORITY, Exchange, Job, Line, Measured, Result, Role, Way, say};

/// As in the rows.
pub const EXPERIMENT: &str = "wait and take";
/// How long one message may take to be ready.
const LONGEST: Duration = Duration::from_secs(5);

/// Subscriptions of a wait set, and those of them that have a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Waits {
    pub client: Client,
    pub ready: usize,
    pub of: usize,
    /// By a system file, which orders the callbacks by their priorities.
    pub is_governed: bool,
}

impl Case for Waits {
    fn is_governed(self) -> bool {
        self.is_governed
    }

    fn experiment(self, _is_held: bool) -> String {
        match self.client {
            Client::C => EXPERIMENT.to_owned(),
            client => format!("{}, {EXPERIMENT}", client.name()),
        }
    }

    fn bytes(self) -> usize {
        STRUCT_BYTES
    }

    fn name(self) -> String {
        format!("{} of {} ready", self.ready, self.of)
    }

    fn measure(self, starter: &Starter<'_>, system: &System, length: Duration) -> Result<Measured> {
        let job = starter.job(system, Role::Near, Exchange::RoundTrips, length);
        let way = Way { topics: self.of, subscribers: self.ready, ..job.way.clone() };
        let job = Job { payload_bytes: STRUCT_BYTES, way, ..job };
        let file = self.file(|| system_file(self, &job))?;
        let mut process = match self.client {
            Client::C => starter.start_governed(system, &job, Task::Waits, file.as_ref())?,
            client => starter.start_client(client, system, &job, ("ready", self.of), file.as_ref())?,
        };
        let measured = measured(&mut process, PATIENCE)?;
        process.finish()?;
        Ok(measured)
    }
}

/// A system file with a group of all callbacks.
fn system_file(waits: Waits, job: &Job) -> String {
    let head = format!(
        "[hosts.here]\ncores = [{}]\n[nodes.near]\nclient = \"rclcpp\"\n[groups.all]\norder = \"priority\"\npriority = {APPLICATION_PRIORITY}\n",
        job.core.unwrap_or(0)
    );
    let callbacks = (0..waits.of).map(|index| {
            let (topic, rank) = (topic(job, index), index * 7 % waits.of % 99 + 1);
            format!(
                "[callbacks.c{index}]\ntopic = \"{topic}\"\ngroup = \"all\"\npriority = {rank}\nwcet = \"1us\"\n[topics.\"{topic}\"]\nperiod = \"1s\"\n"
            )
        });
    std::iter::once(head).chain(callbacks).collect()
}

fn topic(job: &Job, index: usize) -> String {
    format!("{}/of_{index}", job.topic)
}

/// Publishes, then waits for it and takes it, in one thread; times the latter, for each message.
pub fn run(job: &Job) -> Result<()> {
    let own = job.clone();
    job.as_application(move || {
        let node = Node::new(&own, "near")?;
        let support = types::message("geometry_msgs", "Twist")?;
        let subscriptions: Result<Vec<_>> =
            (0..own.way.topics).map(|index| node.subscription(support, &topic(&own, index))).collect();
        let mut waiting = node.waiting(subscriptions?)?;
        // Of many that are ready all, of one the last.
        let ready = own.way.topics - own.way.subscribers..own.way.topics;
        let publishers: Result<Vec<_>> =
            ready.map(|index| node.publisher(support, &topic(&own, index))).collect();
        // SAFETY: rmw's functions.
        let (publish, take): (Publish, Take) =
            unsafe { (node.function("rmw_publish")?, node.function("rmw_take")?) };
        let (publishers, mut times_ns) = (publishers?, Vec::with_capacity(1 << 20));
        let round = |waiting: &mut Waiting| -> Result<u64> {
            for publisher in &publishers {
                let mut message = Twist::default();
                // SAFETY: rmw's protocol.
                checked(unsafe { publish(*publisher, message.place(), null_mut()) }, "publish")?;
            }
            let (since, mut taken) = (Instant::now(), 0);
            while taken < publishers.len() {
                if !waiting.wait(LONGEST)? {
                    return Err(format!("{taken} of {} messages arrived", publishers.len()).into());
                }
                taken += take_ready(waiting, take)?;
            }
            Ok(since.elapsed().as_nanos() as u64 / publishers.len() as u64)
        };
        // Once they are connected: what is published before that may be lost.
        connect(&mut waiting, &publishers, publish, take)?;
        let end = Instant::now() + own.budget;
        while Instant::now() < end && times_ns.len() < times_ns.capacity() {
            times_ns.push(round(&mut waiting)?);
        }
        say(&Line::Measured(Measured { times_ns, ..Measured::default() }));
        Ok(())
    })
}

/// Publishes on each topic until a message arrives, and takes what is under way then.
fn connect(
    waiting: &mut Waiting,
    publishers: &[*mut crate::bindings::rmw_publisher_t],
    publish: Publish,
    take: Take,
) -> Result<()> {
    let end = Instant::now() + PATIENCE;
    for publisher in publishers {
        loop {
            let mut message = Twist::default();
            // SAFETY: rmw's protocol.
            checked(unsafe { publish(*publisher, message.place(), null_mut()) }, "publish")?;
            if waiting.wait(Duration::from_millis(10))? {
                break;
            }
            if Instant::now() > end {
                return Err("its publishers and subscriptions do not find each other".into());
            }
        }
        while waiting.wait(Duration::from_millis(10))? {
            take_ready(waiting, take)?;
        }
    }
    Ok(())
}

/// Takes one message of each subscription that has some; says how many.
fn take_ready(waiting: &Waiting, take: Take) -> Result<usize> {
    let mut count = 0;
    for (index, subscription) in waiting.subscriptions.iter().enumerate() {
        if waiting.is_ready(index) {
            let (mut message, mut taken) = (Twist::default(), false);
            // SAFETY: rmw's protocol.
            checked(unsafe { take(*subscription, message.place(), &mut taken, null_mut()) }, "take")?;
            count += usize::from(taken);
        }
    }
    Ok(count)
}
