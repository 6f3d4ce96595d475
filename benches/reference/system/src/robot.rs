// SPDX-License-Identifier: MIT OR Apache-2.0
//! The nodes on Tautline: loaned messages, written and read in shared memory; a thread for each callback.

use futures::Stream;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::thread;
use tautline::{
    Admission, Context, ContextBuilder, Node, Publisher, Qos, Realtime, Sample, Subscription, Timer,
};
use tautline_reference::graph::{CALLBACKS, Callback, Trigger};
use tautline_reference::{DEPTH, Input, Job, Kpis, Load, Message4kb, Output, Records, conduct, window};
use tautline_rt::clock::monotonic_ns;

use crate::Result;

/// Time between set-up and the first release, which all timers have in common: the critical instant.
const LEAD_NS: u64 = 200_000_000;

/// Runs all nodes in this process, which then is a process without nodes again. If it `accounts` for the time of cores, `taut report`
/// explains what was late; otherwise the environment says whether.
pub fn run(
    job: &Job,
    load: &Load,
    accounts: bool,
    progress: impl FnMut(f64) + Send + 'static,
) -> Result<Kpis> {
    let file = job.system_file.as_deref().ok_or("a system file says who runs where")?;
    let realtime = if job.realtime { Realtime::Required } else { Realtime::Off };
    // What the analysis refuses is measured, too.
    let mut context = Context::builder().system(file).realtime(realtime).admission(Admission::Force);
    if accounts {
        context = context.account_core_time(Some(ContextBuilder::CORE_TIME_PIECE));
    }
    let context = context.build()?;
    let window = window(job);
    let records = Arc::new(Records::new(window));
    let first_ns = monotonic_ns() + LEAD_NS;
    let (mut nodes, mut callbacks) = (Vec::new(), Vec::new());
    for of_node in CALLBACKS.chunk_by(|a, b| a.node == b.node) {
        let mut node = Node::create(context.clone(), of_node[0].node, "")?;
        for callback in of_node {
            let ends = Ends::open(&mut node, callback, first_ns)?;
            let (index, limit, records) = (callbacks.len(), job.cruncher_limit, Arc::clone(&records));
            let run = tautline_reference::run(index, limit, records, ends.timer, ends.inputs, ends.output);
            callbacks.push(node.spawn_callback(context.callback(callback.name)?, run)?);
        }
        nodes.push(node);
    }
    let events = context.events().clone();
    let conductor = thread::spawn(move || {
        let usage = conduct(&window, progress);
        events.stop();
        usage
    });
    context.spin()?;
    let usage = conductor.join().map_err(|_| "the thread that ends the run has panicked")?;
    callbacks.iter().for_each(|callback| callback.stop());
    callbacks.into_iter().try_for_each(|callback| callback.join())?;
    Ok(Kpis::new("tautline", mode(file), job, load, &records, &usage))
}

/// The file's name says how callbacks are executed.
fn mode(file: &Path) -> &str {
    file.file_name().and_then(|name| name.to_str()).unwrap_or("a system file")
}

struct Ends {
    timer: Option<Timer>,
    inputs: Vec<Receiver>,
    output: Option<Sender>,
}

impl Ends {
    fn open(node: &mut Node, callback: &Callback, first_ns: u64) -> Result<Ends> {
        let qos = Qos::keep_last(DEPTH);
        let mut inputs = Vec::new();
        for topic in callback.inputs {
            inputs.push(Receiver(node.subscribe(&format!("/{topic}"), qos)?));
        }
        let output = match callback.output {
            Some(topic) => Some(Sender(node.create_publisher(&format!("/{topic}"), qos)?)),
            None => None,
        };
        let timer = match callback.trigger {
            Trigger::Period(period) => Some(node.create_wall_timer_at(first_ns, period)?),
            Trigger::Any | Trigger::All => None,
        };
        Ok(Ends { timer, inputs, output })
    }
}

struct Sender(Publisher<Message4kb>);

impl Output for Sender {
    fn publish(&mut self, fill: impl FnOnce(&mut Message4kb)) {
        let mut message = self.0.loan().expect("one loan at a time is within the limits");
        fill(&mut message);
        message.publish().expect("keep-last never refuses");
    }
}

struct Receiver(Subscription<Message4kb>);

impl Input for Receiver {
    fn latest(&mut self) -> Option<Sample<Message4kb>> {
        // The queue keeps one. What is no message cannot come: the only publishers are in this process.
        self.0.try_take().ok().flatten()
    }
}

impl Stream for Receiver {
    type Item = Sample<Message4kb>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut std::task::Context<'_>) -> Poll<Option<Self::Item>> {
        Pin::new(&mut self.0).poll_next(context)
    }
}
