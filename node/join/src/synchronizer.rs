// SPDX-License-Identifier: MIT OR Apache-2.0
//! Messages of several streams whose stamps belong together.

use crate::counters::JoinCounters;
use crate::policy::{Arrival, Policy, nanos};
use crate::source::Stamped;
use crate::{JoinError, check_room, for_each_tuple};
use futures::stream::{Fuse, Stream, StreamExt};
use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

/// A stream of sets: tuples of one message of each input, whose stamps are equal ([`ExactTime`](crate::ExactTime)) or close
/// ([`ApproximateTime`](crate::ApproximateTime), [`ApproximateEpsilonTime`](crate::ApproximateEpsilonTime)). As in message_filters,
/// with the same sets.
///
/// If time jumps back by more than [`time_jump`](Self::time_jump), for example when a recording restarts, all waiting messages are
/// dropped.
///
/// On a callback thread each message is a job. The response time of the message that completes a set includes the callback's work;
/// the other messages were only queued.
///
/// The stream ends when an input has ended of which no message waits, or when all inputs have ended.
///
/// # Real-time
/// No allocation. One poll takes at most as many messages as fit into all queues; then other tasks of the thread get their turn.
#[derive(Debug)]
#[must_use = "nothing is received unless it is polled"]
pub struct Synchronizer<P, S: SynchronizerInputs> {
    policy: P,
    queues: S::Queues,
    counters: Arc<JoinCounters>,
    newest_ns: [i64; crate::MAX_INPUTS],
    time_jump_ns: i64,
    turn: usize,
}

impl<P: Policy, S: SynchronizerInputs> Synchronizer<P, S> {
    /// Joins 2 to 9 inputs, given as a tuple.
    ///
    /// # Errors
    /// [`JoinError::NoQueue`] for a queue size of 0. [`JoinError::Room`] if an input may not hold a full queue, one arriving message
    /// and one message that the callback works on.
    pub fn new(mut policy: P, inputs: S) -> Result<Self, JoinError> {
        let queue_size = policy.queue_size();
        if queue_size == 0 {
            return Err(JoinError::NoQueue);
        }
        let mut queues = inputs.into_queues(queue_size.saturating_add(1));
        check_room((0..S::COUNT).map(|i| S::queue(&mut queues, i).room()), queue_size)?;
        policy.start(S::COUNT);
        Ok(Synchronizer {
            policy,
            queues,
            counters: Arc::new(JoinCounters::new(S::COUNT)),
            newest_ns: [i64::MIN; crate::MAX_INPUTS],
            time_jump_ns: 1_000_000_000,
            turn: 0,
        })
    }

    /// If a message's stamp is earlier than its predecessor's by more than this, time has jumped back; if by less, the message is
    /// out of order. 1 s by default.
    pub fn time_jump(self, jump: Duration) -> Self {
        Synchronizer { time_jump_ns: nanos(jump), ..self }
    }

    /// Counters of the messages, readable from any thread.
    pub fn counters(&self) -> Arc<JoinCounters> {
        self.counters.clone()
    }

    /// Takes one message, from the inputs in turns.
    fn poll_arrival(&mut self, context: &mut Context<'_>) -> Poll<Option<()>> {
        let (mut has_ended, mut ended) = (false, 0);
        for step in 0..S::COUNT {
            let input = (self.turn + step) % S::COUNT;
            let queue = S::queue(&mut self.queues, input);
            match queue.poll_arrival(context) {
                Poll::Ready(Some(stamp_ns)) => {
                    self.turn = input + 1;
                    self.put(input, stamp_ns);
                    return Poll::Ready(Some(()));
                }
                Poll::Ready(None) => {
                    has_ended |= queue.is_empty();
                    ended += 1;
                }
                Poll::Pending => {}
            }
        }
        if has_ended || ended == S::COUNT { Poll::Ready(None) } else { Poll::Pending }
    }

    /// Queues, refuses or drops the message that has arrived from `input`, as the policy decides.
    fn put(&mut self, input: usize, stamp_ns: i64) {
        self.counters.of(input, |c| &c.received);
        if stamp_ns < self.newest_ns[input].saturating_sub(self.time_jump_ns) {
            self.counters.reset();
            self.newest_ns = [i64::MIN; crate::MAX_INPUTS];
            self.policy.clear();
            for i in 0..S::COUNT {
                while S::queue(&mut self.queues, i).drop_front() {
                    self.counters.of(i, |c| &c.dropped);
                }
            }
        }
        self.newest_ns[input] = self.newest_ns[input].max(stamp_ns);
        let arrival = self.policy.arrived(input, stamp_ns);
        let queue = S::queue(&mut self.queues, input);
        match arrival {
            Arrival::Wait(place) => queue.keep(place),
            Arrival::WaitTooClose(place) => {
                self.counters.of(input, |c| &c.too_close);
                queue.keep(place);
            }
            Arrival::Refuse => {
                self.counters.of(input, |c| &c.refused);
                queue.refuse();
            }
        }
    }

    /// The next set, if there is one among the waiting messages.
    fn decide(&mut self) -> Option<S::Items> {
        let (queues, counters) = (&mut self.queues, &*self.counters);
        let mut drop = |input| {
            S::queue(queues, input).drop_front();
            counters.of(input, |c| &c.dropped);
        };
        if !self.policy.decide(&mut drop) {
            return None;
        }
        self.counters.passed_on();
        S::take(&mut self.queues)
    }
}

impl<P: Policy + Unpin, S: SynchronizerInputs> Stream for Synchronizer<P, S> {
    type Item = S::Items;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<S::Items>> {
        let synchronizer = &mut *self;
        let most = synchronizer.policy.queue_size().saturating_mul(S::COUNT).max(S::COUNT);
        for taken in 0..=most {
            if let Some(set) = synchronizer.decide() {
                return Poll::Ready(Some(set));
            }
            if taken == most {
                break;
            }
            // All sets that the last message completes were delivered.
            let last = (synchronizer.turn + S::COUNT - 1) % S::COUNT;
            S::queue(&mut synchronizer.queues, last).finish();
            match synchronizer.poll_arrival(context) {
                Poll::Ready(Some(())) => {}
                Poll::Ready(None) => return Poll::Ready(None),
                Poll::Pending => return Poll::Pending,
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }
}

/// Tuples of 2 to 9 [`Stamped`] sources.
pub trait SynchronizerInputs: sealed::Tuple {
    /// One message of each input.
    type Items;
}

mod sealed {
    use super::{Queue, SynchronizerInputs};

    pub trait Tuple {
        /// The sources with their waiting messages.
        type Queues: Unpin;
        const COUNT: usize;
        fn into_queues(self, capacity: usize) -> Self::Queues;
        fn queue(queues: &mut Self::Queues, input: usize) -> &mut dyn Queue;
        fn take(queues: &mut Self::Queues) -> Option<Self::Items>
        where
            Self: SynchronizerInputs;
    }
}

/// One input and its waiting items, of any type.
pub trait Queue {
    fn poll_arrival(&mut self, context: &mut Context<'_>) -> Poll<Option<i64>>;
    fn keep(&mut self, place: usize);
    fn refuse(&mut self);
    fn drop_front(&mut self) -> bool;
    fn finish(&mut self);
    fn is_empty(&self) -> bool;
    fn room(&self) -> (String, usize);
}

/// A source, the message that has just arrived, and the waiting messages.
#[derive(Debug)]
pub struct Input<S: Stamped> {
    source: Fuse<S>,
    arrived: Option<S::Item>,
    waiting: VecDeque<S::Item>,
}

// Nothing in it is pinned but the source, which may be moved.
impl<S: Stamped> Unpin for Input<S> {}

impl<S: Stamped> Queue for Input<S> {
    fn poll_arrival(&mut self, context: &mut Context<'_>) -> Poll<Option<i64>> {
        self.source.poll_next_unpin(context).map(|item| {
            self.arrived = item;
            self.arrived.as_ref().map(|item| self.source.get_ref().stamp_ns(item))
        })
    }

    fn keep(&mut self, place: usize) {
        if let Some(item) = self.arrived.take() {
            self.waiting.insert(place.min(self.waiting.len()), item);
        }
    }

    fn refuse(&mut self) {
        self.arrived = None;
    }

    fn drop_front(&mut self) -> bool {
        self.waiting.pop_front().is_some()
    }

    fn finish(&mut self) {
        self.source.get_mut().finish();
    }

    fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    fn room(&self) -> (String, usize) {
        (self.source.get_ref().name(), self.source.get_ref().room().held)
    }
}

macro_rules! tuple {
    ($($name:ident $place:tt),*) => {
        impl<$($name: Stamped),*> SynchronizerInputs for ($($name,)*) {
            type Items = ($($name::Item,)*);
        }

        impl<$($name: Stamped),*> sealed::Tuple for ($($name,)*) {
            type Queues = ($(Input<$name>,)*);
            const COUNT: usize = [$($place),*].len();

            fn into_queues(self, capacity: usize) -> Self::Queues {
                ($(Input {
                    source: self.$place.fuse(),
                    arrived: None,
                    waiting: VecDeque::with_capacity(capacity),
                },)*)
            }

            fn queue(queues: &mut Self::Queues, input: usize) -> &mut dyn Queue {
                match input {
                    $($place => &mut queues.$place,)*
                    // Unreachable: inputs are numbered below `COUNT`.
                    _ => &mut queues.0,
                }
            }

            fn take(queues: &mut Self::Queues) -> Option<<Self as SynchronizerInputs>::Items> {
                Some(($(queues.$place.waiting.pop_front()?,)*))
            }
        }
    };
}
for_each_tuple!(tuple);
