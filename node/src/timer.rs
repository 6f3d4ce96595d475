// SPDX-License-Identifier: MIT OR Apache-2.0
//! A timer, which measures its callback.

use crate::error::{Error, Result};
#[cfg(feature = "rosgraph_msgs")]
use crate::time::RosTimer;
use futures::Stream;
use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_executor::{job, stop_requested};
use tautline_sampler::Tick;
use tautline_transport::NodeHandle;

/// A periodic timer: absolute releases, no drift, missed ones counted. A stream of [`Tick`]s, or [`tick`](Timer::tick).
///
/// On a callback thread each tick is a job: its response time counts from the time at which it was due.
#[must_use = "nothing happens unless it is polled; dropping it ends it"]
pub struct Timer {
    inner: Inner,
    node: NodeHandle,
    job: Option<job::Job>,
    trace: tautline_trace::Object,
    _timer: tautline_trace::Object,
}

enum Inner {
    Wall(tautline_sampler::Timer),
    #[cfg(feature = "rosgraph_msgs")]
    Ros(RosTimer),
}

impl Inner {
    fn period_ns(&self) -> u64 {
        match self {
            Inner::Wall(timer) => timer.period_ns(),
            #[cfg(feature = "rosgraph_msgs")]
            Inner::Ros(timer) => timer.period_ns(),
        }
    }

    fn missed(&self) -> u64 {
        match self {
            Inner::Wall(timer) => timer.missed(),
            #[cfg(feature = "rosgraph_msgs")]
            Inner::Ros(timer) => timer.missed(),
        }
    }

    fn poll_tick(&mut self, context: &mut Context<'_>) -> Poll<Tick> {
        match self {
            Inner::Wall(timer) => timer.poll_tick(context),
            #[cfg(feature = "rosgraph_msgs")]
            Inner::Ros(timer) => timer.poll_tick(context),
        }
    }
}

impl Timer {
    pub(crate) fn new(node: &NodeHandle, inner: tautline_sampler::Timer) -> Self {
        node.adopt(inner.slot());
        Timer::of(node, Inner::Wall(inner))
    }

    #[cfg(feature = "rosgraph_msgs")]
    pub(crate) fn on_ros_clock(node: &NodeHandle, inner: RosTimer) -> Self {
        Timer::of(node, Inner::Ros(inner))
    }

    fn of(node: &NodeHandle, inner: Inner) -> Self {
        let timer = tautline_trace::timer_init(inner.period_ns());
        let name = format!("timer {:?}", Duration::from_nanos(inner.period_ns()));
        let trace = tautline_trace::timer_callback_init(timer.id(), &name);
        Timer { inner, node: node.clone(), job: None, trace, _timer: timer }
    }

    /// Waits for the next release.
    ///
    /// # Real-time
    /// Each poll wait-free; no allocation.
    ///
    /// # Errors
    /// [`Error::NodeEnded`]: the node was dropped.
    pub async fn tick(&mut self) -> Result<Tick> {
        poll_fn(|context| self.poll_tick(context)).await.ok_or(Error::NodeEnded)
    }

    /// The period.
    pub fn period(&self) -> Duration {
        Duration::from_nanos(self.inner.period_ns())
    }

    /// Releases that were not taken.
    pub fn missed(&self) -> u64 {
        self.inner.missed()
    }

    fn poll_tick(&mut self, context: &mut Context<'_>) -> Poll<Option<Tick>> {
        if let Some(job) = self.job.take() {
            job.finish();
        }
        if stop_requested() {
            // A timer that is always late would never let its callback end.
            return Poll::Pending;
        }
        let poll = self.inner.poll_tick(context);
        // Checked after the waker was registered: if the node ends after this check, the task is woken.
        if self.node.has_ended() {
            return Poll::Ready(None);
        }
        poll.map(|tick| {
            // A timer queues nothing: releases while its callback is busy are missed, except the latest.
            job::note_queue(job::QueueState { lost: tick.missed, max_queue: 1, depth: 1 });
            self.job = Some(job::begin_for(self.trace.id(), tick.since_ns));
            Some(tick)
        })
    }
}

tautline_rt::debug_fields!(Timer, |this| period_ns = this.inner.period_ns());

impl Stream for Timer {
    type Item = Tick;

    /// # Real-time
    /// Wait-free; no allocation. Ends with the node.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Tick>> {
        self.poll_tick(context)
    }
}
