// SPDX-License-Identifier: MIT OR Apache-2.0
//! The Autoware reference system on r2r, over whatever ROS 2 it was built with.
//!
//! Started by Tautline's `reference_system` with `--child` and a job as JSON. The nodes' work is the same source as there. As
//! r2r's examples have it one thread spins and runs all callbacks, on one `LocalPool`; or, if the job has placements, each callback
//! is a thread with a `LocalPool`, a priority and a core of its own. A `Node` of r2r's has a wait set of its own, so that the
//! callbacks of all 24 nodes are those of one. The middleware's threads inherit the priority of the thread that spins.
//! The message's 4096 bytes are the data of a `std_msgs/msg/UInt8MultiArray`, read in place where r2r has put them.

use std::ops::Deref;
use std::pin::Pin;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Poll;
use std::thread;
use std::time::Duration;

use futures::executor::LocalPool;
use futures::stream::{self, BoxStream};
use futures::task::LocalSpawnExt;
use futures::{FutureExt, Stream, StreamExt};
use r2r::std_msgs::msg::UInt8MultiArray;
use r2r::{Context, Node, Publisher, QosProfile};
use rival_r2r::{Result, program};
use tautline_msgs::{from_bytes, write_cdr};
use tautline_reference::graph::{CALLBACKS, Callback, Trigger};
use tautline_reference::{
    DEPTH, Input, Job, Kpis, Load, Message4kb, Output, Placement, Records, conduct, run as run_callback,
    window,
};
use tautline_rt::{
    CoreSet, MemoryLock, Policy, Realtime, ThreadBuilder, lock_memory, set_policy, tune_malloc,
};

/// Of the thread that spins: above all callbacks, and as Tautline's sampler.
const PRIORITY: u8 = 90;
/// How often it is looked whether the end has come.
const LOOK: Duration = Duration::from_millis(100);

fn main() -> ExitCode {
    program("reference-system", |job| {
        println!("{}", serde_json::to_string(&run(job)?)?);
        Ok(())
    })
}

fn run(job: &Job) -> Result<Kpis> {
    let load = Load::measure(job.cruncher_limit);
    let window = window(job);
    let records = Arc::new(Records::new(window));
    let over = Arc::new(AtomicBool::new(false));
    // While threads are ordinary.
    let conductor = thread::spawn({
        let over = Arc::clone(&over);
        move || {
            let usage = conduct(&window, |_| {});
            over.store(true, Ordering::Release);
            usage
        }
    });
    if job.realtime {
        tune_malloc();
        lock_memory(MemoryLock::OnFault)?;
        set_policy(Policy::Fifo(PRIORITY))?;
    }
    let mut node = Node::create(Context::create()?, "reference_system", "")?;
    let mut pool = LocalPool::new();
    for (index, callback) in CALLBACKS.iter().enumerate() {
        let (ends, limit, records) =
            (Ends::open(&mut node, callback)?, job.cruncher_limit, Arc::clone(&records));
        let callback = run_callback(index, limit, records, ends.timer, ends.inputs, ends.output);
        match job.placements.get(index) {
            None => pool.spawner().spawn_local(callback)?,
            Some(placement) => spawn(callback, *placement, job.realtime)?,
        }
    }
    while !over.load(Ordering::Acquire) {
        node.spin_once(LOOK);
        pool.run_until_stalled();
    }
    let usage = conductor.join().map_err(|_| "the thread that ends the run has panicked")?;
    let mode = if job.placements.is_empty() { "one LocalPool" } else { "a thread each" };
    Ok(Kpis::new("r2r", mode, job, &load, &records, &usage))
}

/// Gives a callback a thread, which ends with the process.
fn spawn(
    callback: impl Future<Output = ()> + Send + 'static,
    placement: Placement,
    realtime: bool,
) -> Result<()> {
    let thread = ThreadBuilder::new("callback")
        .policy(Policy::Fifo(placement.priority))
        .cores(CoreSet::one(placement.core));
    let realtime = if realtime { Realtime::Required } else { Realtime::Off };
    thread.realtime(realtime).spawn(move || move || LocalPool::new().run_until(callback))?;
    Ok(())
}

struct Ends {
    timer: Option<BoxStream<'static, Duration>>,
    inputs: Vec<Receiver>,
    output: Option<Sender>,
}

impl Ends {
    fn open(node: &mut Node, callback: &Callback) -> Result<Ends> {
        let qos = QosProfile::default().keep_last(DEPTH);
        let mut inputs = Vec::new();
        for topic in callback.inputs {
            inputs.push(Receiver(node.subscribe(&format!("/{topic}"), qos.clone())?.boxed()));
        }
        let output = match callback.output {
            Some(topic) => Some(Sender::new(node.create_publisher(&format!("/{topic}"), qos)?)),
            None => None,
        };
        let timer = match callback.trigger {
            Trigger::Period(period) => Some(ticks(node.create_wall_timer(period)?)),
            Trigger::Any | Trigger::All => None,
        };
        Ok(Ends { timer, inputs, output })
    }
}

/// Ends when the timer fails.
fn ticks(timer: r2r::Timer) -> BoxStream<'static, Duration> {
    stream::unfold(timer, |mut timer| async { timer.tick().await.ok().map(|elapsed| (elapsed, timer)) })
        .boxed()
}

/// A message and the array that is sent for it are made once.
struct Sender {
    publisher: Publisher<UInt8MultiArray>,
    message: Box<Message4kb>,
    array: UInt8MultiArray,
}

impl Sender {
    fn new(publisher: Publisher<UInt8MultiArray>) -> Sender {
        let array = UInt8MultiArray { data: vec![0; size_of::<Message4kb>()], ..Default::default() };
        Sender { publisher, message: Box::new(Message4kb::EMPTY), array }
    }
}

impl Output for Sender {
    fn publish(&mut self, fill: impl FnOnce(&mut Message4kb)) {
        fill(&mut self.message);
        write_cdr(&*self.message, &mut self.array.data).expect("the array has the message's size");
        self.publisher.publish(&self.array).expect("its node lives");
    }
}

struct Receiver(BoxStream<'static, UInt8MultiArray>);

/// An array that holds a message.
struct Received(UInt8MultiArray);

impl Deref for Received {
    type Target = Message4kb;

    fn deref(&self) -> &Message4kb {
        from_bytes(&self.0.data).expect("checked when it came")
    }
}

impl Input for Receiver {
    fn latest(&mut self) -> Option<Received> {
        // r2r queues up to ten messages behind the middleware's one.
        std::iter::from_fn(|| self.next().now_or_never().flatten()).last()
    }
}

impl Stream for Receiver {
    type Item = Received;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut std::task::Context<'_>) -> Poll<Option<Received>> {
        self.0.poll_next_unpin(context).map(|array| {
            let array = array?;
            // The allocator's alignment is more than the eight bytes that a message needs.
            from_bytes::<Message4kb>(&array.data).expect("only messages are sent here");
            Some(Received(array))
        })
    }
}
