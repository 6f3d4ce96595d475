// SPDX-License-Identifier: MIT OR Apache-2.0
//! The newest messages of all inputs, at the rate of the fastest input.

use crate::JoinError;
use crate::counters::JoinCounters;
use crate::latest::{LatestInputs, check_readers};
use crate::latest_time::LatestTime;
use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

/// A stream of the newest messages of all inputs, one tuple for each message of the fastest input: message_filters' `Synchronizer` with
/// the policy [`LatestTime`]. Messages of slower inputs are in several tuples.
///
/// Each message is a job on a callback thread, as in a [`Synchronizer`](crate::Synchronizer). If there is no room for a message, because
/// the callback still holds two of its input, it is dropped and makes no tuple.
///
/// The stream ends when all inputs have ended, or when an input has ended without sending a message.
///
/// # Real-time
/// No allocation; the clock is read once for each message. One poll takes at most as many messages as all queues together are deep;
/// then other tasks of the thread get their turn.
#[derive(Debug)]
#[must_use = "nothing is received unless it is polled"]
pub struct RateSynchronizer<C, S: LatestInputs> {
    policy: LatestTime,
    clock: C,
    readers: S::Readers,
    counters: Arc<JoinCounters>,
    depth: usize,
    turn: usize,
}

impl<C: FnMut() -> i64, S: LatestInputs> RateSynchronizer<C, S> {
    /// Joins 1 to 9 inputs, given as a tuple. `clock` returns the time in nanoseconds; it is called when a
    /// message is taken.
    ///
    /// ```
    /// use futures::{executor::block_on_stream, stream};
    /// use tautline_join::{LatestTime, RateSynchronizer, stamped};
    /// let input = |items: &'static [i64]| stamped(stream::iter(items.iter().copied()), |item| *item);
    /// let mut now_ns = 0;
    /// let clock = move || {
    ///     now_ns += 5_000_000;
    ///     now_ns
    /// };
    /// let inputs = (input(&[1, 2, 3]), input(&[10]));
    /// let joined = RateSynchronizer::new(LatestTime::new(), clock, inputs)?;
    /// let sets: Vec<_> = block_on_stream(joined).map(|(a, b)| (*a, *b)).collect();
    /// assert_eq!(sets, [(2, 10), (3, 10)]);
    /// # Ok::<(), tautline_join::JoinError>(())
    /// ```
    ///
    /// # Errors
    /// [`JoinError::Room`] if an input may hold fewer than four items.
    pub fn new(policy: LatestTime, clock: C, inputs: S) -> Result<Self, JoinError> {
        let mut readers = inputs.into_readers();
        check_readers::<S>(&mut readers)?;
        let depth = (0..S::COUNT).map(|i| S::reader(&mut readers, i).room().1.depth.max(1));
        let depth = depth.fold(0, usize::saturating_add);
        let counters = Arc::new(JoinCounters::new(S::COUNT));
        Ok(RateSynchronizer { policy, clock, readers, counters, depth, turn: 0 })
    }
}

impl<C, S: LatestInputs> RateSynchronizer<C, S> {
    /// Counters of the messages, readable from any thread. Messages that were never delivered count as
    /// dropped.
    pub fn counters(&self) -> Arc<JoinCounters> {
        self.counters.clone()
    }
}

impl<C: FnMut() -> i64 + Unpin, S: LatestInputs> RateSynchronizer<C, S> {
    /// Takes one message, from the inputs in turns. Returns the set that it makes, if any.
    fn poll_arrival(&mut self, context: &mut Context<'_>) -> Poll<Option<Option<S::All>>> {
        let (mut is_over, mut ended) = (false, 0);
        for step in 0..S::COUNT {
            let input = (self.turn + step) % S::COUNT;
            let reader = S::reader(&mut self.readers, input);
            match reader.poll_arrival(context, input, &self.counters) {
                Poll::Ready(Some(is_kept)) => {
                    self.turn = input + 1;
                    let makes_set = self.policy.arrived(input, (self.clock)()) && is_kept;
                    let set = if makes_set { S::read_all(&mut self.readers) } else { None };
                    if set.is_some() {
                        self.counters.passed_on();
                    }
                    return Poll::Ready(Some(set));
                }
                Poll::Ready(None) => {
                    is_over |= reader.is_empty();
                    ended += 1;
                }
                Poll::Pending => {}
            }
        }
        if is_over || ended == S::COUNT { Poll::Ready(None) } else { Poll::Pending }
    }
}

impl<C: FnMut() -> i64 + Unpin, S: LatestInputs> Stream for RateSynchronizer<C, S> {
    type Item = S::All;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<S::All>> {
        let synchronizer = &mut *self;
        for _ in 0..synchronizer.depth {
            let last = (synchronizer.turn + S::COUNT - 1) % S::COUNT;
            S::reader(&mut synchronizer.readers, last).finish();
            match synchronizer.poll_arrival(context) {
                Poll::Ready(Some(None)) => {}
                Poll::Ready(Some(set)) => return Poll::Ready(set),
                Poll::Ready(None) => return Poll::Ready(None),
                Poll::Pending => return Poll::Pending,
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }
}
