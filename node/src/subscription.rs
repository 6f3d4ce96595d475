// SPDX-License-Identifier: MIT OR Apache-2.0
//! A subscription as a stream that measures its callback and knows how its thread waits.

use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use tautline_executor::{busy_polling, job, stop_requested};
use tautline_msgs::{Message, Plain};
use tautline_transport::{Counters, Sample, TakeError};

/// Receives messages of type `T` from one topic: a stream of [`Sample`]s that deref into shared memory.
///
/// On a callback thread each message is a job: its response time counts from the message's release, and the next poll of
/// this stream ends it. On a busy-polling thread the subscription polls its queue without any doorbell.
pub struct Subscription<T> {
    inner: tautline_transport::Subscription<T>,
    job: Option<job::Job>,
    quiet: bool,
}

impl<T: Message + Plain> Subscription<T> {
    pub(crate) fn new(inner: tautline_transport::Subscription<T>) -> Self {
        Subscription { inner, job: None, quiet: false }
    }

    /// Takes the oldest sample, if there is one, without waiting.
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall.
    ///
    /// # Errors
    /// [`TakeError`].
    pub fn take(&self) -> Result<Option<Sample<T>>, TakeError> {
        self.inner.take()
    }

    /// Received, lost, invalid, highest queue fill: to be read from any thread.
    pub fn counters(&self) -> Arc<Counters> {
        self.inner.counters()
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

impl<T: Message + Plain> Stream for Subscription<T> {
    type Item = Sample<T>;

    /// # Real-time
    /// Wait-free; no allocation; on a callback thread that measures execution times one syscall per message. Never ends.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        if let Some(job) = self.job.take() {
            job.finish();
        }
        if stop_requested() {
            // A stream that always has a next message would never let its callback end.
            return Poll::Pending;
        }
        let poll = if busy_polling() { self.poll_busily(context) } else { self.inner.poll_take(context) };
        if let Poll::Ready(sample) = &poll {
            self.job = Some(job::begin(sample.info().released_ns));
        }
        poll.map(Some)
    }
}

impl<T: Message + Plain> Subscription<T> {
    /// Looks without registering for a wake-up, and tells publishers not to ring.
    fn poll_busily(&mut self, context: &mut Context<'_>) -> Poll<Sample<T>> {
        if let Ok(Some(sample)) = self.inner.take_valid() {
            return Poll::Ready(sample);
        }
        if !self.quiet {
            self.inner.set_quiet(true);
            self.quiet = true;
        }
        // For combinators that only poll what was woken.
        context.waker().wake_by_ref();
        Poll::Pending
    }
}
