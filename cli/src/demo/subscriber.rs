// SPDX-License-Identifier: MIT OR Apache-2.0
//! The subscriber process: the sampler on the main thread, one callback thread per topic.

use super::application::{self, MomentCollector, Stamped, Topic};
use super::protocol::{self, Line, Measured, TopicMeasured};
use super::{DemoArgs, DemoError};
use futures::StreamExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;
use tautline::rt::clock;
use tautline::{CallbackOptions, Node, SubscriptionCounters};

pub fn run(args: &DemoArgs) -> Result<(), DemoError> {
    super::conductor::ignore_interrupts();
    if let Some(core) = args.core {
        application::bind(core)?;
    }
    let context = application::context(args, application::sampler_priority(args)?).build()?;
    let mut node = Node::create(context.clone(), "subscriber", &args.namespace)?;
    let mut callbacks = Vec::new();
    for topic in application::topics()? {
        let subscription = node.subscribe::<Stamped>(&topic.name, application::qos())?;
        let log = Arc::new(Log::for_run(&topic, args.seconds));
        let (counters, wcet) = (subscription.counters(), topic.wcet);
        let options = CallbackOptions::fifo(topic.priority)
            .name(topic.name.as_str())
            .period(topic.period)
            .execution_time(false);
        let handle = {
            let log = log.clone();
            node.spawn_callback(
                options,
                subscription.for_each(move |message| {
                    clock::burn_cpu(wcet);
                    log.note(message.release_ns, clock::monotonic_ns());
                    async {}
                }),
            )?
        };
        callbacks.push(Callback { topic, log, counters, handle });
    }
    {
        let context = context.clone();
        protocol::when_told_to_end(move || context.shutdown());
    }
    let logs: Vec<_> = callbacks.iter().map(|callback| callback.log.clone()).collect();
    let collector = MomentCollector::new(callbacks.iter().map(|callback| &callback.handle), move || {
        let handled: usize = logs.iter().map(|log| log.count.load(Ordering::Relaxed)).sum();
        protocol::say(&Line::Progress(handled as u64));
    });
    let cpu_before_ns = clock::process_cpu_ns();
    protocol::say(&Line::Ready);
    node.spin()?;
    let cpu_ns = clock::process_cpu_ns() - cpu_before_ns;
    protocol::say(&Line::Measured(measured(callbacks, collector, cpu_ns)?));
    Ok(())
}

struct Callback {
    topic: Topic,
    log: Arc<Log>,
    counters: Arc<SubscriptionCounters>,
    handle: tautline::CallbackHandle,
}

fn measured(
    callbacks: Vec<Callback>,
    collector: MomentCollector,
    cpu_ns: u64,
) -> Result<Measured, DemoError> {
    let (mut topics, mut busy_ns) = (Vec::new(), 0);
    for callback in callbacks {
        callback.handle.stop();
        callback.handle.join().map_err(tautline::Error::from)?;
        let (releases_ns, latencies_ns): (Vec<_>, Vec<_>) = callback.log.jobs().unzip();
        busy_ns += latencies_ns.len() as u64 * callback.topic.wcet.as_nanos() as u64;
        let (lost, max_queue) = (callback.counters.lost(), callback.counters.max_queue());
        topics.push(TopicMeasured { releases_ns, latencies_ns, lost, max_queue });
    }
    Ok(Measured { overhead_cpu_ns: cpu_ns.saturating_sub(busy_ns), topics, moments: collector.end() })
}

/// Where a callback writes its releases and response times: memory that is there before it starts.
struct Log {
    entries: Box<[[AtomicU64; 2]]>,
    count: AtomicUsize,
}

impl Log {
    /// Room for the run's messages and a quarter more.
    fn for_run(topic: &Topic, seconds: u64) -> Self {
        let messages = Duration::from_secs(seconds).as_nanos() / topic.period.as_nanos();
        let room = (messages + messages / 4 + 16) as usize;
        Log { entries: (0..room).map(|_| Default::default()).collect(), count: AtomicUsize::new(0) }
    }

    fn note(&self, release_ns: u64, end_ns: u64) {
        let index = self.count.load(Ordering::Relaxed);
        if let Some([release, latency]) = self.entries.get(index) {
            release.store(release_ns, Ordering::Relaxed);
            latency.store(end_ns.saturating_sub(release_ns), Ordering::Relaxed);
            self.count.store(index + 1, Ordering::Release);
        }
    }

    /// Each release with its response time.
    fn jobs(&self) -> impl Iterator<Item = (u64, u64)> {
        let count = self.count.load(Ordering::Acquire);
        let value = |word: &AtomicU64| word.load(Ordering::Relaxed);
        self.entries[..count].iter().map(move |[release, latency]| (value(release), value(latency)))
    }
}
