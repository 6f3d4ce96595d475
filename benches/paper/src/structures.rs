// SPDX-License-Identifier: MIT OR Apache-2.0
//! How sampling and callbacks are spread over threads, in each variant of the paper.
//!
//! The calling thread has the sampler's priority, which threads that it starts inherit (with [`Scheduling::Other`]
//! there is none to inherit).

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use futures::executor::{LocalPool, ThreadPool};
use futures::future::join_all;
use futures::task::LocalSpawnExt;
use tautline_rt::{Policy, Realtime, ThreadBuilder, set_policy};
use tokio::runtime::Builder;

use crate::{Callback, Job, PaperError, Scheduling, Structure, Subscriber, priorities};

/// How long a sampler waits before it looks whether the run is over.
const SPIN_TIMEOUT: Duration = Duration::from_millis(100);

/// A node that wakes callbacks: all that a structure needs to know of a middleware.
pub trait Sampler: Send + 'static {
    /// Waits for messages, at most for `timeout`, and wakes the callbacks that have some.
    fn spin_once(&mut self, timeout: Duration);
}

/// Runs the callbacks, one for each topic of the job, until the run is over; then returns the sampler.
pub fn run<S: Sampler>(
    job: &Job,
    subscriber: &mut Subscriber,
    sampler: S,
    callbacks: Vec<Callback>,
) -> Result<S, PaperError> {
    let (structure, scheduling) = (job.variant.structure, job.variant.scheduling);
    if job.realtime && scheduling == Scheduling::MiddlewareOther {
        set_policy(Policy::Fifo(priorities::SAMPLER))?;
    }
    let has_priorities = job.realtime && job.variant.is_realtime();
    let mut sampling = Sampling { sampler, over: subscriber.over() };
    match structure {
        Structure::Futures => {
            let mut pool = local_pool(callbacks);
            subscriber.ready();
            while sampling.turn() {
                pool.run_until_stalled();
            }
            Ok(sampling.sampler)
        }
        Structure::FuturesJoin => {
            let pool = ThreadPool::new().map_err(PaperError::start("a thread pool"))?;
            pool.spawn_ok(async {
                join_all(callbacks).await;
            });
            subscriber.ready();
            Ok(sampling.spin())
        }
        Structure::FuturesThreadPool => {
            let pool = ThreadPool::builder().pool_size(2).create();
            let pool = pool.map_err(PaperError::start("a thread pool"))?;
            callbacks.into_iter().for_each(|callback| pool.spawn_ok(callback));
            subscriber.ready();
            Ok(sampling.spin())
        }
        Structure::FuturesRt => {
            for (topic, callback) in job.topics.iter().zip(callbacks) {
                let name = format!("cb:{}", topic.name);
                spawn_callbacks(name, topic.priority, has_priorities, vec![callback])?;
            }
            subscriber.ready();
            Ok(sampling.spin())
        }
        Structure::Futures2Threads => {
            spawn_callbacks("callbacks".into(), priorities::WORKER, has_priorities, callbacks)?;
            subscriber.ready();
            Ok(sampling.spin())
        }
        Structure::Tokio | Structure::TokioRt => {
            let mut builder = Builder::new_multi_thread();
            if structure == Structure::TokioRt && has_priorities {
                // Refused only if this process could not have its own, higher priority either.
                builder.on_thread_start(|| drop(set_policy(Policy::Fifo(priorities::WORKER))));
            }
            let runtime = builder.build().map_err(PaperError::start("Tokio"))?;
            callbacks.into_iter().for_each(|callback| drop(runtime.spawn(callback)));
            subscriber.ready();
            let sampler = thread::Builder::new().name("sampler".into()).spawn(move || sampling.spin());
            let sampler = sampler.map_err(PaperError::start("a thread"))?;
            let sampler = sampler.join().map_err(|_| PaperError::Panicked);
            // Callbacks never end by themselves.
            runtime.shutdown_background();
            sampler
        }
    }
}

struct Sampling<S> {
    sampler: S,
    over: Arc<AtomicBool>,
}

impl<S: Sampler> Sampling<S> {
    /// One turn; false when the run is over.
    fn turn(&mut self) -> bool {
        self.sampler.spin_once(SPIN_TIMEOUT);
        !self.over.load(Ordering::Acquire)
    }

    fn spin(mut self) -> S {
        while self.turn() {}
        self.sampler
    }
}

/// Runs callbacks in a thread of their own, with a priority if the variant has them.
fn spawn_callbacks(
    name: String,
    priority: u8,
    has_priorities: bool,
    callbacks: Vec<Callback>,
) -> Result<(), PaperError> {
    let realtime = if has_priorities { Realtime::Required } else { Realtime::Off };
    let thread = ThreadBuilder::new(name).policy(Policy::Fifo(priority)).realtime(realtime);
    thread.spawn(move || {
        let mut pool = local_pool(callbacks);
        move || pool.run()
    })?;
    Ok(())
}

/// Callbacks that one thread runs in turn.
fn local_pool(callbacks: Vec<Callback>) -> LocalPool {
    let mut pool = LocalPool::new();
    let spawner = pool.spawner();
    callbacks.into_iter().for_each(|callback| drop(spawner.spawn_local(callback)));
    // Moves the tasks in, which allocates.
    pool.run_until_stalled();
    pool
}
