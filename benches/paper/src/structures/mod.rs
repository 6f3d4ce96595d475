// SPDX-License-Identifier: MIT OR Apache-2.0
//! How sampling and callbacks are spread over threads: one file for each variant of the paper.
//!
//! The calling thread has the sampler's priority, which threads that it starts inherit (with [`Scheduling::Other`]
//! there is none to inherit).

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tautline_rt::{Realtime, set_policy};

use crate::{Callback, Job, PaperError, Scheduling, Structure, Subscriber, Topic, priorities};

mod futures;
mod futures_2_threads;
mod futures_join;
mod futures_rt;
mod futures_thread_pool;
mod tokio;
mod tokio_rt;

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
    if job.realtime && job.variant.scheduling == Scheduling::MiddlewareOther {
        set_policy(tautline_rt::Policy::Fifo(priorities::SAMPLER))?;
    }
    let over = subscriber.over();
    let spinner = Spinner { sampler, over };
    let ready = || subscriber.ready();
    match job.variant.structure {
        Structure::Futures => futures::run(spinner, callbacks, ready),
        Structure::FuturesJoin => futures_join::run(spinner, callbacks, ready),
        Structure::FuturesRt => futures_rt::run(spinner, callbacks, ready, &job.topics, realtime(job)),
        Structure::FuturesThreadPool => futures_thread_pool::run(spinner, callbacks, ready),
        Structure::Futures2Threads => futures_2_threads::run(spinner, callbacks, ready, realtime(job)),
        Structure::Tokio => tokio::run(spinner, callbacks, ready),
        Structure::TokioRt => tokio_rt::run(spinner, callbacks, ready, realtime(job)),
    }
}

/// Whether threads get priorities of their own.
fn realtime(job: &Job) -> Realtime {
    if job.realtime && job.variant.is_realtime() { Realtime::Required } else { Realtime::Off }
}

/// A sampler that knows when the run is over.
struct Spinner<S> {
    sampler: S,
    over: Arc<AtomicBool>,
}

impl<S: Sampler> Spinner<S> {
    /// One turn; false when the run is over.
    fn turn(&mut self) -> bool {
        self.sampler.spin_once(SPIN_TIMEOUT);
        !self.over.load(Ordering::Acquire)
    }

    /// Samples until the run is over.
    fn spin(&mut self) {
        while self.turn() {}
    }
}

/// A callback's thread is named for its topic.
fn thread_name(topic: &Topic) -> String {
    format!("cb:{}", topic.name)
}
