// SPDX-License-Identifier: MIT OR Apache-2.0
//! Both processes on Tautline.

use std::sync::{Arc, mpsc};
use std::time::Duration;

use ::tautline::{CallbackOptions, Context, Message, Node, Publisher, Qos, Realtime, Timer};
use futures::StreamExt;
use futures::future::join_all;
use tautline_paper::{
    Callback, Job, Line, Published, Role, Sampler, Scheduling, Structure, Subscriber, callback, priorities,
    say, set_up_publisher, structures,
};
use tautline_rt::clock;

use crate::Result;

/// The message of every topic: a 64-bit integer, as in the paper. It is the instant at which the message was due.
#[derive(Message, Clone, Copy, Default)]
#[repr(C)]
#[message(name = "std_msgs/msg/UInt64")]
struct Release {
    data: u64,
}

/// Time between set-up and the first release, which all topics have in common: the critical instant.
const LEAD: Duration = Duration::from_millis(200);

pub fn run(job: &str) -> Result<()> {
    let job: Job = serde_json::from_str(job)?;
    match job.role {
        Role::Publisher => publish(&job),
        Role::Subscriber => subscribe(&job),
    }
}

fn realtime(job: &Job) -> Realtime {
    if job.realtime { Realtime::Required } else { Realtime::Off }
}

/// A subscriber: five subscriptions of one node, executed as the variant says.
fn subscribe(job: &Job) -> Result<()> {
    let mut subscriber = Subscriber::new(job)?;
    let nort = job.variant.scheduling == Scheduling::Other;
    let context = Context::builder()
        .realtime(if nort { Realtime::Off } else { realtime(job) })
        .sampler_priority(match job.variant.scheduling {
            Scheduling::MiddlewareBelow => priorities::SAMPLER_BELOW,
            _ => priorities::SAMPLER,
        })
        .hold_idle(false) // the bench itself holds it
        .build()?;
    let mut node = Node::create(context.clone(), "subscriber", &job.namespace)?;
    let (mut callbacks, mut counters) = (Vec::new(), Vec::new());
    for (topic, log) in job.topics.iter().zip(subscriber.logs()) {
        let messages = node.subscribe::<Release>(&topic.name, Qos::keep_last(topic.depth))?;
        counters.push(messages.counters());
        callbacks.push(callback(topic, Arc::clone(log), messages, |message| message.data));
    }
    if job.variant.structure == Structure::FuturesRt {
        spin_with_callback_threads(job, &mut subscriber, &node, callbacks)?;
    } else {
        structures::run(job, &mut subscriber, Spinning(node), callbacks)?;
    }
    let counted_lost: Vec<_> = counters.iter().map(|counters| counters.lost()).collect();
    subscriber.finish(&counted_lost);
    Ok(())
}

/// The paper's proposal as Tautline has it: callback threads, and the main thread as the sampler.
fn spin_with_callback_threads(
    job: &Job,
    subscriber: &mut Subscriber,
    node: &Node,
    callbacks: Vec<Callback>,
) -> Result<()> {
    for (topic, callback) in job.topics.iter().zip(callbacks) {
        let options = CallbackOptions::fifo(topic.priority).name(topic.name.as_str()).period(topic.period());
        node.spawn_callback(options.execution_time(false), callback)?;
    }
    let context = node.context().clone();
    subscriber.when_over(move || context.shutdown());
    subscriber.ready();
    if job.variant.scheduling == Scheduling::MiddlewareOther {
        // The sampler is all there is of a middleware; `spin` would give it its priority.
        while node.context().is_valid() {
            node.context().spin_once(Duration::from_millis(100));
        }
    } else {
        node.spin()?;
    }
    Ok(())
}

/// r2r's way to spin, for the structures that both systems share.
struct Spinning(Node);

impl Sampler for Spinning {
    fn spin_once(&mut self, timeout: Duration) {
        self.0.spin_once(timeout);
    }
}

/// A sampler that serves absolute timers, and a worker below it that publishes.
fn publish(job: &Job) -> Result<()> {
    set_up_publisher(job)?;
    let context = Context::builder()
        .realtime(realtime(job))
        .sampler_priority(priorities::PUBLISHER)
        .hold_idle(false)
        .build()?;
    let mut node = Node::create(context.clone(), "publisher", &job.namespace)?;
    let first_ns = clock::monotonic_ns() + LEAD.as_nanos() as u64;
    let end_ns = first_ns + job.duration_ns();
    let mut tasks = Vec::new();
    for topic in &job.topics {
        let publisher = node.create_publisher::<Release>(&topic.name, Qos::keep_last(topic.depth))?;
        tasks.push(publish_until(publisher, node.create_wall_timer_at(first_ns, topic.period())?, end_ns));
    }
    let (events, (sender, counts)) = (context.events().clone(), mpsc::channel());
    let options = CallbackOptions::fifo(priorities::PUBLISHER_WORKER).name("publish").execution_time(false);
    let worker = node.spawn_callback(options, async move {
        let _ = sender.send(join_all(tasks).await);
        events.stop();
    })?;
    let cpu_before_ns = clock::process_cpu_ns();
    node.spin()?;
    let cpu_ns = clock::process_cpu_ns() - cpu_before_ns;
    worker.join()?;
    let (messages, missed): (_, Vec<u64>) = counts.recv()?.into_iter().unzip();
    say(&Line::Published(Published { messages, missed: missed.iter().sum(), cpu_ns }));
    Ok(())
}

/// Publishes a message at each release before `end_ns`; returns how many, and how many releases were missed.
async fn publish_until(publisher: Publisher<Release>, mut timer: Timer, end_ns: u64) -> (u64, u64) {
    let (mut sent, mut missed) = (0, 0);
    while let Some(tick) = timer.next().await {
        if tick.release_ns >= end_ns {
            break;
        }
        missed += tick.missed;
        // A loan is free again as soon as it is published.
        if let Ok(mut loan) = publisher.loan() {
            loan.data = tick.release_ns;
            sent += u64::from(loan.publish_released_at(tick.release_ns).is_ok());
        }
    }
    (sent, missed)
}
