// SPDX-License-Identifier: MIT OR Apache-2.0
//! Tautline as its users have it: a node, one callback thread for all subscriptions of a process, the main thread as the sampler.

use super::{IMAGE_BYTES, LOOK, Publishing, SMALL_BYTES};
use futures::StreamExt;
use futures::TryStreamExt;
use futures::stream::FuturesUnordered;
use std::sync::mpsc;
use tautline::{
    CallbackOptions, Context, Limits, Message, Node, Plain, Publisher, Qos, Realtime, Subscription,
};
use tautline_exchange::{
    APPLICATION_PRIORITY, Inlet, Job, Line, Measured, Result, Role, Sink, Source, Stamp, on_stop, say,
    stop_flag,
};
use tautline_rt::clock::monotonic_ns;

/// The sampler's priority: above the callbacks'.
const SAMPLER_PRIORITY: u8 = APPLICATION_PRIORITY + 10;

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "bench_msgs/msg/Small")]
struct Small {
    bytes: [u8; SMALL_BYTES],
}

#[derive(Message, Clone, Copy)]
#[repr(C)]
#[message(name = "bench_msgs/msg/Picture")]
struct Picture {
    bytes: [u8; IMAGE_BYTES],
}

trait Frame: Message + Plain {
    fn bytes(&self) -> &[u8];
    fn bytes_mut(&mut self) -> &mut [u8];
}

macro_rules! frame {
    ($name:ty) => {
        impl Frame for $name {
            fn bytes(&self) -> &[u8] {
                &self.bytes
            }

            fn bytes_mut(&mut self) -> &mut [u8] {
                &mut self.bytes
            }
        }
    };
}
frame!(Small);
frame!(Picture);

pub fn run(job: &Job, is_direct: bool) -> Result<()> {
    match job.payload_bytes {
        SMALL_BYTES => play::<Small>(job, is_direct),
        _ => play::<Picture>(job, is_direct),
    }
}

fn play<T: Frame>(job: &Job, is_direct: bool) -> Result<()> {
    let realtime = if job.realtime { Realtime::Required } else { Realtime::Off };
    let context = Context::builder().domain(job.domain).realtime(realtime).sampler_priority(SAMPLER_PRIORITY);
    let context = job.core.map_or(context.clone(), |core| context.sampler_core(core)).build()?;
    let node = Node::create(context.clone(), if job.role == Role::Near { "near" } else { "far" }, "")?;
    let options = CallbackOptions::fifo(APPLICATION_PRIORITY).name("callback");
    let options = job.core.map_or(options.clone(), |core| options.core(core));
    let options = if is_direct { options.direct_wake() } else { options };
    match job.role {
        Role::Near => send::<T>(job, &context, node, options),
        Role::Far => receive::<T>(job, &context, node, options),
    }
}

fn limits() -> Limits {
    Limits { held: 2, loans: 2, ..Limits::default() }
}

fn send<T: Frame>(job: &Job, context: &Context, mut node: Node, options: CallbackOptions) -> Result<()> {
    let mut publishers: Vec<Publisher<T>> = Vec::new();
    for topic in 0..job.way.topics {
        let topic = format!("{}/t{topic}", job.topic);
        node.set_topic_limits(&topic, limits())?;
        publishers.push(node.create_publisher(&topic, Qos::keep_last(job.depth()))?);
    }
    let (own, end) = (job.clone(), context.events().clone());
    let (sender, outcome) = mpsc::channel();
    let callback = node.spawn_callback(options, async move {
        let sent = publish_all(&own, &publishers);
        let _ = sender.send(sent.map(|measured| (measured, publishers)));
        end.stop();
    })?;
    node.spin()?;
    callback.join()?;
    let (measured, publishers) = outcome.recv()??;
    say(&Line::Measured(measured));
    // The end of a publisher wakes subscriptions once more.
    std::thread::sleep(LOOK);
    drop(publishers);
    Ok(())
}

fn publish_all<T: Frame>(job: &Job, publishers: &[Publisher<T>]) -> Result<Measured> {
    let (mut source, mut publishing) = (Source::new(job, stop_flag()), Publishing::of(job));
    while let Some((topic, stamp)) = source.next() {
        let start_ns = monotonic_ns();
        let mut loan = publishers[topic].loan()?;
        stamp.write(loan.bytes_mut(), false);
        loan.publish().map_err(|unpublished| unpublished.to_string())?;
        publishing.add(monotonic_ns() - start_ns);
    }
    Ok(publishing.into(source.measured()))
}

fn receive<T: Frame>(job: &Job, context: &Context, mut node: Node, options: CallbackOptions) -> Result<()> {
    let sink = Sink::new(job);
    let mut ends: Vec<(Subscription<T>, Inlet)> = Vec::new();
    for (topic, inlet) in sink.inlets(job) {
        let topic = format!("{}/t{topic}", job.topic);
        node.set_topic_limits(&topic, limits())?;
        ends.push((node.subscribe(&topic, Qos::keep_last(job.depth()))?, inlet));
    }
    let (sender, outcome) = mpsc::channel();
    // A callback that held the context would keep it alive.
    let end = context.events().clone();
    let _callback = node.spawn_callback(options, async move {
        // Only woken ones are checked.
        let all = ends.into_iter().map(|(messages, inlet)| take_all(messages, inlet));
        if let Err(error) = all.collect::<FuturesUnordered<_>>().try_collect::<()>().await {
            let _ = sender.send(error);
            end.stop();
        }
    })?;
    let end = context.events().clone();
    on_stop(move || end.stop());
    say(&Line::Ready(None));
    node.spin()?;
    if let Ok(error) = outcome.try_recv() {
        return Err(error);
    }
    say(&Line::Measured(sink.measured()));
    Ok(())
}

async fn take_all<T: Frame>(mut messages: Subscription<T>, inlet: Inlet) -> Result<()> {
    while let Some(message) = messages.next().await {
        let stamp = Stamp::read(message.bytes(), false)?;
        // A message has arrived when its memory is returned.
        drop(message);
        inlet.arrive(stamp);
    }
    Ok(())
}
