// SPDX-License-Identifier: MIT OR Apache-2.0
//! What the subscriber process of any middleware does around its node.

use std::io::{BufRead, stdin};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use rustix::process::{Signal, set_parent_process_death_signal};
use tautline_exchange::{Log, say};
use tautline_rt::{CoreSet, MemoryLock, Policy, clock, lock_memory, set_affinity, set_policy, tune_malloc};

use crate::{Job, Line, Measured, PaperError, Scheduling, TopicMeasured, priorities};

/// With no callback ending for this long, the messages that are missing will not come.
const STALLED: Duration = Duration::from_millis(1_500);
/// How long a backlog may take, at most.
const PATIENCE: Duration = Duration::from_secs(30);
const GLANCE: Duration = Duration::from_millis(50);

/// The subscriber's process: its core, its priority, its logs, its end.
pub struct Subscriber {
    logs: Vec<Arc<Log>>,
    over: Arc<AtomicBool>,
    when_over: Hook,
    cpu_before_ns: u64,
    wcets_ns: Vec<u64>,
}

type Hook = Arc<Mutex<Option<Box<dyn FnOnce() + Send>>>>;

impl Subscriber {
    /// Binds the process to its core, locks its memory and gives the calling thread the priority that threads of the
    /// middleware are to inherit. To be called first.
    pub fn new(job: &Job) -> Result<Subscriber, PaperError> {
        let log = |topic| Arc::new(Log::new(job.releases(topic) as usize));
        let logs: Vec<_> = job.topics.iter().map(log).collect();
        let (over, when_over) = (Arc::<AtomicBool>::default(), Hook::default());
        // While threads are ordinary and may run anywhere: this one sleeps until the run is over.
        wait_for_end(logs.clone(), Arc::clone(&over), Arc::clone(&when_over))?;
        bind(job)?;
        if job.realtime {
            tune_malloc();
            lock_memory(MemoryLock::OnFault)?;
            match job.variant.scheduling {
                Scheduling::Fifo => set_policy(Policy::Fifo(priorities::SAMPLER))?,
                Scheduling::MiddlewareBelow => set_policy(Policy::Fifo(priorities::SAMPLER_BELOW))?,
                // The main thread's turn comes when the middleware has its threads.
                Scheduling::Other | Scheduling::MiddlewareOther => {}
            }
        }
        let wcets_ns = job.topics.iter().map(|topic| topic.wcet_ns).collect();
        Ok(Subscriber { logs, over, when_over, cpu_before_ns: 0, wcets_ns })
    }

    pub fn logs(&self) -> &[Arc<Log>] {
        &self.logs
    }

    pub fn over(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.over)
    }

    /// Calls `then`, in another thread, when the run is over.
    pub fn when_over(&self, then: impl FnOnce() + Send + 'static) {
        *self.when_over.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(then));
    }

    /// Tells the parent that messages may come.
    pub fn ready(&mut self) {
        self.cpu_before_ns = clock::process_cpu_ns();
        say(&Line::Ready);
    }

    /// Tells the parent what was measured. `counted_lost`: the messages of each topic that the middleware itself counted as
    /// lost; empty if it does not count.
    pub fn finish(self, counted_lost: &[u64]) {
        let cpu_ns = clock::process_cpu_ns().saturating_sub(self.cpu_before_ns);
        let topics: Vec<_> = (self.logs.iter().enumerate())
            .map(|(index, log)| TopicMeasured {
                latencies_ns: log.to_vec(),
                counted_lost: counted_lost.get(index).copied(),
            })
            .collect();
        let busy_ns: u64 =
            topics.iter().zip(&self.wcets_ns).map(|(t, wcet)| t.latencies_ns.len() as u64 * wcet).sum();
        say(&Line::Measured(Measured { overhead_cpu_ns: cpu_ns.saturating_sub(busy_ns), topics }));
    }
}

/// Binds the publisher's process to its core and gives the calling thread the paper's priority. To be called first.
pub fn set_up_publisher(job: &Job) -> Result<(), PaperError> {
    bind(job)?;
    if job.realtime {
        tune_malloc();
        lock_memory(MemoryLock::OnFault)?;
        set_policy(Policy::Fifo(priorities::PUBLISHER))?;
    }
    Ok(())
}

/// Everything runs on one core and ends with the parent, of which nothing would be left to stop it.
fn bind(job: &Job) -> Result<(), PaperError> {
    let with_parent = set_parent_process_death_signal(Some(Signal::KILL));
    with_parent.map_err(|error| PaperError::start("a process")(error.into()))?;
    Ok(set_affinity(CoreSet::one(job.core))?)
}

/// Waits in a thread until every published message was handled or no more callbacks end.
fn wait_for_end(logs: Vec<Arc<Log>>, over: Arc<AtomicBool>, when_over: Hook) -> Result<(), PaperError> {
    let wait = move || {
        let mut line = String::new();
        // Closed without a word: the parent has given up.
        let _ = stdin().lock().read_line(&mut line);
        let published: Vec<u64> = serde_json::from_str(&line).unwrap_or_default();
        wait_until_handled(&logs, &published);
        over.store(true, Ordering::Release);
        if let Some(then) = when_over.lock().unwrap_or_else(PoisonError::into_inner).take() {
            then();
        }
    };
    let started = thread::Builder::new().name("end".into()).spawn(wait);
    started.map(drop).map_err(PaperError::start("a thread"))
}

fn wait_until_handled(logs: &[Arc<Log>], published: &[u64]) {
    let (mut before, mut since) = (0, clock::monotonic_ns());
    let give_up = since + PATIENCE.as_nanos() as u64;
    loop {
        let all = logs.iter().zip(published).all(|(log, count)| log.len() as u64 >= *count);
        let handled: usize = logs.iter().map(|log| log.len()).sum();
        let now = clock::monotonic_ns();
        if handled != before {
            (before, since) = (handled, now);
        }
        if all || now - since > STALLED.as_nanos() as u64 || now > give_up {
            return;
        }
        thread::sleep(GLANCE);
    }
}
