// SPDX-License-Identifier: MIT OR Apache-2.0
//! The publisher process: a sampler that serves five absolute timers, a worker thread that publishes.

use super::application::{self, MomentCollector, Stamped};
use super::args::DemoArgs;
use super::protocol::{self, Line, Published};
use crate::verb::Outcome;
use futures::StreamExt;
use futures::future::join_all;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use tautline::{CallbackOptions, Node, Publisher, Timer};
use tautline_rt::clock;

/// Time between set-up and the first release, which all topics have in common: the critical instant.
const LEAD: Duration = Duration::from_millis(200);

pub fn run(args: &DemoArgs) -> Outcome {
    super::conductor::ignore_terminal_signals();
    let elsewhere = application::bind(args.core)?;
    let context = application::context(args, application::PUBLISHER_SAMPLER_PRIORITY).build()?;
    let mut node = Node::create(context.clone(), "publisher", &args.namespace)?;
    let first_ns = clock::monotonic_ns() + LEAD.as_nanos() as u64;
    let end_ns = first_ns + Duration::from_secs(args.seconds).as_nanos() as u64;
    let mut tasks = Vec::new();
    for task in application::tasks()? {
        let publisher = node.create_publisher::<Stamped>(&task.name, application::qos())?;
        let timer = node.create_wall_timer_at(first_ns, Duration::from_nanos(task.period_ns))?;
        tasks.push((publisher, timer));
    }
    let counts = Arc::new(Counts::default());
    let worker = {
        let (context, counts) = (context.clone(), counts.clone());
        // All processor time of this thread is overhead, so it is recorded as an overrun of its budget, and each wait as that of a late job.
        let options = CallbackOptions::fifo(application::PUBLISHER_WORKER_PRIORITY)
            .name("publish")
            .bound(Duration::from_nanos(1))
            .budget(Duration::from_nanos(1));
        node.spawn_callback(options, async move {
            join_all(
                tasks.into_iter().map(|(publisher, timer)| publish(publisher, timer, end_ns, counts.clone())),
            )
            .await;
            context.shutdown();
        })?
    };
    let collector = MomentCollector::new(&context, elsewhere, [&worker], || {});
    let cpu_ns = protocol::spin(&context)?;
    worker.stop();
    let (messages, missed) = (counts.messages.load(Ordering::Relaxed), counts.missed.load(Ordering::Relaxed));
    let seen = collector.end();
    let cpu_ns = cpu_ns.saturating_sub(seen.cpu_ns);
    protocol::say(&Line::Published(Published { messages, cpu_ns, missed, seen }));
    Ok(())
}

#[derive(Default)]
struct Counts {
    messages: AtomicU64,
    missed: AtomicU64,
}

/// Publishes one message at each release before `end_ns`, stamped with the instant at which it was due.
async fn publish(publisher: Publisher<Stamped>, mut timer: Timer, end_ns: u64, counts: Arc<Counts>) {
    while let Some(tick) = timer.next().await {
        if tick.release_ns >= end_ns {
            return;
        }
        counts.missed.fetch_add(tick.missed, Ordering::Relaxed);
        // A loan is free again as soon as it is published.
        if let Ok(mut loan) = publisher.loan() {
            *loan = Stamped { counter: tick.index, release_ns: tick.release_ns };
            if loan.publish_released_at(tick.release_ns).is_ok() {
                counts.messages.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}
