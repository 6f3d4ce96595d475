// SPDX-License-Identifier: MIT OR Apache-2.0
//! A subscription as a stream that measures its callback and adapts to how its thread waits.

use futures::{Stream, StreamExt};
use std::any::Any;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{Ordering, fence};
use std::task::{Context, Poll};
use std::time::Duration;
use tautline_executor::job::QueueState;
use tautline_executor::{Parker, busy_polling, job, parker, parks_on, stop_requested};
use tautline_join::{self as join, Room, StampedStream};
use tautline_msgs::HasStamp;
use tautline_transport::{
    Decode, Participant, RawSubscription, Sample, SubscriptionCounters, TakeError, ThreadBell,
};

/// Receives messages of type `T` from one topic: a stream of [`Sample`]s, each read where it was written. `T` is a Rust type, or
/// `Json` or `Cdr` for a type that is known only at run time.
///
/// On a callback thread each message is a job: its response time counts from the message's release, and the next poll of
/// this stream ends it. On a busy-polling thread the subscription is polled without a doorbell.
#[must_use = "nothing is received unless it is polled; dropping it ends it"]
pub struct Subscription<T: Decode> {
    samples: Samples<tautline_transport::Subscription<T>>,
}

impl<T: Decode> Subscription<T> {
    pub(crate) fn new(inner: tautline_transport::Subscription<T>) -> Self {
        Subscription { samples: Samples::new(inner) }
    }

    /// Takes the oldest sample, if there is one, without waiting. (Not called `take`: that is a method of every stream.)
    ///
    /// # Real-time
    /// Wait-free; no allocation; no syscall. The message is checked: see [`Message::view`](crate::Message::view).
    pub fn try_take(&self) -> Result<Option<Sample<T>>, TakeError> {
        self.samples.source().try_take()
    }

    /// The stream of owned messages, copied out of shared memory: strings and sequences are allocated.
    pub fn owned(self) -> impl Stream<Item = T::Owned> + Unpin + Send + use<T> {
        self.map(|sample| sample.to_owned())
    }

    /// Adds stamps, in nanoseconds, from the function `stamp`, so that the stream can be joined with others:
    /// for messages without a header.
    ///
    /// ```no_run
    /// # fn f(odometry: tautline::Subscription<tautline::nav_msgs::msg::Odometry>) {
    /// // When it was published, instead of what its header says.
    /// let odometry = odometry.stamped_by(|sample| sample.info().source_timestamp_ns);
    /// # drop(odometry);
    /// # }
    /// ```
    pub fn stamped_by<F: Fn(&Sample<T>) -> i64>(self, stamp: F) -> StampedStream<Self, F> {
        StampedStream::new(self, stamp)
    }

    /// The type's definition that is known at run time.
    pub fn definition(&self) -> &T::Definition {
        self.samples.source().definition()
    }

    /// Received, lost and invalid messages, highest queue fill: readable from any thread.
    pub fn counters(&self) -> Arc<SubscriptionCounters> {
        self.samples.counters()
    }

    /// The topic's fully qualified name.
    pub fn topic(&self) -> &str {
        self.samples.source().topic()
    }

    /// Number of publishers of the topic.
    pub fn publisher_count(&self) -> usize {
        self.samples.source().publisher_count()
    }
}

impl<T: Decode> AsRef<RawSubscription> for Subscription<T> {
    fn as_ref(&self) -> &RawSubscription {
        self.samples.source().raw()
    }
}

tautline_rt::debug_fields!([T: Decode] Subscription<T>, |this| topic = this.topic());

impl<T: Decode> Stream for Subscription<T> {
    type Item = Sample<T>;

    /// # Real-time
    /// Wait-free; no allocation; the message is checked: see [`Message::view`](crate::Message::view); on a callback thread that measures execution times one syscall per message. Ends with the node.
    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        self.samples.poll_next(context)
    }
}

/// The subscription as input of a join: a message that the join takes is a job, unless it is read beside a trigger.
impl<T: Decode> join::Source for Subscription<T> {
    fn name(&self) -> String {
        self.topic().to_owned()
    }

    fn room(&self) -> Room {
        let source = self.samples.source();
        Room { held: source.limits().held, depth: source.qos().depth }
    }

    fn try_next(&mut self) -> Option<Sample<T>> {
        self.samples.try_next()
    }

    fn finish(&mut self) {
        self.samples.finish();
    }
}

impl<T: HasStamp> join::Stamped for Subscription<T> {
    fn stamp_ns(&self, sample: &Sample<T>) -> i64 {
        T::stamp_ns(sample.view())
    }
}

/// The source of samples: a subscription to messages, or a server's subscription to requests.
pub(crate) trait SampleSource {
    type Sample;

    fn raw(&self) -> &RawSubscription;
    fn try_take_valid(&mut self) -> Result<Option<Self::Sample>, TakeError>;
    fn poll_take(&mut self, context: &mut Context<'_>) -> Poll<Option<Self::Sample>>;
    fn released_ns(sample: &Self::Sample) -> u64;
}

impl<T: Decode> SampleSource for tautline_transport::Subscription<T> {
    type Sample = Sample<T>;

    fn raw(&self) -> &RawSubscription {
        self.as_ref()
    }

    fn try_take_valid(&mut self) -> Result<Option<Sample<T>>, TakeError> {
        tautline_transport::Subscription::try_take_valid(self)
    }

    fn poll_take(&mut self, context: &mut Context<'_>) -> Poll<Option<Sample<T>>> {
        tautline_transport::Subscription::poll_take(self, context)
    }

    fn released_ns(sample: &Sample<T>) -> u64 {
        sample.info().released_ns
    }
}

/// A callback thread that sleeps where publishers ring.
struct ThreadParker(Arc<ThreadBell>);

impl Parker for ThreadParker {
    fn park(&self, spin: Duration) {
        self.0.wait(spin);
    }

    fn unpark(&self) {
        self.0.wake();
    }
}

/// Returns a function that creates the parkers of this participant's callback threads.
pub(crate) fn thread_parkers(
    participant: &Participant,
) -> impl Fn() -> std::result::Result<Arc<dyn Parker>, Box<dyn std::error::Error + Send + Sync>> + use<> {
    let doorbell = participant.doorbell().clone();
    move || Ok(Arc::new(ThreadParker(doorbell.claim_thread_bell()?)))
}

/// The samples of a source, each a job.
pub(crate) struct Samples<S> {
    source: S,
    job: Option<job::Job>,
    trace: tautline_trace::Object,
    quiet: bool,
    /// The parker of the thread that polled last, if publishers can wake it.
    parker: Option<Arc<dyn Parker>>,
    counters: Arc<SubscriptionCounters>,
    /// The number of lost messages already recorded in the callback's statistics.
    noted_lost: u64,
}

impl<S: SampleSource> Samples<S> {
    pub(crate) fn new(source: S) -> Self {
        let raw = source.raw();
        let counters = raw.counters();
        let trace = tautline_trace::subscription_callback_init(raw.trace_id(), raw.topic());
        Samples { source, job: None, trace, quiet: false, parker: None, counters, noted_lost: 0 }
    }

    pub(crate) fn source(&self) -> &S {
        &self.source
    }

    pub(crate) fn counters(&self) -> Arc<SubscriptionCounters> {
        self.counters.clone()
    }

    /// Ends the job of the sample that came last, if it has not ended.
    fn finish(&mut self) {
        if let Some(job) = self.job.take() {
            job.finish();
        }
    }

    /// The next sample, if there is one, without a job. A sample that cannot be taken now is taken later.
    fn try_next(&mut self) -> Option<S::Sample> {
        let sample = self.source.try_take_valid().ok().flatten();
        if sample.is_some() || self.counters.lost() != self.noted_lost {
            self.note_queue();
        }
        sample
    }

    /// Ends the job of the previous sample, and begins the job of the next one, if there is one. `None`: the node has ended, and all
    /// samples that had arrived were yielded.
    pub(crate) fn poll_next(&mut self, context: &mut Context<'_>) -> Poll<Option<S::Sample>> {
        self.finish();
        if stop_requested() {
            // A stream that always has a next message would never let its callback end.
            return Poll::Pending;
        }
        let busy = busy_polling();
        self.set_quiet(busy);
        if !parks_on(self.parker.as_ref()) {
            self.move_in();
        }
        let poll = if busy { self.poll_busily(context) } else { self.source.poll_take(context) };
        if poll.is_ready() || self.counters.lost() != self.noted_lost {
            self.note_queue();
        }
        if let Poll::Ready(Some(sample)) = &poll {
            self.job = Some(job::begin_for(self.trace.id(), S::released_ns(sample)));
        }
        poll
    }

    /// Polls the queue without registering for a wake-up.
    fn poll_busily(&mut self, context: &mut Context<'_>) -> Poll<Option<S::Sample>> {
        if let Ok(Some(sample)) = self.source.try_take_valid() {
            return Poll::Ready(Some(sample));
        }
        if self.source.raw().has_ended() && !self.source.raw().has_samples() {
            return Poll::Ready(None);
        }
        // For combinators that poll only woken tasks.
        context.waker().wake_by_ref();
        Poll::Pending
    }

    /// Records lost messages and the highest queue fill in the callback's statistics.
    fn note_queue(&mut self) {
        let lost = self.counters.lost();
        job::note_queue(QueueState {
            lost: lost.wrapping_sub(self.noted_lost),
            max_queue: self.counters.max_queue(),
            depth: self.source.raw().qos().depth as u64,
        });
        self.noted_lost = lost;
    }

    /// Makes publishers wake the current thread from now on, or the sampler if the thread does not sleep on a bell.
    #[cold]
    fn move_in(&mut self) {
        self.parker = parker();
        let any = self.parker.as_deref().map(|parker| parker as &dyn Any);
        let thread = any.and_then(|parker| parker.downcast_ref::<ThreadParker>());
        // The caller checks the queue afterwards.
        self.source.raw().wake_thread(thread.map(|ThreadParker(bell)| bell));
    }

    /// Sets whether publishers need not ring: only as long as a busy-polling thread polls.
    fn set_quiet(&mut self, quiet: bool) {
        if quiet != self.quiet {
            self.quiet = quiet;
            self.source.raw().set_quiet(quiet);
            // A publisher has a fence between sending and reading the flag: either it sees the change, or the check of
            // the queue that follows here sees its sample.
            fence(Ordering::SeqCst);
        }
    }
}
