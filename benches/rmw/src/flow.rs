// SPDX-License-Identifier: MIT OR Apache-2.0
//! What it costs to send at a rate: a process with publishers that one thread serves, one with as many subscriptions in a wait set.

use crate::rmw::{Node, Publish, STRUCT_BYTES, Take, Twist, Waiting, checked};
use crate::system::{PATIENCE, Starter, System, Task, measured, ready};
use crate::types;
use std::ptr::null_mut;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tautline_exchange::{Exchange, Inlet, Job, Line, Result, Role, Sink, Source, Stamp, Way, say, stop_flag};
use tautline_harness::rows::{Round, Row, rounded};

const TOPICS: usize = 20;
const RATE_HZ: usize = 100;

/// How often who receives looks whether it is to end.
const LOOK: Duration = Duration::from_millis(100);
/// How long what is under way may take to arrive.
const DRAIN: Duration = Duration::from_millis(500);

/// What it is called among the rows.
pub const EXPERIMENT: &str = "cpu";
pub const MODE: &str = "20 topics at 100 Hz";

/// The CPU time of both processes for each message.
pub fn measure(starter: &Starter<'_>, system: &System, budget: Duration) -> Result<Row> {
    let start = |role| {
        let exchange = Exchange::Paced { rate: (TOPICS * RATE_HZ) as f64 };
        let job = starter.job(system, role, exchange, budget);
        let way = Way { topics: TOPICS, subscribers: 1, at_once: true, ..job.way.clone() };
        starter.start(system, &Job { payload_bytes: STRUCT_BYTES, way, ..job }, Task::Flow)
    };
    let mut far = start(Role::Far)?;
    ready(&mut far, PATIENCE)?;
    let mut near = start(Role::Near)?;
    far.expect(PATIENCE, |line| matches!(line, Line::Connected { .. }).then_some(()))?;
    near.tell("go")?;
    let sent = measured(&mut near, PATIENCE + budget * 2)?;
    // Whether the last one has come: what has not is counted as lost.
    let _ = far.wait_for(DRAIN, |line| matches!(line, Line::Complete).then_some(()))?;
    far.tell("stop")?;
    let received = measured(&mut far, PATIENCE)?;
    near.finish()?;
    far.finish()?;
    let per_message = |cpu_ns: u64| cpu_ns as f64 / 1e3 / received.messages.max(1) as f64;
    let [publishing, subscribing] = [sent.cpu_ns, received.cpu_ns].map(per_message);
    let cpu_us_per_msg = Some(rounded(publishing + subscribing));
    Ok(Row {
        experiment: EXPERIMENT.to_owned(),
        system: system.name.to_owned(),
        mode: MODE.to_owned(),
        payload_bytes: STRUCT_BYTES,
        n: received.messages,
        lost: received.lost,
        cpu_us_per_msg,
        note: format!("publishing {publishing:.1} µs, subscribing {subscribing:.1} µs"),
        rounds: vec![Round { round: 1, n: received.messages, cpu_us_per_msg, ..Round::default() }],
        ..Row::default()
    })
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
