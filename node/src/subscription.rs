// SPDX-License-Identifier: MIT OR Apache-2.0
//! A subscription as a stream that measures its callback and knows how its thread waits.

use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{Ordering, fence};
use std::task::{Context, Poll};
use tautline_executor::job::QueueState;
use tautline_executor::{busy_polling, job, stop_requested};
use tautline_msgs::Message;
use tautline_transport::{Counters, Sample, TakeError};

/// Receives messages of type `T` from one topic: a stream of [`Sample`]s, each read where it was written.
///
/// On a callback thread each message is a job: its response time counts from the message's release, and the next poll of
/// this stream ends it. On a busy-polling thread the subscription polls its queue without any doorbell.
#[must_use = "nothing is received unless it is polled; dropping it ends it"]
pub struct Subscription<T> {
    inner: tautline_transport::Subscription<T>,
    job: Option<job::Job>,
    trace: tautline_trace::Object,
    quiet: bool,
    counters: Arc<Counters>,
    /// How many lost messages the callback's statistics know of.
    noted_lost: u64,
}

impl<T: Message> Subscription<T> {
    pub(crate) fn new(inner: tautline_transport::Subscription<T>) -> Self {
        let counters = inner.counters();
        let trace = tautline_trace::subscription_callback_init(inner.trace_id(), inner.topic());
        Subscription { inner, job: None, trace, quiet: false, counters, noted_lost: 0 }
    }

    /// Takes the oldest sample, if there is one, without waiting. (Not called `take`: that is a method of every stream.)
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. The message is checked: see [`Message::view`].
    ///
    /// # Errors
    /// [`TakeError`].
    pub fn try_take(&self) -> Result<Option<Sample<T>>, TakeError> {
        self.inner.try_take()
    }

    /// Received, lost, invalid, highest queue fill: to be read from any thread.
    pub fn counters(&self) -> Arc<Counters> {
        self.counters.clone()
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.inner.topic()
    }

    /// Number of publishers of the topic.
    pub fn publisher_count(&self) -> usize {
        self.inner.publisher_count()
    }
}

impl<T: Message> std::fmt::Debug for Subscription<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Subscription").field("topic", &self.topic()).finish_non_exhaustive()
    }
}

impl<T: Message> Stream for Subscription<T> {
    type Item = Sample<T>;

    /// # Real-time
    /// Wait-free; no allocation; the message is checked: see [`Message::view`]; on a callback thread that measures execution times one syscall per message. Never ends.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        if let Some(job) = self.job.take() {
            job.finish();
        }
        if stop_requested() {
            // A stream that always has a next message would never let its callback end.
            return Poll::Pending;
        }
        let busy = busy_polling();
        self.set_quiet(busy);
        let poll = if busy { self.poll_busily(context) } else { self.inner.poll_take(context) };
        if poll.is_ready() || self.counters.lost() != self.noted_lost {
            self.note_queue();
        }
        if let Poll::Ready(sample) = &poll {
            self.job = Some(job::begin_for(self.trace.id(), sample.info().released_ns));
        }
        poll.map(Some)
    }
}

impl<T: Message> Subscription<T> {
    /// Looks without registering for a wake-up.
    fn poll_busily(&mut self, context: &mut Context<'_>) -> Poll<Sample<T>> {
        if let Ok(Some(sample)) = self.inner.try_take_valid() {
            return Poll::Ready(sample);
        }
        // For combinators that only poll what was woken.
        context.waker().wake_by_ref();
        Poll::Pending
    }

    /// Tells the callback's statistics what became of its messages.
    fn note_queue(&mut self) {
        let lost = self.counters.lost();
        job::note_queue(QueueState {
            lost: lost.wrapping_sub(self.noted_lost),
            max_queue: self.counters.max_queue(),
            depth: self.inner.qos().depth as u64,
        });
        self.noted_lost = lost;
    }

    /// Publishers need not ring as long as a busy-polling thread polls, and no longer.
    fn set_quiet(&mut self, quiet: bool) {
        if quiet != self.quiet {
            self.quiet = quiet;
            self.inner.set_quiet(quiet);
            // A publisher has a fence between sending and reading the flag: either it sees the change, or the look into
            // the queue that follows here sees its sample.
            fence(Ordering::SeqCst);
        }
    }
}
