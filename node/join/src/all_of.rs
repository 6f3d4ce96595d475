// SPDX-License-Identifier: MIT OR Apache-2.0
//! A new message of every input.

use crate::counters::JoinCounters;
use crate::source::Source;
use crate::{JoinError, check_room, for_each_tuple};
use futures::stream::{Fuse, Stream, StreamExt};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

/// How often one poll checks all inputs.
const ROUNDS: usize = 4;

/// A stream of tuples with the newest message of each input, as soon as each input has sent one since the previous tuple. Created by
/// [`all_of`].
///
/// A message that is replaced by its successor is counted as dropped. The stream ends when an input has ended of which no message
/// waits.
///
/// # Real-time
/// No allocation. One poll takes at most as many messages of an input as its queue is deep; then other tasks of the thread get their
/// turn.
#[derive(Debug)]
#[must_use = "nothing is received unless it is polled"]
pub struct AllOf<S: AllOfInputs> {
    slots: S::Slots,
    counters: Arc<JoinCounters>,
    /// The input whose message arrived last: the callback's work belongs to its job.
    last: usize,
}

/// Waits for a new message of each of 2 to 9 inputs, given as a tuple.
///
/// ```
/// use futures::{executor::block_on_stream, stream};
/// use tautline_join::{all_of, stamped};
/// let input = |items: &'static [i64]| stamped(stream::iter(items.iter().copied()), |item| *item);
/// let all = all_of((input(&[1, 2, 3]), input(&[10])))?;
/// assert_eq!(block_on_stream(all).collect::<Vec<_>>(), [(3, 10)]);
/// # Ok::<(), tautline_join::JoinError>(())
/// ```
///
/// # Errors
/// [`JoinError::Room`] if an input may hold fewer than three items.
pub fn all_of<S: AllOfInputs>(inputs: S) -> Result<AllOf<S>, JoinError> {
    let mut slots = inputs.into_slots();
    check_room((0..S::COUNT).map(|i| S::slot(&mut slots, i).room()), 1)?;
    Ok(AllOf { slots, counters: Arc::new(JoinCounters::new(S::COUNT)), last: 0 })
}

impl<S: AllOfInputs> AllOf<S> {
    /// Counters of the messages, readable from any thread.
    pub fn counters(&self) -> Arc<JoinCounters> {
        self.counters.clone()
    }
}

impl<S: AllOfInputs> Stream for AllOf<S> {
    type Item = S::Items;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<S::Items>> {
        let AllOf { slots, counters, last } = &mut *self;
        // Twice is enough if nothing arrives meanwhile: to take the available messages, and to register for a wake-up.
        for _ in 0..ROUNDS {
            let (mut has_come, mut has_ended) = (false, false);
            for input in 0..S::COUNT {
                if *last == input {
                    S::slot(slots, input).finish();
                }
                let slot = S::slot(slots, input);
                match slot.poll_arrival(context, &mut |dropped| {
                    counters.of(input, |c| &c.received);
                    if dropped {
                        counters.of(input, |c| &c.dropped);
                    }
                }) {
                    Poll::Ready(Some(())) => {
                        let before = std::mem::replace(last, input);
                        if before != input {
                            S::slot(slots, before).finish();
                        }
                        has_come = true;
                    }
                    Poll::Ready(None) => has_ended |= slot.is_empty(),
                    Poll::Pending => {}
                }
            }
            if let Some(items) = S::take(slots) {
                counters.passed_on();
                return Poll::Ready(Some(items));
            }
            if has_ended {
                return Poll::Ready(None);
            }
            if !has_come {
                return Poll::Pending;
            }
        }
        context.waker().wake_by_ref();
        Poll::Pending
    }
}

/// Tuples of 2 to 9 [`Source`]s.
pub trait AllOfInputs: sealed::Tuple {
    /// One message of each input.
    type Items;
}

mod sealed {
    use super::{AllOfInputs, Slot};

    pub trait Tuple {
        type Slots: Unpin;
        const COUNT: usize;
        fn into_slots(self) -> Self::Slots;
        fn slot(slots: &mut Self::Slots, input: usize) -> &mut dyn Slot;
        fn take(slots: &mut Self::Slots) -> Option<Self::Items>
        where
            Self: AllOfInputs;
    }
}

/// One input and its newest item, of any type.
pub trait Slot {
    /// Takes the available messages, and reports for each one whether it replaced another.
    fn poll_arrival(&mut self, context: &mut Context<'_>, note: &mut dyn FnMut(bool)) -> Poll<Option<()>>;
    fn finish(&mut self);
    fn is_empty(&self) -> bool;
    fn room(&self) -> (String, usize);
}

#[derive(Debug)]
pub struct Input<S: Source> {
    source: Fuse<S>,
    newest: Option<S::Item>,
}

// Nothing in it is pinned but the source, which may be moved.
impl<S: Source> Unpin for Input<S> {}

impl<S: Source> Slot for Input<S> {
    fn poll_arrival(&mut self, context: &mut Context<'_>, note: &mut dyn FnMut(bool)) -> Poll<Option<()>> {
        let Some(item) = ready!(self.source.poll_next_unpin(context)) else { return Poll::Ready(None) };
        note(self.newest.replace(item).is_some());
        // Messages that arrived after it belong to the same job.
        let source = self.source.get_mut();
        for _ in 0..source.room().depth {
            let Some(newer) = source.try_next() else { break };
            note(self.newest.replace(newer).is_some());
        }
        Poll::Ready(Some(()))
    }

    fn finish(&mut self) {
        self.source.get_mut().finish();
    }

    fn is_empty(&self) -> bool {
        self.newest.is_none()
    }

    fn room(&self) -> (String, usize) {
        (self.source.get_ref().name(), self.source.get_ref().room().held)
    }
}

macro_rules! tuple {
    ($($name:ident $place:tt),*) => {
        impl<$($name: Source),*> AllOfInputs for ($($name,)*) {
            type Items = ($($name::Item,)*);
        }

        impl<$($name: Source),*> sealed::Tuple for ($($name,)*) {
            type Slots = ($(Input<$name>,)*);
            const COUNT: usize = [$($place),*].len();

            fn into_slots(self) -> Self::Slots {
                ($(Input { source: self.$place.fuse(), newest: None },)*)
            }

            fn slot(slots: &mut Self::Slots, input: usize) -> &mut dyn Slot {
                match input {
                    $($place => &mut slots.$place,)*
                    // Unreachable: inputs are numbered below `COUNT`.
                    _ => &mut slots.0,
                }
            }

            fn take(slots: &mut Self::Slots) -> Option<<Self as AllOfInputs>::Items> {
                if $(slots.$place.newest.is_none() ||)* false {
                    return None;
                }
                Some(($(slots.$place.newest.take()?,)*))
            }
        }
    };
}
for_each_tuple!(tuple);
