// SPDX-License-Identifier: MIT OR Apache-2.0
//! What it costs to send at a rate: a process with publishers that one thread serves, one with as many subscriptions in a wait set.

use crate::rmw::{Node, Publish, STRUCT_BYTES, Take, Twist, Waiting, checked};
use crate::system::{PATIENCE, Starter, System, Task, measured, ready, said};
use crate::types;
use serde_json::{Value, json};
use std::fmt;
use std::ptr::null_mut;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tautline_exchange::{Exchange, Inlet, Job, Line, Result, Role, Sink, Source, Stamp, Way, say, stop_flag};

pub const TOPICS: usize = 20;
pub const RATE_HZ: usize = 100;

/// How often who receives looks whether it is to end.
const LOOK: Duration = Duration::from_millis(100);
/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(500);

pub const HEAD: &str = "system            publishing  subscribing   CPU ms/s  n received    lost";

pub struct Row {
    pub system: &'static str,
    /// CPU time of a process in ms for each second.
    publishing: f64,
    subscribing: f64,
    received: u64,
    pub lost: u64,
}

impl Row {
    pub fn measure(starter: &Starter<'_>, system: &System, budget: Duration) -> Result<Self> {
        let start = |role| {
            let exchange = Exchange::Paced { rate: (TOPICS * RATE_HZ) as f64 };
            let job = starter.job(system, role, exchange, budget);
            let way = Way { topics: TOPICS, subscribers: 1, at_once: true, ..job.way.clone() };
            starter.start(system, &Job { payload_bytes: STRUCT_BYTES, way, ..job }, Task::Flow)
        };
        let mut far = start(Role::Far)?;
        ready(&mut far, PATIENCE)?;
        let mut near = start(Role::Near)?;
        said(far.expect(PATIENCE, |line| matches!(line, Line::Connected { .. }).then_some(())))?;
        said(near.tell("go"))?;
        let sent = measured(&mut near, PATIENCE + budget * 2)?;
        // Whether the last one has come: what has not is counted as lost.
        let _ = said(far.wait_for(DRAIN, |line| matches!(line, Line::Complete { .. }).then_some(())))?;
        said(far.tell("stop"))?;
        let received = measured(&mut far, PATIENCE)?;
        said(near.finish())?;
        said(far.finish())?;
        let per_second = |cpu_ns: u64| cpu_ns as f64 / 1e6 / sent.seconds;
        Ok(Row {
            system: system.name,
            publishing: per_second(sent.cpu_ns),
            subscribing: per_second(received.cpu_ns),
            received: received.messages,
            lost: received.lost,
        })
    }

    pub fn cpu_ms_per_s(&self) -> f64 {
        self.publishing + self.subscribing
    }

    pub fn to_json(&self) -> Value {
        json!({
            "system": self.system, "topics": TOPICS, "rate_hz": RATE_HZ, "publishing_cpu_ms_per_s": self.publishing,
            "subscribing_cpu_ms_per_s": self.subscribing, "cpu_ms_per_s": self.cpu_ms_per_s(),
            "received": self.received, "lost": self.lost,
        })
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<18}{:>10.1}{:>13.1}", self.system, self.publishing, self.subscribing)?;
        write!(f, "{:>11.1}{:>12}{:>8}", self.cpu_ms_per_s(), self.received, self.lost)
    }
}

/// Plays one end.
pub fn run(job: &Job) -> Result<()> {
    let (own, stop) = (job.clone(), stop_flag());
    job.as_application(move || {
        let node = Node::new(&own, &format!("{:?}", own.role).to_lowercase())?;
        let support = types::message("geometry_msgs", "Twist")?;
        let topics = (0..own.way.topics).map(|index| format!("{}/of_{index}", own.topic));
        if own.role == Role::Near {
            let publishers: Result<Vec<_>> = topics.map(|topic| node.publisher(support, &topic)).collect();
            // SAFETY: rmw's function.
            let (publishers, publish): (_, Publish) = (publishers?, unsafe { node.function("rmw_publish")? });
            let mut source = Source::new(&own, stop);
            while let Some((topic, stamp)) = source.next() {
                let mut message = Twist([stamp.number, stamp.sent_ns, 2, 3, 4, 5].map(f64::from_bits));
                // SAFETY: rmw's protocol.
                checked(unsafe { publish(publishers[topic], message.place(), null_mut()) }, "publish")?;
            }
            say(&Line::Measured(source.measured()));
            return Ok(());
        }
        let subscriptions: Result<Vec<_>> = topics.map(|topic| node.subscription(support, &topic)).collect();
        let (mut waiting, sink) = (node.waiting(subscriptions?)?, Sink::new(&own));
        // SAFETY: rmw's function.
        let (inlets, take): (_, Take) = (sink.inlets(&own), unsafe { node.function("rmw_take")? });
        say(&Line::Ready(None));
        while !stop.load(Ordering::Relaxed) {
            if waiting.wait(LOOK)? {
                arrive(&waiting, &inlets, take)?;
            }
        }
        say(&Line::Measured(sink.measured()));
        Ok(())
    })
}

/// Takes one message of each subscription that has some.
fn arrive(waiting: &Waiting, inlets: &[(usize, Inlet)], take: Take) -> Result<()> {
    for (index, subscription) in waiting.subscriptions.iter().enumerate() {
        if !waiting.is_ready(index) {
            continue;
        }
        let (mut message, mut taken) = (Twist::default(), false);
        // SAFETY: rmw's protocol.
        checked(unsafe { take(*subscription, message.place(), &mut taken, null_mut()) }, "take")?;
        let [number, sent_ns, ..] = message.0.map(f64::to_bits);
        if taken {
            inlets[index].1.arrive(Stamp { number, sent_ns });
        }
    }
    Ok(())
}
