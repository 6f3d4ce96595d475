// SPDX-License-Identifier: MIT OR Apache-2.0
//! The subscriber process: the sampler on the main thread, one callback thread per topic.

use super::application::{self, MomentCollector, Stamped};
use super::args::DemoArgs;
use super::protocol::{self, Job, Line, Measured, TopicMeasured};
use crate::verb::Outcome;
use futures::StreamExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;
use tautline::{CallbackOptions, Node, SubscriptionCounters};
use tautline_analysis::Task;
use tautline_rt::{CoreMark, CoreTime, clock};

pub fn run(args: &DemoArgs) -> Outcome {
    super::conductor::ignore_terminal_signals();
    let elsewhere = application::bind(args.core)?;
    let context = application::context(args, application::sampler_priority(args)?).build()?;
    let mut node = Node::create(context.clone(), "subscriber", &args.namespace)?;
    let mut callbacks = Vec::new();
    for task in application::tasks()? {
        let subscription = node.subscribe::<Stamped>(&task.name, application::qos())?;
        let log = Arc::new(Log::for_run(&task, args.seconds));
        let [period, wcet] = [task.period_ns, task.wcet_ns].map(Duration::from_nanos);
        let counters = subscription.counters();
        let options =
            CallbackOptions::fifo(task.priority).name(task.name.as_str()).period(period).budget(wcet);
        let handle = {
            let log = log.clone();
            node.spawn_local(options, move || {
                let core_time = CoreTime::new();
                // Without these clocks the executor, which needs them too, has refused to start, and no job runs.
                let mark = move || core_time.as_ref().map_or_else(|_| CoreMark::default(), CoreTime::mark);
                let mut before = mark();
                subscription.for_each(move |message| {
                    let begin = mark();
                    clock::burn_cpu(wcet);
                    let end = mark();
                    log.note(message.release_ns, [&std::mem::replace(&mut before, end), &begin, &end]);
                    async {}
                })
            })?
        };
        callbacks.push(Callback { task, log, counters, handle });
    }
    let logs: Vec<_> = callbacks.iter().map(|callback| callback.log.clone()).collect();
    let collector = MomentCollector::new(
        &context,
        elsewhere,
        callbacks.iter().map(|callback| &callback.handle),
        move || {
            let handled: usize = logs.iter().map(|log| log.count.load(Ordering::Relaxed)).sum();
            protocol::say(&Line::Progress(handled as u64));
        },
    );
    let cpu_ns = protocol::spin(&context)?;
    protocol::say(&Line::Measured(measured(callbacks, collector, cpu_ns)?));
    Ok(())
}

struct Callback {
    task: Task,
    log: Arc<Log>,
    counters: Arc<SubscriptionCounters>,
    handle: tautline::CallbackHandle,
}

fn measured(callbacks: Vec<Callback>, collector: MomentCollector, cpu_ns: u64) -> Outcome<Measured> {
    let (mut topics, mut busy_ns) = (Vec::new(), 0);
    for callback in callbacks {
        callback.handle.stop();
        callback.handle.join().map_err(tautline::Error::from)?;
        let jobs: Vec<_> = callback.log.jobs().collect();
        busy_ns += jobs.len() as u64 * callback.task.wcet_ns;
        let (lost, max_queue) = (callback.counters.lost(), callback.counters.max_queue());
        topics.push(TopicMeasured { jobs, lost, max_queue });
    }
    let seen = collector.end();
    let overhead_cpu_ns = cpu_ns.saturating_sub(busy_ns + seen.cpu_ns);
    Ok(Measured { overhead_cpu_ns, topics, seen })
}

/// The buffer into which a callback writes its jobs; allocated before the callback starts.
struct Log {
    /// Release, time from which the thread was ready, begin, end, and time that it waited, as in `Job`.
    entries: Box<[[AtomicU64; 5]]>,
    count: AtomicUsize,
}

impl Log {
    /// Room for the run's messages and a quarter more.
    fn for_run(task: &Task, seconds: u64) -> Self {
        let messages = Duration::from_secs(seconds).as_nanos() / u128::from(task.period_ns);
        let room = (messages + messages / 4 + 16) as usize;
        Log { entries: (0..room).map(|_| Default::default()).collect(), count: AtomicUsize::new(0) }
    }

    /// Records a job; `before` is the end of the previous one.
    fn note(&self, release_ns: u64, [before, begin, end]: [&CoreMark; 3]) {
        let index = self.count.load(Ordering::Relaxed);
        if let Some(entry) = self.entries.get(index) {
            // The wait before the job's beginning counts only from its release: the thread waited the rest before it slept.
            let waited_ns = before.waited_until(begin).unwrap_or(0);
            let ready_ns = begin.from_ns.saturating_sub(waited_ns).max(release_ns).min(begin.from_ns);
            // The time of reading a mark belongs to the job.
            let waited_ns = begin.from_ns - ready_ns + begin.waited_until(end).unwrap_or(0);
            for (word, value) in entry.iter().zip([release_ns, ready_ns, begin.from_ns, end.to_ns, waited_ns])
            {
                word.store(value, Ordering::Relaxed);
            }
            self.count.store(index + 1, Ordering::Release);
        }
    }

    fn jobs(&self) -> impl Iterator<Item = Job> {
        let count = self.count.load(Ordering::Acquire);
        self.entries[..count].iter().map(|entry| {
            let [release_ns, ready_ns, begin_ns, end_ns, waited_ns] =
                entry.each_ref().map(|word| word.load(Ordering::Relaxed));
            Job { release_ns, ready_ns, begin_ns, end_ns, waited_ns }
        })
    }
}
